// $TITLE: the controller of $HEADER for C++11 and later, header only.
#ifndef $PREFIX_HPP
#define $PREFIX_HPP

#include <array>

#include "$HEADER"

namespace $prefix {

using Real = $prefix_real;
using Joints = std::array<Real, $PREFIX_JOINTS>;

// What one call gives: torque, coefficients joint by joint, and status bits of every joint.
struct Output {
    Joints tau;
    std::array<Real, $PREFIX_JOINTS * $PREFIX_COEFFICIENTS> coefficients;
    std::array<int, $PREFIX_JOINTS> status;

    Real coefficient(int joint, int number) const {
        return coefficients[static_cast<unsigned>(joint * $PREFIX_COEFFICIENTS + number)];
    }
};

// Velocity, acceleration and load to friction torque; one object a mechanism, no heap.
class Friction {
public:
    static constexpr int joints = $PREFIX_JOINTS;

    Output step(const Joints &qd, const Joints &qdd, const Joints &load) {
        Output out{};
#if $PREFIX_STATE_SIZE
        if (!started_)
            $prefix_init(&state_, qd.data(), qdd.data());
        started_ = true;
        $prefix_step(&state_, qd.data(), qdd.data(), load.data(), out.tau.data(),
                     out.coefficients.data(), out.status.data());
#else
        $prefix_step(qd.data(), qdd.data(), load.data(), out.tau.data(), out.coefficients.data(),
                     out.status.data());
#endif
        return out;
    }

    // Forget all samples so far.
    void reset() {
#if $PREFIX_STATE_SIZE
        started_ = false;
#endif
    }

#if $PREFIX_STATE_SIZE
private:
    $prefix_state state_{};
    bool started_ = false;
#endif
};

#if $PREFIX_FILTER_SIZE
// Raw position and load to friction torque: the causal filter, then the friction.
class FilteredFriction {
public:
    static constexpr int joints = $PREFIX_JOINTS;
    using Positions = std::array<double, $PREFIX_JOINTS>;

    Output step(const Positions &q, const Joints &load) {
        Joints qd{}, qdd{};
        if (!started_)
            reset(q);
        $prefix_filter_step(&filter_, q.data(), qd.data(), qdd.data());
        return friction_.step(qd, qdd, load);
    }

    // Start anew as if the joints had rested at `q`.
    void reset(const Positions &q) {
        $prefix_filter_init(&filter_, q.data());
        friction_.reset();
#if $PREFIX_STATE_SIZE
        const Joints rest{};
        friction_ = Friction();
        friction_.step(rest, rest, rest);
#endif
        started_ = true;
    }

private:
    Friction friction_;
    $prefix_filter filter_{};
    bool started_ = false;
};
#endif

}  // namespace $prefix

#endif

// {{ title }}: the controller of {{ name }}.h for C++11 and later, header only.
#ifndef NF_HPP
#define NF_HPP

#include <array>

#include "{{ name }}.h"

namespace {{ prefix }} {

using Real = nf_real;
using Joints = std::array<Real, NF_JOINTS>;

// Result of one call: torque, coefficients joint by joint, and status bits of every joint.
struct Output {
    Joints tau;
    std::array<Real, NF_JOINTS * NF_COEFFICIENTS> coefficients;
    std::array<int, NF_JOINTS> status;

    Real coefficient(int joint, int number) const {
        return coefficients[static_cast<unsigned>(joint * NF_COEFFICIENTS + number)];
    }
};

// Velocity, acceleration and load to friction torque; one object per mechanism, no heap.
class Friction {
public:
    static constexpr int joints = NF_JOINTS;

    Output step(const Joints &qd, const Joints &qdd, const Joints &load) {
        Output out{};
#if NF_STATE_SIZE
        if (!started_)
            nf_init(&state_, qd.data(), qdd.data());
        started_ = true;
        nf_step(&state_, qd.data(), qdd.data(), load.data(), out.tau.data(),
                     out.coefficients.data(), out.status.data());
#else
        nf_step(qd.data(), qdd.data(), load.data(), out.tau.data(), out.coefficients.data(),
                     out.status.data());
#endif
        return out;
    }

#if NF_HAS_LOAD
    // Load of each joint at positions and velocities, see nf_load.
    static Joints load(const Joints &q, const Joints &qd) {
        Joints found{};
        nf_load(q.data(), qd.data(), found.data());
        return found;
    }
#endif

    // Forget all samples so far.
    void reset() {
#if NF_STATE_SIZE
        started_ = false;
#endif
    }

#if NF_STATE_SIZE
private:
    nf_state state_{};
    bool started_ = false;
#endif
};

#if NF_FILTER_SIZE
// Raw position and load to friction torque: the causal filter, then the friction.
class FilteredFriction {
public:
    static constexpr int joints = NF_JOINTS;
    using Positions = std::array<double, NF_JOINTS>;

    Output step(const Positions &q, const Joints &load) {
        Joints qd{}, qdd{};
        if (!started_)
            reset(q);
        nf_filter_step(&filter_, q.data(), qd.data(), qdd.data());
        return friction_.step(qd, qdd, load);
    }

    // Start again as if the joints had rested at `q`.
    void reset(const Positions &q) {
        nf_filter_init(&filter_, q.data());
        friction_.reset();
#if NF_STATE_SIZE
        const Joints rest{};
        friction_ = Friction();
        friction_.step(rest, rest, rest);
#endif
        started_ = true;
    }

private:
    Friction friction_;
    nf_filter filter_{};
    bool started_ = false;
};
#endif

}  // namespace {{ prefix }}

#endif

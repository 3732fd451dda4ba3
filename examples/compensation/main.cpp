// Friction compensation on a simulated motor: effect of the gain and of the velocity given to the
// model on a position loop. Build it with the C code from `nfriction export`, see README.md.
#include <cmath>
#include <cstdio>

#include "friction.hpp"

namespace {

constexpr double kPi = 3.141592653589793;
constexpr double kPeriod = 1e-3;  // of the controller [s]
constexpr int kSteps = 20;        // simulation steps per controller sample
constexpr double kInertia = 0.05, kStiffness = 40.0, kDamping = 2.0;
constexpr double kCount = 2 * kPi / 8192 / 50;  // an encoder on the motor, gear ratio 50
constexpr double kDeadBand = 0.05;              // [rad/s]

enum class Velocity { none, measured, faded, desired };

struct Case {
    const char *name;
    Velocity velocity;
    double gain;
};

double friction_at(double qd) {
    friction::Joints v{}, none{}, load{};
    v[0] = static_cast<friction::Real>(qd);
    load[0] = 1;
    friction::Friction model;
    return static_cast<double>(model.step(v, none, load).tau[0]);
}

// The torque to add to that of the drive. Friction torque brakes, so it is added, not subtracted.
double compensation(const Case &chosen, double measured, double desired) {
    switch (chosen.velocity) {
        case Velocity::measured:
            return chosen.gain * friction_at(measured);
        case Velocity::faded: {
            const double share = std::fmin(std::fabs(measured) / kDeadBand, 1.0);
            return chosen.gain * share * friction_at(measured);
        }
        case Velocity::desired:
            return chosen.gain * friction_at(desired);
        default:
            return 0.0;
    }
}

void run(const Case &chosen) {
    double q = 0, qd = 0, last = 0, filtered = 0, torque = 0;
    double squares = 0, chatter = 0, effort = 0;
    int moving = 0, holding = 0;
    for (int k = 0; k < 8000; ++k) {
        const double t = k * kPeriod;
        const bool holds = t >= 4;  // four seconds of a sine, then four of standstill
        const double angle = kPi * t;
        const double want = holds ? 0.0 : 0.5 * std::sin(angle);
        const double rate = holds ? 0.0 : 0.5 * kPi * std::cos(angle);
        const double push = holds ? 0.0 : -0.5 * kPi * kPi * std::sin(angle);

        const double read = std::round(q / kCount) * kCount;
        filtered += 0.3 * ((read - last) / kPeriod - filtered);
        last = read;
        // The drive applies the torque one sample later.
        const double next = kInertia * push + kStiffness * (want - read)
            + kDamping * (rate - filtered) + compensation(chosen, filtered, rate);
        for (int i = 0; i < kSteps; ++i) {
            qd += kPeriod / kSteps * (torque - friction_at(qd)) / kInertia;
            q += kPeriod / kSteps * qd;
        }
        if (t >= 1 && !holds) {
            squares += (want - q) * (want - q);
            ++moving;
        }
        if (t >= 6) {  // long after it should have come to rest
            chatter += qd * qd;
            effort += (next - torque) * (next - torque);
            ++holding;
        }
        torque = next;
    }
    std::printf("%-34s %4.1f  %9.2f  %11.2f  %9.3f\n", chosen.name, chosen.gain,
                1e3 * std::sqrt(squares / moving), 1e3 * std::sqrt(chatter / holding),
                std::sqrt(effort / holding));
}

}  // namespace

int main() {
    std::printf("%-34s gain  error mrad  rest mrad/s  chatter N m\n", "velocity given to the model");
    for (const Case &chosen : {
             Case{"none", Velocity::none, 0.0},
             Case{"measured", Velocity::measured, 0.8},
             Case{"measured", Velocity::measured, 1.0},
             Case{"measured", Velocity::measured, 1.3},
             Case{"measured, faded below 0.05 rad/s", Velocity::faded, 0.8},
             Case{"measured, faded below 0.05 rad/s", Velocity::faded, 1.3},
             Case{"desired", Velocity::desired, 0.8},
             Case{"desired", Velocity::desired, 1.0},
             Case{"desired", Velocity::desired, 1.3},
         })
        run(chosen);
    return 0;
}

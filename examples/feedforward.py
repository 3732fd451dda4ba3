"""Learn the friction of a driven axis, and add it to the torque of its position controller."""

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch

from nfriction import CVFM, FrictionModel, Recording, Rotor, Stribeck, fit, rollout, save
from nfriction.simulation.closed_loop import Electronics, control

INERTIA, COUNTS = 0.05, 8192
AXIS = Rotor(INERTIA, name="axis", position_quantum=2 * np.pi / COUNTS)
ELECTRONICS = Electronics(counts=COUNTS, delay=1, torque_limit=5.0)
REST = torch.zeros(1, dtype=torch.float64)
# F_c [N m], F_d [N m], F_v [N m s/rad], v_s [rad/s], delta [-]. Fits keep delta at 2, so no fitted
# model can express this friction exactly.
TRUTH = Stribeck(1, [0.25, 0.1, 0.12, 0.3, 1.0]).requires_grad_(False)


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="two seconds instead of ten")
    parser.add_argument("--out", type=Path, default=Path("runs/feedforward"))
    arguments = parser.parse_args(argv)
    train = [driven(seed, seconds=2.0 if arguments.quick else 10.0) for seed in (0, 1)]
    report("none", None)
    for model in (CVFM(1), Stribeck(1)):
        learnt = fit(model, AXIS, train, windows=(0.5,), fit_plant=False).model
        save(learnt, arguments.out / f"{type(model).__name__}.json")
        report(f"learnt, {type(model).__name__}", learnt)
    report("the true one", TRUTH)
    return 0


def driven(seed: int, seconds: float) -> Recording:
    """A recording of the axis under a torque of four sines."""
    time = np.arange(round(1e3 * seconds) + 1) / 1e3
    phase = np.random.default_rng(seed).uniform(0, 2 * np.pi, (4, 1))
    rate = 2 * np.pi * np.array([[0.3], [0.7], [1.1], [1.7]])
    tau = 0.35 * np.sin(rate * time + phase).sum(0)[:, None]
    run = rollout(AXIS, TRUTH, REST, REST, torch.tensor(tau[:-1]), sample_time=1e-3)
    return Recording(time, ELECTRONICS.read(run.q.numpy()), tau=tau, name=f"driven{seed}")


def report(name: str, friction: FrictionModel | None) -> None:
    """Print the error along a sine of 0.5 rad and 0.5 Hz, which no recording contains."""
    time = np.arange(8002)[:, None] / 1e3
    q, qd, qdd = (0.5 * np.pi**k * np.sin(np.pi * (time + 0.5 * k)) for k in range(3))
    torques, errors = INERTIA * qdd, [REST.numpy()] * 20
    if friction is not None:
        # At the planned velocity, so that no loop is closed through its sign.
        torques += friction(*map(torch.tensor, (qd, qdd, np.ones_like(qd)))).detach().numpy()

    def controller(time: float, measured: np.ndarray) -> np.ndarray:
        k = round(1e3 * time)
        errors.append(q[k] - measured)
        rate = (errors[-1] - errors.pop(0)) / 0.02  # over 20 ms, as counts are coarse
        return torques[k + 1] + 5.0 * errors[-1] + 0.7 * rate  # it acts one sample later

    run = control(AXIS, TRUTH, controller, REST, REST + qd[0, 0],
                  steps=8000, electronics=ELECTRONICS)  # fmt: skip
    error = np.sqrt(np.mean((run.q.numpy() - q[:-1])[2000:] ** 2))
    print(f"friction compensated: {name:16} tracking error {1e3 * error:6.2f} mrad")


if __name__ == "__main__":
    raise SystemExit(main())

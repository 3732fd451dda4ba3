"""Checks using the twins: independent frictionless simulations, the true torque, fresh releases.

Fresh releases rank models. With two releases the ranking is left to chance, as one is from upright,
where the motion amplifies every error. These ten are predictable.
"""

import importlib.util
from typing import Any

import numpy as np
import pandas as pd
import torch
from numpy.typing import NDArray

from nfriction.evaluation.score import RMSE
from nfriction.friction.models import FrictionModel
from nfriction.papers.twin.dataset import (
    QUICK_DURATION,
    RATE,
    Split,
    Twin,
    sample_count,
    specification,
)
from nfriction.papers.twin.mechanics import Array, Links, simulate
from nfriction.plant import PendulumChain, Plant
from nfriction.simulation.rollout import rollout
from nfriction.simulation.validate import required_substeps

Cells = NDArray[np.int64]

EQUATIONS, TWIN, MUJOCO = "equations", "independent mechanics", "MuJoCo"
HORIZONS = (1.0, 2.0, 5.0, 10.0)  # [s]
SPEED_CELLS, ACCELERATION_CELLS = 40, 6
# Joint angles [deg], released at rest. Drawn as in the family of twins, and selected only by the
# truth: starting one encoder count off at every joint, they stay within 16 counts for 10 s.
POSES = (
    (147.7, 37.5, 50.8), (159.0, -3.5, 27.4), (116.4, 53.5, -7.8), (204.9, -1.4, 13.2),
    (107.0, -50.7, -1.2), (117.1, 5.4, 30.0), (248.2, -41.7, -42.6), (147.5, 34.2, 47.5),
    (135.6, 19.1, -28.2), (218.5, -22.4, 58.6),
)  # fmt: skip


def simulations(plant: PendulumChain, q0: Array, qd0: Array, steps: int) -> dict[str, Array]:
    """Frictionless motions at 1 ms by the library, the twin's mechanics and, if installed, MuJoCo.

    Args:
        plant: a chain of three links with its arm fixed.
        q0, qd0: release in joint coordinates [rad, rad/s].
        steps: number of samples after the release.

    Returns:
        Joint angles by simulation, each (steps + 1, joint); MuJoCo needs `pip install
        nfriction[mujoco]`.
    """
    start = torch.as_tensor(q0), torch.as_tensor(qd0)
    found = {
        EQUATIONS: rollout(plant, None, *start, sample_time=1e-3, steps=steps).q.numpy(),
        TWIN: simulate(
            Links.of(plant), None, *(tuple(x.tolist()) for x in start), samples=steps + 1
        ).q,
    }
    if importlib.util.find_spec("mujoco") is not None:
        import mujoco  # an optional dependency

        model: Any = mujoco.MjModel.from_xml_string(_mjcf(plant))
        data = mujoco.MjData(model)
        data.qpos[:], data.qvel[:] = q0, qd0
        motion = [data.qpos.copy()]
        for _ in range(steps):
            mujoco.mj_step(model, data)
            motion.append(data.qpos.copy())
        found[MUJOCO] = np.array(motion)
    return found


def agreement(plant: PendulumChain, q0: Array, qd0: Array) -> pd.DataFrame:
    """Largest difference from the library's motion up to each horizon [rad], by simulation.

    The last row is for a start off by 1e-12 rad: chaotic motion amplifies round-off, so no two
    programs agree better than that for long. In the TLRIP paper, Figs. 3 and 4, equations and
    SimMechanics "match exactly".
    """
    steps = round(1000 * HORIZONS[-1])
    found = simulations(plant, q0, qd0, steps)
    ours = found.pop(EQUATIONS)
    moved = torch.as_tensor(q0) + 1e-12, torch.as_tensor(qd0)
    found["start off by 1e-12 rad"] = rollout(
        plant, None, *moved, sample_time=1e-3, steps=steps
    ).q.numpy()
    rows = {
        name: [float(np.abs(q - ours)[: round(1000 * h) + 1].max()) for h in HORIZONS]
        for name, q in found.items()
    }
    return pd.DataFrame.from_dict(
        rows, orient="index", columns=[f"until {h:g} s [rad]" for h in HORIZONS]
    )


def _mjcf(plant: PendulumChain) -> str:
    """The rig for MuJoCo: x along each link, z along the joint axes, the first link up."""
    given, inner = plant.to_dict(), ""
    for k in reversed(range(plant.links)):
        place = f"{given['length'][k - 1]!r} 0 0" if k else "0 0 0"
        frame = "" if k else 'xyaxes="0 0 1 0 -1 0"'
        # In a plane only Izz matters; a sphere with this inertia is physically valid.
        izz = given["inertia"][k]
        inner = (
            f'<body pos="{place}" {frame}><joint type="hinge" axis="0 0 1"/>'
            f'<inertial pos="{given["com"][k]!r} 0 0" mass="{given["mass"][k]!r}" '
            f'diaginertia="{izz!r} {izz!r} {izz!r}"/>{inner}</body>'
        )
    return (
        f'<mujoco><option integrator="RK4" timestep="0.001" gravity="0 0 {-given["gravity"]!r}">'
        '<flag contact="disable"/></option>'
        f"<worldbody>{inner}</worldbody></mujoco>"
    )


def missed_torque(twin: Twin) -> dict[str, float]:
    """Fraction of the true friction torque missed by tables over speed (and acceleration).

    A table contains the mean torque in cells with equally many samples of the training motion and
    predicts the torque along the test motion. No coefficients of the same inputs can do much
    better, so this is the cost of the choice of inputs, for any network. Returns the ratio of RMS
    error to RMS torque, averaged over the joints, for "speed" and for "speed and acceleration"
    (along the motion).
    """
    train, test = _motion(twin, "train"), _motion(twin, "test")
    shares = [_shares(train[:, :, k], test[:, :, k]) for k in range(twin.plant.joints)]
    speed, both = np.mean(shares, axis=0).tolist()
    return {"speed": speed, "speed and acceleration": both}


def _motion(twin: Twin, split: Split) -> Array:
    """Speed, acceleration and friction torque along the motion, (3, sample, joint)."""
    of = [twin.truth[label] for label, own in twin.splits.items() if own == split]
    qd, qdd, tau_f = (np.concatenate([getattr(m, k) for m in of]) for k in ("qd", "qdd", "tau_f"))
    return np.stack([qd, qdd, tau_f]) * np.sign(qd)


def _shares(train: Array, test: Array) -> tuple[float, float]:
    """Fractions of one joint's torque that the two tables miss."""
    cells = []
    for row, count in ((0, SPEED_CELLS), (1, ACCELERATION_CELLS)):
        borders = np.quantile(train[row], np.linspace(0, 1, count + 1)[1:-1])
        cells.append([np.digitize(part[row], borders) for part in (train, test)])
    speed, acceleration = cells
    both = [ACCELERATION_CELLS * v + a for v, a in zip(speed, acceleration, strict=True)]
    # Cells that training never visited have no mean to test.
    seen = np.isin(both[1], both[0])
    wanted = test[2, seen]

    def missed(known: Cells, judged: Cells) -> float:
        mean = np.bincount(known, train[2]) / np.maximum(np.bincount(known), 1)
        return float(np.sqrt(np.mean((mean[judged[seen]] - wanted) ** 2) / np.mean(wanted**2)))

    return missed(*speed), missed(*both)


def true_positions(seconds: float) -> Array:
    """True positions along the fresh releases [rad], at most 10 s, (release, sample, joint)."""
    specified, samples = specification("tlrip"), sample_count(min(seconds, QUICK_DURATION))
    links = Links.of(specified.rig())
    starts = np.deg2rad(POSES).tolist()
    return np.stack(
        [
            simulate(links, specified.friction, (a, b, c), samples=samples, rate=RATE).q
            for a, b, c in starts
        ]
    )


def free_run_errors(plant: Plant, model: FrictionModel, true: Array) -> list[list[float | None]]:
    """RMSE of free runs by fresh release and joint [rad]; None if a simulation diverges."""
    start = torch.tensor(true[:, 0])
    run = rollout(
        plant, model, start, torch.zeros_like(start), sample_time=1 / RATE,
        steps=true.shape[1] - 1, substeps=required_substeps(plant, model, 1 / RATE),
        gradients=False,
    )  # fmt: skip
    return [RMSE.of(error).to_dict()["joints"] for error in run.q.numpy() - true]

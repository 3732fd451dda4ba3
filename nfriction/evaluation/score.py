"""Scores: position errors of free runs and of windows, in the recording's own coordinates."""

import logging
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from nfriction.friction.models import FrictionModel
from nfriction.plant import Plant
from nfriction.recording import Recording
from nfriction.signals import Motion, kalman_smoother
from nfriction.simulation.protocols import Friction
from nfriction.simulation.rk4 import required_substeps
from nfriction.simulation.rollout import Scheme, rollout

logger = logging.getLogger(__name__)

Array = NDArray[np.float64]
Start = tuple[Array, Array]

HORIZONS = (1.0, 2.0, 5.0)
# A sign that passes within a hundredth of a sample is a wall, not friction: scoring it would take
# minutes, and its search has failed anyhow.
MOST_SUBSTEPS = 100
# Semi-implicit steps are of first order: short ones for errors below an encoder's [s].
STOP_STEP = 2e-4


@dataclass(frozen=True)
class RMSE:
    """Root mean square of the position error [rad; m for a sliding axis].

    Attributes:
        joints: of each joint.
        all: over samples and joints.
    """

    joints: tuple[float, ...]
    all: float

    @classmethod
    def of(cls, error: Array) -> "RMSE":
        """From errors of shape (..., joint); NaN or infinity make it infinite."""
        with np.errstate(over="ignore", invalid="ignore"):
            square = np.mean(error.reshape(-1, error.shape[-1]) ** 2, axis=0)
        square = np.where(np.isfinite(square), square, np.inf)
        return cls(tuple(float(x) for x in np.sqrt(square)), float(np.sqrt(square.mean())))

    def to_dict(self) -> dict[str, Any]:
        """Plain JSON; a diverged simulation has no number."""
        values = [x if np.isfinite(x) else None for x in (*self.joints, self.all)]
        return {"joints": values[:-1], "all": values[-1]}


@dataclass(frozen=True)
class Score:
    """How well a model predicts one recording.

    Attributes:
        recording: name of the recording.
        free_run: error of one simulation over the whole recording from its initial state; behind
            a gap in time it starts anew from the smoothed motion.
        windows: error of simulations restarted from the recording, by horizon [s].
        floor: error of the free run when every initial position is off by one encoder count:
            below it, differences between models mean nothing. None where the count is unknown.
        time, simulated: the free run, in the recording's coordinates, for figures.
        diverged_at: time at which the free run diverged [s], infinity where it did not. Friction
            too steep at rest to be simulated at all counts as diverged from the start.
    """

    recording: str
    free_run: RMSE
    windows: dict[str, RMSE]
    floor: RMSE | None
    time: Array = field(repr=False)
    simulated: Array = field(repr=False)
    diverged_at: float

    def to_dict(self) -> dict[str, Any]:
        return {
            "free_run": self.free_run.to_dict(),
            "windows": {horizon: rmse.to_dict() for horizon, rmse in self.windows.items()},
            "floor": None if self.floor is None else self.floor.to_dict(),
            "diverged_at": self.diverged_at if np.isfinite(self.diverged_at) else None,
        }


def score(
    plant: Plant,
    friction: FrictionModel | None,
    recording: Recording,
    *,
    motion: Motion | None = None,
    initial_state: Start | None = None,
    horizons: Sequence[float] = HORIZONS,
    scheme: Scheme = "rk4",
) -> Score:
    """Simulate a recording and measure the position error.

    Args:
        plant: the mechanism.
        friction: friction model, or None for no friction.
        recording: what was measured; where it does not say how its angles are written, then as
            the plant says.
        motion: its smoothed motion in joint coordinates; computed where not given.
        initial_state: q0 and qd0 of the free run in the recording's convention, (joint,) each;
            default from the smoothed motion.
        horizons: lengths of windows [s]; those longer than the recording are left out.
        scheme: of the integration, see `rollout`; `"stop"` where joints come to rest off their
            balance, which a smoothed sign lets creep back.

    Returns:
        Errors in the recording's coordinates and unit.
    """
    first_link, convention = plant.first_link, recording.resolve_convention(plant)
    joint = recording.joint_coordinates(plant)
    motion = motion or kalman_smoother(joint.time, joint.q)
    q0, qd0 = motion.q[0], motion.qd[0]
    if initial_state is not None:
        q0 = convention.position_to_joint(np.asarray(initial_state[0]), first_link)
        qd0 = convention.rate_to_joint(np.asarray(initial_state[1]), first_link)
    if scheme == "stop":
        substeps: int | None = max(1, math.ceil(recording.longest_step / STOP_STEP))
    else:
        substeps = _substeps(plant, friction, recording.longest_step, recording.name)
    quantum = plant.position_quantum
    off = np.zeros((1, len(q0))) if quantum is None else np.eye(len(q0) + 1, len(q0), -1) * quantum
    run = np.broadcast_to(motion.q, (len(off), *motion.q.shape)).copy()
    diverged_at = np.inf
    for first, last in recording.segments:
        if first > 0:
            q0, qd0 = motion.q[first], motion.qd[first]
        tau = None if joint.tau is None else joint.tau[first:last]
        step = np.diff(joint.time[first : last + 1])
        piece, lost = _simulate(
            plant, friction, (q0 + off, qd0), tau, step, substeps, scheme=scheme
        )
        run[:, first : last + 1] = piece
        diverged_at = min(diverged_at, joint.time[first] - joint.time[0] + float(lost[0]))
    simulated = convention.position_from_joint(run, first_link)
    floor = None
    if quantum is not None:
        # Independent errors of every joint add in the mean square.
        floor = RMSE.of(np.sqrt(np.sum((simulated[1:] - simulated[0]) ** 2, axis=0)))
    return Score(
        recording=recording.name,
        free_run=RMSE.of(simulated[0] - recording.q),
        windows=_windows(plant, friction, recording, motion, horizons, substeps, scheme),
        floor=floor,
        time=recording.time,
        simulated=simulated[0],
        diverged_at=float(diverged_at),
    )


def _substeps(plant: Plant, friction: Friction | None, longest: float, name: str) -> int | None:
    """Integration steps to a sample; None where friction is too steep to be simulated."""
    if friction is None:
        return 1
    # Of a slope that is no number nothing can be required.
    if torch.isfinite(friction.zero_velocity_damping()).all():
        needed = required_substeps(plant, friction, longest)
        if needed <= MOST_SUBSTEPS:
            return needed
        found = f"needs {needed} integration steps to the longest sample of {longest:g} s"
    else:
        found = "has no finite slope"
    logger.warning(
        "%s: friction %s at rest, at most %d are taken; scored as diverged. A larger `v_smooth` "
        "makes it less steep.", name, found, MOST_SUBSTEPS,
    )  # fmt: skip
    return None


def _simulate(
    plant: Plant,
    friction: Friction | None,
    start: Start,
    tau: Array | None,
    step: Array,
    substeps: int | None,
    memory: torch.Tensor | None = None,
    scheme: Scheme = "rk4",
) -> tuple[Array, Array]:
    """Positions (*batch, sample, joint) in joint coordinates, and when they diverged (*batch,)."""
    q0, qd0 = start
    if substeps is None:
        lost = np.full((len(q0), step.shape[-1] + 1, q0.shape[-1]), np.nan)
        return lost, np.zeros(len(q0))
    # Copies, for a recording's arrays are read-only and tensors know no such thing.
    torque = None if tau is None else torch.tensor(tau)
    with torch.no_grad():
        run = rollout(
            plant, friction, torch.tensor(q0), torch.tensor(qd0), torque,
            sample_time=torch.tensor(step), substeps=substeps, scheme=scheme, memory=memory,
        )  # fmt: skip
    return run.q.numpy(), run.diverged_at.numpy()


def _windows(
    plant: Plant,
    friction: FrictionModel | None,
    recording: Recording,
    motion: Motion,
    horizons: Sequence[float],
    substeps: int | None,
    scheme: Scheme,
) -> dict[str, RMSE]:
    """Error of windows that follow each other, restarted from the smoothed motion."""
    convention = recording.resolve_convention(plant)
    time = recording.time - recording.time[0]
    steps = np.diff(time)
    found = {}
    # What a controller would remember of the recording at the start of each window.
    known = None
    if friction is not None and friction.state_size:
        known = friction.schedule.states(torch.tensor(motion.qd), torch.tensor(motion.qdd))
    for horizon in horizons:
        edges = [_edges(time, span, horizon) for span in recording.segments]
        length = min((b - a for e in edges for a, b in pairwise(e)), default=0)
        starts = [a for e in edges for a in e[:-1]]
        if length < 1:
            continue
        index = np.array(starts)[:, None] + np.arange(length)
        tau = None if recording.tau is None else recording.tau[index]
        state = motion.q[starts], motion.qd[starts]
        memory = None if known is None else known[starts]
        run, _ = _simulate(plant, friction, state, tau, steps[index], substeps, memory, scheme)
        simulated = convention.position_from_joint(run, plant.first_link)
        measured = recording.q[np.array(starts)[:, None] + np.arange(length + 1)]
        found[f"{horizon:g}"] = RMSE.of(simulated - measured)
    return found


def _edges(time: Array, span: tuple[int, int], horizon: float) -> list[int]:
    """Samples between which windows of a stretch without gaps lie."""
    first, last = span
    duration = time[last] - time[first]
    # A stretch a few samples short of a whole number of windows still gives that number.
    count = int(duration / horizon + 0.02)
    width = min(horizon, duration / max(count, 1))
    stamps = time[first : last + 1] - time[first]
    return [first + int(np.searchsorted(stamps, k * width - 1e-9)) for k in range(count + 1)]


def rmse_table(scores: Mapping[str, Sequence[Score]], horizon: str | None = None) -> Array:
    """Root mean square over recordings of each model's error: rows models, columns joints, all.

    Args:
        scores: scores by model; all models over the same recordings.
        horizon: window length as in `Score.windows`; None for the free run.

    References:
        TLRIP paper, Table 10.
    """
    rows = []
    for of_model in scores.values():
        errors = [s.free_run if horizon is None else s.windows[horizon] for s in of_model]
        square = np.mean(np.square([[*e.joints, e.all] for e in errors]), axis=0)
        rows.append(np.sqrt(square))
    return np.array(rows)


def improvement_table(rmse: Array) -> Array:
    """Reduction of the error against the first row [%]: `100 (1 - rmse / rmse_first)`.

    References:
        TLRIP paper, Table 11.
    """
    # Where both diverged there is nothing to compare: NaN.
    with np.errstate(divide="ignore", invalid="ignore"):
        return 100.0 * (1.0 - rmse / rmse[0])

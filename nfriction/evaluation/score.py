"""Score a model: simulate a recording with it and measure the position error.

A model that was fitted to some recordings is judged by others, simulated from nothing but their
initial state and torques. One simulation over the whole recording is the *free run*; *windows* are
simulations of 1, 2 and 5 s restarted from the measured motion, because in a chaotic mechanism the
free run amplifies the error of its initial state more than that of the model. The next step is
`nfriction.evaluation.compare`: the scores of several models on the same recordings.
"""

import logging
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from nfriction.friction.models import FrictionModel
from nfriction.plant import Plant
from nfriction.recording import Recording
from nfriction.signals import Motion, kalman_smoother
from nfriction.simulation.rk4 import required_substeps
from nfriction.simulation.rollout import Scheme, rollout

logger = logging.getLogger(__name__)

Array = NDArray[np.float64]

HORIZONS = (1.0, 2.0, 5.0)
# Friction that needs more integration steps to a sample than this is a wall: scoring it would take
# minutes, and the search that found it has failed anyhow.
MOST_SUBSTEPS = 100
# The time-stepping scheme is of first order: such steps keep its error below an encoder's [s].
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
        """Plain JSON; a diverged simulation has null for a number."""
        values = [x if np.isfinite(x) else None for x in (*self.joints, self.all)]
        return {"joints": values[:-1], "all": values[-1]}


@dataclass(frozen=True)
class Score:
    """Position errors of a model on one recording.

    Attributes:
        recording: name of the recording.
        free_run: error of one simulation from the initial state; behind a gap in time it restarts
            from the smoothed motion.
        windows: error of simulations restarted from the recording, by horizon [s].
        floor: error of the free run caused by initial positions that are off by one encoder count:
            differences between models below it are not meaningful. None where the count is unknown.
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
    initial_state: tuple[Array, Array] | None = None,
    horizons: Sequence[float] = HORIZONS,
    scheme: Scheme = "rk4",
) -> Score:
    """Simulate a recording and measure the position error.

    Args:
        plant: the mechanism.
        friction: friction model, or None for no friction.
        recording: the measured motion; the plant's angle convention applies where it has none.
        motion: its smoothed motion in joint coordinates; computed where not given.
        initial_state: q0 and qd0 of the free run in the recording's convention, (joint,) each;
            default from the smoothed motion.
        horizons: lengths of windows [s]; those longer than the recording are skipped.
        scheme: of the integration, see `rollout`; `"time_stepping"` where joints come to
            rest off their balance, which a smoothed sign lets creep back.

    Returns:
        Errors in the recording's coordinates and unit.
    """
    convention, first_link = recording.resolve_convention(plant), plant.first_link
    joint = recording.joint_coordinates(plant)
    motion = motion or kalman_smoother(joint.time, joint.q)
    start = motion.q[0], motion.qd[0]
    if initial_state is not None:
        q0, qd0 = (np.asarray(given) for given in initial_state)
        start = (convention.position_to_joint(q0, first_link),
                 convention.rate_to_joint(qd0, first_link))  # fmt: skip
    simulator = _Simulator(plant, friction, joint, motion, scheme)
    q, diverged_at = simulator.free_runs(*start)
    simulated = convention.position_from_joint(q, first_link)
    windows = {}
    for horizon in horizons:
        samples, q = simulator.windows(horizon)
        if len(samples):
            error = convention.position_from_joint(q, first_link) - recording.q[samples]
            windows[f"{horizon:g}"] = RMSE.of(error)
    floor = None
    if plant.position_quantum is not None:
        # Independent errors of every joint add in the mean square.
        floor = RMSE.of(np.sqrt(np.sum((simulated[1:] - simulated[0]) ** 2, axis=0)))
    free_run = RMSE.of(simulated[0] - recording.q)
    return Score(
        recording.name, free_run, windows, floor, recording.time, simulated[0], diverged_at
    )


class _Simulator:
    """Simulates parts of a recording, driven by its torques; all in joint coordinates."""

    def __init__(
        self,
        plant: Plant,
        friction: FrictionModel | None,
        recording: Recording,
        motion: Motion,
        scheme: Scheme,
    ) -> None:
        self.plant, self.friction, self.recording = plant, friction, recording
        self.motion, self.scheme = motion, scheme
        # From zero, so that the rounding of large stamps costs no window its last sample.
        self.time = recording.time - recording.time[0]
        self.substeps: int | None = math.ceil(recording.longest_step / STOP_STEP)
        if scheme != "time_stepping":
            self.substeps = _substeps(plant, friction, recording)
        self.states: torch.Tensor | None = None
        if friction is not None and friction.state_size:
            # Those of a controller at every sample, from which windows go on.
            qd, qdd = torch.tensor(motion.qd), torch.tensor(motion.qdd)
            self.states = friction.schedule.states(qd, qdd)

    def free_runs(self, q0: Array, qd0: Array) -> tuple[Array, float]:
        """The free run, then one for each joint that starts one encoder count off.

        Returns:
            Positions (run, sample, joint), and when the first run diverged [s].
        """
        count, joints = self.plant.position_quantum, len(q0)
        off = np.zeros((1, joints)) if count is None else count * np.eye(joints + 1, joints, -1)
        q = np.broadcast_to(self.motion.q, (len(off), *self.motion.q.shape)).copy()
        diverged_at = math.inf
        for first, last in self.recording.segments:
            if first > 0:
                q0, qd0 = self.motion.q[first], self.motion.qd[first]
            run, lost = self._simulate(q0 + off, qd0, np.arange(first, last))
            q[:, first : last + 1] = run
            diverged_at = min(diverged_at, float(self.time[first] + lost[0]))
        return q, diverged_at

    def windows(self, horizon: float) -> tuple[NDArray[np.intp], Array]:
        """Samples (window, sample) of windows that follow each other, and positions there."""
        starts: list[int] = []
        length = len(self.time)
        for first, last in self.recording.segments:
            stamps = self.time[first : last + 1] - self.time[first]
            # A stretch a few samples short of a whole number of windows still gives that number.
            count = int(stamps[-1] / horizon + 0.02)
            width = min(horizon, stamps[-1] / max(count, 1))
            edges = first + np.searchsorted(stamps, width * np.arange(count + 1) - 1e-9)
            starts += edges[:-1].tolist()
            length = min([length, *np.diff(edges).tolist()])
        if not starts or length < 1:
            return np.zeros((0, 0), dtype=np.intp), np.zeros(0)
        samples = np.array(starts)[:, None] + np.arange(length + 1)
        memory = None if self.states is None else self.states[starts]
        q0, qd0 = self.motion.q[starts], self.motion.qd[starts]
        return samples, self._simulate(q0, qd0, samples[:, :-1], memory)[0]

    def _simulate(
        self, q0: Array, qd0: Array, samples: NDArray[np.intp], memory: torch.Tensor | None = None
    ) -> tuple[Array, Array]:
        """Positions (*batch, sample + 1, joint) over samples, and when they diverged (*batch,)."""
        if self.substeps is None:
            lost = np.full((len(q0), samples.shape[-1] + 1, q0.shape[-1]), np.nan)
            return lost, np.zeros(len(q0))
        # Copies, because a recording's arrays are read-only, which tensors cannot be.
        tau = None if self.recording.tau is None else torch.tensor(self.recording.tau[samples])
        step = torch.tensor(np.diff(self.time)[samples])
        with torch.no_grad():
            run = rollout(
                self.plant, self.friction, torch.tensor(q0), torch.tensor(qd0), tau,
                sample_time=step, substeps=self.substeps, scheme=self.scheme, hidden_state=memory,
            )  # fmt: skip
        return run.q.numpy(), run.diverged_at.numpy()


def _substeps(plant: Plant, friction: FrictionModel | None, recording: Recording) -> int | None:
    # None where friction is too steep to be simulated.
    if friction is None:
        return 1
    longest = recording.longest_step
    if torch.isfinite(friction.zero_velocity_damping()).all():
        needed = required_substeps(plant, friction, longest)
        if needed <= MOST_SUBSTEPS:
            return needed
        found = f"needs {needed} integration steps to the longest sample of {longest:g} s"
    else:
        found = "has no finite slope"
    logger.warning(
        "%s: friction %s at rest (limit: %d); scored as diverged. A larger `v_smooth` makes it "
        "less steep.", recording.name, found, MOST_SUBSTEPS,
    )  # fmt: skip
    return None

"""Score a model: simulate a recording with it and measure the position error.

A model that was fitted to some recordings is tested on others. Its simulations use only their
torques and an initial state, which the model estimates from a short lead-in that is not scored
(`nfriction.evaluation.lead_in`). One simulation over the whole recording is the *free run*;
*windows* are simulations of 1, 2 and 5 s, because a chaotic free run amplifies the error of the
initial state more than that of the model. This is the last file of the tour;
`nfriction.evaluation.compare` scores several models.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from nfriction.evaluation.lead_in import DRAWS, LEAD_IN, ZERO_IN, Runs, Simulator, with_own_zero
from nfriction.fitting.data.inputs import release
from nfriction.fitting.options import checked_lengths
from nfriction.friction.models import FrictionModel
from nfriction.plant import Plant, rigs
from nfriction.recording import Array, Recording, RecordingLike
from nfriction.simulation.rollout import Scheme

HORIZONS = (1.0, 2.0, 5.0)


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
        # A diverged motion must not score better than one that is merely bad.
        square = np.where(np.isfinite(square), square, np.inf)
        return cls(tuple(float(x) for x in np.sqrt(square)), float(np.sqrt(square.mean())))

    def to_dict(self) -> dict[str, Any]:
        """Plain JSON; null in place of a number if the simulation diverged."""
        values = [x if np.isfinite(x) else None for x in (*self.joints, self.all)]
        return {"joints": values[:-1], "all": values[-1]}


@dataclass(frozen=True)
class Errors:
    """Position errors of simulations of a recording.

    Attributes:
        free_run: error of one simulation, from a given state or from a lead-in of 0.2 s; after a
            gap in time it restarts from another lead-in.
        windows: error of consecutive simulations, by horizon [s]; each starts from its own
            lead-in.
    """

    free_run: RMSE
    windows: dict[str, RMSE]

    def __str__(self) -> str:
        windows = (f"{horizon} s: {rmse.all:.3g}" for horizon, rmse in self.windows.items())
        return ", ".join((f"free run: {self.free_run.all:.3g}", *windows))

    def to_dict(self) -> dict[str, Any]:
        return {
            "free_run": self.free_run.to_dict(),
            "windows": {horizon: rmse.to_dict() for horizon, rmse in self.windows.items()},
        }


@dataclass(frozen=True)
class Score(Errors):
    """Errors of one model on one recording; they are plain data, without plant or model.

    Attributes:
        limit: errors that noise in initial states, encoder zeros and torques, together with the
            integration, can cause in simulations of this model: the largest of 39 draws, which the
            true model exceeds in one of 40 cases; None if not requested. Smaller differences
            between models are not meaningful.
        time, simulated: the free run with its lead-ins, in the recording's coordinates, for
            figures; NaN between gaps that leave no room for a lead-in.
        diverged_at: time at which the free run diverged [s], infinity if it did not. Friction
            too steep at rest to be simulated counts as diverged from the start.
        zero: offset that the model added to recorded positions, the encoders' zero, (joint,).
    """

    limit: Errors | None
    recording: str
    time: Array = field(repr=False)
    simulated: Array = field(repr=False)
    diverged_at: float
    zero: tuple[float, ...] | None = None
    unit: str = "rad; m"  # of the errors

    def __str__(self) -> str:
        limit = "" if self.limit is None else f"; limit of these data: {self.limit}"
        return (
            f"RMSE [{self.unit}] of {self.recording or 'a recording'}: {super().__str__()}{limit}"
        )

    def to_dict(self) -> dict[str, Any]:
        return {
            **super().to_dict(),
            "limit": None if self.limit is None else self.limit.to_dict(),
            "diverged_at": self.diverged_at if np.isfinite(self.diverged_at) else None,
            "zero": None if self.zero is None else list(self.zero),
        }


def score(
    plant: Plant | str,
    friction: FrictionModel | None,
    recording: RecordingLike,
    *,
    initial_state: tuple[Array, Array] | None = None,
    horizons: Sequence[float] = HORIZONS,
    scheme: Scheme = "rk4",
    limit: bool = True,
    zeroed: bool = False,
) -> Score:
    """Simulate a recording and measure the position error.

    Args:
        plant: the mechanism, its name, or the path of a rig file.
        friction: friction model, or None for no friction.
        recording: or its path or table; without an angle convention it has the plant's. Without a
            torque, and held at first, it is scored from its release.
        initial_state: q0 and qd0 of the free run in the recording's convention, (joint,) each,
            used unchanged and scored from the first sample; by default estimated from a lead-in.
        horizons: lengths of windows [s]; left out if longer than the recording or under a sample.
        scheme: of the integration, see `rollout`; `"time_stepping"` if joints come to rest away
            from their equilibrium, to which a smoothed sign lets them creep back.
        limit: also find the limit of these data, which takes forty times as many simulations.
        zeroed: the encoders were set to zero at the start, at rest in a pose held by stiction; the
            model estimates their true zero from the first second, which is not scored.

    Returns:
        Errors in the recording's coordinates and unit.

    Raises:
        ValueError: if the recording is too short, or lacks a torque that the law reads.
    """
    plant = rigs.of(plant)
    recording = Recording.of(recording, plant=plant)
    first = release(recording) if initial_state is None else 0
    whole = recording
    if first:
        recording = recording[first:]
    horizons = checked_lengths("horizons", horizons, 0)
    zero = None
    if zeroed:
        recording, initial_state, zero = with_own_zero(plant, friction, recording, initial_state)
    simulator = Simulator(plant, friction, recording, scheme, DRAWS if limit else 0, zero)
    runs = simulator.free_runs(initial_state)
    if not runs:
        raise ValueError(
            f"{recording.name or 'the recording'} is too short to be scored: its longest stretch "
            f"without a gap must be longer than the lead-in of {ZERO_IN if zero else LEAD_IN:g} s."
        )
    windows = {f"{h:g}": run for h in horizons if (run := simulator.windows(h)) is not None}
    simulated = np.full_like(whole.q, np.nan)
    for run in runs:
        simulated[first:][run.samples] = run.q - (0.0 if zero is None else zero.offset)
    return Score(
        RMSE.of(np.concatenate([run.error for run in runs], axis=1)),
        {horizon: RMSE.of(run.error) for horizon, run in windows.items()},
        Errors(_bound(runs), {horizon: _bound([run]) for horizon, run in windows.items()})
        if limit else None,
        whole.name,
        whole.time,
        simulated,
        min(run.diverged_at for run in runs),
        None if zero is None else tuple(zero.offset.tolist()), plant.unit,
    )  # fmt: skip


def _bound(runs: Sequence[Runs]) -> RMSE:
    """Largest error from all drawn starts, by joint and over all."""
    # Runs are weighted by their samples, so that a short stretch between gaps does not decide.
    weights = [run.error[..., 0].size for run in runs]
    squares = np.average([run.squares for run in runs], axis=0, weights=weights)
    squares = np.where(np.isfinite(squares), squares, np.inf)
    joints = np.sqrt(squares.max(axis=0))
    return RMSE(tuple(joints.tolist()), float(np.sqrt(squares.mean(axis=1).max())))

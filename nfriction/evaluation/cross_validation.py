"""Choose a law on training data alone, by cross-validation over blocks of time."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from numbers import Integral, Real
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import torch

from nfriction.evaluation.lead_in import longest_window
from nfriction.evaluation.parallel import Data, Fits, Progress, fit_models
from nfriction.evaluation.score import score
from nfriction.fitting.data.inputs import (
    apply_encoder_offsets,
    looks_zeroed_per_recording,
    released,
)
from nfriction.fitting.options import DEFAULTS
from nfriction.fitting.result.fit_result import FitResult
from nfriction.fitting.result.paired_test import improves
from nfriction.friction import model_by_name, model_name
from nfriction.plant import Plant, rigs
from nfriction.recording import Recording, RecordingLike
from nfriction.signals import Motion, kalman_smoother

# Relative difference of errors that counts as a tie.
TOLERANCE = 0.02
# Fewer samples say nothing about a law.
SHORTEST_BLOCK = 100


class TimeBlock(NamedTuple):
    """A part of a recording, with its motion in joint coordinates."""

    recording: Recording
    motion: Motion


class Fold(NamedTuple):
    """A block of a recording for testing, and the rest of it for training."""

    test: TimeBlock
    train: TimeBlock


@dataclass(frozen=True)
class Candidate:
    """Errors of one model on blocks that its fits had not seen.

    Attributes:
        errors: root mean square position error of each block [rad or m], infinite where the model
            diverged or could not be fitted; blocks in the same order for all candidates.
        parameters: number of fitted parameters of the friction model.
    """

    name: str
    errors: tuple[float, ...]
    parameters: int
    converged: bool

    @property
    def error(self) -> float:
        """Root mean square over the blocks."""
        return math.sqrt(sum(e * e for e in self.errors) / len(self.errors))


@dataclass(frozen=True, repr=False)
class Selection:
    """Models compared by cross-validation, and the one to choose.

    Attributes:
        candidates: all models, in the order given.
        horizon: length of the scored simulations [s].
    """

    chosen: str
    reason: str
    candidates: tuple[Candidate, ...]
    horizon: float
    unit: str

    def __repr__(self) -> str:
        """The choice, its reason, and the errors of all candidates."""
        return f"Selection of {self.chosen}: {self.reason}\n{self.to_frame().to_string()}"

    def to_frame(self) -> pd.DataFrame:
        """Candidates as rows: error over all blocks with its unit, parameters, converged."""
        rows = {c.name: (c.error, c.parameters, c.converged) for c in self.candidates}
        columns = [f"error [{self.unit}]", "parameters", "converged"]
        return pd.DataFrame.from_dict(rows, orient="index", columns=columns)

    def to_dict(self) -> dict[str, Any]:
        """Plain JSON; null in place of a number for a diverged block."""
        return {
            "chosen": self.chosen,
            "reason": self.reason,
            "horizon": self.horizon,
            "units": self.unit,
            "candidates": {
                c.name: {
                    "error": c.error if math.isfinite(c.error) else None,
                    "blocks": [e if math.isfinite(e) else None for e in c.errors],
                    "parameters": c.parameters,
                    "converged": c.converged,
                }
                for c in self.candidates
            },
        }


def select(
    plant: Plant | str | Path,
    models: str | Sequence[str],
    recordings: RecordingLike | Sequence[RecordingLike],
    *,
    folds: int = 3,
    horizon: float = 5.0,
    progress: Progress | None = None,
    jobs: int = 1,
    **fit_settings: Any,
) -> Selection:
    """Choose a friction model from training recordings alone.

    Every recording is cut into as many blocks of time as there are folds. Each fold leaves one
    block of every recording out, fits all models to the rest and simulates the hold-out blocks; if
    encoders were zeroed at the start of each recording, with the offsets estimated from the rest. A
    model with fewer parameters is preferred if its error is statistically tied with the smallest
    one: within 2 %, or within the scatter over blocks (`improves`).

    Args:
        plant, models, progress, jobs, fit_settings: as in `compare`.
        folds: at least 2.
        horizon: length of the simulations [s], or of a shorter block.

    Raises:
        ValueError: if there are fewer than two folds, no model or no recording, or a recording is
            too short to be cut.
    """
    plant = rigs.of(plant)
    if not isinstance(horizon, Real) or not 0 < horizon < math.inf:
        raise ValueError(f"`horizon` must be a positive length [s] such as 5.0, got {horizon!r}.")
    models = [models] if isinstance(models, str) else models
    recordings = released(Recording.many(recordings, plant=plant))
    if not isinstance(folds, Integral) or folds < 2 or not models or not recordings:
        raise ValueError(
            "selection needs models, recordings and a whole number of at least 2 folds, got "
            f"{len(models)} models, {len(recordings)} recordings and {folds!r} folds."
        )
    names = list(dict.fromkeys(map(model_name, models)))
    by_recording = [blocked_k_fold(plant, recording, folds) for recording in recordings]
    if fit_settings.get("encoder_reference", "auto") == "auto":
        # A block alone does not show the start of its recording.
        per_recording = looks_zeroed_per_recording(plant, recordings)
        fit_settings["encoder_reference"] = "per_recording" if per_recording else "shared"
    horizon = min(horizon, *(longest_window(f.test.recording) for row in by_recording for f in row))
    train, test = {}, {}
    for k in range(folds):
        label = f"fold {k + 1} of {folds}: fit"
        # Staggered, so that no fold leaves out the same part of every recording.
        chosen = [row[(k + i) % folds] for i, row in enumerate(by_recording)]
        test[label] = [fold.test for fold in chosen]
        left = [fold.train for fold in chosen]
        train[label] = Data([b.recording for b in left], [b.motion for b in left])
    fits = fit_models(plant, names, train, jobs=jobs, progress=progress, **fit_settings)
    candidates = tuple(_candidate(plant, name, fits, test, horizon) for name in names)
    return Selection(*choose(candidates, plant.unit), candidates, horizon, plant.unit)


def blocked_k_fold(plant: Plant, recording: Recording, count: int) -> list[Fold]:
    """Folds of a recording, each with one of `count` blocks of time for testing.

    Blocks share their end samples with the rest. The whole recording is smoothed once, so that a
    block's ends are known as well as its middle.

    Raises:
        ValueError: if the blocks would have fewer than 100 samples.
    """
    if len(recording) < SHORTEST_BLOCK * count:
        raise ValueError(
            f"{recording.name or 'a recording'} has {len(recording)} samples, too few for "
            f"{count} blocks of at least {SHORTEST_BLOCK}; give fewer folds or longer recordings."
        )
    joint = recording.joint_coordinates(plant)
    motion = kalman_smoother(joint.time, joint.q)
    series, index = (motion.time, motion.q, motion.qd, motion.qdd), np.arange(len(recording))
    folds = []
    for first, last in pairwise(np.linspace(0, index[-1], count + 1).astype(int)):
        inside = (first <= index) & (index <= last)
        # A block at an end of the recording leaves no single sample over.
        rest = ((index <= first) & (first > 0)) | ((last <= index) & (last < index[-1]))
        parts = ((recording[m], [x[m] for x in series]) for m in (inside, rest))
        folds.append(Fold(*(TimeBlock(of, Motion(*smoothed)) for of, smoothed in parts)))
    return folds


def block_errors(found: FitResult, blocks: Sequence[TimeBlock], horizon: float) -> list[float]:
    """Root mean square position error of simulations of `horizon` seconds over each block.

    Encoder offsets are those that the fit found in the rest; one block for each recording.
    """
    given, motions = zip(*blocks, strict=True)
    recordings, _ = apply_encoder_offsets(found.encoder_offsets, found.plant, given, motions)
    scores = [
        score(found.plant, found.model, found.aligned(r), horizons=(horizon,), limit=False)
        for r in recordings
    ]
    return [scored.windows[f"{horizon:g}"].all for scored in scores]


def _candidate(
    plant: Plant,
    name: str,
    fits: Mapping[str, Fits],
    test: Mapping[str, list[TimeBlock]],
    horizon: float,
) -> Candidate:
    """The errors of a model on the blocks that its fits have not seen."""
    errors: list[float] = []
    converged = True
    for label, blocks in test.items():
        found = fits[label].found.get(name)
        converged &= found is not None and found.converged
        errors += block_errors(found, blocks, horizon) if found else [math.inf] * len(blocks)
    parameters = model_by_name(name)(plant.joints).schedule.parameter_vector().numel()
    return Candidate(name, tuple(errors), parameters, converged)


def choose(candidates: Sequence[Candidate], unit: str = "rad") -> tuple[str, str]:
    """The model with the fewest parameters that is tied with the best, and the reason.

    Args:
        candidates: with errors on the same blocks.
    """

    def error(candidate: Candidate) -> str:
        return f"{1e3 * candidate.error:.3g} m{unit}"

    best = min(candidates, key=lambda c: c.error)
    if not math.isfinite(best.error):
        simplest = min(candidates, key=lambda c: c.parameters)
        return simplest.name, "every model diverged on a hold-out block; the simplest is chosen."
    tied = [c for c in candidates if indistinguishable(c, best)]
    chosen = min(tied, key=lambda c: (c.parameters, c.error))
    if chosen is not best:
        return chosen.name, (
            f"its error on hold-out blocks, {error(chosen)}, is statistically tied with the "
            f"smallest, {error(best)} of {best.name}, and it has fewer parameters "
            f"({chosen.parameters} against {best.parameters})."
        )
    others = sorted((c for c in candidates if c is not best), key=lambda c: c.error)
    if not others:
        return best.name, "it is the only model."
    if math.isinf(others[0].error):
        return best.name, "every other model diverged on a hold-out block."
    return best.name, (
        f"its error on hold-out blocks, {error(best)}, is the smallest; {others[0].name} follows "
        f"with {error(others[0])}."
    )


def indistinguishable(one: Candidate, best: Candidate, least: float = DEFAULTS.min_noise) -> bool:
    """True if two errors differ by no more than their scatter over the blocks explains.

    Errors of less than `least` [unit of the errors] are alike.
    """
    squares = np.square([best.errors, one.errors]).clip(min=least**2)
    new, old = torch.from_numpy(squares)
    return not improves(new, old, least=1 + TOLERANCE)

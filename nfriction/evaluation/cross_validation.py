"""Choice of a law on training data alone, by cross-validation over blocks of time."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from nfriction.evaluation.fit_many import Data, Fits, fit_models
from nfriction.evaluation.time_blocks import (
    Block,
    Split,
    block_errors,
    leave_blocks_out,
    longest_stretch,
)
from nfriction.fitting.data.checks import looks_zeroed_per_recording
from nfriction.fitting.options import DEFAULTS
from nfriction.friction.registry import model_by_name
from nfriction.plant import Plant
from nfriction.recording import Recording


@dataclass(frozen=True)
class Candidate:
    """How one model fared on blocks that it had not seen.

    Attributes:
        name: of the model.
        errors: root mean square position error of each block [rad or m], infinite where the model
            diverged or could not be fitted; blocks in the same order for all candidates.
        parameters: how many numbers a fit varies in the friction model.
        converged: whether every fold's fit converged.
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
    """Models compared by cross-validation, and the one to take.

    Attributes:
        chosen: name of the model.
        reason: why, in a sentence.
        candidates: all models, in the order given.
        horizon: length of the simulations that were judged [s].
        unit: of the errors.
    """

    chosen: str
    reason: str
    candidates: tuple[Candidate, ...]
    horizon: float
    unit: str

    def __repr__(self) -> str:
        """What is chosen and why, and how all candidates fared."""
        return f"Selection of {self.chosen}: {self.reason}\n{self.to_frame().to_string()}"

    def to_frame(self) -> pd.DataFrame:
        """Candidates as rows: error over all blocks with its unit, parameters, converged."""
        rows = {c.name: (c.error, c.parameters, c.converged) for c in self.candidates}
        columns = [f"error [{self.unit}]", "parameters", "converged"]
        return pd.DataFrame.from_dict(rows, orient="index", columns=columns)

    def to_dict(self) -> dict[str, Any]:
        """Plain JSON; a diverged block has no number."""
        return {
            "chosen": self.chosen,
            "reason": self.reason,
            "horizon": self.horizon,
            "units": self.unit,
            "candidates": {
                c.name: {
                    "error": _finite(c.error),
                    "blocks": [_finite(e) for e in c.errors],
                    "parameters": c.parameters,
                    "converged": c.converged,
                }
                for c in self.candidates
            },
        }


def select(
    plant: Plant,
    models: Sequence[str],
    recordings: Sequence[Recording],
    *,
    folds: int = 3,
    horizon: float = 5.0,
    tolerance: float = 0.02,
    on_stage: Callable[[str], None] | None = None,
    on_step: Callable[[str], None] | None = None,
    jobs: int = 1,
    **fit_settings: Any,
) -> Selection:
    """Choose a friction model from training recordings alone.

    Every recording is cut into as many blocks of time as there are folds. Each fold leaves one
    block of every recording out, fits all models to the rest and simulates the blocks left out;
    where encoders were zeroed anew for each recording, with the zeros that the rest showed. A
    model with fewer parameters is preferred where its error cannot be told from the least one:
    within `tolerance`, or within the standard error of the difference over blocks, both of their
    mean squares and of the logarithms: one block of violent motion must not hide that it is worse
    on all others.

    Args:
        plant: the mechanism as given.
        models: names of models, simple ones first.
        recordings: what may be trained on.
        folds: at least 2.
        horizon: length of the simulations [s]; a block where that is shorter.
        tolerance: relative difference of errors that counts as none.
        on_stage, on_step, jobs: as in `compare`; fits of different folds never wait for each
            other.
        fit_settings: see `fit`.

    Returns:
        The choice, with every model's error on every block.

    Raises:
        ValueError: if there are fewer than two folds, no model or no recording, or a recording is
            too short to be cut.
    """
    if folds < 2 or not models or not recordings:
        raise ValueError(
            "a choice needs models, recordings and at least 2 folds, got "
            f"{len(models)} models, {len(recordings)} recordings and {folds} folds."
        )
    names = list(dict.fromkeys(models))
    splits = [leave_blocks_out(plant, recording, folds) for recording in recordings]
    if fit_settings.get("encoder_reference", "auto") == "auto":
        # Blocks no longer show where their recording began.
        per_recording = looks_zeroed_per_recording(plant, recordings)
        fit_settings["encoder_reference"] = "per_recording" if per_recording else "shared"
    horizon = min(horizon, *(longest_stretch(s.unseen.recording) for row in splits for s in row))
    seen, unseen = _folds(splits, folds)
    fits = fit_models(
        plant, names, seen, jobs=jobs, on_stage=on_stage, on_step=on_step, **fit_settings
    )
    candidates = tuple(_candidate(plant, name, fits, unseen, horizon) for name in names)
    return Selection(*choose(candidates, tolerance, plant.unit), candidates, horizon, plant.unit)


def _folds(
    splits: Sequence[list[Split]], folds: int
) -> tuple[dict[str, Data], dict[str, list[Block]]]:
    """What each fold's fits see of every recording, and what they do not."""
    seen, unseen = {}, {}
    for fold in range(folds):
        label = f"fold {fold + 1} of {folds}: fit"
        # Staggered, so that no fold lacks the same stretch of every recording.
        chosen = [row[(fold + i) % folds] for i, row in enumerate(splits)]
        unseen[label] = [split.unseen for split in chosen]
        left = [split.seen for split in chosen]
        seen[label] = Data([b.recording for b in left], [b.motion for b in left])
    return seen, unseen


def _candidate(
    plant: Plant,
    name: str,
    fits: Mapping[str, Fits],
    unseen: Mapping[str, list[Block]],
    horizon: float,
) -> Candidate:
    """A model judged on the blocks that its fits have not seen."""
    errors: list[float] = []
    converged = True
    for label, blocks in unseen.items():
        found = fits[label].found.get(name)
        converged &= found is not None and found.converged
        errors += block_errors(found, blocks, horizon) if found else [math.inf] * len(blocks)
    parameters = model_by_name(name)(plant.joints).schedule.parameter_vector().numel()
    return Candidate(name, tuple(errors), parameters, converged)


def choose(
    candidates: Sequence[Candidate], tolerance: float = 0.02, unit: str = "rad"
) -> tuple[str, str]:
    """The model with the fewest parameters whose error cannot be told from the least.

    Args:
        candidates: with errors of the same blocks.
        tolerance: relative difference of errors that counts as none.
        unit: of the errors.

    Returns:
        Its name, and why, in a sentence.
    """

    def told(candidate: Candidate) -> str:
        return f"{1e3 * candidate.error:.3g} m{unit}"

    best = min(candidates, key=lambda c: c.error)
    if not math.isfinite(best.error):
        simplest = min(candidates, key=lambda c: c.parameters)
        return simplest.name, "every model diverged on a block left out; the simplest is taken."
    alike = [c for c in candidates if _alike(c, best, tolerance)]
    chosen = min(alike, key=lambda c: (c.parameters, c.error))
    if chosen is not best:
        return chosen.name, (
            f"its error on blocks left out, {told(chosen)}, cannot be told from the least, "
            f"{told(best)} of {best.name}, and it has fewer parameters "
            f"({chosen.parameters} against {best.parameters})."
        )
    others = sorted((c for c in candidates if c is not best), key=lambda c: c.error)
    if not others:
        return best.name, "it is the only model."
    return best.name, (
        f"its error on blocks left out, {told(best)}, is the least; {others[0].name} follows "
        f"with {told(others[0])}."
    )


def _alike(one: Candidate, best: Candidate, tolerance: float) -> bool:
    """Whether two errors differ by no more than their blocks make them."""
    if not math.isfinite(one.error):
        return False
    if one.error <= (1 + tolerance) * best.error:
        return True
    squares = np.square([one.errors, best.errors])
    logarithms = np.log(squares.clip(min=DEFAULTS.min_noise**2))
    return all(_within_error(a - b) for a, b in (squares, logarithms))


def _within_error(difference: NDArray[np.float64]) -> bool:
    """Whether a mean is no larger than its standard error."""
    n = len(difference)
    error = float(difference.std(ddof=1)) / math.sqrt(n) if n > 1 else 0.0
    return float(difference.mean()) <= error


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None

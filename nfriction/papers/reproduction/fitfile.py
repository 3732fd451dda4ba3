"""A fit as files, so that a later one can start from it in another process."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch

from nfriction.evaluation.results import model_info
from nfriction.fitting.result.fit_result import FitResult
from nfriction.fitting.result.identifiability import Interval
from nfriction.io.atomic import replacing
from nfriction.io.model_file import load, load_info, load_plant, save
from nfriction.recording import Recording
from nfriction.signals import Motion


def save_fit(found: FitResult, path: Path, recordings: Sequence[Recording]) -> None:
    """Write a fit as a model file and, beside it, an `.npz` of what a later fit asks for.

    The model file is written last: where it is, the fit is whole.

    Args:
        found: the fit.
        path: of the model file, `.json`.
        recordings: those fitted.
    """
    names, values, bounds = zip(*found.plant_terms, strict=True) if found.plant_terms else ((),) * 3
    with replacing(path.with_suffix(".npz")) as temporary, temporary.open("wb") as file:
        np.savez(
            file,
            residuals=found.residuals.numpy(),
            term_names=np.array(names, dtype=str),
            term_values=np.array(values, dtype=np.float64),
            term_bounds=np.array(bounds, dtype=np.float64),
            steps=np.array(found.steps),
            left_out=np.array(found.skipped_horizons, dtype=np.float64),
            interval_names=np.array([i.name for i in found.intervals], dtype=str),
            intervals=np.array([(i.value, i.low, i.high) for i in found.intervals]).reshape(-1, 3),
        )
    save(found.model, path, model_info(found, recordings))


def load_fit(path: Path, motions: Sequence[Motion]) -> FitResult:
    """Read what `save_fit` wrote.

    Args:
        path: of the model file.
        motions: smoothed motion of each recording fitted; they are not in the files.

    Raises:
        ModelFileError: if the model file is absent or damaged.
    """
    told = load_info(path).fit
    with np.load(path.with_suffix(".npz")) as kept:
        terms = zip(
            kept["term_names"].tolist(),
            kept["term_values"].tolist(),
            kept["term_bounds"].tolist(),
            strict=True,
        )
        told_of = zip(kept["interval_names"].tolist(), kept["intervals"].tolist(), strict=True)
        return FitResult(
            model=load(path),
            plant=load_plant(path),
            plant_terms=tuple(terms),
            status=told["status"],
            converged=told["converged"],
            residual=told["residual"],
            at_bounds=tuple(told["at_bounds"]),
            steps=int(kept["steps"]),
            motions=tuple(motions),
            residuals=torch.as_tensor(kept["residuals"]),
            intervals=tuple(Interval(name, *ends) for name, ends in told_of),
            unidentifiable=tuple(told["unidentifiable"]),
            warnings=tuple(told["warnings"]),
            skipped_horizons=tuple(kept["left_out"].tolist()),
        )

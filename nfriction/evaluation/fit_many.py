"""Fit several models to the same recordings, those at the same time that need not wait."""

import logging
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

from nfriction.evaluation import parallel
from nfriction.fitting.fit import fit
from nfriction.fitting.result.fit_result import FitResult
from nfriction.friction.models import ConstantModel
from nfriction.friction.registry import model_by_name
from nfriction.plant import Plant
from nfriction.recording import Recording
from nfriction.signals import Motion

logger = logging.getLogger(__name__)


class Data(NamedTuple):
    """Recordings, and their smoothed motions in joint coordinates."""

    recordings: Sequence[Recording]
    motions: Sequence[Motion]


class Fits(NamedTuple):
    """What came of fitting models to a part of the data.

    Attributes:
        found: fits by model, in the order asked for.
        failed: why a model has none, by its name.
    """

    found: dict[str, FitResult]
    failed: dict[str, str]


def fit_models(
    plant: Plant,
    models: Sequence[str],
    parts: Mapping[str, Data],
    *,
    jobs: int = 1,
    on_stage: Callable[[str], None] | None = None,
    on_step: Callable[[str], None] | None = None,
    **fit_settings: Any,
) -> dict[str, Fits]:
    """Fit every model to every part of the data.

    Fits of a round start from those of the rounds before and know nothing of each other, so the
    result is the same however many processes share the work. A model that cannot be fitted is no
    reason to lose the others.

    Args:
        plant: the mechanism as given.
        models: names of models, different ones.
        parts: data by what to call the work on them, such as "fit".
        jobs: at most so many processes, each on one thread; -1 for one to each core.
        on_stage: told what is being done.
        on_step: told the steps of searches that run in this process.
        fit_settings: see `nfriction.fit`.

    Returns:
        What came of it, by part.

    Raises:
        ValueError: if there is no such model, or a setting cannot cross to other processes.
        ImportError: if `jobs` needs joblib and it is not installed.
        ValueError, ArithmeticError, RuntimeError: the first model's error where all failed.
    """
    parallel.check_jobs(jobs)
    if jobs != 1 and fit_settings.get("callback") is not None:
        raise ValueError("`callback` cannot be called from other processes; with `jobs` above 1 "
                         "use `on_stage`.")  # fmt: skip
    names = list(dict.fromkeys(models))
    fits: dict[tuple[str, str], FitResult] = {}
    errors: dict[tuple[str, str], Exception] = {}
    settings = dict(fit_settings)
    if jobs == 1 and on_step is not None:
        settings |= {"callback": lambda stage, _: on_step(stage)}
    origin = starts(names)
    for ready in rounds(origin):
        labels = {f"{part} {name}": (part, name) for part in parts for name in ready}
        pieces = {
            label: (name, plant, parts[part], fits.get((part, origin[name] or "")), settings)
            for label, (part, name) in labels.items()
        }
        for label, (result, seconds) in parallel.done(_fit, pieces, jobs=jobs, on_stage=on_stage):
            part, name = labels[label]
            if isinstance(result, Exception):
                errors[part, name] = result
                logger.warning("%s failed: %s", label, result)
                continue
            # What came back from another process brought copies of the motions.
            fits[part, name] = replace(result, motions=tuple(parts[part].motions))
            logger.info("%s: %s (%.3g s)", label, result.status, seconds)
    if not fits:
        raise next(iter(errors.values()))
    return {
        part: Fits(
            {name: fits[part, name] for name in names if (part, name) in fits},
            {name: str(errors[part, name]) for name in names if (part, name) in errors},
        )
        for part in parts
    }


def starts(models: Sequence[str]) -> dict[str, str | None]:
    """The model from whose fit each begins, None for none.

    Constant laws begin with the plant's terms of the first of them, all others with the constant
    fit of their own law, or of the first where that is not asked for.

    Raises:
        ValueError: if there is no such model.
    """
    kinds = {name: model_by_name(name) for name in models}
    constant = {n: k.definition for n, k in kinds.items() if issubclass(k, ConstantModel)}
    first = next(iter(constant), None)
    origin: dict[str, str | None] = {}
    for name, kind in kinds.items():
        own = next((n for n, law in constant.items() if law == kind.definition), first)
        origin[name] = first if own == name else own
        if name == first:
            origin[name] = None
    return origin


def rounds(origin: Mapping[str, str | None]) -> Iterator[list[str]]:
    """Names in groups: each begins from what an earlier group fitted, or from nothing."""
    fitted: set[str | None] = {None}
    left = dict(origin)
    while left:
        ready = [name for name, start in left.items() if start in fitted]
        yield ready
        fitted |= set(ready)
        left = {name: start for name, start in left.items() if name not in fitted}


def _fit(
    name: str, plant: Plant, data: Data, start: FitResult | None, settings: dict[str, Any]
) -> tuple[FitResult | Exception, float]:
    """A fit, or why there is none; and how long it took [s]."""
    begun = time.perf_counter()
    model = model_by_name(name)(plant.joints)
    result: FitResult | Exception
    try:
        result = fit(model, plant, data.recordings, motions=data.motions, start=start, **settings)
    except (ValueError, ArithmeticError, RuntimeError) as error:
        result = error
    return result, time.perf_counter() - begun

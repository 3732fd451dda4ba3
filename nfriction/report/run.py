"""Read what a comparison left in its folder, trusting none of it."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from nfriction.evaluation.compare import Comparison
from nfriction.evaluation.cross_validation import Candidate, Selection
from nfriction.evaluation.score import RMSE, Score
from nfriction.friction.models import FrictionModel
from nfriction.friction.registry import model_names
from nfriction.io import strict_json
from nfriction.io.model_file import ModelFileError, load, load_info
from nfriction.io.model_info import ModelInfo
from nfriction.report.entries import UnfitError, mapped, mapping, number, seconds, text, texts
from nfriction.report.png import Figure, read_figures

# Far beyond any run of ours; what is larger is no results file.
LARGEST_RESULTS = 64 * 2**20


class RunError(ValueError):
    """A folder is not one that a comparison wrote, or it is damaged."""


@dataclass(frozen=True)
class FitRecord:
    """How a fit ended, as `Fit.to_dict` tells; what an older version left out is empty.

    Attributes:
        intervals: 95 % interval by parameter, infinite where the data tell nothing.
        plant: adjusted terms of the plant by name.
    """

    status: str
    converged: bool
    residual: float
    residual_unit: str
    at_bounds: tuple[str, ...]
    warnings: tuple[str, ...]
    lost: tuple[str, ...]
    plant: dict[str, float]
    intervals: dict[str, tuple[float, float]]


@dataclass(frozen=True)
class Run:
    """A comparison as its folder tells it.

    Attributes:
        folder: as it was given.
        comparison: the scores, without simulated positions and without fits.
        fits: how each fit ended, by model.
        coefficients: by model, then by what they hold for (`"always"` for a constant model),
            then by name: a value a joint.
        best: name of the best model, None where nothing was held out.
        judged_by: what it was judged by.
        alike: it and all that cannot be told from it, simplest first; of older versions none.
        command: what made the results.
        recordings: digest by name of those trained on (`"train"`) and `"held_out"`.
        models: models and what their files say; those that could be read.
        figures: in the order of their names.
        notes: what could not be read, a sentence each.
        selection: what the training recordings alone would choose, where that was asked.
    """

    folder: Path
    comparison: Comparison
    fits: dict[str, FitRecord]
    coefficients: dict[str, dict[str, dict[str, tuple[float, ...]]]]
    best: str | None
    judged_by: str
    command: str
    recordings: dict[str, dict[str, str]]
    models: dict[str, tuple[FrictionModel, ModelInfo]]
    figures: tuple[Figure, ...]
    notes: tuple[str, ...]
    selection: Selection | None = None
    alike: tuple[str, ...] = ()


def read_run(folder: str | Path) -> Run:
    """Read the folder of `nfriction compare` or `nfriction demo`.

    Raises:
        RunError: if the folder has no sound `results.json`; one line says what is wrong.
        OSError: if it cannot be read.
    """
    folder = Path(folder)
    path = folder / "results.json"
    if not path.is_file():
        raise RunError(
            f"{folder}: has no results.json; give a folder that `nfriction compare` or "
            "`nfriction demo` wrote."
        )
    if path.stat().st_size > LARGEST_RESULTS:
        raise RunError(f"{path}: is too large for results of a comparison.")
    try:
        content = strict_json.parse(path.read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:
        raise RunError(f"{path}: is no JSON, or cut short ({error}).") from error
    try:
        return _run(folder, mapping(content, "the file"))
    except UnfitError as error:
        raise RunError(f"{path}: not results of a comparison: {error}.") from error


def _run(folder: Path, content: Mapping[str, Any]) -> Run:
    joints = texts(content.get("joints"), "`joints`")
    unit = content.get("units")
    if unit not in ("rad", "m"):
        raise UnfitError('`units` must be "rad" or "m"')
    entries = mapped(content.get("models"), "`models`", mapping)
    if not joints or not entries:
        raise UnfitError("it has no joints or no models")
    scores = {
        kind: {
            name: _scores(entry.get(kind, {}), f"{name}, {kind}", len(joints))
            for name, entry in entries.items()
        }
        for kind in ("train", "held_out")
    }
    for kind, of in scores.items():
        # Tables pool the recordings of a model, so all must have been scored on the same.
        forms = {tuple((s.recording, *s.windows) for s in many) for many in of.values()}
        if len(forms) > 1:
            raise UnfitError(f"its models were scored on different recordings ({kind})")
    fits = {n: _fit(e["fit"], n) for n, e in entries.items() if "fit" in e}
    train, held_out = ({n: s for n, s in of.items() if s} for of in scores.values())
    if not train and not held_out:
        raise UnfitError("it has no scores")
    models, notes = _models(folder, fits, len(joints))
    figures, unread = read_figures(folder / "figures")
    best = mapping(content.get("best") or {}, "`best`")
    if best and text(best.get("model"), "`best`") not in entries:
        raise UnfitError("its best model is none of its models")
    return Run(
        folder=folder,
        comparison=Comparison(
            {},
            train,
            held_out,
            unit,
            joints,
            failed=mapped(content.get("failed", {}), "`failed`", text),
        ),
        fits=fits,
        coefficients={
            n: _coefficients(e["coefficients"], n, len(joints))
            for n, e in entries.items()
            if "coefficients" in e
        },
        best=best.get("model"),
        judged_by=text(best.get("by", ""), "`best`"),
        command=text(content.get("command", ""), "`command`"),
        recordings={
            kind: mapped(digests, "`recordings`", text)
            for kind, digests in mapping(content.get("recordings", {}), "`recordings`").items()
        },
        models=models,
        figures=figures,
        notes=(*notes, *unread),
        selection=_selection(content.get("selection"), unit),
        alike=texts(best.get("alike", []), "`best`"),
    )


def _scores(value: object, where: str, joints: int) -> list[Score]:
    nothing = np.zeros(0)
    found = []
    for recording, entry in mapped(value, where, mapping).items():
        at = f"{where}, {recording}"
        windows = mapped(entry.get("windows", {}), at, lambda v, w: _rmse(v, w, joints))
        for horizon in windows:
            seconds(horizon, at)
        floor = entry.get("floor")
        diverged_at = entry.get("diverged_at")
        found.append(
            Score(
                recording, _rmse(entry.get("free_run"), at, joints), windows,
                None if floor is None else _rmse(floor, at, joints), nothing, nothing,
                math.inf if diverged_at is None else number(diverged_at, at),
            )
        )  # fmt: skip
    return found


def _selection(value: object, unit: str) -> Selection | None:
    if value is None:
        return None
    where = "`selection`"
    entry = mapping(value, where)
    candidates = mapped(entry.get("candidates"), where, _candidate)
    chosen = text(entry.get("chosen"), where)
    if chosen not in candidates:
        raise UnfitError(f"{where} chose none of its candidates")
    return Selection(
        chosen, text(entry.get("reason", ""), where),
        tuple(replace(c, name=name) for name, c in candidates.items()),
        number(entry.get("horizon"), where), unit,
    )  # fmt: skip


def _candidate(value: object, where: str) -> Candidate:
    entry = mapping(value, where)
    blocks = entry.get("blocks")
    if not isinstance(blocks, list) or not blocks:
        raise UnfitError(f"{where} needs the error of each block")
    errors = tuple(math.inf if e is None else number(e, where) for e in blocks)
    parameters = int(number(entry.get("parameters"), where))
    return Candidate("", errors, parameters, entry.get("converged") is True)


def _rmse(value: object, where: str, joints: int) -> RMSE:
    """Errors of a simulation; one that diverged has null for a number."""
    entry = mapping(value, where)
    of_joints = entry.get("joints")
    if not isinstance(of_joints, list) or len(of_joints) != joints:
        raise UnfitError(f"{where} needs an error for each of {joints} joints")
    errors = [math.inf if e is None else number(e, where) for e in (*of_joints, entry.get("all"))]
    if min(errors) < 0:
        raise UnfitError(f"{where} has a negative error")
    return RMSE(tuple(errors[:-1]), errors[-1])


def _fit(value: object, name: str) -> FitRecord:
    entry, where = mapping(value, f"fit of {name}"), f"fit of {name}"
    return FitRecord(
        status=text(entry.get("status", "unknown"), where),
        converged=entry.get("converged") is True,
        residual=number(entry.get("residual", math.nan), where),
        residual_unit=text(entry.get("residual_unit", ""), where),
        at_bounds=texts(entry.get("at_bounds", []), where),
        warnings=texts(entry.get("warnings", []), where),
        lost=texts(entry.get("unidentifiable", entry.get("lost", [])), where),
        plant=mapped(entry.get("plant", {}), where, number),
        intervals=mapped(entry.get("intervals", {}), where, _interval),
    )


def _interval(value: object, where: str) -> tuple[float, float]:
    if not isinstance(value, list) or len(value) != 2:
        raise UnfitError(f"an interval of {where} needs two ends")
    low, high = value
    return (
        -math.inf if low is None else number(low, where),
        math.inf if high is None else number(high, where),
    )


def _coefficients(value: object, name: str, joints: int) -> dict[str, dict[str, tuple[float, ...]]]:
    where = f"coefficients of {name}"
    entry = mapping(value, where)
    sets = entry if all(isinstance(v, dict) for v in entry.values()) else {"always": entry}

    def values(given: object, at: str) -> tuple[float, ...]:
        if not isinstance(given, list) or len(given) != joints:
            raise UnfitError(f"{at} need a value for each of {joints} joints")
        return tuple(number(x, at) for x in given)

    return {label: mapped(of, where, values) for label, of in sets.items()}


def _models(
    folder: Path, fits: Mapping[str, FitRecord], joints: int
) -> tuple[dict[str, tuple[FrictionModel, ModelInfo]], list[str]]:
    """Models whose files can be read; of names that are ours, so that no path is made of others."""
    found: dict[str, tuple[FrictionModel, ModelInfo]] = {}
    notes = []
    for name in fits:
        if name not in model_names():
            continue
        path = folder / "models" / f"{name}.json"
        try:
            model, info = load(path), load_info(path)
        except ModelFileError as error:
            notes.append(f"{name}: its model file could not be read ({error})")
            continue
        if type(model).__name__ != name or model.joints != joints:
            notes.append(f"{name}: {path} holds another model")
            continue
        found[name] = (model, info)
    return found, notes

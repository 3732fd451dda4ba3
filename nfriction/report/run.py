"""Read a comparison's folder without trusting any of it."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from nfriction.evaluation.compare import SCHEMA, Comparison, Part
from nfriction.evaluation.cross_validation import Candidate, Selection
from nfriction.evaluation.score import RMSE, Score
from nfriction.friction.model import FrictionModel
from nfriction.friction.models import MODELS
from nfriction.io import strict_json
from nfriction.io.model_content import ModelFileError
from nfriction.io.model_file import load, load_info
from nfriction.io.model_info import ModelInfo
from nfriction.report.figures import Figure, read_figures

# Far above any run of ours; a larger file is no results file.
LARGEST_RESULTS = 64 * 2**20
# Squares of smaller numbers are finite.
LARGEST_NUMBER = 10**100

T = TypeVar("T")


class RunError(ValueError):
    """The folder is not one that a comparison wrote, or it is damaged."""


class _EntryError(ValueError):
    """An entry of the results file has another form."""


@dataclass(frozen=True)
class FitRecord:
    """How a fit ended, from `FitResult.to_dict`; entries that an older version lacks are empty.

    Attributes:
        intervals: 95 % interval by parameter, infinite where unidentifiable.
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
    """A comparison as read from its folder.

    Attributes:
        folder: as it was given.
        comparison: the scores, without simulated positions and without fits.
        fits: how each fit ended, by model.
        coefficients: by model, then by where they apply (`"always"` for a constant model),
            then by name: a value a joint.
        best: name of the best model, None where there was no test recording.
        judged_by: criterion of the verdict.
        indistinguishable: the best and all models tied with it, simplest first; of older versions
            none.
        command: reproduces the results.
        recordings: digest by name of the `"train"` and `"test"` recordings.
        models: models and the information of their files; those that could be read.
        figures: in the order of their names.
        notes: a sentence on everything that could not be read.
        selection: the choice on the training recordings alone, where there is one.
    """

    folder: Path
    comparison: Comparison
    fits: dict[str, FitRecord]
    coefficients: dict[str, dict[str, dict[str, tuple[float, ...]]]]
    best: str | None
    judged_by: str
    command: str
    recordings: dict[Part, dict[str, str]]
    models: dict[str, tuple[FrictionModel, ModelInfo]]
    figures: tuple[Figure, ...]
    notes: tuple[str, ...]
    selection: Selection | None = None
    indistinguishable: tuple[str, ...] = ()


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
        return _run(folder, _mapping(content, "the file"))
    except _EntryError as error:
        raise RunError(f"{path}: not results of a comparison: {error}.") from error


def _run(folder: Path, content: Mapping[str, Any]) -> Run:
    schema = _number(content.get("schema", 1), "`schema`")
    if schema > SCHEMA:
        raise _EntryError(f"its schema {schema:g} is newer than {SCHEMA}; update nfriction")
    old = schema < 2
    keys: dict[Part, str] = {"train": "train", "test": "held_out" if old else "test"}
    joints = _texts(content.get("joints"), "`joints`")
    unit = content.get("units")
    if unit not in ("rad", "m"):
        raise _EntryError('`units` must be "rad" or "m"')
    entries = _each(content.get("models"), "`models`", _mapping)
    if not joints or not entries:
        raise _EntryError("it has no joints or no models")
    scores: dict[Part, dict[str, list[Score]]] = {}
    for part, key in keys.items():
        of = {
            name: _scores(entry.get(key, {}), f"{name}, {key}", len(joints))
            for name, entry in entries.items()
        }
        # Tables pool the recordings of a model, so all must have been scored on the same.
        if len({tuple((s.recording, *s.windows) for s in many) for many in of.values()}) > 1:
            raise _EntryError(f"its models were scored on different recordings ({key})")
        scores[part] = {name: many for name, many in of.items() if many}
    if not any(scores.values()):
        raise _EntryError("it has no scores")
    fits = {n: _fit(e["fit"], n) for n, e in entries.items() if "fit" in e}
    models, notes = _models(folder, fits, len(joints))
    figures, unread = read_figures(folder / "figures")
    best = _mapping(content.get("best") or {}, "`best`")
    if best and _text(best.get("model"), "`best`") not in entries:
        raise _EntryError("its best model is none of its models")
    recordings = _mapping(content.get("recordings", {}), "`recordings`")
    failed = _each(content.get("failed", {}), "`failed`", _text)
    return Run(
        folder=folder,
        comparison=Comparison(
            {}, scores["train"], scores["test"], unit=unit, joint_names=joints, failed=failed
        ),
        fits=fits,
        coefficients={
            n: _coefficients(e["coefficients"], n, len(joints))
            for n, e in entries.items()
            if "coefficients" in e
        },
        best=best.get("model"),
        judged_by=_text(best.get("by", ""), "`best`"),
        command=_text(content.get("command", ""), "`command`"),
        recordings={
            part: _each(recordings.get(key, {}), "`recordings`", _text)
            for part, key in keys.items()
        },
        models=models,
        figures=figures,
        notes=(*notes, *unread),
        selection=_selection(content.get("selection"), unit),
        indistinguishable=_texts(best.get("alike" if old else "indistinguishable", []), "`best`"),
    )


def _scores(value: object, where: str, joints: int) -> list[Score]:
    def rmse(value: object, at: str) -> RMSE:
        """Errors of a simulation; one that diverged has null for a number."""
        entry = _mapping(value, at)
        of_joints = entry.get("joints")
        if not isinstance(of_joints, list) or len(of_joints) != joints:
            raise _EntryError(f"{at} needs an error for each of {joints} joints")
        errors = [_error(e, at) for e in (*of_joints, entry.get("all"))]
        if min(errors) < 0:
            raise _EntryError(f"{at} has a negative error")
        return RMSE(tuple(errors[:-1]), errors[-1])

    found = []
    for recording, entry in _each(value, where, _mapping).items():
        at = f"{where}, {recording}"
        windows = _each(entry.get("windows", {}), at, rmse)
        for horizon in windows:
            try:
                float(horizon)
            except ValueError:
                raise _EntryError(f"{at} has windows of {horizon!r} seconds") from None
        floor = entry.get("floor")
        found.append(
            Score(
                recording, rmse(entry.get("free_run"), at), windows,
                None if floor is None else rmse(floor, at),
                time=np.zeros(0), simulated=np.zeros(0),
                diverged_at=_error(entry.get("diverged_at"), at),
            )
        )  # fmt: skip
    return found


def _selection(value: object, unit: str) -> Selection | None:
    if value is None:
        return None
    where = "`selection`"
    entry = _mapping(value, where)
    candidates = _each(entry.get("candidates"), where, _candidate)
    chosen = _text(entry.get("chosen"), where)
    if chosen not in candidates:
        raise _EntryError(f"{where} chose none of its candidates")
    return Selection(
        chosen, _text(entry.get("reason", ""), where),
        tuple(replace(c, name=name) for name, c in candidates.items()),
        _number(entry.get("horizon"), where), unit,
    )  # fmt: skip


def _candidate(value: object, where: str) -> Candidate:
    entry = _mapping(value, where)
    blocks = entry.get("blocks")
    if not isinstance(blocks, list) or not blocks:
        raise _EntryError(f"{where} needs the error of each block")
    errors = tuple(_error(e, where) for e in blocks)
    parameters = int(_number(entry.get("parameters"), where))
    return Candidate("", errors, parameters, entry.get("converged") is True)


def _fit(value: object, name: str) -> FitRecord:
    where = f"fit of {name}"
    entry = _mapping(value, where)
    at_bounds, warnings, lost = (
        _texts(entry.get(key, []), where) for key in ("at_bounds", "warnings", "lost")
    )
    return FitRecord(
        status=_text(entry.get("status", "unknown"), where),
        converged=entry.get("converged") is True,
        residual=_number(entry.get("residual", math.nan), where),
        residual_unit=_text(entry.get("residual_unit", ""), where),
        at_bounds=at_bounds, warnings=warnings, lost=lost,
        plant=_each(entry.get("plant", {}), where, _number),
        intervals=_each(entry.get("intervals", {}), where, _interval),
    )  # fmt: skip


def _interval(value: object, where: str) -> tuple[float, float]:
    if not isinstance(value, list) or len(value) != 2:
        raise _EntryError(f"an interval of {where} needs two ends")
    low, high = value
    return -math.inf if low is None else _number(low, where), _error(high, where)


def _coefficients(value: object, name: str, joints: int) -> dict[str, dict[str, tuple[float, ...]]]:
    def values(given: object, at: str) -> tuple[float, ...]:
        if not isinstance(given, list) or len(given) != joints:
            raise _EntryError(f"{at} need a value for each of {joints} joints")
        return tuple(_number(x, at) for x in given)

    where = f"coefficients of {name}"
    entry = _mapping(value, where)
    sets = entry if all(isinstance(v, dict) for v in entry.values()) else {"always": entry}
    return {label: _each(of, where, values) for label, of in sets.items()}


def _models(
    folder: Path, fits: Mapping[str, FitRecord], joints: int
) -> tuple[dict[str, tuple[FrictionModel, ModelInfo]], list[str]]:
    """Models whose files can be read; of our own names, so that no path is made of others."""
    found: dict[str, tuple[FrictionModel, ModelInfo]] = {}
    notes = []
    for name in (name for name in fits if name in MODELS):
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


def _mapping(value: object, where: str) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise _EntryError(f"{where} must be an object")
    return value


def _each(value: object, where: str, read: Callable[[Any, str], T]) -> dict[str, T]:
    return {key: read(entry, f"{where}, {key}") for key, entry in _mapping(value, where).items()}


def _text(value: object, where: str) -> str:
    if not isinstance(value, str):
        raise _EntryError(f"{where} must be text")
    return value


def _texts(value: object, where: str) -> tuple[str, ...]:
    if not isinstance(value, list):
        raise _EntryError(f"{where} must be a list of texts")
    return tuple(_text(v, where) for v in value)


def _number(value: object, where: str) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise _EntryError(f"{where} must be a number")
    # An int may be too large for a comparison with floats.
    if abs(value) > LARGEST_NUMBER:
        raise _EntryError(f"{where} is too large a number")
    return float(value)


def _error(value: object, where: str) -> float:
    """A number that JSON writes as null where it is infinite."""
    return math.inf if value is None else _number(value, where)

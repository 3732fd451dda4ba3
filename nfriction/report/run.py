"""Read a comparison's folder without trusting any of it."""

import math
import re
import types
import typing
from collections.abc import Mapping
from dataclasses import MISSING, dataclass, field, fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np

from nfriction.evaluation.compare import PART_NAMES, SCHEMA, Comparison, Part
from nfriction.evaluation.cross_validation import Candidate, Selection
from nfriction.evaluation.results import COMPLETE, exclusive
from nfriction.evaluation.score import Score
from nfriction.friction import model_names
from nfriction.friction.models import FrictionModel
from nfriction.io.files import parse_json
from nfriction.io.model_file import ModelFileError, ModelInfo, load, load_info

# Far above any run of ours; larger files are none of it.
LARGEST_RESULTS, LARGEST_FIGURE, MOST_FIGURES = 64 * 2**20, 16 * 2**20, 100
_PNG, _GIF = b"\x89PNG\r\n\x1a\n", b"GIF8"
# Text that `plots.save_all` puts before the picture.
_RUN = re.compile(rb"tEXtnfriction run\0([0-9a-f]{16})")
# Squares of smaller numbers are finite.
LARGEST_NUMBER = 10**100

Coefficients = dict[str, dict[str, tuple[float, ...]]]


class RunError(ValueError):
    """The folder is not one that a comparison wrote, or it is damaged."""


class _EntryError(ValueError):
    """An entry of the results file has another form."""


@dataclass(frozen=True)
class FitRecord:
    """End of a fit, from `FitResult.to_dict`.

    Attributes:
        usability: "good", "doubtful" or "do not use", and why.
        intervals: 95 % interval by parameter, infinity for an open end.
        plant: adjusted terms of the plant by name.
        rule_seconds: how long the recordings fired each rule of a network [s], by joint.
    """

    status: str = "unknown"
    converged: bool = False
    usability: tuple[str, str] = ("doubtful", "")
    residual: float = math.nan
    residual_unit: str = ""
    at_bounds: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()
    unidentifiable: tuple[str, ...] = ()
    plant: dict[str, float] = field(default_factory=dict)
    intervals: dict[str, tuple[float, float]] = field(default_factory=dict)
    rule_seconds: tuple[tuple[float, ...], ...] = ()


@dataclass(frozen=True)
class Figure:
    """A PNG or GIF file with its size in pixels, and the id of its run if it bears one."""

    name: str
    data: bytes
    width: int
    height: int
    run: str = ""


@dataclass(frozen=True)
class Run:
    """A comparison as read from its folder.

    Attributes:
        id: of the run, in every file that it wrote.
        comparison: the scores, without simulated positions and without fits.
        fits: status of each fit, by model.
        coefficients: by model, then by where they apply (`"always"` for a constant model),
            then by name: a value a joint.
        best: name of the best model, None where there was no test recording.
        indistinguishable: the best and all models tied with it, simplest first.
        unfit: models not to be used, and why.
        recordings: digest by name of the `"train"` and `"test"` recordings.
        models: those whose files could be read, with the information in them.
        notes: a sentence on everything that could not be read.
        selection: the choice on the training recordings alone, where there is one.
    """

    id: str
    folder: Path
    comparison: Comparison
    fits: dict[str, FitRecord]
    coefficients: dict[str, Coefficients]
    best: str | None
    judged_by: str
    indistinguishable: tuple[str, ...]
    unfit: dict[str, str]
    command: str
    recordings: dict[Part, dict[str, str]]
    models: dict[str, tuple[FrictionModel, ModelInfo]]
    figures: tuple[Figure, ...]
    notes: tuple[str, ...]
    selection: Selection | None


def read_run(folder: str | Path) -> Run:
    """Read the folder of `nfriction compare` or `nfriction demo`.

    Where a process was killed while it put its files in place, they are put there first.

    Raises:
        RunError: if the folder has no sound `results.json`, or files of two runs; one line says
            what is wrong.
        OSError: if it cannot be read, or another process is writing it.
    """
    folder = Path(folder)
    if (folder / COMPLETE).is_dir():
        with exclusive(folder):
            pass
    path = folder / "results.json"
    if not path.is_file():
        raise RunError(
            f"{folder}: has no results.json; give a folder that `nfriction compare` or "
            "`nfriction demo` wrote."
        )
    # Before reading, so that a huge file cannot exhaust the memory.
    if path.stat().st_size > LARGEST_RESULTS:
        raise RunError(f"{path}: is too large for results of a comparison.")
    try:
        content = parse_json(path.read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:
        raise RunError(f"{path}: is no JSON, or cut short ({error}).") from error
    try:
        return _run(folder, _read(dict[str, Any], content, "the file"))
    except _EntryError as error:
        raise RunError(f"{path}: not results of a comparison: {error}.") from error


def _run(folder: Path, content: dict[str, Any]) -> Run:
    if content.get("schema") != SCHEMA:
        found = str(content.get("schema"))[:40]
        raise _EntryError(f"its schema is {found}, not {SCHEMA}; run the comparison again")
    joints = _read(tuple[str, ...], content.get("joints"), "`joints`")
    unit = content.get("units")
    if unit not in ("rad", "m"):
        raise _EntryError('`units` must be "rad" or "m"')
    entries = _read(dict[str, dict[str, Any]], content.get("models"), "`models`")
    if not joints or not entries:
        raise _EntryError("it has no joints or no models")
    scores = {part: _scores(entries, part, len(joints)) for part in PART_NAMES}
    if not any(scores.values()):
        raise _EntryError("it has no scores")
    best = _read(dict[str, Any], content.get("best") or {}, "`best`")
    # Names select files and table rows further on.
    if best and _read(str, best.get("model"), "`best`") not in entries:
        raise _EntryError("its best model is none of its models")
    recordings = _read(dict[str, dict[str, str]], content.get("recordings", {}), "`recordings`")
    fits: dict[str, FitRecord] = {
        n: _read(FitRecord, e["fit"], f"fit of {n}") for n, e in entries.items() if "fit" in e
    }
    models, notes = _models(folder, fits, len(joints))
    figures, unread = _figures(folder / "figures")
    failed = _read(dict[str, str], content.get("failed", {}), "`failed`")
    run = Run(
        id=_read(str, content.get("run", ""), "`run`"),
        folder=folder,
        comparison=Comparison({}, scores["train"], scores["test"], unit, joints, failed=failed),
        fits=fits,
        coefficients={
            name: _coefficients(entry["coefficients"], f"coefficients of {name}", len(joints))
            for name, entry in entries.items()
            if "coefficients" in entry
        },
        best=best.get("model"),
        judged_by=_read(str, best.get("by", ""), "`best`"),
        indistinguishable=_read(tuple[str, ...], best.get("indistinguishable", []), "`best`"),
        unfit=_read(dict[str, str], content.get("unfit", {}), "`unfit`"),
        command=_read(str, content.get("command", ""), "`command`"),
        recordings={part: recordings.get(part, {}) for part in PART_NAMES},
        models=models,
        figures=figures,
        notes=(*notes, *unread),
        selection=_selection(content.get("selection"), unit),
    )
    _require_one_run(run)
    return run


def _scores(
    entries: Mapping[str, Mapping[str, Any]], part: Part, joints: int
) -> dict[str, list[Score]]:
    found: dict[str, list[Score]] = {}
    nothing = np.zeros(0)
    for name, entry in entries.items():
        where = f"{name}, {part}"
        found[name] = [
            _read_record(
                Score, {"windows": {}, "diverged_at": None, "limit": None} | of,
                f"{where}, {recording}", recording=recording, time=nothing, simulated=nothing,
            )
            for recording, of in _read(dict[str, dict], entry.get(part, {}), where).items()
        ]  # fmt: skip
        for score in found[name]:
            for rmse in (e for part in (score, score.limit) if part
                         for e in (part.free_run, *part.windows.values())):  # fmt: skip
                if len(rmse.joints) != joints:
                    raise _EntryError(f"{where} needs an error for each of {joints} joints")
                if min(*rmse.joints, rmse.all) < 0:
                    raise _EntryError(f"{where} has a negative error")
            for horizon in score.windows:
                try:
                    float(horizon)
                except ValueError:
                    raise _EntryError(f"{where} has windows of {horizon!r} seconds") from None
    # Tables pool the recordings of a model, so all must have been scored on the same.
    if len({tuple((s.recording, *s.windows) for s in many) for many in found.values()}) > 1:
        raise _EntryError(f"its models were scored on different recordings ({part})")
    return {name: many for name, many in found.items() if many}


def _selection(value: Any, unit: str) -> Selection | None:
    if value is None:
        return None
    where = "`selection`"
    entry = _read(dict[str, Any], value, where)
    candidates = tuple(
        _read_record(Candidate, {"converged": False} | of, where, name=name,
                     errors=_read(tuple[float, ...], of.get("blocks"), where))
        for name, of in _read(dict[str, dict], entry.get("candidates"), where).items()
    )  # fmt: skip
    if not all(candidate.errors for candidate in candidates):
        raise _EntryError(f"{where} needs the error of each block")
    if entry.get("chosen") not in [candidate.name for candidate in candidates]:
        raise _EntryError(f"{where} chose none of its candidates")
    if entry.get("horizon") is None:
        raise _EntryError(f"{where} has no `horizon`")
    known = {"candidates": candidates, "unit": unit}
    selection: Selection = _read_record(Selection, {"reason": ""} | entry, where, **known)
    return selection


def _coefficients(value: Any, where: str, joints: int) -> Coefficients:
    entry = _read(dict[str, Any], value, where)
    sets = entry if all(isinstance(v, dict) for v in entry.values()) else {"always": entry}
    found: Coefficients = _read(Coefficients, sets, where)
    if any(len(values) != joints for of in found.values() for values in of.values()):
        raise _EntryError(f"{where} need a value for each of {joints} joints")
    return found


def _models(
    folder: Path, fits: Mapping[str, FitRecord], joints: int
) -> tuple[dict[str, tuple[FrictionModel, ModelInfo]], list[str]]:
    """Models whose files can be read; of our own names, so that no path is made of others."""
    found: dict[str, tuple[FrictionModel, ModelInfo]] = {}
    notes = []
    for name in (name for name in fits if name in model_names()):
        path = folder / "models" / f"{name}.json"
        try:
            model, info = load(path), load_info(path)
        except ModelFileError as error:
            notes.append(f"{name}: its model file could not be read ({error})")
            continue
        # A copied file would show the coefficients of one model under the name of another.
        if type(model).__name__ != name or model.joints != joints:
            notes.append(f"{name}: {path} holds another model")
            continue
        found[name] = (model, info)
    return found, notes


def _figures(folder: Path) -> tuple[tuple[Figure, ...], list[str]]:
    """Those in the order of their names, and a sentence on each that could not be read."""
    found: list[Figure] = []
    notes = []
    for path in sorted([*folder.glob("*.png"), *folder.glob("*.gif")])[:MOST_FIGURES]:
        if not path.is_file() or path.stat().st_size > LARGEST_FIGURE:
            notes.append(f"figure {path.name}: no file, or too large")
            continue
        data = path.read_bytes()
        if not data.startswith((_PNG, _GIF)) or len(data) < 24:
            notes.append(f"figure {path.name}: not a PNG or GIF file")
            continue
        if data.startswith(_PNG):
            width, height = (int.from_bytes(data[k : k + 4], "big") for k in (16, 20))
        else:
            width, height = (int.from_bytes(data[k : k + 2], "little") for k in (6, 8))
        run = _RUN.search(data[:4096])
        found.append(Figure(path.stem, data, width, height, run[1].decode() if run else ""))
    return tuple(found), notes


def _require_one_run(run: Run) -> None:
    """Refuse models and figures of another run than the results'."""
    trained_on = run.recordings["train"]
    foreign = [
        f"models/{name}.json"
        for name, (_, info) in run.models.items()
        if info.fit.get("run", "") != run.id
        # Runs of older versions have no id, but the digests of their recordings.
        or (info.training_data and info.training_data != trained_on)
    ]
    foreign += [f"figures/{f.name}.png" for f in run.figures if f.run not in ("", run.id)]
    if foreign:
        raise RunError(
            f"{run.folder}: has files of two runs: {', '.join(foreign)} belong to another run than "
            f"results.json; run the comparison again, or give a folder that a single run wrote."
        )


def _read(kind: Any, value: Any, where: str) -> Any:
    """A JSON value as a type, such as `dict[str, float]`; null is an infinite number."""
    origin, of = typing.get_origin(kind), typing.get_args(kind)
    if kind is Any:
        return value
    if origin is types.UnionType:
        return None if value is None else _read(of[0], value, where)
    if origin is tuple:
        if not isinstance(value, list):
            raise _EntryError(f"{where} must be a list")
        if of[-1] is not ... and len(value) != len(of):
            raise _EntryError(f"{where} needs {len(of)} values")
        return tuple(_read(of[0], entry, where) for entry in value)
    if kind is dict or origin is dict or is_dataclass(kind):
        if not isinstance(value, dict):
            raise _EntryError(f"{where} must be an object")
        if is_dataclass(kind):
            return _read_record(kind, value, where)
        return {k: _read(of[1], v, f"{where}, {k}") for k, v in value.items()} if of else value
    if kind in (float, int):
        if value is None and kind is float:
            return math.inf
        if isinstance(value, bool) or not isinstance(value, (int, float)):
            raise _EntryError(f"{where} must be a number")
        # An int may be too large for a comparison with floats.
        if abs(value) > LARGEST_NUMBER:
            raise _EntryError(f"{where} is too large a number")
        return kind(value)
    if not isinstance(value, kind):
        raise _EntryError(f"{where} must be {'text' if kind is str else 'true or false'}")
    return value


def _read_record(kind: Any, entry: Mapping[str, Any], where: str, **known: Any) -> Any:
    """A dataclass from the entries of its fields' names, and from fields that are known."""
    types_of = typing.get_type_hints(kind)
    for of in fields(kind):
        if of.name in known:
            continue
        if of.name in entry:
            known[of.name] = _read(types_of[of.name], entry[of.name], f"{where}, {of.name}")
        elif of.default is MISSING and of.default_factory is MISSING:
            raise _EntryError(f"{where} has no `{of.name}`")
    return kind(**known)

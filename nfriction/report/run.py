"""Read a comparison's folder."""

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np

from nfriction.evaluation.compare import PART_NAMES, SCHEMA, Comparison, Part
from nfriction.evaluation.cross_validation import Candidate, Selection
from nfriction.evaluation.results import COMPLETE, exclusive
from nfriction.evaluation.score import RMSE, Errors, Score
from nfriction.friction import model_names
from nfriction.friction.models import FrictionModel
from nfriction.io.files import is_intact, parse_json
from nfriction.io.model_file import ModelFileError, ModelInfo, load, load_info

# Far above the sizes in any run; larger files do not belong to one.
LARGEST_RESULTS, LARGEST_FIGURE, MOST_FIGURES = 64 * 2**20, 16 * 2**20, 100
_PNG, _GIF = b"\x89PNG\r\n\x1a\n", b"GIF8"
# Text that `plots.save_all` puts before the image data.
_RUN = re.compile(rb"tEXtnfriction run\0([0-9a-f]{16})")

Coefficients = dict[str, dict[str, tuple[float, ...]]]


class RunError(ValueError):
    """The folder is not one that a comparison wrote, or it is damaged."""


@dataclass(frozen=True)
class FitRecord:
    """Outcome of a fit, from `FitResult.to_dict`."""

    status: str = "unknown"
    converged: bool = False
    usability: tuple[str, str] = ("doubtful", "")
    residual: float = math.nan
    residual_unit: str = ""
    at_bounds: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()
    unidentifiable: tuple[str, ...] = ()
    plant: dict[str, float] = field(default_factory=dict)  # adjusted terms by name
    names_with_si: dict[str, str] = field(default_factory=dict)
    intervals: dict[str, tuple[float, float]] = field(default_factory=dict)
    rule_seconds: tuple[tuple[float, ...], ...] = ()

    @classmethod
    def of(cls, entry: dict[str, Any]) -> "FitRecord":
        """The record of a fit's entry."""
        known = {f.name: entry[f.name] for f in fields(cls) if f.name in entry}
        intervals = entry["intervals"].items()
        ends = {name: (_number(a, -math.inf), _number(b)) for name, (a, b) in intervals}
        return cls(**known | {"intervals": ends, "residual": _number(entry["residual"])})


@dataclass(frozen=True)
class Figure:
    """A PNG or GIF file with its size in pixels, and the id of its run if it contains one."""

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
        coefficients: by model, then by range of validity (`"always"` for a constant model),
            then by name: one value per joint.
        best: name of the best model, None if there was no test recording.
        indistinguishable: the best and all models tied with it, simplest first.
        unfit: models not to be used, with the reason.
        recordings: digest by name of the `"train"` and `"test"` recordings.
        models: those whose files could be read, with the information in them.
        notes: a sentence on each file that could not be read.
        selection: the choice on the training recordings alone, if there is one.
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

    If a process was killed while it put its files in place, that is completed first.

    Raises:
        RunError: if the folder has no valid `results.json`, or files of two runs; one line states
            the reason.
        OSError: if it cannot be read, or another process is writing it.
    """
    folder = Path(folder)
    if (folder / COMPLETE).is_dir():
        with exclusive(folder):
            pass
    path = folder / "results.json"
    if not path.is_file():
        raise RunError(
            f"{folder} has no results.json; give a folder that `nfriction compare` or "
            "`nfriction demo` wrote."
        )
    # Before reading, so that a huge file cannot exhaust the memory.
    if path.stat().st_size > LARGEST_RESULTS:
        raise RunError(f"{path} is too large for results of a comparison.")
    try:
        content = parse_json(path.read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:
        raise RunError(f"{path} is not JSON, or cut short ({error}).") from error
    if not isinstance(content, dict) or content.get("schema") != SCHEMA:
        raise RunError(f"{path}: not results of schema {SCHEMA}; run the comparison again.")
    if not is_intact(content):
        raise RunError(
            f"{path}: the checksum is missing or does not match, so it was damaged or edited, or "
            "written by an older version; run the comparison again."
        )
    try:
        run = _run(folder, content)
    # From a file of another program with a matching checksum.
    except (LookupError, TypeError, ValueError, AttributeError) as error:
        raise RunError(f"{path}: not results of a comparison ({error!r:.200}).") from error
    foreign = [
        f"models/{name}.json"
        for name, (_, info) in run.models.items()
        if info.fit.get("run", "") != run.id
    ]
    foreign += [f"figures/{f.name}.png" for f in run.figures if f.run not in ("", run.id)]
    if foreign:
        raise RunError(
            f"{folder} has files of two runs: {', '.join(foreign)} belong to another run than "
            f"results.json; run the comparison again, or give a folder that a single run wrote."
        )
    return run


def _run(folder: Path, content: dict[str, Any]) -> Run:
    joints, unit, entries = tuple(content["joints"]), content["units"], content["models"]
    best = content["best"] or {}
    scores = {
        part: {
            name: [_score(recording, of) for recording, of in entry[part].items()]
            for name, entry in entries.items()
            if entry[part]
        }
        for part in PART_NAMES
    }
    fits = {name: FitRecord.of(entry["fit"]) for name, entry in entries.items() if "fit" in entry}
    models, notes = _models(folder, fits, len(joints))
    figures, unread = _figures(folder / "figures")
    selection = None
    if (of := content.get("selection")) is not None:
        candidates = tuple(
            Candidate(name, tuple(map(_number, c["blocks"])), c["parameters"], c["converged"])
            for name, c in of["candidates"].items()
        )
        selection = Selection(of["chosen"], of["reason"], candidates, of["horizon"], unit)
    comparison = Comparison(
        {}, scores["train"], scores["test"], unit, joints, failed=content.get("failed", {}),
        test_warnings=tuple(content.get("test_warnings", ())),
    )  # fmt: skip
    return Run(
        id=content.get("run", ""),
        folder=folder,
        comparison=comparison,
        fits=fits,
        coefficients={
            name: _coefficients(entry["coefficients"])
            for name, entry in entries.items()
            if "coefficients" in entry
        },
        best=best.get("model"),
        judged_by=best.get("by", ""),
        indistinguishable=tuple(best.get("indistinguishable", ())),
        unfit=content.get("unfit", {}),
        command=content.get("command", ""),
        recordings=content["recordings"],
        models=models,
        figures=figures,
        notes=(*notes, *unread),
        selection=selection,
    )


def _number(value: float | None, null: float = math.inf) -> float:
    """A number of JSON, where null is infinite."""
    return null if value is None else float(value)


def _errors(of: dict[str, Any]) -> Errors:
    def rmse(of: dict[str, Any]) -> RMSE:
        return RMSE(tuple(map(_number, of["joints"])), _number(of["all"]))

    windows = {horizon: rmse(window) for horizon, window in of["windows"].items()}
    return Errors(rmse(of["free_run"]), windows)


def _score(recording: str, of: dict[str, Any]) -> Score:
    errors, nothing = _errors(of), np.zeros(0)
    zero = None if of["zero"] is None else tuple(map(float, of["zero"]))
    return Score(
        errors.free_run, errors.windows, of["limit"] and _errors(of["limit"]), recording,
        nothing, nothing, _number(of["diverged_at"]), zero,
    )  # fmt: skip


def _coefficients(of: dict[str, Any]) -> Coefficients:
    sets = of if all(isinstance(v, dict) for v in of.values()) else {"always": of}
    return {
        label: {name: tuple(map(_number, values)) for name, values in named.items()}
        for label, named in sets.items()
    }


def _models(
    folder: Path, fits: Mapping[str, FitRecord], joints: int
) -> tuple[dict[str, tuple[FrictionModel, ModelInfo]], list[str]]:
    """Models whose files can be read; only known names, so that foreign names make no path."""
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
            notes.append(f"{name}: {path} contains another model")
            continue
        found[name] = (model, info)
    return found, notes


def _figures(folder: Path) -> tuple[tuple[Figure, ...], list[str]]:
    """Figures in the order of their names, and a sentence on each that could not be read."""
    found: list[Figure] = []
    notes = []
    for path in sorted([*folder.glob("*.png"), *folder.glob("*.gif")])[:MOST_FIGURES]:
        if not path.is_file() or path.stat().st_size > LARGEST_FIGURE:
            notes.append(f"figure {path.name}: not a file, or too large")
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

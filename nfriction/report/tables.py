"""Tables of a report as plain data: what stands in which cell, and by what it sorts."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from nfriction.evaluation.compare import NO_FRICTION
from nfriction.evaluation.cross_validation import Selection
from nfriction.io.model_info import ModelInfo, describe
from nfriction.report.rules import JointRules
from nfriction.report.run import Run

# A positive coefficient at zero is given for 1e-12 of its unit.
NOTHING = 1.001e-12
KINDS = {"held_out": "held-out recordings", "train": "recordings trained on"}


@dataclass(frozen=True)
class Cell:
    """What is shown, and the number by which a column sorts (None sorts by the text)."""

    text: str
    value: float | None = None
    best: bool = False


@dataclass(frozen=True)
class Table:
    """A caption, column headings, and rows whose first cell names the row."""

    caption: str
    columns: tuple[str, ...]
    rows: tuple[tuple[Cell, ...], ...]


def number(value: float, digits: int = 4) -> Cell:
    """A cell of a number; infinite says that nothing is known."""
    if abs(value) <= NOTHING:
        return Cell("0", value)
    if math.isnan(value):
        return Cell("n/a", math.inf)
    if math.isinf(value):
        return Cell("unknown", value)
    whole = 10.0**digits > abs(value) >= 10.0 ** (digits - 1) or 1e7 > abs(value) >= 1e4
    return Cell(f"{value:.0f}" if whole else f"{value:.{digits}g}", value)


def error(value: float) -> Cell:
    """A cell of an error, in thousandths of its unit; infinite where a simulation diverged."""
    return Cell("diverged", value) if math.isinf(value) else number(1e3 * value)


def error_table(run: Run, kind: str) -> Table:
    """Position errors by model over all recordings of a kind, best of each column marked."""
    comparison, held_out = run.comparison, kind == "held_out"
    free = comparison.table(held_out=held_out)
    if len(comparison.joint_names) == 1:
        free = free[["all"]]
    columns = {f"free run, {name}": free[name].tolist() for name in free}
    for horizon in comparison.horizons(held_out=held_out):
        table = comparison.table(horizon, held_out=held_out)
        columns[f"{horizon} s windows"] = table["all"].tolist()
    models = [str(name) for name in free.index]
    saved = [math.nan] * len(models)
    if models[0] == NO_FRICTION:
        saved = comparison.improvement(held_out=held_out)["all"].tolist()
    lowest = {name: min(values) for name, values in columns.items()}
    rows = []
    for k, model in enumerate(models):
        cells = [error(values[k]) for values in columns.values()]
        marked = [
            Cell(c.text, c.value, best=math.isfinite(values[k]) and values[k] == lowest[name])
            for c, (name, values) in zip(cells, columns.items(), strict=True)
        ]
        rows.append((Cell(model), *marked, number(saved[k])))
    return Table(
        f"Position RMSE [m{comparison.unit}] over {KINDS[kind]}",
        ("model", *columns, "saved [%]"),
        tuple(rows),
    )


def recording_table(run: Run) -> Table:
    """The free-run error of every model on every recording, beside what one encoder count does."""
    rows = []
    for kind in KINDS:
        for model, many in getattr(run.comparison, kind).items():
            for s in many:
                floor = math.nan if s.floor is None else s.floor.all
                at = s.diverged_at
                rows.append(
                    (
                        Cell(s.recording), Cell(model), Cell(kind.replace("_", " ")),
                        error(s.free_run.all), error(floor),
                        Cell("no", math.inf) if math.isinf(at) else Cell(f"at {at:.3g} s", at),
                    )
                )  # fmt: skip
    unit = run.comparison.unit
    return Table(
        "Every recording: free run over all joints",
        ("recording", "model", "part", f"RMSE [m{unit}]", f"one encoder count [m{unit}]",
         "diverged"),
        tuple(rows),
    )  # fmt: skip


def selection_table(selection: Selection) -> Table:
    """How each model fared on blocks of the training recordings left out of its fits."""
    least = min(c.error for c in selection.candidates)
    rows = []
    for c in selection.candidates:
        judged = error(c.error)
        marked = Cell(judged.text, judged.value, best=math.isfinite(least) and c.error == least)
        converged = Cell("yes" if c.converged else "no")
        rows.append((Cell(c.name), marked, number(float(c.parameters)), converged))
    return Table(
        f"Position RMSE [m{selection.unit}] of {selection.horizon:.3g} s simulations over blocks "
        "left out",
        ("model", "error", "parameters", "all fits converged"),
        tuple(rows),
    )


def data_table(run: Run) -> Table:
    """What was fitted on which file: recordings, their part and digest."""
    rows = [
        (Cell(name), Cell("held out" if kind == "held_out" else "trained on"), Cell(digest[:16]))
        for kind in ("train", "held_out")
        for name, digest in run.recordings.get(kind, {}).items()
    ]
    return Table(
        "Recordings", ("recording", "part", "SHA-256 of its samples, in part"), tuple(rows)
    )


def coefficient_units(run: Run, model: str) -> dict[str, str]:
    """Unit of each coefficient, where the model's file tells."""
    if model not in run.models:
        return {}
    described = describe(run.models[model][0], ModelInfo(unit=run.comparison.unit))
    return {c["name"]: c["unit"] for c in described["coefficients"]}


def coefficient_table(run: Run, model: str) -> Table:
    """Coefficients by joint, and by what they hold for where they follow the motion."""
    sets, units = run.coefficients[model], coefficient_units(run, model)
    names = list(next(iter(sets.values()), {}))
    follows = list(sets) != ["always"]
    rows = []
    for j, joint in enumerate(run.comparison.joint_names):
        for label, values in sets.items():
            given = [number(values[n][j]) if n in values else Cell("n/a") for n in names]
            rows.append(
                (Cell(joint), *([Cell(label.replace("_", " "))] if follows else []), *given)
            )
    heads = [f"{n} [{units[n]}]" if n in units else n for n in names]
    return Table(
        f"Coefficients of {model}", ("joint", *(["holds"] if follows else []), *heads), tuple(rows)
    )


def interval_table(run: Run, model: str) -> Table | None:
    """95 % intervals of coefficients and plant terms; None where the fit claims none."""
    fit = run.fits[model]
    if not fit.intervals:
        return None
    joints = run.comparison.joint_names
    fixed = run.coefficients.get(model, {}).get("always", {})
    known = {f"{c} of {j}": v for c, of in fixed.items() for j, v in zip(joints, of, strict=True)}
    known |= fit.plant
    rows = tuple(
        (Cell(parameter), number(known.get(parameter, math.nan)), number(low), number(high))
        for parameter, (low, high) in fit.intervals.items()
    )
    caption = f"95 % intervals of {model}"
    if fit.plant:
        caption += "; terms of the plant are ratios less 1, offsets in SI"
    return Table(caption, ("parameter", "value", "from", "to"), rows)


def range_table(info: ModelInfo, joints: Sequence[str], unit: str) -> Table | None:
    """Trained range of velocity and acceleration; None where the file has none of that form."""
    kinds = [
        (k, u) for k, u in (("qd", f"{unit}/s"), ("qdd", f"{unit}/s²")) if k in info.input_ranges
    ]
    bounds = {k: _pairs(info.input_ranges[k], len(joints)) for k, _ in kinds}
    known = [(k, u, pairs) for k, u in kinds if (pairs := bounds[k]) is not None]
    if not known:
        return None
    word = {"qd": "velocity", "qdd": "acceleration"}
    columns = tuple(f"{word[k]} {end} [{u}]" for k, u, _ in known for end in ("from", "to"))
    rows = tuple(
        (Cell(joint), *(number(x) for _, _, pairs in known for x in pairs[j]))
        for j, joint in enumerate(joints)
    )
    return Table("Motion that the models were trained on", ("joint", *columns), rows)


def rule_table(of: JointRules, model: str, units: dict[str, str]) -> Table:
    """Rules of one joint; a row reads as a sentence."""
    heads = [f"{name} = [{unit}]" for name, unit in units.items()]
    rows = tuple(
        (Cell(f"{rule.condition} THEN", k), *(number(v) for v in rule.values))
        for k, rule in enumerate(of.rules)
    )
    return Table(f"{model}, {of.joint}: {len(rows)} rules", ("rule", *heads), rows)


def term_table(of: JointRules, model: str, unit: str) -> Table:
    """What the words of the rules stand for."""
    inputs: Iterable = (
        ("velocity", of.velocity, f"{unit}/s"),
        ("acceleration", of.acceleration, f"{unit}/s²"),
    )
    rows = tuple(
        (Cell(f"{what}: {term.name}"), number(term.centre), number(term.width), Cell(u))
        for what, terms, u in inputs
        for term in terms
    )
    return Table(
        f"{model}, {of.joint}: what the words stand for",
        ("word", "middle", "standard deviation", "unit"),
        rows,
    )


def _pairs(value: object, joints: int) -> list[tuple[float, float]] | None:
    """Low and high of each joint, None if that is not what is there."""
    if not isinstance(value, list) or len(value) != joints:
        return None
    sound = all(
        isinstance(p, list) and len(p) == 2 and all(isinstance(x, (int, float)) for x in p)
        for p in value
    )
    return [(float(p[0]), float(p[1])) for p in value] if sound else None

"""Tables of comparisons and fits as rows, which the command line prints and the report draws."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import zip_longest

from nfriction.evaluation.compare import LIMIT, NO_FRICTION, PART_NAMES, Comparison, Part
from nfriction.evaluation.cross_validation import Selection
from nfriction.friction.models import FrictionModel
from nfriction.io.model_file import unit_for

Value = str | float
Sets = Mapping[str, Mapping[str, Sequence[float]]]
# A positive coefficient at its bound is 1e-12 of its unit.
ZERO = 1.001e-12
_WIDEST = 8  # coefficients side by side


def four_digits(value: Value) -> str:
    """A number to four digits, "n/a" for NaN; text stays."""
    if isinstance(value, str):
        return value
    if abs(value) <= ZERO:
        return "0"
    if math.isnan(value):
        return "n/a"
    if math.isinf(value):
        return "unknown"
    return f"{value:.0f}" if 1e3 <= abs(value) < 1e7 else f"{value:.4g}"


@dataclass(frozen=True)
class Table:
    """A caption, column headings, and rows whose first value names the row.

    Attributes:
        caption: without a full stop.
        columns: headings; a comma separates a group of columns from the column's own name.
        infinite: word for an infinite number.
        marked: indices of columns whose smallest number is marked.
        limit: a last row with the differences that are not meaningful; empty if unknown.
    """

    caption: str
    columns: tuple[str, ...]
    rows: tuple[tuple[Value, ...], ...]
    infinite: str = "unknown"
    marked: tuple[int, ...] = ()
    limit: tuple[Value, ...] = ()

    def text(self, value: Value) -> str:
        """A value as by `four_digits`, but the table's word for an infinite one."""
        infinite = isinstance(value, float) and math.isinf(value)
        return self.infinite if infinite else four_digits(value)

    def is_numeric(self, column: int) -> bool:
        """True where every value of a column is a number."""
        return column > 0 and not any(isinstance(row[column], str) for row in self.rows)

    def is_marked(self, row: Sequence[Value], column: int) -> bool:
        """True if the value is the smallest of a marked column, and finite."""
        if column not in self.marked:
            return False
        least = self._least(column)
        return math.isfinite(least) and self.text(row[column]) == self.text(least)

    def is_tied(self, row: Sequence[Value], column: int) -> bool:
        """True if the value is within the limit of the smallest of a marked column."""
        if column not in self.marked or not self.limit:
            return False
        most = self._least(column) + float(self.limit[column])
        near = [other for other in self.rows if float(other[column]) <= most < math.inf]
        return len(near) > 1 and float(row[column]) <= most

    def _least(self, column: int) -> float:
        return min(float(row[column]) for row in self.rows)

    def __str__(self) -> str:
        """Lines of text, a group of columns named once above its own."""
        heads = list(zip_longest(*(c.split(", ", 1) for c in self.columns[1:]), fillvalue=""))
        if len(heads) == 2:
            above, own = heads
            pairs = zip(above, ("", *above), strict=False)
            heads = [tuple("" if group == before else group for group, before in pairs), own]
        lines = [("", *head) for head in heads]
        lines += [
            tuple(self.text(v) + "=" * self.is_tied(row, k) for k, v in enumerate(row))
            for row in self.rows
        ]
        if self.limit:
            lines.append(tuple(self.text(value) for value in self.limit))
        # Unmarked entries reserve space for a mark, so that digits are aligned.
        marked = [any(v.endswith("=") for v in column) for column in zip(*lines, strict=True)]
        lines = [
            tuple(v + " " * (room and not v.endswith("="))
                  for v, room in zip(line, marked, strict=True))
            for line in lines
        ]  # fmt: skip
        widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
        just = [str.rjust if self.is_numeric(k) else str.ljust for k in range(len(widths))]
        printed = ("  ".join(j(v, w) for j, v, w in zip(just, line, widths, strict=True))
                   for line in lines)  # fmt: skip
        return "\n".join([self.caption, *(line.rstrip() for line in printed)])


def error_table(comparison: Comparison, part: Part) -> Table:
    """Position errors by model over all recordings of a part, and the reduction by friction."""
    free = 1e3 * comparison.table(part=part)
    if len(comparison.joint_names) == 1:
        free = free[["all"]]
    columns = {f"free run, {name}": free[name].tolist() for name in free}
    for horizon in comparison.horizons(part):
        error = 1e3 * comparison.table(horizon, part=part)["all"]
        columns[f"windows, {horizon} s"] = error.tolist()
    marked = tuple(range(1, len(columns) + 1))
    limits = [comparison.limit(column=str(name), part=part) for name in free]
    limits += [comparison.limit(horizon, part=part) for horizon in comparison.horizons(part)]
    limit: tuple[Value, ...] = ()
    if any(of is not None for of in limits):
        limit = (LIMIT, *(math.nan if of is None else 1e3 * of for of in limits))
    if free.index[0] == NO_FRICTION:
        columns["error reduction, %"] = comparison.improvement(part=part)["all"].tolist()
        limit = (*limit, "") if limit else ()
    rows = zip(map(str, free.index), *columns.values(), strict=True)
    caption = f"Position RMSE [m{comparison.unit}] over {PART_NAMES[part]}"
    return Table(caption, ("model", *columns), tuple(rows), "diverged", marked, limit)


def selection_table(selection: Selection) -> Table:
    """Error of each model on blocks of the training recordings that its fits had not seen."""
    rows = tuple(
        (c.name, 1e3 * c.error, float(c.parameters), "yes" if c.converged else "no")
        for c in selection.candidates
    )
    return Table(
        f"Position RMSE [m{selection.unit}] of {selection.horizon:.3g} s simulations over blocks "
        "left out",
        ("model", "error", "parameters", "all fits converged"), rows, "diverged", (1,),
    )  # fmt: skip


def coefficient_table(
    model: str, joints: Sequence[str], sets: Sets, units: Mapping[str, str]
) -> Table:
    """Coefficients by joint, and by range of validity if they follow the motion.

    Joints are rows; many constants, as of a law with memory, are rows themselves. `sets` are by
    range of validity (`"always"` for constants), then by name; `units` by name, as far as they are
    known.
    """
    names = list(next(iter(sets.values()), {}))
    follows = list(sets) != ["always"]
    heads = [f"{name} [{units[name]}]" if name in units else name for name in names]
    caption = f"Coefficients of {model}" + (" (they follow the motion)" if follows else "")
    rows: list[tuple[Value, ...]] = []
    if len(names) > _WIDEST and not follows:
        rows += [(head, *sets["always"][name]) for head, name in zip(heads, names, strict=True)]
        return Table(caption, ("coefficient", *joints), tuple(rows))
    for j, joint in enumerate(joints):
        for label, of in sets.items():
            values = [of[name][j] if name in of else math.nan for name in names]
            rows.append((joint, *([label.replace("_", " ")] if follows else []), *values))
    return Table(caption, ("joint", *(["applies"] if follows else []), *heads), tuple(rows))


def interval_table(
    model: str,
    intervals: Sequence[tuple[str, float, float, float]],
    plant: bool,
    warnings: Sequence[str],
) -> Table:
    """95 % confidence intervals of a model: parameter, value, ends; `plant` for its terms too.

    The caption mentions warnings of errors that the intervals do not cover.
    """
    caption = f"95 % confidence intervals of {model}"
    if any("intervals do not cover this" in warning for warning in warnings):
        caption += ", assuming a complete model"
    if plant:
        caption += " (plant terms as relative change from the rig, offsets in SI)"
    return Table(caption, ("parameter", "value", "from", "to"), tuple(intervals))


def coefficient_units(model: FrictionModel, unit: str) -> dict[str, str]:
    """Unit of each coefficient for positions in `unit`."""
    return {c.name: unit_for(c.unit, unit) for c in model.law.coefficients}


def joint_labels(names: Sequence[str] | None, joints: int) -> list[str]:
    """The given names, or joint1, joint2, ...; ValueError if there is not one for each joint."""
    if names is not None and len(names) != joints:
        raise ValueError(f"`joint_names` must be {joints} names, got {list(names)}.")
    return list(names) if names is not None else [f"joint{k + 1}" for k in range(joints)]

"""From a table's columns to a recording's arrays: names, units, numbers."""

from __future__ import annotations

import math
import re
import unicodedata
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from nfriction.io.formats.numbers import THOUSANDS, Array, column_numbers

if TYPE_CHECKING:
    import pandas as pd

OURS = re.compile(r"time|(q|qd|tau|motor|current)[1-9]\d{0,3}", re.ASCII)
# What a motor's angle and current are converted to.
_OF_MOTORS = {"motor": "q", "current": "tau"}
# Usual names of a torque, or of the current that produces it, followed by a number and a unit;
# "torque_on" and "taut" are not among them.
_LIKE_TORQUE = re.compile(
    r"(torque|drehmoment|strom|(?<![a-z])(tau|force|current))(_(cmd|command|meas|measured))?[\W_]*\d*(_[mk]?(Nc?m?m?|A))?\s*([\[(].*)?$",
    re.IGNORECASE,
)
_LIKE_TIME = re.compile(r"^(t|time|zeit|timestamp|zeitstempel)(?![a-z])", re.IGNORECASE)
_LIKE_POSITION = re.compile(
    r"^(pos|ang|winkel|gelenk|joint|motor|enc|geber|theta|phi|q(?!d))\w*[\W_]*\d*\s*([\[(].*)?$",
    re.IGNORECASE,
)
_LIKE_VELOCITY = re.compile(r"speed|vel|omega|drehzahl|geschw|^qd\d*$", re.IGNORECASE)
_LIKE_CURRENT = re.compile("strom|current", re.IGNORECASE)

_TURN = 2 * math.pi
_ROTATION = {"rad": 1.0, "mrad": 1e3, "deg": 180 / math.pi, "rev": 1 / _TURN}
_LENGTH = {"m": 1.0, "cm": 1e2, "mm": 1e3, "um": 1e6}
# Units per SI unit: values are divided by them, so that milliseconds stay exact.
_PER_SI: dict[str, dict[str, float]] = {
    "time": {"min": 1 / 60, "s": 1.0, "ms": 1e3, "us": 1e6, "ns": 1e9},
    "q": _ROTATION | _LENGTH,
    "qd": {f"{x}/s": per for x, per in (_ROTATION | _LENGTH).items()} | {"rpm": 60 / _TURN},
    "tau": {"N m": 1.0, "mN m": 1e3, "N cm": 1e2, "N": 1.0, "mN": 1e3, "kN": 1e-3},
    "motor": _ROTATION,
    "current": {"A": 1.0, "mA": 1e3},
}
_SPELLINGS = {
    "°": "deg", "°/s": "deg/s", "degree": "deg", "degrees": "deg", "degrees/s": "deg/s",
    "Grad": "deg", "Grad/s": "deg/s", "radian": "rad", "radians": "rad", "radians/s": "rad/s",
    "1/min": "rpm", "U/min": "rpm", "Nm": "N m", "N*m": "N m", "N.m": "N m", "mNm": "mN m",
    "Nmm": "mN m", "N mm": "mN m", "N*mm": "mN m", "N.mm": "mN m", "Ncm": "N cm",
    "sec": "s", "msec": "ms", "μs": "us", "μm": "um", "turns": "rev",
}  # fmt: skip


# At the end of a name, only unambiguous units: "rev" may be a direction, "cm" a mass centre, and SI
# units need no mention. Brackets may contain a unit or anything else, but a number is an index.
_UNIT_IN_NAME = re.compile(r"_(ms|us|ns|mrad|deg|mm|um|rpm|mNm|Ncm|mA)$|[\[(](\D[^\[\]()]*)[\])]$")


class Source(NamedTuple):
    """A column of a table and its unit, None if unknown; for a motor, with a factor."""

    column: str
    unit: str | None
    motor: str = ""
    factor: float = 1.0


class Arrays(NamedTuple):
    """Arrays of a recording in SI."""

    # time, q; qd if every joint has it; tau if any joint has it, zero for the others
    values: dict[str, Array]
    slides: bool | None  # whether positions are lengths; None if unknown
    remarks: tuple[tuple[str, str], ...] = ()  # doubts about the columns, each with its remedy
    of_motors: bool = False  # positions follow from the angles of motors
    has_unit: bool = False  # whether every position has a unit


def table_arrays(
    table: pd.DataFrame,
    columns: Mapping[str, str] | None = None,
    *,
    degrees: bool = False,
    motor_factors: Mapping[str, Sequence[float]] | None = None,
) -> Arrays:
    """Arrays time, q and perhaps qd and tau.

    Args:
        table: with columns time, q1 …, perhaps qd1 …, tau1 …; others are ignored. In place of q1
            and tau1 it may have motor1 and current1.
        columns: the table's names for ours, optionally with a unit: "enc_1:deg".
        degrees: positions and velocities without a unit are in degrees.
        motor_factors: position per angle of a joint's motor ("motor") and torque per its current
            ("current"), one number per joint.
    Raises:
        ValueError: a column or unit that is missing, unknown or contradicts another, or a column
            given for a joint that does not exist.
    """
    # A user's table may number its columns.
    table = table.set_axis([str(name) for name in table.columns], axis=1)
    columns = {key: str(name) for key, name in (columns or {}).items()}
    sources = _sources(table, columns)
    named = [_joint_key(key) if key in sources else key for key in columns]
    sources = _of_joints(sources, columns, motor_factors or {})
    joints = max((int(key[1:]) for key in sources if re.fullmatch(r"q\d+", key)), default=1)
    # For a lone q9999 it is enough to name one missing column.
    needed = ["time", *(f"q{k + 1}" for k in range(min(joints, len(sources) + 1)))]
    missing = [key for key in dict.fromkeys((*needed, *named)) if key not in sources]
    if missing:
        raise ValueError(_missing(table, columns, missing))
    beyond = [key for key in columns if _number(key) > joints]
    if beyond:
        raise ValueError(
            f"`columns` names {', '.join(beyond)}, but the last position is q{joints}; also name "
            f"positions of those joints, or drop them."
        )
    sources = {key: source for key, source in sources.items() if _number(key) <= joints}
    undecided = _settle_decimal_sign(table, sources)
    arrays = {"time": _column(table, "time", sources["time"])}
    for key in ("q", "qd", "tau"):
        group = [sources.get(f"{key}{k + 1}") for k in range(joints)]
        # A joint without a motor has no torque to log; an unlogged velocity is not zero.
        if all(group) or (key == "tau" and any(group)):
            stack = [_joint_column(table, key, source, degrees) for source in group]
            arrays[key] = np.stack(stack, axis=1)
    positions = [sources[f"q{k + 1}"] for k in range(joints)]
    units = [s.unit for s in positions if s.unit and not s.motor]
    kinds = {slides(unit) for unit in units}
    if len(kinds) > 1:
        raise ValueError(f"positions must all be angles or all be lengths, got {', '.join(units)}.")
    remarks = [*undecided, *_remarks(table, sources, joints)]
    complete = np.all([~np.isnan(np.c_[x]).any(axis=1) for x in arrays.values()], axis=0)
    if not complete.all():
        read = {k: v for k, v in sources.items() if k.rstrip("0123456789") in arrays}
        remarks.append(_incomplete_rows(table, read, complete))
        arrays = {key: values[complete] for key, values in arrays.items()}
    of_motors = any(source.motor == "motor" for source in sources.values())
    has_unit = degrees or all(source.unit for source in positions)
    return Arrays(arrays, kinds.pop() if kinds else None, tuple(remarks), of_motors, has_unit)


def _incomplete_rows(
    table: pd.DataFrame, sources: dict[str, Source], complete: NDArray[np.bool_]
) -> tuple[str, str]:
    """A remark on rows without a number in some column; ValueError if most rows are."""
    columns = dict.fromkeys(source.column for source in sources.values())
    empty = [name for name in columns if np.isnan(column_numbers(table, name)).any()]
    # Counted from 0 below the header.
    finding = (
        f"{(~complete).sum()} of {len(complete)} rows (the first is row {np.argmin(complete)}) "
        f"have no number in {', '.join(empty)}"
    )
    if 2 * complete.sum() < len(complete):
        raise ValueError(
            f"{finding}; drop empty columns, and log the others at one rate or interpolate them to "
            "common time stamps."
        )
    return f"{finding}, so they are left out", "fill them if these columns are sampled less often"


def parse_source(spec: str, names: set[str]) -> Source | None:
    """The column that a specification such as "enc_1" or "enc_1:deg" names, None if missing.

    A unit in a column's name, as in "speed_rpm" or "speed [rpm]", applies unless another is stated.
    """
    stem, _, unit = spec.rpartition(":")
    if spec in names:
        in_name = _UNIT_IN_NAME.search(spec)
        unit = canonical_unit(in_name[1] or in_name[2]) if in_name else ""
        return Source(spec, unit if is_unit(unit) else None)
    return Source(stem, unit) if stem in names and is_unit(unit) else None


def canonical_unit(text: str) -> str:
    """A unit in our spelling, without the brackets and signs of a file."""
    text = unicodedata.normalize("NFKC", text).strip().strip("[]()").strip()
    return _SPELLINGS.get(text, text)


def is_unit(text: str) -> bool:
    """True for a unit of any kind of column."""
    return any(_per_si(kind, text) is not None for kind in _PER_SI)


def slides(unit: str) -> bool:
    """True for the unit of a sliding joint."""
    return canonical_unit(unit) in _LENGTH


def to_si(kind: str, values: Array, unit: str) -> Array:
    """Values in SI.

    Args:
        kind: "time", "q", "qd", "tau", "motor" or "current".
        values: any shape.
        unit: s, ms, us, ns; rad, mrad, deg, rev, counts/8192 (any count per turn), m, cm, mm,
            um; those per second, rpm; N m, mN m, N cm, N, mN, kN; A, mA; min.
    """
    per = _per_si(kind, unit)
    if per is None:
        known = ", ".join(_PER_SI[kind]) + (", counts/N" if kind in ("q", "motor") else "")
        raise ValueError(f"{unit!r} is not a unit of {kind}; known units are {known}.")
    return values if per == 1.0 else values / per


def _per_si(kind: str, unit: str) -> float | None:
    unit = canonical_unit(unit)
    counts = re.fullmatch(r"counts?/([1-9][0-9]{0,11})", unit)
    if counts and kind in ("q", "motor"):
        return int(counts[1]) / _TURN
    return _PER_SI[kind].get(unit)


def _sources(table: pd.DataFrame, columns: dict[str, str]) -> dict[str, Source]:
    """Sources of time, q1 … by our names."""
    unknown = [key for key in columns if not OURS.fullmatch(key)]
    if unknown:
        raise ValueError(
            f"`columns` maps time, q1 …, qd1 …, tau1 … to the file's names, got keys {unknown}."
        )
    names = set(table.columns)
    aliases = _texts(table, "aliases")
    mapped = {key: parse_source(spec, names | set(aliases)) for key, spec in columns.items()}
    found = {key: source for key, source in mapped.items() if source is not None}
    keys: dict[str, list[str]] = {}
    for key, source in found.items():
        keys.setdefault(aliases.get(source.column, source.column), []).append(key)
    for column, of in keys.items():
        if len(of) > 1:
            raise ValueError(
                f"`columns` names column {column} for {' and '.join(of)}; each needs its own "
                "column, so correct one of them."
            )
    # A column that is mapped to one key must not also be found under its own name.
    for name in (*names, *aliases):
        if OURS.fullmatch(name) and name not in columns and aliases.get(name, name) not in keys:
            found[name] = Source(name, None)
    return {key: _known(table, aliases, source) for key, source in found.items()}


def _known(table: pd.DataFrame, aliases: dict[str, str], source: Source) -> Source:
    """A source by the table's own name for it, with the unit in the file."""
    column = aliases.get(source.column, source.column)
    # pandas renames repeated columns, so that the first would be used silently.
    if column in table.attrs.get("repeated", ()) or (table.columns == column).sum() > 1:
        raise ValueError(f"column {column} occurs more than once; rename one of them.")
    written = _texts(table, "units").get(column)
    units = {canonical_unit(unit) for unit in (source.unit, written) if unit and is_unit(unit)}
    if source.unit and len(units) > 1:
        raise ValueError(
            f"column {column} is given as {source.unit!r}, but the file says {written!r}."
        )
    return Source(column, source.unit or written)


def _joint_key(key: str) -> str:
    """Our name of the quantity to which a motor's column is converted: q1 for motor1."""
    stem = key.rstrip("0123456789")
    return _OF_MOTORS.get(stem, stem) + key[len(stem) :]


def _of_joints(
    sources: dict[str, Source], columns: Mapping[str, str], factors: Mapping[str, Sequence[float]]
) -> dict[str, Source]:
    """Sources by quantity of a joint; a motor's are used if the joint has none of its own."""
    found = {key: source for key, source in sources.items() if _joint_key(key) == key}
    for key, source in sources.items():
        ours, kind = _joint_key(key), key.rstrip("0123456789")
        if ours == key or (ours in found and key not in columns):
            continue
        if ours in columns:
            raise ValueError(
                f"`columns` names {ours} and {key}, but one follows from the other; drop one."
            )
        joint = int(key[len(kind) :])
        if joint > len(factors.get(kind, ())):
            if kind == "current" and key not in columns:
                continue  # a remark states what is needed
            what = "`torque_constant`" if kind == "current" else "`gear_ratio`"
            raise ValueError(
                f"{key} belongs to a motor: the rig needs a `motor` with a {what} for joint "
                f"{joint}, and the reader needs that rig (`plant=rig`)."
            )
        found[ours] = source._replace(motor=kind, factor=factors[kind][joint - 1])
    return found


def _joint_column(table: pd.DataFrame, key: str, source: Source | None, degrees: bool) -> Array:
    """A joint's numbers in SI; zero without a source."""
    if source is None:
        return np.zeros(len(table))
    if degrees and key in ("q", "qd"):
        unit = "deg" if key == "q" else "deg/s"
        if source.unit and canonical_unit(source.unit) != unit:
            raise ValueError(
                f"`degrees=True`, but column {source.column} is given as {source.unit!r}; "
                f"drop one of the two."
            )
        source = source._replace(unit=unit)
    with np.errstate(invalid="ignore"):  # a signalling NaN, which is refused later
        return source.factor * _column(table, source.motor or key, source)


def _number(name: str) -> int:
    """The last number in a name such as "tau_1 [Nm]", 0 where there is none."""
    digits = re.search(r"([0-9]{1,4})[^0-9]*$", name)
    return int(digits[1]) if digits else 0


def _settle_decimal_sign(table: pd.DataFrame, sources: dict[str, Source]) -> list[tuple[str, str]]:
    """Settle an ambiguous decimal sign; a remark if it remains a guess."""
    used = [s for s in sources.values() if s.column in table.attrs.get("undecided", ())]
    for column, unit, *_ in used:
        cell = next(str(cell) for cell in table[column] if set(str(cell)) & set(THOUSANDS))
        sign = "," if "," in cell else "."
        # Counts are whole numbers, so it cannot be a decimal sign.
        if unit and canonical_unit(unit).startswith("count"):
            table.attrs["decimal"] = THOUSANDS[sign]
            return []
    if not used:
        return []
    role = "is a decimal sign" if table.attrs["decimal"] == sign else "separates thousands"
    finding = f"column {column} is ambiguous: it is assumed that {sign!r} in {cell!r} {role}"
    remedy = "state the decimal sign with a line `# decimal: ,` or `# decimal: .` above the header"
    return [(finding, remedy)]


def _remarks(
    table: pd.DataFrame, sources: dict[str, Source], joints: int
) -> Iterator[tuple[str, str]]:
    lacking = {
        key: [f"{key}{k + 1}" for k in range(joints) if f"{key}{k + 1}" not in sources]
        for key in ("qd", "tau")
    }
    if 0 < len(lacking["qd"]) < joints:
        finding = f"column {', '.join(lacking['qd'])} is missing, so no measured velocity is read"
        yield finding, "name the columns of all joints, or of none"
    for column, unit, *_ in sources.values():
        bracket = _UNIT_IN_NAME.search(column)
        if bracket and unit is None:
            finding = f"column {column}: {bracket[2]!r} is not a known unit and is ignored"
            yield finding, 'if it is a unit, convert the column, or state one, as in "enc_1:deg"'
    free = lacking["tau"]
    if 0 < len(free) < joints:
        of_motors = any(source.motor == "current" for source in sources.values())
        named = [name.replace("tau", "current") if of_motors else name for name in free]
        finding = f"no column {', '.join(named)}, so that joint is assumed to be passive"
        yield finding, f'if it is driven, name it with columns={{"{named[0]}": "..."}}'
    read = {source.column for source in sources.values()}
    drives = {name: kind for name, kind in _drives(table).items() if name not in read}
    unread = [name for name in drives if f"tau{_number(name)}" not in sources] if free else []
    if unread:
        own = f"tau{_number(unread[0])}"
        option = f'columns={{"{own if own in free else free[0]}": "{unread[0]}"}}'
        kind, remedy = "torque", f"if it is, name it with {option}"
        if drives[unread[0]] == "current":
            kind, option = "motor current", option.replace('{"tau', '{"current')
            remedy = "if it drives a joint, give the rig a `motor` with its `torque_constant` "
            remedy += f"and `gear_ratio`, and name the column with {option}"
        finding = f"column {', '.join(unread[:3])} looks like {kind} and is not read"
        yield finding, remedy


def _drives(table: pd.DataFrame) -> dict[str, str]:
    """Columns whose name or unit suggests a torque or a motor's current, with that quantity."""
    units, found = _texts(table, "units"), {}
    for name in map(str, table.attrs.get("found", table.columns)):
        of_unit = [kind for kind in ("tau", "current") if _per_si(kind, units.get(name, ""))]
        if of_unit:
            found[name] = of_unit[0]
        elif _LIKE_TORQUE.search(name):
            found[name] = "current" if _LIKE_CURRENT.search(name) else "tau"
    return found


def _column(table: pd.DataFrame, kind: str, source: Source) -> Array:
    values = column_numbers(table, source.column)
    if source.unit is None:
        return values
    try:
        return to_si(kind, values, source.unit)
    except ValueError as error:
        raise ValueError(f"column {source.column}: {error}") from error


def _missing(table: pd.DataFrame, columns: dict[str, str], missing: list[str]) -> str:
    found = [str(name) for name in table.attrs.get("found", table.columns)]
    more = f" … ({len(found)} in all)" if len(found) > 30 else ""
    shown = ", ".join(name[:60] for name in found[:30]) + more
    first = columns.get(missing[0], missing[0])
    stem, _, unit = first.rpartition(":")
    note = f" {unit!r} is not a known unit." if stem in found and not is_unit(unit) else ""
    rates = [name for name in found if _LIKE_VELOCITY.search(name)]
    if rates and missing[0].startswith("q") and not any(map(_LIKE_POSITION.search, found)):
        note += f" Without positions, add the integral of {rates[0][:60]} over time as a column."
    lost = [columns.get(key, key) for key in missing[:10]]
    label = f"column {lost[0]} is" if len(lost) == 1 else f"columns {', '.join(lost)} are"
    guessed = {} if columns else _guessed(found, _drives(table))
    pairs = ", ".join(f'"{key}": "{name}"' for key, name in guessed.items())
    pairs = pairs or f'"{missing[0]}": "..."'
    return (
        f"{label} missing; found {shown}.{note} Name the columns with columns={{{pairs}}}, with a "
        'unit after a colon if it is not SI, as in "enc_1:deg".'
    )


def _guessed(found: Sequence[str], drives: Mapping[str, str]) -> dict[str, str]:
    """Our names with a file's, by usual words; empty unless time and positions are among them.

    Only for advice in an error: columns to be read are always named by the user.
    """
    plain = [name for name in found if not set(name) & set('",=:') and len(name) <= 60]
    times = [name for name in plain if _LIKE_TIME.search(name)]
    torques = [name for name in plain if name in drives]
    positions = [name for name in plain if _LIKE_POSITION.search(name) and name not in torques][:10]
    if len(times) != 1 or not positions:
        return {}
    pairs = {"time": times[0]}
    pairs |= {
        f"{'motor' if name.lower().startswith('motor') else 'q'}{k}": name
        for k, name in enumerate(positions, 1)
    }
    # With fewer torques than joints it is unknown which joints are driven.
    if len(torques) == len(positions):
        pairs |= {f"{drives[name]}{k}": name for k, name in enumerate(torques, 1)}
    return {key: name for key, name in pairs.items() if key != name}


def _texts(table: pd.DataFrame, key: str) -> dict[str, str]:
    """A mapping among a table's attributes, which may come from an untrusted file."""
    given = table.attrs.get(key)
    return {str(k): str(v) for k, v in given.items()} if isinstance(given, dict) else {}

"""Tables of friction torque over velocity: constant-velocity tests, or residual torques."""

from __future__ import annotations

import hashlib
import math
import os
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from nfriction.io import formats
from nfriction.io.formats.selection import canonical_unit, is_unit, parse_source, slides, to_si
from nfriction.recording.record import Unit
from nfriction.recording.validation import Array, gaps, restarts, time_unit, turns_between_samples

if TYPE_CHECKING:
    import pandas as pd

# Other names of our columns, optionally followed by the joint's number.
_NAMES = {
    "time": "time",
    "q": "q|position",
    "qd": "qd|velocity",
    "qdd": "qdd|acceleration",
    "tau": "tau|tau_f|friction|torque",
    "load": "load|normal_force",
    "temperature": "temperature",
    "joint": "joint",
}
_KEYS = {
    key: re.compile(rf"(?:{names})_?([1-9]\d{{0,3}})?", re.ASCII) for key, names in _NAMES.items()
}
# Columns whose units are those of times, positions or torques; others are not converted.
_KIND = {"time": "time", "q": "q", "qd": "qd", "tau": "tau", "load": "tau"}
_PER_JOINT = ("q", "qd", "qdd", "tau", "load", "temperature")
# Usual names, without a unit.
_LIKE = {
    "qd": re.compile(r"(speed|vel|omega|drehzahl|geschw)", re.IGNORECASE),
    "tau": re.compile(r"[^\[(]*(torque|moment|tau|force|kraft|friction)", re.IGNORECASE),
}
MINIMUM_ROWS = 8
# Faster joints are in degrees per second, or wheels [rad/s].
FAST = 60.0
# Positions follow the velocity within this factor: units differ by more, filters by less.
FOLLOWS = 2.0
# Number of unread columns that are named.
LISTED = 8
# Share of the largest velocity up to which a joint is at rest.
RESTING = 1e-3


@dataclass(frozen=True, eq=False)
class JointTorque:
    """Friction torque of one joint, row by row.

    Attributes:
        qd: velocity [rad/s; m/s], (row,).
        tau: friction torque, of the sign of the velocity [N m; N], (row,).
        time: increasing [s], (row,); None for unordered rows, such as constant-velocity tests.
        q: position [rad; m], (row,), or None.
        qdd: acceleration [rad/s^2; m/s^2], (row,); zero where it is unknown.
        load: normal load in any unit, (row,), or None; load-dependent laws use it unscaled.
        temperature: in any unit, (row,), or None.
    """

    name: str
    qd: Array
    tau: Array
    time: Array | None
    q: Array | None
    qdd: Array
    load: Array | None
    temperature: Array | None

    def __len__(self) -> int:
        return len(self.qd)

    @property
    def step(self) -> float:
        """Median time between rows [s]; 1 for unordered rows."""
        return 1.0 if self.time is None else float(np.median(np.diff(self.time)))

    def rows(self, index: NDArray[Any]) -> JointTorque:
        """Some of the rows, given by a mask or by their numbers."""
        every = {key: getattr(self, key) for key in ("time", *_PER_JOINT)}
        some: dict[str, Any] = {k: None if x is None else x[index] for k, x in every.items()}
        return replace(self, **some)

    @property
    def moving(self) -> JointTorque:
        """Rows without those at rest, where dry friction can have any value."""
        fast = np.abs(self.qd) > RESTING * np.abs(self.qd).max()
        return self if fast.all() or not fast.any() else self.rows(fast)

    @property
    def sliding(self) -> JointTorque:
        """Unordered rows without those at rest; all rows in order of time."""
        return self.moving if self.time is None else self

    @property
    def distinct(self) -> JointTorque:
        """Rows without time by velocity, without copies of the whole table.

        Copies would narrow intervals. Readings of a coarse sensor are equal by chance, but then not
        each a multiple of k times. The order of rows in the file does not matter; those at one
        velocity are shuffled, because in order of their torque they would seem correlated.
        """
        if self.time is not None:
            return self
        every = (self.qd, self.tau, self.q, self.qdd, self.load, self.temperature)
        table = np.stack([x for x in every if x is not None], 1)
        _, where, counts = np.unique(table, axis=0, return_inverse=True, return_counts=True)
        kept = counts // np.gcd.reduce(counts)
        if kept.sum() < MINIMUM_ROWS:
            kept = counts
        repeat = np.arange(len(table)) - np.repeat(np.cumsum(counts) - counts, counts)
        order = np.argsort(where.ravel(), kind="stable")[repeat < np.repeat(kept, counts)]
        order = np.random.default_rng(0).permutation(order)
        return self.rows(order[np.argsort(self.qd[order], kind="stable")])


@dataclass(frozen=True, eq=False, repr=False)
class TorqueTable:
    """Friction torque over velocity, joint by joint.

    Attributes:
        joints: rows of each joint, which need not be equally many.
        unit: of a position, `"rad"` or `"m"`.
        remarks: doubts about the data, a sentence each.
    """

    joints: tuple[JointTorque, ...]
    unit: Unit = "rad"
    name: str = ""
    remarks: tuple[str, ...] = ()

    def __repr__(self) -> str:
        rows = ", ".join(f"{joint.name} {len(joint)}" for joint in self.joints)
        return f"TorqueTable({self.name or 'unnamed'}: rows of {rows})"

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Names of the joints."""
        return tuple(joint.name for joint in self.joints)

    def digest(self) -> str:
        """SHA-256 of the content in hexadecimal."""
        digest = hashlib.sha256(repr((self.joint_names, self.unit)).encode())
        for joint in self.joints:
            for key in ("time", *_PER_JOINT):
                values = getattr(joint, key)
                digest.update(b"-" if values is None else values.tobytes())
        return digest.hexdigest()

    @classmethod
    def read(
        cls,
        path: str | os.PathLike[str],
        *,
        columns: Mapping[str, str] | None = None,
        degrees: bool = False,
        unit: Unit = "rad",
        torque: bool = True,
    ) -> TorqueTable:
        """Table from a file, in any of the formats of `Recording.read`.

        Args:
            path: of the file; the table's name is the file's without its ending.
            columns, degrees, unit, torque: as for `from_pandas`.

        Raises:
            FileNotFoundError: there is no such file.
            ValueError: broken content or missing columns; names the file.
        """
        table = formats.read_table(path, list((columns or {}).values()))
        try:
            found = cls.from_pandas(
                table, columns=columns, degrees=degrees, unit=unit, torque=torque
            )
        except ValueError as error:
            raise ValueError(f"'{path}': {error}") from error
        return replace(found, name=formats.stem(path))

    @classmethod
    def from_pandas(
        cls,
        table: pd.DataFrame,
        *,
        columns: Mapping[str, str] | None = None,
        degrees: bool = False,
        unit: Unit = "rad",
        torque: bool = True,
    ) -> TorqueTable:
        """Table from columns qd and tau, perhaps time, q, qdd, load, temperature and joint.

        A column joint separates the rows of several joints; without it, qd1, tau1, qd2, tau2, ...
        are theirs. `tau_f`, `friction` and `torque` are read as tau, and likewise `position`,
        `velocity`, `acceleration` and `normal_force`. If time and q are given but not qd, velocity
        and acceleration come from smoothed positions.

        Args:
            table: units in its header, as in `qd [deg/s]`, are used.
            columns: the table's names for ours, optionally with a unit: "vel:deg/s".
            degrees: positions and velocities are in degrees.
            unit: of positions, `"rad"` or `"m"`.
            torque: False also accepts a table without tau, to predict its torque; tau is then NaN.

        Raises:
            ValueError: a column that is missing or lacks numbers in some rows; time that does not
                increase; a joint that does not move.
        """
        if unit not in ("rad", "m"):
            raise ValueError(f'`unit` must be "rad" or "m", got {unit!r}.')
        table = table.set_axis([str(name) for name in table.columns], axis=1)
        sources = _sources(table, columns or {})
        _require_unit(unit, sources)
        values = {
            key: _numbers(table, key[0], *source, degrees=degrees)
            for key, source in sources.items()
            if key[0] != "joint"
        }
        remarks: list[str] = []
        read = {column for column, _ in sources.values()}
        if unread := [name[:60] for name in table.columns if name not in read]:
            more = f" and {len(unread) - LISTED} more" * (len(unread) > LISTED)
            remarks.append(f"Columns that are not read: {', '.join(unread[:LISTED])}{more}.")
        if torque and ("time", 0) in sources:
            # Without time, equal rows need not be copies: `JointTorque.distinct` judges.
            first = ~table.duplicated(list(read)).to_numpy()
            if copies := int((~first).sum()):
                remarks.append(
                    f"{copies} of {len(table)} rows equal others in every column, time included, "
                    "and are left out."
                )
            table, values = table[first], {key: x[first] for key, x in values.items()}
        names: list[str] = []
        parts: list[dict[str, Array | None]] = []
        for name, rows, number in _parts(table, sources, torque):
            found = {key: values.get((key, number)) for key in _PER_JOINT}
            # One column may be shared by all joints.
            for key in ("load", "temperature"):
                if found[key] is None:
                    found[key] = values.get((key, 0))
            found["time"] = values.get(("time", 0))
            names.append(name)
            parts.append({key: None if x is None else x[rows] for key, x in found.items()})
        joints = [_joint(*pair, remarks) for pair in zip(names, parts, strict=True)]
        for joint in joints:
            remarks += _doubts(joint, turns=unit == "rad")
        stated = any(named for (key, _), (_, named) in sources.items() if key in ("q", "qd"))
        if unit == "rad" and not (degrees or stated):
            fast = [j.name for j in joints if np.abs(j.qd).max() > FAST]
            if fast:
                remarks.append(
                    f"The velocity of {', '.join(fast)} exceeds {FAST:g} rad/s, as degrees per "
                    "second or revolutions per minute would; if so, read the table with "
                    '`degrees=True`, or columns={"qd": "qd:rpm"}.'
                )
        return cls(tuple(joints), unit, "", tuple(remarks))


_Key = tuple[str, int]


def _sources(table: pd.DataFrame, columns: Mapping[str, str]) -> dict[_Key, tuple[str, str | None]]:
    """Column and unit of each of our keys, with the number of its joint, 0 for none."""
    aliases = table.attrs.get("aliases") or {}
    units = table.attrs.get("units") or {}
    names = {str(name) for name in table.columns}
    found: dict[_Key, tuple[str, str | None]] = {}
    taken = {str(spec).rpartition(":")[0] for spec in columns.values()} | set(columns.values())
    for name in (*names, *aliases):
        key = _key(name)
        if key and name not in taken:
            own = aliases.get(name, name)
            if key in found and found[key][0] != own:
                raise ValueError(
                    f"columns {found[key][0]} and {own} are both {key[0]}; rename one of them, or "
                    f'name the one to read with columns={{"{key[0]}": "..."}}.'
                )
            found[key] = (own, units.get(own))
    for ours, spec in columns.items():
        key = _key(ours)
        source = parse_source(spec, names) or parse_source(spec, set(aliases))
        if key is None:
            raise ValueError(
                f"`columns` maps {', '.join(_NAMES)}, optionally followed by a joint's number, to "
                f"the file's names, got the key {ours!r}."
            )
        if source is None:
            raise ValueError(_missing(table, ours, f"no column {spec!r}"))
        own = aliases.get(source.column, source.column)
        found[key] = (own, source.unit or units.get(own))
    return found


def _key(name: str) -> _Key | None:
    """Our name and the joint's number, 0 for none, of a column's name."""
    for key, pattern in _KEYS.items():
        match = pattern.fullmatch(name)
        if match and not (match[1] and key in ("time", "joint")):
            return key, int(match[1] or 0)
    return None


def _missing(table: pd.DataFrame, wanted: str, what: str) -> str:
    found = [str(name)[:60] for name in table.columns][:30]
    shown = ", ".join(found)
    # Only for this advice: columns to be read are always named by the user.
    guessed = {}
    for key, words in _LIKE.items():
        near = [n for n in found if words.match(n) and _key(n) is None and not set(n) & set('",=:')]
        if len(near) == 1:
            guessed[key] = near[0]
    pairs = guessed if wanted in guessed else {wanted: "..."}
    named = ", ".join(f'"{key}": "{name}"' for key, name in pairs.items())
    return (
        f"{what}; found {shown or 'none'}. A table of friction needs qd and tau, or qd1, tau1, "
        f"qd2, ...; name its columns with columns={{{named}}}, a unit after a colon "
        'where it is not SI, as in "velocity:deg/s".'
    )


def _parts(
    table: pd.DataFrame, sources: Mapping[_Key, tuple[str, str | None]], torque: bool
) -> Iterator[tuple[str, NDArray[Any] | slice, int]]:
    """Name, rows and number of columns of each joint."""
    numbers = sorted({n for key, n in sources if key == "tau"})
    if not numbers and not torque:
        numbers = sorted({n for key, n in sources if key in ("q", "qd")})
    if not numbers:
        raise ValueError(_missing(table, "tau", "no column of friction torque"))
    for n in numbers:
        known = {key for key, number in sources if number == n}
        # Velocity comes from positions if there are time stamps.
        if "qd" not in known and not ("q" in known and ("time", 0) in sources):
            own = f"qd{n}" if n else "qd"
            raise ValueError(_missing(table, own, f"column {own} is missing"))
    if ("joint", 0) not in sources:
        yield from ((f"joint{n or 1}", slice(None), n) for n in numbers)
        return
    if numbers != [0]:
        raise ValueError(
            "a table with a column joint has one qd and one tau, but this one also has tau"
            f"{numbers[-1]}; drop the column joint."
        )
    column = table[sources["joint", 0][0]]
    if column.isna().any():
        row = int(np.flatnonzero(column.isna())[0])
        raise ValueError(
            f"column {column.name}, row {row} (counted from 0 below the header) names no joint; "
            "fill or drop such rows."
        )
    labels = column.astype(str).str.strip().to_numpy()
    for label in dict.fromkeys(labels):
        name = f"joint{label}" if re.fullmatch(r"\d+", label) else label
        yield name, np.flatnonzero(labels == label), 0


def _numbers(
    table: pd.DataFrame, key: str, column: str, unit: str | None, *, degrees: bool
) -> Array:
    """A column's numbers in SI, finite in every row."""
    values = formats.column_numbers(table, column)
    kind = _KIND.get(key)
    if degrees and key in ("q", "qd", "qdd"):
        if unit and not canonical_unit(unit).startswith("deg"):
            raise ValueError(
                f"`degrees=True`, but column {column} is given as {unit!r}; drop one of the two."
            )
        values = np.deg2rad(values)
    elif kind and unit and is_unit(unit):
        values = to_si(kind, values, unit)
    bad = np.flatnonzero(~np.isfinite(values))
    if len(bad):
        raise ValueError(
            f"column {column}, row {bad[0]} (counted from 0 below the header) is {values[bad[0]]}, "
            f"one of {len(bad)} that are not finite; every row needs a number, so drop or fill "
            "these."
        )
    return values


def _joint(name: str, of: Mapping[str, Array | None], remarks: list[str]) -> JointTorque:
    """The rows of a joint, checked; velocity from positions if none is given."""
    time, q, qd, qdd, tau = (of[key] for key in ("time", "q", "qd", "qdd", "tau"))
    if tau is None:
        given = qd if qd is not None else q
        assert given is not None
        tau = np.full(len(given), np.nan)
    if len(tau) < MINIMUM_ROWS:
        raise ValueError(f"{name} has {len(tau)} rows; at least {MINIMUM_ROWS} are needed.")
    if time is not None and not np.all(np.diff(time) > 0):
        k = int(np.flatnonzero(np.diff(time) <= 0)[0])
        remedy = "sort the rows, or drop the column time if they are unordered"
        if restarts(time):
            remedy = "the clock starts again there, so count on, or drop the column time"
        raise ValueError(
            f"time of {name} must increase from row to row, got {time[k]:g} s and then "
            f"{time[k + 1]:g} s; {remedy}."
        )
    if qd is None:
        assert time is not None
        assert q is not None
        qd, qdd = _derivatives(time, q, qdd)
        if slow := time_unit(time):
            remarks.append(
                f"`time` looks like {slow[1]}; if so, divide it by {slow[2]:g}, or read it with "
                f'columns={{"time": "time:{slow[0]}"}}.'
            )
    elif qdd is None:
        qdd = np.zeros_like(qd) if time is None else np.gradient(qd, time)
    assert qdd is not None
    largest = float(np.abs(qd).max())
    if largest == 0.0:
        raise ValueError(
            f"{name} does not move: its velocity is zero in every row, so friction has no "
            "direction; record motion in both directions."
        )
    ways = [float(np.mean(sign * qd > RESTING * largest)) for sign in (1, -1)]
    if min(ways) == 0.0:
        remarks.append(
            f"{name} moves in one direction only: an offset cannot be separated from Coulomb "
            "friction, and nothing is known about the other direction."
        )
    if np.ptp(tau) == 0.0:
        raise ValueError(f"the friction torque of {name} is {tau[0]:g} in every row.")
    if min(ways) > 0.0 and (tau.min() >= 0.0 or tau.max() <= 0.0):
        remarks.append(
            f"The friction torque of {name} has one sign in both directions, as without its sign "
            "or with a load: give it the sign of the velocity, or subtract the torque of the load."
        )
    elif float(tau @ qd) < 0.0:
        remarks.append(
            f"The friction torque of {name} drives the joint on average, as with the wrong sign: "
            "it must be positive with positive velocity. If the sign is wrong, reverse it."
        )
    return JointTorque(name, qd, tau, time, q, qdd, of["load"], of["temperature"])


def _require_unit(unit: Unit, sources: Mapping[_Key, tuple[str, str | None]]) -> None:
    """Raise ValueError if a column's own unit contradicts the unit of positions."""
    for (key, _), (column, own) in sources.items():
        if key in ("q", "qd") and own and is_unit(own):
            found = "m" if slides(canonical_unit(own).removesuffix("/s")) else "rad"
            if found != unit:
                raise ValueError(
                    f"`unit` is {unit!r}, but column {column} is in {canonical_unit(own)}; read "
                    f"the table with `unit={found!r}` (`--unit {found}`)."
                )


def _doubts(joint: JointTorque, *, turns: bool) -> Iterator[str]:
    """Signs that positions are wrong, a sentence each."""
    if joint.q is None or joint.time is None:
        return
    pauses = gaps(joint.time)
    if turns and (jumps := int(turns_between_samples(joint.q[:, None], pauses)[0])):
        yield (
            f"q of {joint.name} looks wrapped ({jumps} jumps of about a turn); if so, unwrap it "
            "with `numpy.unwrap`."
        )
        return
    moved, step = np.diff(joint.q), np.diff(joint.time)
    expected = 0.5 * (joint.qd[1:] + joint.qd[:-1]) * step
    # Summed, because steps between rows may be as small as an encoder's.
    moved[pauses] = expected[pauses] = 0.0
    moved, expected = (np.cumsum(x) - np.cumsum(x).mean() for x in (moved, expected))
    ratio = float(moved @ expected) / max(float(expected @ expected), 1e-300)
    if not 1 / FOLLOWS < ratio < FOLLOWS:
        yield (
            f"q of {joint.name} changes {ratio:.3g} times as much as qd and time imply; laws with "
            "memory follow q, other laws qd: check the sign and the unit of both, and of time, an "
            "offset of qd, and that both are of this joint and on the same side of its gear."
        )


def _derivatives(time: Array, q: Array, qdd: Array | None) -> tuple[Array, Array]:
    """Velocity and acceleration of smoothed positions."""
    window = min(len(q) - 1 + len(q) % 2, 11)
    if math.isclose(float(np.ptp(q)), 0.0):
        return np.zeros_like(q), np.zeros_like(q)
    from scipy.signal import savgol_filter  # slow to import

    grid = np.linspace(time[0], time[-1], len(time))
    even = np.interp(grid, time, q)
    step = float(grid[1] - grid[0])
    found = [
        np.interp(time, grid, savgol_filter(even, window, 2, deriv=k, delta=step)) for k in (1, 2)
    ]
    return found[0], found[1] if qdd is None else qdd


def as_table(table: Any, **options: Any) -> TorqueTable:
    """A table, also from a path or DataFrame; options as for `TorqueTable.from_pandas`."""
    if isinstance(table, TorqueTable):
        return table
    if isinstance(table, (str, os.PathLike)):
        return TorqueTable.read(table, **options)
    if hasattr(table, "columns"):
        return TorqueTable.from_pandas(table, **options)
    raise TypeError(
        f"`table` must be a TorqueTable, a path or a DataFrame, got {type(table).__name__}."
    )


def blocks(joint: JointTorque, count: int) -> list[NDArray[np.intp]]:
    """Rows of each of `count` blocks that are left out in turn.

    Rows ordered in time form contiguous blocks; others are assigned by their velocity, so that a
    block left out lies between the rest.
    """
    if joint.time is not None:
        return list(np.array_split(np.arange(len(joint)), count))
    order = np.argsort(joint.qd, kind="stable")
    return [np.sort(order[k::count]) for k in range(count)]

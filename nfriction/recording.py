"""Recording: what an encoder log says, validated, in SI units, one column per joint."""

from __future__ import annotations

import hashlib
import os
import re
import warnings
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike, NDArray

from nfriction.angles import AngleConvention
from nfriction.formats import column_numbers, read_table, table_arrays, write_table

Array = NDArray[np.float64]
Unit = Literal["rad", "m"]

MINIMUM_SAMPLES = 8


class RecordingWarning(UserWarning):
    """A recording is valid but looks as if its units were not SI."""


def is_uniform(time: Array) -> bool:
    """Whether all steps between stamps are alike.

    Stamps rounded to a microsecond at 1 kHz differ by 1e-3 of a step; real jitter is larger.
    """
    step = np.diff(time)
    return bool(np.all(np.abs(step - np.median(step)) <= 2e-3 * np.median(step)))


@dataclass(frozen=True, eq=False, repr=False)
class Recording:
    """Positions of a mechanism's joints over time, with torque and velocity where measured.

    Arrays are copied to read-only float64. Irregular time stamps are allowed and kept. Two
    recordings hold the same data when their `digest()` agree.

    Args:
        time: [s], increasing, shape (time,).
        q: position [rad, or m where `unit` says so], shape (time, joint).
        tau: joint torque [N m, or N], shape like `q`.
        qd: measured velocity [rad/s, or m/s], shape like `q`.
        names: one name per joint, "joint1" … by default.
        convention: how `q` and `qd` are written; torques are joint torques in every convention.
        unit: of position.
        name: what to call the recording, such as the file's stem.
    Raises:
        ValueError: arrays that do not fit together, NaN or infinity, stamps that do not increase,
            fewer than 8 samples.
    Warns:
        RecordingWarning: positions that look like degrees, stamps that look like milliseconds.
    """

    time: Array
    q: Array
    tau: Array | None = None
    qd: Array | None = None
    names: tuple[str, ...] = ()
    convention: AngleConvention = field(default_factory=AngleConvention)
    unit: Unit = "rad"
    name: str = ""

    def __post_init__(self) -> None:
        for key in ("time", "q", "tau", "qd"):
            if getattr(self, key) is not None:
                object.__setattr__(self, key, _frozen(getattr(self, key), key))
        if self.q.ndim != 2:
            raise ValueError(
                f"`q` must be (time, joint), got shape {self.q.shape}; "
                f"a single joint is `q[:, None]`."
            )
        names = tuple(self.names) or tuple(f"joint{k + 1}" for k in range(self.joints))
        object.__setattr__(self, "names", names)
        _check_shapes(self)
        _check_content(self)
        _warn_of_units(self)

    @property
    def joints(self) -> int:
        """Number of joints."""
        return self.q.shape[1]

    @property
    def duration(self) -> float:
        """Time from the first to the last sample [s]."""
        return float(self.time[-1] - self.time[0])

    @property
    def sample_time(self) -> float:
        """Median step between samples [s]."""
        return float(np.median(np.diff(self.time)))

    @property
    def is_uniform(self) -> bool:
        """Whether all steps are alike but for the rounding of the stamps."""
        return is_uniform(self.time)

    def __len__(self) -> int:
        return len(self.time)

    def __repr__(self) -> str:
        stamps = "uniform" if self.is_uniform else "irregular"
        extras = [key for key in ("tau", "qd") if getattr(self, key) is not None]
        return (
            f"Recording({self.name!r}, joints={list(self.names)}, samples={len(self)}, "
            f"duration={self.duration:.6g} s, sample_time={self.sample_time:.4g} s {stamps}, "
            f"convention='{self.convention}', unit={self.unit!r}, with={extras})"
        )

    def __getitem__(self, samples: slice) -> Recording:
        """Samples as a recording, `recording[100:200]`; the stamps stay."""
        if not isinstance(samples, slice):
            raise TypeError(
                f"a recording is cut by a slice of samples, got {samples!r}; "
                f"columns are `recording.q[:, k]`."
            )
        tau = None if self.tau is None else self.tau[samples]
        qd = None if self.qd is None else self.qd[samples]
        return replace(self, time=self.time[samples], q=self.q[samples], tau=tau, qd=qd)

    def window(self, start: float, stop: float) -> Recording:
        """The samples from `start` to `stop` [s of the recording's own time], both included."""
        # A stamp that is a rounding error away counts as being there.
        slack = 1e-6 * self.sample_time
        first, last = np.searchsorted(self.time, [start - slack, stop + slack])
        return self[int(first) : int(last)]

    def windows(self, length: float, stride: float | None = None) -> list[Recording]:
        """Windows of `length` seconds, every `stride` seconds (`length` by default).

        Windows in a row share the sample between them; what is left at the end is dropped.
        """
        stride = length if stride is None else stride
        if not (length > 0 and stride > 0):
            raise ValueError(f"`length` and `stride` must be positive, got {length} and {stride}.")
        fitting = (self.duration - length + 1e-6 * self.sample_time) / stride
        starts = self.time[0] + stride * np.arange(int(np.floor(fitting)) + 1)
        return [self.window(start, start + length) for start in starts]

    def joint_coordinates(self, first_link: int = 0) -> Recording:
        """The same motion in joint coordinates: first angle from upright, the others relative.

        Args:
            first_link: column of the first link, 1 where column 0 is a free arm.
        """
        if self.unit == "m":
            return self
        qd = None if self.qd is None else self.convention.rate_to_joint(self.qd, first_link)
        q = self.convention.position_to_joint(self.q, first_link)
        return replace(self, q=q, qd=qd, convention=AngleConvention())

    def digest(self) -> str:
        """SHA-256 of the content in hexadecimal: arrays, joint names, convention and unit."""
        digest = hashlib.sha256(repr((self.names, str(self.convention), self.unit)).encode())
        for key in ("time", "q", "tau", "qd"):
            values = getattr(self, key)
            digest.update(f"{key} {None if values is None else values.shape}".encode())
            if values is not None:
                # Adding zero makes -0.0 the 0.0 it equals.
                digest.update((values + 0.0).astype("<f8").tobytes())
        return digest.hexdigest()

    def to_pandas(self) -> pd.DataFrame:
        """Table with columns time, q1 …, qd1 …, tau1 …; `attrs` tell convention, unit and names."""
        columns = {"time": self.time}
        for key in ("q", "qd", "tau"):
            values = getattr(self, key)
            if values is not None:
                columns |= {f"{key}{k + 1}": values[:, k] for k in range(self.joints)}
        table = pd.DataFrame(columns)
        names = ", ".join(self.names)
        table.attrs = {"convention": str(self.convention), "unit": self.unit, "names": names}
        return table

    @classmethod
    def from_pandas(
        cls,
        table: pd.DataFrame,
        *,
        columns: Mapping[str, str] | None = None,
        degrees: bool = False,
        convention: AngleConvention | str | None = None,
        unit: Unit | None = None,
        name: str = "",
    ) -> Recording:
        """Recording from a table with columns time, q1 …, and perhaps qd1 … and tau1 ….

        Velocity and torque are taken where every joint has them; other columns are ignored.

        Args:
            table: a row per sample.
            columns: the table's name for ours where they differ, {"time": "t", "q1": "enc_1"}.
            degrees: positions and velocities are in degrees.
            convention: of the angles; else `table.attrs["convention"]`, else relative, upright.
            unit: of position; else `table.attrs["unit"]`, else rad.
            name: what to call the recording.
        """
        attributes = table.attrs
        convention = convention or attributes.get("convention") or AngleConvention()
        if isinstance(convention, str):
            convention = AngleConvention.parse(convention)
        unit = unit or attributes.get("unit") or "rad"
        if degrees and unit == "m":
            raise ValueError("`degrees=True` needs angles, but `unit` is 'm'; drop one of the two.")
        arrays = table_arrays(table, dict(columns or {}))
        if degrees:
            arrays |= {key: np.deg2rad(arrays[key]) for key in ("q", "qd") if key in arrays}
        names = [part.strip() for part in attributes.get("names", "").split(",") if part.strip()]
        return cls(
            time=arrays["time"],
            q=arrays["q"],
            tau=arrays.get("tau"),
            qd=arrays.get("qd"),
            names=tuple(names),
            convention=convention,
            unit=unit,
            name=name,
        )

    @classmethod
    def read(
        cls,
        path: str | os.PathLike[str],
        *,
        columns: Mapping[str, str] | None = None,
        degrees: bool = False,
        convention: AngleConvention | str | None = None,
        unit: Unit | None = None,
        name: str | None = None,
    ) -> Recording:
        """Recording from a .csv, .csv.gz, .parquet or .npz file.

        A CSV file may begin with comment lines `# convention: absolute,hanging` and `# unit: rad`;
        arguments override what the file says. The name is the file's without its ending.

        Args:
            path: of the file.
            columns, degrees, convention, unit, name: as for `from_pandas`.
        Raises:
            FileNotFoundError: there is no such file.
            ValueError: broken content or missing columns; names the file.
        """
        table = read_table(path)
        stem = re.sub(r"\.(csv|csv\.gz|parquet|npz)$", "", Path(path).name, flags=re.IGNORECASE)
        try:
            return cls.from_pandas(
                table,
                columns=columns,
                degrees=degrees,
                convention=convention,
                unit=unit,
                name=stem if name is None else name,
            )
        except ValueError as error:
            raise ValueError(f"'{path}': {error}") from error

    def write(self, path: str | os.PathLike[str]) -> None:
        """Write to .csv, .csv.gz, .parquet or .npz, whole or not at all; `read` gives it back."""
        write_table(self.to_pandas(), path)


def read_initial_states(path: str | os.PathLike[str]) -> dict[str, tuple[Array, Array]]:
    """Initial position and velocity per recording from a table with columns id, q0_1, qd0_1, ….

    Cells of joints that a mechanism lacks are empty. States are in the recordings' own convention.

    Args:
        path: of the table, such as a data set's `recordings.csv`.
    Returns:
        {id: (q0, qd0)}, each (joint,).
    """
    table = read_table(path)
    joints = sorted((c[3:] for c in table.columns if re.fullmatch(r"q0_\d+", c)), key=int)
    wanted = ["id", *(f"{key}_{k}" for key in ("q0", "qd0") for k in joints or ["1"])]
    missing = [c for c in wanted if c not in table.columns]
    if missing:
        raise ValueError(f"'{path}' lacks columns {missing}; found {list(table.columns)}.")
    q0, qd0 = (
        np.stack([column_numbers(table, f"{key}_{k}") for k in joints], axis=1)
        for key in ("q0", "qd0")
    )
    states: dict[str, tuple[Array, Array]] = {}
    for row, label in enumerate(table["id"].astype(str)):
        present = ~np.isnan(q0[row])
        if label in states or not present.any() or np.any(present == np.isnan(qd0[row])):
            raise ValueError(
                f"'{path}': {label!r} must come once, with q0 and qd0 of the same joints."
            )
        states[label] = (q0[row][present], qd0[row][present])
    return states


def _frozen(values: ArrayLike, key: str) -> Array:
    try:
        array = np.array(values, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ValueError(
            f"`{key}` must be a rectangular array of numbers ({error}); "
            f"every sample needs a number for every joint."
        ) from error
    array.setflags(write=False)
    return array


def _check_shapes(recording: Recording) -> None:
    time, q, names = recording.time, recording.q, recording.names
    if q.shape[1] == 0 or time.shape != q.shape[:1]:
        raise ValueError(
            f"`time` must be (time,) and `q` (time, joint) with as many samples, "
            f"got {time.shape} and {q.shape}."
        )
    for key in ("tau", "qd"):
        values = getattr(recording, key)
        if values is not None and values.shape != q.shape:
            raise ValueError(
                f"`{key}` must be shaped like `q` {q.shape}, got {values.shape}; "
                f"a single joint is `{key}[:, None]`."
            )
    if len(names) != q.shape[1] or len(set(names)) < len(names):
        raise ValueError(f"`names` must name each of {q.shape[1]} joints once, got {names}.")
    if any(not re.fullmatch(r"[^\s,#]([^,#\n]*[^\s,#])?", name) for name in names):
        raise ValueError(f"`names` must be free of commas, # and outer blanks, got {names}.")
    if recording.unit not in ("rad", "m"):
        raise ValueError(
            f"`unit` must be 'rad' or 'm', got {recording.unit!r}; "
            f"degrees are converted by `Recording.read(..., degrees=True)`."
        )
    if len(time) < MINIMUM_SAMPLES:
        raise ValueError(
            f"a recording needs at least {MINIMUM_SAMPLES} samples, got {len(time)}; "
            f"take a longer file or window."
        )


def _check_content(recording: Recording) -> None:
    for key in ("time", "q", "qd", "tau"):
        values = getattr(recording, key)
        if values is None:
            continue
        bad = np.argwhere(~np.isfinite(values))
        if len(bad):
            sample, *joint = bad[0]
            label = key + "".join(str(j + 1) for j in joint)
            raise ValueError(
                f"`{label}` must be finite, got {values[tuple(bad[0])]} at sample {sample} "
                f"({len(bad)} such values in `{key}`); cut them off or drop those rows."
            )
    stuck = np.flatnonzero(np.diff(recording.time) <= 0)
    if len(stuck):
        k = int(stuck[0])
        raise ValueError(
            f"`time` must increase, got {recording.time[k]!r} then {recording.time[k + 1]!r} s at "
            f"sample {k + 1} ({len(stuck)} such steps); sort the rows and drop repeated stamps."
        )


def _warn_of_units(recording: Recording) -> None:
    step = np.diff(recording.time)
    if np.median(step) >= 0.5:
        # At two samples a second no joint's motion can be told.
        _warn(recording, "`time` looks like milliseconds", "divide it by 1000")
        return
    if recording.unit == "m":
        return
    # A pendulum of 0.1 m falls from upright through the bottom at 20 rad/s, and of a whirling chain
    # the first link seldom goes round. So joints that all pass a full turn and one of them 30 rad/s
    # are driven wheels, or in degrees. Wrapped angles never span more than a turn.
    turns = np.ptp(recording.q, axis=0).min() / (2 * np.pi)
    speed = np.abs(np.diff(recording.q, axis=0) / step[:, None]).max()
    if turns > 1 and speed > 30.0:
        _warn(
            recording,
            f"`q` looks like degrees (every joint turns at least {turns:.1f} times, at up to "
            f"{speed:.0f} rad/s)",
            "read it with `degrees=True`",
        )


def _warn(recording: Recording, finding: str, mend: str) -> None:
    label = f"recording '{recording.name}': " if recording.name else ""
    warnings.warn(f"{label}{finding}; if so, {mend}.", RecordingWarning, stacklevel=5)

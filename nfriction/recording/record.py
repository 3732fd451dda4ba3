"""Recordings: encoder logs, validated, in SI units, one column per joint; their initial states."""

from __future__ import annotations

import hashlib
import os
import re
import reprlib
import warnings
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pkgutil import resolve_name
from typing import TYPE_CHECKING, Any, Literal, TypeAlias, Union

import numpy as np
from numpy.typing import NDArray

from nfriction.io import formats
from nfriction.io.files import shortened
from nfriction.recording.angles import AngleConvention, ConventionLike, Mechanism
from nfriction.recording.validation import Array, check, doubts, gaps, is_uniform, read_only

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

Unit = Literal["rad", "m"]


class RecordingWarning(UserWarning):
    """A recording is valid, but its units look wrong, columns are missing, or it has gaps."""


@dataclass(frozen=True, eq=False, repr=False)
class Recording:
    """Positions of a mechanism's joints over time, with torque and velocity where measured.

    Arrays are copied to read-only float64. Irregular time stamps are allowed and kept. Two
    recordings contain the same data if their `digest()` is equal.

    Without a convention, angles are in that of the plant's encoders. Motion simulated in joint
    coordinates needs `convention="relative,upright"`.

    Args:
        time: [s], increasing, shape (time,).
        q: position [rad or m, as `unit` states], shape (time, joint).
        tau: joint torque [N m, or N], shape like `q`.
        qd: measured velocity [rad/s, or m/s], shape like `q`. Fits compare it with the derivative
            of `q`, and use only the latter.
        names: one name per joint, "joint1" … by default.
        convention: of `q` and `qd`, or None for the plant's; words such as "absolute,hanging" or a
            plant become an `AngleConvention`. Torques are joint torques in every convention.
        unit: of position.
        name: of the recording, such as the file's stem.
    Raises:
        ValueError: arrays that do not fit together, NaN or infinity, stamps that do not increase,
            fewer than 8 samples.
    Warns:
        RecordingWarning: positions that look like degrees or wrapped, stamps that look like
            milliseconds or leave gaps.
    """

    time: Array
    q: Array
    tau: Array | None = None
    qd: Array | None = None
    names: tuple[str, ...] = ()
    convention: AngleConvention | None = None
    unit: Unit = "rad"
    name: str = ""

    def __post_init__(self) -> None:
        arrays = {key: getattr(self, key) for key in ("time", "q", "tau", "qd")}
        arrays = {k: None if x is None else read_only(x, k) for k, x in arrays.items()}
        convention = None if self.convention is None else AngleConvention.of(self.convention)
        joints = np.shape(arrays["q"])[-1] if np.ndim(arrays["q"]) else 0
        names = tuple(self.names) or tuple(f"joint{k + 1}" for k in range(joints))
        # A frozen dataclass can only normalise its fields this way.
        for key, value in (arrays | {"convention": convention, "names": names}).items():
            object.__setattr__(self, key, value)
        check(arrays, self.names, self.unit)
        for finding, remedy in doubts(
            self.time,
            self.q,
            self.names,
            self.unit,
            driven=self.tau is not None and bool(self.tau.any()),
        ):
            self._warn(finding, remedy, stacklevel=4)

    @property
    def joints(self) -> int:
        """Number of joints."""
        return self.q.shape[1]

    @property
    def duration(self) -> float:
        """Time from the first to the last sample [s]."""
        return float(self.time[-1] - self.time[0])

    @cached_property
    def sample_time(self) -> float:
        """Median step between samples [s]."""
        return float(np.median(np.diff(self.time)))

    @property
    def segments(self) -> list[tuple[int, int]]:
        """First and last sample of each part without a gap in time, at least two samples long."""
        pauses = gaps(self.time).tolist()
        first, last = [0, *(k + 1 for k in pauses)], [*pauses, len(self.time) - 1]
        return [(a, b) for a, b in zip(first, last, strict=True) if a < b]

    @property
    def longest_step(self) -> float:
        """Longest step between samples except gaps [s]."""
        return float(np.delete(np.diff(self.time), gaps(self.time)).max())

    @property
    def is_uniform(self) -> bool:
        """True if all steps are equal up to the rounding of the stamps."""
        return is_uniform(self.time)

    def __len__(self) -> int:
        return len(self.time)

    def __repr__(self) -> str:
        stamps = "uniform" if self.is_uniform else "irregular"
        extras = [key for key in ("tau", "qd") if getattr(self, key) is not None]
        return (
            f"Recording({self.name!r}, joints={list(self.names)}, samples={len(self)}, "
            f"duration={self.duration:.6g} s, sample_time={self.sample_time:.4g} s {stamps}, "
            f"convention={str(self.convention or 'that of the plant')!r}, unit={self.unit!r}, "
            f"with={extras})"
        )

    def __getitem__(self, samples: slice | NDArray[np.bool_]) -> Recording:
        """Samples as a recording, `recording[100:200]` or `recording[recording.time < 3]`."""
        if not isinstance(samples, slice):
            samples = np.asarray(samples)
            if samples.dtype != np.bool_ or samples.shape != self.time.shape:
                raise TypeError(
                    f"a recording is indexed by a slice of samples or a mask of {len(self)} "
                    f"booleans, got {samples.dtype} of shape {samples.shape}; columns are "
                    f"`recording.q[:, k]`."
                )
        tau = None if self.tau is None else self.tau[samples]
        qd = None if self.qd is None else self.qd[samples]
        return self._replace(time=self.time[samples], q=self.q[samples], tau=tau, qd=qd)

    def _replace(self, **changes: Any) -> Recording:
        """A changed copy that does not repeat this recording's warnings."""
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RecordingWarning)
            return replace(self, **changes)

    def resolve_convention(self, plant: Mechanism) -> AngleConvention:
        """The recording's own convention, else the plant's; for sliding joints the default one.

        Raises:
            ValueError: the recording is in metres and the plant's joints turn, or vice versa.
        """
        if self.unit != plant.unit:
            raise ValueError(
                f"{self.name or 'the recording'} is in {self.unit}, the plant's joints are in "
                f"{plant.unit}; if the recording is, too, read it with `unit={plant.unit!r}`."
            )
        if self.unit == "m":
            return AngleConvention()
        return AngleConvention.of(plant) if self.convention is None else self.convention

    def joint_coordinates(self, plant: Mechanism | None = None) -> Recording:
        """The same motion in joint coordinates: first angle from upright, the others relative.

        Args:
            plant: the recorded one; optional if the recording has a convention and its first
                column is that of a link.
        Raises:
            ValueError: neither recording nor plant have a convention, or their units differ.
        """
        convention = self.convention if plant is None else self.resolve_convention(plant)
        if self.unit == "m":
            return self
        if convention is None:
            raise ValueError(
                "the recording has no angle convention; give the plant, or read "
                "it with, for example, convention='absolute,hanging'."
            )
        # Without a plant the first column is taken to be a link, not an arm.
        first_link = 0 if plant is None else plant.first_link
        qd = None if self.qd is None else convention.rate_to_joint(self.qd, first_link)
        q = convention.position_to_joint(self.q, first_link)
        return self._replace(q=q, qd=qd, convention=AngleConvention())

    def advance_torque(self, delay: float) -> Recording:
        """The recording with its torque shifted `delay` [s] earlier; later if negative.

        For torques that a bus or a filter logs later than the positions. Samples for which no
        torque is known are cut off; torques between samples are interpolated.

        Raises:
            ValueError: there is no torque, or the delay leaves fewer than 8 samples.
        """
        if self.tau is None:
            raise ValueError(f"{self.name or 'the recording'} has no torque to advance.")
        at = self.time + delay
        known = (at >= self.time[0]) & (at <= self.time[-1])
        return self._replace(tau=self.torque_at(at))[known]

    def torque_at(self, time: Array) -> Array:
        """Torque interpolated between samples and held beyond the ends, (time, joint)."""
        if self.tau is None:
            return np.zeros((len(time), self.joints))
        return np.stack([np.interp(time, self.time, column) for column in self.tau.T], 1)

    def digest(self) -> str:
        """SHA-256 of the content in hexadecimal: arrays, joint names, convention and unit."""
        convention = None if self.convention is None else str(self.convention)
        digest = hashlib.sha256(repr((self.names, convention, self.unit)).encode())
        for key in ("time", "q", "tau", "qd"):
            values = getattr(self, key)
            digest.update(f"{key} {None if values is None else values.shape}".encode())
            if values is not None:
                # Adding zero turns -0.0 into 0.0, which it equals.
                digest.update((values + 0.0).astype("<f8").tobytes())
        return digest.hexdigest()

    def to_pandas(self) -> pd.DataFrame:
        """Table with columns time, q1 …, qd1 …, tau1 …; `attrs` hold unit, names and convention."""
        import pandas as pd  # slow to import

        columns = {"time": self.time}
        for key in ("q", "qd", "tau"):
            values = getattr(self, key)
            if values is not None:
                columns |= {f"{key}{k + 1}": values[:, k] for k in range(self.joints)}
        table = pd.DataFrame(columns)
        table.attrs = {"unit": self.unit, "names": ", ".join(self.names)}
        if self.convention is not None:
            table.attrs["convention"] = str(self.convention)
        return table

    def plot(self) -> Figure:
        """Positions over time, one panel per joint; see `plots.motion`."""
        # By name, because plots is a layer above this one.
        figure: Figure = resolve_name("nfriction.plots:motion")(self)
        return figure

    @classmethod
    def from_pandas(
        cls,
        table: pd.DataFrame,
        *,
        columns: Mapping[str, str] | None = None,
        degrees: bool = False,
        convention: ConventionLike | None = None,
        unit: Unit | None = None,
        name: str = "",
        plant: Mechanism | None = None,
    ) -> Recording:
        """Recording from a table with columns time, q1 …, and perhaps qd1 … and tau1 ….

        Rows without a number in a column that is read are left out; most rows must have them all.
        If some joints have a torque, the others are taken to be undriven, with zero torque.
        Velocity is read if every joint has it; other columns are ignored. In place of q1 and tau1
        the table may have motor1, the angle of the joint's motor [rad], and current1 [A], which the
        plant's `Motor` converts.

        Args:
            table: one row per sample.
            columns: the table's names for ours, optionally with a unit after a colon,
                {"time": "t:ms", "q1": "enc_1:deg"}. Units: s, ms, us, ns; rad, mrad, deg, rev,
                counts/8192 (any number per revolution), m, cm, mm, um; these per second, rpm;
                N m, mN m, N cm, N, mN, kN; A, mA; min. One in the name, "angle [deg]", is read.
            degrees: positions and velocities without a unit are in degrees.
            convention: of the angles, such as "absolute,hanging" or ("absolute", "hanging"), an
                `AngleConvention`, or a plant; by default `table.attrs["convention"]`, or None for
                that of the plant in whose fit or score the recording is used.
            unit: of position; by default `table.attrs["unit"]`, the plant's, or rad.
            name: of the recording.
            plant: the mechanism, for its motors.
        Warns:
            RecordingWarning: rows that are left out, velocity or torque of some joints only, unread
                columns that look like torque; and as `Recording`.
        """
        _check_columns(columns)
        if not hasattr(table, "attrs"):
            raise TypeError(f"`table` must be a pandas.DataFrame, got {type(table).__name__}.")
        attributes = table.attrs
        convention = attributes.get("convention") if convention is None else convention
        factors = None if plant is None else plant.motor_factors
        arrays, slides, remarks, of_motors, has_unit = formats.table_arrays(
            table, columns, degrees=degrees, motor_factors=factors
        )
        if of_motors and plant is not None and arrays["q"].shape[1] > plant.first_link + 1:
            angles = AngleConvention.of(plant if convention is None else convention).angles
            if angles == "absolute":
                raise ValueError(
                    "motors turn their joints, so their angles are relative to the previous link, "
                    "but the convention is absolute; give a relative one, such as "
                    "`convention=('relative', 'hanging')`."
                )
        found: Unit | None = None if slides is None else "m" if slides else "rad"
        # "deg" in the file means the same as `degrees`.
        written = None if degrees and attributes.get("unit") == "deg" else attributes.get("unit")
        unit = unit or written or found or ("m" if plant and plant.unit == "m" else "rad")
        if found and found != unit:
            raise ValueError(
                f"`unit` is {unit!r}, but the columns are in {found!r}; drop one of the two."
            )
        # Angles of motors are converted before their screws turn them into lengths.
        if degrees and unit == "m" and (not of_motors or "qd" in arrays):
            raise ValueError("`degrees=True` needs angles, but `unit` is 'm'; drop one of the two.")
        # One text, because CSV comments and Parquet metadata cannot contain lists.
        names = [part.strip() for part in str(attributes.get("names", "")).split(",")]
        with warnings.catch_warnings():
            # A wheel may turn far and fast; this doubt is about a missing unit.
            if has_unit:
                warnings.filterwarnings("ignore", ".*looks like degrees", RecordingWarning)
            convention = None if convention is None else AngleConvention.of(convention)
            label = tuple(filter(None, names))
            try:
                recording = cls(**arrays, names=label, convention=convention, unit=unit, name=name)
            except ValueError as error:
                lacking = len(table) - len(arrays["time"])
                before = f" {lacking} rows without a number were left out before." * bool(lacking)
                raise ValueError(f"{error}{before}") from error
        for finding, remedy in remarks:
            recording._warn(finding, remedy, stacklevel=3)
        return recording

    @classmethod
    def read(
        cls,
        path: str | os.PathLike[str],
        *,
        columns: Mapping[str, str] | None = None,
        degrees: bool = False,
        convention: ConventionLike | None = None,
        unit: Unit | None = None,
        name: str | None = None,
        plant: Mechanism | None = None,
    ) -> Recording:
        """Recording from a file: CSV, TSV, TXT, Parquet, NPZ, MATLAB, HDF5 or MDF4.

        The ending selects the format: .csv, .csv.gz, .tsv, .txt, .parquet, .npz, .mat, .h5, .hdf5
        or .mf4.

        A CSV file may begin with comment lines `# convention: absolute,hanging` and `# unit: rad`;
        arguments override the file. Cells may be separated by commas, semicolons, tabs or blanks,
        like the header; numbers may have decimal commas, and thousands separated by the other
        sign. If all are like `35,000`, a unit in counts or a line `# decimal: .` decides; otherwise
        the sign is guessed with a warning. Units in a row under the header, or in the header as in
        `time [ms]`, are used. Arrays of .mat and .h5 files are named by their path, `data.Y.q1`,
        `enc[0]`; signals of dSPACE ControlDesk by their names. The recording is named after the
        file, without its ending.

        Args:
            columns, degrees, convention, unit, name, plant: as for `from_pandas`.
        Warns:
            RecordingWarning: a guessed decimal sign; and as `from_pandas`.
        Raises:
            FileNotFoundError: there is no such file.
            ImportError: a format whose library is not installed.
            ValueError: broken content or missing columns; names the file.
        """
        # Before the file is read, so that the message for a wrong argument does not name the file.
        _check_columns(columns)
        if convention is not None:
            convention = AngleConvention.of(convention)
        table = formats.read_table(path, list((columns or {}).values()))
        try:
            return cls.from_pandas(
                table, columns=columns, degrees=degrees, convention=convention, unit=unit,
                name=formats.stem(path) if name is None else name, plant=plant,
            )  # fmt: skip
        except ValueError as error:
            raise ValueError(f"'{path}': {shortened(error, 2000)}") from error

    @classmethod
    def of(
        cls, given: RecordingLike, *, plant: Mechanism | None = None, name: str = ""
    ) -> Recording:
        """A recording as it is, or read from a file or a table with columns time, q1, ….

        Args:
            given: a recording, a path, or a table.
            plant: see `from_pandas`.
            name: of a recording from a table.
        Raises:
            TypeError: for anything else; for arrays use `Recording(time, q)`.
        """
        if isinstance(given, Recording):
            return given
        if isinstance(given, str | os.PathLike):
            return cls.read(given, plant=plant)
        # Recognises a table without importing pandas, which is slow.
        if not (hasattr(given, "columns") and hasattr(given, "attrs")):
            raise TypeError(
                "a recording is a Recording, the path of a file, or a table with columns time, q1, "
                f"…, got {type(given).__name__} {reprlib.repr(given)}; `Recording(time, q)` makes "
                "one from arrays."
            )
        return cls.from_pandas(given, plant=plant, name=name)

    @classmethod
    def many(
        cls,
        given: RecordingLike | Iterable[RecordingLike],
        *,
        plant: Mechanism | None = None,
        name: str = "table",
    ) -> list[Recording]:
        """Recordings from one or several arguments of `of`; tables are called `name` 1, 2, …."""
        # Iteration over a path gives its letters, over a table its columns.
        single = isinstance(given, Recording | str | os.PathLike) or hasattr(given, "columns")
        listed: Iterable[Any] = [given]
        if not single and isinstance(given, Iterable):
            listed = given
        return [cls.of(one, plant=plant, name=f"{name} {k}") for k, one in enumerate(listed, 1)]

    def write(self, path: str | os.PathLike[str]) -> None:
        """Write to .csv, .csv.gz, .parquet or .npz atomically; `read` restores it."""
        formats.write_table(self.to_pandas(), path)

    def _warn(self, finding: str, remedy: str, *, stacklevel: int) -> None:
        # With many recordings the message must name the one.
        label = f"recording '{self.name}': " if self.name else ""
        warnings.warn(f"{label}{finding}; {remedy}.", RecordingWarning, stacklevel=stacklevel)


# Not with `|`, because pandas is slow to import.
RecordingLike: TypeAlias = Union[Recording, str, "os.PathLike[str]", "pd.DataFrame"]


def read_initial_states(
    path: str | os.PathLike[str], *, degrees: bool = False
) -> dict[str, tuple[Array, Array]]:
    """Initial position and velocity per recording from a table with columns id, q0_1, qd0_1, ….

    Cells for joints that a mechanism lacks are empty. Angles are in the recordings' convention.

    Args:
        path: of the table, such as a data set's `recordings.csv`.
        degrees: positions and velocities are in degrees.
    Returns:
        {id: (q0, qd0)} in SI, each (joint,).
    Raises:
        ValueError: missing columns, or an incomplete or repeated state.
    """
    table = formats.read_table(path)
    joints = sorted((c[3:] for c in table.columns if re.fullmatch(r"q0_[0-9]{1,4}", c)), key=int)
    wanted = ["id", *(f"{key}_{k}" for key in ("q0", "qd0") for k in joints or ["1"])]
    missing = [c for c in wanted if c not in table.columns]
    if missing:
        raise ValueError(
            f"'{path}' lacks columns {_listed(missing)}; found {_listed(table.columns)}."
        )
    try:
        q0, qd0 = (
            np.stack([formats.column_numbers(table, f"{key}_{k}") for k in joints], axis=1)
            for key in ("q0", "qd0")
        )
    except ValueError as error:
        raise ValueError(f"'{path}': {error}") from error
    if degrees:
        q0, qd0 = np.deg2rad(q0), np.deg2rad(qd0)
    states: dict[str, tuple[Array, Array]] = {}
    ids = table["id"]
    for row, (label, lost) in enumerate(zip(ids.astype(str), ids.isna(), strict=True)):
        if lost or not label:
            raise ValueError(f"'{path}': row {row + 1} has no id.")
        state = np.stack([q0[row], qd0[row]])
        # Some mechanisms of a table may have fewer joints than the table has columns.
        present = ~np.isnan(state[0])
        sound = np.array_equal(present, ~np.isnan(state[1])) and not np.isinf(state).any()
        if label in states or not present.any() or not sound:
            raise ValueError(
                f"'{path}': {label[:60]!r} must come once, with finite q0 and qd0 of the same "
                f"joints."
            )
        states[label] = (state[0, present], state[1, present])
    if not states:
        raise ValueError(f"'{path}' has no rows; write one per recording with {', '.join(wanted)}.")
    return states


def _check_columns(columns: object) -> None:
    if not isinstance(columns, Mapping | None):
        raise ValueError(f'`columns` must be like {{"q1": "enc:deg"}}, got {columns!r}.')


def _listed(names: Iterable[str]) -> str:
    """Names from a file, which may be many and long."""
    return ", ".join(str(name)[:60] for name in list(names)[:30])

"""What a recording must fulfil: shapes, content; units and stamps that look right."""

from __future__ import annotations

import re
import warnings
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

if TYPE_CHECKING:
    from nfriction.recording.record import Recording

Array = NDArray[np.float64]

MINIMUM_SAMPLES = 8
# In no unit is a measurement larger; squares and differences of it are finite.
LARGEST_VALUE = 1e30
# No recording lasts eleven days: such a stamp is a clock's [s].
LARGE_STAMP = 1e6


class RecordingWarning(UserWarning):
    """A recording is valid but looks as if its units were not SI, lacks columns, or has gaps."""


def is_uniform(time: Array) -> bool:
    """Whether all steps between stamps are alike.

    Stamps rounded to a microsecond at 1 kHz differ by 1e-3 of a step; real jitter is larger.
    """
    step = np.diff(time)
    return bool(np.all(np.abs(step - np.median(step)) <= 2e-3 * np.median(step)))


def frozen(values: ArrayLike, key: str) -> Array:
    try:
        # First as it is, for a tensor knows no copy.
        array = np.array(np.asarray(values), dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ValueError(
            f"`{key}` must be a rectangular array of numbers ({error}); "
            f"every sample needs a number for every joint."
        ) from error
    array.setflags(write=False)
    return array


def check_shapes(recording: Recording) -> None:
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


def check_content(recording: Recording) -> None:
    for key in ("time", "q", "qd", "tau"):
        values = getattr(recording, key)
        if values is None:
            continue
        # NaN is in no order with anything.
        bad = np.argwhere(~(np.abs(values) <= LARGEST_VALUE))
        if len(bad):
            sample, *joint = bad[0]
            label = key + "".join(str(j + 1) for j in joint)
            value = values[tuple(bad[0])]
            rule = f"within {LARGEST_VALUE:g}" if np.isfinite(value) else "finite"
            raise ValueError(
                f"`{label}` must be {rule}, got {value} at sample {sample} "
                f"({len(bad)} such values in `{key}`); cut them off or drop those rows."
            )
    stuck = np.flatnonzero(np.diff(recording.time) <= 0)
    if len(stuck):
        k = int(stuck[0])
        before, after = float(recording.time[k]), float(recording.time[k + 1])
        # Stamps of a clock of many digits repeat where a logger wrote fewer.
        rounded = before == after and abs(after) >= LARGE_STAMP
        mend = (
            "write so large stamps with more digits, or count from the recording's start"
            if rounded
            else "sort the rows and drop repeated stamps"
        )
        raise ValueError(
            f"`time` must increase, got {before!r} then {after!r} s at sample {k + 1} "
            f"({len(stuck)} such steps); {mend}."
        )


def gaps_in(time: Array) -> NDArray[np.intp]:
    """Samples after which the recording pauses."""
    step = np.diff(time)
    # Logs from computers without a real-time system jitter by up to three steps.
    return np.flatnonzero(step > 5 * np.median(step))


def warn_of_gaps(recording: Recording) -> None:
    gaps = gaps_in(recording.time)
    if len(gaps):
        step = np.diff(recording.time)[gaps]
        k = int(np.argmax(step))
        _warn(
            recording,
            f"`time` has gaps ({len(gaps)}), the longest of {step[k]:.4g} s at "
            f"{recording.time[gaps[k]]:.6g} s",
            "no simulation crosses them; each starts anew behind one",
        )


def warn_of_units(recording: Recording) -> None:
    step = np.diff(recording.time)
    if np.median(step) >= 0.5:
        # At two samples a second no joint's motion can be told.
        _warn(recording, "`time` looks like milliseconds", "if so, divide it by 1000")
        return
    if recording.unit == "m":
        return
    # A pendulum of 0.1 m falls from upright through the bottom at 20 rad/s, and of a whirling chain
    # the first link seldom goes round. So joints that all pass a full turn and one of them 30 rad/s
    # are driven wheels, or in degrees. Wrapped angles never span more than a turn.
    turns = np.ptp(recording.q, axis=0).min() / (2 * np.pi)
    with np.errstate(over="ignore"):  # stamps may be as close as numbers get
        speed = np.abs(np.diff(recording.q, axis=0) / step[:, None]).max()
    if turns > 1 and speed > 30.0:
        _warn(
            recording,
            f"`q` looks like degrees (every joint turns at least {turns:.1f} times, at up to "
            f"{speed:.0f} rad/s)",
            "if so, read it with `degrees=True`",
        )


def warn_of_wrapping(recording: Recording) -> None:
    if recording.unit == "m":
        return
    step = np.abs(np.diff(recording.q, axis=0))
    step[gaps_in(recording.time)] = 0.0
    # A jump of about a turn between steps that are short: no joint starts and stops so fast, in
    # degrees neither.
    short = np.pad(step < np.pi / 2, ((1, 1), (0, 0)), constant_values=True)
    jumps = (np.abs(step - 2 * np.pi) < np.pi / 2) & short[:-2] & short[2:]
    count = jumps.sum(axis=0)
    if count.any():
        names = ", ".join(name for name, n in zip(recording.names, count, strict=True) if n)
        _warn(
            recording,
            f"`q` of {names} looks wrapped ({count.sum()} jumps of about a turn)",
            "if so, unwrap it with `numpy.unwrap(q, axis=0)`",
        )


def warn_of_columns(recording: Recording, remarks: Sequence[tuple[str, str]]) -> None:
    """Pass on what a table's columns left open: findings, and the mend of each."""
    for finding, mend in remarks:
        _warn(recording, finding, mend, stacklevel=4)


def _warn(recording: Recording, finding: str, mend: str, *, stacklevel: int = 5) -> None:
    label = f"recording '{recording.name}': " if recording.name else ""
    warnings.warn(f"{label}{finding}; {mend}.", RecordingWarning, stacklevel=stacklevel)

"""Requirements on recorded arrays, and signs that their units or time stamps are wrong."""

import math
import re
from collections.abc import Iterator, Mapping, Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

MINIMUM_SAMPLES = 8
# No measurement is larger in any unit; its squares and differences are finite.
LARGEST_VALUE = 1e30
# No recording lasts eleven days: a larger stamp comes from a clock [s].
LARGE_STAMP = 1e6


def is_uniform(time: Array) -> bool:
    """True if all steps between stamps are equal up to rounding.

    Stamps rounded to a microsecond at 1 kHz differ by 1e-3 of a step; real jitter is larger.
    """
    step = np.diff(time)
    return bool(np.all(np.abs(step - np.median(step)) <= 2e-3 * np.median(step)))


def gaps(time: Array) -> NDArray[np.intp]:
    """Samples after which the recording pauses."""
    step = np.diff(time)
    # Logs from computers without a real-time system jitter by up to three steps.
    return np.flatnonzero(step > 5 * np.median(step))


def read_only(values: ArrayLike, key: str) -> Array:
    """A read-only float64 copy."""
    try:
        if isinstance(values, np.ma.MaskedArray):
            values = np.ma.filled(values.astype(np.float64), np.nan)  # missing, as in a table
        # `asarray` first, because a tensor does not accept `copy`.
        array = np.array(np.asarray(values), dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ValueError(
            f"`{key}` must be a rectangular array of numbers ({error}); "
            f"every sample needs a number for every joint."
        ) from error
    # Recordings are shared between fits, and their digest must stay valid.
    array.setflags(write=False)
    return array


def check(arrays: Mapping[str, Array | None], names: Sequence[str], unit: str) -> None:
    """Raise ValueError unless arrays time, q, tau, qd, joint names and unit make a recording."""
    time, q = arrays["time"], arrays["q"]
    assert time is not None
    assert q is not None
    if q.ndim != 2:
        raise ValueError(
            f"`q` must be (time, joint), got shape {q.shape}; a single joint is `q[:, None]`."
        )
    if q.shape[1] == 0 or time.shape != q.shape[:1]:
        raise ValueError(
            f"`time` must be (time,) and `q` (time, joint) with as many samples, "
            f"got {time.shape} and {q.shape}."
        )
    for key in ("tau", "qd"):
        values = arrays[key]
        if values is not None and values.shape != q.shape:
            raise ValueError(
                f"`{key}` must be shaped like `q` {q.shape}, got {values.shape}; "
                f"a single joint is `{key}[:, None]`."
            )
    if len(names) != q.shape[1] or len(set(names)) < len(names):
        raise ValueError(f"`names` must name each of {q.shape[1]} joints once, got {names}.")
    # Names are written in CSV headers and comments, and must be recovered from them.
    if any(not re.fullmatch(r"[^\s,#]([^,#\n]*[^\s,#])?", name) for name in names):
        raise ValueError(f"`names` must be free of commas, # and outer blanks, got {names}.")
    if unit not in ("rad", "m"):
        raise ValueError(
            f"`unit` must be 'rad' or 'm', got {unit!r}; "
            f"`Recording.read(..., degrees=True)` converts degrees."
        )
    if len(time) < MINIMUM_SAMPLES:
        raise ValueError(
            f"a recording needs at least {MINIMUM_SAMPLES} samples, got {len(time)}; "
            f"take a longer file or window."
        )
    for key, values in arrays.items():
        if values is None:
            continue
        # The negation also catches NaN.
        bad = np.argwhere(~(np.abs(values) <= LARGEST_VALUE))
        if len(bad):
            sample, *joint = bad[0]
            label = key + "".join(str(j + 1) for j in joint)
            value = values[tuple(bad[0])]
            rule = f"within {LARGEST_VALUE:g}" if np.isfinite(value) else "finite"
            raise ValueError(
                f"`{label}` must be {rule}, got {value} at sample {sample} ({len(bad)} in all); "
                "remove these rows with their times; a recording may lack samples."
            )
    _check_stamps(time)
    # No encoder has steps of a radian.
    if unit == "rad" and np.ptp(q) > 1 and (q == np.rint(q)).all():
        raise ValueError(
            f"`q` must be in radians, got only whole numbers, from {q.min():g} to {q.max():g}; "
            "state the unit: counts per turn with the column, as in q1=q1:counts/8192, or degrees."
        )


def restarts(time: Array) -> bool:
    """True if stamps fall by many rows, and seldom: the clock starts again; else rows are unsorted.

    Sorted, the rows of both parts would lie between each other.
    """
    back = np.flatnonzero(np.diff(time) < 0)
    if not 0 < len(back) * MINIMUM_SAMPLES < len(time) or back[0] < MINIMUM_SAMPLES:
        return False
    return bool((time[back + 1] <= time[back - MINIMUM_SAMPLES]).all())


def _check_stamps(time: Array) -> None:
    steps = np.diff(time)
    if (steps > 0).all():
        return
    # Steps back explain more than repeated stamps do.
    k = int(np.argmax(steps < 0) if (steps < 0).any() else np.argmax(steps <= 0))
    before, after = float(time[k]), float(time[k + 1])
    if before > after:
        remedy = "sort the rows and drop repeated stamps"
        if restarts(time):
            remedy = (
                "the clock starts again there, so read each part of the file as a recording of its "
                "own; if a counter overflows, unwrap it (`numpy.unwrap`)"
            )
    elif abs(after) >= LARGE_STAMP:
        # The stamps of a clock have more digits than the logger wrote.
        remedy = "write large stamps with more digits, or count from the recording's start"
    else:
        remedy = "drop repeated rows; if their positions differ, write stamps with more digits"
    raise ValueError(
        f"`time` must increase, got {before!r} then {after!r} s at sample {k + 1} "
        f"({(steps <= 0).sum()} such steps); {remedy}."
    )


def doubts(
    time: Array, q: Array, names: Sequence[str], unit: str, *, driven: bool
) -> Iterator[tuple[str, str]]:
    """Signs that units or time stamps are wrong, each with its remedy."""
    step = np.diff(time)
    pauses = gaps(time)
    if slow := time_unit(time):
        short, plain, _ = slow
        yield (
            f"`time` looks like {plain}",
            f'if so, divide it, or read it with columns={{"time": "time:{short}"}}',
        )
    if len(pauses):
        k = int(pauses[np.argmax(step[pauses])])
        # A logger that pauses so often stamps packets of samples when they arrive.
        packets = "; if samples came in packets, give them even times" * (10 * len(pauses) > len(q))
        yield (
            f"`time` has gaps ({len(pauses)}), the longest of {step[k]:.4g} s at {time[k]:.6g} s",
            f"no simulation crosses them; a new one starts after each{packets}",
        )
    held = held_samples(q)
    if (held > 1).any():
        slow_joints = ", ".join(name for name, n in zip(names, held, strict=True) if n > 1)
        rows = int(held.max())
        yield (
            f"each position of {slow_joints} is repeated for about {rows} samples, probably "
            "because the sensor is slower than the log",
            f"if so, keep only rows with new values, as `recording[::{rows}]` does: repeated "
            "values look like a joint that stops and jumps",
        )
    if unit == "m":
        return
    # A pendulum of 0.1 m falls from upright through the bottom at 20 rad/s, and the first link of a
    # whirling chain seldom turns over. So if all joints exceed a full turn and one of them 30
    # rad/s, they are in degrees, or driven wheels: recorded torques then show the unit of the
    # angles. Wrapped angles never span more than a turn.
    turns = np.ptp(q, axis=0).min() / (2 * np.pi)
    with np.errstate(over="ignore"):  # stamps may be arbitrarily close
        speed = np.abs(np.diff(q, axis=0) / step[:, None]).max()
    if turns > 1 and speed > 30.0 and not slow and not driven:
        yield (
            f"`q` looks like degrees or encoder counts (every joint turns at least {turns:.1f} "
            f"times, at up to {speed:.0f} rad/s)",
            "if so, read it with `degrees=True`, or state the counts per turn, as in "
            'columns={"q1": "q1:counts/8192"}, or radians with columns={"q1": "q1:rad"}',
        )
    jumps = turns_between_samples(q, pauses)
    if jumps.any():
        wrapped = ", ".join(name for name, n in zip(names, jumps, strict=True) if n)
        yield (
            f"`q` of {wrapped} looks wrapped ({jumps.sum()} jumps of about a turn)",
            "if so, unwrap it with `numpy.unwrap(q, axis=0)`",
        )


def time_unit(time: Array) -> tuple[str, str, float] | None:
    """The unit that stamps seem to have: short, in words, per second; None if they are in s.

    A joint's motion cannot be observed at two samples per second; logs have 15 to 15,000.
    """
    step = float(np.median(np.diff(time)))
    units = ("ms", "milliseconds", 1e3), ("us", "microseconds", 1e6), ("ns", "nanoseconds", 1e9)
    return units[min(2, int(math.log(15 * step, 1000)))] if step >= 0.5 else None


def held_samples(q: Array) -> NDArray[np.intp]:
    """Samples for which each new position is held, (joint,); 1 if values are not repeated.

    A joint that moves by two counts or more from one sample to the next hardly rests at the samples
    before and after. If most such steps lie between two samples of rest, values are repeated.
    """
    held = np.ones(q.shape[1], dtype=np.intp)
    for joint, step in enumerate(np.abs(np.diff(q, axis=0)).T):
        moves = np.flatnonzero(step[1:-1] > 1.5 * np.min(step[step > 0], initial=np.inf)) + 1
        alone = (step[moves - 1] == 0) & (step[moves + 1] == 0)
        if len(moves) >= MINIMUM_SAMPLES and alone.mean() > 0.5:
            held[joint] = max(2, round(float(np.median(np.diff(moves)))))
    return held


def turns_between_samples(q: Array, pauses: NDArray[np.intp]) -> NDArray[np.intp]:
    """Jumps of about a turn between small steps, (joint,): no joint starts and stops so fast."""
    step = np.abs(np.diff(q, axis=0))
    # Across a gap any number of turns is possible.
    step[pauses] = 0.0
    short = np.pad(step < np.pi / 2, ((1, 1), (0, 0)), constant_values=True)
    jumps = (np.abs(step - 2 * np.pi) < np.pi / 2) & short[:-2] & short[2:]
    return jumps.sum(axis=0)

"""Motion: position, velocity and acceleration over time."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False, repr=False)
class Motion:
    """Position, velocity and acceleration of every joint over time.

    Args:
        time: [s], shape (time,).
        q: position [rad], shape (time, joint).
        qd: velocity [rad/s], shape like `q`.
        qdd: acceleration [rad/s²], shape like `q`.
        std: standard deviations of `q`, `qd` and `qdd` where the method knows them.
    """

    time: Array
    q: Array
    qd: Array
    qdd: Array
    std: Motion | None = None

    def __repr__(self) -> str:
        known = "" if self.std is None else ", with std"
        duration = self.time[-1] - self.time[0]
        samples, joints = self.q.shape
        return f"Motion(joints={joints}, samples={samples}, duration={duration:.6g} s{known})"


def check_motion(time: ArrayLike, q: ArrayLike) -> tuple[Array, Array]:
    """Time (time,) and positions (time, joint) as float64, checked.

    Raises:
        ValueError: wrong shapes, fewer than 8 samples, NaN, or time that does not increase.
    """
    time, q = np.asarray(time, dtype=np.float64), np.asarray(q, dtype=np.float64)
    if q.ndim != 2 or time.shape != q.shape[:1]:
        raise ValueError(
            f"`time` must be (time,) and `q` (time, joint), got {time.shape} and {q.shape}; "
            f"a single joint is `q[:, None]`."
        )
    if len(time) < 8:
        raise ValueError(f"at least 8 samples are needed, got {len(time)}.")
    if not (np.isfinite(q).all() and np.isfinite(time).all() and np.all(np.diff(time) > 0)):
        raise ValueError(
            "`time` and `q` must be finite and `time` increasing; `Recording` shows where not."
        )
    return time, q

"""Share of a twin's friction torque that the inputs of a network cannot explain."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from nfriction.papers.twin.dataset import Split, Twin

Array = NDArray[np.float64]

SPEED_CELLS, ACCELERATION_CELLS = 40, 6


def missed_torque(twin: Twin) -> dict[str, float]:
    """Share of the true friction torque that tables over speed, and acceleration too, miss.

    A table holds the mean torque of cells with equally many samples of the training motion and
    predicts the torque along the test motion. No coefficients of the same inputs can do much
    better, so this is the cost of the inputs, whatever the network.

    Args:
        twin: with releases of both splits; its truth is only judged by.

    Returns:
        Root mean square error over that of the torque, averaged over the joints, of "speed" and of
        "speed and acceleration" (along the motion).
    """
    train, test = _motion(twin, "train"), _motion(twin, "test")
    shares = [_shares(train[:, :, k], test[:, :, k]) for k in range(twin.plant.joints)]
    speed, both = np.mean(shares, axis=0).tolist()
    return {"speed": speed, "speed and acceleration": both}


def _motion(twin: Twin, split: Split) -> Array:
    """Speed, acceleration and friction torque along the motion, (3, sample, joint)."""
    of = [twin.truth[label] for label, own in twin.splits.items() if own == split]
    qd, qdd, tau_f = (np.concatenate([getattr(m, k) for m in of]) for k in ("qd", "qdd", "tau_f"))
    return np.stack([qd, qdd, tau_f]) * np.sign(qd)


def _shares(train: Array, test: Array) -> tuple[float, float]:
    """Shares of one joint's torque that the two tables miss."""
    speed, acceleration = (
        [np.digitize(of[k], np.quantile(train[k], np.linspace(0, 1, n + 1)[1:-1]))
         for of in (train, test)]
        for k, n in enumerate((SPEED_CELLS, ACCELERATION_CELLS))
    )  # fmt: skip
    both = [ACCELERATION_CELLS * v + a for v, a in zip(speed, acceleration, strict=True)]
    # Cells that training never visited have no mean to judge.
    seen = np.isin(both[1], both[0])
    wanted = test[2, seen]

    def missed(cells: list[NDArray[np.int64]]) -> float:
        known, judged = cells
        mean = np.bincount(known, train[2]) / np.maximum(np.bincount(known), 1)
        return float(np.sqrt(np.mean((mean[judged[seen]] - wanted) ** 2) / np.mean(wanted**2)))

    return missed(speed), missed(both)

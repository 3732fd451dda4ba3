"""Initial states of free runs."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from nfriction.io import formats

Array = NDArray[np.float64]


def read_initial_states(
    path: str | os.PathLike[str], *, degrees: bool = False
) -> dict[str, tuple[Array, Array]]:
    """Initial position and velocity per recording from a table with columns id, q0_1, qd0_1, ….

    Cells of joints that a mechanism lacks are empty. Angles are in the recordings' convention.

    Args:
        path: of the table, such as a data set's `recordings.csv`.
        degrees: positions and velocities are in degrees.
    Returns:
        {id: (q0, qd0)} in SI, each (joint,).
    Raises:
        ValueError: missing columns, or a state that is incomplete or comes twice.
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
        # Mechanisms of one table may have fewer joints than it has columns.
        present = ~np.isnan(state[0])
        sound = np.array_equal(present, ~np.isnan(state[1])) and not np.isinf(state).any()
        if label in states or not present.any() or not sound:
            raise ValueError(
                f"'{path}': {label[:60]!r} must come once, with finite q0 and qd0 of the same "
                f"joints."
            )
        states[label] = (state[0, present], state[1, present])
    return states


def _listed(names: Iterable[str]) -> str:
    """Names from a file, which may be many and long."""
    return ", ".join(str(name)[:60] for name in list(names)[:30])

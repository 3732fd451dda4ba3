"""Normal equations of windows that share variables and have own ones (states, offsets)."""

from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple

import torch
from torch import Tensor


class Rows(NamedTuple):
    """Rows of the Jacobian at some samples (`part`) of all windows.

    Columns are the shared variables, then each window's own (`DecisionVariables.indices`). `scaled`
    are rows of the scaled errors, (window, row, column); `states` those of the positions, and at
    the end of a window of the velocities, in joint coordinates, (window, sample, row, column).
    """

    part: slice
    scaled: Tensor
    states: Tensor


def scaled_rows(
    pieces: Iterable[tuple[slice, Tensor]], scale: Tensor, measurement: Tensor, indices: Tensor
) -> Iterator[Rows]:
    """Rows of the Jacobian from derivatives of the positions, see `propagate`.

    `scale` is 1 over the noise of each error, (window, sample, joint or 1).
    """
    joints, shared, own = len(measurement), int(indices[0, 0]), indices.shape[1]
    for part, rows in pieces:
        if own > 2 * joints:
            # An encoder offset moves the initial position and the measured ones.
            measured = torch.eye(rows.shape[2], joints, dtype=torch.float64)
            rows = torch.cat([rows, rows[..., shared : shared + joints] - measured], -1)
        scaled = (measurement @ rows[:, :, :joints]) * scale[:, part, :, None]
        yield Rows(part, scaled.flatten(1, 2), rows)


def normal_equations(
    rows: Iterable[Rows], r: Tensor, indices: Tensor, size: int
) -> tuple[Tensor, Tensor, Tensor]:
    """J^T r and J^T J of all variables, and derivatives of the windows' final states.

    `r` are the scaled errors, (window, sample, joint); the last result is (window, 2 joint,
    column).
    """
    windows, count = indices.shape
    shared = int(indices[0, 0])
    gradient = torch.zeros(size, dtype=torch.float64)
    hessian = torch.zeros(size, size, dtype=torch.float64)
    slope = torch.zeros(windows, count, dtype=torch.float64)
    mixed = torch.zeros(windows, count, shared, dtype=torch.float64)
    curvature = torch.zeros(windows, count, count, dtype=torch.float64)
    ends = torch.zeros(0, dtype=torch.float64)
    for part, scaled, states in rows:
        common, own = scaled.split([shared, count], -1)
        errors, flat = r[:, part].flatten(1), common.flatten(0, 1)
        gradient[:shared] += errors.flatten() @ flat
        hessian[:shared, :shared] += flat.T @ flat
        slope += (errors[:, None] @ own)[:, 0]
        mixed += own.mT @ common
        curvature += own.mT @ own
        ends = states[:, -1]
    _scatter(gradient, hessian, indices, slope, mixed, curvature)
    return gradient, hessian, ends


def add_defects(
    gradient: Tensor,
    hessian: Tensor,
    defects: Tensor,
    ends: Tensor,
    pairs: Sequence[tuple[int, int]],
    indices: Tensor,
    sd: Tensor,
) -> None:
    """Add the defects between windows to normal equations, in place.

    `defects` are over their standard deviations `sd`, (pair, 2 joint) and (2 joint,); `ends` come
    from `normal_equations`.
    """
    shared, state = int(indices[0, 0]), len(sd)
    before, after = ([pair[k] for pair in pairs] for k in (0, 1))
    start = -torch.eye(state, dtype=torch.float64).expand(len(pairs), -1, -1)
    rows = torch.cat([ends[before], start], -1) / sd[:, None]
    common, own = rows[..., :shared], rows[..., shared:]
    flat = common.flatten(0, 1)
    gradient[:shared] += defects.flatten() @ flat
    hessian[:shared, :shared] += flat.T @ flat
    both = torch.cat([indices[before], indices[after, :state]], -1)
    _scatter(gradient, hessian, both, (defects[:, None] @ own)[:, 0], own.mT @ common, own.mT @ own)


def _scatter(
    gradient: Tensor, hessian: Tensor, indices: Tensor, slope: Tensor, mixed: Tensor, own: Tensor
) -> None:
    """Add blocks of the windows' own variables where `indices` names them, in place."""
    rows, shared = indices[:, :, None], torch.arange(mixed.shape[-1])
    gradient.index_put_((indices,), slope, accumulate=True)
    hessian.index_put_((rows, shared), mixed, accumulate=True)
    hessian.index_put_((shared, rows), mixed, accumulate=True)
    hessian.index_put_((rows, indices[:, None]), own, accumulate=True)

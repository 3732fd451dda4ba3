"""Normal equations of windows that share parameters and have states of their own.

Unknowns are ordered as [what is shared, states of each window, zeros of each recording].
"""

from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple

import torch
from torch import Tensor


class Rows(NamedTuple):
    """Rows of the Jacobian at some samples of all windows.

    Attributes:
        part: which samples.
        scaled: of the scaled errors, (window, row, column); columns are what is shared, then what
            `places` of `normal_equations` names.
        states: of the positions there, and of the velocities at the windows' ends, in joint
            coordinates, (window, sample, row, column).
    """

    part: slice
    scaled: Tensor
    states: Tensor


def scaled_rows(
    pieces: Iterable[tuple[slice, Tensor]], scale: Tensor, mixing: Tensor, places: Tensor
) -> Iterator[Rows]:
    """Rows of the Jacobian from derivatives of the positions.

    Args:
        pieces: samples and derivatives of the positions there, see `propagated`.
        scale: what turns an error into a scaled one, (window, sample, joint or 1).
        mixing: from joint coordinates to those of the errors, (joint, joint).
        places: see `normal_equations`.
    """
    joints, shared, count = len(mixing), int(places[0, 0]), places.shape[1]
    for part, rows in pieces:
        if count > 2 * joints:
            # A zero moves the start, and what is measured with it.
            measured = torch.eye(rows.shape[2], joints, dtype=torch.float64)
            rows = torch.cat([rows, rows[..., shared : shared + joints] - measured], -1)
        scaled = (mixing @ rows[:, :, :joints]) * scale[:, part, :, None]
        yield Rows(part, scaled.flatten(1, 2), rows)


def normal_equations(
    rows: Iterable[Rows], r: Tensor, places: Tensor, size: int
) -> tuple[Tensor, Tensor, Tensor]:
    """J^T r and J^T J of all unknowns.

    Args:
        rows: of the Jacobian, see `scaled_rows`.
        r: scaled errors, (window, sample, joint).
        places: where each window's state, and the zeros of its recording where these are sought,
            stand among the unknowns, (window, 2 or 3 times joint).
        size: number of unknowns.

    Returns:
        Gradient, Hessian, and the derivatives of the states at the windows' ends by what is shared
        and by what `places` names, (window, 2 joint, ·).
    """
    windows, count = places.shape
    shared = int(places[0, 0])
    gradient = torch.zeros(size, dtype=torch.float64)
    hessian = torch.zeros(size, size, dtype=torch.float64)
    slope = torch.zeros(windows, count, dtype=torch.float64)
    of_own = torch.zeros(windows, count, count, dtype=torch.float64)
    mixed = torch.zeros(windows, count, shared, dtype=torch.float64)
    ends = torch.zeros(0, dtype=torch.float64)
    for part, scaled, states in rows:
        common, own = scaled.split([shared, count], -1)
        left = r[:, part].flatten(1)
        gradient[:shared] += left.flatten() @ common.flatten(0, 1)
        slope += (left[:, None] @ own)[:, 0]
        hessian[:shared, :shared] += common.flatten(0, 1).T @ common.flatten(0, 1)
        mixed += own.mT @ common
        of_own += own.mT @ own
        ends = states[:, -1]
    # A window's own state has nothing to do with another's.
    for w, place in enumerate(places):
        gradient[place] += slope[w]
        hessian[place, :shared] += mixed[w]
        hessian[:shared, place] += mixed[w].T
        hessian[place[:, None], place] += of_own[w]
    return gradient, hessian, ends


def add_jumps(
    gradient: Tensor,
    hessian: Tensor,
    jumps: Tensor,
    ends: Tensor,
    seams: Sequence[tuple[int, int]],
    places: Tensor,
    sd: Tensor,
) -> None:
    """Add jumps from windows' ends to the next one's start to normal equations.

    Args:
        gradient, hessian, ends, places: see `normal_equations`; the first two are changed.
        jumps: over their standard deviations, (seam, 2 joint).
        seams: pairs of windows.
        sd: standard deviations, (2 joint,).
    """
    shared, state = int(places[0, 0]), len(sd)
    before, after = ([pair[k] for pair in seams] for k in (0, 1))
    start = -torch.eye(state, dtype=torch.float64).expand(len(seams), -1, -1)
    rows = torch.cat([ends[before], start], -1) / sd[:, None]
    common, own = rows[..., :shared], rows[..., shared:]
    gradient[:shared] += jumps.flatten() @ common.flatten(0, 1)
    hessian[:shared, :shared] += common.flatten(0, 1).T @ common.flatten(0, 1)
    for k, place in enumerate(torch.cat([places[before], places[after, :state]], -1)):
        mixed = own[k].T @ common[k]
        gradient[place] += jumps[k] @ own[k]
        hessian[place, :shared] += mixed
        hessian[:shared, place] += mixed.T
        hessian[place[:, None], place] += own[k].T @ own[k]

"""Normal equations of windows that share parameters and have states of their own.

Unknowns are ordered as [what is shared, states of each window, zeros of each recording].
"""

from collections.abc import Iterable, Sequence

import torch
from torch import Tensor


def normal_equations(
    pieces: Iterable[tuple[slice, Tensor]],
    r: Tensor,
    scale: Tensor,
    mixing: Tensor,
    places: Tensor,
    size: int,
) -> tuple[Tensor, Tensor, Tensor]:
    """J^T r and J^T J of all unknowns.

    Args:
        pieces: samples and derivatives of the positions there, see `propagated`.
        r: scaled errors, (window, sample, joint).
        scale: what turns an error into a scaled one, (window, sample, joint).
        mixing: from joint coordinates to those of the errors, (joint, joint).
        places: where each window's state, and the zeros of its recording where these are sought,
            stand among the unknowns, (window, 2 or 3 times joint).
        size: number of unknowns.

    Returns:
        Gradient, Hessian, and the derivatives of the states at the windows' ends by what is shared
        and by what `places` names, (window, 2 joint, ·).
    """
    windows, count = places.shape
    joints = r.shape[-1]
    shared = int(places[0, 0])
    gradient = torch.zeros(size, dtype=torch.float64)
    hessian = torch.zeros(size, size, dtype=torch.float64)
    slope = torch.zeros(windows, count, dtype=torch.float64)
    of_own = torch.zeros(windows, count, count, dtype=torch.float64)
    mixed = torch.zeros(windows, count, shared, dtype=torch.float64)
    rows = torch.zeros(0, dtype=torch.float64)
    for part, rows in pieces:
        if count > 2 * joints:
            # A zero moves the start, and what is measured with it.
            measured = torch.eye(rows.shape[2], joints, dtype=torch.float64)
            rows = torch.cat([rows, rows[..., shared : shared + joints] - measured], -1)
        scaled = (mixing @ rows[:, :, :joints]) * scale[:, part, :, None]
        common, own = scaled.flatten(1, 2).split([shared, count], -1)
        left = r[:, part].flatten(1)
        gradient[:shared] += left.flatten() @ common.flatten(0, 1)
        slope += (left[:, None] @ own)[:, 0]
        hessian[:shared, :shared] += common.flatten(0, 1).T @ common.flatten(0, 1)
        mixed += own.mT @ common
        of_own += own.mT @ own
    # A window's own state has nothing to do with another's.
    for w, place in enumerate(places):
        gradient[place] += slope[w]
        hessian[place, :shared] += mixed[w]
        hessian[:shared, place] += mixed[w].T
        hessian[place[:, None], place] += of_own[w]
    return gradient, hessian, rows[:, -1]


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

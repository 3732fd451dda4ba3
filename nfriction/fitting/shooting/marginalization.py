"""States of windows eliminated from the rows of the Jacobian, not from their squares.

The end of a chaotic motion moves by 1e10 times what its start does. Beside the squares of such
derivatives, all that a window tells of anything else is rounding, and no solver brings it back. The
rows still have it: every window's are triangularised by its state's columns, piece by piece, and
what falls out below is free of the state and of its growth, so that its squares may be added up.

References:
    G. J. Bierman, Factorization Methods for Discrete Sequential Estimation (1977), ch. 5.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from nfriction.fitting.shooting.normal_equations import Rows

# Rounding of a row, in units of its size and the machine's precision: what errors of this size
# could have made up is not taken for told. Motions that grow by 1e20 leave nothing else.
ROUNDING = 30.0


@dataclass(frozen=True)
class Layout:
    """Columns of windows' rows, and where those stand that are kept when the states are gone.

    Attributes:
        shared: number of unknowns that all windows share; their columns come first.
        state: number of unknowns of a window's state, whose columns follow.
        zeros: number of those of its recording's zeros, which come last.
        size: number of unknowns that are kept: what is shared, and the zeros of all recordings.
        groups: windows that keep the same unknowns, and where these stand among all that are kept.
    """

    shared: int
    state: int
    zeros: int
    size: int
    groups: tuple[tuple[Tensor, Tensor], ...]

    @classmethod
    def of(cls, places: Tensor, state: int, size: int) -> "Layout":
        """That of unknowns in their usual order.

        Args:
            places: see `normal_equations`.
            state: number of unknowns of a window's state.
            size: number of all unknowns.
        """
        shared, states = int(places[0, 0]), len(places) * state
        members: dict[tuple[int, ...], list[int]] = {}
        for window, zeros in enumerate((places[:, state:] - states).tolist()):
            members.setdefault(tuple(zeros), []).append(window)
        groups = tuple(
            (torch.tensor(windows), torch.tensor([*range(shared), *zeros]))
            for zeros, windows in members.items()
        )
        return cls(shared, state, places.shape[1] - state, size - states, groups)

    def split(self, rows: Tensor) -> tuple[Tensor, Tensor]:
        """Columns of the state, and all others, of (*, column)."""
        common, own, zeros = rows.split([self.shared, self.state, self.zeros], -1)
        return own, torch.cat([common, zeros], -1) if self.zeros else common

    def squares(self, rows: Tensor) -> Tensor:
        """J^T J of rows free of states, (window, row, column), over what is kept, (kept, kept)."""
        total = torch.zeros(self.size, self.size, dtype=torch.float64)
        for windows, at in self.groups:
            flat = rows[windows].flatten(0, 1)
            total[at[:, None], at] += flat.T @ flat
        return total


@dataclass(frozen=True)
class Eliminated:
    """What rows tell when the windows' states follow whatever is kept.

    Attributes:
        data: curvature over what is kept, less what rounding may have made up, (kept, kept).
        response: derivatives of each window's state by what is shared and by the zeros of its
            recording, (window, state, column).
    """

    data: Tensor
    response: Tensor


def eliminated(
    rows: Iterable[Rows],
    layout: Layout,
    precision: Tensor,
    seams: Sequence[tuple[int, int]] = (),
    jump_sd: Tensor | None = None,
) -> Eliminated:
    """Eliminate the windows' states by a square-root information filter.

    Args:
        rows: of the Jacobian, some samples at a time, in time's order.
        layout: of their columns.
        precision: of the states' prior, (window, state).
        seams: pairs of windows of which the second begins where the first ends, in time's order.
        jump_sd: standard deviations of a jump there, (state,).
    """
    windows, state = precision.shape
    columns = layout.shared + layout.zeros
    triangle = precision.sqrt().diag_embed()
    right = torch.zeros(windows, state, columns, dtype=torch.float64)
    data = torch.zeros(layout.size, layout.size, dtype=torch.float64)
    # Sums of squares of all rows, by the state and by what is kept.
    sizes = [torch.zeros(windows, n, dtype=torch.float64) for n in (state, columns)]
    ends = torch.zeros(0, dtype=torch.float64)
    for piece in rows:
        own, others = layout.split(piece.scaled)
        triangle, right, free = _triangularised(
            torch.cat([triangle, own], 1), torch.cat([right, others], 1)
        )
        data += layout.squares(free)
        for size, part in zip(sizes, (own, others), strict=True):
            size += part.square().sum(1)
        ends = piece.states[:, -1]
    links = torch.zeros_like(triangle)
    if jump_sd is not None:
        jumps = layout.split(ends / jump_sd[:, None])
        data += layout.squares(_joined(triangle, right, links, jumps, seams, jump_sd))
        before = [w for w, _ in seams]
        for size, part in zip(sizes, jumps, strict=True):
            size[before] += part[before].square().sum(1)
    response = _response(triangle, right, links, seams)
    unsure = sizes[1] + (sizes[0][..., None] * response.square()).sum(1)
    return Eliminated(_beyond_rounding(data, layout.squares(unsure.sqrt()[:, None])), response)


def score_covariance(
    rows: Iterable[Rows], layout: Layout, known: Eliminated, precision: Tensor
) -> Tensor:
    """Covariance of the gradient over what is kept, (kept, kept), by rows scaled to its residuals.

    Args:
        rows, layout, precision: see `eliminated`.
        known: what that returned.
    """
    total = layout.squares(precision.sqrt()[..., None] * known.response)
    for piece in rows:
        own, others = layout.split(piece.scaled)
        total += layout.squares(others + own @ known.response)
    return total


def _beyond_rounding(data: Tensor, sizes: Tensor) -> Tensor:
    """Curvature less what rounding may have made up in rows of these squares, each (kept, kept).

    Of what is all made up nothing is told. It is left open, the worst first, and the others are
    told with it open, not as if it were known.
    """
    made_up = (ROUNDING * torch.finfo(data.dtype).eps) ** 2 * sizes.diagonal()
    left_open = torch.zeros_like(made_up, dtype=torch.bool)
    while True:
        share = torch.where(left_open | (made_up == 0), torch.inf, data.diagonal() / made_up)
        worst = int(share.argmin())
        if not share[worst] <= 1:
            break
        pivot = data[worst, worst]
        if pivot > 0:
            data = data - torch.outer(data[:, worst], data[worst]) / pivot
        left_open[worst] = True
        data = torch.where(left_open[:, None] | left_open, 0.0, data)
    return data - torch.diag(torch.where(left_open, 0.0, made_up))


def _joined(
    triangle: Tensor,
    right: Tensor,
    links: Tensor,
    jumps: tuple[Tensor, Tensor],
    seams: Sequence[tuple[int, int]],
    jump_sd: Tensor,
) -> Tensor:
    """Rows free of states that come of joining windows, (window, row, column).

    What a window tells of its end is passed on to the next one's start.

    Args:
        triangle, right: of each window; changed.
        links: by each window's successor's state; filled in.
        jumps: rows of the windows' ends over `jump_sd`, by the state and by what is kept.
        seams, jump_sd: see `eliminated`.
    """
    free = torch.zeros_like(right)
    state = len(jump_sd)
    start = torch.cat([torch.zeros(state, state), -torch.diag(1 / jump_sd)])
    for before, after in seams:
        own, others = (
            torch.cat([top[before], end[before]])
            for top, end in zip((triangle, right), jumps, strict=True)
        )
        triangle[before], top, told = _triangularised(own, torch.cat([start, others], 1))
        links[before], right[before] = top[:, :state], top[:, state:]
        triangle[after], right[after], free[after] = _triangularised(
            torch.cat([triangle[after], told[:, :state]]),
            torch.cat([right[after], told[:, state:]]),
        )
    return free


def _response(
    triangle: Tensor, right: Tensor, links: Tensor, seams: Sequence[tuple[int, int]]
) -> Tensor:
    """What states are where their rows vanish, by what is kept; the last windows' first."""
    response = -torch.linalg.solve_triangular(triangle, right, upper=True)
    for before, after in reversed(seams):
        response[before] = -torch.linalg.solve_triangular(
            triangle[before], right[before] + links[before] @ response[after], upper=True
        )
    return response


def _triangularised(own: Tensor, others: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Rotate rows so that `own` is a triangle above zeros.

    Returns:
        The triangle, and of the other columns what stands beside it and beside the zeros.
    """
    reflections, factors = torch.geqrf(own)
    turned = torch.ormqr(reflections, factors, others, left=True, transpose=True)
    top, free = turned.tensor_split([own.shape[-1]], -2)
    return reflections[..., : own.shape[-1], :].triu(), top, free

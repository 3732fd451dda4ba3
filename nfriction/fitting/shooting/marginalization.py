"""Marginalisation of window states on the rows of the Jacobian instead of on J^T J.

The end of a chaotic motion moves by 1e10 times as much as its start. In J^T J the growth of these
columns swamps all other information; QR of J keeps it. Each window's rows are triangularised by
its state's columns, piece by piece; the rows below the triangle depend neither on the state nor on
its growth, so their squares may be summed.

References:
    G. J. Bierman, Factorization Methods for Discrete Sequential Estimation (1977), ch. 5.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from nfriction.fitting.shooting.normal_equations import Rows

# Information below so many roundings of a row is discarded; motions that grow by 1e20 leave
# nothing else.
ROUNDOFF_UNITS = 30.0


@dataclass(frozen=True)
class BlockLayout:
    """Columns of the windows' rows, and their places among the variables that are kept.

    Attributes:
        shared, state, offset: number of shared variables, whose columns come first, of a window's
            state, and of its recording's offsets.
        size: number of kept variables: the shared ones, and the offsets of all recordings.
        groups: windows that keep the same variables, and the places of these.
    """

    shared: int
    state: int
    offset: int
    size: int
    groups: tuple[tuple[Tensor, Tensor], ...]

    @classmethod
    def of(cls, indices: Tensor, state: int, size: int) -> "BlockLayout":
        """Layout of variables in their usual order.

        Args:
            indices: see `DecisionVariables.indices`.
            state: number of variables of a window's state.
            size: number of all variables.
        """
        shared, states = int(indices[0, 0]), len(indices) * state
        members: dict[tuple[int, ...], list[int]] = {}
        for window, offsets in enumerate((indices[:, state:] - states).tolist()):
            members.setdefault(tuple(offsets), []).append(window)
        groups = tuple(
            (torch.tensor(windows), torch.tensor([*range(shared), *offsets]))
            for offsets, windows in members.items()
        )
        return cls(shared, state, indices.shape[1] - state, size - states, groups)

    def split(self, rows: Tensor) -> tuple[Tensor, Tensor]:
        """Columns of the state, and all others, of (*, column)."""
        common, own, offsets = rows.split([self.shared, self.state, self.offset], -1)
        return own, torch.cat([common, offsets], -1) if self.offset else common

    def squares(self, rows: Tensor) -> Tensor:
        """J^T J of rows without states, (window, row, column), over the kept ones, (kept, kept)."""
        total = torch.zeros(self.size, self.size, dtype=torch.float64)
        for windows, at in self.groups:
            flat = rows[windows].flatten(0, 1)
            total[at[:, None], at] += flat.T @ flat
        return total


@dataclass(frozen=True)
class Marginal:
    """Information about the kept variables, the states following them.

    Attributes:
        data: curvature by the data above round-off, (kept, kept).
        response: derivatives of each window's state by the shared variables and its recording's
            offsets, (window, state, column).
    """

    data: Tensor
    response: Tensor


def marginalize_states(
    rows: Iterable[Rows],
    layout: BlockLayout,
    precision: Tensor,
    pairs: Sequence[tuple[int, int]] = (),
    defect_sd: Tensor | None = None,
) -> Marginal:
    """Marginalise the windows' states by a square-root information filter.

    Args:
        rows: of the Jacobian, in the order of time.
        layout: of their columns.
        precision: of the states' prior, (window, state).
        pairs: see `Windows.continuity_pairs`, in the order of time.
        defect_sd: standard deviations of the defects, (state,).
    """
    windows, state = precision.shape
    columns = layout.shared + layout.offset
    triangle = precision.sqrt().diag_embed()
    right = torch.zeros(windows, state, columns, dtype=torch.float64)
    data = torch.zeros(layout.size, layout.size, dtype=torch.float64)
    # Sums of squares of all rows, by the state and by the kept variables.
    sizes = [torch.zeros(windows, n, dtype=torch.float64) for n in (state, columns)]
    ends = torch.zeros(0, dtype=torch.float64)
    for piece in rows:
        own, others = layout.split(piece.scaled)
        triangle, right, free = _triangularise(
            torch.cat([triangle, own], 1), torch.cat([right, others], 1)
        )
        data += layout.squares(free)
        for size, part in zip(sizes, (own, others), strict=True):
            size += part.square().sum(1)
        ends = piece.states[:, -1]
    links = torch.zeros_like(triangle)
    if defect_sd is not None:
        defects = layout.split(ends / defect_sd[:, None])
        data += layout.squares(_join(triangle, right, links, defects, pairs, defect_sd))
        before = [w for w, _ in pairs]
        for size, part in zip(sizes, defects, strict=True):
            size[before] += part[before].square().sum(1)
    # The state in which each window's rows vanish, the last windows first.
    response = -torch.linalg.solve_triangular(triangle, right, upper=True)
    for w, after in reversed(pairs):
        response[w] = -torch.linalg.solve_triangular(
            triangle[w], right[w] + links[w] @ response[after], upper=True
        )
    squares = sizes[1] + (sizes[0][..., None] * response.square()).sum(1)
    unsure = layout.squares(squares.sqrt()[:, None]).diagonal()
    return Marginal(_discard_roundoff(data, unsure), response)


def score_covariance(
    rows: Iterable[Rows], layout: BlockLayout, known: Marginal, precision: Tensor
) -> Tensor:
    """Covariance of the gradient over the kept variables, (kept, kept).

    Args:
        rows: scaled to their own residuals.
        layout, precision: see `marginalize_states`.
        known: its result.
    """
    total = layout.squares(precision.sqrt()[..., None] * known.response)
    for piece in rows:
        own, others = layout.split(piece.scaled)
        total += layout.squares(others + own @ known.response)
    return total


def _discard_roundoff(data: Tensor, sizes: Tensor) -> Tensor:
    """Curvature above the round-off of rows with these sums of squares (kept,), (kept, kept).

    Variables whose information is below round-off are dropped one by one, worst first, and
    marginalised out of the rest.
    """
    roundoff = (ROUNDOFF_UNITS * torch.finfo(data.dtype).eps) ** 2 * sizes
    dropped = torch.zeros_like(roundoff, dtype=torch.bool)
    while True:
        share = torch.where(dropped | (roundoff == 0), torch.inf, data.diagonal() / roundoff)
        worst = int(share.argmin())
        if not share[worst] <= 1:
            break
        pivot = data[worst, worst]
        if pivot > 0:
            data = data - torch.outer(data[:, worst], data[worst]) / pivot
        dropped[worst] = True
        data = torch.where(dropped[:, None] | dropped, 0.0, data)
    return data - torch.diag(torch.where(dropped, 0.0, roundoff))


def _join(
    triangle: Tensor,
    right: Tensor,
    links: Tensor,
    defects: tuple[Tensor, Tensor],
    pairs: Sequence[tuple[int, int]],
    defect_sd: Tensor,
) -> Tensor:
    """Pass the information about each window's end on to the next one's start.

    Args:
        triangle, right, links: of each window, the last by its successor's state; changed.
        defects: rows of the windows' ends over `defect_sd`, by the state and by the kept variables.
        pairs, defect_sd: see `marginalize_states`.

    Returns:
        Rows without states, (window, row, column).
    """
    free = torch.zeros_like(right)
    state = len(defect_sd)
    start = torch.cat([torch.zeros(state, state), -torch.diag(1 / defect_sd)])
    for before, after in pairs:
        own, others = (
            torch.cat([top[before], end[before]])
            for top, end in zip((triangle, right), defects, strict=True)
        )
        triangle[before], top, passed = _triangularise(own, torch.cat([start, others], 1))
        links[before], right[before] = top[:, :state], top[:, state:]
        triangle[after], right[after], free[after] = _triangularise(
            torch.cat([triangle[after], passed[:, :state]]),
            torch.cat([right[after], passed[:, state:]]),
        )
    return free


def _triangularise(own: Tensor, others: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Rotate rows so that `own` is a triangle above zeros.

    Returns:
        The triangle, and of the other columns the rows beside it and those beside the zeros.
    """
    reflections, factors = torch.geqrf(own)
    turned = torch.ormqr(reflections, factors, others, left=True, transpose=True)
    top, free = turned.tensor_split([own.shape[-1]], -2)
    return reflections[..., : own.shape[-1], :].triu(), top, free

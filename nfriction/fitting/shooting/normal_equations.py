"""Normal equations of windows with shared variables and their own ones (states, offsets).

For intervals, the windows' states are marginalised on the rows of the Jacobian instead of on J^T J.
The end of a chaotic motion is 1e10 times as sensitive as its start. In J^T J the growth of these
columns swamps all other information; QR of J keeps it. Each window's rows are triangularised with
respect to its state's columns, piece by piece; the rows below the triangle depend neither on the
state nor on its growth, so their squares may be summed.

References:
    G. J. Bierman, Factorization Methods for Discrete Sequential Estimation (1977), ch. 5.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

# Rows of the Jacobian at some samples of all windows: these samples, and derivatives of the scaled
# errors, (window, row, column), with respect to the shared variables and then each window's own
# (`DecisionVariables.indices`).
Rows = tuple[slice, Tensor]


def scaled_rows(
    pieces: Iterable[tuple[slice, Tensor]], scale: Tensor, measurement: Tensor, indices: Tensor
) -> Iterator[Rows]:
    """Rows of the Jacobian from derivatives of the positions, see `propagate`.

    `scale` is 1 over the noise of each error, (window, sample, joint or 1).
    """
    joints, shared, own = len(measurement), int(indices[0, 0]), indices.shape[1]
    for part, rows in pieces:
        if shared + own > rows.shape[-1]:
            # An encoder offset shifts both the initial position and the measured ones.
            measured = torch.eye(joints, dtype=torch.float64)
            rows = torch.cat([rows, rows[..., shared : shared + joints] - measured], -1)
        observed = measurement * scale[:, part, :, None]
        yield part, product(observed, rows).flatten(1, 2)


def product(left: Tensor, right: Tensor) -> Tensor:
    """Matrix product by NumPy, which multiplies many small matrices several times as fast as torch.

    It computes each pair of a matrix and its own transpose once.
    """
    # The search rejects a step at which derivatives overflow; a warning would be noise.
    with np.errstate(over="ignore", invalid="ignore"):
        return torch.from_numpy(left.numpy() @ right.numpy())


def normal_equations(
    rows: Iterable[Rows], r: Tensor, indices: Tensor, size: int
) -> tuple[Tensor, Tensor]:
    """J^T r and J^T J of all variables, for scaled errors `r`, (window, sample, joint)."""
    windows, count = indices.shape
    shared = int(indices[0, 0])
    gradient = torch.zeros(size, dtype=torch.float64)
    hessian = torch.zeros(size, size, dtype=torch.float64)
    slope = torch.zeros(windows, shared + count, dtype=torch.float64)
    by_own = torch.zeros(windows, count, shared + count, dtype=torch.float64)
    for part, scaled in rows:
        common = scaled[..., :shared].flatten(0, 1)
        hessian[:shared, :shared] += product(common.mT, common)
        slope += (r[:, part].flatten(1)[:, None] @ scaled)[:, 0]
        by_own += product(scaled[..., shared:].mT, scaled)
    gradient[:shared] = slope[:, :shared].sum(0)
    slope, (mixed, curvature) = slope[:, shared:], by_own.split([shared, count], -1)
    places, common = indices[:, :, None], torch.arange(shared)
    gradient.index_put_((indices,), slope, accumulate=True)
    hessian.index_put_((places, common), mixed, accumulate=True)
    hessian.index_put_((common, places), mixed, accumulate=True)
    hessian.index_put_((places, indices[:, None]), curvature, accumulate=True)
    return gradient, hessian


# Information below this many round-off units of a row is discarded; motions that grow by 1e20
# contain nothing else.
ROUNDOFF_UNITS = 30.0


@dataclass(frozen=True, eq=False)
class Kept:
    """The variables that remain: the shared ones, and the encoder offsets of all recordings."""

    indices: Tensor  # see `DecisionVariables.indices`
    state: int  # number of variables of a window's state
    size: int  # number of all variables

    @property
    def shared(self) -> int:
        return int(self.indices[0, 0])

    def split(self, rows: Tensor) -> tuple[Tensor, Tensor]:
        """Columns of the state, and of the remaining variables, of (*, column)."""
        common, own, offsets = rows.tensor_split([self.shared, self.shared + self.state], -1)
        return own, torch.cat([common, offsets], -1)

    def squares(self, rows: Tensor) -> Tensor:
        """J^T J of rows (window, row, column) without states, (kept, kept)."""
        if self.shared == rows.shape[-1]:
            columns = rows.flatten(0, 1)
            return product(columns.mT, columns)
        total = torch.zeros(self.count, self.count, dtype=torch.float64)
        at = self._places()
        return total.index_put_((at[:, :, None], at[:, None]), rows.mT @ rows, accumulate=True)

    def by_states(self, response: Tensor, precision: Tensor) -> Tensor:
        """Covariance of the gradient due to the prior of the states alone, (kept, kept)."""
        return self.squares(precision.sqrt()[..., None] * response)

    def sums(self, rows: Tensor, errors: Tensor) -> Tensor:
        """J^T e of rows (window, row, column) and errors (window, row, draw), (kept, draw)."""
        total = torch.zeros(self.count, errors.shape[-1], dtype=torch.float64)
        return total.index_put_((self._places(),), rows.mT @ errors, accumulate=True)

    @property
    def count(self) -> int:
        """Number of the variables that remain."""
        return self.size - len(self.indices) * self.state

    def _places(self) -> Tensor:
        """Index of each window's columns among the remaining variables, (window, column)."""
        states, common = self.size - self.count, torch.arange(self.shared)
        offsets = self.indices[:, self.state :] - states
        return torch.cat([common.expand(len(offsets), -1), offsets], 1)


def marginalize_states(
    rows: Iterable[Rows], kept: Kept, precision: Tensor
) -> tuple[Tensor, Tensor]:
    """Marginalise the windows' states by a square-root information filter.

    Returns the curvature above round-off in the remaining variables, (kept, kept), and derivatives
    of each window's state with respect to its columns of these, (window, state, column). Rows of
    the Jacobian are in order of time; `precision` is that of the states' prior, (window, state).
    """
    windows, state = precision.shape
    columns = kept.shared + kept.indices.shape[1] - state
    triangle = precision.sqrt().diag_embed()
    right = torch.zeros(windows, state, columns, dtype=torch.float64)
    data = kept.squares(right)
    # Sums of squares of all rows, for the state and for the remaining variables.
    sizes = torch.zeros_like(precision), torch.zeros_like(right[:, 0])
    for _, scaled in rows:
        own, others = kept.split(scaled)
        triangle, right, free = _triangularise(
            torch.cat([triangle, own], 1), torch.cat([right, others], 1)
        )
        data += kept.squares(free)
        for size, part in zip(sizes, (own, others), strict=True):
            size += part.square().sum(1)
    # The state at which each window's rows vanish.
    response = -torch.linalg.solve_triangular(triangle, right, upper=True)
    squares = sizes[1] + (sizes[0][..., None] * response.square()).sum(1)
    unsure = kept.squares(squares.sqrt()[:, None]).diagonal()
    return _discard_roundoff(data, unsure), response


def score_covariance(
    rows: Iterable[Rows], kept: Kept, response: Tensor, precision: Tensor
) -> Tensor:
    """Covariance of the gradient, (kept, kept), from rows scaled to their own residuals."""
    total = kept.by_states(response, precision)
    for _, scaled in rows:
        own, others = kept.split(scaled)
        total += kept.squares(others + own @ response)
    return total


def drawn_score(rows: Iterable[Rows], kept: Kept, response: Tensor, errors: Tensor) -> Tensor:
    """Covariance of the gradient from drawn errors (window, sample, joint, draw), scaled alike."""
    sums = torch.zeros(kept.count, errors.shape[-1], dtype=torch.float64)
    for part, scaled in rows:
        own, others = kept.split(scaled)
        sums += kept.sums(others + own @ response, errors[:, part].flatten(1, 2))
    return sums @ sums.T / sums.shape[1]


def rounding_of(
    q: Tensor, count: float, spans: Sequence[tuple[int, int, int]], draws: int = 100
) -> Tensor:
    """Rounding of windows (window, sample, joint) by encoders with any zero, (*, draw).

    Each recording (see `Windows.spans`) has a zero. A position to which a joint returns is rounded
    in the same way, at any later time.
    """
    random = torch.Generator().manual_seed(0)
    shape = (1 + max(place for place, *_ in spans), 1, q.shape[-1], draws)
    zeros = torch.rand(shape, generator=random, dtype=torch.float64)
    counts = q[..., None] / count + zeros[[place for place, *_ in spans]]
    return count * (counts - counts.round())


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


def _triangularise(own: Tensor, others: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Rotate rows so that `own` is a triangle above zeros: the triangle, others above and below."""
    reflections, factors = torch.geqrf(own)
    turned = torch.ormqr(reflections, factors, others, left=True, transpose=True)
    top, free = turned.tensor_split([own.shape[-1]], -2)
    return reflections[..., : own.shape[-1], :].triu(), top, free

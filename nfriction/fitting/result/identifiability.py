"""What a fit may claim: intervals, what the data cannot tell, and what to be wary of.

The linear theory of least squares around the minimum, with two corrections that make it honest:
residuals that last for many samples count as few, and what is at a bound is not taken for known.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from nfriction.optim.least_squares import scaled_spectrum

# Two-sided 95 % of a normal distribution.
NORMAL_95 = 1.959964
# A direction is lost where it is worse determined than its parameters alone by this factor.
LOST = 1e3
# A value that its interval leaves wholly open is lost where it would be known that much better
# with the others given; where it would not, it is but small.
TRADED = 30.0
# Below this share of its parameter's largest entry, a direction's entry is not worth naming.
NAMED = 0.3
# Left over beyond this many times the encoder's rounding is the model's own error.
MODEL_ERROR = 3.0
# Windows that are to make one motion do so up to this many standard deviations of a jump.
JOINED = 5.0


@dataclass(frozen=True)
class Interval:
    """A fitted value and the 95 % interval around it, within its bounds.

    Attributes:
        name: of the parameter.
        value: as fitted.
        low, high: ends; at a bound the bound itself, infinite where the data tell nothing.
    """

    name: str
    value: float
    low: float
    high: float

    @property
    def sd(self) -> float:
        """Standard deviation, by the wider side: a bound cuts the other short."""
        return max(self.high - self.value, self.value - self.low) / NORMAL_95


@dataclass(frozen=True)
class Information:
    """What the data say of the shared parameters, once window states are eliminated.

    Attributes:
        data: curvature by the data, in units of one independent residual, (p, p).
        prior: prior precision, (p,).
        score: covariance of the data's gradient; None where residuals are alike, and it is `data`.
    """

    data: Tensor
    prior: Tensor
    score: Tensor | None = None

    def subset(self, index: Tensor) -> "Information":
        """What is known of some of the parameters while the others are held."""
        score = None if self.score is None else self.score[index][:, index]
        return Information(self.data[index][:, index], self.prior[index], score)


def information(
    hessian: Tensor,
    precision: Tensor,
    shared: int,
    score: Tensor | None = None,
) -> Information:
    """Curvature over the shared parameters with every window's state eliminated.

    Nothing is known, prior included, where rounding has taken that curvature: windows that diverge
    answer to their start by 1e15 times what they answer to anything else.

    Args:
        hessian: of the cost, prior included, (n, n).
        precision: of the prior, (n,); its window states come last.
        shared: number of friction and plant parameters.
        score: covariance of that cost's gradient by the data, (n, n), where it is not the
            curvature: residuals differ in size, or in how long they last.
    """
    across = hessian[:shared, shared:]
    solved, failed = torch.linalg.solve_ex(hessian[shared:, shared:], across.T)
    if failed or not solved.isfinite().all():
        return Information(hessian.new_zeros(shared, shared), precision.new_zeros(shared))
    pull = solved.T
    data = hessian[:shared, :shared] - torch.diag(precision[:shared])
    eliminated = _symmetric(data - pull @ across.T)
    if score is None:
        return Information(eliminated, precision[:shared])
    passed = torch.cat([torch.eye(shared, dtype=data.dtype), -pull], 1)
    known = passed @ score @ passed.T + (pull * precision[shared:]) @ pull.T
    return Information(eliminated, precision[:shared], _symmetric(known))


def covariance_root(known: Information) -> Tensor:
    """R of the posterior covariance R R^T, (p, p); rows are infinite where nothing is known.

    Where residuals are not alike it is the sandwich covariance H^-1 (score + prior) H^-1.

    References:
        H. White, Econometrica 50 (1982), 1-25.
    """
    scale, values, vectors = scaled_spectrum(known.data + torch.diag(known.prior))
    floor = torch.finfo(values.dtype).eps * len(values)
    least = values.clamp(min=floor)
    root = scale[:, None] * vectors * least.rsqrt()
    if known.score is not None:
        pulled = root.T @ (known.score + torch.diag(known.prior)) @ root
        # What of the score lies where the curvature all but vanishes is rounding.
        weak = values <= torch.finfo(values.dtype).eps ** 0.5
        pulled = torch.where(weak | weak[:, None], torch.diag(weak.to(pulled)), pulled)
        sizes, turn = torch.linalg.eigh(_symmetric(pulled))
        root = root @ (turn * sizes.clamp(min=0).sqrt())
    # Where the huge variance of a lost direction rules, no number means anything.
    lost = (vectors.square() * (values <= 10 * floor)).sum(1) > 1e-12
    return torch.where(lost[:, None], torch.inf, root)


def standard_deviations(known: Information) -> Tensor:
    """Posterior standard deviation of each parameter, infinite where nothing is known, (p,)."""
    return covariance_root(known).norm(dim=1)


def intervals(
    names: Sequence[str], values: Tensor, sd: Tensor, lower: Tensor, upper: Tensor
) -> tuple[Interval, ...]:
    """95 % intervals within the bounds."""
    low = torch.maximum(values - NORMAL_95 * sd, lower)
    high = torch.minimum(values + NORMAL_95 * sd, upper)
    rows = zip(names, values.tolist(), low.tolist(), high.tolist(), strict=True)
    return tuple(Interval(*row) for row in rows)


def lost_directions(names: Sequence[str], known: Information) -> tuple[str, ...]:
    """Parameters and combinations of them that the data cannot tell, in words.

    A prior may still hold them; it is not asked here, except that a parameter of which the data
    say a millionth of what its prior says counts as lost.

    Args:
        names: of the shared parameters.
        known: what is known of them.
    """
    diagonal = known.data.diagonal()
    seen = diagonal > known.prior * LOST**-2
    found = [names[i] for i in (~seen).nonzero().flatten().tolist()]
    index = seen.nonzero().flatten()
    _, values, vectors = scaled_spectrum(known.data[index][:, index])
    for value, vector in zip(values, vectors.T, strict=True):
        if value > LOST**-2:
            break
        size = vector.abs()
        order = size.argsort(descending=True).tolist()
        parts = [names[int(index[i])] for i in order if size[i] > NAMED * size.max()]
        found.append(" with ".join(parts))
    return tuple(found)


def open_values(names: Sequence[str], values: Tensor, known: Information) -> tuple[str, ...]:
    """Parameters whose very size is open, because others make up for them.

    Args:
        names: of some parameters.
        values: theirs.
        known: what is known of these, and of others behind them.
    """
    sd = standard_deviations(known)[: len(names)]
    alone = known.data.diagonal()[: len(names)].clamp_min(1e-300).rsqrt()
    found = (NORMAL_95 * sd >= values.abs()) & (sd > TRADED * alone)
    return tuple(names[i] for i in found.nonzero().flatten().tolist())


def beyond_need(names: Sequence[str], sd: Tensor, slope: Tensor, need: Tensor) -> tuple[str, ...]:
    """Coefficients so open that within their intervals friction exceeds all that moves the joint.

    A ratio to the value itself would not do: a coefficient near zero is open by it, and yet known
    to be small.

    Args:
        names: of some coefficients.
        sd: standard deviation of each.
        slope: of the friction torque by each, at its joint's largest speed.
        need: the largest torque that moves its joint along the recordings.
    """
    found = NORMAL_95 * sd * slope.abs() > need
    return tuple(names[i] for i in found.nonzero().flatten().tolist())


def warnings_of(
    *,
    converged: bool,
    at_bounds: Sequence[str],
    lost: Sequence[str],
    residual: float,
    effective_sd: float,
    quantum: float | None,
    unit: str,
    largest_jump: float = 0.0,
    at_zero: Sequence[str] = (),
) -> tuple[str, ...]:
    """Sentences on what to be wary of; none for a fit without blemish.

    Of `at_bounds`, those `at_zero` ended at what no coefficient can be less than; of those that the
    data cannot tell, that tells nothing.
    """
    found = []
    if not converged:
        found.append("The search did not end at a minimum; intervals may be too narrow.")
    if not largest_jump <= JOINED:
        found.append(
            f"Windows do not join: the state jumps by {largest_jump:.3g} times what their "
            "continuity expects. The law is not right, or the motion forgets its start."
        )
    if none := [name for name in at_zero if not any(name in told for told in lost)]:
        found.append(f"At zero: {', '.join(none)}; the data show none.")
    if beyond := [name for name in at_bounds if name not in at_zero]:
        found.append(f"At a bound: {', '.join(beyond)}; the data ask for values beyond it.")
    if lost:
        found.append(f"The data cannot tell: {'; '.join(lost)}.")
    rounding = None if quantum is None else quantum / 12**0.5
    if rounding and residual > MODEL_ERROR * rounding:
        count = (effective_sd / residual) ** 2
        found.append(
            f"Left over are {residual:.3g} {unit}, {residual / rounding:.0f} times the encoder's "
            f"rounding: the model's own error, alike for about {count:.0f} samples. Intervals "
            "allow for its size, not for what is missing in the model."
        )
    return tuple(found)


def _symmetric(matrix: Tensor) -> Tensor:
    return 0.5 * (matrix + matrix.T)

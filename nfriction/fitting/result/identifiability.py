"""Confidence intervals, unidentifiable parameters, warnings, and coefficients at any motion.

Linear least-squares theory around the minimum, with two corrections: residuals are autocorrelated,
so intervals use the effective sample size; and intervals are clipped at the parameters' bounds.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from nfriction.fitting.options import DEFAULTS, FitOptions
from nfriction.friction.coefficients import Schedule
from nfriction.friction.laws import Law
from nfriction.friction.memory import load_at_rest
from nfriction.friction.models import FrictionModel
from nfriction.optim.least_squares import scaled_spectrum
from nfriction.signals import count_seen

# Two-sided 95 % of a normal distribution.
NORMAL_95 = 1.959964


@dataclass(frozen=True)
class Interval:
    """A fitted value and its 95 % confidence interval, within its bounds."""

    name: str
    value: float
    low: float  # at least the lower bound; infinite where the data determine nothing
    high: float  # at most the upper bound; likewise
    multiplicative: bool = False

    @property
    def sd(self) -> float:
        """Standard deviation from the wider side, because a bound may clip the other."""
        if self.multiplicative:
            factor = max(self.high / self.value, self.value / self.low)
            return self.value * math.log(factor) / NORMAL_95
        return max(self.high - self.value, self.value - self.low) / NORMAL_95


@dataclass(frozen=True)
class Information:
    """Information about the shared variables, the others marginalised."""

    data: Tensor  # curvature due to the data, in units of one independent residual, (p, p)
    prior: Tensor  # prior precision, (p,)
    score: Tensor | None = None  # covariance of the data's gradient; None if equal to `data`

    def subset(self, index: Tensor) -> "Information":
        """Information about some of the variables while the others are fixed."""
        score = None if self.score is None else self.score[index][:, index]
        return Information(self.data[index][:, index], self.prior[index], score)


def information(
    hessian: Tensor, precision: Tensor, shared: int, score: Tensor | None = None
) -> Information:
    """Marginalise all but the leading `shared` variables.

    The result is zero, including the prior, if round-off destroyed that curvature: divergent
    windows are 1e15 times as sensitive to their start as to anything else.

    Args:
        hessian, precision: of the cost, prior included, (n, n), and of the prior, (n,).
        shared: number of variables to keep.
        score: covariance of the data's gradient, (n, n), if it differs from the curvature, as for
            heteroscedastic or autocorrelated residuals.
    """
    across = hessian[:shared, shared:]
    solved, failed = torch.linalg.solve_ex(hessian[shared:, shared:], across.T)
    if failed or not solved.isfinite().all():
        return Information(hessian.new_zeros(shared, shared), precision.new_zeros(shared))
    pull = solved.T
    data = _symmetric(hessian[:shared, :shared] - torch.diag(precision[:shared]) - pull @ across.T)
    if score is None:
        return Information(data, precision[:shared])
    passed = torch.cat([torch.eye(shared, dtype=data.dtype), -pull], 1)
    known = passed @ score @ passed.T + (pull * precision[shared:]) @ pull.T
    return Information(data, precision[:shared], _symmetric(known))


def covariance_root(known: Information) -> Tensor:
    """R of the posterior covariance R R^T, (p, p); rows are infinite without information.

    Information that is not finite, because simulations diverge, is none.

    With a score it is the sandwich covariance H^-1 (score + prior) H^-1 (H. White, Econometrica 50
    (1982), 1-25).
    """
    if not all(x.isfinite().all() for x in (known.data, known.score) if x is not None):
        return torch.full_like(known.data, torch.inf)
    scale, values, vectors = scaled_spectrum(known.data + torch.diag(known.prior))
    floor = torch.finfo(values.dtype).eps * len(values)
    root = scale[:, None] * vectors * values.clamp(min=floor).rsqrt()
    if known.score is not None:
        pulled = root.T @ (known.score + torch.diag(known.prior)) @ root
        # Where the curvature nearly vanishes, the score is round-off.
        weak = values <= torch.finfo(values.dtype).eps ** 0.5
        pulled = torch.where(weak | weak[:, None], torch.diag(weak.to(pulled)), pulled)
        sizes, turn = torch.linalg.eigh(_symmetric(pulled))
        root = root @ (turn * sizes.clamp(min=0).sqrt())
    # No number is meaningful where the huge variance of a null direction dominates.
    null = (vectors.square() * (values <= 10 * floor)).sum(1) > 1e-12
    return torch.where(null[:, None], torch.inf, root)


def standard_deviations(known: Information) -> Tensor:
    """Posterior standard deviation of each variable, infinite without information, (p,)."""
    return covariance_root(known).norm(dim=1)


def confidence_intervals(
    names: Sequence[str],
    values: Tensor,
    sd: Tensor,
    lower: Tensor,
    upper: Tensor,
    law: Law | None = None,
) -> tuple[Interval, ...]:
    """95 % confidence intervals within the bounds.

    Positive coefficients in which the torque of the `law` is not linear are scales, such as the
    Stribeck velocity: their logarithms are nearly normal, they themselves are not.
    """
    own = law.coefficients if law else ()
    scales = {c.name for c in own if c.positive and not c.linear}
    is_scale = torch.tensor([name.split(" of ")[0] in scales for name in names], dtype=torch.bool)
    factor = torch.exp(NORMAL_95 * sd / values)
    low = torch.where(is_scale, values / factor, values - NORMAL_95 * sd)
    high = torch.where(is_scale, values * factor, values + NORMAL_95 * sd)
    low, high = torch.maximum(low, lower), torch.minimum(high, upper)
    columns = (x.tolist() for x in (values, low, high, is_scale))
    rows = zip(names, *columns, strict=True)
    return tuple(Interval(*row) for row in rows)


def null_directions(
    names: Sequence[str], known: Information, options: FitOptions = DEFAULTS
) -> tuple[str, ...]:
    """Parameters, and combinations `"a with b"`, about which the data say nothing.

    The prior is ignored, except that a parameter counts as unidentifiable where the information of
    the data is a millionth of its prior's.
    """
    least = options.null_ratio**-2
    seen = known.data.diagonal() > known.prior * least
    found = [names[i] for i in (~seen).nonzero().flatten().tolist()]
    index = seen.nonzero().flatten()
    _, values, vectors = scaled_spectrum(known.data[index][:, index])
    for value, vector in zip(values, vectors.T, strict=True):
        if value > least:
            break
        size = vector.abs()
        order = size.argsort(descending=True).tolist()
        large = [i for i in order if size[i] > options.named_share * size.max()]
        found.append(" with ".join(names[int(index[i])] for i in large))
    return tuple(found)


def weakly_identified(
    names: Sequence[str], values: Tensor, known: Information, options: FitOptions = DEFAULTS
) -> tuple[str, ...]:
    """Leading parameters of `known` whose interval includes zero because others compensate."""
    sd = standard_deviations(known)[: len(names)]
    conditional = known.data.diagonal()[: len(names)].clamp_min(1e-300).rsqrt()
    found = (NORMAL_95 * sd >= values.abs()) & (sd > options.conditional_ratio * conditional)
    return tuple(names[i] for i in found.nonzero().flatten().tolist())


def exceeds_drive_torque(
    names: Sequence[str], sd: Tensor, slope: Tensor, need: Tensor
) -> tuple[str, ...]:
    """Coefficients so uncertain that their friction could exceed the torque of the joint.

    The ratio of uncertainty to value would not do: a coefficient near zero may be known to be
    small. `slope` is the derivative of the friction torque with respect to each coefficient at its
    joint's peak speed, `need` the largest torque.
    """
    found = NORMAL_95 * sd * slope.abs() > need
    return tuple(names[i] for i in found.nonzero().flatten().tolist())


def warnings_of(
    *,
    converged: bool,
    at_bounds: Sequence[str],
    unidentifiable: Sequence[str],
    at_zero: Sequence[str] = (),
) -> tuple[str, ...]:
    """Warnings about the end of a search, one sentence each.

    `at_zero` are those of `at_bounds` that mean absence of an effect, which is a finding unless the
    parameter is unidentifiable.
    """
    found = []
    if not converged:
        found.append("The search did not reach a minimum; the intervals may be too narrow.")
    if none := [name for name in at_zero if not any(name in d for d in unidentifiable)]:
        found.append(f"At zero: {', '.join(none)}; the data show no such effect.")
    if beyond := [name for name in at_bounds if name not in at_zero]:
        found.append(f"At a bound: {', '.join(beyond)}; the data favour values beyond it.")
    if unidentifiable:
        parts = [
            f"{', '.join(others)} and {last} (only their combination)" if others else last
            for *others, last in (direction.split(" with ") for direction in unidentifiable)
        ]
        found.append(f"Not identifiable from these data: {'; '.join(parts)}.")
    return tuple(found)


def model_error_warning(
    residual: float, effective_sd: float, noise: float, unit: str, options: FitOptions = DEFAULTS
) -> tuple[str, ...]:
    """A warning if the residual exceeds what the measurement noise [rad; m] explains."""
    if not residual > options.model_error_ratio * noise:
        return ()
    return (
        f"Residual: {1e3 * residual:.3g} m{unit} RMS, {residual / noise:.0f}x the measurement "
        "noise, so the model is missing something (error is correlated over "
        f"~{(effective_sd / residual) ** 2:.0f} samples). The intervals do not cover this.",
    )


def observed_count(recorded: Tensor) -> float | None:
    """Largest of the encoder counts that positions (window, sample, joint) show; None if none."""
    seen = float(np.fmax.reduce(count_seen(recorded.numpy())))
    return None if math.isnan(seen) else seen


def _symmetric(matrix: Tensor) -> Tensor:
    return 0.5 * (matrix + matrix.T)


# Motions processed at a time, because the derivatives of a network have many columns.
PIECE = 500


@dataclass(frozen=True, eq=False, repr=False)
class CoefficientUncertainty:
    """Posterior of a schedule's parameters, propagated to its coefficients.

    Linear theory around the fitted parameters, marginalised over the plant's terms and the windows'
    states. Rows of the root are infinite for unidentifiable parameters, zero for fixed ones.
    """

    schedule: Schedule
    root: Tensor  # R of their covariance R R^T, (parameter, any)

    @torch.no_grad()
    def sd(self, qd: Tensor, qdd: Tensor) -> Tensor:
        """Standard deviation of the coefficients at motions, (*batch, joint, coefficient).

        Outside the trained range it is that at the range's edge: the network fades there, but not
        because it is known better. `qd` [rad/s] and `qdd` [rad/s^2] are (*batch, joint).
        """
        shape = qd.shape
        flat = (x.reshape(-1, shape[-1]).split(PIECE) for x in (qd, qdd))
        found = torch.cat([self._sd(v, a) for v, a in zip(*flat, strict=True)])
        return found.reshape(*shape, -1)

    def torque_sd(self, model: FrictionModel, qd: Tensor, load: Tensor | None = None) -> Tensor:
        """Standard deviation of a model's torque at velocities, (sample, joint).

        At a load shaped like `qd`, by default that at rest, and without acceleration. `model` has
        this schedule; its `v_smooth` is assumed to be known.
        """
        rest, load = torch.zeros_like(qd), load_at_rest(model.law, qd) if load is None else load
        with torch.enable_grad():
            held = model.coefficients(qd, rest).detach().expand(*qd.shape, -1).clone()
            held.requires_grad_()
            # A law is elementwise, so the sum's gradient is each joint's slope.
            (slopes,) = torch.autograd.grad(model.steady_torque(qd, load, held).sum(), held)
        with torch.no_grad():
            pieces = (x.split(PIECE) for x in (qd, rest, slopes))
            return torch.cat([self._sd(*piece) for piece in zip(*pieces, strict=True)])[..., 0]

    def _sd(self, qd: Tensor, qdd: Tensor, weights: Tensor | None = None) -> Tensor:
        """Standard deviation of each coefficient, or of their weighted sum, (sample, joint, 1)."""
        by = self.schedule.sensitivities(*self.schedule.within_range(qd, qdd))
        slopes, joint = by.parameters, by.joint
        unknown = torch.isinf(self.root).any(1)
        root = torch.where(unknown[:, None], 0.0, self.root)
        columns = []
        for j in range(qd.shape[-1]):
            own = (joint == j).nonzero().squeeze(-1)
            part = slopes[..., own].expand(len(qd), -1, -1)
            if weights is not None:
                part = (weights[:, j, :, None] * part).sum(1, keepdim=True)
            spread = (part @ root[own]).norm(dim=-1)
            lost = (part[..., unknown[own]] != 0).any(-1)
            columns.append(torch.where(lost, torch.inf, spread))
        return torch.stack(columns, 1)

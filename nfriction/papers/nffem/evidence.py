"""Bayesian regularisation: least squares with one prior precision per group of parameters.

Gauss-Newton steps on the parameters w alternate with MacKay's updates of the precisions.

Convention (Foresee and Hagan): E_D = sum e^2 and E_g = sum (w - w0)^2 over group g, without
factors of 1/2. The negative log posterior is beta E_D + sum_g alpha_g E_g, so the noise variance is
1 / (2 beta), the prior variance of a parameter of group g is 1 / (2 alpha_g), the posterior
covariance is S^-1 / 2 with S = beta J^T J + diag(alpha), and at the maximum of the evidence

    alpha_g = gamma_g / (2 E_g),    beta = (n - gamma) / (2 E_D).

References:
    D. J. C. MacKay, Neural Computation 4 (1992) 415-472; F. D. Foresee and M. T. Hagan,
    Gauss-Newton approximation to Bayesian learning, ICNN 1997.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from copy import deepcopy
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple, TypeAlias

import torch
from torch import Tensor, nn
from tqdm.auto import tqdm

from nfriction.optim.group_evidence import factorise, group_sums
from nfriction.papers.nffem.jacobian import (
    NormalEquations,
    assign,
    check_samples,
    flatten,
    normal_equations,
    sum_of_squares,
    trainable,
)

Status = Literal["converged", "noise_floor", "max_steps", "stalled", "not_finite", "stopped"]

MESSAGES: dict[str, str] = {
    "converged": "Converged: parameters, alpha, beta and gamma are at a maximum of the evidence.",
    "noise_floor": "The residuals reached the given noise floor.",
    "max_steps": "The step limit was reached before convergence.",
    "stalled": "No step lowers the objective although its gradient is not small.",
    "not_finite": "The errors or their Jacobian are not finite, at the start or at every step.",
    "stopped": "Stopped by the callback or by an interrupt; the parameters are the best reached.",
}
# Damping of the first step as in Foresee and Hagan; above the largest, steps are negligible.
FIRST_DAMPING, LARGEST_DAMPING = 0.005, 1e10
# A group whose prior outweighs its data by this factor is inactive; alpha is limited to it.
LARGEST_RATIO = 1e12


@dataclass(frozen=True, eq=False)
class EvidenceState:
    """State of a run, as passed to a callback."""

    w: Tensor  # parameters, shape (p,)
    alpha: Tensor  # prior precisions, shape (groups,)
    beta: float = 1.0  # noise precision
    damping: float = FIRST_DAMPING  # mu of the next step
    step: int = 0
    network: int = 0  # number of the one in training, of several


Callback: TypeAlias = Callable[[EvidenceState], "bool | None"]


@dataclass(frozen=True)
class EvidenceOptions:
    """Settings of a run.

    Args:
        tolerance: for convergence: relative error of alpha = gamma / 2E_g and of beta =
            (n - gamma) / 2E_D, and gain of a full Gauss-Newton step in nats.
        noise_floor: standard deviation of the errors at which fitting ends.
        callback: called with the state after each accepted step; stops the run by returning True.
    Raises:
        ValueError: if the tolerance is not positive.
    """

    max_steps: int = 300
    tolerance: float = 1e-3
    noise_floor: float = 0.0
    callback: Callback | None = None
    progress: bool = False

    def __post_init__(self) -> None:
        if self.tolerance <= 0:
            raise ValueError(f"`tolerance` must be positive, got {self.tolerance}.")


@dataclass(frozen=True, eq=False)
class EvidenceResult:
    """Outcome of a fit by evidence; check `converged` before using it."""

    status: Status  # reason for termination; `message` describes it in words
    w: Tensor  # parameters, (p,)
    alpha: dict[str, float]  # prior precision by group
    beta: float  # noise precision; the noise variance is 1 / (2 beta), in the targets' unit squared
    gamma: dict[str, float]  # effective number of parameters by group
    error_squares: float  # E_D
    parameter_squares: dict[str, float]  # E_g = sum (w - w0)^2, by group
    samples: int  # n, number of errors in E_D
    log_evidence: float  # in nats, with all constants, so models of the same data can be compared
    covariance: Tensor  # posterior covariance of the parameters, (p, p)
    steps: int

    @property
    def converged(self) -> bool:
        """True at a maximum of the evidence or at the noise floor."""
        return self.status in ("converged", "noise_floor")

    @property
    def message(self) -> str:
        """The status in words."""
        return MESSAGES[self.status]


def bayesian_regularisation(
    model: nn.Module,
    x: Tensor,
    y: Tensor,
    *,
    kind: Callable[[str], str] = str,
    prior: Mapping[str, Tensor | float] | None = None,
    options: EvidenceOptions = EvidenceOptions(),
) -> EvidenceResult:
    """Train a module in place on samples, with Bayesian regularisation and no validation set.

    Every trainable parameter is shrunk toward its prior value with the strength that the evidence
    assigns to its group. A step solves (S + mu diag S) d = -(beta J^T e + alpha (w - w0)) and is
    accepted if beta E_D + sum alpha_g E_g falls; otherwise, or if errors are not finite, mu is
    raised by 10. Then alpha and beta are updated, and mu is divided by 10 if the first trial
    decreased about as predicted. Damping is relative to the diagonal, so that parameter units do
    not matter; the first step has hardly any prior, as in Foresee and Hagan. The weights are
    written when the fit ends, even by an interrupt; a failure at the start changes nothing.

    Args:
        model: module whose outputs for sample i depend only on sample i.
        x: inputs, shape (n, ...).
        y: targets, shape of the model's output.
        kind: maps the name of a parameter to its group; by default each is its own group.
        prior: values w0 by parameter name, 0 where missing.
        options: settings; the noise floor is in the unit of `y`.
    Returns:
        Weights, alpha, beta, gamma, log evidence, covariance and status.
    Raises:
        ValueError: if samples or prior do not match the model.
    """
    parameters, given = trainable(model), prior or {}
    if not parameters or (unknown := sorted(set(given) - set(parameters))):
        wrong = f"`prior` names {unknown}" if parameters else "`model` has nothing to train"
        raise ValueError(f"{wrong}; parameters that require a gradient are {list(parameters)}.")
    check_samples(x, y)
    if not (torch.isfinite(x).all() and torch.isfinite(y).all()):
        raise ValueError("`x` and `y` must be finite; drop the samples that are not.")
    groups = [kind(name) for name in parameters]
    names = list(dict.fromkeys(groups))
    places = torch.tensor([names.index(group) for group in groups], device=x.device)
    sizes = torch.tensor([value.numel() for value in parameters.values()], device=x.device)
    centres = {n: torch.zeros_like(value) + given.get(n, 0.0) for n, value in parameters.items()}
    # Errors within the round-off of the targets contain no information.
    rounding = torch.finfo(y.dtype).eps * float(y.square().mean().sqrt())
    # Samples last in memory, as in the layers, whose kernels are vectorised over samples.
    x, y = (part.movedim(0, -1).contiguous().movedim(-1, 0) for part in (x, y))
    options = replace(options, noise_floor=max(options.noise_floor, rounding))
    prior_groups = PriorGroups(flatten(centres), places.repeat_interleave(sizes), names)
    fit = _Fit(deepcopy(model), (x, y), prior_groups, options)
    try:
        status = fit.run()
    except KeyboardInterrupt:
        status = "stopped"
    assign(model, fit.state.w)
    return fit.result(status)


class PriorGroups(NamedTuple):
    """Prior w0 (p,), group of each parameter (p,), and the names of the groups."""

    centre: Tensor
    of: Tensor
    names: list[str]


class _Fit:
    """A run of `bayesian_regularisation`, which overwrites the parameters of `model`."""

    def __init__(
        self,
        model: nn.Module,
        data: tuple[Tensor, Tensor],
        prior: PriorGroups,
        options: EvidenceOptions,
    ) -> None:
        self.model, self.data, self.prior, self.options = model, data, prior, options
        self.samples = data[1].numel()
        w = flatten(trainable(model))
        # Exact fits would otherwise drive beta to infinity.
        self.noise_floor = max(options.noise_floor, 1e-15)
        # An interrupt during the first evaluation must still have something to report.
        nan = torch.full_like(w, math.nan)
        self.state = EvidenceState(w, nan.new_full((len(prior.names),), math.nan))
        self.local = NormalEquations(nan.diag(), nan, nan.sum())
        self.not_finite = False

    def run(self) -> Status:
        options, callback = self.options, self.options.callback
        self.local = normal_equations(self.model, *self.data)
        if not self.local.finite:
            return "not_finite"
        self._start()
        with tqdm(total=options.max_steps, disable=not options.progress, unit="step") as bar:
            while True:
                known = self.posterior()
                if self._settled(known):
                    return "converged"
                unexplained = self.samples - float(known.gamma.sum())
                # Below the known noise level, the fit would learn only noise.
                if float(self.local.squares) <= unexplained * self.noise_floor**2:
                    return "noise_floor"
                if self.state.step >= options.max_steps:
                    return "max_steps"
                # At the start, residuals do not yet indicate noise and priors.
                if self.state.step > 0:
                    alpha, beta = reestimate(
                        known, self.local, self.prior.of, self.samples, self.state.alpha,
                        0.5 / self.noise_floor**2,
                    )  # fmt: skip
                    self.state = replace(self.state, alpha=alpha, beta=beta)
                failed = self._advance()
                if failed is not None:
                    return failed
                bar.set_postfix(log_evidence=f"{known.log_evidence:.6g}", refresh=False)
                bar.update()
                if callback is not None and callback(self.state):
                    return "stopped"

    def posterior(self) -> Posterior:
        state, offset = self.state, self.state.w - self.prior.centre
        return posterior(self.local, offset, self.prior.of, self.samples, state.alpha, state.beta)

    def _start(self) -> None:
        """Initial state: noise as large as the errors, and a prior far weaker than the data."""
        local, groups, count = self.local, self.prior.of, len(self.prior.names)
        beta = self.samples / max(2 * float(local.squares), 1e-300)
        beta = min(beta, 0.5 / self.noise_floor**2)
        sizes = group_sums(torch.ones_like(local.Jte), groups, count)
        curvature = group_sums(local.JtJ.diagonal(), groups, count) / sizes
        # A group without influence at the start has no curvature as reference.
        curvature = torch.where(curvature > 0, curvature, local.JtJ.diagonal().mean())
        # Far weaker than the data: the first step is nearly plain least squares.
        alpha = 1e-6 * beta * torch.where(curvature > 0, curvature, 1.0)
        self.state = replace(self.state, alpha=alpha, beta=beta)

    def _settled(self, known: Posterior) -> bool:
        """True if the log evidence is stationary in w, log alpha and log beta."""
        alpha, gamma, tolerance = self.state.alpha, known.gamma, self.options.tolerance
        # Derivatives of the log evidence by log alpha are (gamma - 2 alpha E_g) / 2.
        off = (gamma - 2 * alpha * known.parameter_squares).abs() / gamma.clamp(min=1)
        unexplained = self.samples - float(gamma.sum())
        noise_off = abs(unexplained - 2 * self.state.beta * float(self.local.squares))
        return (
            known.newton_decrement <= tolerance
            and bool((off <= tolerance).all())
            and noise_off <= tolerance * max(unexplained, 1.0)
        )

    def _advance(self) -> Status | None:
        """Take one step that lowers the objective, with as much damping as needed."""
        state, local = self.state, self.local
        precision = state.alpha[self.prior.of]
        offset = state.w - self.prior.centre
        system = state.beta * local.JtJ + precision.diag()
        slope = state.beta * local.Jte + precision * offset
        objective = float(state.beta * local.squares + precision @ offset.square())
        rounding = 64 * torch.finfo(slope.dtype).eps * objective
        damping = state.damping
        while damping <= LARGEST_DAMPING:
            scale, factor = factorise(system + damping * system.diagonal().diag())
            step = -scale * torch.cholesky_solve((scale * slope)[:, None], factor)[:, 0]
            predicted = -float(2 * slope @ step + step @ (system @ step))
            # Only a nearly undamped step proves that no further decrease is possible.
            if damping <= 1 and predicted <= rounding:
                # The parameters are optimal for these alpha and beta: only those change.
                self.state = replace(state, step=state.step + 1)
                return None
            found = self._attempt(state.w + step, precision, objective)
            if found is not None:
                there, fall = found
                # After a rejected trial or a poor model, less damping would cost another trial.
                if fall > 0.75 * predicted and damping <= state.damping:
                    damping = max(damping / 10, 1e-15)
                elif fall < 0.25 * predicted:
                    damping *= 4
                self.local = there
                self.state = replace(state, w=state.w + step, damping=damping, step=state.step + 1)
                return None
            damping *= 10
        return "not_finite" if self.not_finite else "stalled"

    def _attempt(
        self, w: Tensor, precision: Tensor, objective: float
    ) -> tuple[NormalEquations, float] | None:
        """Normal equations at `w` and the objective's decrease, if finite and positive."""
        beta = self.state.beta
        shrinkage = float(precision @ (w - self.prior.centre).square())
        assign(self.model, w)
        cheap = float(beta * sum_of_squares(self.model, *self.data)) + shrinkage
        self.not_finite = not math.isfinite(cheap)
        # Most rejected trials end here, at a fraction of the cost of a Jacobian.
        if not cheap < objective:
            return None
        there = normal_equations(self.model, *self.data)
        self.not_finite = not there.finite
        # Decided by the sum on which the next objective is based, not by its cheap equivalent.
        fall = objective - float(beta * there.squares) - shrinkage
        return (there, fall) if fall > 0 and not self.not_finite else None

    def result(self, status: Status) -> EvidenceResult:
        state = self.state
        unknown = torch.full_like(state.alpha, math.nan)
        known = Posterior(self.local.JtJ * math.nan, unknown, math.nan, math.nan, unknown)
        if self.local.finite:
            known = self.posterior()

        def named(values: Tensor) -> dict[str, float]:
            return dict(zip(self.prior.names, values.tolist(), strict=True))

        return EvidenceResult(
            status=status,
            w=state.w,
            alpha=named(state.alpha),
            beta=state.beta,
            gamma=named(known.gamma),
            error_squares=float(self.local.squares),
            parameter_squares=named(known.parameter_squares),
            samples=self.samples,
            log_evidence=known.log_evidence,
            covariance=known.covariance,
            steps=state.step,
        )


class Posterior(NamedTuple):
    """Gauss-Laplace posterior at given parameters, alpha and beta."""

    covariance: Tensor  # of the parameters, (2 S)^-1, shape (p, p)
    gamma: Tensor  # effective (well determined) parameters of each group, shape (groups,)
    log_evidence: float  # log p(data | alpha, beta) in nats, with all its constants
    newton_decrement: float  # gain in log posterior of a full Gauss-Newton step, in nats
    parameter_squares: Tensor  # E_g, shape (groups,)


def posterior(
    local: NormalEquations, offset: Tensor, groups: Tensor, samples: int, alpha: Tensor, beta: float
) -> Posterior:
    """Posterior, effective parameters and log evidence; exact if the model is linear.

    Args:
        local: J^T J, J^T e and E_D at the parameters w.
        offset: w - w0, shape (p,).
        groups: group of each parameter, 0 ... groups - 1, int64, shape (p,).
        samples: number n of errors in E_D.
        alpha: prior precision (halved) of each group, shape (groups,), positive.
        beta: noise precision (halved), positive.
    """
    count, precision = len(alpha), alpha[groups]
    # Scaled to a unit diagonal, so that the units of the parameters do not affect accuracy.
    scale, factor = factorise(beta * local.JtJ + precision.diag())
    inverse = scale[:, None] * torch.cholesky_inverse(factor) * scale
    slope = beta * local.Jte + precision * offset
    squares = group_sums(offset.square(), groups, count)
    # The diagonal of S^-1 (beta J^T J) equals 1 - alpha (S^-1)_ii, but remains accurate where the
    # prior dominates and the difference would be round-off.
    determined = beta * (inverse * local.JtJ).sum(1)
    sizes = group_sums(torch.ones_like(offset), groups, count)
    log_determinant = 2 * factor.diagonal().log().sum() - 2 * scale.log().sum()
    log_evidence = (
        -beta * local.squares
        - alpha @ squares
        + 0.5 * samples * math.log(beta / math.pi)
        + 0.5 * sizes @ alpha.log()
        - 0.5 * log_determinant
    )
    return Posterior(
        covariance=inverse / 2,
        gamma=group_sums(determined, groups, count).clamp(min=0),
        log_evidence=float(log_evidence),
        newton_decrement=float(slope @ (inverse @ slope)),
        parameter_squares=squares,
    )


def reestimate(
    known: Posterior,
    local: NormalEquations,
    groups: Tensor,
    samples: int,
    alpha: Tensor,
    largest_beta: float = math.inf,
) -> tuple[Tensor, float]:
    """MacKay's fixed-point update: alpha_g = gamma_g / (2 E_g), beta = (n - gamma) / (2 E_D).

    A group still at the centre of its prior keeps its alpha: it has no information yet. `known` is
    the `posterior` of the other arguments, `largest_beta` the limit from a known noise floor.
    """
    curvature = group_sums(local.JtJ.diagonal(), groups, len(alpha))
    # As many parameters as samples would leave no noise at all.
    beta = float((samples - known.gamma.sum()).clamp(min=1e-3) / (2 * local.squares))
    beta = min(beta, largest_beta)
    limit = LARGEST_RATIO * beta * curvature
    # A group without curvature has no reference for a limit.
    limit = torch.where(limit > 0, limit, alpha)
    estimate = torch.minimum(known.gamma / (2 * known.parameter_squares), limit)
    # At the centre of its prior, the estimate of a group would divide zero by zero.
    usable = (known.parameter_squares > 0) & (estimate > 0)
    return torch.where(usable, estimate, alpha), beta

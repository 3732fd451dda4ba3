"""Bayesian regularisation: least squares with one prior precision for each group of parameters.

Gauss-Newton steps on the parameters w alternate with MacKay's updates of the precisions.

The precisions alpha (by group) and beta have no halves, as in `posterior`.

References:
    D. J. C. MacKay, Neural Computation 4 (1992) 415-472; F. D. Foresee and M. T. Hagan,
    Gauss-Newton approximation to Bayesian learning, ICNN 1997.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Literal, TypeAlias

import torch
from torch import Tensor, nn
from tqdm.auto import tqdm

from nfriction.optim.group_evidence import factorise, group_sums
from nfriction.papers.nffem.jacobian import (
    NormalEquations,
    check_samples,
    flatten,
    jacobian_pieces,
    normal_equations,
    sum_of_squares,
    trainable,
    unflatten,
)
from nfriction.papers.nffem.posterior import EvidenceProblem, Posterior, posterior, reestimate

Status = Literal["converged", "noise_floor", "max_steps", "stalled", "not_finite", "stopped"]

MESSAGES: dict[str, str] = {
    "converged": "Converged: parameters, alpha, beta and gamma are at a maximum of the evidence.",
    "noise_floor": "The residuals reached the given noise floor.",
    "max_steps": "The step limit was reached before convergence.",
    "stalled": "No step lowers the objective although its gradient is not small.",
    "not_finite": "The errors or their Jacobian are not finite, at the start or at every step.",
    "stopped": "Stopped by the callback or by an interrupt; the parameters are the best reached.",
}
# Beyond it a step is too short to matter.
LARGEST_DAMPING = 1e10


@dataclass(frozen=True, eq=False)
class EvidenceState:
    """State of a run, as given to a callback.

    Args:
        w: parameters, shape (p,).
        alpha: prior precisions, shape (groups,).
        beta: noise precision.
        damping: mu of the next step.
        step: accepted steps so far.
    """

    w: Tensor
    alpha: Tensor
    beta: float = 1.0
    damping: float = 0.005
    step: int = 0


Callback: TypeAlias = Callable[[EvidenceState], "bool | None"]


@dataclass(frozen=True)
class EvidenceOptions:
    """Settings of a run.

    Args:
        max_steps: limit of accepted steps.
        tolerance: of convergence: relative error of alpha = gamma / 2E_g and beta =
            (n - gamma) / 2E_D, and gain of a full Gauss-Newton step in nats.
        noise_floor: standard deviation of the errors at which fitting ends.
        initial_damping: mu of the first step.
        callback: called after each accepted step with the state; True stops.
        progress: show a bar.
    Raises:
        ValueError: a tolerance or damping that is not positive.
    """

    max_steps: int = 300
    tolerance: float = 1e-3
    noise_floor: float = 0.0
    initial_damping: float = 0.005
    callback: Callback | None = None
    progress: bool = False

    def __post_init__(self) -> None:
        if self.tolerance <= 0 or self.initial_damping <= 0:
            raise ValueError(
                "`tolerance` and `initial_damping` must be positive, got "
                f"{self.tolerance} and {self.initial_damping}."
            )


@dataclass(frozen=True, eq=False)
class EvidenceResult:
    """Outcome of a fit by evidence; read `converged` before believing it.

    Args:
        status: reason for the end; `message` gives it in words.
        w: parameters in one vector, shape (p,).
        alpha, gamma: prior precision and effective parameters, by group.
        beta: noise precision; the noise has the standard deviation `noise_std`.
        error_squares: E_D.
        parameter_squares: E_g = sum (w - w0)^2, by group.
        samples: n, number of errors that E_D sums.
        log_evidence: in nats with all constants: models of the same data can be compared by it.
        covariance: posterior covariance of the parameters, shape (p, p).
        steps: accepted steps.
        history: log evidence before each step.
        model, parameters: differentiated by `predictive_std`.
    """

    status: Status
    w: Tensor
    alpha: dict[str, float]
    beta: float
    gamma: dict[str, float]
    error_squares: float
    parameter_squares: dict[str, float]
    samples: int
    log_evidence: float
    covariance: Tensor
    steps: int
    history: list[float]
    model: nn.Module
    parameters: dict[str, Tensor]

    @property
    def converged(self) -> bool:
        """True at a maximum of the evidence or at the noise floor."""
        return self.status in ("converged", "noise_floor")

    @property
    def message(self) -> str:
        """The status in words."""
        return MESSAGES[self.status]

    @property
    def noise_std(self) -> float:
        """Standard deviation of the noise of an error, in the targets' unit."""
        return math.sqrt(0.5 / self.beta)

    def predictive_std(self, x: Tensor, noise: bool = True) -> Tensor:
        """Standard deviation of the outputs at `x` by the uncertainty of parameters and noise.

        Args:
            x: inputs, shape (m, ...).
            noise: include that of a new measurement, or only that of the function.
        Returns:
            Shape of the outputs, (m, *outputs).
        """
        floor = 0.5 / self.beta if noise else 0.0
        deviations = []
        for _, output, jacobians in jacobian_pieces(self.model, self.parameters, x):
            # Only the diagonal of J C J^T.
            variance = torch.stack([((J @ self.covariance) * J).sum(-1) for J in jacobians], -1)
            deviations.append((variance.clamp(min=0) + floor).sqrt().view_as(output))
        return torch.cat(deviations)


def bayesian_regularisation(
    model: nn.Module,
    x: Tensor,
    y: Tensor,
    *,
    kind: Callable[[str], str] = str,
    prior: Mapping[str, Tensor | float] | None = None,
    options: EvidenceOptions | None = None,
) -> EvidenceResult:
    """Train a module in place on samples, with Bayesian regularisation and no validation set.

    Every trainable parameter is shrunk toward its prior value with the strength that the evidence
    assigns to its group. A step solves (S + mu diag S) d = -(beta J^T e + alpha (w - w0)) and is
    taken if beta E_D + sum alpha_g E_g falls; else, or where errors are not finite, mu*10. Then
    come new alpha and beta, and mu/10 if the first trial fell about as predicted. The damping is
    relative to the diagonal, so that the units of the parameters do not matter; the first step has
    hardly any prior, as in Foresee and Hagan. The weights are written when the fit ends, also if an
    interrupt or the callback ends it; a fit that fails from the start leaves the module unchanged.

    Args:
        model: outputs of sample i depend on sample i only; see `nfriction.papers.nffem.jacobian`
            for modules that offer their derivatives.
        x: inputs, shape (n, ...).
        y: targets, shape of the model's output.
        kind: group of a parameter by its name; by default each is a group of its own.
        prior: values w0 by parameter name, 0 where missing.
        options: settings; the noise floor is in the unit of `y`.
    Returns:
        Weights, alpha, beta, gamma, log evidence, error bars and status.
    Raises:
        ValueError: samples or prior do not fit the model.
    """
    options = EvidenceOptions() if options is None else options
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
    # Errors within the rounding of the targets carry no information.
    rounding = torch.finfo(y.dtype).eps * float(y.square().mean().sqrt())
    # Samples last in memory, as layers take them: kernels are vectorised over samples.
    x, y = (part.movedim(0, -1).contiguous().movedim(-1, 0) for part in (x, y))
    problem = EvidenceProblem(
        equations=lambda w: normal_equations(model, unflatten(w, parameters), x, y),
        squares=lambda w: sum_of_squares(model, unflatten(w, parameters), x, y),
        samples=y.numel(), prior=flatten(centres), groups=places.repeat_interleave(sizes),
        names=names,
    )  # fmt: skip
    options = replace(options, noise_floor=max(options.noise_floor, rounding))
    fit = _Fit(problem, options, flatten(parameters))
    try:
        status = fit.run()
    except KeyboardInterrupt:
        status = "stopped"
    best = unflatten(fit.state.w.clone(), parameters)
    with torch.no_grad():
        for name, parameter in model.named_parameters():
            if name in best:
                parameter.copy_(best[name])
    return fit.result(status, model, best)


class _Fit:
    """A run of `bayesian_regularisation`."""

    def __init__(self, problem: EvidenceProblem, options: EvidenceOptions, w: Tensor) -> None:
        self.problem, self.options = problem, options
        # Exact fits would otherwise drive beta to infinity.
        self.noise_floor = max(options.noise_floor, 1e-15)
        # An interrupt of the first evaluation must still find something to report.
        nan = torch.full_like(w, math.nan)
        unknown = nan.new_full((len(problem.names),), math.nan)
        self.state = EvidenceState(w, unknown, damping=options.initial_damping)
        self.local = NormalEquations(nan.diag(), nan, nan.sum())
        self.history: list[float] = []
        self.not_finite = False

    def run(self) -> Status:
        options, callback = self.options, self.options.callback
        self.local = self.problem.equations(self.state.w)
        if not self.local.finite:
            return "not_finite"
        self._start()
        with tqdm(
            total=options.max_steps, disable=not options.progress,
            unit="step",
        ) as bar:  # fmt: skip
            while True:
                known = self.posterior()
                self.history.append(known.log_evidence)
                if self._settled(known):
                    return "converged"
                unexplained = self.problem.samples - float(known.gamma.sum())
                # Below the known noise the fit only learns that noise.
                if float(self.local.squares) <= unexplained * self.noise_floor**2:
                    return "noise_floor"
                if self.state.step >= options.max_steps:
                    return "max_steps"
                # At the start the residuals say nothing yet about noise and priors.
                if self.state.step > 0:
                    self._reestimate(known)
                failed = self._advance()
                if failed is not None:
                    return failed
                bar.set_postfix(log_evidence=f"{self.history[-1]:.6g}", refresh=False)
                bar.update()
                if callback is not None and callback(self.state):
                    return "stopped"

    def posterior(self) -> Posterior:
        return posterior(self.problem, self.local, self.state.w, self.state.alpha, self.state.beta)

    def _start(self) -> None:
        """Noise as large as the errors and a prior far below the data."""
        problem, local = self.problem, self.local
        beta = problem.samples / max(2 * float(local.squares), 1e-300)
        beta = min(beta, 0.5 / self.noise_floor**2)
        count = len(problem.names)
        sizes = group_sums(torch.ones_like(local.Jte), problem.groups, count)
        curvature = group_sums(local.JtJ.diagonal(), problem.groups, count) / sizes
        # A group without influence at the start has no curvature to compare with.
        curvature = torch.where(curvature > 0, curvature, local.JtJ.diagonal().mean())
        # Far below the data: the first step is nearly plain least squares.
        alpha = 1e-6 * beta * torch.where(curvature > 0, curvature, 1.0)
        self.state = replace(self.state, alpha=alpha, beta=beta)

    def _settled(self, known: Posterior) -> bool:
        """True where the log evidence is stationary in w, log alpha and log beta."""
        alpha, gamma, tolerance = self.state.alpha, known.gamma, self.options.tolerance
        # Derivatives of the log evidence by log alpha are (gamma - 2 alpha E_g) / 2.
        off = (gamma - 2 * alpha * known.parameter_squares).abs() / gamma.clamp(min=1)
        unexplained = self.problem.samples - float(gamma.sum())
        noise_off = abs(unexplained - 2 * self.state.beta * float(self.local.squares))
        return (
            known.newton_decrement <= tolerance
            and bool((off <= tolerance).all())
            and noise_off <= tolerance * max(unexplained, 1.0)
        )

    def _reestimate(self, known: Posterior) -> None:
        largest = 0.5 / self.noise_floor**2
        alpha, beta = reestimate(self.problem, known, self.local, self.state.alpha, largest)
        self.state = replace(self.state, alpha=alpha, beta=beta)

    def _advance(self) -> Status | None:
        """Take one step that lowers the objective, with as much damping as that needs."""
        state, problem, local = self.state, self.problem, self.local
        precision = state.alpha[problem.groups]
        offset = state.w - problem.prior
        system = state.beta * local.JtJ + precision.diag()
        slope = state.beta * local.Jte + precision * offset
        objective = float(state.beta * local.squares + precision @ offset.square())
        rounding = 64 * torch.finfo(slope.dtype).eps * objective
        damping = state.damping
        while damping <= LARGEST_DAMPING:
            scale, factor = factorise(system + damping * system.diagonal().diag())
            step = -scale * torch.cholesky_solve((scale * slope)[:, None], factor)[:, 0]
            predicted = -float(2 * slope @ step + step @ (system @ step))
            # Only a nearly undamped step proves that nothing is left to gain.
            if damping <= 1 and predicted <= rounding:
                # The parameters are optimal for these alpha and beta: only those change.
                self.state = replace(state, step=state.step + 1)
                return None
            found = self._attempt(state.w + step, precision, objective)
            if found is not None:
                there, fall = found
                # After a rejected trial, or a poor model, less damping would cost another trial.
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
        """Normal equations at `w` and the objective's fall, if all is finite and there is one."""
        beta, problem = self.state.beta, self.problem
        shrinkage = float(precision @ (w - problem.prior).square())
        if problem.squares is not None:
            cheap = float(beta * problem.squares(w)) + shrinkage
            self.not_finite = not math.isfinite(cheap)
            # Most rejected trials end here, at a fraction of the cost of a Jacobian.
            if not cheap < objective:
                return None
        there = problem.equations(w)
        self.not_finite = not there.finite
        # The sum that the next objective starts from decides, not its cheap twin.
        fall = objective - float(beta * there.squares) - shrinkage
        return (there, fall) if fall > 0 and not self.not_finite else None

    def result(
        self, status: Status, model: nn.Module, parameters: dict[str, Tensor]
    ) -> EvidenceResult:
        state, names = self.state, self.problem.names
        unknown = torch.full_like(state.alpha, math.nan)
        known = Posterior(self.local.JtJ * math.nan, unknown, math.nan, math.nan, unknown)
        if self.local.finite:
            known = self.posterior()

        def named(values: Tensor) -> dict[str, float]:
            return dict(zip(names, values.tolist(), strict=True))

        return EvidenceResult(
            status=status,
            w=state.w,
            alpha=named(state.alpha),
            beta=state.beta,
            gamma=named(known.gamma),
            error_squares=float(self.local.squares),
            parameter_squares=named(known.parameter_squares),
            samples=self.problem.samples,
            log_evidence=known.log_evidence,
            covariance=known.covariance,
            steps=state.step,
            history=self.history,
            model=model,
            parameters=parameters,
        )

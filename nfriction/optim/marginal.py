"""Maximum of the evidence by Gauss-Newton steps on the weights and MacKay's updates between them.

Knows no module: it needs normal equations only, from wherever they come.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TypeAlias

import torch
from torch import Tensor
from tqdm.auto import tqdm

from nfriction.optim.evidence_result import EvidenceResult, EvidenceState, Status
from nfriction.optim.jacobian import NormalEquations
from nfriction.optim.posterior import Posterior, factorise, group_sums, posterior, reestimate

Callback: TypeAlias = Callable[[EvidenceState], "bool | None"]

LARGEST_DAMPING = 1e10


def maximise_evidence(
    equations: Callable[[Tensor], NormalEquations],
    w: Tensor,
    *,
    samples: int,
    squares: Callable[[Tensor], Tensor] | None = None,
    groups: Tensor | None = None,
    names: Sequence[str] | None = None,
    prior: Tensor | None = None,
    log_weights: float = 0.0,
    max_steps: int = 300,
    tolerance: float = 1e-3,
    noise_floor: float = 1e-15,
    initial_damping: float = 0.005,
    state: EvidenceState | None = None,
    callback: Callback | None = None,
    progress: bool = False,
) -> EvidenceResult:
    """Fit parameters, noise precision and one prior precision per group to normal equations.

    A step solves (S + mu diag S) d = -(beta J^T e + alpha (w - w0)) and is taken if
    beta E_D + sum alpha_g E_g falls; else, or where errors are not finite, mu*10. Then come new
    alpha and beta, and mu/10 if the first trial fell about as predicted. The damping is relative to
    the diagonal, so that the units of the parameters do not matter; the first step has hardly any
    prior, as in Foresee and Hagan.

    Args:
        equations: J^T J, J^T e and E_D = sum e^2 at given parameters.
        w: start, shape (p,).
        samples: number n of errors that E_D sums.
        squares: E_D alone, where that is cheaper; tries the steps.
        groups: group of each parameter, int64, shape (p,); one for all by default.
        names: names of the groups; "0", "1", ... by default.
        prior: w0, shape (p,); 0 by default.
        log_weights: sum of the logarithms of the errors' weights.
        max_steps: limit of accepted steps, those of a resumed `state` included.
        tolerance: relative error of alpha = gamma / 2E_g and beta = (n - gamma) / 2E_D, and gain
            of a full Gauss-Newton step in nats, below which all have settled.
        noise_floor: standard deviation of the errors at which fitting ends.
        initial_damping: mu of the first step.
        state: to go on from, bit for bit as if never interrupted; replaces `w`.
        callback: called after each accepted step with the state; True stops.
        progress: show a bar.
    References:
        Foresee and Hagan, ICNN 1997; D. J. C. MacKay, Neural Computation 4 (1992).
    """
    if samples < 1 or tolerance <= 0 or initial_damping <= 0:
        raise ValueError(
            "`samples`, `tolerance` and `initial_damping` must be positive, got "
            f"{samples}, {tolerance} and {initial_damping}."
        )
    index = torch.zeros_like(w, dtype=torch.int64) if groups is None else groups
    labels = [str(g) for g in range(int(index.max()) + 1)] if names is None else list(names)
    state = EvidenceState(w.detach().clone(), damping=initial_damping) if state is None else state
    if state.w.shape != w.shape or (state.alpha is not None and len(state.alpha) != len(labels)):
        raise ValueError(
            f"`state` has {len(state.w)} parameters and alpha {state.alpha}; this fit has "
            f"{len(w)} parameters in the groups {labels}."
        )
    centre = torch.zeros_like(w) if prior is None else prior
    data = _Data(equations, squares, samples, log_weights, centre, index, max(noise_floor, 1e-15))
    fit = _Fit(data, labels, state)
    with tqdm(total=max_steps, initial=state.step, disable=not progress, unit="step") as bar:

        def report(reached: EvidenceState) -> bool | None:
            bar.set_postfix(log_evidence=f"{fit.history[-1]:.6g}", refresh=False)
            bar.update()
            return None if callback is None else callback(reached)

        try:
            status = fit.run(max_steps, tolerance, report)
        except KeyboardInterrupt:
            status = "stopped"
    return fit.result(status)


@dataclass(frozen=True, eq=False)
class _Data:
    """What is fitted: fixed while the fit runs."""

    equations: Callable[[Tensor], NormalEquations]
    squares: Callable[[Tensor], Tensor] | None
    samples: int
    log_weights: float
    centre: Tensor
    groups: Tensor
    noise_floor: float


class _Fit:
    """Where a fit stands."""

    def __init__(self, data: _Data, names: list[str], state: EvidenceState) -> None:
        self.data, self.names, self.state = data, names, state
        p = len(state.w)
        nan = state.w.new_full((p,), math.nan)
        # Until the first evaluation nothing is known; an interrupt in it must still find a result.
        self.local = NormalEquations(nan.diag(), nan, nan.sum())
        self.history: list[float] = []
        self.not_finite = False

    def run(self, max_steps: int, tolerance: float, report: Callback) -> Status:
        self.local = self.data.equations(self.state.w)
        if not _finite(self.local):
            return "not_finite"
        if self.state.alpha is None:
            self._start()
        while True:
            known = self.posterior()
            self.history.append(known.log_evidence)
            if self._settled(known, tolerance):
                return "converged"
            unexplained = self.data.samples - float(known.gamma.sum())
            if float(self.local.squares) <= unexplained * self.data.noise_floor**2:
                return "noise_floor"
            if self.state.step >= max_steps:
                return "max_steps"
            if self.state.step > 0:
                self._reestimate(known)
            failed = self._advance()
            if failed is not None:
                return failed
            if report(self.state):
                return "stopped"

    def posterior(self) -> Posterior:
        state, data = self.state, self.data
        assert state.alpha is not None
        return posterior(
            self.local,
            state.w - data.centre,
            data.groups,
            state.alpha,
            state.beta,
            data.samples,
            data.log_weights,
        )

    def _start(self) -> None:
        """Noise as large as the errors and a prior far below the data."""
        data, local = self.data, self.local
        beta = data.samples / max(2 * float(local.squares), 1e-300)
        beta = min(beta, 0.5 / data.noise_floor**2)
        count = len(self.names)
        sizes = group_sums(torch.ones_like(local.Jte), data.groups, count)
        curvature = group_sums(local.JtJ.diagonal(), data.groups, count) / sizes
        # A group without influence at the start has no curvature to compare with.
        curvature = torch.where(curvature > 0, curvature, local.JtJ.diagonal().mean())
        alpha = 1e-6 * beta * torch.where(curvature > 0, curvature, 1.0)
        self.state = replace(self.state, alpha=alpha, beta=beta)

    def _settled(self, known: Posterior, tolerance: float) -> bool:
        """Whether the log evidence is stationary in w, log alpha and log beta."""
        alpha, gamma, n = self.state.alpha, known.gamma, self.data.samples
        assert alpha is not None
        off = (gamma - 2 * alpha * known.parameter_squares).abs() / gamma.clamp(min=1)
        unexplained = n - float(gamma.sum())
        noise_off = abs(unexplained - 2 * self.state.beta * float(self.local.squares))
        return (
            known.newton_decrement <= tolerance
            and bool((off <= tolerance).all())
            and noise_off <= tolerance * max(unexplained, 1.0)
        )

    def _reestimate(self, known: Posterior) -> None:
        data = self.data
        assert self.state.alpha is not None
        alpha, beta = reestimate(
            known,
            self.local,
            data.groups,
            self.state.alpha,
            data.samples,
            0.5 / data.noise_floor**2,
        )
        self.state = replace(self.state, alpha=alpha, beta=beta)

    def _advance(self) -> Status | None:
        """One step that lowers the objective, with as much damping as that takes."""
        state, data, local = self.state, self.data, self.local
        assert state.alpha is not None
        precision = state.alpha[data.groups]
        offset = state.w - data.centre
        system = state.beta * local.JtJ + precision.diag()
        slope = state.beta * local.Jte + precision * offset
        objective = float(state.beta * local.squares + precision @ offset.square())
        rounding = 64 * torch.finfo(slope.dtype).eps * objective
        damping = state.damping
        while damping <= LARGEST_DAMPING:
            scale, factor = factorise(system + damping * system.diagonal().diag())
            step = -scale * torch.cholesky_solve((scale * slope)[:, None], factor)[:, 0]
            predicted = -float(2 * slope @ step + step @ (system @ step))
            if damping <= 1 and predicted <= rounding:
                # The weights are where these alpha and beta want them: only those move on.
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
        """Normal equations at `w` and the objective's fall if all is finite and there is one."""
        state, data = self.state, self.data
        shrinkage = float(precision @ (w - data.centre).square())
        if data.squares is not None:
            cheap = float(state.beta * data.squares(w)) + shrinkage
            self.not_finite = not math.isfinite(cheap)
            if not cheap < objective:
                return None
        there = data.equations(w)
        self.not_finite = not _finite(there)
        # The very sum that the next objective starts from decides, not its cheap twin.
        fall = objective - float(state.beta * there.squares) - shrinkage
        return (there, fall) if fall > 0 and not self.not_finite else None

    def result(self, status: Status) -> EvidenceResult:
        state, data = self.state, self.data
        unknown = data.centre.new_full((len(self.names),), math.nan)
        alpha = unknown if state.alpha is None else state.alpha
        known = (
            self.posterior()
            if state.alpha is not None and _finite(self.local)
            else Posterior(self.local.JtJ * math.nan, unknown, math.nan, math.nan, unknown)
        )
        return EvidenceResult(
            status=status,
            w=state.w,
            alpha=self._named(alpha),
            beta=state.beta,
            gamma=self._named(known.gamma),
            error_squares=float(self.local.squares),
            parameter_squares=self._named(known.parameter_squares),
            samples=data.samples,
            log_evidence=known.log_evidence,
            covariance=known.covariance,
            steps=state.step,
            history=self.history,
            state=state,
        )

    def _named(self, values: Tensor) -> dict[str, float]:
        return dict(zip(self.names, values.tolist(), strict=True))


def _finite(equations: NormalEquations) -> bool:
    return all(bool(torch.isfinite(part).all()) for part in equations)

"""Further plant terms, by evidence: eccentric encoders, and the delay of the torque."""

from dataclasses import dataclass

import torch
from torch import Tensor

from nfriction.fitting.diagnosis import delay_in_words
from nfriction.fitting.shooting.problem import ShootingProblem
from nfriction.fitting.strategy.continuation import HorizonResult, ShootingFitter
from nfriction.optim.least_squares import Quadratic

LATE = (
    "Perhaps {}: with that delay the residual would fall by about {:.0f} %, and coefficients may "
    "move by more than their intervals."
)


def richer_by_evidence(
    base: HorizonResult, richer: ShootingFitter, tolerance: float
) -> HorizonResult | None:
    """The stage with encoder terms if the data ask for them, else None.

    The two plants are compared by their evidence in Laplace's approximation: the decrease of the
    cost less the Occam factor of the new terms, with residuals inflated for autocorrelation. A
    first prediction of the decrease from derivatives alone may save the search. The terms of
    `richer` are those of `base`, then the encoders'.

    References:
        D. J. C. MacKay, Neural Computation 4 (1992), 415-447.
    """
    further = _FurtherTerms.of(base, richer)
    # The prediction costs one step, the search it may save costs a whole fit.
    if further is None or further.predicted_gain() <= 0:
        return None
    problem, before = further.problem, further.before
    zeros = torch.zeros(further.count, dtype=torch.float64)
    start = problem.variables.start(torch.cat([base.parts.plant, zeros]), base.parts.offsets)
    found = richer.search(problem, start, tolerance, "eccentric encoders")
    end = found.result
    gain = float(before.cost) - float(end.cost)
    better = gain + further.occam(Quadratic(end.cost, end.gradient, end.hessian)) > 0
    return found if better else None


def delay_warning(found: HorizonResult, delayed: ShootingFitter) -> list[str]:
    """A sentence on the delay between torques and positions that the data ask for, if any.

    By derivatives alone: a delay below a sample hardly shows in the balance of torques, but it
    biases coefficients by more than their intervals.
    """
    further = _FurtherTerms.of(found, delayed)
    if further is None or further.predicted_gain() <= 0:
        return []
    delay = float(further.step()[further.first])
    fall = 1.0 - max(0.0, 1.0 - further.decrease() / float(further.before.cost)) ** 0.5
    return [LATE.format(delay_in_words(delay), 100 * fall)]


@dataclass(frozen=True)
class _FurtherTerms:
    """Local model of a stage with further plant terms, which begin at 0 behind its own."""

    problem: ShootingProblem
    before: Quadratic
    first: int
    count: int
    # Variables that may move, without and with the further terms.
    known: Tensor
    both: Tensor

    @classmethod
    def of(cls, base: HorizonResult, richer: ShootingFitter) -> "_FurtherTerms | None":
        count = len(richer.jacobian.terms) - len(base.problem.jacobian.terms)
        if not base.noise > 0 or count < 1:
            return None
        problem = richer.problem(base.problem.windows, base.noise, base.parts.friction)
        first = base.problem.variables.shared_count
        zeros = torch.zeros(count, dtype=torch.float64)
        at_base = torch.cat([base.result.x[:first], zeros, base.result.x[first:]])
        lower, upper = problem.variables.bounds()
        # Variables at a bound cannot move, so they take no volume of the posterior.
        known = (at_base > lower) & (at_base < upper)
        known[first : first + count] = False
        both = known.clone()
        both[first : first + count] = True
        return cls(problem, problem.linearise(at_base), first, count, known, both)

    def occam(self, after: Quadratic) -> float:
        """Logarithm of the Occam factor of the further terms."""
        precision = self.problem.variables.prior()[0][self.first : self.first + self.count]
        volume = _log_volume(after, self.both) - _log_volume(self.before, self.known)
        return 0.5 * (float(precision.log().sum()) - volume)

    def step(self) -> Tensor:
        """Gauss-Newton step with the further terms, (variable,)."""
        step = torch.zeros_like(self.before.gradient)
        step[self.both] = -_newton_step(self.before, self.both)
        return step

    def decrease(self) -> float:
        """Decrease of the cost by the further terms that derivatives predict."""
        return _newton_decrease(self.before, self.both) - _newton_decrease(self.before, self.known)

    def predicted_gain(self) -> float:
        """Gain of the log evidence that derivatives predict."""
        return self.decrease() + self.occam(self.before)


def _newton_step(local: Quadratic, chosen: Tensor) -> Tensor:
    slope = local.gradient[chosen]
    return torch.linalg.lstsq(local.hessian[chosen][:, chosen], slope).solution


def _newton_decrease(local: Quadratic, chosen: Tensor) -> float:
    """Decrease of the cost that its quadratic model predicts when the chosen variables move."""
    return 0.5 * float(local.gradient[chosen] @ _newton_step(local, chosen))


def _log_volume(local: Quadratic, chosen: Tensor) -> float:
    return float(torch.linalg.slogdet(local.hessian[chosen][:, chosen]).logabsdet)

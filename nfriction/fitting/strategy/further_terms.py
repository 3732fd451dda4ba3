"""Further plant terms, by evidence: eccentric encoders, and the delay of the torque."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from nfriction.fitting.diagnosis.corrections import delay_in_words
from nfriction.fitting.result.identifiability import Interval
from nfriction.fitting.shooting.problem import ShootingProblem
from nfriction.fitting.strategy.continuation import HorizonResult, ShootingFitter, loglik_tolerance
from nfriction.optim.least_squares import Quadratic

LATE = "Perhaps {}: with that delay the residual falls by {:.0f} %, and coefficients {}."


def richer_by_evidence(
    base: HorizonResult, richer: ShootingFitter, name: str
) -> HorizonResult | None:
    """The stage with further terms if the data support them, otherwise None.

    The two plants are compared by their evidence in Laplace's approximation: the decrease of the
    cost minus the Occam factor of the new terms, with residuals inflated for autocorrelation. A
    prediction of the decrease from derivatives may make the search unnecessary. `richer` has the
    terms of `base`, followed by the further ones; `name` is the stage's for the callback.

    References:
        D. J. C. MacKay, Neural Computation 4 (1992), 415-447.
    """
    further = _FurtherTerms.of(base, richer)
    # The prediction costs one step; the search that it may avoid costs a whole fit.
    if further is None or further.predicted_gain() <= 0:
        return None
    problem, before = further.problem, further.before
    zeros = torch.zeros(further.count, dtype=torch.float64)
    start = problem.variables.start(torch.cat([base.parts.plant, zeros]), base.parts.offsets)
    tolerance = loglik_tolerance(base.result.cost, richer.options)
    found = richer.search(problem, start, tolerance, name)
    end = found.result
    gain = float(before.cost) - float(end.cost)
    better = gain + further.occam(Quadratic(end.cost, end.gradient, end.hessian)) > 0
    return found if better else None


def delay_warning(
    found: HorizonResult, delayed: ShootingFitter, intervals: Sequence[Interval]
) -> tuple[list[str], bool]:
    """A sentence on the torque delay that the data indicate, and whether friction depends on it.

    A delay below one sample is hardly visible in the torque balance. A wrong law also looks like a
    delay; friction depends on it only if fitting it moves a coefficient out of its interval. One
    below a sample that moves none is not reported.
    """
    late = richer_by_evidence(found, delayed, "delay of the torque")
    fall = 0 if late is None else round(100 * (1 - late.rms / found.rms))
    # Below one percent: in chaotic windows the evidence includes effects not visible in residuals.
    if late is None or fall < 1:
        return [], False
    names = delayed.friction.schedule.parameter_names(delayed.jacobian.plant.joint_names)
    values = dict(zip(names, late.parts.friction.tolist(), strict=True))
    own = [(i, values[i.name]) for i in intervals if i.name in values]
    left = ", ".join(f"{i.name} {x:.3g}" for i, x in own if not i.low <= x <= i.high)
    lag = float(late.parts.plant[-1])
    if not left and abs(lag) < min(r.sample_time for r in delayed.recordings):
        return [], False
    # Only the nearest minimum was sought.
    stay = "stay within their intervals unless `fit_delay` finds another minimum"
    where = f"leave their intervals: {left}" if left else stay
    return [LATE.format(delay_in_words(lag), fall, where)], bool(left)


@dataclass(frozen=True)
class _FurtherTerms:
    """Local model of a stage with further plant terms, which start at 0 after its own terms."""

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
        own = base.problem
        problem = richer.problem(own.windows, base.noise, base.parts.friction)
        # Costs with a different integration or loss are not comparable.
        problem = replace(problem, substeps=own.substeps, loss=own.loss)
        first = base.problem.variables.shared_count
        zeros = torch.zeros(count, dtype=torch.float64)
        at_base = torch.cat([base.result.x[:first], zeros, base.result.x[first:]])
        lower, upper = problem.variables.bounds()
        # Variables at a bound cannot move, so they do not contribute to the posterior volume.
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

    def predicted_gain(self) -> float:
        """Gain in log evidence predicted from derivatives."""
        decrease = _newton_decrease(self.before, self.both)
        return decrease - _newton_decrease(self.before, self.known) + self.occam(self.before)


def _newton_decrease(local: Quadratic, chosen: Tensor) -> float:
    """Decrease of the cost that its quadratic model predicts when the chosen variables move."""
    slope = local.gradient[chosen]
    step = torch.linalg.lstsq(local.hessian[chosen][:, chosen], slope, driver="gelsd").solution
    return 0.5 * float(slope @ step)


def _log_volume(local: Quadratic, chosen: Tensor) -> float:
    return float(torch.linalg.slogdet(local.hessian[chosen][:, chosen]).logabsdet)

"""Whether a network earns its place: trained on part of the windows, judged on the rest."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache

import torch
from torch import Tensor

from nfriction.fitting.data.windows import Windows, cut_windows
from nfriction.fitting.shooting.problem import TrajectoryProblem
from nfriction.fitting.strategy.continuation import Refinement
from nfriction.optim.least_squares import Quadratic
from nfriction.optim.levenberg_marquardt import LevenbergMarquardt
from nfriction.recording import Recording
from nfriction.signals import Motion

# Of the search for the states that held back windows start from: few unknowns, close by.
STATE_STEPS, STATE_TOLERANCE = 6, 1e-4
# Every so many-th window is held back, so that all sizes of the motion are judged.
FOLDS = 3
# What a network's error on windows held back may be at most, where a recording is short and few
# windows judge: over that of the law that it corrects, fitted to the same windows as it is,
WORTH = 0.8
# and over that of the law fitted to all windows, which would be taken in its place.
HEAD_START = 1.1
# What may be taken of a correction; of what serves alike, the least.
SHARES = (0.0, 0.25, 0.5, 1.0)
# Standard errors by which a gain must show: 95 % of a normal distribution.
SURE = 2.0
# Below any error that an encoder can tell, in rad or m.
LEAST_ERROR = 1e-9


def cut_for_folds(joint: Sequence[Recording], motions: Sequence[Motion], length: float) -> Windows:
    """Windows of which some can be held back: shorter ones where the recordings are short."""
    cut = cut_windows(joint, motions, length)
    if len(cut) >= FOLDS:
        return cut
    longest = max(float(r.time[-1] - r.time[0]) for r in joint)
    return cut_windows(joint, motions, longest / FOLDS)


def judged_windows(
    refinement: Refinement, motions: tuple[Motion, ...], length: float
) -> tuple[Windows, Windows]:
    """Windows to train on and windows held back; shorter where the recordings are short."""
    cut = cut_for_folds(refinement.joint, motions, length)
    back = torch.arange(len(cut)) % FOLDS == FOLDS - 1
    return cut.subset(~back), cut.subset(back)


def shares_by_joint(errors: Callable[[Tensor], Tensor], joints: int) -> Tensor:
    """How much of a correction to take of each joint's, by windows that it has not seen.

    A window is judged by the ratio of its errors to those without the correction, and windows by
    their geometric mean: a single one of a motion that blows up all errors must not outvote the
    others. The share sought makes no joint worse and lowers the mean over joints most, which
    counts as it is at worst within twice its standard error; a smaller gain is none. First the
    same share is tried for all joints, then each joint's own until none changes.

    Args:
        errors: root mean square errors at given shares (joint,), shape (window, joint).
        joints: their number.

    Returns:
        Shares between 0 and 1, (joint,).
    """

    def logarithm(shares: tuple[float, ...]) -> Tensor:
        found = errors(torch.tensor(shares, dtype=torch.float64))
        return found.clamp_min(LEAST_ERROR).log().nan_to_num(torch.inf, torch.inf)

    without = logarithm((0.0,) * joints)

    @cache
    def change(shares: tuple[float, ...]) -> float:
        ratio = logarithm(shares) - without
        own = ratio.mean(1)
        found = own.mean() + SURE * own.std() / len(own) ** 0.5
        return float(found) if bool((ratio.mean(0) <= 0).all()) else math.inf

    best = min(((share,) * joints for share in SHARES), key=change)
    before = None
    while best != before:
        before = best
        for j in range(joints):
            best = min(((*best[:j], share, *best[j + 1 :]) for share in SHARES), key=change)
    return torch.tensor(best, dtype=torch.float64)


@dataclass(frozen=True)
class Judgement:
    """A network's error on windows held back over that of its constant law.

    Attributes:
        same: with the law fitted to the same windows as the network.
        all: with the law fitted to all windows, those held back too.
    """

    same: float
    all: float

    @property
    def score(self) -> float:
        """At most 1 where the network is worth keeping."""
        return max(self.same / WORTH, self.all / HEAD_START)

    def __str__(self) -> str:
        if math.isinf(self.score):
            return "The network diverges on windows held back; its constant law is kept."
        return (
            f"The network predicts windows held back {_change(self.same)} than its constant law "
            f"fitted to the same others, {_change(self.all)} than that fitted to all; it had to be "
            f"{_change(WORTH)} and at most {_change(HEAD_START)}, so the constant law is kept."
        )


def _change(ratio: float) -> str:
    return f"{100 * abs(ratio - 1):.3g} % {'worse' if ratio > 1 else 'better'}"


def error_on(held_back: Windows, problem: TrajectoryProblem, vector: Tensor) -> float:
    """Root mean square error of a fit on windows, each from the state that suits it best.

    The smoothed states err by more than what tells one law from another.

    Args:
        held_back: the windows.
        problem: whose model has the coefficients to judge.
        vector: terms of the plant, as they were found with these coefficients.

    Returns:
        [rad or m]; infinite where the motion diverges.

    Raises:
        KeyboardInterrupt: if interrupted: states half searched would judge the model too hard.
    """
    judged = replace(problem, windows=held_back)
    x = judged.unknowns.start(vector)
    shared = x[: judged.unknowns.shared_count]

    def own(states: Tensor) -> Quadratic:
        found = judged.quadratic(torch.cat([shared, states]))
        first = len(shared)
        blocks = (0, found.blocks[1]) if found.blocks else None
        return Quadratic(found.cost, found.gradient[first:], found.hessian[first:, first:], blocks)

    solver = LevenbergMarquardt(max_steps=STATE_STEPS, cost_tolerance=STATE_TOLERANCE)
    result = solver.minimise(
        own, x[len(shared) :], cost=lambda states: judged.cost(torch.cat([shared, states]))
    )
    if result.status == "stopped":
        raise KeyboardInterrupt
    error = float(judged.errors(torch.cat([shared, result.x])).square().mean().sqrt())
    return max(error, LEAST_ERROR) if math.isfinite(error) else math.inf

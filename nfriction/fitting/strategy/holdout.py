"""Share of a network that its law takes, by blocks of windows left out of its training.

With theta_0 the law, theta_b a network that learnt without block b, and D_j the part of
theta_b - theta_0 that belongs to joint j (stacking; Wolpert 1992),

    w = argmin sum_b |errors on b at theta_0 + sum_j w_j D_j|^2,    0 <= w_j <= 1,

by the Gauss-Newton model of the errors at theta_b. The windows of a block are consecutive: between
its neighbours a window would be too easy where friction drifts. The law has seen all blocks, which
favours it. Simulations at w decide.

References:
    D. H. Wolpert, Neural Networks 5 (1992), 241-259.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial

import torch
from torch import Tensor

from nfriction.fitting.data.windows import Windows, cut_windows
from nfriction.fitting.options import DEFAULTS, FitOptions
from nfriction.fitting.result.identifiability import information
from nfriction.fitting.shooting.problem import ShootingProblem
from nfriction.fitting.strategy.continuation import log_ratio, settle_states, student_quantile
from nfriction.optim import bounded_qp
from nfriction.recording import Recording
from nfriction.signals import Motion


def cut_for_folds(
    joint: Sequence[Recording], motions: Sequence[Motion], length: float, folds: int
) -> Windows:
    """At least `folds` windows, so that some can be held out; shorter ones of short recordings.

    Raises:
        ValueError: if the recordings have too few samples.
    """
    cut = cut_windows(joint, motions, length)
    if len(cut) >= folds:
        return cut
    # No window spans a gap, so the longest stretch between gaps has to give the windows.
    longest = max(float(r.time[last] - r.time[first]) for r in joint for first, last in r.segments)
    return cut_windows(joint, motions, longest / folds)


def training_blocks(count: int, folds: int) -> Iterator[Tensor]:
    """For each block of consecutive windows, those of all the others, bool (window,)."""
    block = torch.arange(count) * folds // count
    for k in range(folds):
        yield block != k


@dataclass(frozen=True, eq=False)
class Correction:
    """A network's deviation from its law, judged on windows that it has not seen.

    Attributes:
        problem: of these windows.
        friction, plant: parameters of the network and of the plant that was fitted with it.
        law_plant: those of the plant that was fitted with the law.
        states: of the windows' starts, near their best, (window, 2 joint).
        joint: the joint that each weight of the network acts on, -1 of parameters of its sets,
            which do nothing without weights, (parameter,).
        direction: weights of the direction of motion, bool (parameter,).
    """

    problem: ShootingProblem
    friction: Tensor
    plant: Tensor
    law_plant: Tensor
    states: Tensor
    joint: Tensor
    direction: Tensor

    @property
    def joints(self) -> int:
        return int(self.problem.windows.q0.shape[-1])

    def directions(self) -> Tensor:
        """Parameters that a share of one adds for each joint, (shared, joint).

        The change of the plant belongs to all joints alike.
        """
        own = self.joint[:, None] == torch.arange(self.joints)
        moved = (self.plant - self.law_plant) / self.joints
        return torch.cat([own * self.friction[:, None], moved[:, None].expand(-1, self.joints)])

    def shared_at(self, shares: Tensor) -> Tensor:
        """Parameters of friction and plant at shares (joint,), (shared,)."""
        whole = torch.cat([self.friction, self.plant])
        return whole - self.directions() @ (1.0 - shares)

    def settled(self, shares: Tensor) -> Tensor | None:
        """Decision variables at shares, windows at their best states; None if stopped."""
        start = torch.cat([self.shared_at(shares), self.states.flatten()])
        x, stopped = settle_states(self._without_priors, start)
        return None if stopped else x

    def squares(self, x: Tensor) -> Tensor:
        """Squared error of each window, (window,)."""
        least = self.problem.options.min_noise
        found = self.problem.counted_errors(x).square().clamp_min(least**2).sum((1, 2))
        return found.nan_to_num(math.inf, math.inf)

    def quadratic(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Slope and curvature of half the squared error over noise by the shares, at `x`."""
        problem, count = self._without_priors, len(self.friction) + len(self.plant)
        local, by = problem.linearise(x), self.directions()
        precision, _ = problem.variables.prior()
        data = information(local.hessian, precision, count).data
        # At the best states there is no slope by them to marginalise.
        return by.T @ local.gradient[:count], by.T @ data @ by

    @property
    def _without_priors(self) -> ShootingProblem:
        """The problem without priors on what all windows share."""
        flat = ((v, torch.full_like(v, math.inf)) for v in (self.friction, self.plant))
        friction, plant = flat
        return replace(self.problem, friction_prior=friction, plant_prior=plant, extrapolation=None)


@dataclass(frozen=True)
class Judgement:
    """Shares of a network and what they gain on windows left out.

    Attributes:
        shares: of the correction, between 0 and 1, (joint,).
        ratio: of the root mean square errors with to without, as a logarithm.
        spread: its standard deviation.
        windows: number of windows left out.
        direction: ratio of the errors with to without the direction as an input, as a logarithm.
    """

    shares: Tensor
    ratio: float
    spread: float
    windows: int
    direction: float = 0.0
    options: FitOptions = DEFAULTS

    @property
    def kept(self) -> bool:
        """True if the gain is more than chance."""
        return self.ratio + self._chance < 0

    @property
    def _chance(self) -> float:
        """Half-width of the one-sided interval of `ratio`."""
        return self.spread * student_quantile(self.windows - 1, 1 - self.options.gain_level)

    def statement(self, names: Sequence[str]) -> str:
        """Shares of a network that is kept, and what they gain."""
        parts = ", ".join(
            f"{share:.2g} of {name}'s"
            for share, name in zip(self.shares.tolist(), names, strict=True)
        )
        return (
            f"By blocks left out each joint takes a share of the network's correction: {parts}; "
            f"errors there are {_change(self.ratio)} than the constant law's, and "
            f"{_change(self.direction)} than without the direction of motion as an input."
        )

    def rejection(self) -> str:
        """Reason why a network is not kept."""
        if not math.isfinite(self.ratio):
            return "Network rejected: it diverges on blocks left out; its constant law is kept."
        chance = f"; chance may account for {100 * (1 - math.exp(-self._chance)):.3g} %"
        return (
            f"Network rejected: on blocks left out it was {_change(self.ratio)} than the constant "
            f"law{chance if self.ratio < 0 else ''}; the constant law is kept."
        )


def _change(ratio: float) -> str:
    return f"{100 * abs(math.expm1(ratio)):.3g} % {'worse' if ratio > 0 else 'better'}"


def judge(corrections: Sequence[Correction]) -> Judgement | None:
    """Shares of a correction from networks that each left out a block; None if stopped."""
    joints = corrections[0].joints
    full, none = torch.ones(joints, dtype=torch.float64), torch.zeros(joints, dtype=torch.float64)
    slope, curvature = none.clone(), torch.zeros(joints, joints, dtype=torch.float64)
    for correction in corrections:
        x = correction.settled(full)
        if x is None:
            return None
        first, second = correction.quadratic(x)
        slope, curvature = slope + first, curvature + second
    options = corrections[0].problem.options
    if not (slope.isfinite().all() and curvature.isfinite().all()):
        return Judgement(none, math.inf, math.inf, 0, options=options)
    solve = partial(bounded_qp.solve_free, blocks=None)
    free = torch.ones(joints, dtype=torch.bool)
    shares = 1.0 + bounded_qp.minimise(curvature, slope, -full, none, free, solve)
    blind = [replace(c, friction=c.friction.where(~c.direction, 0.0)) for c in corrections]
    squares = []
    for trial, at in ((corrections, shares), (corrections, none), (blind, shares)):
        states = [correction.settled(at) for correction in trial]
        if any(x is None for x in states):
            return None
        pairs = zip(trial, states, strict=True)
        squares.append(torch.cat([c.squares(x) for c, x in pairs if x is not None]))
    ratio, spread = log_ratio(*squares[:2])
    by_direction, _ = log_ratio(squares[0], squares[2])
    return Judgement(shares, ratio, spread, len(squares[0]), by_direction, options)

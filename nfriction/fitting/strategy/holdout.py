"""Hold-out validation of a network: trained on some windows, judged on the others."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from nfriction.fitting.data.windows import Windows, cut_windows
from nfriction.fitting.options import DEFAULTS, FitOptions
from nfriction.fitting.shooting.problem import ShootingProblem
from nfriction.fitting.strategy.continuation import settle_states
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


def holdout_split(
    joint: Sequence[Recording], motions: Sequence[Motion], length: float, folds: int
) -> tuple[Windows, Windows]:
    """Windows to train on, and every `folds`-th one to test on."""
    cut = cut_for_folds(joint, motions, length, folds)
    test = torch.arange(len(cut)) % folds == folds - 1
    return cut.subset(~test), cut.subset(test)


@dataclass(frozen=True)
class HoldoutScore:
    """Hold-out RMSE of a network over that of its constant law.

    `same` is the ratio to the law fitted to the same windows, `all` to the law fitted to all.
    """

    same: float
    all: float
    options: FitOptions = DEFAULTS

    @property
    def score(self) -> float:
        """At most 1 if the network is worth keeping."""
        return max(self.same / self.options.max_ratio_same, self.all / self.options.max_ratio_all)

    def __str__(self) -> str:
        if math.isinf(self.score):
            return "Network rejected: it diverges on hold-out windows; its constant law is kept."
        ratio, limit, data = self.all, self.options.max_ratio_all, "all data"
        if self.same / self.options.max_ratio_same > self.all / self.options.max_ratio_all:
            ratio, limit, data = self.same, self.options.max_ratio_same, "the same windows"
        return (
            f"Network rejected: on hold-out windows it was {_change(ratio)} than the constant law "
            f"fitted to {data} (limit: {_change(limit)}); the constant law is kept."
        )


def _change(ratio: float) -> str:
    return f"{100 * abs(ratio - 1):.3g} % {'worse' if ratio > 1 else 'better'}"


def holdout_rmse(
    test: Windows, problem: ShootingProblem, friction: Tensor, plant: Tensor
) -> float | None:
    """Root mean square error on windows [rad; m], each simulated from its best initial state.

    Smoothed states err by more than the difference between two laws. Infinite where the motion
    diverges, None where the search was interrupted. The problem is of other windows with the same
    friction model and plant, whose parameters are given.
    """
    if problem.friction.law.memory:
        test = test.deflected(problem.jacobian.plant, problem.friction)
    judged = replace(problem, windows=test)
    x, stopped = settle_states(judged, judged.variables.start(plant, friction=friction))
    if stopped:
        return None
    error = float(judged.counted_errors(x).square().mean().sqrt())
    return max(error, problem.options.min_noise) if math.isfinite(error) else math.inf

"""Whether a network earns its place: trained on part of the windows, judged on the rest."""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache

import torch
from torch import Tensor

from nfriction.fitting.stages import Refinement, Stage
from nfriction.fitting.windows import Windows, cut_windows
from nfriction.recording import Recording
from nfriction.signals import Motion

# Every so many-th window is held back, so that all sizes of the motion are judged.
FOLDS = 3
# A network's error on windows held back must be at most so much of that of the law that it
# corrects, fitted to the same windows: where a recording is short few windows judge.
WORTH = 0.9
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


def ratio_on(held_back: Windows, network: Stage, constant: Stage, mean: Tensor) -> float:
    """Error of a network on windows held back over that of its constant law.

    Both were trained on the other windows and start from the smoothed states, as a score does. They
    move the same plant, that of a fit to all windows: an inertia that is off by some parts in ten
    thousand shifts a swing by more than friction does. Infinite where the network diverges.

    Args:
        held_back: windows that neither has seen.
        network, constant: their searches on the others.
        mean: terms of the plant.
    """

    def error(stage: Stage) -> Tensor:
        judged = replace(stage.problem, windows=held_back)
        return judged.errors(judged.start(mean)).square().mean().sqrt()

    ratio = float(error(network) / error(constant))
    return ratio if math.isfinite(ratio) else math.inf

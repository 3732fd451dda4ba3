"""Hold-out validation: training on some windows or recordings and testing on the others."""

import math
from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from nfriction.fitting.data.windows import Windows, cut_windows, moving_segments
from nfriction.fitting.shooting.problem import ShootingProblem
from nfriction.fitting.shooting.variables import model_at
from nfriction.fitting.strategy.continuation import settle_states
from nfriction.recording import Recording
from nfriction.signals import Motion


class StoppedError(Exception):
    """The caller stopped a search whose result was to be judged."""


def cut_for_folds(
    joint: Sequence[Recording], motions: Sequence[Motion], length: float, folds: int
) -> Windows:
    """At least `folds` windows, so that some can be held out; shorter ones for short recordings."""
    cut = cut_windows(joint, motions, length)
    if len(cut) >= folds:
        return cut
    # No window spans a gap, so the longest segment between gaps has to provide the windows.
    return cut_windows(joint, motions, max(_durations(joint, motions)) / folds)


def holdout_windows(
    joint: Sequence[Recording], motions: Sequence[Motion], length: float, folds: int
) -> Windows:
    """Windows of a length [s] for `holdout_splits`, or so short that each split holds out several.

    Each then lies between training windows of similar motion; otherwise the largest third of a
    decaying swing, for example, would be tested with what was learned from the smaller swings.
    """
    total = sum(_durations(joint, motions))
    return cut_for_folds(joint, motions, min(length, total / folds**2), folds)


def _durations(joint: Sequence[Recording], motions: Sequence[Motion]) -> list[float]:
    pairs = [(r, s) for r, m in zip(joint, motions, strict=True) for s in moving_segments(r, m)]
    return [float(r.time[last] - r.time[first]) for r, (first, last) in pairs]


def holdout_splits(windows: Windows, folds: int) -> list[tuple[Windows, Windows]]:
    """Training and test windows: every `folds`-th is for testing, each in exactly one split."""
    fold = torch.arange(len(windows)) % folds
    return [(windows.subset(fold != k), windows.subset(fold == k)) for k in reversed(range(folds))]


def recording_splits(windows: Windows, folds: int) -> list[tuple[Windows, Windows]]:
    """Training and test windows of different recordings, in at most `folds` groups."""
    place = torch.tensor([place for place, *_ in windows.spans])
    place = place.unique(return_inverse=True)[1]  # some recordings may have no window
    count = int(place.max()) + 1
    group = place * min(folds, count) // count
    return [(windows.subset(group != k), windows.subset(group == k)) for k in group.unique()]


def verdict(network: Tensor, law: Tensor, blocks: str = "windows", least: float = 1.0) -> str:
    """Sentence that rejects a network, from squared errors on each hold-out block, (block,).

    `blocks` names the blocks: windows or recordings; `least` is the required gain, see `improves`.
    """
    change = 100 * (math.sqrt(float(network.sum() / law.sum())) - 1)
    if math.isinf(change):
        return f"Network rejected: it diverges on hold-out {blocks}; its constant law is kept."
    better, tied = int((network < law).sum()), int((network == law).sum())
    if tied == len(law):  # errors count as no smaller than the noise
        return (
            f"Network rejected: its constant law already explains the hold-out {blocks} to the "
            "noise; the constant law is kept."
        )
    ties = f" (equal on {tied})" if tied else ""
    if 2 * tied > len(law):
        ties = f" and equal on {tied}, most of which the law already explains to the noise"
    gain = f" ({100 * (least - 1):.0f} % and more than the scatter are required)"
    return (
        f"Network rejected: its error on hold-out {blocks} was {abs(change):.3g} % "
        f"{'more' if change > 0 else 'less'} than that of its constant law, and lower on {better} "
        f"of {len(law)}{ties}{'' if change > 0 else gain}; the constant law is kept."
    )


def settled(
    test: Windows,
    problem: ShootingProblem,
    friction: Tensor,
    plant: Tensor,
) -> Tensor:
    """Mean squared error on each window [rad^2; m^2], (window,), from its best initial state.

    The errors of smoothed states exceed the difference between two laws. Infinite where the motion
    diverges. The problem is that of other windows with the same friction model and plant, whose
    parameters are given.

    Raises:
        StoppedError: if the search for the initial states was interrupted.
    """
    model = model_at(problem.friction, friction)
    judged = replace(problem, windows=test.with_states(problem.jacobian.plant, model))
    x, stopped = settle_states(judged, judged.variables.start(plant, friction=friction))
    if stopped:
        raise StoppedError
    squares = judged.counted_errors(x).square().mean((1, 2)).nan_to_num(nan=math.inf)
    return squares.clamp_min(problem.options.min_noise**2)

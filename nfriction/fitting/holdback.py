"""Whether a network earns its place: trained on part of the windows, judged on the rest."""

import math
from dataclasses import replace

import torch
from torch import Tensor

from nfriction.fitting.stages import Refinement, Stage
from nfriction.fitting.windows import Windows, cut_windows
from nfriction.signals import Motion

# Every so many-th window is held back, so that all sizes of the motion are judged.
FOLDS = 3
# How much worse a network may do on windows held back than the law that it corrects: that law has
# seen them, and where a recording is short few windows judge.
HEAD_START = 1.1


def judged_windows(
    refinement: Refinement, motions: tuple[Motion, ...], length: float
) -> tuple[Windows, Windows]:
    """Windows to train on and windows held back; shorter where the recordings are short."""
    cut = cut_windows(refinement.joint, motions, length)
    if len(cut) < FOLDS:
        longest = max(float(r.time[-1] - r.time[0]) for r in refinement.joint)
        cut = cut_windows(refinement.joint, motions, longest / FOLDS)
    back = torch.arange(len(cut)) % FOLDS == FOLDS - 1
    return cut.subset(~back), cut.subset(back)


def gain_on(held_back: Windows, trained: Stage, mean: Tensor) -> float:
    """Error on windows held back over that of the constant law from which a network started.

    Both start from the smoothed states, as a score does, and move the constant law's plant: that
    one has seen all windows, and an inertia that is off by some parts in ten thousand shifts a
    swing by more than friction does. Infinite where the network diverges.

    Args:
        held_back: windows that the network has not seen.
        trained: the network's search on the others.
        mean: plant terms of the constant law.
    """
    problem = trained.problem
    schedule = problem.friction.schedule
    network = schedule.parameter_vector()
    judged = replace(problem, windows=held_back)
    own = judged.errors(judged.start(mean)).square().mean()
    schedule.set_parameter_vector(torch.zeros_like(network))
    constant = judged.errors(judged.start(mean)).square().mean()
    schedule.set_parameter_vector(network)
    ratio = float((own / constant).sqrt())
    return ratio if math.isfinite(ratio) else math.inf

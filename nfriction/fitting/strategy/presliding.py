"""Starts for laws with memory, and stiffness that the data do not determine.

Presliding may extend over a thousandth of an encoder count or over thousands of counts, so
displacements are tried one by one on short windows.
"""

import itertools
import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from nfriction.fitting.shooting.uncertainty import rounding
from nfriction.fitting.strategy.continuation import HorizonResult, ShootingFitter
from nfriction.friction.coefficients import Constant
from nfriction.friction.laws import Law
from nfriction.signals import Motion

# Presliding displacements, relative to the range of the motion, and ratios of damping to stiffness
# [s]: from hardly visible to values that mean no presliding.
PRESLIDING = tuple(np.geomspace(1e-5, 1.0, 11).tolist())
BRISTLE_TIMES = (1e-4, 1e-3, 1e-2, 1e-1)
# Distance from a reversal, relative to that range, beyond which a contact certainly slides.
TRAVELLED = 0.1
# Relative excess of static friction, which torques of sticking joints do not show.
PEAKS = (0.1, 0.3, 1.0)
# Number of displacements searched if the residual of the first exceeds the encoder's rounding.
MOST_STARTS = 4

# Stiffness and damping of an alternative relative to those found: its contacts relax at once.
STIFFER = (5.0, 0.01)


def presliding_starts(
    fitter: ShootingFitter, sliding: Tensor, apart: Tensor, plant: Tensor,
    motions: tuple[Motion, ...],
) -> Iterator[Tensor]:  # fmt: skip
    """Coefficients of a law with memory to start from, (joint, coefficient), the best first.

    `sliding` contains sets of coefficients implied by torques, (set, joint, coefficient), which
    describe only sliding; `apart`, (joint, coefficient), is the first set computed from torques far
    from reversals, and replaces that set if it fits short windows better. Presliding displacement
    (relative to the joint's range) and damping (a time) are chosen by the cost of short windows;
    then likewise the excess of static friction and its velocity. Several displacements of the first
    set follow, and the best of every other set if the law has no such excess.
    """
    for place, coefficients in enumerate(sliding):
        if place and peaked(fitter.friction.law, coefficients):
            return
        found = _yielding_alike(fitter, coefficients, plant, motions)
        if not place:
            rivals = found, _yielding_alike(fitter, apart, plant, motions)
            found = min(rivals, key=lambda starts: starts[0].rank())
        yield from (start.coefficients for start in found[: 1 if place else MOST_STARTS])


def _yielding_alike(
    fitter: ShootingFitter, coefficients: Tensor, plant: Tensor, motions: tuple[Motion, ...]
) -> "list[_Start]":
    """Best coefficients for each displacement, in ascending order of the cost of short windows."""
    law, windows = fitter.friction.law, fitter.cut(motions, fitter.options.windows[0])
    ranges = np.max([np.ptp(m.q, axis=0) for m in motions], axis=0)

    def yields(share: float, time: float, base: Tensor, joints: Sequence[int]) -> _Start:
        trial = base.clone()
        for j in joints:
            trial[j] = yielding(law, base[j], share * float(ranges[j]), time)
        return tried(trial)

    def tried(trial: Tensor) -> _Start:
        problem = fitter.problem(windows, fitter.options.first_noise, trial.reshape(-1))
        return _Start(float(problem.cost(problem.variables.start(plant))), trial)

    def best(joints: Sequence[int], base: Tensor) -> list[_Start]:
        rows = ([yields(s, t, base, joints) for t in BRISTLE_TIMES] for s in PRESLIDING)
        return sorted((min(row, key=_Start.rank) for row in rows), key=_Start.rank)

    # First all joints together, then each separately.
    everyone = range(len(coefficients))
    found = best(everyone, coefficients)
    while peaks := [tried(trial) for trial in peaked(law, found[0].coefficients)]:
        peak = min(peaks, key=_Start.rank)
        if not peak.rank() < found[0].rank():
            break
        found = best(everyone, peak.coefficients)
    for j in range(len(coefficients)) if len(coefficients) > 1 else ():
        found = [*best([j], found[0].coefficients)[:1], *found]
    return sorted(found, key=_Start.rank)


class _Start(NamedTuple):
    cost: float
    coefficients: Tensor

    def rank(self) -> float:
        return self.cost if math.isfinite(self.cost) else math.inf


def ambiguous_stiffness(
    fitter: ShootingFitter, found: HorizonResult, stage: HorizonResult
) -> list[str]:
    """Names of stiffness and damping of bristles that the data do not determine.

    Presliding that the encoder does not resolve has minima of about equal cost at very different
    stiffness. A search from much stiffer bristles finds another one; if it differs by more than a
    factor of two and the likelihood does not favour the first, the value is not identifiable. The
    same holds if a search ended early and the other explains the motion to encoder resolution.
    `stage` has short windows, whose states hardly trap a search.
    """
    from scipy.special import chdtri  # slow to import

    problem, law = stage.problem, stage.problem.friction.law
    count, tolerance = problem.variables.shared_count, fitter.options.loose_tolerance
    # Terms that only the final stage may have are last.
    start = torch.cat([found.result.x[:count], stage.result.x[count:]])
    found = fitter.search(problem, start, tolerance, "stiffness")
    places = [law.names.index(name) for name in ("sigma_0", "sigma_1") if name in law.names]
    table = found.parts.friction.reshape(-1, len(law.names)).clone()
    table[:, places] *= torch.tensor(STIFFER[: len(places)])
    lower, upper = problem.friction.schedule.bounds()
    start = torch.cat([table.reshape(-1).clamp(lower, upper), found.result.x[table.numel() :]])
    rival = fitter.search(problem, start, tolerance, "stiffer bristles")
    # The noise of a first stage is a guess.
    lost = float(rival.result.cost - found.result.cost) * (problem.noise_sd / found.noise) ** 2
    # If a search ended before its minimum, its cost cannot be compared as a likelihood.
    early = not (found.result.converged and rival.result.converged)
    explained = early and rival.rms <= rounding(problem)
    if not (explained or lost < 0.5 * float(chdtri(len(table) * len(places), 0.05))):
        return []
    apart = (rival.parts.friction / found.parts.friction).log().abs().reshape(table.shape)
    names = problem.friction.schedule.parameter_names(problem.jacobian.plant.joint_names)
    return [
        names[j * table.shape[1] + k]
        for j in range(len(table)) if apart[j, places[0]] > math.log(2.0) for k in places
    ]  # fmt: skip


def peaked(law: Law, coefficients: Tensor) -> list[Tensor]:
    """Coefficients (joint, coefficient) with other excesses of static friction."""
    if not {"F_c", "F_d", "v_s"} <= set(law.names):
        return []
    found = []
    coulomb, rise, velocity = (law.names.index(name) for name in ("F_c", "F_d", "v_s"))
    for share, v_s in itertools.product(PEAKS, law.coefficients[velocity].initial_grid):
        trial = coefficients.clone()
        trial[:, rise], trial[:, velocity] = share * trial[:, coulomb], v_s
        found.append(trial)
    return found


def yielding(law: Law, coefficients: Tensor, displacement: float, time: float) -> Tensor:
    """Coefficients of one joint with the same sliding friction and a presliding displacement.

    `time` is the ratio of the damping of a bristle to its stiffness [s]. Laws with other names for
    these coefficients are left unchanged.
    """
    values = dict(zip(law.names, coefficients.tolist(), strict=True))
    widths = [name for name in values if name.startswith("d_") and f"k{name[1:]}" in values]
    if {"sigma_0", "F_c"} <= values.keys():
        values["sigma_0"] = values["F_c"] / max(displacement, 1e-12)
        values["sigma_1"] = time * values["sigma_0"]
    elif widths:
        scale = displacement / max(values[name] for name in widths)
        for name in widths:
            values[name] *= scale
            values["k" + name[1:]] /= scale
    found = torch.tensor([values[name] for name in law.names], dtype=torch.float64)
    lower, upper = Constant(law, 1, found).bounds()
    return found.clamp(lower, upper)

"""A law that is not linear, searched from where the simpler law that it contains ended."""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import torch
from torch import Tensor

from nfriction.fitting.data.inputs import constant_schedule
from nfriction.fitting.data.windows import Windows
from nfriction.fitting.strategy.continuation import LEAST_NOISE, Refinement, Stage, flat, least
from nfriction.fitting.strategy.growing import through_windows
from nfriction.friction.laws import Law
from nfriction.friction.models import FrictionModel
from nfriction.plant import Plant
from nfriction.signals import Motion


def from_simpler(
    search: Refinement,
    own: Stage,
    left_out: tuple[float, ...],
    simpler: FrictionModel,
    windows: Sequence[float],
    vector: Tensor,
    motions: tuple[Motion, ...],
    by_torque: Callable[[Plant], Tensor],
) -> tuple[Stage, tuple[float, ...]]:
    """The lowest end of a law, also looked for from its simpler law's; see `lowest_of`.

    Args:
        search: of the law.
        own, left_out: its end, and the lengths of windows left out on the way there.
        simpler: model of the simpler law, at what torques tell.
        windows, vector, motions: see `through_windows`.
        by_torque: coefficients of the law that torques tell on a plant, (joint, coefficient).

    Returns:
        Its stage, and the lengths of windows left out on the way to it.
    """
    base, without = through_windows(
        replace(search, model=simpler), windows, vector, motions, of=f", {simpler.law.name} law"
    )
    lowest = lowest_of(search, own, base, by_torque)
    return lowest, left_out if lowest.problem is own.problem else without


def lowest_of(
    search: Refinement, own: Stage, simpler: Stage, by_torque: Callable[[Plant], Tensor]
) -> Stage:
    """A law's own end, or a lower one that it reaches from where the simpler law ended.

    A law that is not linear has several minima, and to which of them torques lead depends on the
    plant. So it is searched again from what they tell on the simpler law's; and as long as it is
    above the law that it contains, from there. Priors guide each search; between their ends what is
    left over counts alone. The model is left with the lowest; with one of longer windows where only
    the simpler law could follow them.

    Args:
        search: of the law.
        own, simpler: its end, and that of the simpler law.
        by_torque: coefficients of the law that torques tell on a plant, (joint, coefficient).
    """
    if simpler.result.status == "stopped":
        return _stopped(own)
    windows = _from_its_end(simpler)
    # Where one of the two could not follow the longest windows, what they left over is no measure.
    alike = windows.spans == own.problem.windows.spans
    if not alike and len(windows) >= len(own.problem.windows):
        return own
    # By what the worse of the two could not explain, priors would outweigh the data.
    sizes = (own.noise, simpler.noise, own.problem.noise_sd, simpler.problem.noise_sd)
    noise = max(min(size for size in sizes if math.isfinite(size)), LEAST_NOISE)
    schedule, name = constant_schedule(search.model), simpler.problem.friction.law.name
    told = by_torque(own.problem.plant_at(simpler.vector))
    known = constant_schedule(simpler.problem.friction).values
    contained = _left_over(simpler, noise)
    best, lowest = own, _left_over(own, noise) if alike else math.inf
    tolerance = flat(min(lowest, contained))
    for start in (told, _lifted(search.model.law, known, told)):
        if start is not told and lowest <= contained:
            break
        schedule.set_coefficients(start)
        problem = search.problem(windows, noise)
        stage = search.search(
            problem, simpler.vector, tolerance, f"from the {name} law", simpler.zeros
        )
        left, surer = _left_over(stage, noise), _surer(stage, best)
        if left < lowest * (1 - tolerance) or (surer and left < lowest * (1 + tolerance)):
            best, lowest = stage, left
        if stage.result.status == "stopped":
            best = _stopped(best)
            break
    schedule.set_parameter_vector(best.problem.unknowns.split(best.result.x)[0])
    return best


def _from_its_end(stage: Stage) -> Windows:
    """The windows of a stage with the states that it found, but for those that are known."""
    windows = stage.problem.windows
    q0, qd0 = (x.clone() for x in stage.problem.unknowns.split(stage.result.x)[2].chunk(2, -1))
    known = list(windows.at_rest)
    q0[known], qd0[known] = windows.q0[known], windows.qd0[known]
    return replace(windows, q0=q0, qd0=qd0)


def _left_over(stage: Stage, noise: float) -> float:
    """Half the sum of squares of residuals and jumps; infinite where the motion diverged."""
    jumps = 0.5 * float(stage.problem.jumps(stage.result.x).square().sum())
    left = least(stage.residuals, noise) + jumps
    return left if math.isfinite(left) else math.inf


def _surer(stage: Stage, other: Stage) -> bool:
    return stage.result.converged and not other.result.converged


def _lifted(law: Law, simpler: Tensor, shapes: Tensor) -> Tensor:
    """Coefficients at which a law is the simpler one that it contains, (joint, coefficient).

    Args:
        law: the law.
        simpler: coefficients of the simpler law.
        shapes: coefficients of the law, of which those are taken in which it is not linear.
    """
    linear = torch.tensor([c.linear for c in law.coefficients])
    lifted = torch.where(linear, 0.0, shapes)
    lifted[:, [law.names.index(name) for name in law.nested_coefficients]] = simpler
    return lifted


def _stopped(stage: Stage) -> Stage:
    return replace(stage, result=replace(stage.result, status="stopped"))

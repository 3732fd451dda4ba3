"""A law that is not linear, searched from where the simpler law that it contains ended."""

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from nfriction.fitting.outcome import Plant
from nfriction.fitting.preparation import constant_schedule
from nfriction.fitting.stages import LEAST_NOISE, Refinement, Stage, flat, least
from nfriction.friction import Law


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
    states = simpler.problem.unknowns.split(simpler.result.x)[2].chunk(2, -1)
    windows = replace(simpler.problem.windows, q0=states[0], qd0=states[1])
    # Where one of the two could not follow the longest windows, what they left over is no measure.
    alike = windows.spans == own.problem.windows.spans
    if not alike and len(windows) >= len(own.problem.windows):
        return own
    # By the worse of the two, priors would outweigh what it cannot explain.
    noise = max(np.fmin(own.noise, simpler.noise), LEAST_NOISE)
    schedule, problem = constant_schedule(search.model), search.problem(windows, noise)
    told = by_torque(problem.plant_at(simpler.vector))
    known = constant_schedule(simpler.problem.friction).values
    of_simpler = least(simpler.residuals, noise)
    best, lowest = own, least(own.residuals, noise) if alike else math.inf
    if not math.isfinite(lowest):
        lowest = math.inf
    tolerance = flat(min(lowest, of_simpler))
    for start in (told, _lifted(search.model.law, known, told)):
        if start is not told and lowest <= of_simpler:
            break
        schedule.set_coefficients(start)
        stage = search.search(
            problem, simpler.vector, tolerance,
            f"from the {simpler.problem.friction.law.name} law", simpler.zeros,
        )  # fmt: skip
        over = least(stage.residuals, noise)
        if over < lowest * (1 - tolerance):
            best, lowest = stage, over
        if stage.result.status == "stopped":
            best = _stopped(best)
            break
    schedule.set_parameter_vector(best.problem.unknowns.split(best.result.x)[0])
    return best


def _lifted(law: Law, simpler: Tensor, shapes: Tensor) -> Tensor:
    """Coefficients at which a law is the simpler one that it contains, (joint, coefficient).

    Args:
        law: the law.
        simpler: coefficients of the simpler law.
        shapes: coefficients of the law, of which those are taken in which it is not linear.
    """
    linear = torch.tensor([c.linear for c in law.coefficients])
    lifted = torch.where(linear, 0.0, shapes)
    lifted[:, [law.names.index(name) for name in law.shared]] = simpler
    return lifted


def _stopped(stage: Stage) -> Stage:
    return replace(stage, result=replace(stage.result, status="stopped"))

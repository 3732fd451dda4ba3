"""Windows of growing length, each length searched from where the one before it ended."""

from collections.abc import Callable, Sequence

from torch import Tensor

from nfriction.fitting.data.inputs import constant_schedule
from nfriction.fitting.data.windows import cut_windows
from nfriction.fitting.strategy.continuation import LEAST_NOISE, Refinement, Stage, flat, least
from nfriction.plant import Plant
from nfriction.signals import Motion

# First guess of what a model of a bench leaves unexplained, before a fit tells [rad or m].
FIRST_NOISE = 1e-3
# Relative fall of the cost that ends a search of which only the neighbourhood matters.
LOOSE = 1e-4


def through_windows(
    search: Refinement,
    windows: Sequence[float],
    vector: Tensor,
    motions: tuple[Motion, ...],
    by_torque: Callable[[Plant], Tensor] | None = None,
    of: str = "",
) -> tuple[Stage, tuple[float, ...]]:
    """Stages of growing length, each from the states and weighed by the errors of the last.

    At the first length that the motion does not allow, the last one before it is returned, with all
    lengths that are left out.

    With coefficients `by_torque` on a plant, the first stage is searched a second time from what
    they are on the plant that it found: a law that is not linear has several minima, and on an
    inertia that is a little wrong the torques lead to a worse one.
    """
    reached: Stage | None = None
    zeros: Tensor | None = None
    noise, traced = FIRST_NOISE, motions
    for place, length in enumerate(windows):
        # Encoders that were zeroed where dry friction held the links were zeroed at rest.
        cut = cut_windows(search.joint, traced, length, from_rest=search.zero_sd is not None)
        problem = search.problem(cut, noise, far=reached is None and len(windows) > 1)
        tolerance = LOOSE
        if length == windows[-1]:
            # Of a start far away the cost says nothing; the last stage's minimum is as high.
            near = reached and least(reached.residuals, noise)
            tolerance = flat(near or float(problem.cost(problem.unknowns.start(vector))))
        name = f"{length:g} s windows{of}"
        stage = search.search(problem, vector, tolerance, name, zeros)
        if reached is None and by_torque is not None and stage.result.status != "stopped":
            stage = _better_start(search, stage, tolerance, name, by_torque)
        if reached is not None and stage.lost_since(reached):
            schedule = search.model.schedule
            schedule.set_parameter_vector(reached.problem.unknowns.split(reached.result.x)[0])
            return reached, tuple(windows[place:])
        reached, vector, noise = stage, stage.vector, max(stage.noise, LEAST_NOISE)
        zeros = stage.zeros
        if stage.result.status == "stopped":
            break
        traced = problem.traced(stage.result.x, traced)
    assert reached is not None
    return reached, ()


def _better_start(
    search: Refinement,
    stage: Stage,
    tolerance: float,
    name: str,
    by_torque: Callable[[Plant], Tensor],
) -> Stage:
    """A stage, or the same searched from the coefficients by torque on its plant if that is better.

    The model is left with the coefficients of the one returned.
    """
    problem, schedule = stage.problem, constant_schedule(search.model)
    found = schedule.parameter_vector()
    schedule.set_coefficients(by_torque(problem.plant_at(stage.vector)))
    other = search.search(problem, stage.vector, tolerance, name, stage.zeros)
    if other.result.status == "stopped" or other.result.cost < stage.result.cost:
        return other
    schedule.set_parameter_vector(found)
    return stage

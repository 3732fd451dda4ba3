"""Fit the constant law: torques first, then windows of growing length."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from nfriction.fitting.eccentricity import may_be_eccentric, richer_by_evidence
from nfriction.fitting.nested import lowest_of
from nfriction.fitting.outcome import Continuity, Fit, Plant, torque_outcome, trajectory_outcome
from nfriction.fitting.preparation import (
    adjustable_terms,
    constant_schedule,
    in_joint_coordinates,
    is_eccentric,
    mixing_of,
)
from nfriction.fitting.stages import JUMP_SD, LEAST_NOISE, Callback, Refinement, Stage, flat, least
from nfriction.fitting.torque import TorqueFit, fit_torque, prior_sd
from nfriction.fitting.windows import cut_windows
from nfriction.friction import Constant, FrictionModel
from nfriction.recording import Recording
from nfriction.signals import Motion

TOO_LONG = (
    "Windows of {:g} s are too long for this motion, which forgets its start within them, or for a "
    "law or plant that is wrong; left out."
)
# Dry friction of a tenth of a link's largest gravity moment lets it rest up to 0.1 rad off [rad].
ZERO_SD = 0.05
# First guess of what a model of a bench leaves unexplained, before a fit tells [rad or m].
FIRST_NOISE = 1e-3
# Short windows converge from far away, long ones tell small friction and small drag apart [s].
WINDOWS = (0.5, 2.0, 5.0)
# Relative fall of the cost that ends a search of which only the neighbourhood matters.
LOOSE = 1e-4


@dataclass(frozen=True)
class Settings:
    """What a fit from trajectories is asked for; see `fit`, whose defaults these are."""

    windows: Sequence[float] = WINDOWS
    fit_plant: bool = True
    drag: bool | None = None
    eccentricity: bool | None = False
    continuity: Continuity = "free"
    max_steps: int = 30
    callback: Callback | None = None


def fit_by_torque(
    model: FrictionModel,
    plant: Plant,
    recordings: Sequence[Recording],
    motions: tuple[Motion, ...],
    start: Fit | None = None,
) -> Fit:
    """The constant coefficients that the torques of the smoothed motion imply.

    Args:
        model, plant, recordings, motions: see `fit_constant`.
        start: an earlier fit, whose plant is taken.
    """
    joint = in_joint_coordinates(plant, model, recordings)
    torque = _set_by_torque(model, start.plant if start else plant, joint, motions)
    return torque_outcome(model, start, plant, motions, torque)


def fit_constant(
    model: FrictionModel,
    plant: Plant,
    recordings: Sequence[Recording],
    motions: tuple[Motion, ...],
    start: Fit | None,
    settings: Settings,
    *,
    each: bool,
) -> Fit:
    """The fit of constant coefficients, by torques and then by trajectories.

    Args:
        model: changed in place.
        plant: the mechanism as given.
        recordings: as they are written, all in one convention.
        motions: the smoothed motion of each, in joint coordinates.
        start: an earlier fit, whose plant the torques take and whose terms the search starts at.
        settings: see `fit`.
        each: whether encoders were zeroed anew at the start of each recording.
    """
    joint = in_joint_coordinates(plant, model, recordings)
    _set_by_torque(model, start.plant if start else plant, joint, motions)
    mixing = mixing_of(plant, recordings[0].convention_on(plant))
    known = {name: value for name, value, _ in start.plant_terms} if start else {}
    zero_sd = torch.full((len(joint), plant.joints), ZERO_SD, dtype=torch.float64)

    def refinement(eccentric: bool) -> Refinement:
        terms = adjustable_terms(
            plant, joint, settings.fit_plant, settings.drag, eccentric, zeroed_once=not each
        )
        return Refinement(
            plant, model, joint, mixing, terms, settings.max_steps, settings.callback,
            zero_sd if each else None, JUMP_SD[settings.continuity],
        )  # fmt: skip

    search = refinement(is_eccentric(settings.eccentricity, known))
    vector = torch.tensor([known.get(t.name, 0.0) for t in search.terms], dtype=torch.float64)

    def by_torque(found: Plant) -> Tensor:
        return fit_torque(model.law, found, joint, motions, model.v_smooth).coefficients

    linear = all(c.linear or not c.fitted for c in model.law.coefficients)
    stage, left_out = _through_windows(
        search, settings.windows, vector, motions, None if linear else by_torque
    )
    law = model.law.simpler
    if law is not None and stage.result.status != "stopped":
        simpler = FrictionModel(law, Constant(law, model.joints), model.v_smooth)
        _set_by_torque(simpler, start.plant if start else plant, joint, motions)
        base, without = _through_windows(
            replace(search, model=simpler), settings.windows, vector, motions,
            of=f", {law.name} law",
        )  # fmt: skip
        lowest = lowest_of(search, stage, base, by_torque)
        if lowest.problem is not stage.problem:
            left_out = without
        stage = lowest
    undecided = start is None and settings.eccentricity is None
    possible = settings.fit_plant and may_be_eccentric(plant)
    if undecided and possible and stage.result.status != "stopped":
        tolerance = flat(stage.result.cost)
        stage = richer_by_evidence(stage, refinement(True), tolerance) or stage
    found = trajectory_outcome(stage.problem, stage.result, stage.residuals, motions)
    return replace(found, continuity=settings.continuity).telling(left_out)


def _set_by_torque(
    model: FrictionModel, plant: Plant, joint: Sequence[Recording], motions: Sequence[Motion]
) -> TorqueFit:
    """Set constant coefficients, and how far they may go, by torques."""
    torque = fit_torque(model.law, plant, joint, motions, model.v_smooth)
    schedule = constant_schedule(model)
    schedule.set_coefficients(torque.coefficients)
    schedule.set_prior_sd(prior_sd(model.law, torque))
    return torque


def _through_windows(
    search: Refinement,
    windows: Sequence[float],
    vector: Tensor,
    motions: tuple[Motion, ...],
    by_torque: Callable[[Plant], Tensor] | None = None,
    of: str = "",
) -> tuple[Stage, tuple[str, ...]]:
    """Stages of growing length, each from the states and weighed by the errors of the last.

    Lengths that the motion does not allow are left out, which is said in a sentence.

    With coefficients `by_torque` on a plant, the first stage is searched a second time from what
    they are on the plant that it found: a law that is not linear has several minima, and on an
    inertia that is a little wrong the torques lead to a worse one.
    """
    reached: Stage | None = None
    zeros: Tensor | None = None
    noise, traced = FIRST_NOISE, motions
    for length in windows:
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
            return reached, (TOO_LONG.format(length),)
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

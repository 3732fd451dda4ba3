"""Fit the constant law: torques first, then windows of growing length."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from nfriction.fitting.data.inputs import (
    adjustable_terms,
    constant_schedule,
    in_joint_coordinates,
    is_eccentric,
    mixing_of,
)
from nfriction.fitting.equation_error import TorqueFit, fit_torque, prior_sd
from nfriction.fitting.result.fit_result import (
    Continuity,
    FitResult,
    torque_outcome,
    trajectory_outcome,
)
from nfriction.fitting.strategy.continuation import JUMP_SD, Callback, Refinement, flat
from nfriction.fitting.strategy.encoder_eccentricity import may_be_eccentric, richer_by_evidence
from nfriction.fitting.strategy.growing import through_windows
from nfriction.fitting.strategy.multistart import from_simpler
from nfriction.friction.coefficients import Constant
from nfriction.friction.models import FrictionModel
from nfriction.plant import Plant
from nfriction.recording import Recording
from nfriction.signals import Motion

TOO_LONG = (
    "Windows of {:g} s are too long for this motion, which forgets its start within them, or for a "
    "law or plant that is wrong; left out."
)
# Dry friction of a tenth of a link's largest gravity moment lets it rest up to 0.1 rad off [rad].
ZERO_SD = 0.05
# Short windows converge from far away, long ones tell small friction and small drag apart [s].
WINDOWS = (0.5, 2.0, 5.0)


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
    start: FitResult | None = None,
) -> FitResult:
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
    start: FitResult | None,
    settings: Settings,
    *,
    each: bool,
) -> FitResult:
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
    begun = start.plant if start else plant
    _set_by_torque(model, begun, joint, motions)
    mixing = mixing_of(plant, recordings[0].resolve_convention(plant))
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
    stage, left_out = through_windows(
        search, settings.windows, vector, motions, None if linear else by_torque
    )
    if (law := model.law.nested_law) is not None and stage.result.status != "stopped":
        simpler = FrictionModel(law, Constant(law, model.joints), model.v_smooth)
        _set_by_torque(simpler, begun, joint, motions)
        stage, left_out = from_simpler(
            search, stage, left_out, simpler, settings.windows, vector, motions, by_torque
        )
    undecided = start is None and settings.eccentricity is None
    possible = settings.fit_plant and may_be_eccentric(plant)
    if undecided and possible and stage.result.status != "stopped":
        tolerance = flat(stage.result.cost)
        stage = richer_by_evidence(stage, refinement(True), tolerance) or stage
    found = trajectory_outcome(stage.problem, stage.result, stage.residuals, motions)
    found = replace(found, continuity=settings.continuity, left_out=left_out)
    return found.with_warnings([TOO_LONG.format(length) for length in left_out])


def _set_by_torque(
    model: FrictionModel, plant: Plant, joint: Sequence[Recording], motions: Sequence[Motion]
) -> TorqueFit:
    """Set constant coefficients, and how far they may go, by torques."""
    torque = fit_torque(model.law, plant, joint, motions, model.v_smooth)
    schedule = constant_schedule(model)
    schedule.set_coefficients(torque.coefficients)
    schedule.set_prior_sd(prior_sd(model.law, torque))
    return torque

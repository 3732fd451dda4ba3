"""Where coefficients that follow the motion start: at the constant fit of their law."""

from collections.abc import Sequence
from typing import TypeGuard

from nfriction.fitting.data.checks import as_it_looks, misgivings
from nfriction.fitting.data.inputs import in_joint_coordinates, zeros_serve
from nfriction.fitting.result.fit_result import Continuity, FitResult
from nfriction.fitting.strategy.constant import Settings, fit_constant
from nfriction.friction.coefficients import Constant
from nfriction.friction.models import FrictionModel
from nfriction.plant import Plant
from nfriction.recording import Recording
from nfriction.signals import Motion


def is_constant_fit(
    start: FitResult | None, model: FrictionModel, continuity: Continuity = "free"
) -> TypeGuard[FitResult]:
    """Whether a fit is one of the model's law with constant coefficients, by such trajectories."""
    return (
        start is not None
        and start.model.law == model.law
        and isinstance(start.model.schedule, Constant)
        and start._residuals.numel() > 0
        and start.continuity == continuity
    )


def constant_start(
    model: FrictionModel,
    plant: Plant,
    recordings: Sequence[Recording],
    motions: tuple[Motion, ...],
    start: FitResult | None,
    settings: Settings,
    each: bool | None = None,
) -> FitResult:
    """The constant fit of a model's law, from which its own fit starts; `start` where it is one.

    Args:
        model, plant, recordings, motions, start, settings: see `fit_constant`.
        each: whether encoders were zeroed anew at the start of each recording, which a `start`
            must bear out. None takes a `start` as it is; without one it is as it looks, and the
            fit says that and what else looks wrong.
    """
    if is_constant_fit(start, model, settings.continuity) and (
        each is None or zeros_serve(start, motions, each)
    ):
        return start
    told: tuple[str, ...] = ()
    if each is None:
        each, told = as_it_looks(plant, recordings)
        joint = in_joint_coordinates(plant, model, recordings)
        told += misgivings(plant, recordings, joint, motions)
    constant = FrictionModel(model.law, Constant(model.law, model.joints), model.v_smooth)
    found = fit_constant(constant, plant, recordings, motions, start, settings, each=each)
    return found.with_warnings(told)

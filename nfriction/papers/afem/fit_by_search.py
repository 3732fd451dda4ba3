"""Coefficients, constant or by class, by direct search of the position error of a simulation."""

from collections.abc import Sequence
from typing import get_args

import torch
from torch import Tensor

from nfriction.fitting.data.inputs import integration_substeps
from nfriction.fitting.data.windows import cut_windows
from nfriction.fitting.equation_error import coefficient_scale
from nfriction.fitting.fit import prepare_task
from nfriction.fitting.options import FitOptions
from nfriction.fitting.result.fit_result import FitResult
from nfriction.fitting.shooting.autocorrelation import effective_noise
from nfriction.fitting.strategy.constant import constant_start, fit_constant
from nfriction.friction.coefficients import Tabulated
from nfriction.friction.constant import Constant
from nfriction.friction.model import FrictionModel
from nfriction.papers.afem.adaptive import Adaptive
from nfriction.papers.afem.classes import AccelerationClasses
from nfriction.papers.afem.labelled import driving_classes, labelled_model
from nfriction.papers.afem.position_error import PositionError
from nfriction.papers.afem.search import (
    Box,
    Callback,
    SearchMethod,
    SearchState,
    available_threads,
    search,
)
from nfriction.papers.afem.settling import PRIOR_SD, adopt_classes, settled
from nfriction.plant import Plant
from nfriction.recording import Recording
from nfriction.signals import Motion


def fit_by_search(
    model: FrictionModel,
    plant: Plant,
    recordings: Recording | Sequence[Recording],
    *,
    method: SearchMethod = "pattern",
    horizon: float | None = 2.0,
    start: FitResult | None = None,
    motions: Sequence[Motion] | None = None,
    classes: AccelerationClasses | None = None,
    prior_sd: float = PRIOR_SD,
    max_evaluations: int = 5000,
    tolerance: float = 1e-4,
    seed: int = 0,
    threads: int | None = None,
    state: SearchState | None = None,
    callback: Callback | None = None,
    progress: bool = False,
) -> FitResult:
    """Fit constant or adaptive coefficients by direct search of the simulation's position error.

    Args:
        model: a model with constant or adaptive coefficients; changed in place.
        plant: the mechanism as given; where `start` is given, as it left it.
        recordings: one or several.
        method: `"pattern"` search or `"sqp"`.
        horizon: length of the simulated windows [s], restarted from the smoothed motion; None
            simulates each recording in one run, as the papers do. After seconds of chaotic motion
            that is a criterion of luck.
        start: fit to start from; of the constant law for an adaptive model. By default the
            constant coefficients that the torques imply (adaptive: the trajectory fit).
        motions: smoothed motions in joint coordinates.
        classes: of an adaptive model, from `find_classes`; found here by default.
        prior_sd: of an adaptive model, see `fit_adaptive`.
        max_evaluations, tolerance, seed, state, callback, progress: see `search`.
        threads: candidates are shared out among this many; all processors by default.

    Returns:
        The fit.

    Raises:
        ValueError: if the model's coefficients are neither constant nor adaptive, or recordings
            and plant do not match.

    References:
        Second paper: NCFM by sequential quadratic programming, LFM and NLFM by pattern search,
        on 80 s; TLRIP paper, AFEM.
    """
    if method not in get_args(SearchMethod):
        raise ValueError(f"`method` must be one of {get_args(SearchMethod)}, got {method!r}.")
    schedule = model.schedule
    if not isinstance(schedule, Constant | Adaptive):
        raise ValueError(
            f"a search fits constant or adaptive coefficients, not {type(schedule).__name__}."
        )
    if start is not None and start.encoder_offsets:
        raise ValueError("a search takes no encoder offsets; start from a fit without them.")
    adaptive = isinstance(schedule, Adaptive)
    options = FitOptions(
        "output_error" if adaptive else "equation_error",
        encoder_reference="auto" if start is None else "shared",
    )
    task = prepare_task(model, plant, recordings, options, start, motions)
    joint, moved = task.recordings, task.motions
    if isinstance(schedule, Adaptive):
        constant = constant_start(task)
        classes = adopt_classes(schedule, classes, joint, moved, plant)
        varied = labelled_model(model, constant, joint, moved, prior_sd)
    else:
        constant = start or fit_constant(task)
        schedule.set_coefficients(constant.model.schedule.coefficient_sets()["always"])
        varied = model
    span = max(float(r.time[-1] - r.time[0]) for r in joint)
    cut = cut_windows(joint, moved, span if horizon is None else horizon)
    error = PositionError(
        constant.plant, varied, cut, task.measurement,
        substeps=integration_substeps(plant, varied, max(r.longest_step for r in joint)),
        drive=None if classes is None else driving_classes(classes, cut),
        threads=threads or available_threads(),
    )  # fmt: skip
    box = _box(varied, constant, joint, moved)
    first = error.residuals(varied.schedule.parameter_vector())
    noise = effective_noise(first.nan_to_num(1.0, 1.0, -1.0))
    mean, sd = varied.schedule.prior()

    def cost(vectors: Tensor) -> Tensor:
        data = error.mean_square(vectors) * (error.values / noise**2)
        return 0.5 * (data + ((vectors - mean) / sd).square().sum(-1))

    result = search(
        cost, box, method, max_evaluations=max_evaluations, tolerance=tolerance, seed=seed,
        state=state, callback=callback, progress=progress,
    )  # fmt: skip
    assert isinstance(varied.schedule, Tabulated)
    varied.schedule.set_parameter_vector(result.vector)
    names = varied.schedule.parameter_names(plant.joint_names)
    hit = box.free & ((result.vector <= box.lower) | (result.vector >= box.upper))
    residuals = error.residuals(result.vector)
    found = FitResult(
        model=model.requires_grad_(False),
        plant=constant.plant,
        plant_terms=constant.plant_terms,
        status=("converged: " if result.converged else "not converged: ") + result.message,
        converged=result.converged,
        residual=float(error.mean_square(result.vector[None])[0].sqrt()),
        at_bounds=tuple(n for n, h in zip(names, hit.tolist(), strict=True) if h),
        steps=result.iterations,
        motions=moved,
        residuals=residuals,
    )
    if classes is None:
        return found
    baseline = float(error.mean_square(mean[None])[0].sqrt())
    return settled(
        model, varied, classes, constant, found, cut, error.mixing, error.substeps, baseline
    )


def _box(
    model: FrictionModel, constant: FitResult, joint: Sequence[Recording], motions: Sequence[Motion]
) -> Box:
    """Variables of a search, scaled by what a coefficient can sensibly be."""
    schedule = model.schedule
    assert isinstance(schedule, Tabulated)
    values = schedule.values
    natural = coefficient_scale(model, constant.plant, joint, motions)
    natural = natural.reshape(len(natural), *(1,) * (values.ndim - 2), -1)
    log = torch.tensor([not c.linear for c in model.law.coefficients]).expand_as(values)
    scale = torch.maximum(values.abs(), natural)
    # What is searched over decades moves by one of them.
    scale = torch.where(log | (scale == 0), 1.0, scale)
    lower, upper = schedule.bounds()
    return Box(schedule.parameter_vector(), lower, upper, scale.reshape(-1), log.reshape(-1))

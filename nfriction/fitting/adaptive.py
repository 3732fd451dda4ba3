"""Adaptive models: coefficients by class of acceleration (AFEM), and constant ones by search."""

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, get_args

import numpy as np
import torch
from torch import Tensor

from nfriction.fitting import estimate
from nfriction.fitting.classes import AccelerationClasses, find_classes
from nfriction.fitting.estimate import Fit, Plant
from nfriction.fitting.residuals import effective_noise
from nfriction.fitting.search import (
    Box,
    Callback,
    PositionError,
    SearchMethod,
    SearchState,
    available_threads,
    search,
)
from nfriction.fitting.sensitivity import StepJacobian
from nfriction.fitting.torque import fit_torque
from nfriction.fitting.trajectory import TrajectoryProblem, solve_trajectory
from nfriction.fitting.windows import Windows, cut_windows
from nfriction.friction import CLASSES, Adaptive, Constant, FrictionModel
from nfriction.friction.schedules import Tabulated
from nfriction.recording import Recording
from nfriction.signals import Motion, kalman_smoother
from nfriction.simulation import Rollout, integrate
from nfriction.solve.levenberg import Step

logger = logging.getLogger(__name__)

AdaptiveMethod = Literal["gauss-newton", "pattern", "sqp"]
# How far a class may deviate from the constant law, in units of a coefficient's natural scale.
PRIOR_SD = 0.5


class Labelled(Adaptive):
    """A table by class whose class is given: it takes the place of the acceleration.

    So that whatever drives coefficients by a measured motion drives them by known classes.

    Args:
        model: the model whose law and joints are taken.
        reference: constant coefficients toward which every class is pulled, (joint, coefficient).
        sd: standard deviation around them, (joint, coefficient).
    """

    state_size = 0

    def __init__(self, model: FrictionModel, reference: Tensor, sd: Tensor) -> None:
        super().__init__(model.law, model.joints, reference)
        shape = self.raw.shape
        self._mean = reference[:, None].expand(shape).reshape(-1)
        self._sd = sd[:, None].expand(shape).reshape(-1)

    def initial_state(self, qd: Tensor, qdd: Tensor) -> Tensor:
        return torch.stack([qdd, qdd], -1)

    def prior(self) -> tuple[Tensor, Tensor]:
        return self._mean, self._sd


@dataclass
class LabelledProblem(TrajectoryProblem):
    """A trajectory problem whose coefficients follow given classes.

    Args:
        classes: class of every sample, (window, step, joint).
    """

    classes: Tensor | None = None

    def _simulate(self, x: Tensor) -> Rollout:
        if self._simulated is not None and torch.equal(self._simulated[0], x):
            return self._simulated[1]
        assert self.classes is not None
        parameters, plant_vector, state = self.split(x)
        self.friction.schedule.set_parameter_vector(parameters)
        q0, qd0 = state.chunk(2, -1)
        classes = self.classes.repeat_interleave(self.substeps, 1)
        motion = integrate(
            self.plant_at(plant_vector), self.friction, q0, qd0, self.tau, self.step,
            measured=(torch.zeros_like(classes), classes),
        )  # fmt: skip
        # What a step's derivatives are taken at must be what drove it.
        motion = replace(motion, qdd=torch.cat([classes, classes[:, -1:]], 1))
        self._simulated = (x.clone(), motion)
        return motion


def fit_adaptive(
    model: FrictionModel,
    plant: Plant,
    recordings: Recording | Sequence[Recording],
    *,
    method: AdaptiveMethod = "gauss-newton",
    classes: AccelerationClasses | None = None,
    windows: Sequence[float] = (0.5, 2.0),
    fit_plant: bool = True,
    drag: bool = False,
    start: Fit | None = None,
    motions: Sequence[Motion] | None = None,
    max_steps: int = 30,
    prior_sd: float = PRIOR_SD,
    callback: Callable[[str, Step], bool | None] | None = None,
    **search_settings: Any,
) -> Fit:
    """Fit a model whose coefficients depend on the class of acceleration.

    The constant law is fitted first. Every class starts there and is pulled toward it, so a
    class of which the recordings say little stays; and where the result simulates the training
    windows no better, with the class following the simulation, the constant coefficients stay.

    Args:
        model: the model to fit; changed in place.
        plant: the mechanism as given.
        recordings: one or several.
        method: `"gauss-newton"` (trajectories, with exact sensitivities and the plant's terms),
            or the papers' `"pattern"` search or `"sqp"` of the position error.
        classes: from `find_classes`; found here by default.
        windows: lengths of the windows [s]; the last serves for the classes.
        fit_plant, drag, start, motions, max_steps, callback: see `fit`.
        prior_sd: how far a class may deviate from the constant law, in units of what explains a
            third of the friction (or of the coefficient, if larger).
        search_settings: of `fit_by_search`, for its methods.

    Returns:
        The fit; read `converged` and `status`.

    Raises:
        ValueError: if recordings and plant do not match, the motion has no classes, or the model
            is not adaptive.

    References:
        TLRIP paper, AFEM.
    """
    if method not in get_args(AdaptiveMethod):
        raise ValueError(f"`method` must be one of {get_args(AdaptiveMethod)}, got {method!r}.")
    if not isinstance(model.schedule, Adaptive):
        raise ValueError(f"{type(model).__name__} is no adaptive model; use `fit`.")
    if not prior_sd > 0:
        raise ValueError(f"`prior_sd` must be positive, got {prior_sd}.")
    given = [recordings] if isinstance(recordings, Recording) else list(recordings)
    joint = estimate._in_joint_coordinates(plant, model, given)
    moved = tuple(motions or (kalman_smoother(r.time, r.q) for r in joint))
    constant = _constant_start(
        model, plant, given, moved, start, windows=windows, fit_plant=fit_plant, drag=drag,
        max_steps=max_steps, callback=callback,
    )  # fmt: skip
    if method != "gauss-newton":
        settings = {"horizon": windows[-1], "prior_sd": prior_sd, **search_settings}
        return fit_by_search(
            model, plant, given, method=method, start=constant, motions=moved, classes=classes,
            **settings,
        )  # fmt: skip
    if search_settings:
        raise ValueError(f"{sorted(search_settings)} are settings of a search, not of {method!r}.")
    classes = _adopt(model.schedule, classes, joint, moved, plant)
    terms = estimate._terms(plant, joint, fit_plant, drag)
    known = {name: value for name, value, _ in constant.plant_terms}
    vector = torch.tensor([known.get(t.name, 0.0) for t in terms], dtype=torch.float64)
    labelled = _labelled(model, constant, joint, moved, prior_sd)
    cut = cut_windows(joint, moved, windows[-1])
    problem = LabelledProblem(
        StepJacobian(plant, labelled, terms), cut, effective_noise(constant._residuals),
        estimate._mixing(plant, given[0].convention_on(plant)),
        substeps=estimate._substeps(plant, labelled, joint), plant_mean=vector,
        classes=_driving(classes, cut),
    )  # fmt: skip
    told = estimate._told(callback, f"{windows[-1]:g} s windows, by class")
    result = solve_trajectory(problem, problem.start(vector), max_steps=max_steps, callback=told)
    residuals = problem.errors(result.x)
    found = estimate._fit_of(problem, result, residuals, moved)
    states = problem.split(result.x)[2].chunk(2, -1)
    return _settled(
        model, labelled, classes, constant, found, replace(cut, q0=states[0], qd0=states[1]),
        problem.mixing, problem.substeps, constant.residual,
    )  # fmt: skip


def fit_by_search(
    model: FrictionModel,
    plant: Plant,
    recordings: Recording | Sequence[Recording],
    *,
    method: SearchMethod = "pattern",
    horizon: float | None = 2.0,
    start: Fit | None = None,
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
) -> Fit:
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
    given = [recordings] if isinstance(recordings, Recording) else list(recordings)
    joint = estimate._in_joint_coordinates(plant, model, given)
    moved = tuple(motions or (kalman_smoother(r.time, r.q) for r in joint))
    if isinstance(schedule, Adaptive):
        constant = _constant_start(model, plant, given, moved, start)
        classes = _adopt(schedule, classes, joint, moved, plant)
        varied = _labelled(model, constant, joint, moved, prior_sd)
    else:
        constant = start or estimate.fit(model, plant, given, method="torque", motions=moved)
        schedule.set_coefficients(estimate._constant(constant.model).values)
        varied = model
    span = max(float(r.time[-1] - r.time[0]) for r in joint)
    cut = cut_windows(joint, moved, span if horizon is None else horizon)
    error = PositionError(
        constant.plant, varied, cut, estimate._mixing(plant, given[0].convention_on(plant)),
        substeps=estimate._substeps(plant, varied, joint),
        drive=None if classes is None else _driving(classes, cut),
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
    found = Fit(
        model=model.requires_grad_(False),
        plant=constant.plant,
        plant_terms=constant.plant_terms,
        status=("converged: " if result.converged else "not converged: ") + result.message,
        converged=result.converged,
        residual=float(error.mean_square(result.vector[None])[0].sqrt()),
        at_bounds=tuple(n for n, h in zip(names, hit.tolist(), strict=True) if h),
        steps=result.iterations,
        motions=moved,
        _residuals=residuals,
    )
    if classes is None:
        return found
    baseline = float(error.mean_square(mean[None])[0].sqrt())
    return _settled(
        model, varied, classes, constant, found, cut, error.mixing, error.substeps, baseline
    )


def _constant_start(
    model: FrictionModel,
    plant: Plant,
    recordings: Sequence[Recording],
    motions: Sequence[Motion],
    start: Fit | None,
    **settings: Any,
) -> Fit:
    """The fit of the model's law with constant coefficients."""
    if (
        start is not None
        and start.model.law is model.law
        and isinstance(start.model.schedule, Constant)
        and start._residuals.numel()
    ):
        return start
    constant = FrictionModel(model.law, Constant(model.law, model.joints), model.v_smooth)
    return estimate.fit(constant, plant, recordings, motions=motions, start=start, **settings)


def _adopt(
    schedule: Adaptive,
    classes: AccelerationClasses | None,
    joint: Sequence[Recording],
    motions: Sequence[Motion],
    plant: Plant,
) -> AccelerationClasses:
    """Classes of the recordings, the schedule set to them."""
    if classes is None:
        classes = find_classes(schedule, joint, motions, plant.joint_names)
    elif [len(known) for known in classes.labels] != [len(r.time) for r in joint]:
        raise ValueError("`classes` are of other recordings; find them in those to be fitted.")
    elif not torch.equal(classes.thresholds, schedule.thresholds):
        raise ValueError("`classes` were found with another model's schedule.")
    for note in classes.notes:
        logger.info("%s", note)
    return classes


def _labelled(
    model: FrictionModel,
    constant: Fit,
    joint: Sequence[Recording],
    motions: Sequence[Motion],
    prior_sd: float,
) -> FrictionModel:
    """The model with given classes, at the constant law's coefficients."""
    values = estimate._constant(constant.model).values
    sd = prior_sd * torch.maximum(values.abs(), _natural(model, constant, joint, motions))
    # Where neither tells a size, the coefficient stays free.
    sd = torch.where(sd > 0, sd, torch.inf)
    schedule = Labelled(model, values, sd)
    return FrictionModel(model.law, schedule, model.v_smooth).requires_grad_(False)


def _natural(
    model: FrictionModel, constant: Fit, joint: Sequence[Recording], motions: Sequence[Motion]
) -> Tensor:
    """Size of each coefficient that alone would explain a third of the friction torque."""
    torque = fit_torque(model.law, constant.plant, joint, motions, model.v_smooth)
    qd = torch.as_tensor(np.concatenate([m.qd for m in motions]))
    return estimate._natural_scale(model, torque, qd)


def _driving(classes: AccelerationClasses, cut: Windows) -> Tensor:
    """Class that drives every step of windows, those without data as the one they stand for."""
    taken = [
        torch.stack([of[known] for of, known in zip(classes.stands_for, labels.T, strict=True)], -1)
        for labels in classes.labels
    ]
    driving = torch.zeros_like(cut.tau)
    for w, (place, first, last) in enumerate(cut.spans):
        driving[w, : last - first] = taken[place][first:last].to(driving.dtype)
    return driving


def _box(
    model: FrictionModel, constant: Fit, joint: Sequence[Recording], motions: Sequence[Motion]
) -> Box:
    """Variables of a search, scaled by what a coefficient can sensibly be."""
    schedule = model.schedule
    assert isinstance(schedule, Tabulated)
    values = schedule.values
    natural = _natural(model, constant, joint, motions)
    natural = natural.reshape(len(natural), *(1,) * (values.ndim - 2), -1)
    log = torch.tensor([not c.linear for c in model.law.coefficients]).expand_as(values)
    scale = torch.maximum(values.abs(), natural)
    # What is searched over decades moves by one of them.
    scale = torch.where(log | (scale == 0), 1.0, scale)
    lower, upper = schedule.bounds()
    return Box(schedule.parameter_vector(), lower, upper, scale.reshape(-1), log.reshape(-1))


def _settled(
    model: FrictionModel,
    labelled: FrictionModel,
    classes: AccelerationClasses,
    constant: Fit,
    found: Fit,
    windows: Windows,
    mixing: Tensor,
    substeps: int,
    baseline: float,
) -> Fit:
    """Take the classes' coefficients as far as they serve where the simulation drives them."""
    schedule = model.schedule
    assert isinstance(schedule, Adaptive)
    assert isinstance(labelled.schedule, Labelled)
    flat = estimate._constant(constant.model).values[:, None]
    table = labelled.schedule.values
    table = torch.stack([row[of] for row, of in zip(table, classes.stands_for, strict=True)])
    model.requires_grad_(False)
    along = [schedule.states(torch.as_tensor(m.qd), torch.as_tensor(m.qdd)) for m in found.motions]
    memory = torch.stack([along[place][first] for place, first, _ in windows.spans])
    for share in (1.0, 0.5, 0.25):
        schedule.set_coefficients(flat + share * (table - flat))
        error = PositionError(found.plant, model, windows, mixing, substeps=substeps, memory=memory)
        residuals = error.residuals(schedule.parameter_vector())
        rms = float((residuals.square().sum() / error.values).sqrt())
        if rms <= baseline:
            part = "" if share == 1.0 else f" {share:g} of the way from the constant law is taken."
            return replace(
                found, model=model, residual=rms, _residuals=residuals,
                status=found.status + part + _said(classes),
            )  # fmt: skip
    schedule.set_coefficients(flat.expand(-1, len(CLASSES), -1))
    return replace(
        constant, model=model,
        status=f"{constant.status} The classes simulate no better: the constant law is kept.",
    )  # fmt: skip


def _said(classes: AccelerationClasses) -> str:
    return "".join(f" {note}." for note in classes.notes)

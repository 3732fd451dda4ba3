"""Fits of adaptive models: coefficients by class of acceleration (AFEM)."""

from collections.abc import Sequence
from dataclasses import replace

import torch

from nfriction.fitting.data.inputs import adjustable_terms
from nfriction.fitting.fit import Callback, FitTask, prepare_task
from nfriction.fitting.options import EncoderReference, FitOptions
from nfriction.fitting.result.fit_result import FitResult, result_from_shooting
from nfriction.fitting.shooting.autocorrelation import effective_noise
from nfriction.fitting.shooting.sensitivity import StepJacobian
from nfriction.fitting.strategy.constant import constant_start, known_terms
from nfriction.fitting.strategy.continuation import ShootingFitter
from nfriction.friction.models import FrictionModel
from nfriction.papers.afem.adaptive import Adaptive
from nfriction.papers.afem.classes import DEFAULTS, ClassOptions
from nfriction.papers.afem.given_classes import ClassFit, GivenClassesProblem
from nfriction.plant import Plant
from nfriction.recording import Recording
from nfriction.signals import Motion

# Relative decrease of the cost that ends the search by class.
TOLERANCE = 1e-6
OPTIONS = FitOptions(windows=(0.5, 2.0))


def fit_adaptive(
    model: FrictionModel,
    plant: Plant,
    recordings: Recording | Sequence[Recording],
    *,
    options: FitOptions = OPTIONS,
    classes: ClassOptions = DEFAULTS,
    start: FitResult | None = None,
    motions: Sequence[Motion] | None = None,
    callback: Callback | None = None,
) -> FitResult:
    """Fit a model whose coefficients depend on the class of acceleration.

    As `nfriction.fit` does, with options for the classes. The constant law is fitted first. Every
    class starts there and is pulled toward it, so a class with few data stays there; and where the
    result simulates the training windows no better, with the class following the simulation, the
    constant coefficients are kept.

    Args:
        model: the model to fit; changed in place.
        plant: the mechanism as given.
        recordings: one or several.
        options: see `nfriction.fit`; the last window is that of the classes.
        classes: how the classes are found, and how far they may deviate from the constant law.
        start, motions, callback: see `nfriction.fit`.

    Returns:
        The fit; read `converged` and `status`.

    Raises:
        ValueError: if recordings and plant do not match, the motion has no classes, or the model
            is not adaptive.

    References:
        TLRIP paper, AFEM.
    """
    task = prepare_task(
        model, plant, recordings, like_start(options, start), start, motions, callback
    )
    return fit_by_class(task, classes)


def like_start(options: FitOptions, start: FitResult | None) -> FitOptions:
    """Options that take a start with the encoder offsets that it found, or none."""
    if start is None:
        return options
    reference: EncoderReference = "per_recording" if start.encoder_offsets else "shared"
    return replace(options, encoder_reference=reference)


def fit_by_class(task: FitTask, classes: ClassOptions = DEFAULTS) -> FitResult:
    """Fit coefficients by class by output error, from the fit of the constant law."""
    schedule = task.model.schedule
    if not isinstance(schedule, Adaptive):
        raise ValueError(f"{type(task.model).__name__} is no adaptive model; use `fit`.")
    # The classes have no encoder eccentricity, and windows are free.
    options = replace(task.options, eccentricity="off", continuity="none")
    task = replace(task, options=options)
    constant = constant_start(task)
    length = constant.longest_usable_horizon(options.windows)
    by_class = ClassFit.of(task, schedule, constant, length, classes)
    task, given, windows = by_class.task, by_class.given, by_class.windows
    terms = adjustable_terms(
        task.plant, task.recordings, options, per_recording=bool(constant.encoder_offsets)
    )
    vector = known_terms(constant, terms)
    sd = torch.tensor([t.prior_sd for t in terms], dtype=torch.float64)
    problem = GivenClassesProblem(
        StepJacobian(task.plant, given, terms), given, windows, effective_noise(constant.residuals),
        task.measurement, substeps=by_class.substeps, plant_prior=(vector, sd),
        classes=by_class.drive(),
    )  # fmt: skip
    fitter = ShootingFitter(
        problem.jacobian, given, task.recordings, task.measurement, replace(options, patience=0),
        task.callback,
    )  # fmt: skip
    name = f"{length:g} s windows, by class"
    result = fitter.search(problem, problem.variables.start(vector), TOLERANCE, name).result
    found = result_from_shooting(given, problem, result, task.motions)
    q0, qd0 = problem.variables.split(result.x).states.chunk(2, -1)
    return by_class.backtracked(found, replace(windows, q0=q0, qd0=qd0), constant.residual)

"""Fit a friction model to recordings: torques first, then trajectories."""

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

from nfriction.fitting.plant_parameters import PlantParameter, plant_parameters
from nfriction.fitting.sensitivity import StepJacobian
from nfriction.fitting.torque import TorqueFit, fit_torque
from nfriction.fitting.trajectory import TrajectoryProblem, solve_trajectory
from nfriction.fitting.windows import cut_windows
from nfriction.friction import Constant, FrictionModel
from nfriction.friction.neurofuzzy import NeuroFuzzy
from nfriction.plant import LinearAxis, PendulumChain
from nfriction.recording import Recording
from nfriction.signals import Motion, kalman_smoother
from nfriction.simulation import required_substeps
from nfriction.solve.levenberg import LeastSquaresResult, Step

logger = logging.getLogger(__name__)

Plant = PendulumChain | LinearAxis
# First guess of what a model of a bench leaves unexplained, before a fit tells [rad or m].
FIRST_NOISE = 1e-3
# Substeps beyond this say that the sign's passage is too steep for the sample time.
MOST_SUBSTEPS = 8


@dataclass(frozen=True)
class Fit:
    """A fitted model and what is known of the fit.

    Attributes:
        model: the friction model, trained in place.
        plant: the plant with its adjusted terms.
        plant_terms: name, value and bound of each adjusted term.
        status: `"converged"`, or why not, in words.
        converged: whether the search ended at a minimum.
        residual: root mean square of the position error over the training windows.
        at_bounds: names of what ended at a bound.
        steps: accepted steps of the last stage.
        motions: smoothed motion of each recording, in joint coordinates.
    """

    model: FrictionModel
    plant: Plant
    plant_terms: tuple[tuple[str, float, float], ...]
    status: str
    converged: bool
    residual: float
    at_bounds: tuple[str, ...]
    steps: int
    motions: tuple[Motion, ...]
    _residuals: Tensor

    def to_dict(self) -> dict[str, Any]:
        return {
            "status": self.status,
            "converged": self.converged,
            "residual": self.residual,
            "at_bounds": list(self.at_bounds),
            "plant": {name: value for name, value, _ in self.plant_terms},
        }


def fit(
    model: FrictionModel,
    plant: Plant,
    recordings: Recording | Sequence[Recording],
    *,
    method: Literal["trajectory", "torque"] = "trajectory",
    windows: Sequence[float] = (0.5, 2.0),
    fit_plant: bool = True,
    drag: bool = False,
    start: Fit | None = None,
    motions: Sequence[Motion] | None = None,
    max_steps: int = 30,
    callback: Callable[[str, Step], bool | None] | None = None,
) -> Fit:
    """Estimate a friction model from recordings.

    The friction torque that the smoothed motion implies gives constant coefficients; simulated
    windows of growing length then refine them, and what the data tell of the plant. A
    neuro-fuzzy model starts at the constant fit of its own law and is pulled toward it.

    Args:
        model: the model to fit; changed in place.
        plant: the mechanism as given.
        recordings: one or several, in any convention.
        method: `"torque"` stops after the torque fit (constant coefficients only).
        windows: lengths of the windows [s], in the order in which they are used.
        fit_plant: adjust ratios of inertia and gravity terms and offsets, within bounds.
        drag: also fit air drag on the links.
        start: an earlier fit to start from: of the same law for a neuro-fuzzy model, of any model
            for the plant's terms.
        motions: smoothed motions in joint coordinates, to save smoothing again.
        max_steps: limit of steps to each window length.
        callback: called with a stage name after every step; True stops.

    Returns:
        The fit; read `converged` and `status`.

    Raises:
        ValueError: if recordings and plant do not match.
    """
    given = [recordings] if isinstance(recordings, Recording) else list(recordings)
    joint = _in_joint_coordinates(plant, model, given)
    moved = tuple(motions or (kalman_smoother(r.time, r.q) for r in joint))
    if isinstance(model.schedule, NeuroFuzzy):
        if method == "torque":
            raise ValueError("a neuro-fuzzy model is fitted to trajectories, not to torques.")
        start = _start_neurofuzzy(
            model, plant, given, joint, moved, start,
            windows=windows, fit_plant=fit_plant, drag=drag, max_steps=max_steps,
            callback=callback,
        )  # fmt: skip
    else:
        torque = fit_torque(
            model.law, start.plant if start else plant, joint, moved, model.v_smooth
        )
        _constant(model).set_coefficients(torque.coefficients)
        if method == "torque":
            return _torque_only(model, start, plant, moved, torque)
    terms = _terms(plant, joint, fit_plant, drag)
    known = {name: value for name, value, _ in start.plant_terms} if start else {}
    vector = torch.tensor([known.get(t.name, 0.0) for t in terms], dtype=torch.float64)
    # A neuro-fuzzy model starts where its constant law ended: what that left over, at the same
    # window length, is the noise that its prior is weighed against.
    refines = isinstance(model.schedule, NeuroFuzzy)
    noise = effective_noise(start._residuals) if refines and start else FIRST_NOISE
    if not windows:
        raise ValueError("`windows` must name at least one window length [s].")
    jacobian = StepJacobian(plant, model, terms)
    for length in windows[-1:] if refines else windows:
        problem = TrajectoryProblem(
            jacobian,
            cut_windows(joint, moved, length),
            noise,
            _mixing(plant, given[0]),
            substeps=_substeps(plant, model, joint),
            plant_mean=vector if refines else None,
        )
        x0 = problem.start(vector)
        told = _told(callback, f"{length:g} s windows")
        result = solve_trajectory(
            problem, x0, max_steps=max_steps, callback=told,
            cost_tolerance=1e-4 if refines else 1e-6,
        )  # fmt: skip
        vector = problem.split(result.x)[1].clone()
        residuals = problem.residuals(result.x) * problem.noise_sd
        if result.status == "stopped":
            break
    return _fit_of(problem, result, residuals, moved)


def _told(
    callback: Callable[[str, Step], bool | None] | None, stage: str
) -> Callable[[Tensor, Step], bool | None] | None:
    return None if callback is None else lambda _, step: callback(stage, step)


def effective_noise(residuals: Tensor) -> float:
    """Standard deviation of position residuals, enlarged for their correlation in time.

    Errors of a model last for many samples; `n` of them weigh like `n / tau` independent ones,
    `tau` the integrated autocorrelation time in samples.

    Args:
        residuals: [rad], shape (window, sample, joint).
    """
    centred = residuals - residuals.mean(1, keepdim=True)
    n = centred.shape[1]
    spectrum = torch.fft.rfft(centred, n=2 * n, dim=1).abs().square()
    correlation = torch.fft.irfft(spectrum, dim=1)[:, :n].sum((0, 2))
    correlation = correlation / correlation[0].clamp_min(1e-300)
    # Summed up to its first zero, beyond which the estimate is noise.
    negative = (correlation < 0).nonzero()
    end = int(negative[0]) if len(negative) else n
    tau = 1.0 + 2.0 * float(correlation[1:end].sum())
    return float(residuals.square().mean().sqrt()) * max(1.0, tau) ** 0.5


def _in_joint_coordinates(
    plant: Plant, model: FrictionModel, recordings: Sequence[Recording]
) -> list[Recording]:
    if not recordings:
        raise ValueError("at least one recording is needed to fit a model.")
    for recording in recordings:
        joints = recording.q.shape[1]
        if joints != plant.joints or joints != model.joints:
            raise ValueError(
                f"{recording.name}: {joints} joints recorded, the plant has {plant.joints}, the "
                f"model {model.joints}; they must agree."
            )
        if recording.convention != recordings[0].convention:
            raise ValueError("recordings fitted together must share one angle convention.")
    return [r.joint_coordinates(plant.first_link) for r in recordings]


def _constant(model: FrictionModel) -> Constant:
    if not isinstance(model.schedule, Constant):
        raise ValueError(f"cannot fit coefficients of type {type(model.schedule).__name__}.")
    return model.schedule


def _terms(
    plant: Plant, joint: Sequence[Recording], fit_plant: bool, drag: bool
) -> list[PlantParameter]:
    if not fit_plant:
        return []
    largest = max(0.0 if r.tau is None else float(np.abs(r.tau).max()) for r in joint)
    return plant_parameters(plant, driven=largest > 0, largest_torque=largest, drag=drag)


def _mixing(plant: Plant, recording: Recording) -> Tensor:
    """Matrix from joint coordinates to the recording's, offsets aside."""
    unit = np.eye(plant.joints)
    return torch.as_tensor(recording.convention.rate_from_joint(unit, plant.first_link).T.copy())


def _substeps(plant: Plant, model: FrictionModel, joint: Sequence[Recording]) -> int:
    step = max(float(np.diff(r.time).max()) for r in joint)
    needed = required_substeps(plant, model, step)
    if needed > MOST_SUBSTEPS:
        logger.warning("friction needs %d substeps at rest, %d are used", needed, MOST_SUBSTEPS)
    # Twice what is needed now, as coefficients may grow on the way.
    return min(1 if needed == 1 else 2 * needed, MOST_SUBSTEPS)


def _start_neurofuzzy(
    model: FrictionModel,
    plant: Plant,
    recordings: Sequence[Recording],
    joint: Sequence[Recording],
    motions: Sequence[Motion],
    start: Fit | None,
    **settings: Any,
) -> Fit:
    """Set a neuro-fuzzy model to the constant fit of its law and to the range of the motion."""
    schedule = model.schedule
    assert isinstance(schedule, NeuroFuzzy)
    fits = (
        start is not None
        and start.model.law is model.law
        and isinstance(start.model.schedule, Constant)
        and start._residuals.numel() > 0
    )
    if start is None or not fits:
        constant = FrictionModel(model.law, Constant(model.law, model.joints), model.v_smooth)
        start = fit(constant, plant, recordings, motions=motions, start=start, **settings)
    values = _constant(start.model).values
    qd = torch.as_tensor(np.concatenate([m.qd for m in motions]))
    qdd = torch.as_tensor(np.concatenate([m.qdd for m in motions]))
    along = qdd * qd.sign() if schedule.along_motion else qdd
    schedule.set_range(
        qd.abs().amax(0),
        torch.stack([torch.quantile(along, 0.001, 0), torch.quantile(along, 0.999, 0)], -1),
    )
    torque = fit_torque(model.law, start.plant, joint, motions, model.v_smooth)
    schedule.set_reference(values, _natural_scale(model, torque, qd))
    schedule.set_parameter_vector(torch.zeros_like(schedule.parameter_vector()))
    return start


def _natural_scale(model: FrictionModel, torque: TorqueFit, qd: Tensor) -> Tensor:
    """Size of each coefficient that alone would explain a third of the friction torque."""
    rms = qd.square().mean(0).sqrt()
    columns = []
    for c in model.law.coefficients:
        if not c.linear:
            columns.append(torch.zeros_like(rms))
        elif c.unit.endswith("s/rad"):
            columns.append(torque.torque / rms / 3)
        else:
            columns.append(torque.torque / 3)
    return torch.stack(columns, -1)


def _torque_only(
    model: FrictionModel,
    start: Fit | None,
    plant: Plant,
    motions: tuple[Motion, ...],
    torque: TorqueFit,
) -> Fit:
    return Fit(
        model,
        start.plant if start else plant,
        start.plant_terms if start else (),
        "converged: linear least squares of the torque",
        True,
        float(torque.residual.square().mean().sqrt()),
        (),
        0,
        motions,
        torch.zeros(0, dtype=torch.float64),
    )


def _fit_of(
    problem: TrajectoryProblem,
    result: LeastSquaresResult,
    residuals: Tensor,
    motions: tuple[Motion, ...],
) -> Fit:
    friction, vector, _ = problem.split(result.x)
    schedule = problem.friction.schedule
    names = [f"parameter {i + 1}" for i in range(friction.numel())]
    if isinstance(schedule, Constant):
        names = [
            f"{name} of {joint}"
            for joint in problem.plant.joint_names
            for name in schedule.coefficient_names
        ]
    names += [t.name for t in problem.plant_terms]
    lower, upper = problem.bounds()
    # What was not to be fitted has equal bounds.
    hit = ((result.at_lower | result.at_upper) & (lower < upper))[: problem.shared_count].tolist()
    at_bounds = tuple(n for n, h in zip(names, hit, strict=True) if h)
    return Fit(
        model=problem.friction,
        plant=problem.plant_at(vector),
        plant_terms=tuple(
            (t.name, float(v), t.upper) for t, v in zip(problem.plant_terms, vector, strict=True)
        ),
        status=("converged: " if result.converged else "not converged: ") + result.message,
        converged=result.converged,
        residual=float(residuals.square().mean().sqrt()),
        at_bounds=at_bounds,
        steps=result.steps,
        motions=motions,
        _residuals=residuals,
    )

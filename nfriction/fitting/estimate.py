"""Fit a friction model to recordings: torques first, then trajectories."""

import logging
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal, get_args

import numpy as np
import torch
from torch import Tensor

from nfriction.angles import AngleConvention
from nfriction.fitting.plant_parameters import PlantParameter, plant_parameters
from nfriction.fitting.residuals import correlation_time, effective_noise
from nfriction.fitting.sensitivity import StepJacobian
from nfriction.fitting.torque import TorqueFit, fit_torque
from nfriction.fitting.trajectory import TrajectoryProblem, solve_trajectory
from nfriction.fitting.verdict import (
    Evidence,
    Interval,
    evidence,
    intervals,
    lost_directions,
    standard_deviations,
    warnings_of,
)
from nfriction.fitting.windows import cut_windows
from nfriction.friction import Adaptive, Constant, FrictionModel
from nfriction.friction.neurofuzzy import NeuroFuzzy
from nfriction.plant import LinearAxis, PendulumChain
from nfriction.recording import Recording
from nfriction.signals import Motion, kalman_smoother
from nfriction.simulation import required_substeps
from nfriction.solve.levenberg import LeastSquaresResult, Step

logger = logging.getLogger(__name__)

Plant = PendulumChain | LinearAxis
Method = Literal["trajectory", "torque"]
# First guess of what a model of a bench leaves unexplained, before a fit tells [rad or m].
FIRST_NOISE = 1e-3
# Short windows converge from far away, long ones tell small friction and small drag apart [s].
WINDOWS = (0.5, 2.0, 5.0)
# Relative fall of the cost that ends a search of which only the neighbourhood matters.
LOOSE = 1e-4
# Residuals grow with the windows, but not so much unless the search went astray.
LOST_TRACK = 10.0
# Samples counted within the time that errors last, and the most that are passed over: a network
# leaves errors that last less long than its constant law's.
CORRELATED, MOST_STRIDE = 8, 20
# Substeps beyond this say that the sign's passage is too steep for the sample time.
MOST_SUBSTEPS = 8


@dataclass(frozen=True)
class Fit:
    """A fitted model and what is known of the fit.

    Attributes:
        model: the friction model, trained in place; without gradients, so that rollouts take the
            compiled way. To train it further: `model.requires_grad_(True)`.
        plant: the plant with its adjusted terms.
        plant_terms: name, value and bound of each adjusted term.
        status: `"converged: ..."` or `"not converged: ..."`, and why, in words.
        converged: whether the search ended at a minimum.
        residual: root mean square of what the fit left over, in `residual_unit`: of the position
            error over the training windows, or of the torque where only torques were fitted.
        at_bounds: names of what ended at a bound.
        steps: accepted steps of the last stage.
        motions: smoothed motion of each recording, in joint coordinates.
        intervals: 95 % intervals of constant coefficients and of the plant's terms; residuals
            that last in time count for as few as they are worth. None for a torque fit.
        lost: what the data cannot tell, parameters or combinations of them, in words.
        warnings: what to be wary of, a sentence each.
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
    intervals: tuple[Interval, ...] = ()
    lost: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()

    @property
    def residual_unit(self) -> str:
        """Unit of `residual`: of positions (rad, m), or of torques (N m, N) of a torque fit."""
        if self._residuals.numel():
            return self.plant.unit
        return "N" if self.plant.unit == "m" else "N m"

    def to_dict(self) -> dict[str, Any]:
        return {
            "status": self.status,
            "converged": self.converged,
            "residual": self.residual,
            "residual_unit": self.residual_unit,
            "at_bounds": list(self.at_bounds),
            "plant": {name: value for name, value, _ in self.plant_terms},
            "intervals": {
                i.name: [x if math.isfinite(x) else None for x in (i.low, i.high)]
                for i in self.intervals
            },
            "lost": list(self.lost),
            "warnings": list(self.warnings),
        }


def fit(
    model: FrictionModel,
    plant: Plant,
    recordings: Recording | Sequence[Recording],
    *,
    method: Method = "trajectory",
    windows: Sequence[float] = WINDOWS,
    fit_plant: bool = True,
    drag: bool | None = None,
    start: Fit | None = None,
    motions: Sequence[Motion] | None = None,
    max_steps: int = 30,
    callback: Callable[[str, Step], bool | None] | None = None,
) -> Fit:
    """Estimate a friction model from recordings.

    The friction torque that the smoothed motion implies gives constant coefficients; simulated
    windows of growing length then refine them, and what the data tell of the plant. A
    neuro-fuzzy model starts at the constant fit of its own law and is pulled toward it. So
    does every class of an adaptive model; `fit_adaptive` has its further settings.

    Args:
        model: the model to fit; changed in place.
        plant: the mechanism as given.
        recordings: one or several, all in one convention; where they say none, in the plant's.
        method: `"torque"` stops after the torque fit (constant coefficients only).
        windows: lengths of the windows [s], in the order in which they are used.
        fit_plant: adjust ratios of inertia and gravity terms and offsets, within bounds.
        drag: also fit air drag on the links. None fits it where nothing drives a chain on a
            fixed pivot: a free swing loses as much to the air as to its joints, and without drag
            the joints' coefficients take it over and are wrong.
        start: an earlier fit to start from: of the same law for a neuro-fuzzy model, of any model
            for the plant's terms.
        motions: smoothed motions in joint coordinates, to save smoothing again.
        max_steps: limit of steps to each window length.
        callback: called with a stage name after every step; True stops.

    Returns:
        The fit; read `converged` and `status`.

    Raises:
        ValueError: if recordings and plant do not match, or there is no such method.
    """
    if method not in get_args(Method):
        raise ValueError(f"`method` must be one of {get_args(Method)}, got {method!r}.")
    given = [recordings] if isinstance(recordings, Recording) else list(recordings)
    joint = _in_joint_coordinates(plant, model, given)
    moved = tuple(motions or (kalman_smoother(r.time, r.q) for r in joint))
    if drag is None:
        drag = _swings_freely(plant, joint)
    if isinstance(model.schedule, Adaptive):
        if method == "torque":
            raise ValueError("an adaptive model is fitted to trajectories, not to torques.")
        # It fits the constant law first, so it stands above this module.
        from nfriction.fitting.adaptive import fit_adaptive

        return fit_adaptive(
            model, plant, given, windows=windows, fit_plant=fit_plant, drag=drag, start=start,
            motions=moved, max_steps=max_steps, callback=callback,
        )  # fmt: skip
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
    noise, stride = FIRST_NOISE, 1
    if refines and start:
        noise = effective_noise(start._residuals)
        stride = int(min(max(correlation_time(start._residuals) / CORRELATED, 1), MOST_STRIDE))
    if not windows:
        raise ValueError("`windows` must name at least one window length [s].")
    jacobian = StepJacobian(plant, model, terms)
    reached: _Stage | None = None
    traced = moved
    for length in windows[-1:] if refines else windows:
        problem = TrajectoryProblem(
            jacobian,
            cut_windows(joint, traced, length),
            noise,
            _mixing(plant, given[0].convention_on(plant)),
            substeps=_substeps(plant, model, joint),
            plant_mean=vector if refines else None,
            stride=stride,
        )
        told = _told(callback, f"{length:g} s windows")
        result = solve_trajectory(
            problem, problem.start(vector), max_steps=max_steps, callback=told,
            cost_tolerance=LOOSE if refines or length != windows[-1] else _flat(problem),
        )  # fmt: skip
        stage = _Stage(problem, result, problem.errors(result.x))
        if reached is not None and stage.lost_since(reached):
            logger.warning("%g s windows are too long for this motion; left out", length)
            model.schedule.set_parameter_vector(reached.problem.split(reached.result.x)[0])
            break
        reached = stage
        vector = problem.split(result.x)[1].clone()
        if result.status == "stopped":
            break
        traced = problem.traced(result.x, traced)
    assert reached is not None
    return _fit_of(reached.problem, reached.result, reached.residuals, moved)


@dataclass(frozen=True)
class _Stage:
    """Where the search ended with windows of one length."""

    problem: TrajectoryProblem
    result: LeastSquaresResult
    residuals: Tensor

    def lost_since(self, before: "_Stage") -> bool:
        """Whether longer windows only found that the motion forgets its start within them."""
        rms = [float(stage.residuals.square().mean().sqrt()) for stage in (before, self)]
        far = not rms[1] <= LOST_TRACK * rms[0]
        return far and not self.result.converged


def _flat(problem: TrajectoryProblem) -> float:
    """Relative fall of the cost that changes the log likelihood by a tenth."""
    return 0.2 / problem.windows.q.numel()


def _told(
    callback: Callable[[str, Step], bool | None] | None, stage: str
) -> Callable[[Tensor, Step], bool | None] | None:
    return None if callback is None else lambda _, step: callback(stage, step)


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
    conventions = {str(r.convention_on(plant)) for r in recordings}
    if len(conventions) > 1:
        raise ValueError(
            "recordings fitted together must share one angle convention, got "
            f"{' and '.join(sorted(conventions))}."
        )
    return [r.joint_coordinates(plant) for r in recordings]


def _constant(model: FrictionModel) -> Constant:
    if not isinstance(model.schedule, Constant):
        raise ValueError(f"cannot fit coefficients of type {type(model.schedule).__name__}.")
    return model.schedule


def _largest_torque(joint: Sequence[Recording]) -> float:
    return max(0.0 if r.tau is None else float(np.abs(r.tau).max()) for r in joint)


def _swings_freely(plant: Plant, joint: Sequence[Recording]) -> bool:
    """Whether nothing drives a chain on a fixed pivot."""
    fixed = isinstance(plant, PendulumChain) and not plant.first_link
    return fixed and _largest_torque(joint) == 0


def _terms(
    plant: Plant, joint: Sequence[Recording], fit_plant: bool, drag: bool
) -> list[PlantParameter]:
    if not fit_plant:
        return []
    largest = _largest_torque(joint)
    return plant_parameters(plant, driven=largest > 0, largest_torque=largest, drag=drag)


def _mixing(plant: Plant, convention: AngleConvention) -> Tensor:
    """Matrix from joint coordinates to the recordings', offsets aside."""
    unit = np.eye(plant.joints)
    return torch.as_tensor(convention.rate_from_joint(unit, plant.first_link).T.copy())


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
        model.requires_grad_(False),
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
    """A fit with its verdict, from where the search ended."""
    vector = problem.split(result.x)[1]
    plant, count = problem.plant, problem.shared_count
    names = problem.friction.schedule.parameter_names(plant.joint_names)
    names += [t.name for t in problem.plant_terms]
    lower, upper = (bound[:count] for bound in problem.bounds())
    # What was not to be fitted has equal bounds.
    fitted = lower < upper
    hit = (result.at_lower | result.at_upper)[:count] & fitted
    at_bounds = tuple(names[i] for i in hit.nonzero().flatten().tolist())
    noise = effective_noise(residuals)
    told, lost = _told_by_data(problem, result, names, fitted, noise)
    residual = float(residuals.square().mean().sqrt())
    return Fit(
        model=problem.friction.requires_grad_(False),
        plant=problem.plant_at(vector),
        plant_terms=tuple(
            (t.name, float(v), t.upper) for t, v in zip(problem.plant_terms, vector, strict=True)
        ),
        status=("converged: " if result.converged else "not converged: ") + result.message,
        converged=result.converged,
        residual=residual,
        at_bounds=at_bounds,
        steps=result.steps,
        motions=motions,
        _residuals=residuals,
        intervals=told,
        lost=lost,
        warnings=warnings_of(
            converged=result.converged, at_bounds=at_bounds, lost=lost, residual=residual,
            effective_sd=noise, quantum=plant.position_quantum, unit=plant.unit,
        ),
    )  # fmt: skip


def _told_by_data(
    problem: TrajectoryProblem,
    result: LeastSquaresResult,
    names: Sequence[str],
    fitted: Tensor,
    noise: float,
) -> tuple[tuple[Interval, ...], tuple[str, ...]]:
    """Intervals, and what the data cannot tell; of a network, only of the plant's terms."""
    count = problem.shared_count
    if not torch.isfinite(result.hessian).all() or not noise > 0:
        return (), ()
    precision, _ = problem.prior()
    known = evidence(result.hessian, precision, count, problem.noise_sd, noise)
    constant = isinstance(problem.friction.schedule, Constant)
    shown = fitted.clone()
    if not constant:
        shown[: problem.friction_count] = False
    index = shown.nonzero().flatten()
    lower, upper = (bound[index] for bound in problem.bounds())
    chosen = [names[i] for i in index.tolist()]
    fixed = fitted.nonzero().flatten()
    part = Evidence(known.data[fixed][:, fixed], known.prior[fixed])
    sd = torch.zeros(count, dtype=torch.float64)
    sd[fixed] = standard_deviations(part)
    lost = lost_directions([names[i] for i in fixed.tolist()], part) if constant else ()
    return intervals(chosen, result.x[index], sd[index], lower, upper), lost

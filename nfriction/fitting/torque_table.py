"""Regression of friction laws on tables of friction torque, joint by joint."""

import copy
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from nfriction.fitting.bristles import fit_bristles
from nfriction.fitting.equation_error import TorqueBalance, regress
from nfriction.fitting.hysteresis import LEAD_IN, PATHS, fit_slip, path_of, range_of
from nfriction.fitting.options import DEFAULTS, FitOptions
from nfriction.fitting.recorded import fit_recorded, recorded_inputs
from nfriction.fitting.result.identifiability import (
    Information,
    Interval,
    confidence_intervals,
    covariance_root,
    null_directions,
)
from nfriction.fitting.shooting.autocorrelation import decimation, effective_noise
from nfriction.friction import model_by_name, plain_name
from nfriction.friction.coefficients import Constant
from nfriction.friction.hysteresis import Recorded
from nfriction.friction.laws import Law, Memory
from nfriction.friction.memory import states_along
from nfriction.friction.models import V_SMOOTH, FrictionModel
from nfriction.optim.least_squares import Quadratic
from nfriction.optim.levenberg_marquardt import LevenbergMarquardt
from nfriction.recording.torque_table import JointTorque, TorqueTable

# Width of the smoothed sign as a share of the largest velocity; at most `V_SMOOTH`.
TURN_SHARE = 0.01
# Share of the difference between starts that another start than the fit's has to explain.
START_SHARE = 0.25


@dataclass(frozen=True, eq=False)
class JointFit:
    """A friction model of one joint, fitted to its rows of a table."""

    model: FrictionModel  # of one joint, without gradients
    intervals: tuple[Interval, ...]  # 95 % confidence intervals of constant coefficients
    unidentifiable: tuple[str, ...]  # coefficients or combinations `"a with b"` without information
    root: Tensor  # R of the covariance R R^T of the model's parameters, (parameter, any)
    residual: float  # root mean square of the unexplained torque [N m; N]
    converged: bool = True

    @property
    def rules(self) -> int:
        """Number of fuzzy rules of recorded inputs."""
        own = self.model.schedule
        if not isinstance(own, Recorded):
            return 0
        return sum(own.layer(name).consequents.numel() for name in own.followed())

    @property
    def note(self) -> str:
        """Recorded inputs that the friction follows, after a semicolon; empty for none."""
        own = self.model.schedule
        return f"; follows {own.described(0)}" if isinstance(own, Recorded) and self.rules else ""

    @torch.no_grad()
    def steady(self, qd: Tensor, qdd: Tensor, load: Tensor) -> tuple[Tensor, Tensor]:
        """Torque at motions (row,), and its sd due to that of the parameters [N m]."""
        torque, slopes = torque_and_slopes(self.model, qd, qdd, load)
        # Coefficients without information are arbitrary; the band shows the others.
        root = torch.where(self.root.isfinite(), self.root, 0.0)
        return torque, (slopes @ root).norm(dim=-1)


def turning_velocity(table: TorqueTable) -> float:
    """Width of the smoothed sign of the velocity, for all joints of a table."""
    slowest = min(float(np.abs(joint.qd).max()) for joint in table.joints)
    return min(V_SMOOTH, TURN_SHARE * slowest)


def fit_joint(
    name: str, joint: JointTorque, v_smooth: float, options: FitOptions = DEFAULTS
) -> JointFit:
    """Constant coefficients of the law of a named model, by least squares within bounds.

    A neuro-fuzzy model then equals its constant law; see `fit_network`.

    Raises:
        ValueError: if there are too few rows, or the law needs a load that the table lacks.
    """
    model = model_by_name(name)(1, v_smooth=v_smooth)
    law = _for_slow(model.law, v_smooth / V_SMOOTH)
    if len(joint) <= len(law.coefficients):
        raise ValueError(
            f"{joint.name} moves in {len(joint)} rows, too few for the {len(law.coefficients)} "
            f"coefficients of {name}; measure at more velocities."
        )
    require_load(name, joint)
    qd, _, load, tau = _columns(joint)
    kept = torch.ones_like(qd, dtype=torch.bool)
    part = TorqueBalance(qd, load, tau, kept, None, joint.step, [(0, len(joint) - 1)])
    found = regress(law, [part], v_smooth, options)
    schedule: Any = model.schedule
    values = found.coefficients
    if schedule.form == "constant":
        schedule.set_parameter_vector(values.reshape(-1))
        lower, upper = Constant(law, 1, values).bounds()
        names = schedule.parameter_names([joint.name])
        free = (lower < upper).nonzero().flatten()
        known = Information(found.information[0], torch.zeros(len(names)).double())
        own = known.subset(free)
        part_root = covariance_root(own)
        root = torch.zeros(len(names), len(free)).double()
        root[free] = part_root
        fitted = [names[i] for i in free.tolist()]
        intervals = confidence_intervals(
            fitted, values[0][free], part_root.norm(dim=1), lower[free], upper[free], law
        )
        unknown = null_directions(fitted, own)
    else:
        schedule.set_range(*_range(joint, options))
        schedule.set_reference(values, _scale(model, joint), options.zero_reference)
        count = len(schedule.parameter_vector())
        intervals, unknown, root = (), (), torch.zeros(count, 1).double()
    return JointFit(model.requires_grad_(False), intervals, unknown, root, float(found.residual[0]))


def _for_slow(law: Law, share: float) -> Law:
    """A law with further start values, and so bounds, that suit slow joints and axes in m.

    `share` is the ratio of the joint's velocities to those that the law's own start values suit.
    """
    factor = {"rad/s": share, "s/rad": 1 / share}
    every = (
        replace(c, initial_grid=(*c.initial_grid, *(factor[c.unit] * x for x in c.initial_grid)))
        if share < 1 and c.unit in factor and c.fitted
        else c
        for c in law.coefficients
    )
    return replace(law, coefficients=tuple(every))


def fit_network(
    constant: JointFit, joint: JointTorque, share: float, options: FitOptions = DEFAULTS
) -> JointFit:
    """Train the network of a neuro-fuzzy model that `fit_joint` set to its constant law.

    `share` is that of the schedule's prior standard deviation.
    """
    model = copy.deepcopy(constant.model)
    qd, qdd, load, tau = _columns(joint)
    with torch.no_grad():
        error = (model(qd, qdd, load) - tau)[None]
    noise = max(effective_noise(error), 1e-12 * float(tau.abs().max()))
    stride = decimation(error, options)
    qd, qdd, load, tau = (x[::stride] for x in (qd, qdd, load, tau))
    # Rows that are left out would have had the same weight as those that stay.
    precision = stride / noise**2
    mean, sd = model.schedule.prior()
    weight = (share * sd).pow(-2)

    def quadratic(x: Tensor) -> Quadratic:
        model.schedule.set_parameter_vector(x)
        torque, slopes = torque_and_slopes(model, qd[:, 0], qdd[:, 0], load[:, 0])
        error = torque - tau[:, 0]
        pull = weight * (x - mean)
        cost = 0.5 * precision * error.square().sum() + 0.5 * (pull * (x - mean)).sum()
        gradient = precision * slopes.T @ error + pull
        return Quadratic(cost, gradient, precision * slopes.T @ slopes + torch.diag(weight))

    lower, upper = model.schedule.bounds()
    found = LevenbergMarquardt(cost_tolerance=1e-6, max_steps=options.max_steps).minimise(
        quadratic, torch.zeros_like(mean), lower=lower, upper=upper
    )
    model.schedule.set_parameter_vector(found.x)
    root = covariance_root(Information(found.hessian - torch.diag(weight), weight))
    residual = float((predict(model, joint) - torch.as_tensor(joint.tau)).square().mean().sqrt())
    return replace(
        constant, model=model.requires_grad_(False), root=root, residual=residual,
        converged=found.converged,
    )  # fmt: skip


def fit_memory(
    name: str, joint: JointTorque, blocks: Sequence[NDArray[np.intp]], v_smooth: float
) -> tuple[JointFit, tuple[float, ...]]:
    """Coefficients of a named model with memory, and its errors on hold-out blocks [N m; N].

    Raises:
        ValueError: if the rows have no time, their position does not change, or the law needs a
            load that the table lacks.
    """
    model = model_by_name(name)(1, v_smooth=v_smooth)
    schedule: Any = model.schedule
    if schedule.follows_motion:
        raise ValueError(
            f"{plain_name(name)} is fitted to recordings of motion, not to tables; use its law, or "
            "slip."
        )
    if joint.time is None:
        raise ValueError(
            f"{plain_name(name)} depends on the preceding motion, but {joint.name} has no column "
            "time; add one, or leave the model out."
        )
    if range_of(joint) == 0.0:
        raise ValueError(
            f"column q of {joint.name} does not change, but laws with memory, such as "
            f"{plain_name(name)}, need motion; give its positions, or a table without q."
        )
    require_load(name, joint)
    unknown: tuple[str, ...] = ()
    if "sigma_0" in model.law.names:
        found = fit_bristles(model.law, joint, blocks)
        if not found.presliding:
            # A stiff joint explains the rows equally well: they contain no presliding.
            unknown = (f"sigma_0 of {joint.name}",)
    elif schedule.form == "recorded":
        found = fit_recorded(cast("Recorded", schedule), joint, blocks, v_smooth)
    elif "f_o" in model.law.names:
        loaded = joint.load is not None and reads_load(model)
        found = fit_slip(joint, blocks, loaded=loaded)
    else:
        raise ValueError(f"{plain_name(name)} is not fitted to tables; use slip.")
    schedule.set_parameter_vector(torch.tensor(found.coefficients))
    error = torch.tensor(found.torque - joint.tau)
    noise = max(effective_noise(error[None, :, None]), 1e-12 * float(np.abs(joint.tau).max()))
    design = torch.tensor(found.design) / noise
    known = Information(design.T @ design, torch.zeros(len(found.fitted)).double())
    own = covariance_root(known)
    root = torch.zeros(len(found.coefficients), own.shape[1]).double()
    kept = list(found.fitted)
    root[kept] = own
    names = schedule.parameter_names([joint.name])
    fitted = [names[k] for k in kept]
    values = schedule.parameter_vector()[kept]
    # The bounds of simulations are not those of a table's slow joints.
    upper = torch.full_like(values, torch.inf)
    lower = torch.where(schedule.positive[kept], 0.0, -upper)
    intervals = confidence_intervals(fitted, values, own.norm(dim=1), lower, upper, model.law)
    residual = float(error.square().mean().sqrt())
    fit = JointFit(
        model.requires_grad_(False), intervals, (*unknown, *null_directions(fitted, known)), root,
        residual,
    )  # fmt: skip
    return fit, found.errors


def predict(model: FrictionModel, joint: JointTorque, lead_in: float = LEAD_IN) -> Tensor:
    """Friction torque of a model of one joint at the rows of a table, (row,) [N m; N].

    Args:
        model: of one joint.
        joint: rows; in order of time for a law with memory.
        lead_in: time from the first row [s] from whose torque the initial deflection of a law with
            memory is estimated; 0 starts undeflected.
    """
    require_load(type(model).__name__, joint, model)
    if model.law.memory is not None:
        return _remembered(model, model.law.memory, joint, lead_in)
    with torch.no_grad():
        torque: Tensor = model(*_columns(joint)[:3])[:, 0]
        return torque


@torch.no_grad()
def _remembered(model: FrictionModel, memory: Memory, joint: JointTorque, lead_in: float) -> Tensor:
    """Torque of a law with memory along rows in order of time."""
    if joint.time is None:
        raise ValueError(f"a law with memory needs the time of the rows of {joint.name}.")
    qd, qdd, load, tau = _columns(joint)
    coefficients = model.coefficients(qd[:1], qdd[:1]).reshape(1, -1)
    step = np.diff(joint.time, prepend=joint.time[0] - joint.step)
    moved = torch.tensor(path_of(joint) / step)[:, None]
    steps = torch.tensor(step)

    def along(state: Tensor, rows: slice) -> Tensor:
        """States after rows, (row, *state)."""
        held = coefficients.expand(len(steps[rows]), -1, -1)
        return states_along(memory, state, moved[rows], load[rows], held, steps[rows])

    still = torch.zeros(1, 1, memory.size).double()
    # A table to predict may have no torque to estimate the start from.
    seen = lead_in if bool(tau.isfinite().all()) else 0.0
    first = slice(int(np.searchsorted(joint.time, joint.time[0] + seen)))
    if first.stop:
        names, reach = model.law.names, max(range_of(joint), 1e-12)
        own = float(coefficients[0, names.index("p_0")]) if "p_0" in names else 0.0
        way = torch.tensor([own, 0.0, *(sign * reach * x for x in PATHS for sign in (1, -1))])
        starts = memory.advance(
            still.expand(len(way), 1, -1), way.sign()[:, None], load[0], coefficients,
            way.abs()[:, None],
        )  # fmt: skip
        states = along(starts, first)[..., 0, :]
        speed, force = (x[first].expand(states.shape[:-1]) for x in (qd, load))
        torque = memory.torque(states, speed, force, coefficients[0])
        rmse = (tau[first] - torque).square().mean(0).sqrt()
        best = int(rmse.argmin())
        # Noise at rest must not select a start that contradicts later rows of the fit.
        spread = torque.mean(0).max() - torque.mean(0).min()
        best = best if rmse[best] + START_SHARE * spread < rmse[0] else 0
        still = starts[best][None]
        fading = float(coefficients[0, names.index("d_r")]) if "d_r" in names else 0.0
        if fading > 1e-6 * reach:
            # Friction that the elements do not explain is the excess after a long rest.
            left = torch.exp(-(moved[first].abs() * steps[first, None]).cumsum(0) / fading)[:, 0]
            error = (tau[first] - torque)[:, best]
            still[..., -1] = left @ error / left.square().sum()
    states = along(still, slice(None))[:, 0]
    torque = memory.torque(states, qd, load, coefficients)
    if model.schedule.form == "recorded":
        torque = cast("Recorded", model.schedule).corrected(torque, recorded_inputs(joint))
    return torque[:, 0]


def torque_and_slopes(
    model: FrictionModel, qd: Tensor, qdd: Tensor, load: Tensor
) -> tuple[Tensor, Tensor]:
    """Torque at motions (row,), and its derivatives in the parameters, (row, parameter)."""
    qd, qdd, load = (x[:, None] for x in (qd, qdd, load))
    with torch.no_grad():
        coefficients = model.coefficients(qd, qdd).expand(*qd.shape, -1).clone()
        by_parameter = model.schedule.sensitivities(qd, qdd).parameters
    with torch.enable_grad():
        # A law is elementwise, so the sum's gradient is each row's own.
        coefficients.requires_grad_()
        torque = model.steady_torque(qd, load, coefficients)
        (by_coefficient,) = torch.autograd.grad(torque.sum(), coefficients)
    slopes = torch.einsum("sk,skp->sp", by_coefficient[:, 0], by_parameter)
    return torque.detach()[:, 0], slopes


def join(models: Sequence[FrictionModel]) -> FrictionModel:
    """One model of several joints from models of one joint each, all of the same kind."""
    first = models[0]
    make: Any = type(first)
    joined: FrictionModel = make(len(models), v_smooth=first.v_smooth, **first.schedule.options())
    states = [model.state_dict() for model in models]
    joined.load_state_dict({key: torch.cat([s[key] for s in states]) for key in states[0]})
    return joined.requires_grad_(False)


def require_load(name: str, joint: JointTorque, model: FrictionModel | None = None) -> None:
    """Raise ValueError if the law of a model reads a load that the table lacks."""
    if joint.load is None and reads_load(model or model_by_name(name)(1)):
        raise ValueError(
            f"{name} needs the load, but {joint.name} has no column load; add one, or leave the "
            "model out."
        )


def reads_load(model: FrictionModel) -> bool:
    """True if the steady torque of a model of one joint depends on the load."""
    qd, load = torch.ones(2, 1).double(), torch.tensor([[0.0], [1.0]]).double()
    units = torch.ones(2, 1, len(model.law.names)).double()
    torque = model.steady_torque(qd, load, units)
    return not torch.equal(torque[0], torque[1])


def _columns(joint: JointTorque) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Velocity, acceleration, load (1 if there is none) and torque, each (row, 1)."""
    load = np.ones_like(joint.qd) if joint.load is None else joint.load
    qd, qdd, load_, tau = (torch.tensor(x)[:, None] for x in (joint.qd, joint.qdd, load, joint.tau))
    return qd, qdd, load_, tau


def _range(joint: JointTorque, options: FitOptions) -> tuple[float, list[float]]:
    """Largest |velocity|, and limits of the acceleration along the motion."""
    along = joint.qdd * np.sign(joint.qd)
    low, high = np.quantile(along, options.acceleration_quantiles)
    if not low < high:
        # At constant velocities there is no acceleration.
        low, high = low - 1.0, high + 1.0
    return float(np.abs(joint.qd).max()), [float(low), float(high)]


def _scale(model: FrictionModel, joint: JointTorque) -> Tensor:
    """Size of each coefficient that alone would explain a third of the torque, (1, coefficient).

    Zero for nonlinear coefficients.
    """
    qd, qdd, load, tau = _columns(joint)
    coefficients = model.coefficients(qd, qdd).detach().expand(*qd.shape, -1).clone()
    coefficients.requires_grad_()
    (by,) = torch.autograd.grad(model.torque(qd, load, coefficients).sum(), coefficients)
    third = tau.square().mean().sqrt() / 3
    linear = torch.tensor([c.linear for c in model.law.coefficients])
    return torch.where(linear, third / by.abs().amax(0).clamp_min(1e-12), 0.0)

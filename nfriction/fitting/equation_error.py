"""Equation error: constant coefficients from a regression on the torque that a motion implies."""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import pad

from nfriction.fitting.options import DEFAULTS, FitOptions
from nfriction.fitting.result.identifiability import NORMAL_95, Information, standard_deviations
from nfriction.fitting.robust_loss import Outliers, RobustLoss, named_outliers
from nfriction.fitting.shooting.autocorrelation import effective_noise
from nfriction.friction.coefficients import Constant
from nfriction.friction.laws import Coefficient, Law
from nfriction.friction.memory import load_of
from nfriction.friction.models import V_SMOOTH, FrictionModel
from nfriction.optim.least_squares import Quadratic
from nfriction.optim.levenberg_marquardt import LevenbergMarquardt
from nfriction.plant import Plant
from nfriction.recording import Recording
from nfriction.signals import Motion

# A robust loss is minimised by iteratively reweighted least squares: at most this many times, or
# until no coefficient changes by more than this fraction of the largest.
REWEIGHTINGS = 30
SETTLED = 1e-4
# Scatter of a torque that counts as round-off, relative to the torque.
ROUNDING = 1e-9


@dataclass(frozen=True)
class TorqueFit:
    """Constant coefficients from a regression on torques.

    Attributes:
        coefficients: (joint, coefficient), in SI.
        residual: root mean square of the unexplained torque, (joint,) [N m].
        torque: root mean square of the friction torque, (joint,) [N m].
        starts: the best coefficients at each combination of initial values of the nonlinear
            coefficients, (start, joint, coefficient).
        information: of the data about each joint's coefficients, (joint, coefficient,
            coefficient), with residuals inflated for autocorrelation.
        offset: of the drives, to be added to the measured torque, (joint,) [N m; N].
        weight: of each sample under a robust loss, (sample, joint).
        outliers: samples to which it gives less than half weight.
    """

    coefficients: Tensor
    residual: Tensor
    torque: Tensor
    starts: Tensor = field(default_factory=lambda: torch.zeros(0, 0, 0, dtype=torch.float64))
    information: Tensor = field(default_factory=lambda: torch.zeros(0, 0, 0, dtype=torch.float64))
    offset: Tensor = field(default_factory=lambda: torch.zeros(0, dtype=torch.float64))
    weight: Tensor = field(default_factory=lambda: torch.zeros(0, 0, dtype=torch.float64))
    outliers: tuple[Outliers, ...] = ()

    def where(self, chosen: Tensor, other: "TorqueFit") -> "TorqueFit":
        """The same with the chosen joints from another regression, (joint,)."""
        rows = chosen[:, None]
        return replace(
            self,
            coefficients=torch.where(rows, other.coefficients, self.coefficients),
            residual=torch.where(chosen, other.residual, self.residual),
            starts=torch.where(rows, other.starts, self.starts),
            information=torch.where(rows[..., None], other.information, self.information),
            offset=torch.where(chosen, other.offset, self.offset),
            weight=torch.where(chosen, other.weight, self.weight),
        )


def friction_torque(
    plant: Plant, recording: Recording, motion: Motion, options: FitOptions = DEFAULTS
) -> tuple[Tensor, Tensor, Tensor]:
    """Velocity, load and friction torque along a recording, each (sample, joint).

    `tau_f = tau - inverse_dynamics(q, qd, qdd)` in joint coordinates, without the ends of the
    record.
    """
    inside = _inside(motion.time, options.edge)
    q, qd, qdd = (torch.as_tensor(x[inside]) for x in (motion.q, motion.qd, motion.qdd))
    tau = np.zeros_like(recording.q) if recording.tau is None else recording.tau
    friction = torch.as_tensor(tau[inside]) - plant.inverse_dynamics(q, qd, qdd)
    return qd, plant.load(q, qd), friction


def peak_dynamics_torque(
    plant: Plant, motions: Sequence[Motion], options: FitOptions = DEFAULTS
) -> tuple[Tensor, Tensor]:
    """Largest speed of each joint, and its largest torque of gravity or of inertia, (joint,).

    Gravity and inertia are taken separately, because in a free swing they nearly cancel.
    """
    speeds, torques = [], []
    for motion in motions:
        inside = _inside(motion.time, options.edge)
        q, qd, qdd = (torch.as_tensor(x[inside]) for x in (motion.q, motion.qd, motion.qdd))
        rest = plant.inverse_dynamics(q, torch.zeros_like(q), torch.zeros_like(q))
        speeds.append(qd)
        torques += [plant.gravity(q), plant.inverse_dynamics(q, qd, qdd) - rest]
    return torch.cat(speeds).abs().amax(0), torch.cat(torques).abs().amax(0)


def _inside(time: NDArray[np.float64], edge: float) -> NDArray[np.bool_]:
    return (time >= time[0] + edge) & (time <= time[-1] - edge)


@dataclass(frozen=True, eq=False)
class TorqueBalance:
    """The torque balance of one recording: friction implied by its smoothed motion.

    A smoother low-pass filters the acceleration, and with it the jumps of dry friction. If the
    torques and the law's regressors pass the same filter, its bias cancels; otherwise a reversal
    smeared over 50 ms would hide all friction that falls with speed.

    References:
        M. Gautier, Dynamic identification of robots with power model, ICRA 1997 (both sides of
        the regression through one low-pass filter).
    """

    qd: Tensor  # (sample, joint)
    load: Tensor  # (sample, joint)
    torque: Tensor  # of friction, (sample, joint) [N m]
    kept: Tensor  # samples away from the ends whose direction of motion is known, (sample, joint)
    rate: Tensor | None  # corner frequency of the smoother, (joint,) [rad/s]; None without one
    step: float  # [s]
    segments: Sequence[tuple[int, int]]  # first and last sample of each part without a gap

    def smoothed(self, x: Tensor) -> Tensor:
        """Torques (sample, joint, any) filtered as by the smoother."""
        if self.rate is None:
            return x
        found = x.clone()
        for first, last in self.segments:
            part = x[first : last + 1]
            # Mirrored, so that the ends meet.
            spectrum = torch.fft.rfft(torch.cat([part, part.flip(0)]), dim=0)
            frequency = 2 * math.pi * torch.fft.rfftfreq(2 * len(part), self.step)
            gain = 1 / (1 + (frequency[:, None] / self.rate) ** 8)
            back = torch.fft.irfft(spectrum * gain[..., None], n=2 * len(part), dim=0)
            found[first : last + 1] = back[: len(part)]
        return found


def _balance(
    law: Law, plant: Plant, recording: Recording, motion: Motion, options: FitOptions
) -> TorqueBalance:
    q, qd, qdd = (torch.as_tensor(x) for x in (motion.q, motion.qd, motion.qdd))
    tau = torch.zeros_like(q) if recording.tau is None else torch.tensor(recording.tau)
    kept = torch.as_tensor(_inside(motion.time, options.edge))[:, None].expand_as(q)
    step = float(np.median(np.diff(motion.time)))
    rate = _smoother_rate(motion)
    load = load_of(law, plant, q, qd, tau)
    found = TorqueBalance(qd, load, tau, kept, rate, step, recording.segments)
    if rate is not None and motion.std is not None:
        # A torque is held until the next sample, so it acts half a sample late.
        held = 0.5 * (tau + torch.cat([tau[:1], tau[:-1]]))
        tau = found.smoothed(held[..., None])[..., 0]
        # Stiction balances any torque, and noise around zero has no direction.
        kept = kept & (qd.abs() > NORMAL_95 * torch.as_tensor(motion.std.qd))
    return replace(found, torque=tau - plant.inverse_dynamics(q, qd, qdd), kept=kept)


def _travelled(q: Tensor) -> Tensor:
    """Distance of positions (sample, joint) from the last reversal, over the joint's range."""
    row = torch.arange(len(q))[1:-1, None]
    turned = torch.where(q.diff(dim=0)[1:] * q.diff(dim=0)[:-1] < 0.0, row, 0)
    last = torch.nn.functional.pad(turned, (0, 0, 1, 1)).cummax(0).values
    return (q - q.gather(0, last)).abs() / (q.amax(0) - q.amin(0))


def _smoother_rate(motion: Motion) -> Tensor | None:
    """Corner frequency of `kalman_smoother` as a low-pass filter, (joint,) [rad/s].

    Its gain is 1 / (1 + (w / rate)^8) far from the ends; the rate follows from the ratio of the
    standard deviations of acceleration and position, which is its square up to a constant.
    """
    if motion.std is None:
        return None
    q, qdd = (torch.as_tensor(np.median(x, axis=0)) for x in (motion.std.q, motion.std.qdd))
    shape = (math.sin(5 * math.pi / 8) / math.sin(math.pi / 8)) ** 0.25
    rate = shape * (qdd / q).sqrt()
    return rate if bool((torch.isfinite(rate) & (rate > 0)).all()) else None


def fit_equation_error(
    law: Law,
    plant: Plant,
    recordings: Sequence[Recording],
    motions: Sequence[Motion],
    v_smooth: float = V_SMOOTH,
    options: FitOptions = DEFAULTS,
    beyond: float = 0.0,
    known: Tensor | None = None,
) -> TorqueFit:
    """Least squares of the friction torque, joint by joint.

    Linear least squares within bounds for the linear coefficients, at every combination of the
    law's initial values of the others, which are then refined. Coefficients that are not fitted
    keep their values in `known`, (joint, coefficient), by default the initial ones. A drive that
    moves both ways has a constant offset where it is significant, unless the plant is not fitted.
    Samples are left out if their direction of motion is uncertain, or if the joint has moved by
    less than `beyond` times its range since the last reversal. A robust loss weights the squares.
    Recordings and motions are in joint coordinates.

    Raises:
        ValueError: if there are too few samples, or the law's torque is not finite along the
        motion.
    """
    parts = [_balance(law, plant, r, m, options) for r, m in zip(recordings, motions, strict=True)]
    count = sum(int(_inside(m.time, options.edge).sum()) for m in motions)
    if count <= len(law.coefficients):
        names = ", ".join(r.name or "a recording" for r in recordings)
        raise ValueError(
            f"{names}: too few samples, {count} more than {options.edge:g} s away from the ends, "
            f"for {len(law.coefficients)} coefficients per joint; record for longer."
        )
    kept = torch.cat([p.kept for p in parts])
    if beyond:
        kept = kept & torch.cat([_travelled(torch.as_tensor(m.q)) > beyond for m in motions])
    # In one direction, dry friction and an offset are alike.
    ways = torch.stack([(kept & (torch.cat([p.qd for p in parts]) * way > 0)).sum(0)
                        for way in (1, -1)])  # fmt: skip
    both = ways.amin(0) > options.two_way * ways.sum(0)
    # A joint that hardly ever moved uses all its samples.
    inside = torch.cat([torch.as_tensor(_inside(m.time, options.edge)) for m in motions])
    kept = torch.where(kept.sum(0) > len(law.coefficients), kept, inside[:, None])
    parts = [
        replace(part, kept=rows)
        for part, rows in zip(parts, kept.split([len(p.qd) for p in parts]), strict=True)
    ]
    found = regress(law, parts, v_smooth, options, known)
    measured = [np.zeros((1, plant.joints)) if r.tau is None else r.tau for r in recordings]
    driven = both & torch.as_tensor(np.concatenate(measured).any(0))
    if driven.any() and options.fit_plant and "f_o" not in law.names:
        other, significant = _offset_regression(law, parts, v_smooth, options, known)
        found = found.where(driven & significant, other)
    weights = zip(recordings, found.weight.split([len(r) for r in recordings]), strict=True)
    named = (outlier for r, weight in weights for outlier in named_outliers(r, weight.numpy()))
    return replace(found, outliers=tuple(named))


def _offset_regression(
    law: Law,
    parts: Sequence[TorqueBalance],
    v_smooth: float,
    options: FitOptions,
    known: Tensor | None,
) -> tuple[TorqueFit, Tensor]:
    """A regression with a constant torque of each drive, and where it is significant, (joint,).

    A weight or a sensor's bias that the plant lacks would otherwise take the place of friction.
    """

    def torque(qd: Tensor, load: Tensor, coefficients: Tensor, v_smooth: float) -> Tensor:
        return law.torque(qd, load, coefficients[..., :-1], v_smooth) - coefficients[..., -1]

    constant = Coefficient("offset", "N m", positive=False)
    wider = Law(law.name, (*law.coefficients, constant), torque)
    found = regress(wider, parts, v_smooth, options, None if known is None else pad(known, [0, 1]))
    values, both = found.coefficients[:, -1], found.information
    sd = [standard_deviations(Information(x, 0.0 * x[0]))[-1] for x in both]
    # Information about the coefficients with the offset unknown.
    across = both[:, :-1, -1:]
    alone = both[:, :-1, :-1] - across @ across.mT / both[:, -1:, -1:]
    found = replace(
        found, coefficients=found.coefficients[:, :-1], starts=found.starts[..., :-1],
        information=alone, offset=values,
    )  # fmt: skip
    return found, values.abs() > NORMAL_95 * torch.stack(sd)


def steady_law(law: Law) -> Law:
    """A law with memory in sliding: coefficients that only deflections reveal keep a value."""
    if law.memory is None:
        return law
    units = torch.ones(1, 1, len(law.names), dtype=torch.float64, requires_grad=True)
    one = torch.ones(1, 1, dtype=torch.float64)
    with torch.enable_grad():
        torque = law.torque(one, one, units, V_SMOOTH).sum()
        (slope,) = torch.autograd.grad(torque, units)
    coefficients = tuple(
        c if seen or c.linear
        else replace(c, initial_grid=(c.initial_grid[len(c.initial_grid) // 2],), fitted=False)
        for c, seen in zip(law.coefficients, slope.flatten() != 0.0, strict=True)
    )  # fmt: skip
    return replace(law, coefficients=coefficients)


def regress(
    law: Law,
    parts: Sequence[TorqueBalance],
    v_smooth: float,
    options: FitOptions = DEFAULTS,
    known: Tensor | None = None,
) -> TorqueFit:
    """Least squares of the kept samples of torque balances; see `fit_equation_error`."""
    torque, kept = (torch.cat([getattr(p, name) for p in parts]) for name in ("torque", "kept"))
    if known is None:
        known = Constant(law, torque.shape[1]).values.detach()
    regression = _Regression(law, known, parts, torque, kept, kept.to(torque), v_smooth, options)
    coefficients, starts = regression.solve()
    if options.loss != "linear":
        for _ in range(REWEIGHTINGS):
            before, regression = coefficients, regression.reweighted(coefficients)
            coefficients, starts = regression.solve()
            if (coefficients - before).abs().max() <= SETTLED * coefficients.abs().max():
                break
    slopes, error = regression.linearised(coefficients)
    many = kept.sum(0)
    # Inflated for autocorrelation.
    noise = [effective_noise(error[kept[:, j], j][None, :, None]) for j in range(len(many))]
    return TorqueFit(
        coefficients,
        (error.square().sum(0) / many).sqrt(),
        (torch.where(kept, torque, 0.0).square().sum(0) / many).sqrt(),
        starts,
        torch.stack([
            slopes[:, j].T @ slopes[:, j] / max(sd**2, 1e-300) for j, sd in enumerate(noise)
        ]),
        offset=torch.zeros(len(many), dtype=torch.float64),
        weight=torch.where(kept, regression.root.square(), 1.0),
    )  # fmt: skip


@dataclass(frozen=True, eq=False)
class _Regression:
    """Residuals of torque balances as a function of all coefficients of a law.

    `known` are values of coefficients that are not fitted, (joint, coefficient); `root` is the
    square root of each sample's weight, 0 where it is not `kept`, (sample, joint).
    """

    law: Law
    known: Tensor
    parts: Sequence[TorqueBalance]
    torque: Tensor
    kept: Tensor
    root: Tensor
    v_smooth: float
    options: FitOptions

    def solve(self) -> tuple[Tensor, Tensor]:
        """The best coefficients, and those at each combination of initial values."""
        law, candidates = self.law, []
        grids = {
            i: [known.new_full(known.shape[:1], x) for x in c.initial_grid] if c.fitted else [known]
            for i, (c, known) in enumerate(zip(law.coefficients, self.known.T, strict=True))
            if not (c.linear and c.fitted)
        }
        for values in itertools.product(*grids.values()):
            fixed = dict(zip(grids, values, strict=True))
            columns = [_design(law, p.qd, p.load, self.v_smooth, fixed) for p in self.parts]
            design = torch.cat([p.smoothed(c) for p, c in zip(self.parts, columns, strict=True)])
            candidates.append(self._linear_fit(design, fixed))
        starts, residuals = (torch.stack(x) for x in zip(*candidates, strict=True))
        # No prior would let a peak narrower than the slowest sample have any height. Its width is
        # that for the whole torque: errors of inertia terms hide how much of it is friction.
        many, least = self.kept.sum(0), residuals.amin(0)
        size = ((self.root * self.torque).square().sum(0) / many).sqrt()
        sd = prior_sd(law, TorqueFit(starts[0], 0 * least, size), self.options)
        noise = torch.maximum(least, ROUNDING * size) / many.sqrt()
        best = (residuals.square() + (noise[:, None] * starts / sd).square().sum(-1)).argmin(0)
        coefficients = starts[best, torch.arange(len(best))]
        if any(c.fitted for c in law.coefficients if not c.linear):
            coefficients = self.refined(coefficients)
        return coefficients, starts

    def reweighted(self, coefficients: Tensor) -> "_Regression":
        """The same with the weights of the robust loss at the residuals of these coefficients."""
        error = replace(self, root=self.kept.to(self.root)).linearised(coefficients)[1]
        root = torch.zeros_like(error)
        for j, (rows, of_joint) in enumerate(zip(self.kept.T, error.T, strict=True)):
            found, least = of_joint[rows, None], ROUNDING * float(self.torque[rows, j].abs().max())
            least = max(least, self.options.min_noise)
            loss = RobustLoss.of_errors(self.options.loss, found, least)
            root[rows, j] = loss.weight(found)[:, 0].sqrt()
        return replace(self, root=root)

    def linearised(self, coefficients: Tensor) -> tuple[Tensor, Tensor]:
        """Slopes (sample, joint, coefficient) and residuals (sample, joint); 0 if left out."""
        rows = []
        for part in self.parts:
            # A law is elementwise, so the sum's gradient contains every sample's slopes.
            own = coefficients.expand(len(part.qd), -1, -1).clone().requires_grad_()
            with torch.enable_grad():
                torque = self.law.torque(part.qd, part.load, own, self.v_smooth)
                slopes = torch.autograd.grad(torque.sum(), own)[0]
            rows.append(part.smoothed(torch.cat([torque.detach()[..., None], slopes], -1)))
        found = self.root[..., None] * torch.where(self.kept[..., None], torch.cat(rows), 0.0)
        return found[..., 1:], found[..., 0] - self.root * torch.where(self.kept, self.torque, 0.0)

    def refined(self, coefficients: Tensor) -> Tensor:
        """The coefficients at the nearest minimum within the bounds of a fit."""
        lower, upper = Constant(self.law, len(coefficients), coefficients).bounds()

        def model(x: Tensor) -> Quadratic:
            slopes, error = self.linearised(x.reshape(coefficients.shape))
            blocks = torch.einsum("sjk,sjl->jkl", slopes, slopes)
            gradient = torch.einsum("sjk,sj->jk", slopes, error).reshape(-1)
            return Quadratic(0.5 * error.square().sum(), gradient, torch.block_diag(*blocks))

        solver = LevenbergMarquardt(cost_tolerance=1e-12)
        found = solver.minimise(model, coefficients.reshape(-1), lower=lower, upper=upper)
        return found.x.reshape(coefficients.shape)

    def _linear_fit(self, design: Tensor, fixed: dict[int, Tensor]) -> tuple[Tensor, Tensor]:
        """Coefficients (joint, coefficient) and residual (joint,) for given values of some."""
        from scipy.optimize import lsq_linear  # slow to import

        law, joints = self.law, self.torque.shape[1]
        linear = [i for i in range(len(law.coefficients)) if i not in fixed]
        lower = [0.0 if law.coefficients[i].positive else -np.inf for i in linear]
        coefficients = torch.zeros(joints, len(law.coefficients), dtype=self.torque.dtype)
        for k, value in fixed.items():
            coefficients[:, k] = value
        residual = torch.zeros(joints, dtype=self.torque.dtype)
        for joint in range(joints):
            rows = self.kept[:, joint]
            root = self.root[rows, joint]
            *columns, without = design[rows, joint].T
            a = (root * torch.stack(columns)).numpy().T if columns else np.zeros((len(root), 0))
            y = (root * (self.torque[rows, joint] - without)).numpy()
            # Columns of unit length, because coefficients differ by orders of magnitude.
            scale = np.linalg.norm(a, axis=0)
            scale[scale == 0] = 1.0
            system = np.concatenate([a / scale, self.options.ridge * np.eye(len(linear))])
            target = np.concatenate([y, np.zeros(len(linear))])
            # The triangular factor has the same minimum, at the same cost for any number of rows.
            triangle = np.asarray(np.linalg.qr(np.column_stack([system, target]), mode="r"))
            # A step along an infinite bound is 0 times infinity inside SciPy, which ignores it.
            with np.errstate(invalid="ignore"):
                found = lsq_linear(
                    triangle[:, :-1], triangle[:, -1], bounds=(lower, np.inf), tol=1e-12
                )
            solution = found.x / scale
            coefficients[joint, linear] = torch.as_tensor(solution)
            residual[joint] = float(np.sqrt(np.mean((a @ solution - y) ** 2)))
        return coefficients, residual


def _design(
    law: Law, qd: Tensor, load: Tensor, v_smooth: float, fixed: dict[int, Tensor]
) -> Tensor:
    """Torque per unit of each other coefficient, and without them, (sample, joint, other + 1)."""
    none = torch.zeros(*qd.shape, len(law.coefficients), dtype=qd.dtype)
    for k, value in fixed.items():
        none[..., k] = value
    others = [i for i in range(len(law.coefficients)) if i not in fixed]
    without, columns = law.torque(qd, load, none, v_smooth), []
    for i in others:
        unit = none.clone()
        unit[..., i] = 1.0
        columns.append(law.torque(qd, load, unit, v_smooth) - without)
    design = torch.stack([*columns, without], -1)
    for sample, joint, k in (~torch.isfinite(design)).nonzero()[:1].tolist():
        ones = [f"{law.names[i]} is 1" for i in others]
        unit_of = [*ones, "its linear coefficients are 0"][k]
        raise ValueError(
            f"law {law.name!r} gives {float(design[sample, joint, k]):g} where {unit_of}, at joint "
            f"{joint + 1}, velocity {float(qd[sample, joint]):g} and load "
            f"{float(load[sample, joint]):g}; its torque must be a finite number."
        )
    return design


def coefficient_scale(
    model: FrictionModel, plant: Plant, recordings: Sequence[Recording], motions: Sequence[Motion]
) -> Tensor:
    """Size of each coefficient that alone would explain a third of the friction torque, in SI.

    Shape (joint, coefficient); zero for nonlinear coefficients and those of a hidden state.
    """
    pairs = zip(recordings, motions, strict=True)
    torque = torch.cat([friction_torque(plant, r, m)[2] for r, m in pairs]).square().mean(0).sqrt()
    rms = torch.as_tensor(np.concatenate([m.qd for m in motions])).square().mean(0).sqrt()
    columns = []
    for c in model.law.coefficients:
        if not c.linear or c.stores:
            columns.append(torch.zeros_like(rms))
        elif c.unit.endswith("s/rad"):
            columns.append(torque / rms / 3)
        elif c.unit == "-":
            columns.append(torch.full_like(rms, 1 / 3))
        else:
            columns.append(torque / 3)
    return torch.stack(columns, -1)


def prior_sd(law: Law, torque: TorqueFit, options: FitOptions = DEFAULTS) -> Tensor:
    """Standard deviations of zero-mean priors [SI], (joint, coefficient); infinite without one."""
    shares = torch.tensor([c.prior_scale for c in law.coefficients], dtype=torque.torque.dtype)
    # On a light mechanism most of the torque consists of errors of inertia terms and smoothing.
    explained = (torque.torque.square() - torque.residual.square()).clamp_min(0.0).sqrt()
    explained = torch.maximum(explained, options.min_explained * torque.torque)
    plain = torch.tensor([c.unit == "-" for c in law.coefficients])
    return torch.where(plain, 1.0, explained.clamp_min(1e-9)[:, None]) * shares

"""Result of a fit: model, plant, convergence, confidence intervals and warnings."""

import html
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pkgutil import resolve_name
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import torch
from torch import Tensor

from nfriction.fitting.equation_error import TorqueFit, peak_dynamics_torque
from nfriction.fitting.options import Continuity
from nfriction.fitting.plant_parameters import TORQUE_DELAY
from nfriction.fitting.result.identifiability import (
    CoefficientUncertainty,
    Information,
    Interval,
    confidence_intervals,
    covariance_root,
    exceeds_drive_torque,
    model_error_warning,
    null_directions,
    observed_count,
    standard_deviations,
    warnings_of,
    weakly_identified,
)
from nfriction.fitting.robust_loss import Outliers, named_outliers, outlier_warning
from nfriction.fitting.shooting.autocorrelation import bandwidth, effective_noise, hac_sd
from nfriction.fitting.shooting.problem import ShootingProblem
from nfriction.fitting.shooting.variables import model_at
from nfriction.friction import model_names, plain_name
from nfriction.friction.models import FrictionModel
from nfriction.optim.least_squares import LeastSquaresResult
from nfriction.plant import Plant
from nfriction.recording import Recording
from nfriction.signals import Motion

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

BLURRED = (
    "The torque comes from a smoothed motion, which blurs friction at low speed and knows no error "
    'of the plant; `method="output_error"` gives a better answer, and intervals that cover both.'
)

Usability = Literal["good", "doubtful", "do not use"]
# Residuals above so many times the quantisation noise are mostly the model's error. A well-fitted
# law on a real bench has up to ten times.
DOUBTFUL_RATIO = 20.0
# A lower bound no larger exists only for the logarithm of a positive coefficient, in SI.
NOTHING = 1e-9


@dataclass(frozen=True)
class FitResult:
    """A fitted model and the quality of its fit.

    Attributes:
        model: the friction model, trained in place; without gradients, so that rollouts are
            compiled. To train it further: `model.requires_grad_(True)`.
        plant: the plant with its adjusted terms.
        plant_terms: name, value and bound of each adjusted term.
        status: `"Converged ..."` or `"Not converged: ..."` with the reason.
        converged: whether the search ended at a minimum.
        residual: root mean square residual in `residual_unit`: of the positions over the training
            windows, or of the torque after an equation-error fit; as a robust loss counts them.
        at_bounds: names of parameters at a bound.
        steps: accepted steps of the last stage.
        motions: smoothed motion of each recording, in joint coordinates.
        residuals: position errors of the training windows [rad; m], (window, sample, joint); empty
            after an equation-error fit.
        intervals: 95 % confidence intervals of constant coefficients and plant terms, by the
            effective sample size of autocorrelated residuals. After an equation-error fit they take
            the plant and the smoothed motion for exact.
        unidentifiable: parameters, or combinations `"a with b"`, that the data do not determine.
        warnings: a sentence each.
        encoder_offsets: added to the recorded positions to get true ones, in joint coordinates
            [rad; m], one row a recording; empty unless encoders were zeroed at each.
        uncertainty: standard deviation of the coefficients at any motion; None after an
            equation-error fit.
        continuity: of the fitted windows, see `fit`.
        data_warnings: warnings about the data; inherited by fits warm-started from this one.
        mistakes: likely mistakes in recordings or rig, see `fitting.diagnosis`; inherited, too.
        quantisation: noise of the encoder's count [rad; m]; None where the count is unknown, and
            after an equation-error fit.
        stages: length of the windows of each stage that was kept [s], and its residual in
            `residual_unit`; of constant coefficients.
        skipped_horizons: lengths of windows that the constant law could not follow [s].
        outliers: stretches of samples that a robust loss counts less than half.
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
    residuals: Tensor
    intervals: tuple[Interval, ...] = ()
    unidentifiable: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()
    encoder_offsets: tuple[tuple[float, ...], ...] = ()
    uncertainty: CoefficientUncertainty | None = None
    continuity: Continuity = "none"
    data_warnings: tuple[str, ...] = ()
    mistakes: tuple[str, ...] = ()
    quantisation: float | None = None
    stages: tuple[tuple[float, float], ...] = ()
    skipped_horizons: tuple[float, ...] = ()
    outliers: tuple[Outliers, ...] = ()

    def longest_usable_horizon(self, windows: Sequence[float]) -> float:
        """The last of growing window lengths that the constant law could follow [s]."""
        usable = [w for w in windows if w < min(self.skipped_horizons, default=math.inf)]
        return usable[-1] if usable else windows[0]

    def with_warnings(
        self, data_warnings: Sequence[str], mistakes: Sequence[str] = ()
    ) -> "FitResult":
        """The same with these warnings about the data first, each once."""
        every = tuple(dict.fromkeys((*data_warnings, *self.data_warnings)))
        others = (w for w in self.warnings if w not in every)
        named = tuple(dict.fromkeys((*mistakes, *self.mistakes)))
        return replace(self, data_warnings=every, warnings=(*every, *others), mistakes=named)

    @property
    def usability(self) -> tuple[Usability, str]:
        """Fitness for simulation and control, and the reason in a clause."""
        times = self.residual / self.quantisation if self.quantisation else 0.0
        far = f"the residual is {times:.0f} times the encoder's quantisation noise"
        if self.mistakes:
            return "do not use", f"a mistake in the data is likely: {self.mistakes[0]}"
        if not self.converged and times > DOUBTFUL_RATIO:
            return "do not use", f"the search did not converge, and {far}"
        reasons = []
        if not self.converged:
            reasons.append("the search did not converge")
        if times > DOUBTFUL_RATIO:
            reasons.append(far)
        if self.unidentifiable:
            count = len(self.unidentifiable)
            reasons.append(f"the data do not determine {count} parameter{'s' * (count > 1)}")
        return ("doubtful", "; ".join(reasons)) if reasons else ("good", "")

    @property
    def torque_delay(self) -> float:
        """Time by which torques are recorded later than positions [s]; 0 unless it was fitted."""
        return next((value for name, value, _ in self.plant_terms if name == TORQUE_DELAY), 0.0)

    def aligned(self, recording: Recording) -> Recording:
        """A recording with its torque advanced by the fitted delay, as simulations need it."""
        delay = self.torque_delay
        return recording.advance_torque(delay) if delay and recording.tau is not None else recording

    @property
    def residual_unit(self) -> str:
        """Unit of `residual`: of positions (rad, m), or of torques (N m, N)."""
        if self.residuals.numel():
            return self.plant.unit
        return "N" if self.plant.unit == "m" else "N m"

    def to_dict(self) -> dict[str, Any]:
        """Summary for JSON."""
        offsets = {"encoder_offsets": [list(row) for row in self.encoder_offsets]}
        return {
            "status": self.status,
            "converged": self.converged,
            "usability": list(self.usability),
            "residual": self.residual,
            "residual_unit": self.residual_unit,
            "at_bounds": list(self.at_bounds),
            "plant": {name: value for name, value, _ in self.plant_terms},
            "intervals": {
                i.name: [x if math.isfinite(x) else None for x in (i.low, i.high)]
                for i in self.intervals
            },
            "unidentifiable": list(self.unidentifiable),
            "stages": [list(stage) for stage in self.stages],
            "warnings": list(self.warnings),
            **({} if self.continuity == "none" else {"continuity": self.continuity}),
            **(offsets if self.encoder_offsets else {}),
            **({"outliers": [o._asdict() for o in self.outliers]} if self.outliers else {}),
        }

    def to_pandas(self) -> "pd.DataFrame":
        """Table of coefficients and plant terms: value, low and high of 95 % intervals, note.

        Coefficients are in SI and plant terms relative to the rig, as in `intervals`. Coefficients
        that follow the motion are given where they apply, without intervals.
        """
        import pandas as pd  # slow to import

        joints, schedule = self.plant.joint_names, self.model.schedule
        rows: dict[str, tuple[float, float, float]] = {}
        for label, values in schedule.coefficient_sets().items():
            where = "" if label == "always" else f", {label.replace('_', ' ')}"
            for joint, of_joint in zip(joints, values.tolist(), strict=True):
                for name, value in zip(schedule.coefficient_names, of_joint, strict=True):
                    rows[f"{name} of {joint}{where}"] = (value, math.nan, math.nan)
        rows |= {i.name: (i.value, i.low, i.high) for i in self.intervals}
        table = pd.DataFrame.from_dict(rows, orient="index", columns=["value", "low", "high"])
        unknown = {name for direction in self.unidentifiable for name in direction.split(" with ")}
        table["note"] = [
            "not identifiable" if name in unknown else "at a bound" * (name in self.at_bounds)
            for name in rows
        ]
        return table.rename_axis("parameter")

    def _head(self) -> str:
        """Model, usability, status and residual in a line."""
        name, (verdict, reason) = type(self.model).__name__, self.usability
        known = f" ({plain_name(name)})" if name in model_names() else ""
        why = f" ({reason})" if reason else ""
        unit = self.residual_unit
        return (
            f"{name}{known}: {verdict}{why}. {self.status.rstrip('.')}. Residual "
            f"{1e3 * self.residual:.3g} m{unit} RMS over the training data."
        )

    def summary(self) -> str:
        """Usability, status, coefficients with 95 % intervals, and warnings, as text."""
        table = self.to_pandas().to_string(float_format=lambda x: f"{x:.4g}", na_rep="")
        warned = [f"- {warning}" for warning in self.warnings]
        return "\n".join([self._head(), *(line.rstrip() for line in table.splitlines()), *warned])

    def _repr_html_(self) -> str:
        """The summary for a notebook."""
        table = self.to_pandas().to_html(float_format=lambda x: f"{x:.4g}", na_rep="")
        warned = "".join(f"<li>{html.escape(warning)}</li>" for warning in self.warnings)
        return f"<p>{html.escape(self._head())}</p>{table}<ul>{warned}</ul>"

    def plot(self) -> "Figure":
        """Coefficients with their intervals; over the velocity where they are fuzzy.

        Others that follow the motion are drawn over time along the first recording. A notebook
        shows the figure, `figure.savefig(path)` writes it.
        """
        # By name, because plots is a layer above this one.
        plots, schedule = resolve_name("nfriction.plots"), self.model.schedule
        labels: dict[str, Any] = {"joint_names": self.plant.joint_names, "unit": self.plant.unit}
        figure: Figure
        if not schedule.follows_motion:
            figure = plots.coefficient_intervals({type(self.model).__name__: self})
        elif schedule.fuzzy_rules() is None:
            models = {type(self.model).__name__: self.model}
            figure = plots.coefficients_over_time(models, self.motions[0], **labels)
        else:
            labels |= {"motions": self.motions, "uncertainty": self.uncertainty}
            figure = plots.coefficient_sections(self.model, **labels)
        return figure


def result_from_equation_error(
    model: FrictionModel,
    plant: Plant,
    start: FitResult | None,
    motions: tuple[Motion, ...],
    torque: TorqueFit,
) -> FitResult:
    """The result of a regression on torques, which is written into the model."""
    model.schedule.set_parameter_vector(torque.coefficients.reshape(-1))
    names = model.schedule.parameter_names(plant.joint_names)
    lower, upper = model.schedule.bounds()
    fitted = (lower < upper).nonzero().flatten()
    fitted_names = [names[i] for i in fitted.tolist()]
    values, lower, upper = (x[fitted] for x in (model.schedule.parameter_vector(), lower, upper))
    known = Information(torch.block_diag(*torque.information), torch.zeros(len(names)).double())
    known = known.subset(fitted)
    sd = standard_deviations(known)
    low, high = values <= lower + NOTHING, values >= upper
    at_bounds, at_zero = (
        tuple(fitted_names[i] for i in mask.nonzero().flatten().tolist())
        for mask in (low | high, low & (lower.abs() <= NOTHING))
    )
    unidentifiable = null_directions(fitted_names, known)
    unidentifiable += tuple(
        name
        for name in weakly_identified(fitted_names, values, known)
        if not any(name in direction for direction in unidentifiable)
    )
    found = warnings_of(
        converged=True, at_bounds=at_bounds, unidentifiable=unidentifiable, at_zero=at_zero
    )
    return FitResult(
        model=model.requires_grad_(False),
        plant=start.plant if start else plant,
        plant_terms=start.plant_terms if start else (),
        status="Converged: linear least squares of the torque.",
        converged=True,
        residual=float(torque.residual.square().mean().sqrt()),
        at_bounds=at_bounds,
        steps=0,
        motions=motions,
        residuals=torch.zeros(0, dtype=torch.float64),
        intervals=confidence_intervals(fitted_names, values, sd, lower, upper),
        unidentifiable=unidentifiable,
        warnings=(*((*found, BLURRED) if found else ()), *outlier_warning(torque.outliers)),
        outliers=torque.outliers,
    )


def result_from_shooting(
    model: FrictionModel,
    problem: ShootingProblem,
    result: LeastSquaresResult,
    motions: tuple[Motion, ...],
    ambiguous: Sequence[str] = (),
) -> FitResult:
    """The result of a search, whose end is written into the model.

    `ambiguous` are parameters for which quite other values explain the data as well.
    """
    plant, variables, x = problem.jacobian.plant, problem.variables, result.x
    friction, vector, _, offsets = variables.split(x)
    model.load_state_dict(model_at(problem.friction, friction).state_dict())
    count, terms = variables.shared_count, variables.terms
    names = [*model.schedule.parameter_names(plant.joint_names), *(t.name for t in terms)]
    lower, upper = (bound[:count] for bound in variables.bounds())
    # Equal bounds: not fitted.
    hit = (result.at_lower | result.at_upper)[:count] & (lower < upper)
    least = lower.abs() <= NOTHING
    least[count - len(terms) :] = torch.tensor([t.to_none for t in terms], dtype=torch.bool)
    at_bounds, at_zero = (
        tuple(names[i] for i in mask.nonzero().flatten().tolist())
        for mask in (hit, hit & result.at_lower[:count] & least)
    )
    encoder_count = plant.position_quantum or observed_count(
        problem.windows.q @ problem.measurement.T
    )
    residuals = problem.errors(x)
    weights, counted = problem.loss.weight(residuals), problem.loss.counted(residuals)
    residual = float(counted.square().mean().sqrt())
    outliers = tuple(outliers_of(problem, weights))
    intervals, unidentifiable, root = _identifiability(
        problem, result, names, residuals * weights, motions, ambiguous
    )
    return FitResult(
        model=model.requires_grad_(False),
        plant=problem.plant_at(vector),
        plant_terms=tuple(
            (t.name, float(v), t.upper) for t, v in zip(terms, vector, strict=True)
        ),
        status=result.message if result.converged else f"Not converged: {result.message}",
        converged=result.converged,
        residual=residual,
        at_bounds=at_bounds,
        steps=result.steps,
        motions=motions,
        residuals=residuals,
        intervals=intervals,
        unidentifiable=unidentifiable,
        encoder_offsets=tuple(map(tuple, offsets.tolist())),
        quantisation=encoder_count and encoder_count / math.sqrt(12),
        warnings=warnings_of(
            converged=result.converged, at_bounds=at_bounds, unidentifiable=unidentifiable,
            at_zero=at_zero, options=problem.options,
            largest_defect=float(problem.defects(x).abs().max()) if problem.pairs else 0.0,
        )
        + model_error_warning(
            residual, effective_noise(counted), encoder_count, plant.unit, problem.options
        )
        + outlier_warning(outliers),
        outliers=outliers,
        uncertainty=None if root is None else CoefficientUncertainty(model.schedule, root),
    )  # fmt: skip


def outliers_of(problem: ShootingProblem, weights: Tensor) -> Iterator[Outliers]:
    """Samples that a robust loss counts less than half, by recording."""
    if problem.loss.name == "linear":
        return
    windows = problem.windows
    for place, recording in enumerate(windows.recordings):
        weight = np.ones_like(recording.q)
        for (of, first, last), row in zip(windows.spans, weights.numpy(), strict=True):
            if of == place:
                part = weight[first : last + 1]
                np.minimum(part, row[: last - first + 1], out=part)
        yield from named_outliers(recording, weight)


def _identifiability(
    problem: ShootingProblem,
    result: LeastSquaresResult,
    names: Sequence[str],
    residuals: Tensor,
    motions: Sequence[Motion],
    ambiguous: Sequence[str],
) -> tuple[tuple[Interval, ...], tuple[str, ...], Tensor | None]:
    """Confidence intervals, unidentifiable parameters, and a covariance root of the friction.

    Of a network only its plant terms have intervals, and no parameter counts as unidentifiable.
    """
    variables, options = problem.variables, problem.options
    count, friction_count = variables.shared_count, variables.friction_count
    constant = not problem.friction.schedule.follows_motion
    lower, upper = (bound[:count] for bound in variables.bounds())
    fitted = (lower < upper).nonzero().flatten()
    fitted_names = [names[i] for i in fitted.tolist()]
    # Residuals of exactly zero are those of joints that never moved.
    if not torch.isfinite(result.hessian).all() or not effective_noise(residuals) > 0:
        return (), tuple(fitted_names) if constant else (), None
    # Without the extrapolation prior: where that alone holds a network, the data do not.
    sd = hac_sd(residuals, bandwidth(problem.windows.q, options), options)
    known = problem.information(result.x, sd).subset(fitted)
    root = torch.zeros(count, len(fitted), dtype=torch.float64)
    root[fitted] = covariance_root(known)
    root[[names.index(name) for name in ambiguous]] = torch.inf
    sd = root.norm(dim=1)
    shown = fitted if constant else fitted[fitted >= friction_count]
    intervals = confidence_intervals(
        [names[i] for i in shown.tolist()], result.x[shown], sd[shown], lower[shown], upper[shown]
    )
    unidentifiable: tuple[str, ...] = ()
    if constant:
        friction = fitted[fitted < friction_count]
        coefficients = fitted_names[: len(friction)]
        unidentifiable = (*null_directions(fitted_names, known, options), *ambiguous)
        slope, need = _torque_scale(problem, result, motions)
        weak = (
            *weakly_identified(coefficients, result.x[friction], known, options),
            *exceeds_drive_torque(coefficients, sd[friction], slope[friction], need[friction]),
        )
        unidentifiable += tuple(
            name for name in dict.fromkeys(weak) if not any(name in d for d in unidentifiable)
        )
    return intervals, unidentifiable, root[:friction_count].clone()


def _torque_scale(
    problem: ShootingProblem, result: LeastSquaresResult, motions: Sequence[Motion]
) -> tuple[Tensor, Tensor]:
    """Derivative of the friction torque by each constant coefficient at its joint's peak speed, and
    the largest torque that moves this joint, (friction parameter,) each.
    """
    friction, vector, _, _ = problem.variables.split(result.x)
    speed, moved = peak_dynamics_torque(problem.plant_at(vector), motions, problem.options)
    need = torch.maximum(moved, problem.windows.tau.abs().amax((0, 1)))
    table = friction.reshape(len(speed), -1).clone().requires_grad_()
    with torch.enable_grad():
        # A law is elementwise, so the sum's gradient is each coefficient's own slope.
        torque = problem.friction.steady_torque(speed, torch.ones_like(speed), table)
        (slope,) = torch.autograd.grad(torque.sum(), table)
    return slope.flatten(), need[:, None].expand_as(slope).flatten()

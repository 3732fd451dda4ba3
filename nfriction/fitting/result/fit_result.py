"""Result of a fit: model, plant, convergence, confidence intervals and warnings."""

import copy
import html
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pkgutil import resolve_name
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import torch
from torch import Tensor

from nfriction.fitting.adjusted_plant import TORQUE_DELAY
from nfriction.fitting.data.inputs import advanced_torques, weighs
from nfriction.fitting.options import DEFAULTS
from nfriction.fitting.result.identifiability import CoefficientUncertainty, Interval
from nfriction.fitting.robust_loss import Outliers
from nfriction.friction import both_names
from nfriction.friction.heat import HEAT
from nfriction.friction.models import FrictionModel
from nfriction.plant import Plant
from nfriction.recording import Recording
from nfriction.recording.validation import gaps
from nfriction.signals import Motion

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

Usability = Literal["good", "doubtful", "do not use"]
# Normalised root mean square error that makes a fit doubtful: a fit below 99 % as defined in system
# identification (L. Ljung, System Identification, 2nd ed. 1999, section 16.3).
DOUBTFUL_ERROR = 0.01
# Standard deviation of a completely unknown angle [rad].
UNIFORM_TURN = math.pi / 3**0.5


@dataclass(frozen=True)
class InputGain:
    """Share of the squared error that an input explains, with all joints and with each alone."""

    name: str
    share: float
    by_joint: tuple[float, ...]

    def words(self, joint_names: Sequence[str]) -> str:
        """A sentence about the input."""
        alone = ", ".join(
            f"{joint} {round(100 * share)} %"
            for joint, share in zip(joint_names, self.by_joint, strict=True)
        )
        each = f" (with one joint alone: {alone})" if len(joint_names) > 1 else ""
        return f"Input {self.name} reduces the squared error by {100 * self.share:.0f} %{each}."


# Plant terms that are relative changes, each of one buffer: its name and unit.
_RELATIVE = {"inertia": ("inertia_coupling", "kg m^2"), "gravity": ("gravity_moment", "N m"),
             "armature": ("armature", "kg m^2"), "mass": ("mass", "kg")}  # fmt: skip


@dataclass(frozen=True)
class FitResult:
    """A fitted model and the quality of its fit.

    Attributes:
        model: the friction model, trained in place; without gradients, so that rollouts are
            compiled. To train it further: `model.requires_grad_(True)`.
        plant: the plant with its adjusted terms.
        plant_terms: name, value and bound of each adjusted term, relative to the plant as given.
        status: `"Converged ..."` or `"Not converged: ..."` with the reason.
        converged: whether the search ended at a minimum.
        residual: root mean square residual in `residual_unit`: of the positions over the training
            windows, or of the torque after an equation-error fit; weighted by a robust loss.
        at_bounds: names of parameters at a bound.
        steps: accepted steps of the last stage.
        motions: smoothed motion of each recording, in joint coordinates.
        residuals: position errors of the training windows [rad; m], (window, sample, joint); empty
            after an equation-error fit.
        intervals: 95 % confidence intervals of constant coefficients and plant terms, from the
            effective sample size of autocorrelated residuals. After an equation-error fit they
            assume that the plant and the smoothed motion are exact.
        unidentifiable: parameters, or combinations `"a with b"`, that the data do not determine.
        warnings: one sentence each.
        encoder_offsets: added to the recorded positions to get true ones, in joint coordinates
            [rad; m], one row per recording; empty unless encoders were zeroed at each.
        uncertainty: standard deviation of the coefficients at any motion; None after an
            equation-error fit.
        data_warnings: warnings about the data; inherited by fits warm-started from this one.
        mistakes: likely mistakes in recordings or rig, see `fitting.diagnosis`; also inherited.
        unmodelled: those of `data_warnings` on changes of friction, play and unfitted delays.
        noise: root mean square residual that a correct law would have from the noise of encoders
            and torque [rad; m]; None after an equation-error fit.
        stages: window length of each stage that was kept [s], and its residual in
            `residual_unit`; without those of its constant law for a network.
        skipped_horizons: lengths of windows that the constant law could not follow [s].
        outliers: consecutive samples to which a robust loss gives less than half weight.
        effective_parameters: for a network: name of each group of its parameters, how many of them
            the data determine (MacKay's gamma), and how many there are.
        inputs: for a network: further inputs that the fit selected, and how much each explains.
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
    data_warnings: tuple[str, ...] = ()
    mistakes: tuple[str, ...] = ()
    unmodelled: tuple[str, ...] = ()
    noise: float | None = None
    stages: tuple[tuple[float, float], ...] = ()
    skipped_horizons: tuple[float, ...] = ()
    outliers: tuple[Outliers, ...] = ()
    effective_parameters: tuple[tuple[str, float, int], ...] = ()
    inputs: tuple[InputGain, ...] = ()

    def longest_usable_horizon(self, windows: Sequence[float]) -> float:
        """The longest of growing window lengths that the constant law could follow [s]."""
        usable = [w for w in windows if w < min(self.skipped_horizons, default=math.inf)]
        return usable[-1] if usable else windows[0]

    def with_warnings(
        self,
        data_warnings: Sequence[str],
        mistakes: Sequence[str] = (),
        unmodelled: Sequence[str] = (),
    ) -> "FitResult":
        """The same with these warnings about the data first, each once."""
        every = tuple(dict.fromkeys((*data_warnings, *self.data_warnings)))
        others = (w for w in self.warnings if w not in every)
        return replace(
            self, data_warnings=every, warnings=(*every, *others),
            mistakes=tuple(dict.fromkeys((*mistakes, *self.mistakes))),
            unmodelled=tuple(dict.fromkeys((*unmodelled, *self.unmodelled))),
        )  # fmt: skip

    def with_own_model(self) -> "FitResult":
        """The same with a copy of the model, as another fit may change the given one."""
        model, uncertainty = copy.deepcopy((self.model, self.uncertainty))
        return replace(self, model=model, uncertainty=uncertainty)

    def with_terms_times(self, ratios: Mapping[str, float]) -> "FitResult":
        """The same with relative terms of the plant stated for another rig, by name.

        The plant stays; `ratios` are those of the terms of the present rig to the other one.
        """

        def changed(name: str, value: float) -> float:
            return (1.0 + value) * ratios[name] - 1.0 if name in ratios else value

        terms = tuple((name, changed(name, x), changed(name, b)) for name, x, b in self.plant_terms)
        intervals = []
        for i in self.intervals:
            value, low, high = (changed(i.name, x) for x in (i.value, i.low, i.high))
            intervals.append(replace(i, value=value, low=low, high=high))
        return replace(self, plant_terms=terms, intervals=tuple(intervals))

    def without(self, warnings: Sequence[str]) -> "FitResult":
        """The same without these warnings."""
        kinds = (self.warnings, self.data_warnings, self.unmodelled)
        kept, of_data, unmodelled = (tuple(w for w in own if w not in warnings) for own in kinds)
        return replace(self, warnings=kept, data_warnings=of_data, unmodelled=unmodelled)

    @property
    def usability(self) -> tuple[Usability, str]:
        """Fitness for simulation and control, and the reason in a clause.

        The residual is judged relative to the motion within windows, because a fine encoder shows
        errors that hardly matter; noise is not an error of the model.
        """
        noise = math.inf if self.noise is None else self.noise
        falls, length = weighs(self.plant), self.stages[-1][0] if self.stages else math.inf
        # Uniform motion needs no torque, so a model that follows it explains nothing.
        degree, moves = 0 if falls else 1, []
        for m in self.motions:
            # A trend passes through two samples.
            pieces = min(round(float(m.time[-1] - m.time[0]) / length), len(m.time) // 3)
            pieces = max(1, pieces)
            for time, q in zip(*(np.array_split(x, pieces) for x in (m.time, m.q)), strict=True):
                trend = np.vander(time - time.mean(), degree + 1)
                moves.append(q - trend @ np.linalg.lstsq(trend, q, rcond=None)[0])
        moved = np.concatenate([q.var(axis=0) for q in moves] or [[math.inf]])
        # A joint that keeps turning over under gravity can be anywhere on its circle.
        most = UNIFORM_TURN**2 if falls else math.inf
        motion = math.sqrt(np.minimum(moved, most).mean())
        above = self.residual > DEFAULTS.model_error_ratio * noise
        wrong = above and self.residual > DOUBTFUL_ERROR * motion
        # A recording at rest has no motion for comparison.
        far = "the residual is larger than the motion"
        if wrong and self.residual < motion:
            where = " within windows" * bool(self.stages)
            far = (
                f"the residual is {100 * self.residual / motion:.2g} % of the motion's standard "
                f"deviation{where}, and {self.residual / noise:.0f} times the measurement noise"
            )
        reasons = [f"a mistake in data or rig is likely: {x}" for x in self.mistakes[:1]]
        # A regression on torques simulates no motion that could excuse a mistake.
        if reasons and (wrong or not self.converged or self.noise is None):
            return "do not use", reasons[0]
        if wrong and not self.converged:
            return "do not use", f"the search did not converge, and {far}"
        # It explains less than half of the motion's variance.
        if wrong and 0 < motion**2 < 2 * self.residual**2:
            return "do not use", far
        if not self.converged:
            reasons.append("the search did not converge")
        if self.unmodelled:
            # Their first clauses.
            whys = [re.split(r"[.,:;] | \(", text)[0] for text in self.unmodelled]
            clauses = "; ".join(f"{why[0].lower()}{why[1:]}" for why in whys)
            reasons.append(f"{clauses}, see warnings")
        if wrong:
            reasons.append(far)
        # Terms of the rig do not count: a motion may depend only on their sum (link and rotor).
        joints, schedule = self.plant.joint_names, self.model.schedule
        # Including names of the constant law, which may be kept instead of a network or classes.
        law = {f"{name} of {joint}" for name in schedule.coefficient_names for joint in joints}
        names = law.union(schedule.parameter_names(joints))
        pairs = zip(schedule.coefficient_names, schedule.fitted_mask, strict=True)
        fitted = {f"{name} of {joint}" for name, free in pairs if free for joint in joints}
        if self.unidentifiable and fitted <= {*self.unidentifiable}:
            return "do not use", "the data determine no coefficient of the friction"
        if count := sum(not names.isdisjoint(x.split(" with ")) for x in self.unidentifiable):
            reasons.append(f"the data do not determine {count} parameter{'s' * (count > 1)}")
        return ("doubtful", "; ".join(reasons)) if reasons else ("good", "")

    @property
    def torque_delay(self) -> float:
        """Time by which torques are recorded later than positions [s]; 0 unless it was fitted."""
        return next((value for name, value, _ in self.plant_terms if name == TORQUE_DELAY), 0.0)

    def aligned(self, recording: Recording) -> Recording:
        """A recording with its torque advanced by the fitted delay, and held at the ends."""
        (advanced,) = advanced_torques([recording], self.torque_delay)
        return advanced

    @property
    def residual_unit(self) -> str:
        """Unit of `residual`: of positions (rad, m), or of torques (N m, N)."""
        if self.residuals.numel():
            return self.plant.unit
        return self.plant.effort_unit

    def names_with_si(self) -> dict[str, str]:
        """Names of relative plant terms, each with the value in SI as given and as fitted."""
        named, buffers = {}, dict(self.plant.named_buffers())
        for name, change, _ in self.plant_terms:
            term, _, place = name.partition(" ")
            if term in _RELATIVE:
                buffer, unit = _RELATIVE[term]
                values = buffers[buffer]
                if values.ndim > 1:  # the inertia of link 2 is 22, on the diagonal
                    values, place = values.diagonal(), place[len(place) // 2 :]
                value = float(values[int(place) - 1])
                named[name] = f"{name} ({value / (1 + change):.4g} -> {value:.4g} {unit})"
        return named

    def rule_seconds(self) -> list[list[float]]:
        """Seconds for which the recordings fired each rule of a network, by joint."""
        rules = self.model.schedule.fuzzy_rules()
        if rules is None:
            return []
        seconds = []
        for motion in self.motions:
            step = np.diff(motion.time, append=motion.time[-1])
            step[gaps(motion.time)] = 0.0
            seconds.append(rules.seconds(*map(torch.as_tensor, (step, motion.qd, motion.qdd))))
        return torch.stack(seconds).sum(0).tolist() if seconds else []

    def to_dict(self) -> dict[str, Any]:
        """Summary for JSON."""
        offsets = {"encoder_offsets": [list(row) for row in self.encoder_offsets]}
        gamma = {name: value for name, value, _ in self.effective_parameters}
        return {
            "status": self.status,
            "converged": self.converged,
            "usability": list(self.usability),
            "residual": self.residual if math.isfinite(self.residual) else None,
            "residual_unit": self.residual_unit,
            "at_bounds": list(self.at_bounds),
            "plant": {name: value for name, value, _ in self.plant_terms},
            "names_with_si": self.names_with_si(),
            "intervals": {
                i.name: [x if math.isfinite(x) else None for x in (i.low, i.high)]
                for i in self.intervals
            },
            "unidentifiable": list(self.unidentifiable),
            "stages": [[x if math.isfinite(x) else None for x in stage] for stage in self.stages],
            "warnings": list(self.warnings),
            **(offsets if self.encoder_offsets else {}),
            **({"outliers": [o._asdict() for o in self.outliers]} if self.outliers else {}),
            **({"effective_parameters": gamma} if gamma else {}),
            **({"rule_seconds": seconds} if (seconds := self.rule_seconds()) else {}),
            **({"inputs": [asdict(gain) for gain in self.inputs]} if self.inputs else {}),
        }

    def to_pandas(self) -> "pd.DataFrame":
        """Table of coefficients and plant terms: value, 95 % interval (low, high), note.

        Coefficients are in SI units, plant terms relative to the rig, as in `intervals`.
        Coefficients that follow the motion are listed by range of validity, without intervals.
        """
        import pandas as pd  # slow to import

        joints, schedule = self.plant.joint_names, self.model.schedule
        rows: dict[str, tuple[float, float, float]] = {}
        own = {i.name: (i.value, i.low, i.high) for i in self.intervals}
        sets = schedule.coefficient_sets()
        for label, values in sets.items():
            where = "" if label == "always" else f", {label.replace('_', ' ')}"
            for joint, of_joint in zip(joints, values.tolist(), strict=True):
                for c, value in zip(self.model.law.coefficients, of_joint, strict=True):
                    if c != HEAT and not (where and f"{c.name} of {joint}" in own):
                        rows[f"{c.name} of {joint}{where}"] = (value, math.nan, math.nan)
        rows |= own
        table = pd.DataFrame.from_dict(rows, orient="index", columns=["value", "low", "high"])
        unknown = {name for direction in self.unidentifiable for name in direction.split(" with ")}
        notes = dict.fromkeys(rows, "") | dict.fromkeys(self.at_bounds, "at a bound")
        names = zip(schedule.coefficient_names, schedule.fitted_mask, strict=True)
        kept = [name for name, fitted in names if not fitted]
        # A constant term of a network has an interval, from the fit of its law.
        of_law = "" if "always" in sets else "fitted with the constant law"
        for name, (_, low, _) in rows.items():
            if name.split(" of ")[0] in kept:
                notes[name] = "not fitted" if math.isnan(low) else notes[name] or of_law
        notes |= dict.fromkeys(unknown, "not identifiable")
        table["note"] = [notes[name] for name in rows]
        return table.rename_axis("parameter")

    def _head(self) -> str:
        """Model, usability, status and residual in a line."""
        name, (verdict, reason) = both_names(type(self.model).__name__), self.usability
        why = f" ({reason})" if reason else ""
        return (
            f"{name}: {verdict}{why}. {self.status.rstrip('.')}. Residual "
            f"{1e3 * self.residual:.3g} m{self.residual_unit} RMS over the training data."
        )

    def __repr__(self) -> str:
        warned = f"\nWarnings: {len(self.warnings)}; see `summary()`." if self.warnings else ""
        return f"FitResult of {self._head()}{warned}"

    def summary(self) -> str:
        """Usability, status, coefficients with 95 % intervals, and warnings, as text."""
        table = self.to_pandas().to_string(float_format=lambda x: f"{x:.4g}", na_rep="")
        warned = [f"- {warning}" for warning in self.warnings if warning not in self.status]
        return "\n".join([self._head(), *(line.rstrip() for line in table.splitlines()), *warned])

    def _repr_html_(self) -> str:
        """The summary for a notebook."""
        table = self.to_pandas().to_html(float_format=lambda x: f"{x:.4g}", na_rep="")
        warned = "".join(f"<li>{html.escape(warning)}</li>" for warning in self.warnings)
        return f"<p>{html.escape(self._head())}</p>{table}<ul>{warned}</ul>"

    def plot(self) -> "Figure":
        """Coefficients with their intervals; neuro-fuzzy ones over the velocity.

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

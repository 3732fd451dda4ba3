"""Fits of adaptive models: coefficients by class of acceleration (AFEM).

During a search the classes are those of the measured motion, so the cost is smooth in the
coefficients. Evidence determines how far classes deviate from the constant law, and whether they do
at all. The result is then used to the extent that it also improves simulations in which the class
follows the simulated motion.
"""

import logging
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace

import torch
from torch import Tensor

from nfriction.fitting.data.inputs import apply_encoder_offsets, integration_substeps
from nfriction.fitting.data.windows import Windows, cut_windows
from nfriction.fitting.equation_error import coefficient_scale
from nfriction.fitting.options import EncoderReference, FitOptions
from nfriction.fitting.result.fit_result import FitResult
from nfriction.fitting.result.of_search import result_from_shooting
from nfriction.fitting.shooting.autocorrelation import effective_noise
from nfriction.fitting.shooting.problem import ShootingProblem
from nfriction.fitting.shooting.sensitivity import StepJacobian
from nfriction.fitting.strategy.constant import constant_start
from nfriction.fitting.strategy.continuation import HorizonResult, ShootingFitter
from nfriction.fitting.strategy.neurofuzzy import constant_kept, log_evidence
from nfriction.fitting.task import Callback, FitTask, known_terms, prepare_task, terms_after
from nfriction.friction.models import FrictionModel
from nfriction.papers.afem.adaptive import CLASSES, Adaptive
from nfriction.papers.afem.classes import DEFAULTS, AccelerationClasses, ClassOptions, find_classes
from nfriction.plant import Plant
from nfriction.recording import Recording
from nfriction.signals import Motion
from nfriction.simulation.compiled import System, integrate_compiled
from nfriction.simulation.protocols import Rollout, RolloutInputs
from nfriction.simulation.rollout import integrate

logger = logging.getLogger(__name__)
# Relative decrease of the cost that ends the search by class.
TOLERANCE = 1e-6
# Fractions of the classes' deviations from the constant law to try, largest first.
SHARES = (1.0, 0.5, 0.25)
# Widths of the classes' prior among which evidence chooses, in units of `prior_sd`, all equally
# likely a priori. With the narrowest the classes equal the constant law.
NARROWEST, WIDTHS = 1e-4, (1 / 256, 1 / 64, 1 / 16, 1 / 4, 1.0)
# For a coefficient that is zero and has no scale [SI].
LEAST_SD = 1e-9
STOPPED = "Stopped before the classes were found"
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

    Like `nfriction.fit`, with options for the classes. The constant law is fitted first. Every
    class starts there and is pulled toward it as strongly as evidence favours, so a class with few
    data stays there. The constant coefficients are kept if classes gain too little evidence, or if
    the result does not simulate the training windows better with the class following the
    simulation.

    Args:
        model: the model to fit; changed in place.
        plant: the mechanism as given.
        options: see `nfriction.fit`; the last window length is used for the classes.
        classes: how classes are found, and how far they may deviate from the constant law.
        start, motions, callback: see `nfriction.fit`.

    Returns:
        The fit; check `converged` and `status`.

    Raises:
        ValueError: if recordings and plant do not match, the motion has no classes, or the model
            is not adaptive.

    References:
        TLRIP paper, AFEM.
    """
    task = prepare_task(
        model, plant, recordings, like_start(options, start), start, motions, callback
    )
    return fit_by_class(task, classes).with_terms_times(task.ratios).with_own_model()


def like_start(options: FitOptions, start: FitResult | None) -> FitOptions:
    """Options that match a start in having encoder offsets or none."""
    if start is None:
        return options
    reference: EncoderReference = "per_recording" if start.encoder_offsets else "shared"
    return replace(options, encoder_reference=reference)


def fit_by_class(task: FitTask, classes: ClassOptions = DEFAULTS) -> FitResult:
    """Fit coefficients by class by output error, from the fit of the constant law."""
    schedule = task.model.schedule
    if not isinstance(schedule, Adaptive):
        raise ValueError(f"{type(task.model).__name__} is no adaptive model; use `fit`.")
    # Fits by class do not include encoder eccentricity.
    options = replace(task.options, eccentricity="off")
    task = replace(task, options=options)
    constant = constant_start(task)
    length = constant.longest_usable_horizon(options.windows)
    by_class = ClassFit.of(task, schedule, constant, length, classes)
    task, given, windows = by_class.task, by_class.given, by_class.windows
    terms = terms_after(task, constant, given.law, task.plant)
    vector = known_terms(constant, terms)
    sd = torch.tensor([t.prior_sd for t in terms], dtype=torch.float64)
    fitter = ClassFitter(
        StepJacobian(task.plant, given, terms), given, task.recordings, task.measurement,
        replace(options, patience=0), task.callback, plant_prior=(vector, sd),
        classes=by_class.driving,
    )  # fmt: skip
    noise, name = effective_noise(constant.residuals), f"{length:g} s windows, by class"
    prior = by_class.table.prior()
    end, gain = fitter.likeliest(windows, noise, vector, prior, name)
    if end is None:
        return by_class.kept(STOPPED, converged=False)
    if not gain > options.evidence_gain:
        return by_class.kept(f"By evidence classes gain too little ({gain:.2g} nats)")
    # With the law's error as noise, the prior would outweigh what classes explain.
    least = max(effective_noise(end.residuals), options.min_noise)
    if least < noise:
        end = fitter.likeliest(windows, least, vector, prior, name)[0] or end.as_stopped()
    found = result_from_shooting(given, end.problem, end.result, task.motions)
    q0, qd0 = end.parts.states.chunk(2, -1)
    return by_class.backtracked(found, replace(windows, q0=q0, qd0=qd0), constant.residual)


class GivenClasses(Adaptive):
    """A table by class whose input is the class instead of the acceleration.

    `reference` are the constant coefficients toward which every class is pulled, and `sd` the
    standard deviation around them, both (joint, coefficient).
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

    def group_names(self) -> tuple[str, ...]:
        return ("deviations by class",)

    def groups(self) -> Tensor:
        return torch.zeros(len(self._mean), dtype=torch.int64)


@dataclass(frozen=True, eq=False)
class GivenClassesProblem(ShootingProblem):
    """A shooting problem whose coefficients follow given classes, (sample, joint) by recording."""

    classes: tuple[Tensor, ...] = ()

    def _integrate(self, plant: Plant, model: FrictionModel, inputs: RolloutInputs) -> Rollout:
        classes = along(self.windows, self.classes).repeat_interleave(self.substeps, 1)
        # The schedule reads the class instead of the acceleration; velocity is not used.
        measured = torch.zeros_like(classes), classes
        motion = integrate(plant, model, replace(inputs, measured=measured))
        # The derivatives of a step must be taken at the input that drove it.
        return replace(motion, qdd=torch.cat([classes, classes[:, -1:]], 1))


@dataclass(frozen=True, eq=False)
class ClassFitter(ShootingFitter):
    """A fitter whose problems follow given classes, see `GivenClassesProblem`."""

    classes: tuple[Tensor, ...] = ()

    def problem(
        self, windows: Windows, noise: float, friction: Tensor, *, stride: int = 1
    ) -> GivenClassesProblem:
        """The shooting problem of windows, started from these friction parameters."""
        posed = super().problem(windows, noise, friction, stride=stride)
        own = {f.name: getattr(posed, f.name) for f in fields(posed)}
        return GivenClassesProblem(**own, classes=self.classes)

    def likeliest(
        self, windows: Windows, noise: float, plant: Tensor, prior: tuple[Tensor, Tensor], name: str
    ) -> tuple[HorizonResult | None, float]:
        """The search at the width of the prior that evidence favours; None if stopped.

        Also returns the gain in log evidence over the constant law [nats], averaged over all
        widths, since the best of several always seems to gain.
        """
        (mean, sd), x = prior, None
        ends, evidence = [], []
        for width in (NARROWEST, *WIDTHS):
            fitter = replace(self, friction_prior=(mean, width * sd))
            problem = fitter.problem(windows, noise, mean)
            start = problem.variables.start(plant) if x is None else x
            end = fitter.search(problem, start, TOLERANCE, name)
            if end.stopped:
                return None, 0.0
            x = end.result.x
            ends.append(end)
            evidence.append(log_evidence(end))
        law, among = torch.tensor(evidence, dtype=torch.float64).split([1, len(WIDTHS)])
        together = among.logsumexp(0) - math.log(len(among)) - law
        return ends[1 + int(among.argmax())], float(together)


def along(windows: Windows, classes: Sequence[Tensor]) -> Tensor:
    """Class that determines every step of windows, (window, step, joint)."""
    driving = torch.zeros_like(windows.tau)
    for w, (place, first, last) in enumerate(windows.spans):
        driving[w, : last - first] = classes[place][first:last]
    return driving


@dataclass(frozen=True, eq=False)
class PositionError:
    """Position error of simulated windows as a function of a schedule's parameter vector."""

    plant: Plant
    friction: FrictionModel  # its schedule is overwritten and restored
    windows: Windows  # measured positions, with the states from which simulations start
    measurement: Tensor  # matrix (joint, joint) from joint coordinates to those of the recording
    substeps: int = 1
    drive: Tensor | None = None  # class of every sample (window, step, joint), or by simulation
    memory: Tensor | None = None  # hidden state at the starts, (window, joint, state_size)
    threads: int = 1  # among which candidates are divided

    @property
    def values(self) -> int:
        """Number of position errors."""
        return int(self.windows.weight.sum()) * self.windows.q0.shape[1]

    def rms(self, residuals: Tensor) -> float:
        """Root mean square of errors returned by `residuals` [rad]."""
        return float((residuals.square().sum() / self.values).sqrt())

    def residuals(self, vector: Tensor) -> Tensor:
        """Error of one candidate [rad], (window, step + 1, joint)."""
        return torch.cat(list(self.parts(vector[None])))

    def parts(self, vectors: Tensor) -> Iterator[Tensor]:
        """Errors of candidates (m, parameter) [rad], (m, step + 1, joint), window by window."""
        of = self.windows
        rows = [
            {name: p.detach().clone() for name, p in self.friction.named_parameters()}
            for _ in self._set_to_each(vectors)
        ]
        parameters = {name: torch.stack([row[name] for row in rows]) for name in rows[0]}
        for w in range(len(of)):
            error = (self._positions(w, vectors, parameters) - of.q[w]) @ self.measurement.T
            yield error * of.weight[w, :, None]

    def _positions(self, w: int, vectors: Tensor, parameters: Mapping[str, Tensor]) -> Tensor:
        of = self.windows
        measured = None if self.drive is None else (torch.zeros_like(self.drive[w]), self.drive[w])
        memory = None if self.memory is None else self.memory[w]
        inputs = RolloutInputs(
            of.q0[w], of.qd0[w], of.tau[w], of.step[w], self.substeps, measured, memory
        )
        batch = [state.expand(len(vectors), -1) for state in (inputs.q0, inputs.qd0)]
        # All candidates of a window in one call; without a compiler, one after another.
        system = System.of(self.plant, self.friction)
        moved = replace(inputs, q0=batch[0], qd0=batch[1])
        states = integrate_compiled(system, moved, "auto", self.threads, parameters)
        if states is not None:
            return states[0]
        runs = (integrate(self.plant, self.friction, inputs) for _ in self._set_to_each(vectors))
        return torch.stack([run.q for run in runs])

    def _set_to_each(self, vectors: Tensor) -> Iterator[None]:
        """Set the schedule to each vector in turn, and restore it at the end."""
        schedule = self.friction.schedule
        before = schedule.parameter_vector()
        for vector in vectors:
            schedule.set_parameter_vector(vector)
            yield
        schedule.set_parameter_vector(before)


@dataclass(frozen=True, eq=False)
class ClassFit:
    """An adaptive model to be fitted, with the classes of its recordings."""

    task: FitTask  # the fit, with encoder offsets removed
    motions: tuple[Motion, ...]  # as recorded
    constant: FitResult  # fit of the constant law, from which every class starts
    classes: AccelerationClasses
    schedule: Adaptive  # of the model to be fitted, set to these classes
    table: GivenClasses  # coefficients varied by a fit with given classes
    given: FrictionModel  # their model
    windows: Windows

    @classmethod
    def of(
        cls,
        task: FitTask,
        schedule: Adaptive,
        constant: FitResult,
        length: float,
        options: ClassOptions,
    ) -> "ClassFit":
        """Find the classes, set the schedule of the task's model to them, and cut windows [s]."""
        model = task.model
        joint, motions = apply_encoder_offsets(
            constant.encoder_offsets, task.plant, task.recordings, task.motions
        )
        classes = find_classes(schedule, joint, motions, task.plant.joint_names, options)
        for note in classes.notes:
            logger.info("%s", note)
        values = constant.model.schedule.coefficient_sets()["always"]
        natural = coefficient_scale(model, constant.plant, joint, motions)
        sd = options.prior_sd * torch.maximum(values.abs(), natural)
        # If neither gives a scale, the coefficient stays that of the law.
        table = GivenClasses(model, values, sd.clamp_min(LEAST_SD))
        given = FrictionModel(model.law, table, model.v_smooth).requires_grad_(False)
        # Windows are compared in joint coordinates, without encoder offsets.
        corrected = replace(task, recordings=joint, motions=motions)
        windows = cut_windows(joint, motions, length)
        return cls(corrected, task.motions, constant, classes, schedule, table, given, windows)

    @property
    def driving(self) -> tuple[Tensor, ...]:
        """Class at each sample of a recording; a class with too few data becomes its neighbour."""
        stands_for = self.classes.stands_for
        joints = torch.arange(len(stands_for))
        return tuple(stands_for[joints, known].double() for known in self.classes.labels)

    def backtracked(self, found: FitResult, windows: Windows, baseline: float) -> FitResult:
        """As much of the fit `found` as improves on `baseline` [rad], the constant law's error.

        Windows start at the states that the fit found.
        """
        task, constant, model, schedule = self.task, self.constant, self.task.model, self.schedule
        flat = constant.model.schedule.coefficient_sets()["always"][:, None]
        # A class without data was never varied: its own entry is still the start.
        table = torch.take_along_dim(self.table.values, self.classes.stands_for[..., None], 1)
        model.requires_grad_(False)
        along = [
            schedule.states(torch.as_tensor(m.qd), torch.as_tensor(m.qdd)) for m in task.motions
        ]
        memory = torch.stack([along[place][first] for place, first, _ in windows.spans])
        longest = max(r.longest_step for r in task.recordings)
        steps = integration_substeps(task.plant, self.given, longest)
        error = PositionError(found.plant, model, windows, task.measurement, steps, memory=memory)
        # In recorded coordinates: with the motions and encoder offsets of the constant fit.
        found = replace(
            found, model=model, motions=self.motions, encoder_offsets=constant.encoder_offsets,
            skipped_horizons=constant.skipped_horizons,
        )  # fmt: skip
        # Given classes hide the feedback of a wrong class on the motion that selects it.
        for share in SHARES:
            schedule.set_coefficients(flat + share * (table - flat))
            residuals = error.residuals(schedule.parameter_vector())
            rms = error.rms(residuals)
            if rms <= baseline:
                part = "" if share == 1.0 else f" {share:g} of the deviations by class is taken."
                status = found.status + part + "".join(f" {note}." for note in self.classes.notes)
                taken = replace(found, residual=rms, residuals=residuals, status=status)
                return taken.with_warnings(constant.data_warnings, unmodelled=constant.unmodelled)
        return self.kept("The classes simulate no better")

    def kept(self, reason: str, *, converged: bool = True) -> FitResult:
        """The constant fit as a fit of the adaptive model, with all classes equal."""
        flat = self.constant.model.schedule.coefficient_sets()["always"][:, None]
        self.schedule.set_coefficients(flat.expand(-1, len(CLASSES), -1))
        note = f"{reason}; the constant law is kept."
        kept = constant_kept(self.constant, self.task.model, note, converged=converged)
        return replace(kept, motions=self.motions)

"""The checked arguments of a fit, which every strategy takes."""

import logging
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import torch
from torch import Tensor

from nfriction.fitting.adjusted_plant import TORQUE_DELAY, PlantParameter
from nfriction.fitting.data import inputs
from nfriction.fitting.diagnosis.balance import Source, collect, unexplained_share
from nfriction.fitting.diagnosis.changes import changing_friction, loose_loads
from nfriction.fitting.diagnosis.corrections import balanced_delay
from nfriction.fitting.diagnosis.mistakes import correction_note, likely_mistakes, mistake_warning
from nfriction.fitting.equation_error import TorqueFit, fit_equation_error, prior_sd, steady_law
from nfriction.fitting.options import FitOptions
from nfriction.fitting.result.fit_result import FitResult
from nfriction.friction.coefficients import Constant
from nfriction.friction.inputs import INPUTS, has_input
from nfriction.friction.laws import Law
from nfriction.friction.models import FrictionModel
from nfriction.optim.least_squares import Step
from nfriction.plant import PendulumChain, Plant, rigs
from nfriction.recording import Recording, RecordingLike
from nfriction.signals import Motion

Callback = Callable[[str, Step], bool | None]


@dataclass(frozen=True, eq=False)
class FitTask:
    """Checked arguments of a fit, as every strategy (`Schedule.fit_strategy`) takes them."""

    model: FrictionModel  # to fit; a strategy changes it once, at the end
    plant: Plant  # the mechanism as given, or corrected in `ratios`
    recordings: Sequence[Recording]  # in joint coordinates
    measurement: Tensor  # matrix from joint to recorded coordinates, see `measurement_matrix`
    motions: tuple[Motion, ...]  # smoothed motion of each recording, in joint coordinates
    options: FitOptions
    start: FitResult | None = None
    callback: Callback | None = None  # `callback(stage, step)` after every step; True stops
    per_recording: bool = False  # whether encoders were set to zero at the start of each recording
    delay: float = 0.0  # of the torque after the positions, by their balance [s]; 0 unless fitted
    data_warnings: tuple[str, ...] = ()
    mistakes: tuple[str, ...] = ()
    drift: tuple[str, ...] = ()  # those of `data_warnings` on changes of friction
    unmodelled: tuple[str, ...] = ()  # those on other effects that no law describes
    smoothed: tuple[str, ...] = ()  # a warning of a wide smoothed sign
    ratios: Mapping[str, float] = field(default_factory=dict)  # of terms of `plant` to those given

    @property
    def offset_sd(self) -> Tensor | None:
        """Prior of the encoder offsets, (recording, joint) [rad; m]; None if they are known."""
        shape, sd = (len(self.recordings), self.plant.joints), self.options.encoder_offset_sd
        return torch.full(shape, sd, dtype=torch.float64) if self.per_recording else None

    def warnings_beside(self, found: FitResult) -> tuple[str, ...]:
        """Those about the data, and on a wide smoothed sign if the residual exceeds the noise."""
        above = not self.mistakes and not self.leaves_noise(found)
        return self.data_warnings + self.smoothed * above

    def leaves_noise(self, found: FitResult) -> bool:
        """True if no more than noise is left, as far as it is known."""
        return found.residual <= self.options.model_error_ratio * (found.noise or math.inf)

    def drift_explained(self, found: FitResult) -> bool:
        """True if friction changes with time by heat, or by inputs that leave only noise."""
        by = [name for name in INPUTS if has_input(found.model.law, name)]
        return "heat" in by or (bool(by) and self.leaves_noise(found))


def prepare_task(
    model: FrictionModel | str,
    plant: Plant | str | Path,
    recordings: RecordingLike | Iterable[RecordingLike],
    options: FitOptions,
    start: FitResult | None = None,
    motions: Sequence[Motion] | None = None,
    callback: Callback | None = None,
) -> FitTask:
    """Check and convert the arguments of a fit; see `fit`."""
    plant = rigs.of(plant)
    if not isinstance(start, FitResult | None):
        raise TypeError(f"`start` must be the result of a fit, got a {type(start).__name__}.")
    # Checked before much time is spent on recordings.
    by_name, model = isinstance(model, str), inputs.as_model(model, plant.joints)
    inputs.require_doubles(model, plant)
    inputs.require_elementwise(model.law, model.joints)
    given_position = has_input(model.law, "position") and not getattr(model, "selected", False)
    if plant.has_position_load and not given_position:
        plant = plant.replace(load_waves=0.0 * plant.load_waves)  # of an earlier fit
    given = inputs.as_recording_list(recordings, plant)
    inputs.require_parts(given, 2 * options.edge)
    given = given if motions else inputs.released(given)
    joint = inputs.in_joint_coordinates(plant, given, model.joints)
    moved = inputs.smoothed_motions(joint, motions)
    floor, wanted = inputs.turning_velocity(plant, joint, moved)
    if by_name:
        model.v_smooth = floor
    blurred = model.v_smooth == floor > wanted and _has_sign(model.law)
    if "p_0" in model.law.names:
        raise ValueError(
            f"the law {model.law.name!r} is for tables of torque, see `fit_torque`; to motions fit "
            "maxwell-slip."
        )
    inputs.require_drive(model.law, joint)
    if options.eccentricity == "on" and not isinstance(plant, PendulumChain):
        raise ValueError(f"{plant.name or 'the axis'} has no encoders that turn with its joints.")
    guessed = (
        options.encoder_reference == "auto"
        # Torques depend too little on a constant offset of the encoders to estimate one.
        and options.method == "output_error"
        and inputs.looks_zeroed_per_recording(plant, given, options)
    )
    per_recording = guessed or options.encoder_reference == "per_recording"
    convention = given[0].resolve_convention(plant)
    delay = 0.0
    if options.fit_delay:
        if not inputs.largest_torques(joint).any():
            raise ValueError("`fit_delay=True` needs recordings with torques, got none.")
        # A search by simulation finds the delay only from a start within a cycle of the motion.
        samples = collect(Source(joint, moved, options))
        delay, share = balanced_delay(plant, samples)
        # Vibrations, or a wrong law, have valleys at other delays that are hardly lower.
        if not options.diagnosis_tie * share < unexplained_share(plant, samples):
            delay = 0.0
    advanced = inputs.advanced_torques(joint, delay)
    # With the delay removed, so that it is not reported again as a mistake.
    diagnosed = partial(
        likely_mistakes, recordings=advanced, motions=moved, convention=convention,
        options=options, zeroed=per_recording, presliding=bool(model.law.memory),
    )  # fmt: skip
    stated, mistakes = diagnosed(plant)
    first, corrected, doubted = next(iter(mistakes), None), tuple[str, ...](), tuple[str, ...]()
    # Without torques only the ratios of its terms matter, and no drive can be the cause.
    free = options.fit_plant and not inputs.largest_torques(joint).any()
    if free and first is not None and first.rig is not None:
        corrected, plant = (correction_note(stated, first),), first.rig
        doubted = (first.text,) if first.timed else ()
        start = start and start.with_terms_times({n: 1.0 / x for n, x in first.ratios.items()})
        stated, mistakes = diagnosed(plant)
    named = mistake_warning(stated, mistakes) + corrected
    for sentence in named:
        # A fit to such data may take minutes, and would report this only at its end.
        logging.getLogger(__name__).warning(sentence)
    of = plant, advanced, moved, options
    unmodelled = [*inputs.lasting_jumps(given, options)]
    drift: list[str] = []
    # Errors of the data would look like changes.
    if not (mistakes or unmodelled):
        for changed, sentence in changing_friction(*of):
            (drift if changed == "friction" else unmodelled).append(sentence)
        unmodelled += loose_loads(*of)
    found = (
        *named,
        *drift,
        *unmodelled,
        *((inputs.ZEROED_PER_RECORDING,) if guessed else ()),
        *inputs.data_warnings(plant, given, joint, moved, options),
    )
    measurement = inputs.measurement_matrix(plant, convention)
    return FitTask(
        model, plant, joint, measurement, moved, options, start, callback, per_recording, delay,
        found, doubted + tuple(m.text for m in mistakes), tuple(drift),
        (() if doubted else corrected) + tuple(unmodelled),
        (inputs.SMOOTHED.format(floor, wanted, plant.unit),) * blurred,
        first.ratios if first is not None and corrected else {},
    )  # fmt: skip


def _has_sign(law: Law) -> bool:
    """True if the friction is smoothed around zero velocity."""
    coefficients = torch.arange(1.0, 1 + len(law.names), dtype=torch.float64)[None]
    slow, load = (x * torch.ones(1, dtype=torch.float64) for x in (0.1, 1.0))
    steep, smooth = (law.torque(slow, load, coefficients, v_smooth) for v_smooth in (1.0, 2.0))
    return not torch.equal(steep, smooth)


def regression(task: FitTask, model: FrictionModel, plant: Plant, beyond: float = 0.0) -> TorqueFit:
    """Constant coefficients implied by the torques on a plant; see `fit_equation_error`."""
    model.check_loads(plant)
    recordings = inputs.advanced_torques(task.recordings, task.delay)
    law = steady_law(model.law)
    # Of a law with memory, more coefficients are kept here than in the fit.
    fitted = torch.tensor([c.fitted for c in model.law.coefficients])
    initial, own = Constant(law, model.joints).values, model.schedule.coefficient_sets()
    known = torch.where(fitted, initial, own.get("always", initial)).detach()
    return fit_equation_error(
        law, plant, recordings, task.motions, model.v_smooth, task.options, beyond, known
    )


def constant_prior(
    model: FrictionModel, torque: TorqueFit, options: FitOptions
) -> tuple[Tensor, Tensor]:
    """Mean and standard deviation of a law's constant coefficients, each (parameter,)."""
    sd = prior_sd(model.law, torque, options).reshape(-1)
    return torch.zeros_like(sd), sd


def known_terms(
    start: FitResult | None, terms: Sequence[PlantParameter], delay: float = 0.0
) -> Tensor:
    """Plant terms of an earlier fit by name, (term,); 0 if missing, except the delay."""
    known = {TORQUE_DELAY: delay}
    if start is not None:
        known |= {name: value for name, value, _ in start.plant_terms}
    return torch.tensor([known.get(t.name, 0.0) for t in terms], dtype=torch.float64)


def terms_after(task: FitTask, at: FitResult, law: Law, plant: Plant) -> list[PlantParameter]:
    """Terms of a plant that a search adjusts further after a fit, see `adjustable_terms`."""
    return inputs.adjustable_terms(
        plant, law, task.recordings, task.options,
        eccentric=fits_eccentricity(task.options, at), per_recording=bool(at.encoder_offsets),
    )  # fmt: skip


def fits_eccentricity(options: FitOptions, start: FitResult | None) -> bool:
    """True if a search has encoder terms: `"on"`, or `"auto"` after a fit that has them."""
    terms = start.plant_terms if start else ()
    found = any(name.startswith("encoder ") for name, _, _ in terms)
    return options.eccentricity == "on" or (options.eccentricity == "auto" and found)

"""Typical mistakes in recordings and rigs, found from the balance of torques.

A mistake leaves torque that no friction explains. Each hypothesis corrects one mistake; the balance
shows which correction explains the motion. Each takes one pass of inverse dynamics, no simulation.
"""

import math
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from itertools import pairwise, product
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray
from torch import Tensor

from nfriction.fitting.adjusted_plant import PlantParameter, adjusted_buffers, adjusted_plant
from nfriction.fitting.data.inputs import names_of, weighs
from nfriction.fitting.options import DEFAULTS, FitOptions
from nfriction.fitting.plant_parameters import plant_parameters
from nfriction.fitting.result.identifiability import NORMAL_95
from nfriction.fitting.result.paired_test import improves, jackknife_sd, student_quantile
from nfriction.friction.models import FrictionModel
from nfriction.plant import LinearAxis, PendulumChain, Plant
from nfriction.recording import Recording
from nfriction.recording.angles import AngleConvention, Angles, MeasuredFrom
from nfriction.recording.validation import MINIMUM_SAMPLES, gaps, time_unit, turns_between_samples
from nfriction.signals import Motion, count_seen

Array = NDArray[np.float64]

# Samples in a block from which a curvature is visible despite their noise.
FEWEST_FOR_CURVATURE = 5
# With fewer blocks, one of the corrections would explain most of the torque by chance.
FEWEST_BLOCKS = 20
# Steps that are alike differ by less than this part; noise and counts must be smaller, too.
ALIKE = 0.1
# Logarithms of the ratios between which gears of robots lie.
LOG_RATIOS = math.log(1.5), math.log(300.0)
# Cogging repeats with the least common multiple of slots and poles, at most about this.
MOST_PER_TURN = 300
# Heavier loads, in masses of the links, are mistakes in a unit.
MOST_PAYLOAD = 100.0
# Linear solutions for terms that multiply each other; their error is squared each time.
SOLUTIONS = 5
# Ridge of a balance, relative to the length of its columns: far above round-off, below any noise.
RIDGE = 1e-8
# Speeds between which a friction torque is linear.
SPEED_KNOTS = 5


# Other units of inertia than kg m^2, as CAD programs and data sheets give them.
UNITS_OF_INERTIA = {"g m^2": 1e-3, "kg cm^2": 1e-4, "kg mm^2": 1e-6, "g cm^2": 1e-7, "g mm^2": 1e-9}


@dataclass(frozen=True)
class Mistake:
    """A mistake that would explain why no friction fits."""

    text: str  # a clause such as "the sign of joint2's position is reversed"
    unexplained: float  # share of the torque after the correction [-]; NaN if none is known
    rig: Plant | None = None  # corrected in several terms at once
    ratios: Mapping[str, float] = field(default_factory=dict)  # of those terms to the given ones
    timed: bool = False  # a wrong sample rate would explain the same


class _Correction(NamedTuple):
    """A correction of one mistake, and the share of the torque that it leaves unexplained [-]."""

    text: str
    share: float
    case: "tuple[Plant, _Data] | None" = None  # corrected; None if more than these change


@dataclass(frozen=True)
class _Data:
    """Samples in joint coordinates, (sample, joint) each, in blocks of equal length.

    `sd` is that of the smoothed accelerations [rad/s²] and `sd_of_mean` that of their block means,
    zero if they are unknown. `turns` is 1 where a joint's velocity exceeds its noise, else 0.
    `time` counts from the start of a recording [s], (sample, 1), and `number` the recordings.
    """

    q: Tensor
    qd: Tensor
    qdd: Tensor
    sd: Tensor
    sd_of_mean: Tensor
    turns: Tensor
    tau: Tensor
    time: Tensor
    number: Tensor
    block: int

    def mean(self, values: Tensor) -> Tensor:
        """Means over blocks, (block, ...)."""
        return values.reshape(-1, self.block, *values.shape[1:]).mean(1)

    def at_rate(self, factor: float) -> "_Data":
        """The same positions at a sample rate that is larger by this factor."""
        return replace(self, qd=self.qd * factor, qdd=self.qdd * factor**2)

    def needed(self, plant: Plant) -> Tensor:
        """Torque of the motion without friction, (sample, joint)."""
        return plant.inverse_dynamics(self.q, self.qd, self.qdd)

    @cached_property
    def driven(self) -> list[int]:
        """Joints with a torque."""
        return np.flatnonzero(self.tau.any(0)).tolist()

    @cached_property
    def moving(self) -> Tensor:
        """1 where a joint turns in one direction throughout a block, else 0, (block, joint).

        Dry friction can have any value at rest, so the balance shows nothing there.
        """
        return (self.mean(self.turns * torch.sign(self.qd)).abs() == 1).to(self.qd)

    @cached_property
    def friction(self) -> Tensor:
        """Dry and viscous friction of each joint, (block, joint, column)."""
        shapes = torch.sign(self.qd), self.qd
        return torch.cat([torch.diag_embed(self.moving * self.mean(x)) for x in shapes], -1)


def likely_mistakes(
    plant: Plant,
    recordings: Sequence[Recording],
    motions: Sequence[Motion],
    convention: AngleConvention,
    options: FitOptions = DEFAULTS,
    *,
    zeroed: bool = False,
    presliding: bool = False,
) -> tuple[float, tuple[Mistake, ...]]:
    """Share of unexplained torque as recorded, and mistakes whose correction reduces it greatly.

    These are the mistakes that the data support, best first: several if the data do not distinguish
    them, none if no correction divides the share [-] by `diagnosis_ratio`, or if the share is at
    most this times that of the noise.

    Args:
        recordings: in joint coordinates.
        motions: of the recordings, smoothed.
        convention: of the recorded angles.
        zeroed: encoders were set to zero at the start of each recording, in any pose.
        presliding: the law has the stiffness of a contact, so that no spring is missing.
    """
    given = _collect(recordings, motions, options)
    # These spoil the balance, and a fit absorbs some wrong times in the inertia.
    if broken := next(_broken(recordings, options), None):
        return math.nan, (broken,)
    if len(given.q) < FEWEST_BLOCKS * given.block:
        return math.nan, ()
    stated = _unexplained(plant, given)
    noise = _of_noise(plant, given, given.sd_of_mean)
    # Inertias or torques wrong by the square of a thousand would have the same effect.
    if unit := time_unit(recordings[0].time):
        short, _, rate = unit
        share = _unexplained(plant, given.at_rate(rate))
        if noise < stated and share < stated / options.diagnosis_ratio:
            return stated, (Mistake(f"time is in {short}", share),)
    if stops := [*_end_stops(plant, recordings, given, options)]:
        return stated, tuple(stops)
    # With different zeros, recordings of the same rig have different balances.
    unlike = [*_unlike_zeros(plant, recordings, given, options)] if len(recordings) > 1 else []
    found = [] if zeroed else [Mistake(*cause) for cause in unlike]
    if noise < stated:
        zeros = min((share for _, share in unlike), default=math.inf)
        found += _above_noise(
            plant, recordings, motions, convention, given, options, zeros, presliding
        )
    if not found and not given.tau.any():
        # With a slightly wrong rig, the energy would seem to rise.
        rig = _with_usual_errors(plant, given, options)
        found = [*_driven_without_torque(rig, recordings, motions, options)]
    # Nearly equal shares: the data do not distinguish these corrections; simple ones come first.
    least = min((mistake.unexplained for mistake in found), default=math.nan)
    # A share that is unknown, NaN, is never larger.
    sure = [m for m in found if not m.unexplained >= options.diagnosis_tie * least]
    return stated, tuple(sure[:3])


def _above_noise(
    plant: Plant,
    recordings: Sequence[Recording],
    motions: Sequence[Motion],
    convention: AngleConvention,
    given: _Data,
    options: FitOptions,
    zeros: float,
    presliding: bool,
) -> list[Mistake]:
    """Corrections that divide the unexplained torque by `diagnosis_ratio`, the simpler ones first.

    `zeros` is the share that different encoder zeros of the recordings leave.
    """
    stated = sound = _unexplained(plant, given)
    noise = options.diagnosis_ratio * _of_noise(plant, given, given.sd_of_mean)
    delay = 0.0, sound
    if given.tau.any():
        delay = balanced_delay(plant, recordings, motions, options)
        # A torque that is held until the next sample acts up to one step late.
        if -max(r.sample_time for r in recordings) <= delay[0] <= 0:
            sound = min(delay[1], sound)
    tested = [*_tested(plant, recordings, motions, convention, given, options, delay, stated)]
    for term, x, rig in _scaled_terms(plant, given, options):
        share = _unexplained(rig, given)
        if term.lower <= x <= term.upper:
            sound = min(share, sound)  # The fit corrects this by itself.
        else:
            text = f"{term.name} is {1 + x:.3g} times that of the rig"
            if plant.joints == 1 and term.name.startswith("inertia"):
                rate = math.sqrt(_inertia(rig) / _inertia(plant))
                text += f", or the true sample rate is {rate:.3g} times that in `time`"
            # Without a drive, a guessed inertia is likelier than a missing rotor.
            place = len(tested) if given.driven else 0
            tested.insert(place, _Correction(text, share, (rig, given)))
    if sound <= noise:
        return []
    if len(recordings) > 1:
        most = min(sound, zeros) / options.diagnosis_ratio
        odd = _odd_one_out(plant, recordings, motions, convention, most, options)
        tested += (_Correction(*x) for x in odd)
    most = sound / options.diagnosis_ratio
    # Near one position a spring is like gravity, and a ratio like a unit.
    least = _least_with_usual_errors(tested, plant, most, options)
    several = [*_several_terms(plant, given, options)]
    springs = () if presliding else _springs(plant, given)
    rare = [*springs, *_unbalanced(plant, given), *_geared(plant, convention, given)]
    rare += _unlike_gains(plant, given, options) if len(given.driven) > 1 else ()
    rare += [_wrong_rate(plant, given), *((each.text, each.unexplained) for each in several)]
    if options.diagnosis_ratio * _of_noise(plant, given, given.sd) < stated:
        rare += _cogging(plant, given)
    tested += [_Correction(*x) for x in rare if options.diagnosis_tie * x[1] < least]
    rigs = {mistake.text: mistake for mistake in several}
    found = [rigs.get(x.text) or Mistake(x.text, x.share) for x in tested if x.share < most]
    if not found and given.driven:
        found = [*_delay_beside_usual_errors(plant, recordings, motions, given, options)]
    if not found and not given.tau.any() and isinstance(plant, PendulumChain | LinearAxis):
        # A rig that is wrong in several terms hides a wrong convention.
        both = [
            Mistake(f"{text}, and {terms.text}", terms.unexplained)
            for text, data in _corrected_positions(plant, convention, given)
            if "`convention`" in text
            for terms in _several_terms(plant, data, options)
        ]
        best = min(both, key=lambda mistake: mistake.unexplained, default=Mistake("", math.inf))
        found = [best] if best.unexplained < most else []
    return found


def mistake_warning(stated: float, mistakes: Sequence[Mistake]) -> tuple[str, ...]:
    """The mistakes in a sentence."""
    if not mistakes:
        return ()
    causes = ", or ".join(mistake.text for mistake in mistakes)
    return (f"A mistake in data or rig is likely: {causes}.{_shares(stated, mistakes[0])}",)


def correction_note(stated: float, mistake: Mistake) -> str:
    """A mistake in the rig that a fit corrects, in a sentence."""
    text = f"{mistake.text[0].upper()}{mistake.text[1:]}.{_shares(stated, mistake)}"
    return f"{text} The fit starts from the corrected rig; terms are relative to the rig as given."


def _shares(stated: float, mistake: Mistake) -> str:
    """A sentence on the torque unexplained before and after a correction; empty if unknown."""
    if math.isnan(mistake.unexplained):
        return ""
    after = f"after the correction {mistake.unexplained:.2g}"
    return f" Friction leaves {stated:.2g} of the torque unexplained, {after}."


def unlike_training(
    plant: Plant,
    friction: FrictionModel,
    train: Iterable[tuple[Recording, Motion]],
    test: Iterable[tuple[Recording, Motion]],
    options: FitOptions = DEFAULTS,
) -> Iterator[tuple[str, Mistake]]:
    """Names of test recordings that differ from those of training, each with the cause.

    With the fitted plant and friction, `diagnosis_ratio` times more torque must be unexplained than
    in training and than noise explains, and less after the correction. Recordings are in joint
    coordinates, with their smoothed motions; friction depends on the current motion alone.
    """
    shares, ratio, trained = [], options.diagnosis_ratio, [*train]
    for k, (recording, motion) in enumerate([*trained, *test]):
        data = _collect([recording], [motion], options)
        if len(data.q) < FEWEST_BLOCKS * data.block:
            continue
        coefficients = friction.coefficients(data.qd, data.qdd)
        tau_f = friction.torque(data.qd, plant.load(data.q, data.qd), coefficients)
        left = data.moving * data.mean(data.tau - data.needed(plant) - tau_f)
        share = _share(plant, data, left.square().mean(0))
        if k < len(trained):
            shares.append(share)
        elif shares and math.inf > share > ratio * (usual := max(shares)):
            most = ratio * max(usual, _of_noise(plant, data, data.sd_of_mean))
            causes = _causes(plant, data, tau_f, left, options)
            rest, text = min(causes, default=(math.inf, ""))
            if rest < most < share:
                said = f"It differs from the training recordings: {text}. The model leaves "
                said += f"{share:.2g} of its torque unexplained, after the correction {rest:.2g}, "
                yield recording.name, Mistake(f"{said}and {usual:.2g} of theirs.", rest)


def _causes(
    plant: Plant, data: _Data, tau_f: Tensor, left: Tensor, options: FitOptions
) -> list[tuple[float, str]]:
    """Unexplained share [-] with other friction, torque or encoder zeros, and the change."""
    kind, unit = ("force", "N") if plant.unit == "m" else ("torque", "N m")
    zero = ", or its encoder has another zero" * weighs(plant)
    own, tau = (data.moving * data.mean(x) for x in (tau_f, data.tau))
    names, drives, grown, rest = plant.joint_names, data.driven, [], left.clone()
    found: list[tuple[float, str]] = []

    def fitted(j: int, shapes: Tensor) -> tuple[Tensor, float]:
        part, rest = shapes @ (torch.linalg.pinv(shapes) @ left[:, j]), left.clone()
        rest[:, j] -= part
        return part, _share(plant, data, rest.square().mean(0))

    def relative(part: Tensor, whole: Tensor) -> float:
        return float(part @ whole) / float(whole @ whole or math.inf)

    for j, name in enumerate(names):
        part, share = fitted(j, data.friction[:, j])
        times = 1 + relative(part, own[:, j])
        # A wrong sign has causes of its own.
        if times > 0:
            found.append((share, f"the friction of {name} is {times:.3g} times theirs"))
            rest[:, j] -= part
            grown.append(f"of {name} is {times:.3g} times")
        if j in drives:
            part, share = fitted(j, tau[:, [j]])
            true = 1 - relative(part, tau[:, j])
            if true > 0:
                found.append((share, f"the {kind} of {name} is {1 / true:.3g} times theirs"))
            part, share = fitted(j, data.moving[:, [j]])
            size = relative(part, data.moving[:, j])
            text = f"the {kind} of {name} has an offset of {size:.3g} {unit}{zero}"
            found.append((share, text))
    # The torque of a drive shows an offset, too.
    zeros, _ = _torques_of_terms(plant, data, options) if not drives else ([], [])
    first = len(names) - len(zeros)
    for name, slope in zip(names[first:], zeros, strict=True):
        part = data.moving * data.mean(slope)
        size = relative(left.flatten(), part.flatten())
        share = _share(plant, data, (left - size * part).square().mean(0))
        off = abs(math.degrees(size))
        found.append((share, f"the encoder of {name} has another zero, {off:.2g} degrees off"))
    share = _share(plant, data, rest.square().mean(0))
    # A change of several joints explains most, so it has to explain clearly more.
    if len(grown) == len(names) > 1 and options.diagnosis_tie * share < min(found)[0]:
        found.append((share, f"the friction {' and '.join(grown)} theirs"))
    return found


def _broken(recordings: Sequence[Recording], options: FitOptions) -> Iterator[Mistake]:
    """Wrapped angles, counters that overflow, and rows lost, repeated or stale under even times.

    Between steps that are all alike, a step of twice their length lacks a row, one of zero repeats
    a row, and one of zero before one of twice their length repeats a position: no joint moves so.
    """
    for recording in recordings:
        name = recording.name or "a recording"
        wrapped = turns_between_samples(recording.q, gaps(recording.time)).any()
        if wrapped and recording.unit == "rad":
            text = f"positions of {name} are wrapped (unwrap them, as `numpy.unwrap(q, axis=0)`)"
            yield Mistake(text, math.nan)
        # The motion goes on in one direction, and the position jumps back by most of its range.
        step = np.diff(recording.q, axis=0)
        step[gaps(recording.time)] = 0.0
        before, at, after = step[:-2], step[1:-1], step[2:]
        far = np.fmax(np.ptp(recording.q, axis=0) / 2, 2 * (np.abs(before) + np.abs(after)))
        far = np.fmax(far, options.spike_ratio * np.median(np.abs(step), axis=0))
        back = (at * before < 0) & (at * after < 0) & (np.abs(at) > far)
        for joint, jump in zip(recording.names, (back * np.abs(at)).max(0), strict=True):
            if jump:
                text = (
                    f"a counter overflows: {joint} of {name} jumps by {jump:.3g} {recording.unit}"
                )
                remedy = "unwrap its column, as `numpy.unwrap(counts, period=65536)`"
                yield Mistake(f"{text} ({remedy})", math.nan)
        q, time = (sliding_window_view(x, 6, axis=0) for x in (recording.q, recording.time))
        steps = np.diff(q)
        noise = np.median(np.abs(np.diff(recording.q, n=2, axis=0)), axis=0)
        noise = np.fmax(noise, count_seen(recording.q))
        even = np.ptp(np.diff(time), axis=-1) < ALIKE * recording.sample_time
        for factors, rows, remedy in (
            ([2], "are missing", "use the logger's own time stamps"),
            ([0], "are repeated", "drop repeated rows before rows are given their times"),
            ([0, 2], "repeat the position before", "drop these rows, with their times"),
        ):
            broken = slice(2, 2 + len(factors))
            others = np.delete(steps, broken, -1)
            mean, apart = others.mean(-1), np.ptp(others, axis=-1)
            size = np.abs(mean)
            seen = (size * ALIKE > noise) & (apart < ALIKE * size) & even[:, None]
            # A row is lost for all joints. Noise causes half of this error more often.
            found, half = (
                int((seen.any(1) & ((error < ALIKE * size) | ~seen).all(1)).sum())
                for error in (
                    np.abs(steps[..., broken] - mean[..., None] * x).max(-1)
                    for x in (np.array(factors), (1 + np.array(factors)) / 2)
                )
            )
            share = found / max(1, int(seen.any(1).sum()))
            if found >= max(MINIMUM_SAMPLES, half) and share > options.clock_error[0]:
                of = f"about {100 * share:.2g} % of the rows of {name} {rows}"
                yield Mistake(f"{of}, although `time` goes on evenly ({remedy})", math.nan)


def _driven_without_torque(
    plant: Plant,
    recordings: Sequence[Recording],
    motions: Sequence[Motion],
    options: FitOptions,
) -> Iterator[Mistake]:
    """The first recording whose energy rises by more than an error of the rig could explain."""
    if not isinstance(plant, PendulumChain | LinearAxis):
        return
    for recording, motion in zip(recordings, motions, strict=True):
        # At rest, or held: only rounding moves.
        if not np.ptp(recording.q, axis=0).all():
            continue
        kinetic, potential = plant.energy(torch.tensor(motion.q), torch.tensor(motion.qd))
        energy = (kinetic + potential).numpy()
        rise = energy - np.minimum.accumulate(energy)
        if rise.max() > options.energy_rise * float(kinetic.max()):
            text = (
                f"{recording.name or 'a recording'} has no torque, but its motion gains energy up "
                f"to {motion.time[rise.argmax()]:.3g} s; name the columns of the torque, cut off "
                "the part in which it is driven, or correct masses, centres of mass and lengths"
            )
            yield Mistake(text, math.nan)
            return


def _tested(
    plant: Plant,
    recordings: Sequence[Recording],
    motions: Sequence[Motion],
    convention: AngleConvention,
    given: _Data,
    options: FitOptions,
    delay: tuple[float, float],
    stated: float,
) -> Iterator[_Correction]:
    for text, data in _corrected_positions(plant, convention, given):
        yield _corrected(text, plant, data)
    for text, rig in _corrected_rigs(plant, bool(given.tau.any())):
        yield _corrected(text, rig, given)
    if given.tau.any():
        for text, data in _corrected_torques(plant, given, options):
            yield _corrected(text, plant, data)
        yield _Correction(delay_in_words(delay[0]), delay[1])
        yield _Correction(*_drifting_clock(plant, recordings, motions, options))
        for text, data in (*_saturated(plant, given), *_switched_off(plant, recordings, given)):
            yield _corrected(text, plant, data)
        # Narrow-band noise of the smoothed accelerations has a resonance of its own.
        if options.diagnosis_ratio * _of_noise(plant, given, given.sd) < stated:
            for text, share in _elastic(plant, given, recordings[0].sample_time):
                yield _Correction(text, share)
    for text, rig in (*_missing_rotors(plant, given, options), *_payloads(plant, given, options)):
        yield _corrected(text, rig, given)


def _inertia(plant: Plant) -> float:
    """Inertia of a single joint with that of its rotor [kg m^2; kg]."""
    rest = torch.zeros(1, plant.joints, dtype=torch.float64)
    accelerated, held = (plant.inverse_dynamics(rest, rest, rest + k) for k in (1.0, 0.0))
    return float((accelerated - held)[0, -1])


def _corrected(text: str, rig: Plant, data: _Data) -> _Correction:
    return _Correction(text, _unexplained(rig, data), (rig, data))


def _least_with_usual_errors(
    tested: Sequence[_Correction], plant: Plant, most: float, options: FitOptions
) -> float:
    """Smallest share that a correction leaves if the rig also has usual errors of a drawing.

    Rare mistakes have to explain more than this, because their factors absorb such errors. Only the
    best corrections of the data and of the rig count, as the errors make all of them alike.
    """
    shares = [math.inf, *(x.share for x in tested)]
    cases = [(x.share, *x.case) for x in tested if x.case]
    for share, rig, data in cases:
        peers = [other for other, of, _ in cases if (of is plant) == (rig is plant)]
        if share < most and share <= options.diagnosis_tie * min(peers):
            torque = data.tau - data.needed(rig)
            left, _ = _balance(data, torque, *_usual_errors(rig, data, options))
            shares.append(_share(rig, data, left))
    return min(shares)


def _odd_one_out(
    plant: Plant,
    recordings: Sequence[Recording],
    motions: Sequence[Motion],
    convention: AngleConvention,
    most: float,
    options: FitOptions,
) -> Iterator[tuple[str, float]]:
    """The recording that friction of its own explains worst, if the others leave at most this.

    Friction may change between recordings, and lively motion leaves more: this one is odd only if
    a correction explains it, or inertia, gravity and zeros of its own with the friction of all.
    """
    few = replace(options, diagnosis_samples=max(1, options.diagnosis_samples // len(recordings)))
    pairs = zip(recordings, motions, strict=True)
    alone = [_unexplained(plant, _collect([r], [m], few)) for r, m in pairs]
    odd = int(np.argmax(np.nan_to_num(alone, nan=-1.0)))
    name = names_of(recordings)[odd]
    order = sorted(range(len(alone)), key=lambda k: k != odd)
    recordings, motions = [recordings[k] for k in order], [motions[k] for k in order]
    share = _unexplained(plant, _collect(recordings[1:], motions[1:], options))
    if share >= most:
        return
    _, causes = likely_mistakes(plant, recordings[:1], motions[:1], convention, few)
    data = _collect(recordings, motions, options)
    zeros, terms = _torques_of_terms(plant, data, options)
    rig = [(data.number == 0) * part for part in zeros + terms]
    if causes or (rig and _unexplained(plant, data, torch.stack(rig, -1)) < most):
        text = f"{name} is from another rig than the others, or was recorded differently"
        yield text + f" ({', or '.join(x.text for x in causes)})" * bool(causes), share


def _torques_of_terms(
    plant: Plant, data: _Data, options: FitOptions
) -> tuple[list[Tensor], list[Tensor]]:
    """Torque per unit of each encoder zero, and of each term of inertia and gravity."""
    needed = data.needed(plant)
    found: tuple[list[Tensor], list[Tensor]] = ([], [])
    for term in _drawn_terms(plant, data, options):
        changed = adjusted_buffers(plant, [term], needed.new_tensor([1e-3]))
        found[term.ratio].append((data.needed(plant.replace(**changed)) - needed) / 1e-3)
    return found


def _drawn_terms(plant: Plant, data: _Data, options: FitOptions) -> list[PlantParameter]:
    """The terms that a drawing gives: encoder zeros, then those of inertia and gravity."""
    terms = plant_parameters(plant, driven=data.driven, options=options)
    # Terms without a spread are exact.
    terms = [term for term in terms if term.prior_sd > 0]
    zeros = [term for term in terms if term.name.startswith("angle offset")]
    return [*zeros, *(term for term in terms if term.ratio)]


def _unlike_zeros(
    plant: Plant, recordings: Sequence[Recording], data: _Data, options: FitOptions
) -> Iterator[tuple[str, float]]:
    """Joints whose encoder zero differs between recordings, and the share left with own zeros.

    The difference must exceed the usual error of a zero, because a wrong law causes small ones, and
    the scatter of its estimates with each piece of the data left out.
    """
    pieces, blocks = options.drift_pieces * len(recordings), len(data.q) // data.block
    zeros, rig = _torques_of_terms(plant, data, options)
    if not zeros or blocks < 2 * pieces:
        return
    own = [(data.number == k) * part for part in zeros for k in range(len(recordings))]
    left, design, _ = _equations(data, data.tau - data.needed(plant), torch.stack(own + rig, -1))
    scale = design.square().mean((0, 1)).sqrt()
    if not scale.isfinite().all():
        return
    # A joint at rest shows no zero.
    shown = (scale[: len(own)] > 0).reshape(len(zeros), -1)
    scale = scale.clamp_min(torch.finfo(scale.dtype).tiny)
    piece, found = torch.arange(blocks) * pieces // blocks, []
    for rows in (piece != k for k in range(-1, pieces)):
        terms, known = (design[rows] / scale).flatten(0, 1), left[rows].reshape(-1, 1)
        least = torch.linalg.lstsq(terms, known, rcond=1e-9, driver="gelsd")
        found.append((least.solution[:, 0] / scale)[: len(own)].reshape(len(zeros), -1))
    sure, said = student_quantile(pieces - 1, 1 - options.drift_chance / 2), []
    names = names_of(recordings)
    if len({*names}) < len(names):
        names = [f"recording {k + 1}" for k in range(len(names))]
    for j, seen in enumerate(shown):
        places = seen.nonzero().flatten()
        order = places[found[0][j, places].argsort()].tolist()
        change, *others = (float(x[j, order[-1]] - x[j, order[0]]) if order else 0.0 for x in found)
        if change - sure * jackknife_sd(others) > options.angle_term[1]:
            joint = plant.joint_names[plant.joints - len(zeros) + j]
            pair = " and ".join(names[k] for k in sorted({order[0], order[-1]}))
            said.append(f"{joint} by {math.degrees(change):.2g} degrees between {pair}")
    if said:
        remedy = '`method="output_error"`, ' * (options.method == "equation_error")
        remedy += '`encoder_reference="per_recording"`'
        text = f"encoder zeros differ: {', '.join(said)} ({remedy})"
        share = _unexplained(plant, data, torch.stack(own, -1))
        drives = torch.diag_embed(data.tau.any(0) * torch.ones_like(data.tau))
        offsets = [(data.number == k)[..., None] * drives for k in range(len(recordings))]
        # A torque that is constant near one position.
        if _unexplained(plant, data, torch.cat(offsets, -1)) < options.diagnosis_tie * share:
            text += ", or the offset of a drive or torque sensor changed between recordings"
        yield text, share


def _collect(
    recordings: Sequence[Recording],
    motions: Sequence[Motion],
    options: FitOptions,
    delay: float = 0.0,
    drift: float = 0.0,
) -> _Data:
    """Samples away from the ends, with the torque that was recorded `delay` [s] later.

    The delay grows by `drift` with time [-].
    """
    # Both sides of the balance are averaged in the same way, which removes noise of accelerations.
    block = max(1, round(options.diagnosis_block / recordings[0].sample_time))
    # Blocks are dropped evenly if there are more samples than needed; at a high rate a block has
    # many.
    most = max(options.diagnosis_samples, 10 * FEWEST_BLOCKS * block)
    stride = block * math.ceil(sum(map(len, recordings)) / most)
    parts: list[tuple[Array, ...]] = []
    # The longest delay is cut off both ends of a recording, so that every delay has the same data.
    for k, (recording, motion) in enumerate(zip(recordings, motions, strict=True)):
        stamps, margin = motion.time, options.edge + options.largest_delay
        inside = np.flatnonzero((stamps >= stamps[0] + margin) & (stamps <= stamps[-1] - margin))
        starts = np.arange(0, max(0, len(inside) - block + 1), stride)
        at = inside[(starts[:, None] + np.arange(block)).ravel()]
        since = stamps[at] - stamps[0]
        torque = recording.torque_at(stamps[at] + delay + drift * since)
        of = since[:, None], np.full((len(at), 1), k)
        noise = noise_of_mean = 0 * torque
        turning = np.ones_like(torque)
        if motion.std is not None:
            noise = motion.std.qdd[at]
            # A mean acceleration is a difference of velocities, too.
            over = max(1, block - 1) * recording.sample_time
            noise_of_mean = np.minimum(noise, math.sqrt(2) / over * motion.std.qd[at])
            turning[np.abs(motion.qd[at]) <= NORMAL_95 * motion.std.qd[at]] = 0.0
        moved = motion.q[at], motion.qd[at], motion.qdd[at]
        parts.append((*moved, noise, noise_of_mean, turning, torque, *of))
    found = (torch.as_tensor(np.concatenate(x)) for x in zip(*parts, strict=True))
    q, qd, qdd, sd, sd_of_mean, turns, tau, time, number = found
    return _Data(q, qd, qdd, sd, sd_of_mean, turns, tau, time, number, block)


def _corrected_positions(
    plant: Plant, convention: AngleConvention, given: _Data
) -> Iterator[tuple[str, _Data]]:
    names, first, joints = plant.joint_names, plant.first_link, plant.joints
    chain = isinstance(plant, PendulumChain)
    eye, none = np.eye(joints), np.zeros(joints)
    kind = "force" if plant.unit == "m" else "torque"

    def recorded(
        matrix: Array, offset: Array = none, reading: AngleConvention = convention
    ) -> _Data:
        """The data if recorded positions were `matrix @ q + offset` in the convention `reading`."""
        if not chain:
            turn = torch.as_tensor(matrix.T)
            return replace(given, q=given.q @ turn, qd=given.qd @ turn, qdd=given.qdd @ turn)
        q = convention.position_from_joint(given.q.numpy(), first) @ matrix.T + offset
        given_rates = given.qd.numpy(), given.qdd.numpy()
        rates = (convention.rate_from_joint(x, first) @ matrix.T for x in given_rates)
        qd, qdd = (torch.as_tensor(reading.rate_to_joint(x, first)) for x in rates)
        return replace(
            given, q=torch.as_tensor(reading.position_to_joint(q, first)), qd=qd, qdd=qdd
        )

    for j, name in enumerate(names):
        own = np.diag(eye[j])
        mirrored = recorded(eye - 2 * own)
        yield f"the sign of {name}'s position is reversed", mirrored
        if joints > 1 and j in given.driven:
            text = f"the signs of {name}'s position and {kind} are reversed"
            yield text, replace(mirrored, tau=given.tau * torch.as_tensor(1 - 2 * eye[j]))
        # The counts of an encoder's revolution, in quadrature or not.
        for factor in (0.25, 0.5, 2.0, 4.0):
            text = f"{name}'s position is {1 / factor:g} times too large (counts per revolution)"
            yield text, recorded(eye + (factor - 1) * own)
        # A half turn of the first link is a matter of the convention.
        turns = (-90, 90) if j == first else (-90, 90, 180)
        for degrees in turns if chain and j >= first else ():
            text = f"{name}'s position is {-degrees if degrees < 180 else 180} degrees off"
            yield text, recorded(eye, math.radians(degrees) * eye[j])
    # On a driven rig this is equivalent to reversed torques, which are also listed.
    yield "the signs of all positions are reversed", recorded(-eye)
    for unit, factor in (("degrees", math.pi / 180), (f"m{plant.unit}", 1e-3)):
        yield f"positions are in {unit}", recorded(factor * eye)
    yield "time runs backwards: the motion gains energy", given.at_rate(-1.0)
    if chain:
        zero: MeasuredFrom = "hanging" if convention.measured_from == "upright" else "upright"
        other = AngleConvention(convention.angles, zero)
        text = f"angles are measured from {zero}, not from {convention.measured_from}"
        yield f"{text} (`convention`)", recorded(eye, reading=other)
    if chain and joints - first > 1:
        angles: Angles = "relative" if convention.angles == "absolute" else "absolute"
        other = AngleConvention(angles, convention.measured_from)
        # Motors turn their joints, so a convention cannot make their angles absolute.
        remedy = "`convention`" if plant.motor is None else "a belt drive? convert its columns"
        text = f"angles are {angles}, not {convention.angles} ({remedy})"
        yield text, recorded(eye, reading=other)
    # Columns of motors are exchanged before their gears.
    geared = plant.motor_factors
    turn, torque = (np.array(geared.get(key, [1.0] * joints)) for key in ("motor", "current"))
    for i in range(joints):
        for j in range(i + 1, joints):
            order = np.arange(joints)
            order[[i, j]] = j, i
            swapped = recorded(eye[order] * (turn / turn[order])[:, None])
            both = f"{names[i]} and {names[j]}"
            yield f"the positions of {both} are exchanged", swapped
            if given.tau.any():
                tau = given.tau[:, order] * torch.as_tensor(torque / torque[order])
                yield f"the torques of {both} are exchanged", replace(given, tau=tau)
                yield f"the columns of {both} are exchanged", replace(swapped, tau=tau)


def _corrected_rigs(plant: Plant, driven: bool) -> Iterator[tuple[str, Plant]]:
    data = plant.to_dict()
    if "buffers" in data:
        return  # they would override the corrected arguments
    motor = data.get("motor") or {}
    given = data | motor
    rotor, milli = "rotor_inertia" if motor else "armature", {"length": 1e-3, "com": 1e-3}
    mistakes: dict[str, dict[str, float]] = {}
    if driven:
        # The keys of a rotor differ.
        none = {"gravity": 1e-6} if "gravity" in given else {"mass": 0.0, "com": 0.0}
        remedy = "`gravity`: 1e-6" if "gravity" in given else "no `mass`"
        text = f"torques show no gravity: joints turn in a horizontal plane ({remedy}), or a"
        mistakes[f"{text} controller compensates it with torques that are not recorded"] = none
    # Of a horizontal rig, at most that of a small tilt.
    if 0 < (level := given.get("gravity", 0.0)) < 0.01:
        text = "the motion shows gravity: joints turn in a vertical plane (`gravity`: 9.81)"
        mistakes[text] = {"gravity": 9.81 / level}
    mistakes |= {
        "masses are in g": {"mass": 1e-3},
        "masses are in g, and inertias in g m^2": {"mass": 1e-3, "inertia": 1e-3},
        "lengths are in mm": milli,
        "lengths are in mm, and inertias in kg mm^2": {**milli, "inertia": 1e-6},
        "the rig is in g, mm and g mm^2": {**milli, "mass": 1e-3, "inertia": 1e-9},
    }
    for unit, factor in UNITS_OF_INERTIA.items():
        mistakes[f"inertias are in {unit}"] = {"inertia": factor}
        mistakes[f"each `{rotor}` is in {unit}"] = {rotor: factor}
        mistakes[f"inertias and each `{rotor}` are in {unit}"] = {"inertia": factor, rotor: factor}
    changes = {
        text: {k: np.array(given[k]) * f for k, f in factors.items() if given.get(k) is not None}
        for text, factors in mistakes.items()
    }
    inertia = np.array(data.get("inertia") or ())
    if inertia.ndim == 1 and len(inertia):
        central = inertia - np.array(data["mass"]) * np.array(data["com"]) ** 2
        changes["inertias are about the joints, not about the mass centres"] = {"inertia": central}
    tried: list[dict[str, Any]] = []
    for text, change in changes.items():
        parts = {key: values.tolist() for key, values in change.items()}
        # A rig without inertias has them in no wrong unit.
        if change and change.keys() <= given.keys() and parts not in tried:
            tried.append({**parts})
            if motor:
                parts["motor"] = motor | {k: parts.pop(k) for k in motor if k in parts}
            # Some would be no mechanism, or a strange one.
            with suppress(ValueError), warnings.catch_warnings():
                warnings.simplefilter("ignore")
                yield text, plant.from_dict({**data, **parts})


def _missing_rotors(plant: Plant, given: _Data, options: FitOptions) -> Iterator[tuple[str, Plant]]:
    own = dict(plant.named_buffers())
    for j, name in enumerate(plant.joint_names) if "armature" in own else ():
        unit = torch.zeros_like(own["armature"])
        unit[j] = 1.0
        x = _amount(plant, {"armature": unit}, given)
        if x > options.ratio_term[0] * float(own["armature"][j]):
            armature = own["armature"] + x * unit
            seen = f"of {float(armature[j]):.3g} kg m^2 seen at the joint"
            text = f"{name} has a rotor inertia {seen} (`armature`, or that of its `motor`)"
            yield text, plant.replace(armature=armature)


def _payloads(plant: Plant, given: _Data, options: FitOptions) -> Iterator[tuple[str, Plant]]:
    """Each link with a mass at its end, unless the fit corrects its effects by itself."""
    own, drawn = dict(plant.named_buffers()), plant.to_dict()
    gravity = drawn.get("gravity")
    if not (isinstance(plant, PendulumChain) and gravity) or plant.first_link:
        return
    for k, name in enumerate(plant.joint_names):
        reach = torch.where(torch.arange(plant.joints) <= k, plant.length, 0.0)
        unit = {"inertia_coupling": torch.outer(reach, reach), "gravity_moment": gravity * reach}
        mass, (bound, _) = _amount(plant, unit, given), options.ratio_term
        seen = any((mass * part > bound * own[key]).any() for key, part in unit.items())
        if seen and 0 < mass < MOST_PAYLOAD * sum(drawn["mass"]):
            rig = plant.replace(**{key: own[key] + mass * part for key, part in unit.items()})
            text = f"the link of {name} carries {mass:.3g} kg at its end that the rig lacks"
            yield f"{text} (`mass`, `com` and `inertia`)", rig


def _scaled_terms(
    plant: Plant, given: _Data, options: FitOptions
) -> Iterator[tuple[PlantParameter, float, Plant]]:
    """Each term of inertia and gravity, the relative change that explains most, and its rig."""
    own = dict(plant.named_buffers())
    for term in plant_parameters(plant, driven=given.driven, options=options):
        if term.ratio and term.name.startswith(("inertia", "gravity", "mass")):
            x = _amount(plant, {k: own[k] * part for k, part in term.change.items()}, given)
            if x > -1:
                yield term, x, adjusted_plant(plant, [term], given.q.new_tensor([x]))


def _several_terms(plant: Plant, given: _Data, options: FitOptions) -> Iterator[Mistake]:
    """Inertia, gravity and length terms that together explain most, unless within their bounds.

    Masses and their centres are often guessed for a rig of one's own, all of them wrongly. Lengths
    are not: together they scale as the square of the time, as for a film in slow motion.
    """
    terms = [
        term
        for term in plant_parameters(plant, driven=given.driven, options=options)
        if term.ratio and term.name.startswith(("inertia", "gravity", "length", "mass"))
    ]
    one, x = given.q.new_ones(1), given.q.new_zeros(len(terms))
    for _ in range(SOLUTIONS if len(terms) > 1 else 0):
        rig = adjusted_plant(plant, terms, x)
        needed = given.needed(rig)
        slopes = [needed - given.needed(adjusted_plant(rig, [term], one)) for term in terms]
        _, change = _balance(given, given.tau - needed, torch.stack(slopes, -1))
        x = (1.0 + x) * (1.0 + change) - 1.0
        if not (x > -1.0).all():
            return
    pairs = [*zip(terms, x.tolist(), strict=True)]
    if any(not term.lower <= value <= term.upper for term, value in pairs):
        times = ", ".join(f"{term.name} {1 + value:.3g}" for term, value in pairs)
        rig = adjusted_plant(plant, terms, x)
        # A motion without torque determines only ratios.
        scale = "" if given.driven else ", for gravity 1 as given"
        text = f"several terms of the rig are wrong (times the given ones{scale}: {times})"
        lengths = [1.0 + value for term, value in pairs if term.name.startswith("length")]
        far = any(abs(value - 1.0) > options.length_term[0] for value in lengths)
        timed = far and max(lengths) / min(lengths) - 1.0 < options.length_term[0]
        if timed:
            rate = math.sqrt(math.prod(lengths) ** (1 / len(lengths)))
            text += f", or the true sample rate is {rate:.3g} times that in `time`"
        ratios = {term.name: 1.0 + value for term, value in pairs}
        yield Mistake(text, _unexplained(rig, given), rig, ratios, timed)


def _with_usual_errors(plant: Plant, given: _Data, options: FitOptions) -> Plant:
    """The plant with those usual errors of a drawing that explain most torque."""
    terms, errors = _drawn_terms(plant, given, options), _usual_errors(plant, given, options)
    _, sizes = _balance(given, given.tau - given.needed(plant), *errors)
    return adjusted_plant(plant, terms, sizes) if sizes.isfinite().all() else plant


def _usual_errors(plant: Plant, data: _Data, options: FitOptions) -> tuple[Tensor, list[float]]:
    """Torque saved per unit of each drawn term, (sample, joint, term), and 95 % of their priors."""
    zeros, others = _torques_of_terms(plant, data, options)
    saved = -torch.stack([*zeros, *others], -1) if zeros or others else data.q[..., None][..., :0]
    return saved, [NORMAL_95 * term.prior_sd for term in _drawn_terms(plant, data, options)]


def _delay_beside_usual_errors(
    plant: Plant,
    recordings: Sequence[Recording],
    motions: Sequence[Motion],
    given: _Data,
    options: FitOptions,
) -> Iterator[Mistake]:
    """A delay that divides the share which usual errors of the rig leave.

    The balance of the rig as given hides a delay beside such errors.
    """
    most, needed = options.largest_delay, given.needed(plant)
    errors = _usual_errors(plant, given, options)

    def unexplained(data: _Data) -> float:
        return _share(plant, data, _balance(data, data.tau - needed, *errors)[0])

    if (sound := unexplained(given)) <= _of_noise(plant, given, given.sd_of_mean):
        return
    delay, share = _best(
        lambda x: unexplained(_collect(recordings, motions, options, x)), -most, most
    )
    # A torque that is held until the next sample acts up to one step late.
    held = -max(r.sample_time for r in recordings) <= delay <= 0
    if not held and options.diagnosis_ratio * share < sound:
        yield Mistake(f"{delay_in_words(delay)}, together with usual errors of the rig", share)


def _corrected_torques(
    plant: Plant, given: _Data, options: FitOptions
) -> Iterator[tuple[str, _Data]]:
    kind = "force" if plant.unit == "m" else "torque"
    driven = given.driven
    groups = [(f"the {kind} of {plant.joint_names[j]}", [j]) for j in driven]
    if len(driven) > 1:
        groups.append((f"every {kind}", driven))
    for what, joints in groups:
        part = torch.zeros_like(given.tau)
        part[:, joints] = given.tau[:, joints]
        # The gain is estimated together with the friction, which would bias a ratio of torques.
        without = replace(given, tau=given.tau - part)
        gain = float(_balance(without, without.tau - given.needed(plant), part)[1])
        if gain and abs(gain - 1) > options.gain_term[0]:
            text = f"{what} {_wrong_by(gain, ' (a unit, torque constant or gear ratio)')}"
            yield text, replace(given, tau=given.tau + (gain - 1) * part)
    needed = given.needed(plant)
    for j in driven:
        tau = given.tau[:, j]
        # If gravity requires only one sign, this changes nothing.
        if bool((tau >= 0).all() or (tau <= 0).all()) and tau.min() < tau.max():
            signed = given.tau.clone()
            signed[:, j] = tau.abs() * torch.sign(needed[:, j])
            text = f"the {kind} of {plant.joint_names[j]} is recorded without its sign"
            yield text, replace(given, tau=signed)


def _wrong_by(gain: float, causes: str = "") -> str:
    """The error of a torque that must be multiplied by a gain, in a clause."""
    if -1.5 < gain < -0.7:
        return "has the wrong sign"
    size, way = (1 / gain, "large") if abs(gain) < 1 else (gain, "small")
    # Three digits, but 1000 and not 1e+03.
    wrong = f"is {float(f'{abs(size):.3g}'):g} times too {way}{causes}"
    return "has the wrong sign and " * (gain < 0) + wrong


def _unlike_gains(plant: Plant, given: _Data, options: FitOptions) -> Iterator[tuple[str, float]]:
    """A gain for each drive, as torque constants of different motors may all be wrong."""
    driven, needed = given.driven, given.needed(plant)
    without = replace(given, tau=torch.zeros_like(given.tau))
    _, gains = _balance(without, -needed, torch.diag_embed(given.tau)[..., driven])
    wrong = [
        f"that of {plant.joint_names[j]} {_wrong_by(gain)}"
        for j, gain in zip(driven, gains.tolist(), strict=True)
        if gain and abs(gain - 1) > options.gain_term[0]
    ]
    if len(wrong) > 1 and (gains != 0).all():
        kind = "force" if plant.unit == "m" else "torque"
        scaled = given.tau.clone()
        scaled[:, driven] *= gains
        text = f"the {kind}s are off by different factors: {' and '.join(wrong)}"
        text += " (torque constants or gear ratios)"
        yield text, _unexplained(plant, replace(given, tau=scaled))


def _saturated(plant: Plant, given: _Data) -> Iterator[tuple[str, _Data]]:
    """Each drive with the torque limit that explains most."""
    for j in given.driven:
        largest = float(given.tau[:, j].abs().max())

        def limited(limit: float, joint: int = j) -> _Data:
            tau = given.tau.clone()
            tau[:, joint] = tau[:, joint].clamp(-limit, limit)
            return replace(given, tau=tau)

        limit, _ = _best(lambda x: _unexplained(plant, limited(x)), 0.1 * largest, largest)
        kind, unit = ("force", "N") if plant.unit == "m" else ("torque", "N m")
        text = (
            f"the drive of {plant.joint_names[j]} saturates at {limit:.3g} {unit}, and its {kind} "
            "is recorded as commanded (clip the column there)"
        )
        yield text, limited(limit)


def _switched_off(
    plant: Plant, recordings: Sequence[Recording], given: _Data
) -> Iterator[tuple[str, _Data]]:
    """Each drive, and all together, switched off during the piece where that explains most."""
    needed, driven = given.mean(given.needed(plant)), given.mean(given.tau)
    number, time = given.mean(given.number.to(given.q))[:, 0], given.mean(given.time)[:, 0]
    gained, joints = torch.zeros_like(needed), given.driven
    for j in joints:
        shapes, left = given.friction[:, j], given.moving[:, j] * (driven - needed)[:, j]
        left = left - shapes @ (torch.linalg.pinv(shapes) @ left)
        without = left - given.moving[:, j] * driven[:, j]
        gained[:, j] = (left.square() - without.square()) / driven[:, j].square().mean()
    groups = [(f"the drive of {plant.joint_names[j]} is", [j]) for j in joints]
    groups += [("all drives are", joints)] * (len(joints) > 1)
    for what, own in groups:
        found = []
        for k, name in enumerate(names_of(recordings)):
            blocks = (number == k).nonzero().flatten()
            # The consecutive blocks with the largest sum.
            total = np.append(0.0, gained[blocks][:, own].sum(1).cumsum(0).numpy())
            rise = total - np.minimum.accumulate(total)
            end = int(rise.argmax())
            piece = blocks[int(total[: end + 1].argmin()) : end]
            found.append((float(rise[end]), piece, name))
        most = max(gain for gain, *_ in found)
        tau, said = given.tau.reshape(-1, given.block, plant.joints).clone(), []
        for gain, piece, name in found:
            if gain > 0.5 * most:
                for j in own:
                    tau[piece, :, j] = 0.0
                said.append(f"from {time[piece[0]]:.3g} to {time[piece[-1]]:.3g} s of {name}")
        if said:
            text = f"{what} off {', '.join(said[:3])}, although a torque is recorded (set it to 0)"
            yield text, replace(given, tau=tau.reshape_as(given.tau))


def _end_stops(
    plant: Plant, recordings: Sequence[Recording], given: _Data, options: FitOptions
) -> Iterator[Mistake]:
    """Driven joints held at an end of their motion against far more torque than moves them nearby.

    A joint must return to the same place, because dry friction may hold it anywhere.
    """
    number, time = (x[:: given.block, 0].tolist() for x in (given.number, given.time))
    needed, rest = given.needed(plant), torch.zeros_like(given.q)
    torque = given.mean(given.tau - needed)
    inertial = given.mean(needed - plant.inverse_dynamics(given.q, rest, rest)).abs()
    names = names_of(recordings)
    for j in given.driven:
        q, said = given.q[:, j].reshape(-1, given.block), []
        for side, end in ((-1, q.min()), (1, q.max())):
            away = (end - q).abs().amax(1) / (q.max() - q.min())
            sliding = (away < ALIKE) & (away > ALIKE**2) & (given.moving[:, j] > 0)
            usual = torque[sliding, j].abs().quantile(0.5) if sliding.any() else math.inf
            # A wrong inertia shows at reversals, an end stop at rest.
            pushed = side * torque[:, j] - inertial[:, j] > options.diagnosis_ratio * usual
            held = ((away < ALIKE**2) & pushed).nonzero().flatten().tolist()
            # The joint has left in between, or the recording is another one.
            visits = held[:1] + [
                b
                for a, b in pairwise(held)
                if number[a] != number[b] or bool((away[a:b] > ALIKE).any())
            ]
            if len(visits) > 1:
                where = ", ".join(f"{time[k]:.3g} s of {names[number[k]]}" for k in visits[:3])
                said.append(f"{float(end):.3g} {plant.unit} (at {where})")
        if said:
            text = f"{plant.joint_names[j]} runs into end stops near {' and '.join(said)}"
            yield Mistake(f"{text}, which the rig lacks (cut these parts off)", math.nan)


def _elastic(plant: Plant, given: _Data, step: float) -> Iterator[tuple[str, float]]:
    """Each driven joint with a spring between the inertia of its drive and the link.

    The drive's inertia B then takes, in addition to the torque of a rigid joint, B/k times that
    torque's second derivative (M. W. Spong, J. Dyn. Sys. Meas. Control 109 (1987), 310-319),
    because it turns ahead of the joint by the torque over the stiffness k.
    """
    if given.block < FEWEST_FOR_CURVATURE:
        return
    place = step * (torch.arange(given.block).to(given.q) - (given.block - 1) / 2)
    parabola = place.square() - place.square().mean()
    needed = given.needed(plant)
    blocks = needed.reshape(-1, given.block, plant.joints)
    curvature = 2 * torch.einsum("bsj,s->bj", blocks, parabola) / parabola.square().sum()
    curvature = curvature.repeat_interleave(given.block, 0)
    for j in given.driven:
        part = torch.where(torch.arange(plant.joints) == j, curvature, 0.0)
        ratio = -float(_balance(given, given.tau - needed, part)[1])
        if ratio > 0:
            text = (
                f"{plant.joint_names[j]} is elastic or has play between drive and encoder "
                f"(resonance near {1 / (math.tau * math.sqrt(ratio)):.2g} Hz), which a rigid rig "
                "cannot follow"
            )
            yield text, _unexplained(plant, given, part)


def changing_friction(
    plant: Plant, recordings: Sequence[Recording], motions: Sequence[Motion], options: FitOptions
) -> Iterator[tuple[str, str]]:
    """Changes with time of a joint's friction, its torque's scale or an offset: kind and sentence.

    Changes may happen during recordings or between them. For the arguments see `likely_mistakes`. A
    wrong law, rig or delay must not appear as a change: friction may be any function of speed plus
    a share of the torque, and the rig is fitted as well. The change has to exceed the scatter of
    its estimates with each piece of the sliding left out, and to predict the torque of these
    pieces: in a short motion, time and falling speed look alike.
    """
    data, pieces = _collect(recordings, motions, options), options.drift_pieces * len(recordings)
    if len(data.q) < 2 * pieces * data.block:
        return
    time, number = data.mean(data.time), data.mean(data.number.to(data.time))
    # At a constant rate, or as a warm-up of which 95 % is over at the end.
    during = [("during a recording", x) for x in (time, 1 - torch.exp(-3 * time / time.max()))]
    onward = "from the first recording to the last", number
    for j, joint in enumerate(plant.joint_names):
        *means, sliding = _of_sliding(plant, data, j, options)
        friction, of_rig, torque = (x[sliding] for x in means)
        terms = friction, of_rig, torque
        if (count := len(friction)) < 2 * pieces or not bool(torch.cat(terms, 1).isfinite().all()):
            continue
        kinds = ["friction", "scale", "offset"] if j in data.driven else ["friction"]
        piece, between = torch.arange(count) * pieces // count, [onward]
        if len(recordings) > 2:
            # The recording whose friction differs most from that of the others.
            alone = [(number == k).to(number) for k in range(len(recordings))]
            own = [_growth("friction", piece < 0, *terms, x[sliding])[0] for x in alone]
            odd = int(np.argmax(np.abs(own)))
            name = names_of(recordings)[odd]
            between.append((f"in {name} relative to the others", alone[odd]))
        # Between recordings, a gain that differs between directions would look like an offset.
        for clocks, shown in ((during, kinds), (between, kinds[:2])):
            tried: list[_Change] = []
            # Per time of sliding, in pieces that all contain some: rest shows nothing.
            for (period, whole), of in product(clocks, shown):
                clock = whole[sliding]
                span = clock.max() - clock.min()
                if span == 0:
                    continue
                given = [*terms, clock / span]
                found = [_growth(of, piece == k, *given) for k in range(pieces)]
                rates, squares, _ = zip(*found, strict=True)
                constant, growing = torch.stack(squares).T
                mean = float((clock - clock.min()).mean() / span)
                rate, _, size = _growth(of, piece < 0, *given)
                sd = math.sqrt((pieces - 1) * np.var(rates))
                # No friction changes its sign, and a torque constant changes by less than that of
                # another drive may differ; an exponential may fit where a line does not.
                plausible = {
                    "friction": rate * (1 - mean) > -1 and rate * mean < 1,
                    "scale": abs(rate) <= options.gain_term[0],
                    "offset": True,
                }
                if plausible[of]:
                    change = _Change(of, period, rate, sd, mean, size, growing, constant)
                    tried.append(change)
            if not tried:
                continue
            best, *_ = tried = sorted(tried, key=lambda x: float(x.growing.sum()))
            # Friction is what usually changes.
            friction_alone = next((x for x in tried if x.of == "friction"), best)
            if not improves(best.growing, friction_alone.growing, options.drift_chance):
                best = friction_alone
            # A change of 1 % hardly shows in a simulation.
            least = best.sd * student_quantile(pieces - 1, 1 - options.drift_chance / 2)
            if abs(best.rate) > max(0.01, least) and improves(
                best.growing, best.constant, options.drift_chance
            ):
                yield best.of, best.sentence(plant, joint, student_quantile(pieces - 1, 0.975))


class _Change(NamedTuple):
    """A change with time of a joint's friction, of its torque's scale, or of an offset."""

    of: str
    period: str
    rate: float  # over the period, relative to the friction or torque [-]
    sd: float  # of the rate
    mean: float  # of the time in the period [-]
    size: float  # of the friction, root mean square [N m; N]
    growing: Tensor  # squared torque errors of hold-out pieces with the change
    constant: Tensor  # and without

    def sentence(self, plant: Plant, joint: str, sure: float) -> str:
        """In words, with an interval of this many standard deviations."""
        kind, unit = ("force", "N") if plant.unit == "m" else ("torque", "N m")
        first, last = 1 - self.rate * self.mean, 1 + self.rate * (1 - self.mean)
        slope = ((1 - self.mean) / last + self.mean / first) * last / first
        if self.of == "offset":
            what, cause, unit = f"offset of the {kind}", "sensor, amplifier", f" {unit}"
            sizes = abs(self.rate) * self.size, sure * self.sd * self.size
        else:
            what, cause, unit = "friction", "warm-up, payload", " %"
            sizes = 100 * abs(last / first - 1), 100 * sure * self.sd * slope
            if self.of == "scale":
                what, cause = f"scale of the {kind}", "torque constant, sensor, supply"
        change, reach = (float(f"{x:.2g}") for x in sizes)
        return (
            f"The {what} of {joint} {'grows' if self.rate > 0 else 'falls'} by {change:g} ± "
            f"{reach:g}{unit} {self.period} ({cause}); the intervals do not cover this."
        )


def loose_loads(
    plant: Plant, recordings: Sequence[Recording], motions: Sequence[Motion], options: FitOptions
) -> Iterator[str]:
    """A sentence for each driven joint whose gear has play: its load is loose after it reverses.

    For the arguments see `likely_mistakes`. Within the play a drive accelerates only its rotor, so
    the torque of the load is missing after it reversed, but not before; a wrong rig, law or delay
    appears in both. Reversals of the velocity are left out, because there bristles change their
    torque. The missing share has to exceed its scatter with each piece of the sliding left out, and
    be most of the load: a mere delay of the friction looks like a smaller share.
    """
    own, pieces = dict(plant.named_buffers()), options.drift_pieces * len(recordings)
    # Every block, because a reversal lies between adjacent blocks.
    every = replace(options, diagnosis_samples=sum(map(len, recordings)))
    data = _collect(recordings, motions, every)
    driven = data.driven
    geared = [k for k in driven if "armature" in own and own["armature"][k] > 0]
    if not geared or len(data.q) < 2 * pieces * data.block:
        return
    terms = [x.change for x in plant_parameters(plant, driven=driven, options=options) if x.ratio]
    rigs = [plant.replace(**{k: own[k] + x for k, x in change.items()}) for change in terms]
    needed, wrong = data.needed(plant), [data.needed(rig) for rig in rigs]
    elapsed = data.mean(data.time)[:, 0].diff()
    beside = (elapsed > 0) & (elapsed < 1.5 * elapsed.median())
    for j in geared:
        friction, of_rig, driving, sliding = _of_sliding(plant, data, j, options)
        load = needed[:, j] - own["armature"][j] * data.qdd[:, j]
        more = [torch.sign(data.qd[:, j]) * load.abs(), data.qdd[:, j], *(x[:, j] for x in wrong)]
        load = data.mean(load)
        turned = torch.nn.functional.pad((load[1:] * load[:-1] < 0) & beside, (1, 1))
        near = torch.stack([load * turned[1:], load * turned[:-1]], 1)
        known = torch.cat([friction, of_rig, data.mean(torch.stack(more, 1)), near], 1)[sliding]
        torque = driving[sliding, 0]
        if int(turned[:-1][sliding].sum()) < pieces // 2 or not bool(known.isfinite().all()):
            continue
        # Scaled, because most terms of a simple rig are sums of others.
        scale = known.square().mean(0).sqrt().clamp_min(torch.finfo(known.dtype).tiny)
        piece, found = torch.arange(len(known)) * pieces // len(known), []
        for seen in (piece != k for k in range(-1, pieces)):
            least = torch.linalg.lstsq(
                (known / scale)[seen], torque[seen], rcond=1e-9, driver="gelsd"
            )
            found.append(-float(least.solution[-1] / scale[-1]))
        share, sd = found[0], jackknife_sd(found[1:])
        sure, within = (student_quantile(pieces - 1, 1 - x) for x in (options.drift_chance, 0.025))
        if share > max(sd * sure, 0.5 + sd * within):
            yield (
                f"The gear of {plant.joint_names[j]} has play: for about "
                f"{options.diagnosis_block:g} s after the load reverses, {100 * share:.0f} ± "
                f"{100 * sd * within:.0f} % of its torque is missing; the intervals do not cover "
                "this."
            )


def _of_sliding(plant: Plant, data: _Data, j: int, options: FitOptions) -> tuple[Tensor, ...]:
    """Block means of friction and rig terms, of the torque that they explain, and what slides.

    The terms are (block, term), the torque (block, 1): that of the drive or, without one, that
    which slows the joint; its scale then is no term of the rig. What slides is (block,).
    """
    rest = torch.zeros_like(data.q)
    static, needed = plant.inverse_dynamics(data.q, rest, rest), data.needed(plant)
    speed, ones = data.qd[:, j].abs(), torch.ones_like(data.qd[:, j])
    knots = torch.quantile(speed, torch.linspace(0, 1, SPEED_KNOTS, dtype=speed.dtype))
    torque = data.tau[:, [j]]
    # A gear's loss, with the load: where friction is most of the torque, the torque times the
    # direction is the torque itself, and would explain everything.
    carried = needed[:, j].abs() * torque.any()
    shapes = [ones, *((speed - knot).clamp_min(0) for knot in knots[:-1]), carried]
    friction = torch.stack([torch.sign(data.qd[:, j]) * shape for shape in shapes], 1)
    rate = needed[:, j].reshape(-1, data.block).diff(dim=1).mean(1)
    of_rig = torch.stack([ones, static[:, j], rate.repeat_interleave(data.block), needed[:, j]], 1)
    if not torque.any():
        of_rig, torque = of_rig[:, :-1], -needed[:, [j]]
    # Smoothed over a reversal, dry friction seems to depend on the acceleration.
    apart = data.mean(speed) > options.diagnosis_block * data.mean(data.qdd[:, j].abs())
    return *map(data.mean, (friction, of_rig, torque)), apart & (data.moving[:, j] > 0)


def _growth(
    of: str, left_out: Tensor, friction: Tensor, of_rig: Tensor, torque: Tensor, time: Tensor
) -> tuple[float, Tensor, float]:
    """Growth per unit of time, relative to the friction or, of the torque's scale, to the torque.

    From the terms of friction and of the rig, (block, term) each, that explain the torque. Also
    returns the sums of squared torque errors without and with the growth on hold-out blocks, and
    the root mean square of the friction.
    """
    known, seen = torch.cat([friction, of_rig], 1), ~left_out
    constant = torch.linalg.lstsq(known[seen], torque[seen], driver="gelsd").solution
    usual = friction @ constant[: friction.shape[1]]
    size = usual.square().mean().sqrt()
    shape = {"friction": usual, "scale": known @ constant, "offset": size}[of]
    terms = torch.cat([known, (time - time[seen].mean()) * shape], 1)
    found = torch.linalg.lstsq(terms[seen], torque[seen], driver="gelsd").solution
    missed = [torque - known @ constant, torque - terms @ found]
    squares = torch.stack([x[left_out].square().sum() for x in missed])
    return float(found[-1]), squares, float(size)


def _springs(plant: Plant, given: _Data) -> Iterator[tuple[str, float]]:
    """Each driven joint with a spring to the frame, whose rest is anywhere."""
    needed = given.needed(plant)
    for j in given.driven:
        part = torch.where(torch.arange(plant.joints) == j, given.q, 0.0)
        stiffness = -float(_balance(given, given.tau - needed, part)[1])
        kind, unit = ("force", "N/m") if plant.unit == "m" else ("torque", "N m/rad")
        text = (
            f"{plant.joint_names[j]} has a spring of {stiffness:.3g} {unit} that the rig lacks "
            f"(subtract stiffness times position from the {kind} of {plant.joint_names[j]}), or it "
            "hardly slides and its contact is elastic (fit a law with memory, such as `dahl`)"
        )
        yield text, _unexplained(plant, given, part)


def _unbalanced(plant: Plant, given: _Data) -> Iterator[tuple[str, float]]:
    """A rotor without weight that gravity turns once per turn."""
    if plant.unit == "rad" and plant.joints == 1 and given.tau.any() and not weighs(plant):
        wave = torch.stack([given.q.sin(), given.q.cos()], -1)
        text = (
            f"{plant.joint_names[0]} has an unbalanced mass that the rig lacks (`mass` and `com`)"
        )
        yield text, _unexplained(plant, given, wave)


def _cogging(plant: Plant, given: _Data) -> Iterator[tuple[str, float]]:
    """Each driven joint with a torque that repeats with its position, as of a motor's magnets."""
    left, terms, weight = _equations(given, given.tau - given.needed(plant))
    for j in given.driven if plant.unit == "rad" else ():
        q, known = given.q[:, j], terms[:, j]
        span = float(q.max() - q.min())
        # At least two periods within the motion.
        if not 2 * math.tau < MOST_PER_TURN * span < math.inf:
            continue
        rates = torch.arange(math.ceil(2 * math.tau / span), MOST_PER_TURN + 1)
        waves = torch.stack([(q[:, None] * rates).sin(), (q[:, None] * rates).cos()], 2)
        waves = (given.moving[:, [j], None] * given.mean(waves)).movedim(1, 0)
        known = torch.linalg.qr(known[:, known.any(0)]).Q
        rest, waves = (x - known @ (known.T @ x) for x in (left[:, j], waves))
        if not bool(rest.isfinite().all()):
            continue
        sizes = torch.linalg.pinv(waves) @ rest
        best = int((waves @ sizes[..., None]).square().sum((1, 2)).argmax())
        part = torch.zeros(*given.q.shape, 2, dtype=q.dtype)
        part[:, j] = torch.stack([(rates[best] * q).sin(), (rates[best] * q).cos()], 1)
        text = (
            f"{plant.joint_names[j]} has a torque of {float(sizes[best].norm() * weight[j]):.2g} "
            f"N m that repeats {rates[best]} times per turn (cogging of its motor)"
        )
        yield text, _unexplained(plant, given, part)


def _geared(plant: Plant, convention: AngleConvention, given: _Data) -> Iterator[tuple[str, float]]:
    """Each joint, and all, as if recorded at the motor, before a gear of the best ratio.

    If the rig has motors, also each driven joint with the ratio of its gear that explains most.
    """
    if not isinstance(plant, PendulumChain) or not given.tau.any():
        return
    first, eye = plant.first_link, np.eye(plant.joints)
    q = convention.position_from_joint(given.q.numpy(), first)
    rates = [convention.rate_from_joint(x.numpy(), first) for x in (given.qd, given.qdd)]

    def geared(x: float, group: Array, drive: Array) -> float:
        scale = np.exp(-x * group)
        at = torch.as_tensor(convention.position_to_joint(q * scale, first))
        qd, qdd = (torch.as_tensor(convention.rate_to_joint(r * scale, first)) for r in rates)
        gain = torch.as_tensor(np.exp(x * drive))
        data = replace(given, q=at, qd=qd, qdd=qdd, tau=given.tau * gain)
        rig = plant.replace(armature=plant.armature * gain.square()) if drive.any() else plant
        return _unexplained(rig, data)

    every = [("all positions are", eye.sum(0))] * (plant.joints > 1)
    alone = [(f"{name}'s position is", eye[j]) for j, name in enumerate(plant.joint_names)]
    for what, group in (*alone, *every):
        ratio, share = _best(partial(geared, group=group, drive=0 * group), *LOG_RATIOS, 41)
        yield f"{what} {math.exp(ratio):.3g} times too large (of the motor, before its gear)", share
    for j in given.driven if plant.motor is not None else ():
        most = math.log(4.0)  # ratios within a series of gears
        ratio, share = _best(partial(geared, group=eye[j], drive=eye[j]), -most, most, 17)
        name = plant.joint_names[j]
        yield f"the gear ratio of {name} is {math.exp(ratio):.3g} times that of the rig", share


def balanced_delay(
    plant: Plant,
    recordings: Sequence[Recording],
    motions: Sequence[Motion],
    options: FitOptions = DEFAULTS,
) -> tuple[float, float]:
    """Delay of torques after positions that explains most [s], and the unexplained share [-].

    For the arguments and that share of the torque see `likely_mistakes`.
    """
    most = options.largest_delay
    return _best(
        lambda x: _unexplained(plant, _collect(recordings, motions, options, x)), -most, most
    )


def _drifting_clock(
    plant: Plant, recordings: Sequence[Recording], motions: Sequence[Motion], options: FitOptions
) -> tuple[str, float]:
    """The drift of the torques' clock that explains most, and the unexplained share [-]."""
    most = options.largest_delay / max(r.duration for r in recordings)
    drift, share = _best(
        lambda x: _unexplained(plant, _collect(recordings, motions, options, drift=x)), -most, most
    )
    fast = "faster" if drift > 0 else "slower"
    off = f"{100 * abs(drift):.2g} % {fast}"
    return f"the clock of the torques is {off} than that of the positions", share


def _wrong_rate(plant: Plant, given: _Data) -> tuple[str, float]:
    """The factor of the sample rate that explains most, and the unexplained share [-]."""
    most = math.log(10)
    x, share = _best(lambda x: _unexplained(plant, given.at_rate(math.exp(x))), -most, most, 17)
    return f"the true sample rate is {math.exp(x):.3g} times that in `time`", share


def _best(
    unexplained: Callable[[float], float], lowest: float, highest: float, count: int = 9
) -> tuple[float, float]:
    """The value with the smallest unexplained share, and that share."""
    from scipy.optimize import minimize_scalar  # slow to import

    # The valley is as wide as a swing, so that a coarse grid finds it.
    grid = np.linspace(lowest, highest, count)
    best = int(np.argmin([unexplained(x) for x in grid]))
    around = float(grid[max(best - 1, 0)]), float(grid[min(best + 1, count - 1)])
    close = 5e-4 * (highest - lowest)
    found = minimize_scalar(unexplained, bounds=around, method="bounded", options={"xatol": close})
    return float(found.x), float(found.fun)


def delay_in_words(delay: float) -> str:
    """A delay of torques after positions [s], and how to remove it, as a clause."""
    words = ("torques", "positions") if delay > 0 else ("positions", "torques")
    return (
        f"{words[0]} are recorded {1e3 * abs(delay):.3g} ms later than {words[1]} "
        f"(`fit_delay=True`, or `recording.advance_torque({delay:.3g})`)"
    )


def _amount(plant: Plant, change: dict[str, Tensor], given: _Data) -> float:
    """Best-fitting factor of a change of buffers in which torques are linear."""
    own = dict(plant.named_buffers())
    moved = plant.replace(**{name: own[name] + part for name, part in change.items()})
    needed = given.needed(plant)
    return float(_balance(given, given.tau - needed, needed - given.needed(moved))[1])


def _unexplained(plant: Plant, data: _Data, extra: Tensor | None = None) -> float:
    """Share of the torque that Coulomb and viscous friction, and `extra`, do not explain [-].

    Root mean square over joints, relative to the sum of squares of the torques of drive, gravity
    and inertia, without their means where a drive may have an offset.
    """
    return _share(plant, data, _balance(data, data.tau - data.needed(plant), extra)[0])


def _of_noise(plant: Plant, data: _Data, sd: Tensor) -> float:
    """Share of the torque that its noise, and that of accelerations, explains [-]."""
    variance, needed = torch.zeros_like(data.moving), data.needed(plant)
    if data.block > 2:
        # Neither the slope of the torque nor its jumps in some blocks count as noise.
        curved = data.tau.reshape(-1, data.block, plant.joints).diff(n=2, dim=1)
        variance += curved.square().mean(1).median(0).values / (6 * data.block)
    for own in torch.eye(plant.joints, dtype=sd.dtype):
        moved = replace(data, qdd=data.qdd + own * sd).needed(plant)
        variance = variance + data.mean((moved - needed).square())
    return _share(plant, data, (data.moving * variance).mean(0))


def _share(plant: Plant, data: _Data, target: Tensor) -> float:
    """Mean squares of torques, (joint,), as a share of the torque [-]; see `_unexplained`."""
    needed, rest = data.needed(plant), torch.zeros_like(data.q)
    static = plant.inverse_dynamics(data.q, rest, rest)
    parts = torch.stack([data.mean(x) for x in (data.tau, static, needed - static)])
    # The offset of a drive would explain a constant torque of any size.
    constant = (data.moving * parts).sum(1, keepdim=True) / data.moving.sum(0).clamp_min(1)
    size = (data.moving * (parts - data.tau.any(0) * constant)).square().mean(1).sum(0)
    return float((target / size.clamp_min(torch.finfo(size.dtype).tiny)).mean().sqrt())


def _balance(
    data: _Data, torque: Tensor, extra: Tensor | None = None, most: Sequence[float] | None = None
) -> tuple[Tensor, Tensor]:
    """Mean square of unexplained torque, (joint,), and factors of `extra` torques, (column,).

    The magnitude of each factor is at most `most`.
    """
    from scipy.optimize import lsq_linear  # slow to import

    left, terms, weight = _equations(data, torque, extra)
    rows: Array = torch.cat([terms, left[..., None]], -1).flatten(0, 1).numpy()
    count = 0 if extra is None else extra.numel() // data.q.numel()
    if not np.isfinite(rows).all():
        return torch.full_like(weight, math.inf), torch.full((count,), math.nan)
    norm = np.linalg.norm(rows[:, :-1], axis=0)
    norm[norm == 0] = 1.0
    high = np.full(len(norm), np.inf)
    high[:count] = math.inf if most is None else most
    # Friction that adds energy is excluded.
    low = -high
    low[terms.shape[-1] - data.friction.shape[-1] :] = 0.0
    # The triangular factor has the same normal equations. Columns may be equal, as those of an
    # offset and of dry friction in one direction: without a ridge, their factors would diverge.
    rows = np.vstack([rows / np.append(norm, 1.0), np.eye(len(norm), len(norm) + 1) * RIDGE])
    factor = np.asarray(np.linalg.qr(rows, mode="r"))
    found = lsq_linear(
        factor[:, :-1], factor[:, -1], (low * norm, high * norm), method="bvls",
        max_iter=50 * len(norm),
    )  # fmt: skip
    factors = torch.as_tensor(found.x / norm)
    return (weight * (left - terms @ factors)).square().mean(0), factors[:count]


def _equations(
    data: _Data, torque: Tensor, extra: Tensor | None = None
) -> tuple[Tensor, Tensor, Tensor]:
    """Torque (block, joint) and what may explain it (block, joint, column) over a weight (joint,).

    The columns are `extra`, the offsets of the drives, and friction.
    """
    left = data.moving * data.mean(torque)
    weight = left.square().mean(0).sqrt()
    weight = torch.where(weight > 0, weight, 1.0)
    own = []
    if extra is not None and extra.numel():
        own.append(-data.moving[..., None] * data.mean(extra.reshape(*data.q.shape, -1)))
    # A drive may have an offset.
    offsets = torch.diag_embed(data.moving)[..., data.tau.any(0)]
    terms = torch.cat([*own, offsets, data.friction], -1)
    return left / weight, terms / weight[:, None], weight

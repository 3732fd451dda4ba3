"""Typical mistakes in recordings and rigs, found from the balance of torques.

A mistake leaves torque that no friction explains. Each hypothesis corrects one mistake; the balance
shows which correction explains the motion. Each takes one pass of inverse dynamics, no simulation.
"""

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
import torch
from numpy.lib.stride_tricks import sliding_window_view
from torch import Tensor

from nfriction.fitting.adjusted_plant import adjusted_plant
from nfriction.fitting.data.inputs import names_of, ranges, weighs
from nfriction.fitting.diagnosis import corrections
from nfriction.fitting.diagnosis.balance import (
    FEWEST_BLOCKS,
    Mistake,
    Samples,
    Source,
    balance_equations,
    collect,
    drawn_terms,
    noise_share,
    solve_balance,
    torque_share,
    torques_of_terms,
    unexplained_share,
    usual_errors,
)
from nfriction.fitting.options import DEFAULTS, FitOptions
from nfriction.fitting.result.paired_test import jackknife_sd, student_quantile
from nfriction.friction.models import FrictionModel
from nfriction.plant import LinearAxis, PendulumChain, Plant
from nfriction.recording import Recording
from nfriction.recording.angles import AngleConvention
from nfriction.recording.validation import MINIMUM_SAMPLES, gaps, time_unit, turns_between_samples
from nfriction.signals import Motion, count_seen

# Steps that are alike differ by less than this part; noise and counts must be smaller, too.
ALIKE = 0.1


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
    given = collect(Source(recordings, motions, options))
    # These spoil the balance, and a fit absorbs some wrong times in the inertia.
    if broken := next(_broken_rows(recordings, options), None):
        return math.nan, (broken,)
    counts = plant.position_quantum or np.fmin.reduce([count_seen(r.q) for r in recordings])
    still = ranges(recordings) <= options.min_counts * np.nan_to_num(counts)
    # Dry friction holds a joint that hardly moves, whatever its rig.
    if still.all() or len(given.q) < FEWEST_BLOCKS * given.block:
        return math.nan, ()
    stated = unexplained_share(plant, given)
    noise = noise_share(plant, given, given.sd_of_mean)
    # Inertias or torques wrong by the square of a thousand would have the same effect.
    if unit := time_unit(recordings[0].time):
        short, _, rate = unit
        share = unexplained_share(plant, given.at_rate(rate))
        if noise < stated and share < stated / options.diagnosis_ratio:
            return stated, (Mistake(f"time is in {short}", share),)
    if stops := [*_end_stops(plant, given)]:
        return stated, tuple(stops)
    # With different zeros, recordings of the same rig have different balances.
    unlike = [*_unlike_zeros(plant, given)] if len(recordings) > 1 else []
    # The shock of a brake looks like other mistakes, and a wrong rig seems to be held.
    held = [*_held(plant, given)] if given.driven else []
    found = held if zeroed else held + unlike
    if noise < stated:
        known = min((x.unexplained for x in held + unlike), default=math.inf)
        found = found + _above_noise(plant, convention, given, known, presliding)
    if not found and not given.tau.any():
        # With a slightly wrong rig, the energy would seem to rise.
        rig = _with_usual_errors(plant, given)
        found = [*_driven_without_torque(rig, given.source)]
    # Nearly equal shares: the data do not distinguish these corrections; simple ones come first.
    least = min((mistake.unexplained for mistake in found), default=math.nan)
    # A share that is unknown, NaN, is never larger.
    sure = [m for m in found if not m.unexplained >= options.diagnosis_tie * least]
    return stated, tuple(sure[:3])


def _above_noise(
    plant: Plant, convention: AngleConvention, given: Samples, known: float, presliding: bool
) -> list[Mistake]:
    """Mistakes whose correction divides the unexplained torque by `diagnosis_ratio`, simple first.

    `known` is the share unexplained with an encoder zero for each recording, or without rests that
    a brake holds.
    """
    stated, options = unexplained_share(plant, given), given.options
    sound, noise = stated, options.diagnosis_ratio * noise_share(plant, given, given.sd_of_mean)
    delay = 0.0, sound
    if given.tau.any():
        delay = corrections.balanced_delay(plant, given)
        if given.held(delay[0]):
            sound = min(delay[1], sound)
    tested = [*_tested(plant, convention, given, delay, stated)]
    for term, x, rig in corrections.scaled_terms(plant, given):
        share = unexplained_share(rig, given)
        if term.lower <= x <= term.upper:
            sound = min(share, sound)  # The fit corrects this by itself.
        else:
            text = f"{term.name} is {1 + x:.3g} times that of the rig"
            if plant.joints == 1 and term.name.startswith("inertia"):
                rate = math.sqrt(corrections.own_inertia(rig) / corrections.own_inertia(plant))
                text += f", or the true sample rate is {rate:.3g} times that in `time`"
            # Without a drive, a guessed inertia is likelier than a missing rotor.
            place = len(tested) if given.driven else 0
            tested.insert(place, Mistake(text, share, (rig, given)))
    for _, gain, scaled in corrections.torque_gains(plant, given):
        if abs(gain - 1) <= options.gain_term[0]:
            sound = min(unexplained_share(plant, scaled), sound)  # The fit corrects this, too.
    if sound <= noise:
        return []
    if len(given.recordings) > 1:
        most = min(sound, known) / options.diagnosis_ratio
        tested += _odd_one_out(plant, convention, given.source, most)
    most = sound / options.diagnosis_ratio
    # Near one position a spring is like gravity, and a ratio like a unit.
    least = _least_with_usual_errors(tested, plant, most, options.diagnosis_tie)
    rare = [
        *(() if presliding else corrections.springs(plant, given)),
        *corrections.unbalanced(plant, given),
        *corrections.geared(plant, convention, given),
        *(corrections.unlike_gains(plant, given) if len(given.driven) > 1 else ()),
        corrections.wrong_rate(plant, given),
        *corrections.several_terms(plant, given),
    ]
    if options.diagnosis_ratio * noise_share(plant, given, given.sd) < stated:
        rare += corrections.cogging(plant, given)
    tested += [x for x in rare if options.diagnosis_tie * x.unexplained < least]
    found = [x for x in tested if x.unexplained < most]
    if not found and given.driven:
        found = [*corrections.delay_beside_usual_errors(plant, given)]
    if not found and not given.tau.any() and isinstance(plant, PendulumChain | LinearAxis):
        # A rig that is wrong in several terms hides a wrong convention.
        both = [
            Mistake(f"{angles.text}, and {terms.text}", terms.unexplained)
            for angles in corrections.corrected_positions(plant, convention, given)
            if angles.case and "`convention`" in angles.text
            for terms in corrections.several_terms(*angles.case)
        ]
        best = min(both, key=lambda mistake: mistake.unexplained, default=Mistake("", math.inf))
        found = [best] if best.unexplained < most else []
    return found


def _tested(
    plant: Plant,
    convention: AngleConvention,
    given: Samples,
    delay: tuple[float, float],
    stated: float,
) -> Iterator[Mistake]:
    """Common mistakes, the simpler ones first, each with the share that its correction leaves."""
    yield from corrections.corrected_positions(plant, convention, given)
    for text, rig in corrections.corrected_rigs(plant, bool(given.tau.any())):
        yield corrections.tried(text, rig, given)
    if given.tau.any():
        yield from corrections.corrected_torques(plant, given)
        yield Mistake(corrections.delay_in_words(delay[0]), delay[1])
        yield corrections.drifting_clock(plant, given)
        yield from corrections.saturated(plant, given)
        yield from corrections.switched_off(plant, given)
        # Narrow-band noise of the smoothed accelerations has a resonance of its own.
        if given.options.diagnosis_ratio * noise_share(plant, given, given.sd) < stated:
            yield from corrections.elastic(plant, given)
    yield from corrections.missing_rotors(plant, given)
    yield from corrections.payloads(plant, given)


def _least_with_usual_errors(
    tested: Sequence[Mistake], plant: Plant, most: float, tie: float
) -> float:
    """Smallest share that a correction leaves if the rig also has usual errors of a drawing.

    Rare mistakes have to explain more than this, because their factors absorb such errors. Only the
    best corrections of the data and of the rig count, as the errors make all of them alike.
    """
    shares = [math.inf, *(x.unexplained for x in tested)]
    cases = [(x.unexplained, *x.case) for x in tested if x.case]
    for share, rig, data in cases:
        peers = [other for other, of, _ in cases if (of is plant) == (rig is plant)]
        if share < most and share <= tie * min(peers):
            needed = data.needed(rig)
            left, _ = solve_balance(data, data.tau - needed, *usual_errors(rig, data))
            shares.append(torque_share(rig, data, left, needed))
    return min(shares)


def _odd_one_out(
    plant: Plant, convention: AngleConvention, source: Source, most: float
) -> Iterator[Mistake]:
    """The recording that friction of its own explains worst, if the others leave at most this.

    Friction may change between recordings, and lively motion leaves more: this one is odd only if
    a correction explains it, or inertia, gravity and zeros of its own with the friction of all.
    """
    recordings, motions, options = source
    few = replace(options, diagnosis_samples=max(1, options.diagnosis_samples // len(recordings)))
    pairs = zip(recordings, motions, strict=True)
    alone = [unexplained_share(plant, collect(Source([r], [m], few))) for r, m in pairs]
    odd = int(np.argmax(np.nan_to_num(alone, nan=-1.0)))
    name = names_of(recordings)[odd]
    order = sorted(range(len(alone)), key=lambda k: k != odd)
    recordings, motions = [recordings[k] for k in order], [motions[k] for k in order]
    share = unexplained_share(plant, collect(Source(recordings[1:], motions[1:], options)))
    if share >= most:
        return
    _, causes = likely_mistakes(plant, recordings[:1], motions[:1], convention, few)
    data = collect(Source(recordings, motions, options))
    zeros, terms = torques_of_terms(plant, data)
    rig = [(data.number == 0) * part for part in zeros + terms]
    if causes or (rig and unexplained_share(plant, data, torch.stack(rig, -1)) < most):
        text = f"{name} is from another rig than the others, or was recorded differently"
        because = f" ({', or '.join(x.text for x in causes)})" * bool(causes)
        yield Mistake(text + because, share)


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
    """A sentence on the torque unexplained before and after a correction; empty if about equal."""
    if not DEFAULTS.diagnosis_ratio * mistake.unexplained < stated:
        return ""
    after = f"after the correction {mistake.unexplained:.2g}"
    return f" Friction leaves {stated:.2g} of the torque unexplained, {after}."


def _broken_rows(recordings: Sequence[Recording], options: FitOptions) -> Iterator[Mistake]:
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


def _driven_without_torque(plant: Plant, source: Source) -> Iterator[Mistake]:
    """The first recording whose energy rises by more than an error of the rig could explain."""
    if not isinstance(plant, PendulumChain | LinearAxis):
        return
    for recording, motion in zip(source.recordings, source.motions, strict=True):
        # At rest, or held: only rounding moves.
        if not np.ptp(recording.q, axis=0).all():
            continue
        kinetic, potential = plant.energy(torch.tensor(motion.q), torch.tensor(motion.qd))
        energy = (kinetic + potential).numpy()
        rise = energy - np.minimum.accumulate(energy)
        if rise.max() > source.options.energy_rise * float(kinetic.max()):
            text = (
                f"{recording.name or 'a recording'} has no torque, but its motion gains energy up "
                f"to {motion.time[rise.argmax()]:.3g} s; name the columns of the torque, cut off "
                "the part in which it is driven, or correct masses, centres of mass and lengths"
            )
            yield Mistake(text, math.nan)
            return


def _with_usual_errors(plant: Plant, given: Samples) -> Plant:
    """The plant with those usual errors of a drawing that explain most torque."""
    terms, errors = drawn_terms(plant, given), usual_errors(plant, given)
    _, sizes = solve_balance(given, given.tau - given.needed(plant), *errors)
    return adjusted_plant(plant, terms, sizes) if sizes.isfinite().all() else plant


def _end_stops(plant: Plant, given: Samples) -> Iterator[Mistake]:
    """Driven joints held at an end of their motion against far more torque than moves them nearby.

    A joint must return to the same place, because dry friction may hold it anywhere.
    """
    number, time = (x[:: given.block, 0].tolist() for x in (given.number, given.time))
    needed, rest = given.needed(plant), torch.zeros_like(given.q)
    torque = given.mean(given.tau - needed)
    inertial = given.mean(needed - plant.inverse_dynamics(given.q, rest, rest)).abs()
    names = names_of(given.recordings)
    for j in given.driven:
        q, said = given.q[:, j].reshape(-1, given.block), []
        for side, end in ((-1, q.min()), (1, q.max())):
            away = (end - q).abs().amax(1) / (q.max() - q.min())
            sliding = (away < ALIKE) & (away > ALIKE**2) & (given.moving[:, j] > 0)
            usual = torque[sliding, j].abs().quantile(0.5) if sliding.any() else math.inf
            # A wrong inertia shows at reversals, an end stop at rest.
            pushed = side * torque[:, j] - inertial[:, j] > given.options.diagnosis_ratio * usual
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


def _held(plant: Plant, given: Samples) -> Iterator[Mistake]:
    """Driven joints at rest against more torque than friction can hold, with the time of each rest.

    Static friction may exceed that of sliding, but neither `diagnosis_ratio` times the usual torque
    of sliding nor 95 % of the torques elsewhere, of which slow motion has its own share.
    """
    # Every block, because a rest may be short.
    every = replace(given.options, diagnosis_samples=sum(map(len, given.recordings)))
    data, rig = collect(given.source._replace(options=every)), _with_usual_errors(plant, given)
    needed, rest, said = data.needed(rig), torch.zeros_like(data.q), []
    free = torch.ones_like(given.time)
    edge = 2 * given.options.diagnosis_block + given.options.edge
    inertial = data.mean(needed - rig.inverse_dynamics(data.q, rest, rest)).abs()
    torque, speed = data.mean(data.tau - needed).abs(), data.mean(data.qd.abs())
    number, time = (data.mean(x.to(data.q))[:, 0] for x in (data.number, data.time))
    for j in data.driven:
        # A joint that turns one way slides, however slowly.
        slow = (speed[:, j] < ALIKE**2 * speed[:, j].max()) & (data.moving[:, j] == 0)
        change = (slow[1:] != slow[:-1]) | (number[1:] != number[:-1])
        runs = torch.arange(len(slow)).tensor_split(change.nonzero().flatten() + 1)
        rests = [run for run in runs if slow[run[0]] and len(run) >= FEWEST_BLOCKS]
        elsewhere = torch.ones_like(slow).index_fill(0, torch.cat([runs[0][:0], *rests]), False)
        sliding = elsewhere & (data.moving[:, j] > 0)
        if not rests or not sliding.any():
            continue
        usual = torque[sliding, j].quantile(0.5)
        others = [torque[x, j].quantile(0.95) for x in (sliding, elsewhere & slow) if x.any()]
        most = max(given.options.diagnosis_ratio * usual, *others)
        for run in rests:
            # The torque of inertia is not certain.
            against = torque[run, j] - inertial[run, j]
            against = against[against > most]
            if len(against) >= FEWEST_BLOCKS:
                first, last, k = time[run[0]], time[run[-1]], number[run[0]]
                # With the shocks at its ends, which smoothing spreads.
                near = (given.time - (first + last) / 2).abs() < (last - first) / 2 + edge
                free[near & (given.number == k)] = 0.0
                of = f"{plant.joint_names[j]} of {names_of(data.recordings)[int(k)]}"
                said.append(
                    f"{of} rests from {first:.3g} to {last:.3g} s against "
                    f"{against.median():.2g} {plant.effort_unit} and slides against {usual:.2g}"
                )
    if said:
        causes = (
            "a brake, an end stop, an obstacle or a drive that is off (leave these samples out)"
        )
        share = unexplained_share(plant, replace(given, turns=given.turns * free))
        yield Mistake(f"{', '.join(said[:3])}: {causes}", share)


def _unlike_zeros(plant: Plant, data: Samples) -> Iterator[Mistake]:
    """Joints whose encoder zero differs between recordings, and the share left with own zeros.

    The difference must exceed the usual error of a zero, because a wrong law causes small ones, and
    the scatter of its estimates with each piece of the data left out.
    """
    recordings, _, options = data.source
    pieces, blocks = options.drift_pieces * len(recordings), len(data.q) // data.block
    zeros, rig = torques_of_terms(plant, data)
    if not zeros or blocks < 2 * pieces:
        return
    own = [(data.number == k) * part for part in zeros for k in range(len(recordings))]
    left, design, _ = balance_equations(
        data, data.tau - data.needed(plant), torch.stack(own + rig, -1)
    )
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
        share = unexplained_share(plant, data, torch.stack(own, -1))
        drives = torch.diag_embed(data.tau.any(0) * torch.ones_like(data.tau))
        offsets = [(data.number == k)[..., None] * drives for k in range(len(recordings))]
        # A torque that is constant near one position.
        if unexplained_share(plant, data, torch.cat(offsets, -1)) < options.diagnosis_tie * share:
            text += ", or the offset of a drive or torque sensor changed between recordings"
        yield Mistake(text, share)


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
        data = collect(Source([recording], [motion], options))
        if len(data.q) < FEWEST_BLOCKS * data.block:
            continue
        coefficients = friction.coefficients(data.qd, data.qdd)
        tau_f = friction.torque(data.qd, plant.load(data.q, data.qd), coefficients)
        needed = data.needed(plant)
        left = data.moving * data.mean(data.tau - needed - tau_f)
        share = torque_share(plant, data, left.square().mean(0), needed)
        if k < len(trained):
            shares.append(share)
        elif shares and math.inf > share > ratio * (usual := max(shares)):
            most = ratio * max(usual, noise_share(plant, data, data.sd_of_mean))
            causes = _causes(plant, data, tau_f, left)
            rest, text = min(causes, default=(math.inf, ""))
            if rest < most < share:
                said = f"It differs from the training recordings: {text}. The model leaves "
                said += f"{share:.2g} of its torque unexplained, after the correction {rest:.2g}, "
                yield recording.name, Mistake(f"{said}and {usual:.2g} of theirs.", rest)


def _causes(plant: Plant, data: Samples, tau_f: Tensor, left: Tensor) -> list[tuple[float, str]]:
    """Unexplained share [-] with other friction, torque or encoder zeros, and the change."""
    kind, unit = plant.effort, plant.effort_unit
    zero = ", or its encoder has another zero" * weighs(plant)
    own, tau = (data.moving * data.mean(x) for x in (tau_f, data.tau))
    needed = data.needed(plant)
    names, drives, grown, rest = plant.joint_names, data.driven, [], left.clone()
    found: list[tuple[float, str]] = []

    def share_of(rest: Tensor) -> float:
        return torque_share(plant, data, rest.square().mean(0), needed)

    def fitted(j: int, shapes: Tensor) -> tuple[Tensor, float]:
        part, rest = shapes @ (torch.linalg.pinv(shapes) @ left[:, j]), left.clone()
        rest[:, j] -= part
        return part, share_of(rest)

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
    zeros, _ = torques_of_terms(plant, data) if not drives else ([], [])
    first = len(names) - len(zeros)
    for name, slope in zip(names[first:], zeros, strict=True):
        part = data.moving * data.mean(slope)
        size = relative(left.flatten(), part.flatten())
        share = share_of(left - size * part)
        off = abs(math.degrees(size))
        found.append((share, f"the encoder of {name} has another zero, {off:.2g} degrees off"))
    share = share_of(rest)
    # A change of several joints explains most, so it has to explain clearly more.
    if len(grown) == len(names) > 1 and data.options.diagnosis_tie * share < min(found)[0]:
        found.append((share, f"the friction {' and '.join(grown)} theirs"))
    return found

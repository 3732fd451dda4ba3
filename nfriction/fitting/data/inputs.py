"""Arguments of a fit, checked and converted: recordings, motions, adjustable plant terms.

Warnings report signs that recordings violate the assumptions of the plant and the fit.
"""

import math
import textwrap
import warnings
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from itertools import chain, compress, pairwise

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from nfriction.fitting.data.windows import begins_at_rest, moving_segments
from nfriction.fitting.options import DEFAULTS, FitOptions
from nfriction.fitting.plant_parameters import (
    PlantParameter,
    has_weight,
    plant_parameters,
    position_terms,
    torque_delay_term,
)
from nfriction.friction import model_by_name
from nfriction.friction.inputs import has_input
from nfriction.friction.laws import Law
from nfriction.friction.models import V_SMOOTH, FrictionModel
from nfriction.plant import PendulumChain, Plant
from nfriction.recording import Recording, RecordingLike
from nfriction.recording.angles import AngleConvention
from nfriction.recording.validation import MINIMUM_SAMPLES, gaps
from nfriction.signals import Motion, count_seen, kalman_smoother
from nfriction.simulation.validate import RK4_STABILITY, required_substeps

Array = NDArray[np.float64]

# Width of the smoothed sign of a model made by name, as a share of the slowest joint's largest
# velocity: the default of 3 mrad/s (mm/s) if that velocity reaches 3 rad/s (m/s).
TURN_SHARE = 1e-3
# Jumps whose sizes differ by less than this fraction count as equal.
ALIKE = 0.02
# Expected number of chance events above which an event proves nothing.
UNLIKELY = 0.01
# Share of held samples up to which they do not matter; a bus may repeat a few.
FEW = 0.01
# Shares of its range that a joint has moved just after its release, the second four times the
# first.
RELEASED = 0.01, 0.04


def as_model(model: FrictionModel | str, joints: int) -> FrictionModel:
    """The given model, or a new one by its name; TypeError or ValueError for anything else."""
    if isinstance(model, str):
        return model_by_name(model)(joints)
    if not isinstance(model, FrictionModel):
        raise TypeError(
            "`model` must be a friction model such as LFM(joints=3), or the name of one, got "
            f"{type(model).__name__} {textwrap.shorten(repr(model), 60)}."
        )
    return model


def require_doubles(model: torch.nn.Module, plant: torch.nn.Module) -> None:
    """Refuse models and plants in single precision, which ends searches early, or on a GPU."""
    for name, of in (("model", model), ("plant", plant)):
        for x in chain(of.parameters(), of.buffers()):
            if x.device.type != "cpu" or (x.is_floating_point() and x.dtype != torch.float64):
                raise ValueError(
                    f"a fit needs float64 on the CPU, got {x.dtype} on {x.device} in the {name}: "
                    f'`{name}.to("cpu", torch.float64)`.'
                )


def turning_velocity(
    plant: Plant, recordings: Sequence[Recording], motions: Sequence[Motion]
) -> tuple[float, float]:
    """Width of the smoothed sign of the velocity, and that without a limit of steps [rad/s; m/s].

    A joint that friction holds creeps at about this velocity. It is a small share of the slowest
    joint's largest velocity; where a rig is driven or comes to rest, it moves no joint by more than
    the noise of a reading in its longest rest; but it is never so small that dry friction is too
    steep for the steps of a fit. Recordings are in joint coordinates.
    """
    speeds = np.max([np.abs(m.qd).max(axis=0) for m in motions], axis=0)
    slowest = min((float(v) for v in speeds if v > 0), default=math.inf)
    pairs = list(zip(recordings, motions, strict=True))
    rests = [r.tau is not None or [*moving_segments(r, m)] != r.segments for r, m in pairs]
    held = [_creep(*p, j) for p in compress(pairs, rests) for j in range(plant.joints)]
    dry = plant.decay_rate(torch.as_tensor(_dry_friction(plant, pairs)))
    # Half the substeps, because coefficients may grow during the search.
    most = RK4_STABILITY * DEFAULTS.max_substeps / 2
    least = float(dry.max()) * max(r.longest_step for r in recordings) / most
    wanted = min(V_SMOOTH, TURN_SHARE * slowest, *held)
    return max(wanted, least), wanted


def _creep(recording: Recording, motion: Motion, joint: int) -> float:
    """Velocity [rad/s; m/s] that moves a joint by the noise of a reading in its longest rest."""
    noise = float(np.std(recording.q[:, joint] - motion.q[:, joint]))
    if not noise:
        return math.inf
    longest = 0.0
    for first, last in recording.segments:
        span, q = recording.time[first : last + 1], motion.q[first : last + 1, joint]
        # Cells of three standard deviations to either side; a rest may lie on a border of one.
        for shift in (0.0, 0.5):
            moved = np.flatnonzero(np.diff(np.floor(q / (6 * noise) + shift)))
            longest = max(longest, float(np.diff(span[[0, *moved, -1]]).max()))
    return noise / longest


def _dry_friction(plant: Plant, pairs: Sequence[tuple[Recording, Motion]]) -> Array:
    """Dry friction of each joint that the dissipated power implies [N m; N], (joint,)."""
    qd, taken = np.concatenate([m.qd for _, m in pairs]), []
    for r, m in pairs:
        needed = plant.inverse_dynamics(*map(torch.as_tensor, (m.q, m.qd, m.qdd)))
        taken.append((0.0 if r.tau is None else r.tau) - needed.numpy())
    driven = largest_torques([r for r, _ in pairs]) > 0
    found = []
    for v, f, drive in zip(qd.T, np.concatenate(taken).T, driven, strict=True):
        shapes = [v, v * abs(v)]
        # A constant torque, such as a weight or a sensor's bias, if both ways show it.
        if drive and min(np.mean(v > 0), np.mean(v < 0)) > DEFAULTS.two_way:
            shapes.append(abs(v))
        # At rest the direction is that of the noise, and the power is none.
        found.append(np.linalg.lstsq(np.stack(shapes, 1), f * abs(v))[0][0])
    return np.clip(found, 0.0, None)


def as_recording_list(
    recordings: RecordingLike | Iterable[RecordingLike], plant: Plant
) -> list[Recording]:
    """The recordings of a fit as a list; raises if one is no recording or given twice."""
    given = Recording.many(recordings, plant=plant)
    refuse_repeated(given)
    warn_of_undriven(given)
    return given


def refuse_repeated(recordings: Iterable[Recording]) -> None:
    """Refuse the same data twice, under any name, because that would narrow intervals."""
    first: dict[str, tuple[int, str]] = {}
    for k, recording in enumerate(recordings, 1):
        # Several blocks of a recording may contain the same rest.
        if not np.ptp(recording.q, axis=0).any():
            continue
        name = recording.name or "unnamed"
        before = first.setdefault(recording.digest(), (k, name))
        if before[0] != k:
            raise ValueError(
                f"a recording can be given only once, but recordings {before[0]} ({before[1]}) and "
                f"{k} ({name}) contain the same data; leave one out."
            )


def names_of(recordings: Sequence[Recording]) -> list[str]:
    """Names for messages; a recording without one is named by its number."""
    return [r.name or f"recording {k + 1}" for k, r in enumerate(recordings)]


def require_parts(recordings: Sequence[Recording], shortest: float) -> None:
    """Refuse a recording with many gaps and no part between them of this length [s]."""
    for name, recording in zip(names_of(recordings), recordings, strict=True):
        parts, count = recording.segments, len(gaps(recording.time))
        longest = max((recording.time[b] - recording.time[a] for a, b in parts), default=0.0)
        if count >= MINIMUM_SAMPLES and longest < shortest:
            raise ValueError(
                f"`time` of {name} has {count} gaps, and its longest part without one is "
                f"{longest:.3g} s, too short for a velocity (at least {shortest:g} s). If a logger "
                "stamps its rows in batches, give them even times, as `numpy.linspace(t[0], t[-1], "
                "len(t))`."
            )


def warn_of_undriven(recordings: Sequence[Recording]) -> None:
    """Warn of recordings without torque if others have it."""
    pairs = zip(names_of(recordings), recordings, strict=True)
    free = [name for name, recording in pairs if recording.tau is None]
    if 0 < len(free) < len(recordings):
        names = ", ".join(dict.fromkeys(free))
        # Not of the category that is silenced once recordings are read; one place, so shown once.
        warnings.warn(
            f"no torque is recorded in {names}, unlike in other recordings, so the joints "
            f"are taken to be undriven there; add the torque, or zeros if there was none.",
            stacklevel=1,
        )


def released(recordings: Sequence[Recording]) -> list[Recording]:
    """Recordings without torque, from the release of a mechanism that was held at first.

    Without torque a mechanism at rest stays at rest, so a hand or a brake held one that moves
    later, and no friction explains that rest.

    Warns:
        UserWarning: with the time of the release.
    """
    found = []
    for recording in recordings:
        first = release(recording)
        if first:
            time = recording.time[first] - recording.time[0]
            warnings.warn(
                f"{recording.name or 'a recording'} has no torque, and rests for {time:.3g} s "
                "before it moves, so it was held or pushed; it is used from its release.",
                stacklevel=1,
            )
        found.append(recording[first:] if first else recording)
    return found


def release(recording: Recording) -> int:
    """First sample after the release of a mechanism without torque that was held at first, or 0."""
    q, since = recording.q, recording.time - recording.time[0]
    extent = np.ptp(q, axis=0)
    # Joints whose encoder resolves the first part of the motion.
    seen = extent * RELEASED[0] > 2 * np.nan_to_num(count_seen(q))
    if (recording.tau is not None and recording.tau.any()) or not seen.any():
        return 0
    away = np.abs(q - q[0])[:, seen] / extent[seen]
    early, late = (since[(away >= share).argmax(0)] for share in RELEASED)
    # The joint that moves first. Its acceleration is constant at first, so that it takes twice the
    # time for four times the way.
    k = early.argmin()
    time = 2 * early[k] - late[k]
    first = int(np.searchsorted(since, time))
    error = 3 * recording.sample_time + (late[k] - early[k]) / 4
    rest = q[since < 0.8 * time]  # not yet the first motion, in spite of errors of the time
    if time <= error or len(rest) < 4 or len(recording) - first < MINIMUM_SAMPLES:
        return 0
    # Near an unstable equilibrium a joint leaves slowly, but not as from a rest.
    moves = np.ptp(rest, axis=0) > 2 * np.ptp(rest[: len(rest) // 2], axis=0)
    return 0 if moves.any() else first


def require_drive(law: Law, recordings: Sequence[Recording]) -> None:
    """Refuse recordings without torque for a law that reads the torque of the drive."""
    free = [r.name or "a recording" for r in recordings if r.tau is None]
    if free and law.reads_drive:
        raise ValueError(
            f"no torque is recorded in {', '.join(dict.fromkeys(free))}, and {law.name} reads the "
            "drive's torque; add tau or use dahl."
        )


def in_joint_coordinates(
    plant: Plant, recordings: Sequence[Recording], modelled: int
) -> list[Recording]:
    """The recordings in joint coordinates, checked against the joints of plant and model."""
    if not recordings:
        raise ValueError("at least one recording is needed to fit a model.")
    for recording in recordings:
        joints = recording.q.shape[1]
        if joints != plant.joints or joints != modelled:
            raise ValueError(
                f"recording, plant and model must have equally many joints, got {joints} in "
                f"{recording.name} (positions are columns q1, q2, ... or those that `columns` "
                f"names), {plant.joints} and {modelled}."
            )
    conventions = {str(r.resolve_convention(plant)) for r in recordings}
    # Residuals are formed in recorded coordinates, with one matrix for all windows.
    if len(conventions) > 1:
        raise ValueError(
            "recordings fitted together must share one angle convention, got "
            f"{' and '.join(sorted(conventions))}."
        )
    return [r.joint_coordinates(plant) for r in recordings]


def smoothed_motions(
    joint: Sequence[Recording], motions: Sequence[Motion] | None
) -> tuple[Motion, ...]:
    """The smoothed motion of each recording in joint coordinates; given ones must match."""
    if not motions:
        return tuple(kalman_smoother(r.time, r.q) for r in joint)
    if [len(m.q) for m in motions] != [len(r) for r in joint]:
        raise ValueError(
            f"`motions` must match the recordings sample by sample, got {len(motions)} of "
            f"{sum(len(m.q) for m in motions)} samples for {len(joint)} recordings of "
            f"{sum(map(len, joint))}; if omitted, they are computed."
        )
    return tuple(motions)


def largest_torques(joint: Sequence[Recording]) -> NDArray[np.float64]:
    """Largest torque of each joint over all recordings, (joint,) [N m; N]."""
    none = np.zeros_like(joint[0].q[0])
    return np.max([none if r.tau is None else np.abs(r.tau).max(0) for r in joint], axis=0)


def is_undriven_pendulum(plant: Plant, joint: Sequence[Recording]) -> bool:
    """True for a chain on a fixed pivot that moves under gravity without any torque."""
    fixed = isinstance(plant, PendulumChain) and not plant.first_link
    return fixed and weighs(plant) and not largest_torques(joint).any()


def weighs(plant: Plant) -> bool:
    """True for a chain whose gravity torque depends on its pose."""
    return isinstance(plant, PendulumChain) and has_weight(
        plant.gravity_moment, plant.inertia_coupling
    )


def adjustable_terms(
    plant: Plant,
    law: Law,
    joint: Sequence[Recording],
    options: FitOptions = DEFAULTS,
    *,
    eccentric: bool = False,
    per_recording: bool = False,
) -> list[PlantParameter]:
    """Terms of the plant that a fit adjusts; `drag=None` includes drag for undriven pendulums.

    No term repeats another parameter: no encoder offset if each recording has its own, no gear loss
    beside a law of the transmitted torque, no torque offset beside f_o. The torque's delay is last.
    """
    # Phases belong to the friction and delays to the log: they are fitted on any plant.
    others = position_terms(plant) if has_input(law, "position") else []
    others += [torque_delay_term(options)] if options.fit_delay else []
    if not options.fit_plant:
        return others
    largest = largest_torques(joint)
    # Over spans that are long compared with one encoder count.
    spans = [max(1, len(r) // 200) for r in joint]
    rates = [
        np.abs(r.q[k:] - r.q[:-k]) / (r.time[k:] - r.time[:-k])[:, None]
        for r, k in zip(joint, spans, strict=True)
    ]
    terms = plant_parameters(
        plant, driven=np.flatnonzero(largest).tolist(), largest_torque=float(largest.max()),
        largest_rate=max(float(rate.max()) for rate in rates),
        drag=is_undriven_pendulum(plant, joint) if options.drag is None else options.drag,
        eccentricity=eccentric, options=options,
    )  # fmt: skip
    if is_undriven_pendulum(plant, joint):
        # Its masses and lengths are often guesses, and no drive can cause the same errors.
        least, most = 1.0 / GUESSED - 1.0, GUESSED - 1.0
        terms = [replace(t, lower=least, upper=most) if t.ratio else t for t in terms]
    repeated = {"angle_offset": per_recording, "gear_loss": law.reads_drive,
                "torque_offset": "f_o" in law.names}  # fmt: skip
    return [t for t in terms if not any(repeated.get(name) for name in t.change)] + others


def advanced_torques(recordings: Sequence[Recording], delay: float) -> list[Recording]:
    """Recordings of equal length with the torque recorded `delay` [s] later; held at the ends."""
    if not delay:
        return list(recordings)
    return [r if r.tau is None else r._replace(tau=r.torque_at(r.time + delay)) for r in recordings]


def apply_encoder_offsets(
    offsets: Sequence[Sequence[float]],
    plant: Plant,
    recordings: Sequence[Recording],
    motions: Sequence[Motion],
) -> tuple[list[Recording], tuple[Motion, ...]]:
    """Recordings and motions as if their encoders had no offsets.

    `offsets` has one row per recording, empty for no change; motions are in joint coordinates.
    """
    if not offsets:
        return list(recordings), tuple(motions)
    matrix = measurement_matrix(plant, recordings[0].resolve_convention(plant)).numpy()
    rows = [np.array(row) for row in offsets]
    shifted = [r._replace(q=r.q + matrix @ row) for r, row in zip(recordings, rows, strict=True)]
    return shifted, tuple(replace(m, q=m.q + row) for m, row in zip(motions, rows, strict=True))


def measurement_matrix(plant: Plant, convention: AngleConvention) -> Tensor:
    """C of the measurement y = C q + const, (joint, joint): from joint to recorded coordinates."""
    unit = np.eye(plant.joints)
    return torch.as_tensor(convention.rate_from_joint(unit, plant.first_link).T.copy())


def integration_substeps(
    plant: Plant, model: FrictionModel, longest_step: float, options: FitOptions = DEFAULTS
) -> int:
    """Integration steps per sample of at most `longest_step` [s]."""
    needed = required_substeps(plant, model, longest_step)
    # Twice the present need, because coefficients may grow during the search.
    return min(1 if needed == 1 else 2 * needed, options.max_substeps)


def too_few_steps(
    plant: Plant, model: FrictionModel, longest_step: float, options: FitOptions = DEFAULTS
) -> tuple[str, ...]:
    """A warning if a sample near rest needs more integration steps than a fit takes."""
    needed, most = required_substeps(plant, model, longest_step), options.max_substeps
    wider = model.v_smooth * needed / most
    return (COARSE.format(needed, most, wider, model.v_smooth),) * (needed > most)


ZEROED_PER_RECORDING = (
    "Every recording begins at rest with all encoders at zero, so they are assumed to have been "
    "zeroed there, in an arbitrary pose; scores estimate it from the first second, which is not "
    'scored. If this is wrong: `encoder_reference="shared"`.'
)
SMOOTHED = (
    "Dry friction is smoothed over velocities of ±{:.2g} instead of ±{:.2g} {}/s, because a "
    "steeper sign needs more integration steps than a fit takes; this may cause errors above the "
    "noise. A model with a smaller `v_smooth`, or recordings with a higher sample rate, avoid "
    "them."
)
COARSE = (
    "Near rest a sample needs {} integration steps, fits take {}, so motion there is approximate; "
    "a higher sample rate avoids this, or a model with v_smooth >= {:.2g} (now {:.2g})."
)
# Largest factor between a guessed and the true inertia, gravity or length of a free rig.
GUESSED = 10.0
# Density of steel [kg/m^3].
STEEL = 7_850.0
# Bound of the error of angles after conversions.
ROUNDING = 1e-9


def looks_zeroed_per_recording(
    plant: Plant, recordings: Sequence[Recording], options: FitOptions = DEFAULTS
) -> bool:
    """True if encoders seem to have been set to zero at the start of each recording.

    Dry friction holds links wherever they stop. If a driven chain begins several recordings at rest
    and all its encoders read zero each time, they must have been set to zero.
    """
    driven = weighs(plant) and bool(largest_torques(recordings).any())
    at_zero = (
        begins_at_rest(r, options.rest_speed) and np.abs(r.q[0]).max() <= options.zero_reading
        for r in recordings
    )
    return driven and len(recordings) > 1 and all(at_zero)


def data_warnings(
    plant: Plant,
    given: Sequence[Recording],
    joint: Sequence[Recording],
    motions: Sequence[Motion],
    options: FitOptions = DEFAULTS,
) -> tuple[str, ...]:
    """Warnings about recordings as given and in joint coordinates, one sentence each."""
    still = _still_joints(plant, given, joint, options.min_counts)
    heavy = _implausible_masses(plant) if is_undriven_pendulum(plant, joint) else ()
    of_logs = (
        *_unlike_clocks(given, options), *_spikes(given, options),
        *_held_torques(given), *_velocities(joint, motions), *finer_counts(plant, given),
    )  # fmt: skip
    return (*of_logs, *still, *heavy)


def finer_counts(plant: Plant, given: Sequence[Recording]) -> Iterator[str]:
    """Positions that change by less than the encoder count of the rig or of other recordings."""
    counts = np.array([count_seen(r.q) for r in given])
    coarsest = np.fmax.reduce(counts)
    seen = float(np.fmax.reduce(coarsest))
    # The usual factors are at least 2: both edges of a pulse, quadrature, a gear, a unit.
    if plant.position_quantum is not None and 1.5 * seen < plant.position_quantum:
        yield (
            f"Positions change by {seen:.3g} {plant.unit}, less than the `position_quantum` of "
            f"{plant.position_quantum:.3g}; give one count as motion of the joint, after any gear."
        )
    for k, j in np.argwhere(1.5 * counts < coarsest):
        yield (
            f"{plant.joint_names[j]} changes by {counts[k, j]:.3g} {plant.unit} in "
            f"{given[k].name or 'a recording'}, by at least {coarsest[j]:.3g} in another: with the "
            "same encoder one of the two is in a wrong unit; read each recording with its own."
        )


def require_elementwise(law: Law, joints: int) -> None:
    """Raise ValueError unless the torque is elementwise and consists of torch operations."""
    qd = torch.linspace(-1.5, 2.0, 3 * joints, dtype=torch.float64).reshape(3, joints)
    coefficients = torch.full((*qd.shape, len(law.names)), 0.5, dtype=torch.float64)
    rule = (
        f"the torque of law {law.name!r} must be an elementwise function of torch operations, of "
        "velocity and load (*batch, joint) and coefficients (*batch, joint, coefficient)"
    )

    def torque(rows: slice, qd: Tensor = qd) -> Tensor:
        return law.torque(qd[rows], torch.ones_like(qd[rows]), coefficients[rows], 1e-3)

    try:
        # Neither copies in NumPy nor changes in place pass.
        qd.requires_grad_()
        coefficients.requires_grad_()
        with torch.enable_grad():
            whole = torque(slice(None))
            torch.autograd.grad(whole.sum(), coefficients)
        alone = torch.cat([torque(slice(k, k + 1)) for k in range(len(qd))])
        others = torque(slice(None), qd + torch.eye(1, joints))[..., 1:]
    except (ArithmeticError, AssertionError, AttributeError, LookupError, RuntimeError, TypeError,
            ValueError) as error:  # fmt: skip
        raise ValueError(f"{rule}; it fails: {error}") from error
    if whole.shape != qd.shape:
        raise ValueError(f"{rule}; it gives shape {tuple(whole.shape)} for {tuple(qd.shape)}.")
    if not torch.allclose(whole, alone, equal_nan=True):
        raise ValueError(f"{rule}; its values for one sample depend on the other samples.")
    if not torch.allclose(whole[..., 1:], others, equal_nan=True):
        raise ValueError(f"{rule}; its values for one joint depend on the first joint.")


def require_motion(plant: Plant, joint: Sequence[Recording]) -> None:
    """Raise a ValueError that names joints which never move: no network can follow them."""
    still = [plant.joint_names[j] for j in np.flatnonzero(ranges(joint) == 0)]
    if still:
        raise ValueError(
            f"{', '.join(still)} never moves in {', '.join(r.name or 'a recording' for r in joint)}"
            ", but neuro-fuzzy coefficients follow the motion; record it moving."
        )


def ranges(joint: Sequence[Recording] | Sequence[Motion]) -> Array:
    """Range of each joint in the recording in which it moves most, (joint,)."""
    ranges = np.max([np.ptp(r.q, axis=0) for r in joint], axis=0)
    # The difference of two absolute angles that turn together is only rounding.
    largest = max(float(np.abs(r.q).max()) for r in joint)
    return np.where(ranges > ROUNDING * largest, ranges, 0.0)


def _still_joints(
    plant: Plant, given: Sequence[Recording], joint: Sequence[Recording], min_counts: int
) -> Iterator[str]:
    # A joint without a visible count is not compared with one.
    seen, known = np.fmin.reduce([count_seen(r.q) for r in given]), plant.position_quantum
    count = seen if known is None else np.full(plant.joints, known)
    for name, extent, one in zip(plant.joint_names, ranges(joint), count, strict=True):
        if extent == 0:
            yield (
                f"{name} never moves: its friction is not observable. If a brake holds it, use a "
                "rig in which its link is fixed, because simulations let it move."
            )
        elif extent < min_counts * one:
            yield (
                f"{name} moves by {extent:.3g} {plant.unit}, {extent / one:.0f} of its encoder's "
                "counts: its friction is hardly observable."
            )


def _unlike_clocks(recordings: Sequence[Recording], options: FitOptions) -> Iterator[str]:
    """Recordings whose uniform steps differ by less than deliberately chosen rates would."""
    even = sorted((r for r in recordings if r.is_uniform), key=lambda r: r.sample_time)
    for fast, slow in pairwise(even):
        apart = slow.sample_time / fast.sample_time - 1
        if options.clock_error[0] < apart < options.clock_error[1]:
            yield (
                f"{slow.name or 'A recording'} has a sample every {1e3 * slow.sample_time:.6g} ms, "
                f"{fast.name or 'another'} every {1e3 * fast.sample_time:.6g} ms: if one logger "
                f"wrote both, one of the two steps is wrong by {100 * apart:.2g} %, and inertia "
                "and friction by up to twice that; give both the step of the logger."
            )


def _spikes(recordings: Sequence[Recording], options: FitOptions) -> Iterator[str]:
    """Single samples of positions and torques far from both neighbours, on the same side."""
    remedies = (
        "such spikes are errors of the sensor, leave these samples out",
        "if these are errors of the log, interpolate them: a simulation adds them up, whatever the "
        "loss",
    )
    for recording in recordings:
        kinds = ("", recording.q, 0.01), ("the torque of ", recording.tau, 0.05)
        for (what, x, share), remedy in zip(kinds, remedies, strict=True):
            if x is None:
                continue
            far, _ = _far_samples(x, options, share)
            for name, peak in zip(recording.names, far.T, strict=True):
                if peak.any():
                    yield (
                        f"{recording.name or 'A recording'}: {what}{name} jumps for one sample at "
                        f"{_times(recording.time[1:-1][peak])}; {remedy}."
                    )


def lasting_jumps(recordings: Sequence[Recording], options: FitOptions) -> Iterator[str]:
    """Steps of a position far above both adjacent steps, which are similar."""
    for recording in recordings:
        time, heights = recording.time, []
        _, least = _far_samples(recording.q, options, 0.01)
        # Across a gap any step is possible.
        steps, periods = np.diff(recording.q, axis=0), np.diff(time)[:, None]
        steps[gaps(time)] = np.nan
        even = steps * recording.sample_time / periods
        # Also if scaled to equal length, by the stamps or by the number of rows in between: samples
        # or their stamps may jitter, and rows with a missing cell are left out.
        rows = np.fmax(1, np.rint(periods / recording.sample_time))
        for step in (steps, even, steps / rows):
            before, at, after = step[:-2], step[1:-1], step[2:]
            high = np.minimum(np.abs(at - before), np.abs(at - after))
            heights.append(np.where(2 * np.abs(after - before) <= high, high, 0.0))
        # The step after a late sample is long, and both together are as usual.
        both = (steps[:-2] + steps[1:-1]) * recording.sample_time / (periods[:-2] + periods[1:-1])
        height = np.where(2 * np.abs(both - even[2:]) > least, np.minimum.reduce(heights), 0.0)
        for name, jump, high in zip(recording.names, (height > least).T, height.T, strict=True):
            if not jump.any():
                continue
            cause = "samples are missing without a gap in time, or the encoder lost counts or froze"
            remedy = "give samples their own times, or cut the recording there"
            # Two jumps by the same amount are not chance.
            if jump.sum() > 1 and np.ptp(high[jump]) < ALIKE * high[jump].mean():
                cause = f"a counter overflows, after {high[jump].mean():.3g} {recording.unit} each"
                remedy = "unwrap its column, as `numpy.unwrap(counts, period=65536)` does"
            where = f"{name} of {recording.name or 'a recording'} jumps"
            yield f"{where} for good at {_times(time[2:-1][jump])}: {cause}; {remedy}."


def _far_samples(x: Array, options: FitOptions, most: float) -> tuple[NDArray[np.bool_], Array]:
    """True where an inner sample is far from both neighbours, and the least such distance.

    At most a share `most` of the curvatures may be of spikes.
    """
    before, after = x[1:-1] - x[:-2], x[1:-1] - x[2:]
    near, other = np.sort(np.abs([before, after]), axis=0)
    # Where a motion turns sharply, as from rest, the steps beside are as large.
    steps = np.abs(np.pad(np.diff(x, axis=0), ((1, 1), (0, 0))))
    alone = near > np.maximum(steps[:-3], steps[3:])
    # Steps, as at a gap in time, and samples next to a spike are far from only one neighbour.
    height = np.where((before * after > 0) & (2 * near > other) & alone, near, 0.0)
    curved = np.quantile(np.abs(before + after) / 2, 1 - most, axis=0)
    # A joint may show no count.
    least = options.spike_ratio * np.fmax(curved, count_seen(x))
    return height > least, least


def _held_torques(recordings: Sequence[Recording]) -> Iterator[str]:
    """Torques with noise that hold a nonzero value of a moving joint for longer than by chance.

    A drive that is off may be logged as 0. Without noise a torque is a command, which may be held,
    as is that of a controller while the encoder shows no motion.
    """
    for recording in recordings:
        if recording.tau is None:
            continue
        columns = zip(recording.names, recording.tau.T, recording.q.T, strict=True)
        for name, torque, q in columns:
            edges = np.flatnonzero(np.diff(torque, prepend=np.nan, append=np.nan))
            value, length = torque[edges[:-1]], np.diff(edges)
            # Differences of a smooth signal shrink with their order, those of noise grow.
            first, third = (np.abs(np.diff(value, n=n)) for n in (1, 3))
            if len(third) < MINIMUM_SAMPLES or np.median(third) < np.median(first):
                continue
            of = f"{recording.name or 'A recording'}: the torque of {name}"
            if (step := float(np.median(first))) < 1.5 * count_seen(torque[:, None])[0]:
                yield (
                    f"{of} has steps of {step:.3g}, larger than its noise; simulations err by more "
                    "than that noise explains."
                )
                continue
            usual = length[length < MINIMUM_SAMPLES]
            same = (usual.sum() - len(usual)) / max(usual.sum(), 1)
            chance = math.log(UNLIKELY / len(torque)) / math.log(same) if same else 0
            count = np.nan_to_num(count_seen(q[:, None]))
            turned = np.abs(q[edges[1:] - 1] - q[edges[:-1]]) > 2 * count
            held = (length > max(MINIMUM_SAMPLES, chance)) & (value != 0) & turned
            share = length[held].sum() / len(torque)
            if share < FEW:
                continue
            ends = {*value[held].tolist()} & {float(torque.min()), float(torque.max())}
            limits = " and ".join(f"{x:.3g}" for x in sorted(ends))
            where = f" at {limits}" if ends else f" from {_times(recording.time[edges[:-1]][held])}"
            yield (
                f"{of} has noise, but does not change in {100 * share:.2g} % of the "
                f"samples,{where}: its sensor is clipped or stuck; leave these samples out."
            )


def _velocities(joint: Sequence[Recording], motions: Sequence[Motion]) -> Iterator[str]:
    """Measured velocities that are not the derivative of the positions."""
    for recording, motion in zip(joint, motions, strict=True):
        if recording.qd is None or len(motion.qd) != len(recording):
            continue
        columns = zip(recording.names, motion.qd.T, recording.qd.T, strict=True)
        for name, derived, measured in columns:
            square, product = derived @ derived, derived @ measured
            ratio = product / square if square > 0 else 1.0
            # Noise of a joint at rest is not proportional to its velocity.
            proportional = product**2 > 0.5 * square * (measured @ measured)
            # As for counts: filters change less, units and signs more.
            if proportional and not 1 / 1.5 <= ratio <= 1.5:
                yield (
                    f"{recording.name or 'A recording'}: the velocity of {name} is {ratio:.3g} "
                    "times the derivative of its position; check units and signs of both (fits use "
                    "only the position)."
                )


def _times(found: Array) -> str:
    """The first three times [s], and how many more there are."""
    more = f" and {len(found) - 3} more" if len(found) > 3 else ""
    return ", ".join(f"{t:.6g}" for t in found[:3]) + f" s{more}"


def _implausible_masses(plant: Plant) -> Iterator[str]:
    """Warn of masses that look like g; a free swing shows only their ratios."""
    data = plant.to_dict()
    if "length" not in data:
        return  # a rotor: its size is not known
    for k, (mass, length) in enumerate(zip(data["mass"], data["length"], strict=True)):
        if mass > STEEL * length**3:
            yield (
                f"Link {k + 1} of {mass:g} kg and {length:g} m would be heavier than a cube of "
                "steel of that length; a free swing does not show the scale of masses, so if they "
                "are in g, friction is too large by the same factor."
            )

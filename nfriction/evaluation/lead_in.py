"""Simulations of a recording's parts, each from a state estimated just before the scored samples.

A scored simulation begins one *lead-in* early, with the state from which the model itself follows
the lead-in best. No scored sample influences this state, so the score measures the prediction from
past samples only.
"""

import logging
import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from nfriction.fitting.data.inputs import require_drive
from nfriction.fitting.data.windows import begins_at_rest
from nfriction.fitting.options import DEFAULTS
from nfriction.fitting.shooting.autocorrelation import white_noise
from nfriction.friction.memory import deflections, holding_share, load_of
from nfriction.friction.models import FrictionModel
from nfriction.io.model_file import require_model
from nfriction.plant import Plant
from nfriction.recording import Array, Recording
from nfriction.signals import causal_motion, count_seen
from nfriction.simulation.rollout import Scheme, rollout
from nfriction.simulation.validate import required_substeps

logger = logging.getLogger(__name__)

LEAD_IN = 0.2
"""Length of the lead-in [s].

The slope at the end of a line through N positions that are rounded to counts has a standard
deviation of one count over LEAD_IN sqrt(N): with 0.2 s at 500 Hz half a count per second, so that
the error of 1 s windows is hardly more than the rounding. An acceleration that a model lacks biases
the velocity at the end by LEAD_IN / 2 times that acceleration, which adds a fifth of the model's
own error to 1 s windows, and less to longer ones; a longer lead-in would add more.
"""
ZERO_IN = 1.0
"""Time over which the zero of encoders that were zeroed for one recording is estimated [s].

Gravity reveals the zero, but torques that the model lacks disturb it. Those of friction change sign
with the velocity and cancel once the joints have turned both ways; over 0.2 s they do not.
"""
FEWEST = 8  # samples
# Friction that needs more integration steps per sample than this is practically a step: scoring it
# would take minutes, and the search that found it has failed anyway.
MOST_SUBSTEPS = 100
# Initial states drawn for the limit, each with noise of the torque. The true state is one more such
# draw, so that its error is below the largest of theirs in 39 of 40 cases.
DRAWS = 39
# Samples simulated together, over all draws: many draws of a long recording take much memory.
DRAWN_SAMPLES = 2**20
# Filters of a controller's velocity and acceleration [Hz].
CUTOFF = 20.0
# The time-stepping scheme is of first order: such steps keep its error below an encoder's [s].
STOP_STEP = 2e-4
# Iterations of Gauss-Newton, and the change of the state, in standard deviations, that ends them.
MOST_STEPS = 8
SMALL = 0.05
# Iterations that shrink deviations which a lead-in contradicts.
DRAWN_CLOSER = 3
# Fractions of a Gauss-Newton step to try; 0 if no other is better.
SHARES = np.array([1.0, 0.5, 0.2, 0.05, 0.0])


def lead_in_samples(recording: Recording) -> int:
    """Samples of a lead-in: of 0.2 s, and at least 8."""
    return max(FEWEST, round(LEAD_IN / recording.sample_time))


def longest_window(recording: Recording) -> float:
    """Duration of the longest segment without a gap, excluding its lead-in [s]."""
    lead, time = lead_in_samples(recording), recording.time
    return max(
        float(time[last] - time[min(first + lead, last)]) for first, last in recording.segments
    )


@dataclass(frozen=True)
class Starts:
    """States at the first samples of lead-ins, with their uncertainty."""

    state: Array  # position and velocity in the recording's coordinates, (window, 2 joint)
    root: Array  # of the states' covariance root @ root.T, (window, 2 joint, 2 joint)
    noise: Array  # standard deviation of a measured position, (window, joint)
    deviations: Array  # random errors of the states, (draw, window, 2 joint); the same every time


@dataclass(frozen=True)
class Runs:
    """Simulations over windows of equal length, in the recording's coordinates."""

    samples: NDArray[np.intp]  # of the recording, (window, sample)
    q: Array  # positions, (window, sample, joint)
    error: Array  # of those that are scored, (window, scored sample, joint)
    squares: Array  # mean square error from each start that the lead-in allows, (draw, joint)
    diverged_at: float  # time of the first divergence [s]


class Simulator:
    """Simulates parts of a recording, driven by its torques; all in the recording's coordinates."""

    def __init__(
        self,
        plant: Plant,
        friction: FrictionModel | None,
        recording: Recording,
        scheme: Scheme,
        draws: int,
        zero: "Zero | None" = None,
    ) -> None:
        """Check and prepare; the time from which a `zero` was estimated is not scored."""
        if friction is not None:
            require_model(friction)
            if friction.joints != plant.joints:
                raise ValueError(
                    f"the plant has {plant.joints} joints, the friction model {friction.joints}; "
                    f"make the model with joints={plant.joints}."
                )
            require_drive(friction.law, [recording])
        self.plant, self.friction, self.recording = plant, friction, recording
        self.scheme, self.draws = scheme, draws
        self.convention = recording.resolve_convention(plant)
        self.lead = lead_in_samples(recording)
        # From zero, so that no window loses its last sample to the rounding of large time stamps.
        self.time = recording.time - recording.time[0]
        self.unscored = 0 if zero is None else int(np.searchsorted(self.time, ZERO_IN))
        self.substeps: int | None = math.ceil(recording.longest_step / STOP_STEP)
        if scheme != "time_stepping":
            self.substeps = _substeps(plant, friction, recording)
        # One count of each encoder, 0 where neither plant nor recording show it.
        self.quantum = np.nan_to_num(count_seen(recording.q))
        if plant.position_quantum is not None:
            self.quantum = np.full(plant.joints, plant.position_quantum)
        self.torque_sd = torch.zeros(plant.joints, dtype=torch.float64)
        if recording.tau is not None:
            self.torque_sd = white_noise(torch.tensor(recording.tau)[None])
        # Random errors of the zero, (draw, window, joint).
        self.zeros = np.zeros((draws, 1, plant.joints))
        if zero is not None:
            normal = np.random.default_rng([0, 2]).standard_normal(self.zeros.shape)
            self.zeros = normal @ zero.root.T
        self.states: torch.Tensor | None = None
        self.law_states: torch.Tensor | None = None
        # Hidden states as of a controller at every sample, from which windows continue.
        if friction is not None and (friction.state_size or friction.law.memory):
            joint, quantum = recording.joint_coordinates(plant), plant.position_quantum
            counts = math.tau / (quantum or np.finfo(np.float64).eps)
            cutoff = min(CUTOFF, 0.2 / joint.sample_time)
            motion = causal_motion(joint.time, joint.q, counts, cutoff)
            q, qd, qdd = (torch.tensor(x) for x in (motion.q, motion.qd, motion.qdd))
            if friction.state_size:
                self.states = friction.schedule.states(qd, qdd, torch.tensor(self.time))
            if friction.law.memory:
                time = torch.tensor(self.time)
                tau = torch.zeros_like(q) if recording.tau is None else torch.tensor(recording.tau)
                load = load_of(friction.law, plant, q, qd, tau)
                start, still = None, torch.zeros_like(q[0])
                if np.all(np.ptp(recording.q[: self.lead], axis=0) <= 1.5 * self.quantum):
                    # Joints that rest are held by their friction, in balance with the torques.
                    held = tau[0] - plant.inverse_dynamics(q[0], still, still)
                    share, slipping = holding_share(friction, held)
                    start = share[..., None] * slipping
                self.law_states, _ = deflections(friction, time, qd, qdd, load, start)

    def free_runs(self, initial_state: tuple[Array, Array] | None) -> list[Runs]:
        """One run of each segment that is longer than a lead-in."""
        runs, given = [], None
        if initial_state is not None:
            _require_joints(self.plant, initial_state)
            given = np.concatenate(initial_state)[None]
        for first, last in self.recording.segments:
            if last - first >= self.lead and last > self.unscored:
                state = given if first == 0 else None
                runs.append(self._score(np.arange(first, last + 1)[None], state))
        return runs

    def windows(self, horizon: float) -> Runs | None:
        """Runs over consecutive windows, the first after the first lead-in."""
        starts: list[int] = []
        length = len(self.time)
        for first, last in self.recording.segments:
            first = max(first + self.lead, self.unscored)
            if first >= last:
                continue
            stamps = self.time[first : last + 1] - self.time[first]
            # A segment too short for a whole number of windows by less than a twentieth of one,
            # such as because of its lead-in, still gives that number.
            count = int(stamps[-1] / horizon + 0.05)
            width = min(horizon, stamps[-1] / max(count, 1))
            edges = first + np.searchsorted(stamps, width * np.arange(count + 1) - 1e-9)
            starts += edges[:-1].tolist()
            length = min([length, *np.diff(edges).tolist()])
        if not starts or length < 1:
            return None
        return self._score(np.array(starts)[:, None] + np.arange(-self.lead, length + 1))

    def _score(self, samples: NDArray[np.intp], state: Array | None = None) -> Runs:
        """Simulate windows of samples (window, sample), each beginning with its lead-in.

        From a given state (1, 2 joint) all samples except the first `unscored` seconds are scored.
        """
        lead_in = samples[:, : self.lead]
        measured = self.recording.q[samples]
        starts = estimate_starts(
            lambda states: self.simulate(states, lead_in)[0],
            self.time[lead_in], measured[:, : self.lead], self.quantum, self.draws,
        )  # fmt: skip
        scored = slice(self.lead if state is None else self.unscored, None)
        state = starts.state if state is None else state
        q, diverged_at = self.simulate(state, samples)
        squares = np.full((self.draws, self.plant.joints), np.inf)
        at_once = max(1, DRAWN_SAMPLES // samples.size)
        # Where the run itself diverged there is no limit.
        unit = np.where(self.quantum > 0, self.quantum, 1.0)
        for k in range(0, self.draws if np.isinf(diverged_at).all() else 0, at_once):
            zero = self.zeros[k : k + at_once]
            off = starts.deviations[k : k + at_once] + np.concatenate([zero, 0 * zero], -1)
            drawn, _ = self.simulate(state + off, samples, noise=k)
            drawn = drawn - zero[:, :, None]
            # As the encoder reads positions, its counts in line with the measured ones.
            read = measured + unit * np.rint((drawn - measured) / unit)
            apart = (np.where(self.quantum > 0, read, drawn) - q)[:, :, scored]
            squares[k : k + at_once] = np.mean(apart**2, axis=(1, 2))
        # Noise of the measured position in excess of its rounding.
        squares += np.mean(np.maximum(starts.noise**2 - self.quantum**2 / 12, 0.0), axis=0)
        if self.draws and np.isfinite(squares).all():
            finer, _ = self.simulate(state, samples, finer=2)
            squares += np.mean((finer - q)[:, scored] ** 2, axis=(0, 1))
        return Runs(
            samples, q, (q - measured)[:, scored], squares,
            float((self.time[samples[:, 0]] + diverged_at).min()),
        )  # fmt: skip

    def simulate(
        self, states: Array, samples: NDArray[np.intp], noise: int | None = None, finer: int = 1
    ) -> tuple[Array, Array]:
        """Positions (*batch, window, sample, joint), and when they diverged (*batch, window).

        Args:
            states: positions and velocities at the first samples, (*batch, window, 2 joint).
            samples: (window, sample).
            noise: seed of noise that is added to the torque, as large as the recorded one; None
                for no noise.
            finer: factor on the number of integration steps per sample.
        """
        joints, first_link = self.plant.joints, self.plant.first_link
        if self.substeps is None:
            lost = np.full((*states.shape[:-1], samples.shape[-1], joints), np.nan)
            return lost, np.zeros(states.shape[:-1])
        q0 = self.convention.position_to_joint(states[..., :joints], first_link)
        qd0 = self.convention.rate_to_joint(states[..., joints:], first_link)
        # Copies, because a recording's arrays are read-only, which tensors cannot be.
        held = samples[:, :-1]
        tau = None if self.recording.tau is None else torch.tensor(self.recording.tau[held])
        if tau is not None and noise is not None:
            random = np.random.default_rng([noise, 1])
            shape = (*states.shape[:-1], *tau.shape[1:])
            tau = tau + self.torque_sd * torch.tensor(random.standard_normal(shape))
        step = torch.tensor(np.diff(self.time)[held])
        memory, law_state = (
            None if x is None else x[samples[:, 0]] for x in (self.states, self.law_states)
        )
        with torch.no_grad():
            run = rollout(
                self.plant, self.friction, torch.tensor(q0), torch.tensor(qd0), tau,
                sample_time=step, substeps=finer * self.substeps, scheme=self.scheme,
                hidden_state=memory, law_state=law_state,
            )  # fmt: skip
        q = self.convention.position_from_joint(run.q.numpy(), first_link)
        return q, run.diverged_at.numpy()


def _require_joints(plant: Plant, state: tuple[Array, Array]) -> None:
    if [np.shape(part) for part in state] != [(plant.joints,)] * 2:
        raise ValueError(
            f"`initial_state` must be q0 and qd0 of shape ({plant.joints},) each, got {state!r}."
        )


@dataclass(frozen=True)
class Zero:
    """Zero of a recording's encoders.

    Attributes:
        offset: to be added to its positions, (joint,).
        root: of its covariance root @ root.T due to position noise, (joint, joint).
    """

    offset: Array
    root: Array


def with_own_zero(
    plant: Plant,
    friction: FrictionModel | None,
    recording: Recording,
    state: tuple[Array, Array] | None,
) -> tuple[Recording, tuple[Array, Array] | None, Zero | None]:
    """A recording and its initial state with its encoders' zero added, and that zero.

    For encoders that were set to zero at the start, at rest in a pose held by stiction. A recording
    that begins otherwise, has a gap before `ZERO_IN`, or is too short to be scored after it, is
    returned unchanged. Without a state it begins at rest.
    """
    if state is not None:
        _require_joints(plant, state)
    at_zero = np.abs(recording.q[0]).max() <= DEFAULTS.zero_reading
    time = recording.time - recording.time[0]
    short = time[-1] < 2 * ZERO_IN or time[recording.segments[0][1]] < ZERO_IN
    if short or not (at_zero and begins_at_rest(recording, DEFAULTS.rest_speed)):
        return recording, state, None
    q0, qd0 = state or (recording.q[0], np.zeros(plant.joints))
    zero = estimate_zero(plant, friction, recording, (q0, qd0))
    return recording._replace(q=recording.q + zero.offset), (q0 + zero.offset, qd0), zero


def estimate_zero(
    plant: Plant, friction: FrictionModel | None, recording: Recording, state: tuple[Array, Array]
) -> Zero:
    """Zero of a recording's encoders.

    By Gauss-Newton on the errors of a simulation of the first `ZERO_IN` seconds from a recorded
    position and velocity, (joint,) each. The prior is that of `FitOptions.encoder_offset_sd`.
    """
    simulator = Simulator(plant, friction, recording, "rk4", 0)
    samples = np.arange(np.searchsorted(simulator.time, ZERO_IN) + 1)[None]
    joints, sd = plant.joints, DEFAULTS.encoder_offset_sd

    def error(zero: Array) -> Array:
        begin = np.concatenate([state[0] + zero, np.broadcast_to(state[1], zero.shape)], -1)
        q, _ = simulator.simulate(begin[..., None, :], samples)
        return (q - zero[..., None, None, :] - recording.q[samples])[..., 0, :, :]

    zero, root = np.zeros(joints), sd * np.eye(joints)
    nudges = 0.1 * sd * np.eye(joints)
    for _ in range(MOST_STEPS):
        now, ahead, back = error(zero), error(zero + nudges), error(zero - nudges)
        if not all(np.isfinite(x).all() for x in (now, ahead, back)):
            break
        slopes = (ahead - back) / (0.2 * sd)
        # The prior matters only for a joint that gravity does not load.
        weight = 1 / max(float(np.mean(now**2)), DEFAULTS.min_noise**2)
        data = weight * np.einsum("akj,bkj->ab", slopes, slopes)
        prior = np.eye(joints) / sd**2
        gradient = weight * np.einsum("akj,kj->a", slopes, now) + zero / sd**2
        # From noise alone: errors in the zero that the model causes count as the model's.
        noise = white_noise(torch.tensor(now)[None]).numpy().clip(DEFAULTS.min_noise)
        known = np.einsum("akj,bkj->ab", slopes / noise, slopes / noise)
        root = np.linalg.cholesky(np.linalg.inv(known + prior))
        step = -np.linalg.solve(data + prior, gradient)
        trials = zero + SHARES[:, None] * step
        cost = weight * np.sum(error(trials) ** 2, axis=(1, 2))
        cost += np.sum((trials / sd) ** 2, axis=-1)
        zero = trials[np.where(np.isfinite(cost), cost, np.inf).argmin()]
        if -gradient @ step < SMALL**2:
            break
    return Zero(zero, root)


def estimate_starts(
    simulate: Callable[[Array], Array],
    time: Array,
    y: Array,
    quantum: float | Array = 0.0,
    draws: int = 0,
) -> Starts:
    """States from which simulations follow the measured positions of lead-ins best.

    Gauss-Newton on the squared errors, weighted by the sensor's noise, with the kinematic estimate
    from a cubic through the lead-in as a weak prior, because friction may stop a joint so soon that
    the motion does not depend on its velocity. `simulate` gives positions (*batch, window, sample,
    joint) from states (*batch, window, 2 joint); `quantum` is one count of the encoders, 0 where
    unknown.
    """
    count = y.shape[1]
    time = time - time[:, :1]
    noise = _noise(y, quantum)
    # Samples within one count of the encoder share their rounding error.
    distinct = (1 + np.count_nonzero(np.diff(y, axis=1), axis=1)) / count
    weight = distinct / noise**2
    kinematic, prior = _cubic(time, y, noise, distinct)
    # Finite differences over steps as large as the noise average friction as the motion does.
    nudge = noise[:, None, :] / np.stack([np.ones(len(y)), time[:, -1]], 1)[..., None]
    nudge = nudge.reshape(kinematic.shape)
    state, run = kinematic, simulate(kinematic)
    if not np.isfinite(run).all(axis=(1, 2)).any():
        # Every simulation is lost within its lead-in, whatever its start.
        root = np.linalg.cholesky(np.linalg.inv(prior))
        return Starts(state, root, noise, np.zeros((draws, *state.shape)))
    for _ in range(MOST_STEPS):
        gradient, information = _linearised(simulate, state, nudge, y - run, weight)
        gradient += (prior @ (kinematic - state)[..., None])[..., 0]
        information += prior
        step = np.linalg.solve(information, gradient[..., None])[..., 0]
        trials = state + SHARES[:, None, None] * step
        runs = simulate(trials)
        away = trials - kinematic
        cost = np.einsum("swkj,wj->sw", (y - runs) ** 2, weight)
        cost += np.einsum("swa,wab,swb->sw", away, prior, away)
        best = np.where(np.isfinite(cost), cost, np.inf).argmin(0), np.arange(len(y))
        state, run = trials[best], runs[best]
        if np.all(np.sum(gradient * step, axis=-1) < SMALL**2):
            break
    # A model that misfits the lead-in knows its state less well than the encoder would allow.
    misfit = np.nan_to_num(np.mean(((y - run) / noise[:, None]) ** 2, axis=(1, 2)), nan=1.0)
    excess = np.sqrt(np.maximum(misfit, 1.0))[:, None]
    root = np.linalg.cholesky(np.linalg.inv(information)) * excess[..., None]
    normal = np.random.default_rng(0).standard_normal((draws, *state.shape))
    deviations = (root @ normal[..., None])[..., 0]
    allowed = np.sum((excess * normal) ** 2, axis=-1)
    for _ in range(DRAWN_CLOSER if draws else 0):
        # If friction holds a joint, the derivatives vanish, and the covariance is too large.
        apart = simulate(state + deviations) - run
        seen = np.einsum("swkj,wj->sw", np.nan_to_num(apart) ** 2, weight)
        deviations *= np.sqrt(allowed / np.maximum(seen, allowed))[..., None]
    return Starts(state, root, noise, deviations)


def _linearised(
    simulate: Callable[[Array], Array], state: Array, nudge: Array, error: Array, weight: Array
) -> tuple[Array, Array]:
    """Gradient and Gauss-Newton matrix of half the squared errors, by central differences."""
    nudges = np.eye(state.shape[-1])[:, None, :] * nudge
    ahead, back = simulate(state + np.stack([nudges, -nudges]))
    slopes = (ahead - back) / (2 * nudge.T[..., None, None])
    # A simulation that diverges says nothing.
    slopes, error = np.nan_to_num(slopes), np.nan_to_num(error)
    gradient = np.einsum("awkj,wj,wkj->wa", slopes, weight, error)
    return gradient, np.einsum("awkj,wj,bwkj->wab", slopes, weight, slopes)


def _cubic(time: Array, y: Array, noise: Array, distinct: Array) -> tuple[Array, Array]:
    """First state of a cubic through each window, and the inverse of its covariance."""
    span = time[:, -1:]
    basis = (time / span)[..., None] ** np.arange(4)
    inverse = np.linalg.pinv(basis)
    coefficients = inverse @ y
    misfit = np.mean((y - basis @ coefficients) ** 2, axis=1)
    inverse = inverse[:, :2] / np.stack([np.ones_like(span), span], 1)
    precision = np.linalg.inv(inverse @ inverse.swapaxes(-1, -2))
    joints = y.shape[-1]
    # Deviations of the motion from a cubic are correlated over all samples, unlike noise.
    by_joint = 1 / (noise**2 / distinct + y.shape[1] * np.maximum(misfit - noise**2, 0.0))
    whole = np.einsum("wab,wj,jk->wajbk", precision, by_joint, np.eye(joints))
    state = np.concatenate([coefficients[:, 0], coefficients[:, 1] / span], -1)
    return state, whole.reshape(len(y), 2 * joints, 2 * joints)


def _noise(y: Array, quantum: float | Array) -> Array:
    """Standard deviation of a measured position, (window, joint), at least the rounding error."""
    # Fourth differences show noise but no smooth motion; the squares of their weights sum to 70.
    seen = np.sqrt(np.mean(np.diff(y, n=4, axis=1) ** 2, axis=1) / 70)
    # Joints at rest show none: they get that of the others.
    seen = np.where(seen > 0, seen, seen.max(axis=-1, keepdims=True))
    least = quantum / math.sqrt(12)
    return np.maximum(seen, np.maximum(least, 1e-12 * np.maximum(np.abs(y).max(axis=1), 1.0)))


def _substeps(plant: Plant, friction: FrictionModel | None, recording: Recording) -> int | None:
    # None where friction is too steep to be simulated.
    if friction is None:
        return 1
    longest = recording.longest_step
    if torch.isfinite(friction.zero_velocity_damping()).all():
        needed = required_substeps(plant, friction, longest)
        if needed <= MOST_SUBSTEPS:
            return needed
        found = f"needs {needed} integration steps in the longest sample of {longest:g} s"
    else:
        found = "has no finite slope"
    logger.warning(
        "%s: friction %s at rest (limit: %d); scored as diverged. A larger `v_smooth` makes it "
        "less steep.", recording.name, found, MOST_SUBSTEPS,
    )  # fmt: skip
    return None

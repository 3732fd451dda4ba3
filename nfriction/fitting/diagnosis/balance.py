"""The balance of torques: those of the motion against those of drive and friction."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from nfriction.fitting.adjusted_plant import PlantParameter, adjusted_buffers
from nfriction.fitting.options import FitOptions
from nfriction.fitting.plant_parameters import plant_parameters
from nfriction.fitting.result.identifiability import NORMAL_95
from nfriction.plant import Plant
from nfriction.recording import Recording
from nfriction.signals import Motion

Array = NDArray[np.float64]

# With fewer blocks, one of the corrections would explain most of the torque by chance.
FEWEST_BLOCKS = 20
# Ridge of a balance, relative to the length of its columns: far above round-off, below any noise.
RIDGE = 1e-8


class Source(NamedTuple):
    """Recordings in joint coordinates, their smoothed motions, and the options of their fit."""

    recordings: Sequence[Recording]
    motions: Sequence[Motion]
    options: FitOptions


@dataclass(frozen=True)
class Samples:
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
    source: Source

    def late(self, delay: float, drift: float = 0.0) -> "Samples":
        """With the torque that was recorded `delay` [s] later, which grows by `drift` [-].

        Of the recordings as given: changes of the samples are lost.
        """
        return collect(self.source, delay, drift)

    def held(self, delay: float) -> bool:
        """True if it is explained by holding a torque until the next sample, up to one step."""
        return -max(r.sample_time for r in self.recordings) <= delay <= 0

    @property
    def recordings(self) -> Sequence[Recording]:
        return self.source.recordings

    @property
    def options(self) -> FitOptions:
        return self.source.options

    def mean(self, values: Tensor) -> Tensor:
        """Means over blocks, (block, ...)."""
        return values.reshape(-1, self.block, *values.shape[1:]).mean(1)

    def at_rate(self, factor: float) -> "Samples":
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


@dataclass(frozen=True)
class Mistake:
    """A mistake that would explain why no friction fits."""

    text: str  # a clause such as "the sign of joint2's position is reversed"
    unexplained: float  # share of the torque after the correction [-]; NaN if none is known
    case: tuple[Plant, Samples] | None = None  # corrected; None if more than these change
    rig: Plant | None = None  # corrected in several terms at once
    ratios: Mapping[str, float] = field(default_factory=dict)  # of those terms to the given ones
    timed: bool = False  # a wrong sample rate would explain the same


def collect(source: Source, delay: float = 0.0, drift: float = 0.0) -> Samples:
    """Samples away from the ends, with the torque that was recorded `delay` [s] later.

    The delay grows by `drift` with time [-].
    """
    recordings, motions, options = source
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
    return Samples(q, qd, qdd, sd, sd_of_mean, turns, tau, time, number, block, source)


def unexplained_share(plant: Plant, data: Samples, extra: Tensor | None = None) -> float:
    """Share of the torque that Coulomb and viscous friction, and `extra`, do not explain [-].

    Root mean square over joints, relative to the sum of squares of the torques of drive, gravity
    and inertia, without their means where a drive may have an offset.
    """
    return share_and_factors(plant, data, extra)[0]


def share_and_factors(
    plant: Plant, data: Samples, extra: Tensor | None = None
) -> tuple[float, Tensor]:
    """`unexplained_share` with the factors of `extra` torques, (column,)."""
    needed = data.needed(plant)
    left, factors = solve_balance(data, data.tau - needed, extra)
    return torque_share(plant, data, left, needed), factors


def noise_share(plant: Plant, data: Samples, sd: Tensor) -> float:
    """Share of the torque that its noise, and that of accelerations, explains [-]."""
    variance, needed = torch.zeros_like(data.moving), data.needed(plant)
    if data.block > 2:
        # Neither the slope of the torque nor its jumps in some blocks count as noise.
        curved = data.tau.reshape(-1, data.block, plant.joints).diff(n=2, dim=1)
        variance += curved.square().mean(1).median(0).values / (6 * data.block)
    for own in torch.eye(plant.joints, dtype=sd.dtype):
        moved = replace(data, qdd=data.qdd + own * sd).needed(plant)
        variance = variance + data.mean((moved - needed).square())
    return torque_share(plant, data, (data.moving * variance).mean(0), needed)


def torque_share(plant: Plant, data: Samples, target: Tensor, needed: Tensor) -> float:
    """Mean squares of torques, (joint,), as a share of the torque [-]; see `unexplained_share`.

    `needed` is the torque of the motion without friction, (sample, joint).
    """
    rest = torch.zeros_like(data.q)
    static = plant.inverse_dynamics(data.q, rest, rest)
    parts = torch.stack([data.mean(x) for x in (data.tau, static, needed - static)])
    # The offset of a drive would explain a constant torque of any size.
    constant = (data.moving * parts).sum(1, keepdim=True) / data.moving.sum(0).clamp_min(1)
    size = (data.moving * (parts - data.tau.any(0) * constant)).square().mean(1).sum(0)
    return float((target / size.clamp_min(torch.finfo(size.dtype).tiny)).mean().sqrt())


def solve_balance(
    data: Samples, torque: Tensor, extra: Tensor | None = None, most: Sequence[float] | None = None
) -> tuple[Tensor, Tensor]:
    """Mean square of unexplained torque, (joint,), and factors of `extra` torques, (column,).

    The magnitude of each factor is at most `most`.
    """
    from scipy.optimize import lsq_linear  # slow to import

    left, terms, weight = balance_equations(data, torque, extra)
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


def balance_equations(
    data: Samples, torque: Tensor, extra: Tensor | None = None
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


def best_amount(plant: Plant, change: dict[str, Tensor], given: Samples) -> float:
    """Best-fitting factor of a change of buffers in which torques are linear."""
    own = dict(plant.named_buffers())
    moved = plant.replace(**{name: own[name] + part for name, part in change.items()})
    needed = given.needed(plant)
    return float(solve_balance(given, given.tau - needed, needed - given.needed(moved))[1])


def least_unexplained(
    unexplained: Callable[[float], float], lowest: float, highest: float, count: int = 9
) -> tuple[float, float]:
    """The value with the smallest unexplained share, and that share."""
    from scipy.optimize import minimize_scalar  # slow to import

    # The valley is as wide as a swing, so that a coarse grid finds it.
    grid = np.linspace(lowest, highest, count)
    square = np.nan_to_num(np.square([unexplained(x) for x in grid]), nan=math.inf)
    beside = np.pad(square, 1, constant_values=math.inf)
    valleys = (square < beside[:-2]) & (square <= beside[2:]) & (square <= 16 * square.min())
    # Vibrations make several valleys, of which a grid shows the depth only about.
    close, found = 5e-4 * (highest - lowest), []
    for k in sorted({int(np.argmin(square)), *np.flatnonzero(valleys).tolist()}):
        around = float(grid[max(k - 1, 0)]), float(grid[min(k + 1, count - 1)])
        found.append(
            minimize_scalar(unexplained, bounds=around, method="bounded", options={"xatol": close})
        )
    best = min(found, key=lambda x: float(x.fun))
    return float(best.x), float(best.fun)


def drawn_terms(plant: Plant, data: Samples) -> list[PlantParameter]:
    """The terms that a drawing gives: encoder zeros, then those of inertia and gravity."""
    terms = plant_parameters(plant, driven=data.driven, options=data.options)
    # Terms without a spread are exact.
    terms = [term for term in terms if term.prior_sd > 0]
    zeros = [term for term in terms if term.name.startswith("angle offset")]
    return [*zeros, *(term for term in terms if term.ratio)]


def torques_of_terms(plant: Plant, data: Samples) -> tuple[list[Tensor], list[Tensor]]:
    """Torque per unit of each encoder zero, and of each term of inertia and gravity."""
    needed = data.needed(plant)
    found: tuple[list[Tensor], list[Tensor]] = ([], [])
    for term in drawn_terms(plant, data):
        changed = adjusted_buffers(plant, [term], needed.new_tensor([1e-3]))
        found[term.ratio].append((data.needed(plant.replace(**changed)) - needed) / 1e-3)
    return found


def usual_errors(plant: Plant, data: Samples) -> tuple[Tensor, list[float]]:
    """Torque saved per unit of each drawn term, (sample, joint, term), and 95 % of their priors."""
    zeros, others = torques_of_terms(plant, data)
    saved = -torch.stack([*zeros, *others], -1) if zeros or others else data.q[..., None][..., :0]
    return saved, [NORMAL_95 * term.prior_sd for term in drawn_terms(plant, data)]

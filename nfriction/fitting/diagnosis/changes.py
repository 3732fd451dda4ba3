"""Friction, scales and offsets that change with time, and gears with play."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import product
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from nfriction.fitting.data.inputs import names_of
from nfriction.fitting.diagnosis.balance import Samples, Source, collect
from nfriction.fitting.options import FitOptions
from nfriction.fitting.plant_parameters import plant_parameters
from nfriction.fitting.result.paired_test import (
    improves,
    jackknife_sd,
    student_quantile,
    total_gain,
)
from nfriction.plant import Plant
from nfriction.recording import Recording
from nfriction.signals import Motion

# Speeds between which a friction torque is linear.
SPEED_KNOTS = 5


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
    data = collect(Source(recordings, motions, options))
    pieces = options.drift_pieces * len(recordings)
    if len(data.q) < 2 * pieces * data.block:
        return
    time, number = data.mean(data.time), data.mean(data.number.to(data.time))
    # At a constant rate, or as a warm-up of which 95 % is over at the end.
    during = [("during a recording", x) for x in (time, 1 - torch.exp(-3 * time / time.max()))]
    onward = "from the first recording to the last", number
    for j, joint in enumerate(plant.joint_names):
        *means, sliding = _of_sliding(plant, data, j)
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
            # In sums, because a change shows at its ends, and hardly in the pieces between.
            gain, spread = total_gain(best.growing, best.constant)
            sure = gain > spread * student_quantile(pieces - 1, 1 - options.drift_chance)
            if sure and abs(best.rate) > max(0.01, least):
                yield best.of, best.sentence(plant, joint, student_quantile(pieces - 1, 0.975))


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
    data = collect(Source(recordings, motions, every))
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
        friction, of_rig, driving, sliding = _of_sliding(plant, data, j)
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
        # A wrong rig may seem to miss many times the load.
        if max(sd * sure, 0.5 + sd * within) < share <= 1 + sd * within:
            yield (
                f"The gear of {plant.joint_names[j]} has play: for about "
                f"{options.diagnosis_block:g} s after the load reverses, {100 * share:.0f} ± "
                f"{100 * sd * within:.0f} % of its torque is missing; the intervals do not cover "
                "this."
            )


def _of_sliding(plant: Plant, data: Samples, j: int) -> tuple[Tensor, ...]:
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
    apart = data.mean(speed) > data.options.diagnosis_block * data.mean(data.qdd[:, j].abs())
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
        first, last = 1 - self.rate * self.mean, 1 + self.rate * (1 - self.mean)
        slope = ((1 - self.mean) / last + self.mean / first) * last / first
        if self.of == "offset":
            what, unit = f"offset of the {plant.effort}", f" {plant.effort_unit}"
            cause = "sensor, amplifier"
            sizes = abs(self.rate) * self.size, sure * self.sd * self.size
        else:
            what, cause, unit = "friction", "warm-up, payload or position", " %"
            sizes = 100 * abs(last / first - 1), 100 * sure * self.sd * slope
            if self.of == "scale":
                what, cause = f"scale of the {plant.effort}", "torque constant, sensor, supply"
        change, reach = (float(f"{x:.2g}") for x in sizes)
        return (
            f"The {what} of {joint} {'grows' if self.rate > 0 else 'falls'} by {change:g} ± "
            f"{reach:g}{unit} {self.period} ({cause}); the intervals do not cover this."
        )

"""Fuzzy rules that make friction follow inputs recorded in a table, see `NFSlip`.

The torque is linear in all rules, so that ridge regression on the law's residual gives them, with
the prior of networks. An input is used if it improves hold-out blocks by more than their scatter.
The period of a ripple is that at which the rows' error has most power over position.
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from nfriction.fitting.hysteresis import TOLERANCE, MemoryFit, fit_slip, range_of
from nfriction.fitting.options import DEFAULTS
from nfriction.fitting.result.paired_test import improves, student_quantile
from nfriction.fitting.shooting.autocorrelation import effective_noise
from nfriction.friction.hysteresis import TERMS, Recorded
from nfriction.friction.neurofuzzy import PRIOR_SD
from nfriction.recording.torque_table import JointTorque

Array = NDArray[np.float64]

# Fewest periods of a ripple in the range of the motion: fewer are a slow function of position.
FEWEST_PERIODS = 10
# Spacing of spatial frequencies, relative to one more period in the range of the motion.
SPACING = 1 / 6
# Lower bound of the rules' factor on the law when a torque is divided by it.
LEAST = 0.1
# Number of trial shifts of a ripple's phase over a period.
SHIFTS = 24
# Fewest cells of position in the shortest period: in one cell the phase turns by an eighth.
CELLS = 8


def recorded_inputs(joint: JointTorque) -> dict[str, Tensor]:
    """Columns that friction may follow, (row, 1), by the names of `Recorded`."""
    given = {
        "load": joint.load, "temperature": joint.temperature, "position": joint.q,
        "direction": joint.qd, "velocity": joint.qd,
    }  # fmt: skip
    return {name: torch.tensor(x)[:, None] for name, x in given.items() if x is not None}


class Rules:
    """Fuzzy rules of a joint, to be fitted in addition to its law.

    Args:
        schedule: of one joint; it gets the ranges of its inputs, and the rules by `set`.
        joint: rows in order of time.
        found: the law's fit to them.
        blocks: rows that are held out in turn.
        v_smooth: width of the smoothed direction [rad/s; m/s].
    """

    def __init__(
        self, schedule: Recorded, joint: JointTorque, found: MemoryFit,
        blocks: Sequence[NDArray[np.intp]], v_smooth: float,
    ) -> None:  # fmt: skip
        self.schedule, self.joint, self.blocks = schedule, joint, blocks
        inputs = recorded_inputs(joint)
        fastest = float(inputs["velocity"].abs().max())
        if joint.q is not None:
            inputs["ripple"] = inputs["velocity"]
        # Symmetric in both directions.
        ends = {"direction": (-v_smooth, v_smooth), "ripple": (-fastest, fastest)}
        self.sets: dict[str, Array] = {}
        for k, name in enumerate(TERMS):
            if name in inputs and len(inputs[name].unique()) > 1:
                x = inputs[name]
                low, high = ends.get(name, (float(x.min()), float(x.max())))
                schedule.ranges[0, k] = torch.tensor([low, high]).double()
                self.sets[name] = (
                    schedule.layer(name).regressor_columns(schedule.within(name, x))[0].T.numpy()
                )
        error = joint.tau - found.torque
        self.size = float(np.sqrt(np.mean(joint.tau**2)))
        self.noise = self.noise_of(error)
        self.ripple = _Ripple.of(joint, error, blocks) if "ripple" in self.sets else None
        if self.ripple is None:
            self.sets.pop("ripple", None)

    def noise_of(self, error: Array) -> float:
        """Noise level of an error, inflated for its autocorrelation [N m; N]."""
        return max(effective_noise(torch.tensor(error)[None, :, None]), 1e-12 * self.size)

    def chosen(self, found: MemoryFit) -> tuple[list[str], Array]:
        """Inputs that improve hold-out blocks, and the squared errors there, (block,)."""
        names: list[str] = []
        now = self._left_out(found, names)
        while others := [name for name in self.sets if name not in names]:
            trials = {name: self._left_out(found, [*names, name]) for name in others}
            best = min(trials, key=lambda name: float(trials[name].sum()))
            fell = now - trials[best]
            # Gains in only a few blocks do not recur in other recordings.
            error = fell.std(ddof=1) / len(fell) ** 0.5
            least = student_quantile(len(fell) - 1, 1 - DEFAULTS.input_chance) * error
            if fell.mean() <= max(least, (1 - (1 - TOLERANCE) ** 2) * now.mean()):
                break
            names.append(best)
            now = trials[best]
        return names, now

    @torch.no_grad()
    def set(self, names: Sequence[str], torque: Array) -> None:
        """Set the rules of inputs, given a law's torque, (row,)."""
        wave = self.ripple.wave() if self.ripple else 1.0
        x = self._columns(names, torque, wave)
        solution: NDArray[Any] = self._weights(x, self.joint.tau - torque)
        for name in names:
            layer = self.schedule.layer(name)
            own, solution = np.split(solution, [layer.consequents.numel()])
            own = own * (self.size if name == "ripple" else 1.0)
            layer.consequents.copy_(torch.tensor(own).reshape(layer.consequents.shape))
        self.schedule.period.fill_(2 * np.pi / wave)

    def _columns(self, names: Sequence[str], torque: Array, wave: float) -> Array:
        """Torque per unit of each rule, (row, rule)."""
        parts = []
        for name in names:
            if name == "ripple":
                assert self.joint.q is not None
                angle = wave * self.joint.q[:, None]
                parts += [self.size * self.sets[name] * f(angle) for f in (np.cos, np.sin)]
            else:
                parts.append(self.sets[name] * torque[:, None])
        return np.concatenate(parts, 1)

    def _weights(self, x: Array, error: Array) -> Array:
        ridge = (self.noise / PRIOR_SD) ** 2 * np.eye(x.shape[1])
        return np.asarray(np.linalg.solve(x.T @ x + ridge, x.T @ error), dtype=np.float64)

    def _left_out(self, found: MemoryFit, names: Sequence[str]) -> Array:
        assert found.without is not None
        squares = []
        for k, (block, torque) in enumerate(zip(self.blocks, found.without, strict=True)):
            error = self.joint.tau - torque
            if names:
                rest = np.setdiff1d(np.arange(len(error)), block)
                x = self._columns(names, torque, self.ripple.wave(k) if self.ripple else 0.0)
                error = error - x @ self._weights(x[rest], error[rest])
            squares.append(float(error[block] @ error[block]))
        return np.array(squares)


def fit_recorded(
    schedule: Recorded, joint: JointTorque, blocks: Sequence[NDArray[np.intp]], v_smooth: float
) -> MemoryFit:
    """Fit the law and set the rules that improve hold-out blocks, in a schedule of one joint.

    Returns the fit of the law, with the torque and the errors on the blocks that result with the
    rules. Rows are in order of time; `v_smooth` is the width of the smoothed direction [rad/s;
    m/s].
    """
    found = fit_slip(joint, blocks, loaded=False)
    rules = Rules(schedule, joint, found, blocks, v_smooth)
    names, squares = rules.chosen(found)
    torque = found.torque
    if names:
        rules.set(names, found.torque)
        inputs = recorded_inputs(joint)

        def corrected(torque: Array) -> Array:
            with torch.no_grad():
                return schedule.corrected(torch.tensor(torque)[:, None], inputs).numpy()[:, 0]

        # The law is fitted again to the torque without the rules' part, and they to its residual.
        ripple, both = (corrected(np.full(len(joint), x)) for x in (0.0, 1.0))
        alone = (joint.tau - ripple) / np.maximum(both - ripple, LEAST)
        found = fit_slip(replace(joint, tau=alone), blocks, loaded=False)
        rules.noise = rules.noise_of(joint.tau - corrected(found.torque))
        rules.set(names, found.torque)
        torque = corrected(found.torque)
    lengths = np.array([len(block) for block in blocks])
    return replace(found, torque=torque, errors=tuple(np.sqrt(squares / lengths).tolist()))


@torch.no_grad()
def ripple_shift(
    schedule: Recorded, joint: JointTorque, torque: Array, blocks: Sequence[NDArray[np.intp]]
) -> float:
    """Shift of the positions at which a ripple explains a run better than by chance [rad; m].

    A different encoder zero puts the ripple out of phase; 0 if the run shows no such shift.
    `torque` is what the model predicts at the rows, (row,), and `blocks` are the rows of each
    block.
    """
    inputs, still = recorded_inputs(joint), torch.zeros(len(joint), 1).double()
    shifts = float(schedule.period[0]) * np.arange(SHIFTS) / SHIFTS

    def squares(shift: float) -> Tensor:
        moved = inputs | {"position": inputs["position"] + shift}
        change = schedule.corrected(still, moved) - schedule.corrected(still, inputs)
        error = joint.tau - torque - change.numpy()[:, 0]
        return torch.from_numpy(np.array([error[block] @ error[block] for block in blocks]))

    found = [squares(shift) for shift in shifts]
    best = min(range(SHIFTS), key=lambda k: float(found[k].sum()))
    return float(shifts[best]) if improves(found[best], found[0], DEFAULTS.input_chance) else 0.0


class _Ripple(NamedTuple):
    """Power of errors over the frequency of a position."""

    waves: Array  # radians of the ripple per unit of position, (frequency,)
    sums: NDArray[np.complex128]  # of error times speed times wave, (block, direction, frequency)
    squares: Array  # sums of squares of the speed, (block, direction)

    @classmethod
    def of(
        cls, joint: JointTorque, error: Array, blocks: Sequence[NDArray[np.intp]]
    ) -> "_Ripple | None":
        assert joint.q is not None
        reach = range_of(joint)
        # A period has at least one row at the highest speed.
        most = reach / float(np.abs(np.diff(joint.q)).max())
        # Zero padding gives the transform the spacing of the frequencies.
        kept = np.arange(round(FEWEST_PERIODS / SPACING), math.ceil(most / SPACING))
        waves = np.asarray(2 * np.pi * SPACING / reach * kept, dtype=np.float64)
        cells = 2 ** math.ceil(math.log2(CELLS * max(most, 1.0)))
        cell = ((joint.q - joint.q.min()) * (cells / reach)).astype(np.intp)
        sums = np.zeros((len(blocks), 2, len(waves)), complex)
        squares = np.zeros((len(blocks), 2))
        for k, block in enumerate(blocks):
            for i, sign in enumerate((1.0, -1.0)):
                rows = block[sign * joint.qd[block] > 0]
                # The ripple grows with speed, and each direction has its own phase.
                speed = np.abs(joint.qd[rows])
                squares[k, i] = speed @ speed
                dealt = np.bincount(cell[rows], speed * error[rows], cells + 1)
                sums[k, i] = np.fft.rfft(dealt, round(cells / SPACING))[kept]
        return cls(waves, sums, squares) if len(waves) else None

    def wave(self, left_out: int | None = None) -> float:
        """The frequency of most power, in all blocks or without one."""
        kept = np.arange(len(self.sums)) != (-1 if left_out is None else left_out)
        power = np.abs(self.sums[kept].sum(0)) ** 2
        of = self.squares[kept].sum(0)[:, None]
        explained = (power / np.maximum(of, 1e-300)).sum(0)
        top = int(explained.argmax())
        before, peak, after = (explained[max(top + k, 0) :][:1].sum() for k in (-1, 0, 1))
        # A parabola through the peak; none at an end.
        bend = before - 2 * peak + after
        shift = 0.5 * (before - after) / bend if bend < 0 and 0 < top < len(explained) - 1 else 0.0
        return float(self.waves[top] + shift * (self.waves[1] - self.waves[0] if top else 0.0))

"""Inputs by which a target is compared with its model: in range, beyond it, at rest, broken."""

import math

import torch
from torch import Tensor

from nfriction.export.controller import UNBOUNDED, Controller

Series = tuple[Tensor, ...]

# How far beyond the trained range targets are compared.
BEYOND = 0.1
# Range of a joint for which nobody gave one.
DEFAULT_RANGE = {"qd": 20.0, "qdd": 200.0}
LARGEST_LOAD = 3.0


def ranges(controller: Controller) -> dict[str, Tensor]:
    """Lowest and highest velocity and acceleration of every joint, (joint, 2)."""
    found = {}
    for name, default in DEFAULT_RANGE.items():
        edges = torch.stack(
            [controller.get_buffer(f"{name}_lower"), controller.get_buffer(f"{name}_upper")], -1
        )
        spread = torch.tensor([-default, default], dtype=edges.dtype)
        found[name] = torch.where(edges.abs() < UNBOUNDED, edges, spread)
    return found


def draw(controller: Controller, count: int, seed: int = 0) -> Series:
    """Finite inputs to 10 % beyond the trained range, (sample, joint) each.

    Motions are drawn by `draw_motion`; positions are those of a swing, in successive samples.
    """
    qd, qdd, load = draw_motion(controller, count, seed)
    return (_sweep(controller, count), load) if controller.filters else (qd, qdd, load)


def draw_motion(controller: Controller, count: int, seed: int = 0) -> Series:
    """Velocity, acceleration and load, evenly drawn; a third of the velocities near rest."""
    generator = torch.Generator().manual_seed(seed)

    def even(low: Tensor, high: Tensor) -> Tensor:
        shape = (count, controller.joints)
        return low + (high - low) * torch.rand(shape, dtype=torch.float64, generator=generator)

    zero = torch.zeros(controller.joints, dtype=torch.float64)
    load = even(zero, zero + LARGEST_LOAD)
    qd, qdd = (even(*_widened(edges)) for edges in ranges(controller).values())
    # Near rest the sign turns and the acceleration along the motion with it.
    qd[::3] *= 10.0 ** even(zero - 5.0, zero)[::3]
    return qd, qdd, load


def trials(controller: Controller) -> Series:
    """The inputs of the test vectors: drawn ones, then edges, rest, and broken inputs.

    Broken inputs come last, one joint and one input at a time, with a sound sample after each.
    """
    drawn = draw(controller, 200, seed=6)
    if not controller.filters:
        special = _special(controller)
        drawn = tuple(torch.cat(pair) for pair in zip(drawn, special, strict=True))
    return _with_broken(drawn, controller.joints)


def _widened(edges: Tensor) -> tuple[Tensor, Tensor]:
    """Range of every joint with a tenth of it more on either side."""
    low, high = edges.unbind(-1)
    more = BEYOND * (high - low)
    return low - more, high + more


def _sweep(controller: Controller, count: int) -> Tensor:
    """Positions of a swing whose velocity grows slowly, to beyond its range."""
    assert controller.filter_options is not None
    cutoff_hz, sample_time = (controller.filter_options[k] for k in ("cutoff_hz", "sample_time"))
    _, fastest = _widened(ranges(controller)["qd"])
    time = sample_time * torch.arange(count, dtype=torch.float64)[:, None]
    # Below the cut-off, so that it gets through, and in two swings or more to the longest count.
    rate = math.tau * min(0.2 * cutoff_hz, 8.0 / (count * sample_time))
    phase = torch.arange(controller.joints, dtype=torch.float64)
    growth = torch.linspace(0.0, 1.0, count, dtype=torch.float64)[:, None]
    return 1.2 * growth * fastest.abs() / rate * torch.sin(rate * time + phase)


def _special(controller: Controller) -> Series:
    """Every pair of edges of the range, rest, and creeping."""
    found = ranges(controller)
    levels = {}
    for name, edges in found.items():
        low, high = edges.unbind(-1)
        zero = torch.zeros_like(low)
        tiny = 1e-4 * high.abs()
        levels[name] = torch.stack([low, high, zero, -zero, tiny, -tiny])
    qd = levels["qd"].repeat_interleave(len(levels["qdd"]), 0)
    qdd = levels["qdd"].repeat(len(levels["qd"]), 1)
    load = torch.ones_like(qd)
    load[::2] = 0.0
    return qd, qdd, load


def _with_broken(inputs: Series, joints: int) -> Series:
    """The inputs, followed by every kind of broken one, each among sound ones."""
    kinds = (math.nan, math.inf, -math.inf)
    rounds = 2 * max(joints, 2) * len(kinds) * len(inputs)
    rows = torch.arange(rounds) % len(inputs[0])
    tails = [x[rows].clone() for x in inputs]
    for row in range(0, rounds, 2):
        turn = row // 2
        which = turn % len(inputs)
        joint = turn // (len(inputs) * len(kinds)) % joints
        tails[which][row, joint] = kinds[turn // len(inputs) % len(kinds)]
    return tuple(torch.cat(pair) for pair in zip(inputs, tails, strict=True))

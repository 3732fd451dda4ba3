"""Exact sensitivities of windows of a simulated motion.

A window's motion is a chain of identical step maps. All step maps are linearised at once, in
forward mode over a few directions (state, held coefficients, plant terms), and steps between
samples that count are chained in these directions; a recursion of small matrix products then
carries the sensitivity through time. The cost hardly depends on how many parameters shape the
coefficients, so constant and neuro-fuzzy models are fitted alike.
"""

import logging
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

import torch
import torch.autograd.forward_ad as forward_ad
from torch import Tensor

from nfriction import codegen
from nfriction.fitting.plant_parameters import PlantParameter, adjusted_buffers
from nfriction.friction.models import FrictionModel
from nfriction.friction.sensitivity import Sensitivity
from nfriction.plant import Plant
from nfriction.simulation.rk4 import rk4_step
from nfriction.simulation.rollout import Rollout

logger = logging.getLogger(__name__)

# Samples linearised together in eager torch: dual numbers should stay in the processor's cache.
CHUNK = 1024


@dataclass(frozen=True)
class StepMaps:
    """Derivatives of the maps of a run of blocks of steps, each (block, window, 3 joint, ·).

    The rows are q, qd and qdd after the block; the columns those before it, the friction model's
    parameters, and the plant's.
    """

    state: Tensor
    parameters: Tensor
    plant: Tensor


class StepJacobian:
    """Exact derivatives of one step by state, held coefficients and plant parameters.

    Compiled where there is a compiler (20 to 30 times faster), otherwise by eager dual numbers.

    Args:
        plant: the mechanism as given.
        friction: the friction model; only its law matters here.
        parameters: adjustable terms of the plant.
    """

    def __init__(
        self,
        plant: Plant,
        friction: FrictionModel,
        parameters: list[PlantParameter],
    ) -> None:
        self.plant, self.friction, self.parameters = plant, friction, parameters
        self._compiled: codegen.CompiledFunction | None = None
        joints, k = plant.joints, len(friction.law.coefficients)
        generator = torch.Generator().manual_seed(0)
        shapes = ((joints,), (joints,), (joints, k), (joints,), (1,), (len(parameters),))
        example = [
            scale * torch.rand(shape, generator=generator, dtype=torch.float64)
            for shape, scale in zip(shapes, (1.0, 1.0, 1e-2, 1.0, 1e-3, 1e-2), strict=True)
        ]
        try:
            self._compiled = codegen.compile_function(self._after, example, jacobian=(0, 1, 2, 5))
        except codegen.CodegenError as error:
            logger.warning("fits run slowly, as steps are linearised in eager torch: %s", error)

    def __call__(
        self, q: Tensor, qd: Tensor, held: Tensor, tau: Tensor, step: Tensor, vector: Tensor
    ) -> Tensor:
        """Derivatives of (q, qd, qdd) after a step, (sample, 3 joint, direction).

        Directions: q, qd, held coefficients (joint-major), plant parameters.
        """
        if self._compiled is not None:
            given = (q, qd, held, tau, step, vector[None])
            return torch.from_numpy(self._compiled(*given)[-1])
        pieces = zip(*(x.split(CHUNK) for x in (q, qd, held, tau, step)), strict=True)
        return torch.cat([self._eager(a, b, c, d, e, vector) for a, b, c, d, e in pieces])

    def _after(
        self, q: Tensor, qd: Tensor, held: Tensor, tau: Tensor, step: Tensor, vector: Tensor
    ) -> Tensor:
        """State after one step, (*batch, 3 joint)."""
        buffers = adjusted_buffers(self.plant, self.parameters, vector)
        plant = self.plant.replace(**buffers) if buffers else self.plant
        return torch.cat(rk4_step(plant, self.friction, q, qd, tau, held, step), -1)

    def _eager(
        self, q: Tensor, qd: Tensor, held: Tensor, tau: Tensor, step: Tensor, vector: Tensor
    ) -> Tensor:
        inputs = (q, qd, held.flatten(1), vector.expand(len(q), -1))
        unit = torch.eye(sum(x.shape[1] for x in inputs), dtype=q.dtype)
        count = len(unit)
        with torch.no_grad(), forward_ad.dual_level():
            duals = [
                forward_ad.make_dual(
                    x.expand(count, *x.shape).contiguous(),
                    tangent[:, None].expand(count, *x.shape).contiguous(),
                )
                for x, tangent in zip(inputs, unit.split([x.shape[1] for x in inputs], 1),
                                      strict=True)
            ]  # fmt: skip
            q_, qd_, held_, vector_ = duals
            after = self._after(q_, qd_, held_.unflatten(-1, held.shape[1:]), tau, step, vector_)
            return forward_ad.unpack_dual(after).tangent.permute(1, 2, 0)


def start_slope(
    jacobian: StepJacobian, q: Tensor, qd: Tensor, tau: Tensor, vector: Tensor
) -> Tensor:
    """Derivative of the acceleration known before the first step, which is without friction.

    Args:
        jacobian: holds the mechanism and its adjustable terms.
        q, qd, tau: initial state and torque, (window, joint).
        vector: parameters of the plant.

    Returns:
        By q, qd and the plant's parameters, (window, joint, direction).
    """

    def acceleration(q: Tensor, qd: Tensor, vector: Tensor, tau: Tensor) -> Tensor:
        buffers = adjusted_buffers(jacobian.plant, jacobian.parameters, vector)
        plant = jacobian.plant.replace(**buffers) if buffers else jacobian.plant
        return plant.forward_dynamics(q, qd, tau)

    slope = torch.func.vmap(torch.func.jacfwd(acceleration, (0, 1, 2)), (0, 0, None, 0))
    return torch.cat(slope(q, qd, vector, tau), -1)


def step_maps(
    jacobian: StepJacobian,
    motion: Rollout,
    tau: Tensor,
    step: Tensor,
    vector: Tensor,
    run: int,
    block: int = 1,
    states: Tensor | None = None,
) -> Iterator[StepMaps]:
    """Linearise windows, `run` blocks of `block` steps at a time, in order.

    What lies between the ends of a block is composed for few directions before the many
    parameters come in. Steps after the last whole block are a shorter one of their own.

    Args:
        jacobian: derivatives of one step.
        motion: of the windows, (window, step + 1, joint).
        tau: torque held over each step, (window, step, joint).
        step: [s], (window, step).
        vector: parameters of the plant.
        run: blocks to a piece.
        block: steps to a block.
        states: memory of the coefficients at every step, (window, step, joint, size), of a
            schedule that has one; what it owes to the motion is not differentiated.
    """
    windows, steps = step.shape

    whole = steps // block * block
    for start, end in pairwise(sorted({*range(0, whole, run * block), whole, steps})):
        part, length = slice(start, end), min(block, end - start)

        def samples(x: Tensor, part: slice = part, length: int = length) -> Tensor:
            return x[:, part].unflatten(1, (-1, length)).transpose(0, 1).flatten(0, 2)

        q, qd, qdd = (samples(x) for x in (motion.q, motion.qd, motion.qdd))
        schedule = jacobian.friction.schedule
        if states is None:
            held, slope = schedule(qd, qdd), schedule.sensitivities(qd, qdd)
        else:
            memory = samples(states)
            held = schedule.coefficients_from(qd, qdd, memory)
            slope = schedule.sensitivities_from(qd, qdd, memory)
        held = held.detach().expand(*qd.shape, held.shape[-1])
        derivative = jacobian(q, qd, held, samples(tau), samples(step[..., None]), vector)
        maps = _compose(slope, derivative, length, len(jacobian.parameters))
        yield StepMaps(*(m.unflatten(0, (len(m) // windows, windows)) for m in maps))


def _compose(
    slope: Sensitivity, derivative: Tensor, block: int, plant_count: int
) -> tuple[Tensor, Tensor, Tensor]:
    """Close the loop from the state through the coefficients, and chain the steps of blocks."""
    samples, joints = slope.qd.shape[:2]
    by_q, by_qd, by_held, by_plant = derivative.split(
        [joints, joints, derivative.shape[-1] - 2 * joints - plant_count, plant_count], dim=-1
    )
    k = by_held.shape[-1] // joints
    of_joint = by_held.unflatten(-1, (joints, k))
    by_state = torch.cat(
        [
            by_q,
            by_qd + torch.einsum("sijk,sjk->sij", of_joint, slope.qd),
            torch.einsum("sijk,sjk->sij", of_joint, slope.qdd),
        ],
        -1,
    )
    steps = (x.unflatten(0, (samples // block, block)) for x in (by_state, by_held, by_plant))
    state, held, plant = _chained(*steps)
    return state, slope.contract(held.unflatten(-1, (joints, k)).transpose(1, 2)), plant


def _chained(state: Tensor, held: Tensor, plant: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Derivatives of the ends of blocks from those of their steps, each (block, step, row, ·).

    Returns:
        By the state before the block; by what was held over each of its steps, step by step; and
        by what acts in all of them.
    """
    steps = state.shape[1]
    if steps == 1:
        return state[:, 0], held, plant[:, 0]
    after, rows, total = state[:, -1], [held[:, -1]], plant[:, -1]
    for s in range(steps - 2, -1, -1):
        rows.append(after @ held[:, s])
        total = total + after @ plant[:, s]
        after = after @ state[:, s]
    return after, torch.stack(rows[::-1], 1), total

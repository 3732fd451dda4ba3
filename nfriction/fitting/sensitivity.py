"""Exact sensitivities of windows of a simulated motion.

A window's motion is a chain of identical step maps. All step maps are linearised at once, in
forward mode over a few directions (state, held coefficients, plant terms); a recursion of small
matrix products then carries the sensitivity through time. The cost hardly depends on how many
parameters shape the coefficients, so constant and neuro-fuzzy models are fitted alike.
"""

import logging
from collections.abc import Iterator
from dataclasses import dataclass

import torch
import torch.autograd.forward_ad as forward_ad
from torch import Tensor

from nfriction import codegen
from nfriction.fitting.plant_parameters import PlantParameter, adjusted_buffers
from nfriction.friction import FrictionModel
from nfriction.plant import LinearAxis, PendulumChain
from nfriction.simulation import Rollout, rk4_step

logger = logging.getLogger(__name__)

# Samples linearised together in eager torch: dual numbers should stay in the processor's cache.
CHUNK = 1024


@dataclass(frozen=True)
class StepMaps:
    """Derivatives of the step maps of a run of steps, each (step, window, 3 joint, ·).

    The rows are q, qd and qdd after the step; the columns those before it, the friction model's
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
        plant: PendulumChain | LinearAxis,
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
    jacobian: StepJacobian, motion: Rollout, tau: Tensor, step: Tensor, vector: Tensor, run: int
) -> Iterator[StepMaps]:
    """Linearise all steps of windows, `run` of them at a time, in order.

    Args:
        jacobian: derivatives of one step.
        motion: of the windows, (window, step + 1, joint).
        tau: torque held over each step, (window, step, joint).
        step: [s], (window, step).
        vector: parameters of the plant.
        run: steps to a piece.
    """
    windows, steps = step.shape
    joints = motion.q.shape[-1]

    def samples(x: Tensor, part: slice, width: int) -> Tensor:
        return x[:, part].transpose(0, 1).reshape(-1, width)

    for start in range(0, steps, run):
        part = slice(start, min(start + run, steps))
        q, qd, qdd = (samples(x, part, joints) for x in (motion.q, motion.qd, motion.qdd))
        held = jacobian.friction.coefficients(qd, qdd).detach()
        held = held.expand(*qd.shape, held.shape[-1])
        derivative = jacobian(
            q, qd, held, samples(tau, part, joints), samples(step, part, 1), vector
        )
        maps = _compose(jacobian.friction, derivative, qd, qdd, len(jacobian.parameters))
        shape = (part.stop - part.start, windows, 3 * joints, -1)
        yield StepMaps(*(m.reshape(shape) for m in maps))


def _compose(
    friction: FrictionModel, derivative: Tensor, qd: Tensor, qdd: Tensor, plant_count: int
) -> tuple[Tensor, Tensor, Tensor]:
    """Close the loop from the state through the coefficients."""
    samples, joints = qd.shape
    by_q, by_qd, by_held, by_plant = derivative.split(
        [joints, joints, derivative.shape[-1] - 2 * joints - plant_count, plant_count], dim=-1
    )
    by_held = by_held.reshape(samples, 3 * joints, joints, -1)
    slope = friction.schedule.sensitivities(qd, qdd)
    state = torch.cat(
        [
            by_q,
            by_qd + torch.einsum("sijk,sjk->sij", by_held, slope.qd),
            torch.einsum("sijk,sjk->sij", by_held, slope.qdd),
        ],
        -1,
    )
    parameters = state.new_empty(samples, 3 * joints, len(slope.joint))
    for joint in range(joints):
        own = (slope.joint == joint).nonzero().squeeze(-1)
        parameters[..., own] = by_held[:, :, joint] @ slope.parameters[..., own]
    return state, parameters, by_plant

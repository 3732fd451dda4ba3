"""Exact sensitivities of windows of a simulated motion.

A window's motion is a chain of identical step maps. All step maps are linearised at once, in
forward mode over a few directions (state, held coefficients, plant terms); a recursion of small
matrix products then carries the sensitivity through time. The cost hardly depends on how many
parameters shape the coefficients, so constant and neuro-fuzzy models are fitted alike.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import torch
import torch.autograd.forward_ad as forward_ad
from torch import Tensor

from nfriction.fitting.plant_parameters import PlantParameter, adjusted_buffers
from nfriction.friction import FrictionModel
from nfriction.plant import LinearAxis, PendulumChain
from nfriction.simulation import Rollout, rk4_step

# Samples linearised together: their dual numbers should stay in the processor's cache.
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


def step_maps(
    plant: PendulumChain | LinearAxis,
    friction: FrictionModel,
    motion: Rollout,
    tau: Tensor,
    step: Tensor,
    parameters: list[PlantParameter],
    vector: Tensor,
    run: int,
) -> Iterator[StepMaps]:
    """Linearise all steps, `run` of them at a time, in order.

    Args:
        plant: the mechanism as given.
        friction: the friction model.
        motion: of the windows, (window, step + 1, joint).
        tau: torque held over each step, (window, step, joint).
        step: [s], (window, step).
        parameters, vector: adjustable terms of the plant and where they stand.
        run: steps to a piece.
    """
    windows, steps = step.shape
    joints = motion.q.shape[-1]

    def samples(x: Tensor, part: slice, width: int) -> Tensor:
        return x[:, part].transpose(0, 1).reshape(-1, width)

    for start in range(0, steps, run):
        part = slice(start, min(start + run, steps))
        q, qd, qdd = (samples(x, part, joints) for x in (motion.q, motion.qd, motion.qdd))
        held = friction.coefficients(qd, qdd).detach()
        held = held.expand(*qd.shape, held.shape[-1])
        every = (q, qd, held, samples(tau, part, joints), samples(step, part, 1))
        derivative = torch.cat(
            [
                _directional(plant, friction, a, b, c, d, e, parameters, vector)
                for a, b, c, d, e in zip(*(x.split(CHUNK) for x in every), strict=True)
            ]
        )
        maps = _compose(friction, derivative, qd, qdd, len(parameters))
        shape = (part.stop - part.start, windows, 3 * joints, -1)
        yield StepMaps(*(m.reshape(shape) for m in maps))


def _directional(
    plant: PendulumChain | LinearAxis,
    friction: FrictionModel,
    q: Tensor,
    qd: Tensor,
    held: Tensor,
    tau: Tensor,
    step: Tensor,
    parameters: list[PlantParameter],
    vector: Tensor,
) -> Tensor:
    """Derivatives of one step, (sample, 3 joint, direction).

    Directions: q, qd, held coefficients (joint-major), plant parameters.
    """
    joints = q.shape[-1]
    k = held.shape[-1]
    count = 2 * joints + joints * k + len(parameters)
    unit = torch.eye(count, dtype=q.dtype)
    first = 2 * joints
    tangents = unit.split([joints, joints, joints * k, len(parameters)], dim=1)
    with torch.no_grad(), forward_ad.dual_level():

        def dual(value: Tensor, tangent: Tensor) -> Tensor:
            shape = (count, *value.shape)
            return forward_ad.make_dual(
                value.expand(shape).contiguous(), tangent.expand(shape).contiguous()
            )

        buffers = {}
        for name, value in adjusted_buffers(plant, parameters, vector).items():
            tangent = torch.zeros((count, *value.shape), dtype=q.dtype)
            for i, parameter in enumerate(parameters):
                if parameter.buffer == name:
                    tangent[first + joints * k + i] = parameter.basis
            buffers[name] = forward_ad.make_dual(
                value.expand(tangent.shape).contiguous()[:, None], tangent[:, None]
            )
        moved = plant.replace(**buffers) if buffers else plant
        after = rk4_step(
            moved,
            friction,
            dual(q, tangents[0][:, None]),
            dual(qd, tangents[1][:, None]),
            tau,
            dual(held, tangents[2].reshape(count, 1, joints, k)),
            step,
        )
        rows = torch.cat([forward_ad.unpack_dual(x).tangent for x in after], -1)
    return rows.permute(1, 2, 0)


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
    own = by_held[:, :, slope.joint]
    return state, torch.einsum("sipk,skp->sip", own, slope.parameters), by_plant

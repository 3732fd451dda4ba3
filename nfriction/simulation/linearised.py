"""Steps of a rollout, linearised, and how a cotangent is carried back through them.

Joints come first and the batch last, so that each entry of every matrix lies in one piece: a batch
of small products is then a few large ones, entry by entry.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from nfriction.plant.slopes import PlantSlopes


@dataclass(frozen=True)
class Linearised:
    """Some steps, linearised.

    Attributes:
        held: coefficients of the law with their graph, (step, *batch, joint, coefficient).
        rate: acceleration at the four stages with its graph, (stage, step, *batch, joint).
        slopes: of each stage's acceleration by q, qd and the coefficients, (joint, 2 joint + joint
            coefficient, stage, step, *batch).
        drive: of the coefficients by qd and qdd: (joint, coefficient, 2, step, *batch) where each
            joint's own motion drives them, else (joint coefficient, 2 joint, step, *batch); None
            where no motion does.
        local: which of these `drive` is.
        step: [s], (step, *batch).
    """

    held: Tensor
    rate: Tensor
    slopes: Tensor
    drive: Tensor | None
    local: bool
    step: Tensor


def combined_slopes(plant: PlantSlopes, by_qd: Tensor, by_load: Tensor, by_c: Tensor) -> Tensor:
    """Derivatives of the acceleration by q, qd and the coefficients; see `Linearised.slopes`.

    Args:
        plant: derivatives of the mechanism.
        by_qd, by_load: of each joint's friction by its own velocity and load, (joint, *batch).
        by_c: by its own coefficients, (joint, coefficient, *batch).
    """
    joints, states = len(by_qd), 2 * len(by_qd)
    torque = torch.cat([plant.by_q, plant.by_qd], 1)
    torque[:, :joints].addcmul_(by_load.unsqueeze(1), plant.load_by_q)
    own = torque[:, joints:].diagonal().movedim(-1, 0)
    own.add_(by_qd).addcmul_(by_load, plant.load_by_qd)
    found = torque.new_empty(joints, states + by_c.shape[:2].numel(), *by_qd.shape[1:])
    max_inverse_inertia = -plant.inverse_mass
    by_state, by_held = found[:, :states], found[:, states:].unflatten(1, by_c.shape[:2])
    torch.mul(max_inverse_inertia[:, :1], torque[0], out=by_state)
    for j in range(1, joints):
        by_state.addcmul_(max_inverse_inertia[:, j : j + 1], torque[j])
    torch.mul(max_inverse_inertia.unsqueeze(2), by_c, out=by_held)
    return found


def step_back(
    piece: Linearised, k: int, after: tuple[Tensor, ...], by_held: Tensor, by_rate: Tensor
) -> tuple[Tensor, ...]:
    """Carry the cotangents of (q, qd) and of qdd after step `k` to those before it.

    What reaches the coefficients and the stages' accelerations is written to `by_held`, (joint,
    coefficient, *batch), and `by_rate`, (stage, joint, *batch).
    """
    by_state, by_qdd = after
    h, joints = piece.step[k], len(by_qdd)
    half, slopes = 0.5 * h, piece.slopes[:, :, :, k]
    once_q, once_qd = (h / 6.0 * by_state).chunk(2)
    twice_q, twice_qd = 2.0 * once_q, 2.0 * once_qd

    def pulled(stage: int, cotangent: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """By all that a stage's acceleration hangs on, and by its q and qd."""
        by_rate[stage] = cotangent
        found = (cotangent.unsqueeze(1) * slopes[:, :, stage]).sum(0)
        return found, found[:joints], found[joints : 2 * joints]

    p4, x4, v4 = pulled(3, once_qd)
    p3, x3, v3 = pulled(2, torch.addcmul(twice_qd, h, v4 + once_q))
    p2, x2, v2 = pulled(1, torch.addcmul(twice_qd, half, v3 + twice_q + h * x4))
    p1, _, _ = pulled(0, torch.addcmul(once_qd, half, v2 + twice_q + half * x3) + by_qdd)
    found = p1 + p2 + p3 + p4
    by_held.copy_(found[2 * joints :].unflatten(0, by_held.shape[:2]))
    before = by_state + found[: 2 * joints]
    # The stages' positions hang on the velocity before the step as well.
    before[joints:] += h * (by_state[:joints] + x4 + 0.5 * (x2 + x3))
    if piece.drive is None:
        return before, torch.zeros_like(by_qdd)
    if piece.local:
        by_qd, by_qdd = (by_held.unsqueeze(2) * piece.drive[:, :, :, k]).sum(1).unbind(1)
    else:
        driven = found[2 * joints :].unsqueeze(1) * piece.drive[:, :, k]
        by_qd, by_qdd = driven.sum(0).chunk(2)
    before[joints:] += by_qd
    return before, by_qdd


def gradients(
    outputs: Sequence[Tensor],
    inputs: Sequence[Tensor],
    cotangents: Sequence[Tensor] | None = None,
    retain: bool = False,
) -> list[Tensor]:
    """Gradients by `inputs`, zero where an output does not depend on one; ones pull by default."""
    pulls = cotangents or [torch.ones_like(y) for y in outputs]
    pairs = [(y, pull) for y, pull in zip(outputs, pulls, strict=True) if y.requires_grad]
    if not pairs or not inputs:
        return [torch.zeros_like(x) for x in inputs]
    alive, pulls = zip(*pairs, strict=True)
    return list(
        torch.autograd.grad(
            alive, inputs, pulls, retain_graph=retain, allow_unused=True, materialize_grads=True
        )
    )

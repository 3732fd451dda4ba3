"""Steps of a rollout, linearised, and how a cotangent is carried back through them."""

from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class Linearised:
    """Some steps, linearised; time is the first axis.

    Attributes:
        held: coefficients of the law with their graph, (step, *batch, joint, coefficient).
        rate: acceleration at the four stages with its graph, (stage, step, *batch, joint).
        slopes: of each stage's acceleration by q, qd and the coefficients, (stage, step, *batch,
            joint, 2 joint + joint coefficient).
        drive: of the coefficients by qd and qdd: (step, *batch, joint, coefficient, 2) where each
            joint's own motion drives them, else (step, *batch, joint coefficient, 2 joint); None
            where no motion does.
        local: which of these `drive` is.
        step: [s], (step, *batch, 1).
    """

    held: Tensor
    rate: Tensor
    slopes: Tensor
    drive: Tensor | None
    local: bool
    step: Tensor


def step_back(
    piece: Linearised, k: int, after: tuple[Tensor, ...], by_held: Tensor, by_rate: Tensor
) -> tuple[Tensor, ...]:
    """Carry the cotangents of (q, qd) and of qdd after step `k` to those before it.

    What reaches the coefficients and the stages' accelerations is written to `by_held` and
    `by_rate`.
    """
    by_state, by_qdd = after
    h, joints = piece.step[k], by_qdd.shape[-1]
    half, own = 0.5 * h, slice(joints, 2 * joints)
    once_q, once_qd = (h / 6.0 * by_state).chunk(2, -1)
    twice_q, twice_qd = 2.0 * once_q, 2.0 * once_qd

    def pulled(stage: int, cotangent: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """By all that a stage's acceleration hangs on, and by its q and qd."""
        by_rate[stage] = cotangent
        found = (cotangent.unsqueeze(-2) @ piece.slopes[stage, k]).squeeze(-2)
        return found, found[..., :joints], found[..., own]

    p4, x4, v4 = pulled(3, once_qd)
    p3, x3, v3 = pulled(2, torch.addcmul(twice_qd, h, v4 + once_q))
    p2, x2, v2 = pulled(1, torch.addcmul(twice_qd, half, v3 + twice_q + h * x4))
    p1, _, _ = pulled(0, torch.addcmul(once_qd, half, v2 + twice_q + half * x3) + by_qdd)
    found = p1 + p2 + p3 + p4
    by_held.copy_(found[..., 2 * joints :].unflatten(-1, by_held.shape[-2:]))
    before = by_state + found[..., : 2 * joints]
    # The stages' positions hang on the velocity before the step as well.
    before[..., joints:] += h * (by_state[..., :joints] + x4 + 0.5 * (x2 + x3))
    if piece.drive is None:
        return before, torch.zeros_like(by_qdd)
    if piece.local:
        by_qd, by_qdd = (by_held.unsqueeze(-1) * piece.drive[k]).sum(-2).unbind(-1)
    else:
        driven = found[..., None, 2 * joints :] @ piece.drive[k]
        by_qd, by_qdd = driven.squeeze(-2).chunk(2, -1)
    before[..., joints:] += by_qd
    return before, by_qdd

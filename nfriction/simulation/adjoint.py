"""Gradients of rollouts: linearised in parallel, carried back step by step.

A rollout is a chain of small steps, and recording every operation of every step costs far more than
the arithmetic. Here the motion is simulated without a graph (compiled where that is possible). The
backward pass takes many steps at once, linearises all their stages in one batch, carries the
cotangent back through the chain by small products of matrices, and differentiates by the
parameters once for all these steps.

References:
    The discrete adjoint of a Runge-Kutta method: E. Hairer, C. Lubich and G. Wanner, Geometric
    Numerical Integration, 2nd ed., 2006, section VI.4.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from nfriction.simulation.linearised import Linearised, step_back
from nfriction.simulation.mechanism import Mechanism
from nfriction.simulation.steps import acceleration

# Samples linearised together, by device: enough that the calls cost little, few enough for the
# cache or (at some 20 KB each) the memory.
CHUNK = {"cpu": 2**14, "cuda": 2**18}

States = tuple[Tensor, ...]


def differentiable(
    simulate: Callable[[], States],
    mechanism: Mechanism,
    q0: Tensor,
    qd0: Tensor,
    tau: Tensor,
    step: Tensor,
    substeps: int,
    measured: tuple[Tensor, Tensor] | None,
) -> States:
    """States of a rollout, differentiable once by the start, the torque and the mechanism.

    Args:
        simulate: gives the states q, qd, qdd, each (*batch, steps + 1, joint).
        mechanism: what moves; without memory, and closed.
        q0, qd0: initial state, (*batch, joint).
        tau: torque, (steps, joint) or (*batch, steps, joint).
        step: sample time, (steps,) or (*batch, steps).
        substeps: Runge-Kutta steps to each sample.
        measured: motion that drives the coefficients, each (*batch, steps, joint) or without batch.
    """
    tensors = mechanism.tensors()
    names, values = tuple(tensors), tensors.values()
    chain = _Chain(mechanism, names, substeps, measured)
    states: States = _Rollout.apply(simulate, chain, step, q0, qd0, tau, *values)
    return states


@dataclass(frozen=True)
class _Chain:
    """What a backward pass needs beyond tensors that are differentiated by."""

    mechanism: Mechanism
    names: tuple[str, ...]
    substeps: int
    measured: tuple[Tensor, Tensor] | None


class _Rollout(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, simulate: Callable[[], States], chain: _Chain, step: Tensor, *inputs: Tensor
    ) -> States:
        states = simulate()
        ctx.chain = chain
        ctx.save_for_backward(step, *states, *inputs)
        return states

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *cotangents: Tensor) -> tuple[Tensor | None, ...]:
        step, q, qd, qdd, q0, _, tau, *tensors = ctx.saved_tensors
        wanted = ctx.needs_input_grad[5:]
        leaves = [
            t.detach().requires_grad_(asked) for t, asked in zip(tensors, wanted[1:], strict=True)
        ]
        walk = _Backward(ctx.chain, leaves, q, step, tau, wanted[0])
        given = [x.movedim(-2, 0) for x in (q, qd, qdd)]
        found = walk.run(given, [x.movedim(-2, 0) for x in cotangents])
        by_tau = walk.by_tau.movedim(0, -2).sum_to_size(tau.shape) if wanted[0] else None
        by_start = [x.sum_to_size(q0.shape) for x in found]
        return None, None, None, *by_start, by_tau, *walk.by_tensor


def _by_time(x: Tensor, like: Tensor) -> Tensor:
    """A series (step, width) or (*batch, step, width) as (step, *batch, width)."""
    return x.expand(*like.shape[:-2], *x.shape[-2:]).movedim(-2, 0)


class _Backward:
    """One walk back through the chain; gradients gather in `by_tau` and `by_tensor`."""

    def __init__(
        self,
        chain: _Chain,
        leaves: list[Tensor],
        q: Tensor,
        step: Tensor,
        tau: Tensor,
        by_tau: bool,
    ) -> None:
        self.chain = chain
        self.own = dict(zip(chain.names, leaves, strict=True))
        self.leaves = leaves
        self.step, self.tau = _by_time(step[..., None], q) / chain.substeps, _by_time(tau, q)
        self.measured = [_by_time(x, q) for x in chain.measured or ()]
        self.by_tensor: list[Tensor | None] = [None] * len(leaves)
        self.by_tau = tau.new_zeros(self.tau.shape if by_tau else 0)

    def call(self, function: Callable[..., Any], *args: Any) -> Any:
        return torch.func.functional_call(self.chain.mechanism, self.own, (function, *args))

    def run(self, states: Sequence[Tensor], cotangents: Sequence[Tensor]) -> tuple[Tensor, Tensor]:
        """Gradients by the initial position and velocity.

        Args:
            states: q, qd, qdd, each (step + 1, *batch, joint).
            cotangents: of these.
        """
        # A step that diverges passes nothing back, but its numbers would turn zeros into NaN.
        alive = torch.stack([torch.isfinite(x[1:]).all(-1, keepdim=True) for x in states]).all(0)
        before = [torch.where(alive, x[:-1], 0.0) for x in states]
        # Position and velocity as one: half as many operations.
        cotangents = [torch.cat(list(cotangents[:2]), -1), cotangents[2]]
        carried: States = tuple(x[-1] for x in cotangents)
        steps, batch = len(self.step), states[0][0, ..., 0].numel()
        length = max(1, CHUNK.get(self.tau.device.type, CHUNK["cpu"]) // max(1, batch))
        for start in reversed(range(0, steps, length)):
            part = slice(start, min(start + length, steps))
            carried = self._chunk(part, before, cotangents, carried)
        by_state, by_qdd = carried
        by_q, by_qd = by_state.chunk(2, -1)
        with torch.enable_grad():
            # The first acceleration is that without friction.
            given = [x[0].detach().requires_grad_() for x in (*states[:2], self.tau)]
            start_rate = self.call(lambda plant, _, *x: plant.forward_dynamics(*x), *given)
        inputs = [*given, *self._asked()]
        more_q, more_qd, more_tau, *own = _grad([start_rate], inputs, [by_qdd])
        self._gather(own)
        if self.by_tau.numel():
            self.by_tau[0] += more_tau
        return by_q + more_q, by_qd + more_qd

    def _asked(self) -> list[Tensor]:
        return [t for t in self.leaves if t.requires_grad]

    def _gather(self, found: Sequence[Tensor]) -> None:
        places = [i for i, t in enumerate(self.leaves) if t.requires_grad]
        for i, more in zip(places, found, strict=True):
            known = self.by_tensor[i]
            self.by_tensor[i] = more if known is None else known + more

    def _chunk(
        self,
        part: slice,
        states: Sequence[Tensor],
        cotangents: Sequence[Tensor],
        carried: States,
    ) -> States:
        """Carry the cotangent of the state after these steps to that before them."""
        pieces, tau = self._linearised(part, [x[part] for x in states])
        by_held = [torch.empty_like(p.held) for p in pieces]
        by_rate = [torch.empty_like(p.rate) for p in pieces]
        for k in reversed(range(part.stop - part.start)):
            for piece, held, rate in zip(pieces[::-1], by_held[::-1], by_rate[::-1], strict=True):
                carried = step_back(piece, k, carried, held[k], rate[:, k])
            carried = tuple(c + x[part.start + k] for c, x in zip(carried, cotangents, strict=True))
        inputs = [*([tau] if tau.requires_grad else []), *self._asked()]
        for piece, held, rate in zip(pieces, by_held, by_rate, strict=True):
            found = _grad([piece.held, piece.rate], inputs, [held, rate])
            if tau.requires_grad:
                self.by_tau[part] += found.pop(0)
            self._gather(found)
        return carried

    @torch.enable_grad()
    def _linearised(self, part: slice, states: Sequence[Tensor]) -> tuple[list[Linearised], Tensor]:
        """Each substep of these samples, and the torque that they were linearised with."""
        q, qd, qdd = states
        h, mechanism = self.step[part], self.chain.mechanism
        tau = self.tau[part].detach().requires_grad_(bool(self.by_tau.numel()))
        pieces = []
        for _ in range(self.chain.substeps):
            driven = [x[part] for x in self.measured] or [qd.detach(), qdd.detach()]
            if not (self.measured or mechanism.has_slopes()):
                driven = [x.requires_grad_() for x in driven]
            held = self.call(lambda _, friction, *x: friction.coefficients(*x), *driven)
            held = held.expand(*q.shape, held.shape[-1])
            drive = None if self.measured else self._drive(held, driven)
            points, after = self._stages(q, qd, tau, held.detach(), h)
            rate, slopes = self._slopes(points, tau, held.detach())
            pieces.append(Linearised(held, rate, slopes, drive, mechanism.is_local(), h))
            q, qd, qdd = after
        return pieces, tau

    @torch.no_grad()
    def _stages(
        self, q: Tensor, qd: Tensor, tau: Tensor, held: Tensor, h: Tensor
    ) -> tuple[tuple[Tensor, Tensor], States]:
        """States at the four stages, (stage, step, *batch, joint), and after the step."""

        def rate(q: Tensor, qd: Tensor) -> Tensor:
            found: Tensor = self.call(acceleration, q, qd, tau, held)
            return found

        half = 0.5 * h
        a1 = rate(q, qd)
        v2, x2 = qd + half * a1, q + half * qd
        a2 = rate(x2, v2)
        v3, x3 = qd + half * a2, q + half * v2
        a3 = rate(x3, v3)
        v4, x4 = qd + h * a3, q + h * v3
        points = torch.stack([q, x2, x3, x4]), torch.stack([qd, v2, v3, v4])
        if self.chain.substeps == 1:
            return points, (q, qd, a1)  # what follows the step is not asked for
        a4, sixth = rate(x4, v4), h / 6.0
        after = (
            q + sixth * (qd + 2.0 * (v2 + v3) + v4),
            qd + sixth * (a1 + 2.0 * (a2 + a3) + a4),
            a1,
        )
        return points, after

    def _slopes(
        self, points: tuple[Tensor, Tensor], tau: Tensor, held: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Acceleration at the stages and its derivatives; see `Linearised`."""
        q, qd = (x.requires_grad_() for x in points)
        c = held.expand(4, *held.shape).contiguous().requires_grad_()
        rate = self.call(acceleration, q, qd, tau, c)
        joints, count = held.shape[-2:]
        slopes = rate.new_empty(*rate.shape, joints * (2 + count))
        for j, y in enumerate(rate.unbind(-1)):
            by_q, by_qd, by_c = _grad([y], [q, qd, c], retain=True)
            row = slopes[..., j, :]
            row[..., :joints], row[..., joints : 2 * joints] = by_q, by_qd
            row[..., 2 * joints :] = by_c.flatten(-2)
        return rate, slopes

    def _drive(self, held: Tensor, driven: Sequence[Tensor]) -> Tensor | None:
        """Derivatives of the coefficients by what drives them; see `Linearised`."""
        mechanism = self.chain.mechanism
        if mechanism.has_slopes():
            given = (*driven, held.detach())
            found = self.call(lambda _, friction, *x: friction.schedule.slopes(*x), *given)
            return torch.stack(found, -1)
        if held.grad_fn is None:
            return None
        if mechanism.is_local():
            # Each joint's coefficient by its own motion, all joints in one pass.
            columns = [_grad([held[..., k]], driven, retain=True) for k in range(held.shape[-1])]
            return torch.stack([torch.stack(own, -1) for own in columns], -2)
        rows = [_grad([y], driven, retain=True) for y in held.flatten(-2).unbind(-1)]
        return torch.stack([torch.cat(row, -1) for row in rows], -2)


def _grad(
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

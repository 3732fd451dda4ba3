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

from nfriction.simulation.linearised import Linearised, combined_slopes, gradients, step_back
from nfriction.simulation.mechanism import Mechanism
from nfriction.simulation.rk4 import acceleration

# Samples linearised together, by device: enough that the calls cost little, few enough for the
# cache or (at some 20 KB each) the memory.
CHUNK = {"cpu": 2**13, "cuda": 2**18}

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
        found = walk.run(*([_joints_first(x) for x in part] for part in ((q, qd, qdd), cotangents)))
        by_tau = walk.by_tau.movedim(0, -2).sum_to_size(tau.shape) if wanted[0] else None
        by_start = [x.movedim(0, -1).sum_to_size(q0.shape) for x in found]
        return None, None, None, *by_start, by_tau, *walk.by_tensor


def _joints_first(x: Tensor) -> Tensor:
    """A series (*batch, step, joint) as (joint, step, *batch), also in memory."""
    return x.movedim((-1, -2), (0, 1)).contiguous()


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
            states: q, qd, qdd, each (joint, step + 1, *batch).
            cotangents: of these.
        Returns:
            Each (joint, *batch).
        """
        # A step that diverges passes nothing back, but its numbers would turn zeros into NaN.
        alive = torch.stack([torch.isfinite(x[:, 1:]) for x in states]).all(0).all(0)
        before = [torch.where(alive, x[:, :-1], 0.0) for x in states]
        # Position and velocity as one: half as many operations.
        cotangents = [torch.cat(list(cotangents[:2])), cotangents[2]]
        carried: States = tuple(x[:, -1] for x in cotangents)
        steps, batch = len(self.step), states[0][0, 0].numel()
        length = max(1, CHUNK.get(self.tau.device.type, CHUNK["cpu"]) // max(1, batch))
        for start in reversed(range(0, steps, length)):
            part = slice(start, min(start + length, steps))
            carried = self._chunk(part, before, cotangents, carried)
        by_state, by_qdd = carried
        by_q, by_qd = by_state.chunk(2)
        with torch.enable_grad():
            # The first acceleration is that without friction.
            first = (*(x[:, 0].movedim(0, -1) for x in states[:2]), self.tau[0])
            given = [x.detach().requires_grad_() for x in first]
            start_rate = self.call(lambda plant, _, *x: plant.forward_dynamics(*x), *given)
        inputs = [*given, *self._asked()]
        more_q, more_qd, more_tau, *own = gradients([start_rate], inputs, [by_qdd.movedim(0, -1)])
        self._gather(own)
        if self.by_tau.numel():
            self.by_tau[0] += more_tau
        return by_q + more_q.movedim(-1, 0), by_qd + more_qd.movedim(-1, 0)

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
        pieces, tau = self._linearised(part, [x[:, part].movedim(0, -1) for x in states])
        # Written step by step, (joint, coefficient, step, *batch) and (stage, joint, step, *batch).
        by_held = [p.held.new_empty(p.held.movedim((-2, -1), (0, 1)).shape) for p in pieces]
        by_rate = [p.rate.new_empty(p.rate.movedim(-1, 1).shape) for p in pieces]
        for k in reversed(range(part.stop - part.start)):
            for piece, held, rate in zip(pieces[::-1], by_held[::-1], by_rate[::-1], strict=True):
                carried = step_back(piece, k, carried, held[:, :, k], rate[:, :, k])
            at = part.start + k
            carried = tuple(c + x[:, at] for c, x in zip(carried, cotangents, strict=True))
        inputs = [*([tau] if tau.requires_grad else []), *self._asked()]
        for piece, held, rate in zip(pieces, by_held, by_rate, strict=True):
            pulls = [held.movedim((0, 1), (-2, -1)), rate.movedim(1, -1)]
            found = gradients([piece.held, piece.rate], inputs, pulls)
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
            linearise = self._slopes if mechanism.has_plant_slopes() else self._automatic_slopes
            found = linearise(points, tau, held.detach())
            pieces.append(Linearised(held, *found, drive, mechanism.is_local(), h[..., 0]))
            q, qd, qdd = after
        return pieces, tau

    @torch.no_grad()
    def _stages(
        self, q: Tensor, qd: Tensor, tau: Tensor, held: Tensor, h: Tensor
    ) -> tuple[States, States]:
        """q, qd and qdd at the four stages, (stage, step, *batch, joint), and after the step."""

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
        a4, sixth = rate(x4, v4), h / 6.0
        # Joints first in memory, as these states come.
        points = tuple(
            torch.stack([x.movedim(-1, 0) for x in part], 1).movedim(0, -1)
            for part in ((q, x2, x3, x4), (qd, v2, v3, v4), (a1, a2, a3, a4))
        )
        after = (
            q + sixth * (qd + 2.0 * (v2 + v3) + v4),
            qd + sixth * (a1 + 2.0 * (a2 + a3) + a4),
            a1,
        )
        return points, after

    def _slopes(self, points: States, tau: Tensor, held: Tensor) -> tuple[Tensor, Tensor]:
        """Acceleration at the stages and its derivatives, the plant's in closed form."""
        q, qd, qdd = points
        plant = self.call(lambda plant, _, *x: plant.slopes(*x), q, qd, qdd)
        load = self.call(lambda plant, _, *x: plant.load(*x).detach(), q, qd)
        inputs = [x.requires_grad_() for x in (qd.detach(), load, held.expand(4, *held.shape))]
        # A law is elementwise, so the sum's gradient is each joint's own slope.
        torque = self.call(lambda _, friction, *x: friction.torque(*x), *inputs)
        by_qd, by_load, by_c = gradients([torque], inputs)
        law = by_qd.movedim(-1, 0), by_load.movedim(-1, 0), by_c.movedim((-2, -1), (0, 1))
        slopes = combined_slopes(plant, *law)
        if tau.requires_grad or self.chain.mechanism.plant_asks(self.own):
            qdd = self.call(acceleration, q, qd, tau, held)
        return qdd, slopes

    def _automatic_slopes(self, points: States, tau: Tensor, held: Tensor) -> tuple[Tensor, Tensor]:
        """Acceleration at the stages and its derivatives, of any plant and friction."""
        q, qd = (x.requires_grad_() for x in points[:2])
        c = held.expand(4, *held.shape).contiguous().requires_grad_()
        rate = self.call(acceleration, q, qd, tau, c)
        rows = []
        for y in rate.unbind(-1):
            by_q, by_qd, by_c = gradients([y], [q, qd, c], retain=True)
            rows.append(torch.cat([by_q, by_qd, by_c.flatten(-2)], -1).movedim(-1, 0))
        return rate, torch.stack(rows)

    def _drive(self, held: Tensor, driven: Sequence[Tensor]) -> Tensor | None:
        """Derivatives of the coefficients by what drives them; see `Linearised`."""
        mechanism = self.chain.mechanism
        if mechanism.has_slopes():
            given = (*driven, held.detach())
            found = self.call(lambda _, friction, *x: friction.schedule.slopes(*x), *given)
            return torch.stack([x.movedim((-2, -1), (0, 1)) for x in found], 2)
        if held.grad_fn is None:
            return None
        if mechanism.is_local():
            # Each joint's coefficient by its own motion, all joints in one pass.
            columns = [
                gradients([held[..., k]], driven, retain=True) for k in range(held.shape[-1])
            ]
            own = [torch.stack([x.movedim(-1, 0) for x in column], 1) for column in columns]
            return torch.stack(own, 1)
        rows = [gradients([y], driven, retain=True) for y in held.flatten(-2).unbind(-1)]
        return torch.stack([torch.cat([x.movedim(-1, 0) for x in row]) for row in rows])

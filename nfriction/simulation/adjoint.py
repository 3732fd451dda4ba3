"""Gradients of rollouts by the discrete adjoint: a reverse sweep over the Jacobians of all steps.

Recording every operation of every step costs far more than the arithmetic. Here the motion is
simulated without a graph, compiled if possible. Then all states are known, so that the Jacobians of
many steps come from one batch. The sweep takes one small matrix product per step, and one
vector-Jacobian product per batch gives the gradient in the torque and the modules' tensors.

References:
    The discrete adjoint of a Runge-Kutta method: E. Hairer, C. Lubich and G. Wanner, Geometric
    Numerical Integration, 2nd ed., 2006, section VI.4.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.functional import pad

from nfriction.simulation.memory_step import memory_of
from nfriction.simulation.protocols import Friction, Plant, RolloutInputs, as_stateful
from nfriction.simulation.rk4 import acceleration, runge_kutta

# Samples linearised together, by device: enough that calls cost little, few enough for the cache or
# (at about 20 KB each) the memory.
CHUNK = {"cpu": 2**13, "cuda": 2**18}

# Beyond this many steps gradients are rarely intended and may take gigabytes, so they must be
# requested.
MOST_STEPS = 10_000

States = tuple[Tensor, ...]


def wants_gradients(inputs: RolloutInputs, tensors: Iterable[Tensor]) -> bool:
    """True if an input of a rollout or one of its modules' tensors requires a gradient."""
    given = (inputs.q0, inputs.qd0, inputs.tau, *tensors)
    short = inputs.step.shape[-1] <= MOST_STEPS
    return short and torch.is_grad_enabled() and any(x.requires_grad for x in given)


def adjoint_rollout(
    simulate: Callable[[], States], plant: Plant, friction: Friction, inputs: RolloutInputs
) -> States | None:
    """States from `simulate`, differentiable once in initial state, torque and modules.

    None if a gradient would be incomplete: with a hidden state, a law with memory, a sample time or
    measured motion that requires one, or modules that read tensors of others.
    """
    modules = [m for m in (plant, friction) if isinstance(m, nn.Module)]
    own = (t for m in modules for t in (*m.parameters(), *m.buffers()) if t.requires_grad)
    system = _System(plant, friction, inputs, list({id(t): t for t in own}.values()))
    fixed = (inputs.step, *(inputs.measured or ()))
    if as_stateful(friction) or memory_of(friction) or any(x.requires_grad for x in fixed):
        return None
    if not _is_closed(system):
        return None
    states: States = _Rollout.apply(
        simulate, system, inputs.q0, inputs.qd0, inputs.tau, *system.tensors
    )
    return states


def _is_closed(system: "_System") -> bool:
    """True if gradients of a step reach no other tensors, found by walking its graph."""
    q, qd = system.inputs.q0.detach(), system.inputs.qd0.detach()
    tau = system.inputs.tau[..., 0, :].detach().expand_as(q)
    with torch.enable_grad():
        held = system.friction.coefficients(qd, tau)  # the graph does not depend on the values
        found = held, acceleration(system.plant, system.friction, q, qd, tau, held)
    known = {id(t) for t in system.tensors}
    # A buffer may itself have been computed: the walk ends there, and autograd continues.
    seen = {t.grad_fn for t in system.tensors}
    nodes = [y.grad_fn for y in found if y.grad_fn is not None]
    while nodes:
        node = nodes.pop()
        if node in seen:
            continue
        seen.add(node)
        if hasattr(node, "variable") and id(node.variable) not in known:
            return False
        nodes += [after for after, _ in node.next_functions if after is not None]
    return True


@dataclass(frozen=True)
class _System:
    plant: Plant
    friction: Friction
    inputs: RolloutInputs
    tensors: list[Tensor]


class _Rollout(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, simulate: Callable[[], States], system: _System, *inputs: Tensor
    ) -> States:
        states = simulate()
        ctx.system = system
        ctx.save_for_backward(*states, *inputs)
        return states

    @staticmethod
    def backward(ctx: Any, *cotangents: Tensor) -> tuple[Tensor | None, ...]:
        if torch.is_grad_enabled():  # `create_graph`; without an error, a Hessian would be zero
            raise RuntimeError(
                "gradients of a rollout are of first order only; for a Hessian or `create_graph` "
                'use `rollout(..., backend="torch")`.'
            )
        # Unpacking refuses tensors that were changed in place since the forward pass.
        q, qd, qdd, q0, _, tau, *_ = ctx.saved_tensors
        sweep = _Sweep(ctx.system, q.shape[:-2])
        states, pulls = torch.cat([q, qd, qdd], -1), torch.cat(cotangents, -1)
        by_start = sweep.run(*(x.movedim(-2, 0).contiguous() for x in (states, pulls)))
        by_tau = sweep.by_tau.movedim(0, -2).sum_to_size(tau.shape)
        return None, None, *(x.sum_to_size(q0.shape) for x in by_start), by_tau, *sweep.by_tensor


class _Sweep:
    """A reverse sweep over states (q, qd, qdd); `by_tau` and `by_tensor` collect gradients."""

    def __init__(self, system: _System, batch: torch.Size) -> None:
        def series(x: Tensor) -> Tensor:
            return x.detach().expand(*batch, *x.shape[-2:]).movedim(-2, 0)

        self.plant, self.friction, self.tensors = system.plant, system.friction, system.tensors
        inputs = system.inputs
        self.substeps, self.tau = inputs.substeps, series(inputs.tau)
        self.step = series(inputs.step[..., None]) / inputs.substeps
        self.measured = [series(x) for x in inputs.measured or ()]
        self.by_tau = torch.zeros_like(self.tau)
        self.by_tensor = [torch.zeros_like(t) for t in self.tensors]

    def run(self, states: Tensor, cotangents: Tensor) -> tuple[Tensor, Tensor]:
        """Gradients in q and qd at the start; arguments are (steps + 1, *batch, 3 joint)."""
        # A divergent step passes nothing back, but its numbers would turn zeros into NaN.
        alive = torch.isfinite(states[1:]).all(-1, keepdim=True)
        before = torch.where(alive, states[:-1], 0.0)
        carried = cotangents[-1]
        steps, batch = len(self.step), states[0, ..., 0].numel()
        length = max(1, CHUNK.get(states.device.type, CHUNK["cpu"]) // max(1, batch))
        for start in reversed(range(0, steps, length)):
            part = slice(start, min(start + length, steps))
            carried = self._chunk(part, before[part], cotangents[part], carried)
        by_q, by_qd, by_qdd = carried.chunk(3, -1)
        with torch.enable_grad():
            q, qd, _ = (x.detach().requires_grad_() for x in states[0].chunk(3, -1))
            tau = self.tau[:1].detach().requires_grad_()
            first = self.plant.forward_dynamics(q, qd, tau[0])
        by_start = _pulled(first, [q, qd], by_qdd, retain=True)
        self._gather(slice(0, 1), first, tau, by_qdd)
        return by_q + by_start[0], by_qd + by_start[1]

    def _gather(self, part: slice, output: Tensor, tau: Tensor, cotangent: Tensor) -> None:
        by_tau, *found = _pulled(output, [tau, *self.tensors], cotangent)
        self.by_tau[part] += by_tau
        for total, more in zip(self.by_tensor, found, strict=True):
            total += more

    def _chunk(self, part: slice, states: Tensor, cotangents: Tensor, carried: Tensor) -> Tensor:
        """Propagate the cotangent of the state after these samples to that before them."""
        tau = self.tau[part].detach().requires_grad_()
        pieces = []
        for _ in range(self.substeps):
            after, jacobian = self._linearised(part, states, tau)
            pieces.append((after, jacobian, torch.empty_like(states)))
            states = after.detach()
        for k in reversed(range(len(states))):
            for _, jacobian, pull in reversed(pieces):
                pull[k] = carried
                carried = (carried.unsqueeze(-2) @ jacobian[k]).squeeze(-2)
            carried = carried + cotangents[k]
        for after, _, pull in pieces:
            self._gather(part, after, tau, pull)
        return carried

    @torch.enable_grad()
    def _linearised(self, part: slice, states: Tensor, tau: Tensor) -> tuple[Tensor, Tensor]:
        """States after each step with their graph, and their Jacobians in the states before."""
        q, qd, qdd = states.chunk(3, -1)
        joints, h = q.shape[-1], self.step[part]
        driven = [x[part] for x in self.measured] or [
            x.detach().requires_grad_() for x in (qd, qdd)
        ]
        held = self.friction.coefficients(*driven)
        held = held.expand(*q.shape, held.shape[-1])
        stages: list[tuple[Tensor, Tensor]] = []

        def rate(q: Tensor, qd: Tensor) -> Tensor:
            stages.append((q.detach(), qd.detach()))
            return acceleration(self.plant, self.friction, q, qd, tau, held)

        after = torch.cat(runge_kutta(rate, q, qd, h), -1)
        by_state, by_held = self._stage_jacobians(stages, tau.detach(), held.detach())
        by_drive = by_held.new_zeros(())
        if not self.measured:
            by_drive = pad(by_held @ self._drive_jacobian(held, driven), (joints, 0))
        local = iter(zip(by_state, by_drive.expand(*by_state.shape[:-1], 3 * joints), strict=True))

        # A Runge-Kutta step is linear in its rates: with linearised rates it maps tangents, here
        # along each entry of the state.
        def tangent(dq: Tensor, dqd: Tensor) -> Tensor:
            slopes, by_motion = next(local)
            return slopes @ torch.cat([dq, dqd], -2) + by_motion

        unit = torch.eye(2 * joints, 3 * joints).to(q).expand(*q.shape[:-1], -1, -1)
        jacobian = torch.cat(
            runge_kutta(tangent, unit[..., :joints, :], unit[..., joints:, :], h[..., None]), -2
        )
        return after, jacobian

    def _stage_jacobians(
        self, stages: Sequence[tuple[Tensor, Tensor]], tau: Tensor, held: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Jacobians of the stages' accelerations in (q, qd) and in all coefficients."""
        q, qd = (torch.stack(x).requires_grad_() for x in zip(*stages, strict=True))
        c = held.expand(4, *held.shape).contiguous().requires_grad_()
        rates = acceleration(self.plant, self.friction, q, qd, tau, c)
        rows = [_pulled(a, [q, qd, c], retain=True) for a in rates.unbind(-1)]
        by_state = torch.stack([torch.cat(row[:2], -1) for row in rows], -2)
        return by_state, torch.stack([row[2].flatten(-2) for row in rows], -2)

    def _drive_jacobian(self, held: Tensor, driven: Sequence[Tensor]) -> Tensor:
        """Jacobian of coefficients in the motion, (step, *batch, joint coefficient, 2 joint)."""
        if getattr(self.friction, "joint_wise", False):
            # Each joint's coefficients follow its own motion: one pass is enough for all.
            rows = [_pulled(c, driven, retain=True) for c in held.unbind(-1)]
            own = [torch.cat([torch.diag_embed(x) for x in row], -1) for row in rows]
            return torch.stack(own, -2).flatten(-3, -2)
        flat = held.flatten(-2).unbind(-1)
        return torch.stack([torch.cat(_pulled(c, driven, retain=True), -1) for c in flat], -2)


def _pulled(
    output: Tensor, inputs: Sequence[Tensor], cotangent: Tensor | None = None, retain: bool = False
) -> list[Tensor]:
    """Vector-Jacobian products, with ones by default; zero for inputs that do not matter."""
    if not output.requires_grad or not inputs:
        return [torch.zeros_like(x) for x in inputs]
    pull = torch.ones_like(output) if cotangent is None else cotangent
    return list(
        torch.autograd.grad(
            output, inputs, pull, retain_graph=retain, allow_unused=True, materialize_grads=True
        )
    )

"""Exact sensitivities of simulated windows.

A window's motion is a chain of identical step maps. One kernel call linearises all of them in a few
directions (state, held coefficients, plant terms); steps between counted samples are chained in
these directions; a recursion of small matrix products then carries the sensitivities through time.
The state includes that of a law with memory. The cost hardly depends on the number of friction
parameters, so constant and neuro-fuzzy models are fitted in the same way.
"""

import logging
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

import numpy as np
import torch
from torch import Tensor

from nfriction import codegen
from nfriction.fitting.adjusted_plant import PlantParameter, adjusted_plant, delay_index
from nfriction.friction.models import FrictionModel
from nfriction.friction.parameters import Sensitivity
from nfriction.plant import Plant
from nfriction.simulation.memory_step import memory_step
from nfriction.simulation.protocols import Rollout
from nfriction.simulation.rk4 import rk4_step

logger = logging.getLogger(__name__)

# Samples linearised together in eager torch, few enough for the processor's cache.
CHUNK = 1024
# Samples, over all windows, whose sensitivities are accumulated together: enough for fast matrix
# products, few enough for the processor's cache.
PIECE = 2000
# Numbers that are carried through time together, derivatives of the states of some windows: 1 MB.
CARRIED = 2**17


class StepJacobian:
    """Exact derivatives of one step with respect to state, held coefficients and plant terms.

    Compiled if possible (100 times faster), otherwise with eager dual numbers.

    Args:
        plant: the mechanism as given.
        friction: the friction model; only its law matters here.

    Attributes:
        after_step: derivatives (sample, row, direction) of the state (q, qd, that of a law with
            memory) and the acceleration after a step, as a function of state, held coefficients,
            torque, step and plant terms. Directions: state, held coefficients (joint-major), plant
            terms. If the torque's delay is one of the terms, the torque consists of that at zero
            delay and its slope over the delay.
        initial_acceleration: derivatives (window, joint, direction) of the first acceleration,
            which has no friction, with respect to q, qd and plant terms, as a function of q, qd,
            torque (window, joint) and plant terms.
    """

    def __init__(
        self, plant: Plant, friction: FrictionModel, terms: Sequence[PlantParameter]
    ) -> None:
        self.plant, self.friction, self.terms = plant, friction, tuple(terms)
        self.delay_index = delay_index(self.terms)
        joints, k = plant.joints, len(friction.law.coefficients)
        torques = joints if self.delay_index is None else 2 * joints
        generator = torch.Generator().manual_seed(0)
        shapes = ((joints,), (joints,), (joints, k), (torques,), (1,), (len(terms),))
        q, qd, held, tau, step, vector = (
            scale * torch.rand(shape, generator=generator, dtype=torch.float64)
            for shape, scale in zip(shapes, (1.0, 1.0, 1e-2, 1.0, 1e-3, 1e-2), strict=True)
        )
        if friction.law.memory:
            # A stiff contact would magnify round-off, against which compiled code is checked.
            held = 0.5 + 50.0 * held
        state = torch.cat([q, qd, 1e-3 * held.new_ones(joints * friction.law.state_size)])
        self._example = [state, held, tau, step, vector]
        self.after_step = _jacobian(self._step, self._example, (0, 1, 4))
        self.initial_acceleration = _jacobian(self._start, [q, qd, tau, vector], (0, 1, 3))

    @cached_property
    def by_state(self) -> Callable[..., Tensor]:
        """`after_step` without the plant terms, in a third of the time."""
        return _jacobian(self._step, self._example, (0, 1))

    def _start(self, q: Tensor, qd: Tensor, tau: Tensor, vector: Tensor) -> Tensor:
        plant = adjusted_plant(self.plant, self.terms, vector)
        return plant.forward_dynamics(q, qd, self._torque(tau, vector))

    def _step(
        self, state: Tensor, held: Tensor, tau: Tensor, step: Tensor, vector: Tensor
    ) -> Tensor:
        """State and acceleration after one step, (*batch, row)."""
        plant = adjusted_plant(self.plant, self.terms, vector)
        torque, joints = self._torque(tau, vector), self.plant.joints
        q, qd = state[..., :joints], state[..., joints : 2 * joints]
        if not self.friction.law.memory:
            return torch.cat(rk4_step(plant, self.friction, q, qd, torque, held, step), -1)
        law = state[..., 2 * joints :].unflatten(-1, (joints, -1))
        q, qd, qdd, law = memory_step(plant, self.friction, q, qd, torque, held, step, law)
        return torch.cat([q, qd, law.flatten(-2), qdd], -1)

    def _torque(self, tau: Tensor, vector: Tensor) -> Tensor:
        k = self.delay_index
        if k is None:
            return tau
        at_none, slope = tau.chunk(2, -1)
        return at_none + vector[..., k : k + 1] * slope


def _jacobian(
    function: Callable[..., Tensor], example: Sequence[Tensor], by: tuple[int, ...]
) -> Callable[..., Tensor]:
    """The Jacobian of a function in some inputs, over batches of all inputs except the last."""
    try:
        compiled = codegen.CompiledFunction(function, example, jacobian=by)
    except codegen.CodegenError as error:
        logger.warning("fits run slowly: steps are linearised in eager torch (%s)", error)
        axes = (*[0] * (len(example) - 1), None)
        slopes = torch.func.vmap(torch.func.jacfwd(function, by), axes, chunk_size=CHUNK)
        return lambda *given: torch.cat([slope.flatten(2) for slope in slopes(*given)], -1)
    return lambda *given: torch.from_numpy(compiled(*given[:-1], given[-1][None])[-1])


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Simulated windows with their friction model and plant terms.

    `motion` is (window, step + 1, joint), `tau` (window, step, any) as `StepJacobian` takes it,
    `step` (window, step). The `memory` of the coefficients (window, step, joint, state_size) is
    held constant in derivatives. `law_slope` are derivatives of the first state of a law with
    memory with respect to friction parameters and its variables, (window, joint state, column).
    """

    friction: FrictionModel
    plant_vector: Tensor
    motion: Rollout
    tau: Tensor
    step: Tensor
    memory: Tensor | None = None
    law_slope: Tensor | None = None

    @property
    def state(self) -> Tensor:
        """Position, velocity and state of a law with memory, (window, step + 1, any)."""
        law = self.motion.law_state
        parts = [self.motion.q, self.motion.qd] + ([] if law is None else [law.flatten(-2)])
        return torch.cat(parts, -1)


def propagate(
    jacobian: StepJacobian, run: Trajectory, substeps: int, stride: int, *, states: bool = False
) -> Iterator[tuple[slice, Tensor]]:
    """Derivatives of the positions at every `stride`-th sample, some samples at a time.

    Yields samples, and (window, sample, joint, column) with respect to friction parameters, plant
    terms and the window's initial state, or to that alone if `states`. The last piece is the
    windows' last sample, counted or not.
    """
    windows, steps = run.step.shape
    joints, state = run.motion.q.shape[-1], run.state
    parameters = run.friction.schedule.parameter_vector().numel()
    counts = (0, 0) if states else (parameters, len(run.plant_vector))
    (friction_count, plant_count), shared = counts, sum(counts)
    own = state.shape[-1]
    carried = torch.zeros(windows, own + joints, shared + own, dtype=torch.float64)
    carried[:, :own, shared:] = torch.eye(own, dtype=torch.float64)
    if run.law_slope is not None:
        by_friction, by_share = run.law_slope.tensor_split([parameters], -1)
        carried[:, 2 * joints : own, :friction_count] = by_friction[..., :friction_count]
        carried[:, 2 * joints : own, shared + 2 * joints :] = by_share
    after_step = jacobian.by_state if states else jacobian.after_step
    motion = slice(shared, shared + 2 * joints)
    carried[:, own:, motion], by_plant = jacobian.initial_acceleration(
        run.motion.q[:, 0], run.motion.qd[:, 0], run.tau[:, 0], run.plant_vector
    ).tensor_split([2 * joints], -1)
    carried[:, own:, friction_count:shared] = by_plant[..., :plant_count]
    block = stride * substeps
    many, whole = block * max(1, PIECE // (windows * block)), steps // block * block
    # Memory that is used again costs less than new memory.
    room, sample = carried.new_empty(windows * max(1, many // block), own + joints, shared), 0
    # Steps after the last whole block form a shorter block.
    for first, last in pairwise(sorted({*range(0, whole, many), whole, steps})):
        length = min(block, last - first)
        before, qd, qdd, tau, step = (
            _by_block(x[:, first:last], length)
            for x in (state, run.motion.qd, run.motion.qdd, run.tau, run.step[..., None])
        )
        memory = None if run.memory is None else _by_block(run.memory[:, first:last], length)
        held, slope = _coefficients(run.friction, qd, qdd, memory)
        slope = replace(slope, factors=tuple) if states else slope
        derivative = after_step(before, held, tau, step, run.plant_vector)
        by_state, by_shared = (
            part.unflatten(0, (-1, windows))
            for part in _compose(slope, derivative, length, counts, room)
        )
        rows, carried = _carry(by_state, by_shared, carried, joints)
        end = sample + stride * rows.shape[1]
        yield slice(sample, end, stride), rows
        sample = end
    yield slice(steps // substeps, None), carried[:, None, :joints]


def _by_block(x: Tensor, length: int) -> Tensor:
    """(window, step, ...) as (block, window, step within block, ...), in one axis."""
    return x.unflatten(1, (-1, length)).transpose(0, 1).flatten(0, 2)


def _coefficients(
    friction: FrictionModel, qd: Tensor, qdd: Tensor, memory: Tensor | None
) -> tuple[Tensor, Sensitivity]:
    """Coefficients held over each step, (sample, joint, coefficient), and their derivatives."""
    schedule = friction.schedule
    if memory is None:
        held, slope = schedule(qd, qdd), schedule.sensitivities(qd, qdd)
    else:
        held = schedule.coefficients_from(qd, qdd, memory)
        slope = schedule.sensitivities_from(qd, qdd, memory)
    return held.detach().expand(*qd.shape, held.shape[-1]), slope


# A search rejects derivatives that overflow; a warning would be noise.
@np.errstate(over="ignore", invalid="ignore")
def _compose(
    slope: Sensitivity, derivative: Tensor, block: int, counts: tuple[int, int], room: Tensor
) -> tuple[Tensor, Tensor]:
    """Close the loop from the state through the coefficients, and chain the steps of blocks.

    Returns derivatives of the ends of blocks with respect to the state before and shared variables,
    of which `counts` are of friction and plant; these are in `room`.
    """
    joints, k = slope.qd.shape[1:]
    own = derivative.shape[-2] - joints
    by_own, by_held, by_plant = derivative.tensor_split([own, own + joints * k], -1)
    by_state = torch.nn.functional.pad(by_own, (0, joints))
    # NumPy multiplies many small matrices several times as fast as torch.
    if slope.qd.any() or slope.qdd.any():
        of_joint = by_held.unflatten(-1, (joints, k)).transpose(1, 2).numpy()
        by_motion = of_joint @ torch.stack([slope.qd, slope.qdd], -1).numpy()
        by_rate, by_state[..., own:] = torch.from_numpy(by_motion).permute(3, 0, 2, 1)
        by_state[..., joints : 2 * joints] += by_rate
    state, held, plant = (
        x.unflatten(0, (-1, block)).numpy() for x in (by_state, by_held, by_plant)
    )
    # From the last step of a block back to its first.
    after, rows, total = state[:, -1], np.empty(held.shape), plant[:, -1].copy()
    rows[:, -1] = held[:, -1]
    for s in range(block - 2, -1, -1):
        if any(counts):
            np.matmul(after, held[:, s], out=rows[:, s])
            total += after @ plant[:, s]
        after = after @ state[:, s]
    shared = room[: len(total)]
    by_friction, by_terms = shared.split(counts, -1)
    by_coefficient = torch.from_numpy(rows).unflatten(-1, (joints, k)).transpose(1, 2)
    slope.contract(by_coefficient, by_friction)
    by_terms.copy_(torch.from_numpy(total))
    return torch.from_numpy(after), shared


def _carry(by_state: Tensor, by_shared: Tensor, start: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """Carry derivatives of a state (window, row, column) through maps (map, window, row, column).

    Returns the first `count` rows before every map, and all rows after the last.
    """
    # For thousands of products of small matrices NumPy's overhead is a fifth of torch's.
    state, shared, end = by_state.numpy(), by_shared.numpy(), start.numpy().copy()
    rows = np.empty((len(end), len(state), count, end.shape[-1]))
    # Some windows at a time through all maps, few enough for the processor's cache.
    some = max(1, CARRIED // end[0].size)
    # The search rejects a step at which derivatives overflow; a warning would be noise.
    with np.errstate(over="ignore", invalid="ignore"):
        for first in range(0, len(end), some):
            part = slice(first, first + some)
            before = end[part]
            for k in range(len(state)):
                rows[part, k] = before[:, :count]
                before = state[k, part] @ before
                before[..., : shared.shape[-1]] += shared[k, part]
            end[part] = before
    return torch.from_numpy(rows), torch.from_numpy(end)

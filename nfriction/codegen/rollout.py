"""Rollouts of a plant with friction: the traced step, the loops around it, and batches."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from nfriction.codegen.batch import (
    Driver,
    Kernel,
    Layout,
    common_rows,
    parameter_rows,
    rows_of,
    series,
    to_array,
)
from nfriction.codegen.graph import FunctionalModule, Program
from nfriction.codegen.ir import real
from nfriction.codegen.scalar import Node, SelfCheckFailed
from nfriction.codegen.transform import hoist

LAYOUT = Layout(
    series=("q0", "qd0", "tau", "step", "drive_qd", "drive_qdd", "memory", "law"),
    outputs=("q_out", "qd_out", "qdd_out", "diverged", "law_out"),
    settings=("samples", "substeps", "driven", "remembered"),
)
# A joint faster than this [rad/s or m/s] is beyond the range of any mechanism: it has diverged.
SPEED_LIMIT = 1e6
# Inputs of `ForcedSystem`; all other inputs of its trace are parameters.
INPUTS = ("q", "qd", "tau", "step", "held", "seen_qd", "seen_qdd", "memory", "law")


class ForcedSystem(nn.Module):
    """Plant and friction as the single function that a rollout repeats, see `CompiledRollout`.

    For a friction law with memory, its state is the last argument of `step`, and its new state the
    last result.
    """

    def __init__(self, plant: Any, friction: Any, step: Callable[..., Any]) -> None:
        super().__init__()
        self.plant = plant
        self.friction = friction
        self.step = step
        self.memory_size = int(getattr(friction, "state_size", 0))
        self.law_size = int(getattr(friction, "law_state_size", 0))

    def forward(
        self,
        q: Tensor,
        qd: Tensor,
        tau: Tensor,
        step: Tensor,
        held: Tensor,
        seen_qd: Tensor,
        seen_qdd: Tensor,
        memory: Tensor | None = None,
        law: Tensor | None = None,
    ) -> tuple[Tensor, ...]:
        own = () if law is None else (law,)
        after = self.step(self.plant, self.friction, q, qd, tau, held, step, *own)
        start = self.plant.forward_dynamics(q, qd, tau)
        if memory is None:
            return *after, start, self.friction.coefficients(seen_qd, seen_qdd)
        coefficients = self.friction.coefficients_from(seen_qd, seen_qdd, memory)
        begin = self.friction.initial_state(seen_qd, seen_qdd)
        return *after, start, coefficients, begin, self.friction.advance(seen_qd, seen_qdd, memory)


@dataclass(frozen=True)
class RolloutProgram:
    """The functions of a rollout as groups of nodes."""

    joints: int
    once: tuple[Node, ...]  # computed once per rollout
    start: tuple[Node, ...]  # acceleration without friction, known at the start
    held: tuple[Node, ...]  # coefficients at a motion and, if they have one, a hidden state
    step: tuple[Node, ...]  # q, qd, qdd after a step, and the state of a law with memory
    within: Node  # true if that state is finite and no joint is too fast
    begin: tuple[Node, ...]  # hidden state of the coefficients after the first sample, if any
    advance: tuple[Node, ...]  # hidden state after a sample, from the previous one
    places: dict[int, tuple[str, int]]  # array and index of the input nodes


def arrange(program: Program, law_size: int = 0) -> RolloutProgram:
    """Arrange the trace of a `ForcedSystem` whose law has an internal state of size `law_size`."""
    graph, outputs = program.graph, [port.nodes for port in program.outputs]
    law = outputs.pop(3) if law_size else ()
    q, qd, qdd, start, held, *remembered = outputs
    begin, advance = remembered or ((), ())
    joints = len(q)
    zero, limit = graph.constant(0.0), graph.constant(SPEED_LIMIT)
    # x - x is zero unless x is NaN or infinite, in which case the comparison is false.
    tests = [graph.apply("eq", graph.apply("sub", x, x), zero) for x in q]
    tests += [graph.apply("le", graph.apply("abs", x), limit) for x in qd]
    within = graph.total(tests, "and")
    groups = [start, held, (*q, *qd, *qdd, *law), (within,), begin, advance]
    groups, once = hoist(graph, groups)
    start, held, step, (within,), begin, advance = groups
    at = {"q": ("state", 0), "qd": ("state", joints), "seen_qdd": ("seen", joints),
          "seen_qd": ("seen", 0), "law": ("state", 3 * joints)}  # fmt: skip
    places = program.places({name: (name, 0) for name in INPUTS} | at)
    return RolloutProgram(joints, tuple(once), start, held, step, within, begin, advance, places)


class RolloutDriver(Driver):
    """The loops over candidates, samples and substeps that call the functions of a program."""

    def __init__(self, program: RolloutProgram, width: int) -> None:
        n = program.joints
        sizes = {"state": len(program.step), "seen": 2 * n, "tau": n, "step": 1,
                 "held": len(program.held), "memory": len(program.advance), "within": 1,
                 "alive": 1}  # fmt: skip
        super().__init__(LAYOUT, width, sizes, program.once, program.places)
        self.program = program
        self.function("nf_start", ["state", "tau"], {"rate": program.start}, seldom=True)
        self.function("nf_held", ["seen", "memory"], {"held": program.held})
        self.function("nf_begin", ["seen"], {"memory": program.begin}, seldom=True)
        self.function("nf_advance", ["seen", "memory"], {"memory": program.advance})
        after = {"state": program.step, "within": (program.within,)}
        self.function("nf_step", ["state", "tau", "step", "held"], after)
        with self.entry():
            self._candidates()

    def _candidates(self) -> None:
        """Write the code for candidates that are computed together."""
        body, n, value = self.body, self.program.joints, self.value
        self.gather("q0", n, value["room.state"])
        self.gather("qd0", n, self.element("state", n))
        self.gather("tau", n, value["room.tau"])
        self.law = len(self.program.step) - 3 * n
        if self.law:
            self.gather("law", self.law, self.element("state", 3 * n))
        value["rate"] = self.element("state", 2 * n)
        self.call("nf_start", "room.state", "room.tau", "rate")
        with self.each() as (candidate, _):
            body.store("-1", value["diverged"], candidate, "i64")
        self._record("0")
        alive = self.element("alive", 0)
        ahead = body.let(f"sub i64 %last, {value['first']}")
        body.run(f"store i64 {self.least(ahead, str(self.lanes))}, ptr {alive}")
        with body.loop("0", value["samples"]) as k:
            some = body.let(f"icmp sgt i64 {body.let(f'load i64, ptr {alive}')}, 0")
            with body.when(some):
                self._sample(k, alive)
            self._record(body.let(f"add i64 {k}, 1"))

    def _sample(self, k: str, alive: str) -> None:
        body, n, value = self.body, self.program.joints, self.value
        self.gather("tau", n, value["room.tau"], k)
        self.gather("step", 1, value["room.step"], k)
        driven = body.let(f"icmp ne i64 {value['driven']}, 0")
        with body.when(driven):
            self.gather("drive_qd", n, value["room.seen"], k)
            self.gather("drive_qdd", n, self.element("seen", n), k)
        moving = self.element("state", n)  # qd, then qdd
        given = f"ptr {value['room.seen']}, ptr {moving}"
        value["sees"] = body.let(f"select i1 {driven}, {given}")
        if self.program.advance:
            self._remember(k)
            # A controller running at the sample rate holds its coefficients over the whole sample.
            self.call("nf_held", "sees", "room.memory", "room.held")
        with body.loop("0", value["substeps"]):
            if not self.program.advance:
                self.call("nf_held", "sees", "room.memory", "room.held")
            rooms = ("state", "tau", "step", "held", "within")
            self.call("nf_step", *(f"room.{name}" for name in rooms))
            fine = body.load(value["room.within"], 0, real(self.width))
            one = body.constant(1.0, self.width)
            lost = body.let(f"fcmp une {real(self.width)} {fine}, {one}")
            if self.width:
                every = body.let(f"bitcast <{self.width} x i1> {lost} to i{self.width}")
                lost = body.let(f"icmp ne i{self.width} {every}, 0")
            with body.when(lost):
                self._stop(k, alive)

    def _remember(self, k: str) -> None:
        body, size = self.body, len(self.program.advance)
        later = body.let(f"icmp sgt i64 {k}, 0")
        first = body.let(f"xor i1 {later}, true")
        given = body.let(f"icmp ne i64 {self.value['remembered']}, 0")
        unknown = body.let(f"xor i1 {given}, true")
        with body.when(later):
            self.call("nf_advance", "sees", "room.memory")
        with body.when(body.let(f"and i1 {first}, {given}")):
            self.gather("memory", size, self.value["room.memory"])
        with body.when(body.let(f"and i1 {first}, {unknown}")):
            self.call("nf_begin", "sees", "room.memory")

    def _stop(self, k: str, alive: str) -> None:
        """Mark candidates that diverged; their simulation continues from zero, without output."""
        body = self.body
        reached = body.let(f"add i64 {k}, 1")
        with self.each() as (candidate, lane):
            lost = body.let(f"fcmp une double {body.load(self.value['room.within'], lane)}, 1.0")
            with body.when(lost):
                for i in range(len(self.program.step)):
                    body.store("0.0", self.element("state", i), lane)
                place = body.at(self.value["diverged"], candidate, "i64")
                fresh = body.let(f"icmp slt i64 {body.let(f'load i64, ptr {place}')}, 0")
                with body.when(fresh):
                    body.run(f"store i64 {reached}, ptr {place}")
                    left = body.let(f"sub i64 {body.let(f'load i64, ptr {alive}')}, 1")
                    body.run(f"store i64 {left}, ptr {alive}")

    def _record(self, sample: str) -> None:
        """Write states; NaN for candidates that diverged."""
        body, n = self.body, self.program.joints
        records = body.let(f"add i64 {self.value['samples']}, 1")
        with self.each() as (candidate, lane):
            place = body.let(f"add i64 {body.let(f'mul i64 {candidate}, {records}')}, {sample}")
            diverged = body.load(self.value["diverged"], candidate, "i64")
            fine = body.let(f"icmp slt i64 {diverged}, 0")
            nan = body.constant(float("nan"))
            parts = [("q_out", n), ("qd_out", n), ("qdd_out", n)]
            parts += [("law_out", self.law)] * bool(self.law)
            element = 0
            for name, size in parts:
                target = body.at(self.value[name], body.let(f"mul i64 {place}, {size}"))
                for i in range(size):
                    state = body.load(self.element("state", element), lane)
                    shown = body.let(f"select i1 {fine}, double {state}, double {nan}")
                    body.store(shown, target, i)
                    element += 1


# For accelerations over steps of 0.1 ms: velocities of 10 rad/s round to 2e-15, rates to 2e-11.
_CHECK_TOLERANCE = 1e-9


@dataclass(frozen=True)
class RolloutInputs:
    """Initial state and inputs of a rollout.

    The coefficients follow the velocity and acceleration in `measured`, each (*batch, steps, joint)
    or without batch, or without them the simulated motion. Their `hidden_state` after the first
    sample is computed from that sample if it is not given.
    """

    q0: Tensor  # [rad], (*batch, joint)
    qd0: Tensor  # [rad/s], (*batch, joint)
    tau: Tensor  # held over each step [N m], (steps, joint) or (*batch, steps, joint)
    step: Tensor  # sample times [s], (steps,) or (*batch, steps)
    substeps: int = 1  # integration steps per sample
    measured: tuple[Tensor, Tensor] | None = None
    hidden_state: Tensor | None = None  # (*batch, joint, state_size)
    law_state: Tensor | None = None  # of a law with memory, (*batch, joint, state)


class CompiledRollout:
    """Rollouts of a plant with friction, traced on creation and compiled at the first call.

    Parameters and floating-point buffers remain inputs: they are read at every call, so a fit can
    change them, and they may differ between candidates. Everything else (Python numbers, integer
    and boolean buffers, the modules' structure) becomes constant.

    Args:
        plant: module with `joints`, `forward_dynamics` and `load`.
        friction: module with `coefficients` and `torque`; if its coefficients have a hidden state,
            also with `state_size` > 0, `initial_state`, `advance` and `coefficients_from`.
        step: the function to repeat, `(plant, friction, q, qd, tau, coefficients, step) ->
            (q, qd, qdd)`; for instance `nfriction.simulation.rk4.rk4_step`.

    Attributes:
        parameter_names: names under which `parameters` may be given.
        digest: a hash of the whole computation; code for another plant and friction model with
            the same digest gives the same results for the same parameters.

    Raises:
        UnsupportedOperation: if the modules use an operation that has no scalar form here.
        TypeError: if one of them is not a module.
    """

    def __init__(self, plant: Any, friction: Any, step: Callable[..., Any]) -> None:
        for name, module in (("plant", plant), ("friction", friction)):
            if not isinstance(module, nn.Module):
                raise TypeError(f"`{name}` must be a torch module, got {type(module).__name__}.")
        system = ForcedSystem(plant, friction, step)
        self._system = system
        self.joints = int(system.plant.joints)
        self._module = FunctionalModule(system)
        self.parameter_names = tuple(self._module.shapes)
        self._traced = self._module.trace(self._examples())
        self.digest = f"{self._module.shapes} {self._traced.digest()}"

    @cached_property
    def kernel(self) -> Kernel:
        """The compiled code, emitted on first use."""
        program = arrange(self._traced, self._system.law_size)
        return Kernel(lambda width: RolloutDriver(program, width), LAYOUT)

    def _examples(self) -> dict[str, Tensor]:
        n, device = self.joints, self._module.device
        generator = torch.Generator().manual_seed(0)
        shapes = {"q": 1.0, "qd": 3.0, "tau": 1.0, "seen_qd": 3.0, "seen_qdd": 10.0}
        found = {
            name: scale * torch.randn(n, generator=generator, dtype=torch.float64)
            for name, scale in shapes.items()
        }
        seen = [found[name].to(device) for name in ("seen_qd", "seen_qdd")]
        with torch.no_grad():
            held = self._system.friction.coefficients(*seen)
            if self._system.memory_size:
                found["memory"] = self._system.friction.initial_state(*seen)
        if self._system.law_size:
            found["law"] = torch.zeros(n, self._system.law_size, dtype=torch.float64)
        step = torch.full((1,), 1e-3, dtype=torch.float64)
        return {**found, "step": step, "held": held}

    def __call__(
        self,
        inputs: RolloutInputs,
        parameters: Mapping[str, Tensor] | None = None,
        threads: int = 1,
    ) -> tuple[Tensor, ...]:
        """States at every sample: q, qd, qdd, each (*batch, steps + 1, joint), and the law's state.

        They are NaN from the first sample whose state is not finite or too fast. The acceleration
        is that of the first stage of the preceding step; at the start, that without friction.

        Args:
            inputs: initial states, sample times, and everything that drives the motion.
            parameters: values that differ from the modules', by name ("plant.…", "friction.…"),
                shape (batch, *the parameter's own) or just the parameter's own.
            threads: number of threads among which the batch is divided.

        Raises:
            ValueError: for shapes that do not match, or an unknown name.
        """
        steps, substeps, n = inputs.step.shape[-1], inputs.substeps, self.joints
        if substeps < 1 or threads < 1:
            raise ValueError(
                f"`substeps` and `threads` must be 1 or more, got {substeps} and {threads}."
            )
        batch = inputs.q0.shape[:-1]

        def rows(x: Tensor, trailing: int) -> Tensor:
            """Candidates on one leading axis; values shared by all have no such axis."""
            x = x.detach()
            own = x.shape[x.ndim - trailing :]
            if x.ndim > trailing:
                x = x.expand(*batch, *own).reshape(-1, *own)
            # An expanded constant does not need one value per step.
            return x[0] if x.ndim == trailing and not x.stride(0) else x

        given = {
            name: rows_of(name, value.detach().reshape(-1, n), (n,))
            for name, value in (("q0", inputs.q0), ("qd0", inputs.qd0))
        }
        given["tau"] = series("tau", rows(inputs.tau, 2), steps, (n,))
        given["step"] = series("step", to_array(rows(inputs.step, 1)) / substeps, steps, ())
        if inputs.measured is not None:
            for name, value in zip(("drive_qd", "drive_qdd"), inputs.measured, strict=True):
                given[name] = series("measured", rows(value, 2), steps, (n,))
        size, law = self._system.law_size, inputs.law_state
        law = inputs.q0.new_zeros(n, size) if size and law is None else law
        kept = {"memory": (inputs.hidden_state, self._system.memory_size), "law": (law, size)}
        for name, (state, numbers) in kept.items():
            if state is not None:
                flat = rows(state, 2).reshape(-1, *state.shape[-2:])
                given[name] = rows_of(name, flat, (n, numbers))
        p, counts = parameter_rows(self._module, parameters or {})
        count = common_rows(counts | {name: one.rows for name, one in given.items()})
        outputs = {name: np.empty((count, steps + 1, n)) for name in LAYOUT.outputs[:3]}
        outputs |= {"law_out": np.empty((count, steps + 1, n, size))} if size else {}
        settings = {"samples": steps, "substeps": substeps,
                    "driven": inputs.measured is not None,
                    "remembered": inputs.hidden_state is not None}  # fmt: skip
        lost = {"diverged": np.empty(count, dtype=np.int64)}
        self.kernel(count, p, given, outputs | lost, settings, threads)
        found = map(torch.from_numpy, outputs.values())
        return tuple(x.reshape(*batch, *x.shape[1:]) for x in found)

    @torch.no_grad()
    def check(self, eager: Callable[[RolloutInputs], tuple[Tensor, ...]]) -> None:
        """Compare two steps from random states with the same steps in eager torch.

        Args:
            eager: states that torch gives for inputs, as this rollout does.

        Raises:
            SelfCheckFailed: if they differ by more than rounding explains.
        """
        # Two steps, so that a hidden state advances once; short, so that errors show in the rate.
        steps, dt, size, device = 2, 1e-4, self._system.law_size, self._module.device
        generator = torch.Generator().manual_seed(1)
        scales = (1.0, 1.0, 3.0)  # of torque, position and velocity, typical of mechanisms
        for _ in range(3):
            tau, q, qd = (
                s * torch.randn(self.joints, generator=generator, dtype=torch.float64).to(device)
                for s in scales
            )
            step = q.new_full((steps,), dt)
            law = q.new_zeros(self.joints, size) if size else None
            inputs = RolloutInputs(q, qd, tau.expand(steps, -1), step, law_state=law)
            rate, expected = (to_array(f(inputs)[1][-1].to(qd) - qd) / dt for f in (self, eager))
            scale = _CHECK_TOLERANCE * (1.0 + np.abs(expected).max())
            if not np.allclose(rate, expected, rtol=0.0, atol=scale, equal_nan=True):
                raise SelfCheckFailed(
                    f"compiled code accelerates by {rate} where torch gives {expected} at q={q}, "
                    f"qd={qd}; please report this, and use the torch rollout "
                    '(`backend="torch"`) meanwhile.'
                )

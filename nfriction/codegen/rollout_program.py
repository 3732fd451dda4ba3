"""A whole rollout: what is traced of it, and the loops around that."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from torch import Tensor, nn

from nfriction.codegen.batch import Driver, Layout
from nfriction.codegen.emit import write_function
from nfriction.codegen.graph import Program
from nfriction.codegen.ir import real
from nfriction.codegen.scalar import Graph, Node
from nfriction.codegen.transform import hoist

LAYOUT = Layout(
    series=("q0", "qd0", "tau", "step", "drive_qd", "drive_qdd", "memory", "law"),
    outputs=("q_out", "qd_out", "qdd_out", "diverged", "law_out"),
    settings=("samples", "substeps", "driven", "remembered"),
)
# A joint faster than this [rad/s or m/s] has left any mechanism's range: it has diverged.
SPEED_LIMIT = 1e6
# Of `ForcedSystem`; all other inputs of its trace are parameters.
INPUTS = ("q", "qd", "tau", "step", "held", "seen_qd", "seen_qdd", "memory", "law")


class ForcedSystem(nn.Module):
    """Plant and friction as the one function that a rollout repeats.

    Args:
        plant: the mechanism.
        friction: the friction model.
        step: `(plant, friction, q, qd, tau, coefficients, step) -> (q, qd, qdd)`; of a friction law
            with memory its state is a last argument, and the state afterwards a last result.
    """

    def __init__(self, plant: Any, friction: Any, step: Callable[..., Any]) -> None:
        super().__init__()
        self.plant = plant
        self.friction = friction
        self.step = step
        self.remembers = int(getattr(friction, "state_size", 0)) > 0
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
    """The functions of a rollout as groups of nodes.

    Attributes:
        joints: number of joints.
        once: values computed once a rollout.
        start: acceleration without friction, which is the one known at the start.
        held: coefficients of a motion, and of a memory where they have one.
        step: q, qd and qdd after a step with these, and the state of a law with memory.
        within: whether that state is finite and no joint too fast.
        begin: memory of the coefficients after the first sample; empty where they have none.
        advance: memory after a sample, from that before.
        places: array and index of the input nodes.
    """

    joints: int
    once: tuple[Node, ...]
    start: tuple[Node, ...]
    held: tuple[Node, ...]
    step: tuple[Node, ...]
    within: Node
    begin: tuple[Node, ...]
    advance: tuple[Node, ...]
    places: dict[int, tuple[str, int]]


def arrange(program: Program, law_size: int = 0) -> RolloutProgram:
    """Arrange the trace of a `ForcedSystem` whose law has an internal state of that size."""
    graph, outputs = program.graph, [port.nodes for port in program.outputs]
    law = outputs.pop(3) if law_size else ()
    q, qd, qdd, start, held, *remembered = outputs
    begin, advance = remembered or ((), ())
    joints = len(q)
    within = _within(graph, q, qd)
    groups = [start, held, (*q, *qd, *qdd, *law), (within,), begin, advance]
    groups, once = hoist(graph, groups)
    start, held, step, (within,), begin, advance = groups
    at = {"q": ("state", 0), "qd": ("state", joints), "seen_qdd": ("seen", joints),
          "seen_qd": ("seen", 0), "law": ("state", 3 * joints)}  # fmt: skip
    places: dict[int, tuple[str, int]] = {}
    parameters = 0
    for port in program.inputs:
        own = port.name in INPUTS
        array, offset = at.get(port.name, (port.name, 0)) if own else ("p", parameters)
        places |= {node.number: (array, offset + i) for i, node in enumerate(port.nodes)}
        parameters += 0 if own else len(port.nodes)
    return RolloutProgram(joints, tuple(once), start, held, step, within, begin, advance, places)


def _within(graph: Graph, q: Sequence[Node], qd: Sequence[Node]) -> Node:
    """A test for finite and slow enough states; numbers that are not finite compare false."""
    zero, limit = graph.constant(0.0), graph.constant(SPEED_LIMIT)
    # A number minus itself is zero unless it is NaN or infinite.
    tests = [graph.apply("eq", graph.apply("sub", x, x), zero) for x in q]
    tests += [graph.apply("le", graph.apply("abs", x), limit) for x in qd]
    return graph.total(tests, "and")


class RolloutDriver(Driver):
    """The loops over candidates, samples and substeps in which a program's functions are called."""

    def __init__(self, program: RolloutProgram, width: int) -> None:
        n = program.joints
        sizes = {"state": len(program.step), "seen": 2 * n, "tau": n, "step": 1,
                 "held": len(program.held), "memory": len(program.advance), "within": 1,
                 "alive": 1}  # fmt: skip
        super().__init__(LAYOUT, width, sizes, len(program.once))
        self.program = program
        self._functions()
        with self.entry():
            self._candidates()

    def _functions(self) -> None:
        parts, body = self.program, self.body
        known = parts.places | {n.number: ("once", i) for i, n in enumerate(parts.once)}

        def function(
            name: str, inputs: Sequence[str], outputs: dict[str, Any], seldom: bool = False
        ) -> None:
            shared = ["p", "once"]
            write_function(body, name, outputs, known, shared, inputs, self.width, seldom)

        once = {"once": parts.once}
        write_function(body, "nf_once", once, parts.places, ["p"], [], seldom=True)
        function("nf_start", ["state", "tau"], {"rate": parts.start}, seldom=True)
        function("nf_held", ["seen", "memory"], {"held": parts.held})
        function("nf_begin", ["seen"], {"memory": parts.begin}, seldom=True)
        function("nf_advance", ["seen", "memory"], {"memory": parts.advance})
        after = {"state": parts.step, "within": (parts.within,)}
        function("nf_step", ["state", "tau", "step", "held"], after)

    def _candidates(self) -> None:
        """The candidates that are computed together."""
        body, n, value = self.body, self.program.joints, self.value
        self.call("nf_once", "own_p", "room.once")
        self.gather("q0", n, value["room.state"])
        self.gather("qd0", n, self.element("state", n))
        self.gather("tau", n, value["room.tau"])
        self.law = len(self.program.step) - 3 * n
        if self.law:
            self.gather("law", self.law, self.element("state", 3 * n))
        value["rate"] = self.element("state", 2 * n)
        self.call("nf_start", "own_p", "room.once", "room.state", "room.tau", "rate")
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
            # A controller at the sample rate holds its coefficients over the whole sample.
            self.call("nf_held", "own_p", "room.once", "sees", "room.memory", "room.held")
        with body.loop("0", value["substeps"]):
            if not self.program.advance:
                self.call("nf_held", "own_p", "room.once", "sees", "room.memory", "room.held")
            rooms = ("state", "tau", "step", "held", "within")
            self.call("nf_step", "own_p", "room.once", *(f"room.{name}" for name in rooms))
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
            self.call("nf_advance", "own_p", "room.once", "sees", "room.memory")
        with body.when(body.let(f"and i1 {first}, {given}")):
            self.gather("memory", size, self.value["room.memory"])
        with body.when(body.let(f"and i1 {first}, {unknown}")):
            self.call("nf_begin", "own_p", "room.once", "sees", "room.memory")

    def _stop(self, k: str, alive: str) -> None:
        """Note which candidates are lost; their state goes on from zero, unseen."""
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
        """Write states; NaN of candidates that are lost."""
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

"""The functions that a rollout is made of, whatever the language.

`driver_c` and `driver_python` put the same RK4 driver around them. Both give it the same entry
point `nf_rollout` with the same arguments: candidates `first` to `last`, flat arrays and strides.
Python's also takes room for what C keeps on its stack.
"""

from dataclasses import dataclass

from nfriction.codegen.graph import Program
from nfriction.codegen.partition import partition
from nfriction.codegen.scalar import Level, Node

LEVELS = {
    "qd_held": Level.STEP,
    "qdd_held": Level.STEP,
    "memory": Level.STEP,
    "tau": Level.STEP,
    "q": Level.STAGE,
    "qd": Level.STAGE,
}
"""How long the inputs of a rollout live; everything else is a parameter."""


@dataclass(frozen=True)
class Pieces:
    """The functions of a rollout as groups of nodes.

    Attributes:
        joints: number of joints.
        once: values computed once a rollout.
        step: values computed once a step.
        stage: acceleration with friction.
        start: acceleration without friction, which seeds the held acceleration.
        begin: memory of the coefficients after the first sample; empty where they have none.
        advance: memory after a sample, from that before.
        inputs: text of the input nodes by number, elements of arrays.
    """

    joints: int
    once: tuple[Node, ...]
    step: tuple[Node, ...]
    stage: tuple[Node, ...]
    start: tuple[Node, ...]
    begin: tuple[Node, ...]
    advance: tuple[Node, ...]
    inputs: dict[int, str]

    @property
    def hoisted(self) -> dict[int, str]:
        """Text of the hoisted values, as the step and the stage read them."""
        once = {node.number: f"once[{i}]" for i, node in enumerate(self.once)}
        return once | {node.number: f"step[{i}]" for i, node in enumerate(self.step)}


def pieces(program: Program) -> Pieces:
    """Arrange a program's outputs by how often their values are needed.

    Args:
        program: with outputs (stage, start), or (stage, start, begin, advance) where the
            coefficients have a memory.
    """
    stage, start, *remembered = program.outputs
    begin, advance = (port.nodes for port in remembered) if remembered else ((), ())
    joints = len(stage.nodes)
    split = partition(program.graph, stage.nodes)
    inputs: dict[int, str] = {}
    offset = 0
    for port in program.inputs:
        held = port.name in LEVELS
        for i, node in enumerate(port.nodes):
            inputs[node.number] = f"{port.name}[{i}]" if held else f"p[{offset + i}]"
        if not held:
            offset += len(port.nodes)
    return Pieces(
        joints,
        split.hoisted[Level.PARAMETER],
        split.hoisted[Level.STEP],
        split.outputs,
        start.nodes,
        begin,
        advance,
        inputs,
    )


# Argument arrays of the functions, in order.
ONCE = ["p"]
STEP = ["p", "once", "tau", "qd_held", "qdd_held", "memory"]
STAGE = ["p", "once", "step", "tau", "qd_held", "qdd_held", "memory", "q", "qd"]
START = ["p", "tau", "q", "qd"]
BEGIN = ["p", "qd_held", "qdd_held"]
ADVANCE = ["p", "qd_held", "qdd_held", "memory"]

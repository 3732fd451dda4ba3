"""Compile single functions, and fold what their parameters decide."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from nfriction.codegen import arguments, build, kernels
from nfriction.codegen.derivative import with_jacobian
from nfriction.codegen.errors import SelfCheckFailed
from nfriction.codegen.function_source import c_source, python_source
from nfriction.codegen.graph import Program
from nfriction.codegen.lift import Lifted, Method
from nfriction.codegen.partition import Partition, partition
from nfriction.codegen.scalar import Level, Node, evaluate

Array = np.ndarray

_CHECK_TOLERANCE = 1e-10


def compile_function(
    function: Callable[..., Any],
    example_inputs: Sequence[Tensor],
    *,
    jacobian: Sequence[int] = (),
    backend: build.Backend = "auto",
) -> "CompiledFunction":
    """Compile a function of tensors.

    Args:
        function: a module, a bound method of one (its parameters stay inputs, read at every
            call), or any callable (tensors it closes over are baked in).
        example_inputs: float64 tensors of the right shapes, without a batch dimension.
        jacobian: positions of the inputs by which to differentiate; the exact Jacobian, (elements
            of all outputs, elements of these inputs), is then returned last.
        backend: "c", "numba", or "auto" for the first of them that is there.

    Returns:
        A callable on NumPy arrays whose first axis is a batch.

    Raises:
        NoBackend, UnsupportedOperation, CompilerError, SelfCheckFailed: see `compile_rollout`.
    """
    served = build.choose(backend)
    compiled = CompiledFunction(function, example_inputs, served, jacobian)
    compiled.check(example_inputs)
    return compiled


class CompiledFunction:
    """A compiled function; made by `compile_function`.

    Attributes:
        backend: "c" or "numba".
        source: what was compiled.
    """

    def __init__(
        self,
        function: Callable[..., Any],
        example_inputs: Sequence[Tensor],
        backend: str,
        jacobian: Sequence[int] = (),
    ) -> None:
        self.backend = backend
        self._function = function
        self._jacobian = tuple(jacobian)
        self._lifted = Lifted(Method(function))
        inputs = {f"x{i}": x for i, x in enumerate(example_inputs)}
        program = self._lifted.trace(inputs, dict.fromkeys(inputs, Level.STAGE))
        if jacobian:
            program = with_jacobian(program, [f"x{i}" for i in jacobian])
        self._inputs = [p.shape for p in program.inputs if p.name in inputs]
        self._outputs = [p.shape for p in program.outputs]
        split, groups = _split(program)
        emit = c_source if backend == "c" else python_source
        self.source = emit(program, split, groups, self._inputs)
        arrays = [kernels.ARRAY] * (1 + len(self._inputs) + len(self._outputs))
        if backend == "c":
            # A Jacobian is long straight code, whose optimisation takes minutes and gains little.
            level = "-O1" if jacobian else "-O3"
            self._kernel = _c_kernel(self.source, level, arrays)
        else:
            self._kernel = _numba_kernel(self.source, len(split.hoisted[Level.PARAMETER]), arrays)

    def __call__(self, *inputs: Any) -> Any:
        """Evaluate row by row.

        Args:
            *inputs: arrays of shape (batch, *shape of the example).

        Returns:
            One array (batch, *shape), or a tuple of them where the function returns several.

        Raises:
            ValueError: if shapes do not fit.
        """
        if len(inputs) != len(self._inputs):
            raise ValueError(f"expected {len(self._inputs)} inputs, got {len(inputs)}.")
        given = [arguments.to_array(x) for x in inputs]
        for i, (x, shape) in enumerate(zip(given, self._inputs, strict=True)):
            if x.shape[1:] != shape or not x.ndim:
                raise ValueError(f"input {i} must be (batch, *{shape}), got {x.shape}.")
        rows = arguments.candidates({f"input {i}": len(x) for i, x in enumerate(given)})
        out = self.bound()(rows, *(arguments.repeated(x, rows) for x in given))
        return out[0] if len(out) == 1 else tuple(out)

    def bound(self) -> Callable[..., list[arguments.Array]]:
        """The function with its parameters as they are now and no checks, for calls in a row.

        Returns:
            `(rows, *inputs) -> outputs`, where inputs are flat, contiguous and float64, and
            outputs (rows, *shape).
        """
        p, _ = arguments.parameter_rows(self._lifted.values(), {})
        flat = p.reshape(-1)

        def call(rows: int, *inputs: arguments.Array) -> list[arguments.Array]:
            out = [np.empty((rows, *shape)) for shape in self._outputs]
            self._kernel(rows, flat, *inputs, *(o.reshape(-1) for o in out))
            return out

        return call

    def check(self, example_inputs: Sequence[Tensor]) -> None:
        """Compare with eager torch at the example inputs and near them.

        Raises:
            SelfCheckFailed: if they differ by more than rounding explains.
        """
        generator = torch.Generator().manual_seed(0)
        for spread in (0.1,) if self._jacobian else (0.0, 0.01, 0.1):
            inputs = [
                x.detach() + spread * torch.randn(x.shape, generator=generator, dtype=x.dtype)
                for x in example_inputs
            ]
            with torch.no_grad():
                eager = self._eager([x.to(self._lifted.device) for x in inputs])
            ours = self(*(x[None] for x in inputs))
            for a, b in zip(
                ours if isinstance(ours, tuple) else (ours,),
                eager,
                strict=True,
            ):
                expected = arguments.to_array(b)
                tolerance = _CHECK_TOLERANCE
                if not np.allclose(a[0], expected, tolerance, tolerance, equal_nan=True):
                    raise SelfCheckFailed(
                        f"the compiled function gives {a[0]} where torch gives {expected}; "
                        "please report this, and use the torch module meanwhile."
                    )

    def _eager(self, inputs: list[Tensor]) -> tuple[Tensor, ...]:
        """All outputs, the Jacobian among them, in eager torch."""

        def outputs(*given: Tensor) -> Tensor:
            return torch.cat([y.reshape(-1) for y in _tuple(self._function(*given))])

        eager = _tuple(self._function(*inputs))
        if not self._jacobian:
            return eager
        blocks = torch.func.jacfwd(outputs, argnums=self._jacobian)(*inputs)
        flat = [block.reshape(block.shape[0], -1) for block in blocks]
        return (*eager, torch.cat(flat, -1))


def _tuple(found: Any) -> tuple[Tensor, ...]:
    return tuple(found) if isinstance(found, (tuple, list)) else (found,)


@dataclass(frozen=True)
class Folded:
    """A traced function in which all that depends on parameters alone is a known number.

    Attributes:
        program: what was traced.
        outputs: nodes of each output, in row-major order.
        known: value of each node that the parameters decide and others read, by node number.
    """

    program: Program
    outputs: list[tuple[Node, ...]]
    known: dict[int, float]


def fold(function: Callable[..., Any], inputs: Mapping[str, Tensor]) -> Folded:
    """Trace a function and compute, in float64, what its parameters decide.

    Args:
        function: a module, a bound method of one, or any callable.
        inputs: example tensors (float64) by name, in the order of the function's arguments.

    Raises:
        UnsupportedOperation: an operation without scalar form.
    """
    lifted = Lifted(Method(function))
    program = lifted.trace(dict(inputs), dict.fromkeys(inputs, Level.STAGE))
    split, groups = _split(program)
    table = _read_parameters(split)
    values = evaluate(table, _port_values(program, lifted))
    known = {node.number: float(v) for node, v in zip(table, values, strict=True)}
    return Folded(program, groups, known)


def _split(program: Program) -> tuple[Partition, list[tuple[Node, ...]]]:
    nodes = [node for port in program.outputs for node in port.nodes]
    split = partition(program.graph, nodes)
    groups, start = [], 0
    for port in program.outputs:
        groups.append(split.outputs[start : start + len(port.nodes)])
        start += len(port.nodes)
    return split, groups


def _read_parameters(split: Partition) -> list[Node]:
    """Parameter-level nodes that the row function reads: hoisted ones and bare inputs."""
    hoisted = set(split.hoisted[Level.PARAMETER])
    read: dict[int, Node] = {}
    stack = list(split.outputs)
    seen: set[int] = set()
    while stack:
        node = stack.pop()
        if node.number in seen:
            continue
        seen.add(node.number)
        if node in hoisted or (node.op == "input" and node.level == Level.PARAMETER):
            read[node.number] = node
        else:
            stack.extend(node.args)
    return [read[number] for number in sorted(read)]


def _port_values(program: Program, lifted: Lifted) -> dict[str, Array]:
    flat = [value.reshape(-1) for value in lifted.values().values()]
    return {f"p{i}": value for i, value in enumerate(flat)}


def _c_kernel(source: str, level: str, arrays: Sequence[type]) -> Callable[..., None]:
    function = build.build_c(source, level).nf_function
    function.restype, function.argtypes = None, [kernels.COUNT, *arrays]
    return kernels.of_arrays(function)


def _numba_kernel(source: str, once: int, arrays: Sequence[type]) -> Callable[..., None]:
    types = [kernels.ARRAY, kernels.COUNT, *arrays]
    function = kernels.of_arrays(build.build_numba(source, "nf_function", types))
    return lambda rows, *given: function(np.empty(once), rows, *given)

"""Trace torch code into a graph of scalars.

The function runs once on `ScalarTensor`s: tensors with an array of scalar nodes in addition to an
example value. Every ATen operation that reaches the dispatcher (composite ones arrive already
decomposed) acts on both, so views cost nothing, in-place writes are visible through views, two
equal tensors remain two inputs, and shapes and dtypes are those of torch. If Python needs a value
(`if x > 0`, `.item()`), the trace stops with an error instead of hard-coding one branch. Tracing
takes milliseconds; `torch.export` takes seconds.
"""

import hashlib
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.utils._mode_utils import no_dispatch
from torch.utils._python_dispatch import TorchDispatchMode

from nfriction.codegen.operations import OPERATIONS, constants
from nfriction.codegen.scalar import Graph, Node, UnsupportedOperation, UpdateRate, reachable

# Limit on the elements of a traced tensor and on the scalar operations of a traced function.
LIMIT = 50_000


@dataclass(frozen=True)
class Port:
    """An input or output of a program: its name, shape and scalar nodes in row-major order."""

    name: str
    shape: tuple[int, ...]
    nodes: tuple[Node, ...]


@dataclass(frozen=True)
class Program:
    """A traced function: its graph, inputs and outputs."""

    graph: Graph
    inputs: tuple[Port, ...]
    outputs: tuple[Port, ...]

    def digest(self) -> str:
        """A hash of the whole computation: inputs, operations, constants and outputs."""
        nodes = reachable(node for port in self.outputs for node in port.nodes)
        ports = [
            (port.name, port.shape, [node.number for node in port.nodes])
            for port in (*self.inputs, *self.outputs)
        ]
        return hashlib.sha256(repr((ports, nodes)).encode()).hexdigest()

    def places(self, arrays: Mapping[str, tuple[str, int]]) -> dict[int, tuple[str, int]]:
        """Array and index of each input node; inputs without an array are parameters, in `p`."""
        found: dict[int, tuple[str, int]] = {}
        parameters = 0
        for port in self.inputs:
            array, offset = arrays.get(port.name, ("p", parameters))
            found |= {node.number: (array, offset + i) for i, node in enumerate(port.nodes)}
            parameters += len(port.nodes) * (array == "p")
        return found


class ScalarTensor(Tensor):
    """A tensor whose elements are nodes of a scalar graph."""

    nodes: np.ndarray  # of `Node`s, shaped like the tensor
    example: Tensor  # an ordinary one with the same shape, strides and dtype
    graph: Graph  # where the nodes live

    @staticmethod
    def __new__(cls, nodes: np.ndarray, example: Tensor, graph: Graph) -> "ScalarTensor":
        if example.is_complex():
            raise UnsupportedOperation("complex arithmetic")
        if nodes.size > LIMIT or len(graph) > LIMIT:
            raise UnsupportedOperation(
                "unrolling", f"met more than {LIMIT} scalars; the model is too large to unroll"
            )
        self = torch.Tensor._make_wrapper_subclass(
            cls, example.shape, strides=example.stride(), dtype=example.dtype
        )
        self.nodes, self.example, self.graph = nodes, example, graph
        return self

    def __repr__(self) -> str:  # type: ignore[override]
        return f"ScalarTensor(shape={tuple(self.nodes.shape)})"

    @classmethod
    def __torch_dispatch__(  # type: ignore[override]
        cls, func: Any, types: Any, args: tuple[Any, ...] = (), kwargs: Any = None
    ) -> Any:
        raise UnsupportedOperation(_name(func), "was called on a traced tensor after its trace")


class _Rules:
    """Rules of tracing: nothing is random, and newly created tensors are traceable."""

    graph: Graph

    def __torch_dispatch__(
        self, func: Any, types: Any, args: tuple[Any, ...] = (), kwargs: Any = None
    ) -> Any:
        kwargs = kwargs or {}
        if torch.Tag.nondeterministic_seeded in func.tags:
            raise UnsupportedOperation(_name(func), "draws random numbers")
        tensors: list[Tensor] = []
        for value in (*args, *kwargs.values()):
            _each(lambda x: tensors.append(x) if isinstance(x, Tensor) else None, value)
        traced = [tensor for tensor in tensors if isinstance(tensor, ScalarTensor)]
        if traced:
            return _interpret(self, func, args, kwargs, traced)
        out = func(*args, **kwargs)
        if isinstance(out, Tensor) and not tensors:
            return ScalarTensor(constants(self.graph, out), out, self.graph)
        return out


class _Watch(_Rules, TorchDispatchMode):
    # torch wraps a `__torch_dispatch__` defined in the mode's own class so that its first use
    # imports all of torch._dynamo (2 s); it leaves an inherited one alone.
    def __init__(self, graph: Graph) -> None:
        super().__init__()
        self.graph = graph


def _name(func: Any) -> str:
    return str(func._schema.name).removeprefix("aten::")


def _interpret(
    watch: Any, func: Any, args: tuple[Any, ...], kwargs: dict[str, Any], leaves: list[ScalarTensor]
) -> Any:
    graph = watch.graph
    name = _name(func)
    in_place = func._schema.is_mutable
    if name in ("_local_scalar_dense", "item", "is_nonzero"):
        if leaves[0].nodes.flat[0].op != "constant":
            raise UnsupportedOperation(
                name, "asks for a value that is known only at run time (use `torch.where`)"
            )
        return leaves[0].example.item()
    operation = OPERATIONS.get(name.removesuffix("_") if in_place else name)
    if operation is None or (in_place and not isinstance(args[0], ScalarTensor)):
        with watch:  # a mode is off inside its own handler
            if not in_place:
                composite = func.decompose(*args, **kwargs)
                if composite is not NotImplemented:
                    return composite
                from torch._decomp import decomposition_table

                if func in decomposition_table:
                    return decomposition_table[func](*args, **kwargs)
            raise UnsupportedOperation(name)

    def nodes_of(leaf: Any) -> Any:
        if isinstance(leaf, ScalarTensor):
            return leaf.nodes
        return constants(graph, leaf) if isinstance(leaf, Tensor) else leaf

    def given(function: Callable[[Any], Any]) -> tuple[list[Any], dict[str, Any]]:
        return _each(function, args), {name: _each(function, x) for name, x in kwargs.items()}

    own, named = given(nodes_of)
    nodes = operation(graph, *own, **named)
    own, named = given(lambda x: x.example if isinstance(x, ScalarTensor) else x)
    example = func(*own, **named)
    if torch.Tag.inplace_view in func.tags:
        # `squeeze_` and similar (used by torch's `linear`) only change shape and strides.
        included = torch._C._meta_in_tls_dispatch_include()
        torch._C._set_meta_in_tls_dispatch_include(True)
        try:
            with no_dispatch():
                func(*args, **kwargs)
        finally:
            torch._C._set_meta_in_tls_dispatch_include(included)
        args[0].nodes = nodes
        return args[0]
    if in_place:
        target = args[0]
        if target.is_floating_point() and target.dtype != torch.float64:
            raise UnsupportedOperation(name, f"writes in place into {target.dtype}, not float64")
        if not target.nodes.flags.writeable:
            raise UnsupportedOperation(name, "writes in place through a view that is not traced")
        target.nodes[...] = nodes
        return target
    if isinstance(example, (tuple, list)):
        wrapped = [_wrap(n, e, graph, name, leaves) for n, e in zip(nodes, example, strict=True)]
        return type(example)(wrapped)
    return _wrap(nodes, example, graph, name, leaves)


def _each(function: Callable[[Any], Any], value: Any) -> Any:
    """Map over nested lists; torch's `tree_map` would take half of a trace's time."""
    if isinstance(value, (list, tuple)):
        return [_each(function, x) for x in value]
    return function(value)


def _wrap(
    nodes: np.ndarray, example: Tensor, graph: Graph, name: str, leaves: list[ScalarTensor]
) -> ScalarTensor:
    narrowed = example.is_floating_point() and example.dtype != torch.float64
    if narrowed and any(leaf.dtype == torch.float64 for leaf in leaves):
        raise UnsupportedOperation(name, f"turns float64 into {example.dtype}")
    if nodes.shape != tuple(example.shape):
        raise AssertionError(f"`{name}` traced to {nodes.shape}, not {tuple(example.shape)}")
    return ScalarTensor(nodes, example, graph)


def trace(
    function: Callable[..., Any], inputs: Mapping[str, Tensor], parameters: Collection[str] = ()
) -> Program:
    """Run `function(**inputs)` symbolically; it returns a tensor or a tuple of tensors.

    The inputs are float64 examples, those named in `parameters` the same over many calls.
    """
    graph, ports, arguments = Graph(), [], {}
    for name, example in inputs.items():
        if example.dtype != torch.float64:
            raise ValueError(
                f"`{name}` must be float64, got {example.dtype}; call `.double()` on the module."
            )
        # Copy, so that inputs never share memory.
        example = example.detach().to("cpu").clone(memory_format=torch.contiguous_format)
        rate = UpdateRate.PARAMETER if name in parameters else UpdateRate.STEP
        nodes = [graph.input(name, i, rate) for i in range(example.numel())]
        ports.append(Port(name, tuple(example.shape), tuple(nodes)))
        array = np.empty(len(nodes), dtype=object)
        array[:] = nodes
        arguments[name] = ScalarTensor(array.reshape(tuple(example.shape)), example, graph)
    # Without gradients, because autograd would needlessly wrap every traced tensor.
    with torch.no_grad(), _Watch(graph):
        outputs = function(**arguments)
    found = []
    for i, output in enumerate(outputs if isinstance(outputs, (tuple, list)) else (outputs,)):
        if not isinstance(output, Tensor):
            raise ValueError(f"a compiled function returns tensors, got {type(output).__name__}.")
        computed = output.nodes if isinstance(output, ScalarTensor) else constants(graph, output)
        found.append(Port(f"out{i}", tuple(output.shape), tuple(computed.ravel())))
    return Program(graph, tuple(ports), tuple(found))


class FunctionalModule:
    """A module whose floating-point parameters and buffers are inputs named p0, p1, ...

    Integer and boolean buffers remain constants: they index and select, so they must be known when
    code is emitted. `shapes` are those of the inputs, by their names in the module.
    """

    def __init__(self, module: nn.Module) -> None:
        self.module = module
        state = self._state()
        self.shapes = {n: tuple(t.shape) for n, t in state.items() if t.is_floating_point()}
        self._fixed = {n: t.detach().cpu() for n, t in state.items() if n not in self.shapes}

    def _state(self) -> dict[str, Tensor]:
        return {**dict(self.module.named_parameters()), **dict(self.module.named_buffers())}

    @property
    def device(self) -> torch.device:
        """The device of the module's first tensor."""
        return next((t.device for t in self._state().values()), torch.device("cpu"))

    def value(self, name: str) -> Tensor:
        """The current value of a parameter or buffer."""
        owner, _, last = name.rpartition(".")
        value: Tensor = getattr(self.module.get_submodule(owner), last)
        return value

    def trace(self, inputs: Mapping[str, Tensor]) -> Program:
        """Trace `module(**inputs)` with examples; the first inputs of the result are parameters."""
        state = self._state()
        parameters = {f"p{i}": state[name] for i, name in enumerate(self.shapes)}

        def call(**given: Tensor) -> Any:
            values = {name: given.pop(f"p{i}") for i, name in enumerate(self.shapes)}
            return torch.func.functional_call(self.module, {**self._fixed, **values}, kwargs=given)

        return trace(call, {**parameters, **inputs}, parameters)


class Method(nn.Module):
    """A module, a bound method of one, or any callable, with named arguments passed by position."""

    def __init__(self, function: Callable[..., Any]) -> None:
        super().__init__()
        owner = function if isinstance(function, nn.Module) else getattr(function, "__self__", None)
        self.owner = owner if isinstance(owner, nn.Module) else None
        self._function = [function]  # in a list, so that it is not registered a second time

    def forward(self, **inputs: Tensor) -> Any:
        return self._function[0](*inputs.values())

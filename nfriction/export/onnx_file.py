"""ONNX: a graph for ONNX Runtime and similar hosts, in double or single precision.

torch's own exporter writes Python numbers as float32, which costs a controller its parity, and
`Atan` in double, for which ONNX Runtime has no kernel. Here everything that depends only on
parameters is computed beforehand and written as a constant.
"""

import importlib
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from nfriction.export.contract import (
    LARGEST_FILE,
    OUTPUTS,
    Contract,
    ExportError,
    Runner,
    contract_of,
    first_line,
    write_verified,
)
from nfriction.export.controller import Controller, controller_of, for_single_precision
from nfriction.export.torch_files import METADATA, another_program, exported, run_from_nan, silent
from nfriction.friction.heat import Heated
from nfriction.friction.models import FrictionModel
from nfriction.io.model_file import ModelInfo
from nfriction.version import __version__

# Old enough for runtimes in use; nothing newer is needed.
OPSET, IR_VERSION = 18, 8
REAL = {"float64": np.float64, "float32": np.float32}


class Value(NamedTuple):
    """A value known only at run time: its name in the graph and its type in torch."""

    name: str
    dtype: torch.dtype


class Unknown(int):
    """The size of the batch, known only at run time; -1 as in `view`."""


class OnnxGraph:
    """Nodes, and constants by name, of a decomposed torch program with a dynamic first axis.

    Inputs and outputs are named in the program's order; `real` is the type of its floats.
    """

    def __init__(
        self,
        program: torch.export.ExportedProgram,
        inputs: Sequence[str],
        outputs: Sequence[str],
        real: Any,
    ) -> None:
        self.real = np.dtype(real)
        self.helper = importlib.import_module("onnx.helper")
        self.nodes: list[Any] = []
        self.constants: dict[str, np.ndarray] = {}
        self._known: dict[tuple[Any, ...], str] = {}
        # Parameters, buffers and constants, by the name of their placeholder.
        signature, held = program.graph_signature, {**program.state_dict, **program.constants}
        owned = {
            **signature.inputs_to_parameters,
            **signature.inputs_to_buffers,
            **signature.inputs_to_lifted_tensor_constants,
        }
        values: dict[Any, Any] = {}
        names = iter(inputs)
        for node in program.graph.nodes:
            if node.op == "placeholder" and node.name in owned:
                values[node] = held[owned[node.name]].detach()
            elif node.op == "placeholder":
                values[node] = Value(next(names), torch.float64)
            elif node.op == "call_function":
                values[node] = self._call(node, values)
        for name, node in zip(outputs, program.graph.output_node().args[0], strict=True):
            self._node("Identity", [self.name(values[node])], name)

    def emit(
        self, op: str, *operands: Any, dtype: torch.dtype | None = None, **attributes: Any
    ) -> Value:
        """Add a node, by default of its first operand's type; operands may be constants."""
        like = next(x.dtype for x in operands if isinstance(x, (Value, Tensor)))
        value = Value(f"v{len(self.nodes)}", dtype or like)
        self._node(op, [self.name(x, like) for x in operands], value.name, **attributes)
        return value

    def name(self, x: Any, like: torch.dtype = torch.float64) -> str:
        """The name of a value, or of the constant for a tensor or number."""
        if isinstance(x, Value):
            return x.name
        tensor = x.detach() if isinstance(x, Tensor) else torch.tensor(x, dtype=like)
        array = np.ascontiguousarray(tensor.numpy())
        if tensor.is_floating_point():
            array = array.astype(self.real)
        array = array.reshape(tuple(tensor.shape))
        key = (str(array.dtype), array.shape, array.tobytes())
        if key not in self._known:
            self._known[key] = f"c{len(self.constants)}"
            self.constants[self._known[key]] = array
        return self._known[key]

    def _node(self, op: str, inputs: list[str], output: str, **attributes: Any) -> None:
        self.nodes.append(self.helper.make_node(op, inputs, [output], **attributes))

    def _call(self, node: Any, values: dict[Any, Any]) -> Any:
        """Result of a node of the program: a value, or a tensor if all operands are known."""
        args, kwargs = torch.fx.node.map_arg((node.args, node.kwargs), lambda n: values[n])
        if not any(isinstance(values[n], (Value, Unknown)) for n in node.all_input_nodes):
            return node.target(*args, **kwargs)
        name = str(node.target).removeprefix("aten.").partition(".")[0]
        rule = _RULES.get(name)
        if rule is None:
            raise ExportError(
                f"the operation `{node.target}` has no ONNX form here; export the model as "
                "TorchScript, C or torch.export instead."
            )
        return rule(self, *args, **kwargs)


# Rules: the arguments are those of the ATen operation.

Rule = Callable[..., Any]


def _plain(op: str, dtype: torch.dtype | None = None) -> Rule:
    return lambda g, *operands: g.emit(op, *operands, dtype=dtype)


def _scaled(op: str) -> Rule:
    def rule(g: OnnxGraph, a: Any, b: Any, alpha: float = 1) -> Value:
        return g.emit(op, a, b if alpha == 1 else g.emit("Mul", b, alpha))

    return rule


def _integers(*numbers: int) -> Tensor:
    return torch.tensor(numbers, dtype=torch.int64)


def _clamp(g: OnnxGraph, a: Any, low: Any = None, high: Any = None) -> Value:
    raised = a if low is None else g.emit("Max", a, low)
    return raised if high is None else g.emit("Min", raised, high)


def _where(g: OnnxGraph, condition: Any, a: Any, b: Any) -> Value:
    like = next(x.dtype for x in (a, b) if isinstance(x, (Value, Tensor)))
    a, b = (x if isinstance(x, (Value, Tensor)) else torch.tensor(x, dtype=like) for x in (a, b))
    return g.emit("Where", condition, a, b, dtype=like)


def _cast(g: OnnxGraph, a: Value, dtype: torch.dtype | None = None, **_: Any) -> Value:
    if dtype is None or dtype == a.dtype:
        return a
    kind = g.real if dtype.is_floating_point else torch.zeros((), dtype=dtype).numpy().dtype
    return g.emit("Cast", a, dtype=dtype, to=int(g.helper.np_dtype_to_tensor_dtype(kind)))


def _slice(
    g: OnnxGraph, a: Any, dim: int = 0, start: Any = None, end: Any = None, step: int = 1
) -> Value:
    ends = (start or 0, 2**62 if end is None else end)
    return g.emit("Slice", a, *(_integers(n) for n in (*ends, dim, step)))


def _view(g: OnnxGraph, a: Any, size: Sequence[int]) -> Value:
    if sum(n == -1 for n in size) > 1:
        raise ExportError("a view with two sizes known only at run time has no ONNX form here.")
    return g.emit("Reshape", a, _integers(*size))


def _atan(g: OnnxGraph, x: Value) -> Value:
    """Arctangent: ONNX Runtime has it in single precision; one Newton step makes it double."""
    if g.real == np.float32:
        return g.emit("Atan", x)
    single = g.emit("Atan", g.emit("Cast", x, to=1))
    y = g.emit("Cast", single, dtype=torch.float64, to=11)
    # With s = sin y and c = cos y this is tan(arctan(x) - y), so small that it is its arctangent.
    s, c = g.emit("Sin", y), g.emit("Sin", g.emit("Add", y, 0.5 * math.pi))
    tangent = g.emit(
        "Div", g.emit("Sub", g.emit("Mul", x, c), s), g.emit("Add", c, g.emit("Mul", x, s))
    )
    return g.emit("Add", y, tangent)


_RULES: dict[str, Rule] = {
    **{
        aten: _plain(op)
        for aten, op in {
            "abs": "Abs", "exp": "Exp", "neg": "Neg", "sign": "Sign", "tanh": "Tanh", "log": "Log",
            "sqrt": "Sqrt", "sin": "Sin", "sigmoid": "Sigmoid", "reciprocal": "Reciprocal",
            "bitwise_not": "Not", "logical_not": "Not", "mul": "Mul", "div": "Div",
            "maximum": "Max", "minimum": "Min", "pow": "Pow", "bitwise_or": "Or",
            "logical_or": "Or", "bitwise_and": "And", "logical_and": "And", "bmm": "MatMul",
        }.items()
    },
    **{
        aten: _plain(op, torch.bool)
        for aten, op in {
            "eq": "Equal", "lt": "Less", "le": "LessOrEqual", "gt": "Greater",
            "ge": "GreaterOrEqual",
        }.items()
    },
    "add": _scaled("Add"),
    "sub": _scaled("Sub"),
    "ne": lambda g, a, b: g.emit("Not", g.emit("Equal", a, b, dtype=torch.bool)),
    "clamp": _clamp,
    "where": _where,
    "_to_copy": _cast,
    "clone": lambda g, a, **_: a,
    "alias": lambda g, a: a,
    "full_like": lambda g, a, value, **_: g.emit(
        "Expand", torch.tensor(value, dtype=a.dtype), g.emit("Shape", a, dtype=torch.int64)
    ),
    "select": lambda g, a, dim, index: g.emit("Gather", a, torch.tensor(index), axis=dim),
    "slice": _slice,
    "squeeze": lambda g, a, dim: g.emit("Squeeze", a, _integers(*dim)),
    "unsqueeze": lambda g, a, dim: g.emit("Unsqueeze", a, _integers(dim)),
    "cat": lambda g, parts, dim=0: g.emit("Concat", *parts, axis=dim),
    "constant_pad_nd": lambda g, a, n, x=0.0: g.emit("Pad", a, _integers(*n), x, _integers(-1)),
    "view": _view,
    "permute": lambda g, a, dims: g.emit("Transpose", a, perm=list(dims)),
    "_softmax": lambda g, a, dim, *_: g.emit("Softmax", a, axis=dim),
    "sum": lambda g, a, dim, keepdim=False, **_: g.emit(
        "ReduceSum", a, _integers(*dim), keepdims=int(keepdim)
    ),
    "atan": _atan,
    "sym_size": lambda g, a, dim: Unknown(-1),
    "_assert_tensor_metadata": lambda g, *_, **__: None,
    "_assert_scalar": lambda g, *_, **__: None,
    # torch up to 2.8 compares sizes for such an assertion.
    "<built-in function eq>": lambda g, *_: Unknown(-1),
}  # fmt: skip


def onnx(
    model: FrictionModel,
    path: str | Path,
    info: ModelInfo | None = None,
    *,
    dtype: str = "float64",
    torque_limit: float | Sequence[float] | None = None,
    with_filter: bool = False,
    cutoff_hz: float = 20.0,
) -> Path:
    """Write a model as ONNX, with a batch of any size.

    Inputs `qd`, `qdd`, `load`, outputs `tau_f`, `coefficients`, `status`, all (batch, joint) in SI.
    If the controller has a state, it is the input `state` and the output `next_state`, (batch,
    joint, number); a state of NaN is a fresh start. The metadata (see `Contract`) are JSON under
    `nfriction.json` in `metadata_props`. The file is run and compared with the model before it is
    put in place, with ONNX Runtime if that is installed, else with ONNX's own evaluator.

    Args:
        dtype: "float64" or "float32", for inputs, outputs and all intermediate values.
        others: as for `torchscript`; the file is usually `.onnx`.

    Returns:
        The path.

    Raises:
        ImportError: if the package `onnx` is missing.
        ExportError, ValueError, OSError: as `torchscript`.
    """
    _package()
    if dtype == "float32" and with_filter:
        # Differences of positions over a millisecond have half the digits of the positions.
        raise ValueError("the filter of ONNX needs float64, got float32; or filter outside.")
    controller = controller_of(
        model, info, torque_limit=torque_limit, with_filter=with_filter, cutoff_hz=cutoff_hz
    )
    heat = controller.model.schedule
    # Half a digit in each step of a time constant may add up to 0.1 % of the heat.
    slow = isinstance(heat, Heated) and heat.cooling_time * 2.0**-24 > 1e-3 * heat.sample_time
    if dtype == "float32" and slow:
        raise ValueError(
            f"heat with a time constant of {heat.cooling_time:g} s loses its steps of "
            f"{heat.sample_time:g} s in float32: export ONNX in float64, or C."
        )
    contract = contract_of(model, controller, info, dtype=dtype)
    file = _file(controller, dtype)
    file.graph.name = str(contract.description["model"])
    _package().helper.set_model_props(file, {METADATA: contract.to_json()})
    return write_verified(
        path, file.SerializeToString(deterministic=True), contract,
        lambda written: _runner(_read(written), controller, dtype, path), "ONNX graph",
    )  # fmt: skip


def contract_of_onnx(path: str | Path) -> Contract:
    """Read the contract of an artefact."""
    file = _read(path)
    properties = {prop.key: prop.value for prop in file.metadata_props}
    contract = Contract.from_json(properties.get(METADATA, ""))
    contract.require_dtype(_dtype(file))
    return contract


def onnx_runner(path: str | Path, controller: Controller) -> Runner:
    """Load an artefact with the controller's graph; its numbers may differ."""
    file = _read(path)
    dtype = _dtype(file)
    if _without_numbers(file) != _without_numbers(_file(controller, dtype)):
        raise ExportError(another_program(path))
    return _runner(file, controller, dtype, path)


def _dtype(file: Any) -> str:
    single = any(port.type.tensor_type.elem_type == 1 for port in file.graph.input)
    return "float32" if single else "float64"


def _without_numbers(file: Any) -> bytes:
    """Bytes of the computation in a file, with only the sizes of its constants."""
    bare = type(file)()
    bare.CopyFrom(file)
    bare.ClearField("metadata_props")
    bare.ClearField("producer_version")
    bare.graph.ClearField("name")
    for constant in bare.graph.initializer:
        constant.raw_data = b"%d" % len(constant.raw_data)
    return bytes(bare.SerializeToString(deterministic=True))


def _runner(file: Any, controller: Controller, dtype: str, path: str | Path) -> Runner:
    names, real = [value.name for value in file.graph.input], REAL[dtype]
    evaluate = _evaluator(file, path)

    def step(*inputs: torch.Tensor) -> Sequence[Any]:
        given = {name: x.numpy().astype(real) for name, x in zip(names, inputs, strict=True)}
        return evaluate(given)

    return lambda *x: run_from_nan(step, x, controller.state_size)


def _read(path: str | Path) -> Any:
    """A file as a protocol buffer."""
    package = _package()
    if Path(path).stat().st_size > LARGEST_FILE:
        raise ExportError(f"{path}: too large for a graph of nfriction.")
    broken = importlib.import_module("google.protobuf.message").DecodeError
    try:
        return package.load_model_from_string(Path(path).read_bytes())
    except (broken, ValueError, RuntimeError) as error:
        raise ExportError(f"{path} is no ONNX graph ({first_line(error)}).") from error


def _package() -> Any:
    """The package `onnx`, which is an extra."""
    try:
        return importlib.import_module("onnx")
    except ImportError as error:
        raise ImportError(
            "ONNX needs the packages `onnx` and, to run it, `onnxruntime`; install them with "
            "`pip install nfriction[onnx]`."
        ) from error


def _file(controller: Controller, dtype: str) -> Any:
    """The whole file except its metadata, as a protocol buffer."""
    package = _package()
    helper = package.helper
    inputs, outputs = list(controller.inputs), list(OUTPUTS)
    if controller.state_size:
        inputs, outputs = [*inputs, "state"], [*outputs, "next_state"]
    if dtype == "float32":
        controller = for_single_precision(controller)
    with silent():
        program = exported(controller).run_decompositions()
    graph = OnnxGraph(program, inputs, outputs, REAL[dtype])
    real, size = helper.np_dtype_to_tensor_dtype(graph.real), controller.state_size
    further = {"coefficients": [controller.coefficient_count], "state": [size],
               "next_state": [size]}  # fmt: skip

    def port(name: str) -> Any:
        kind = package.TensorProto.INT32 if name == "status" else real
        shape = ["batch", controller.joints, *further.get(name, [])]
        return helper.make_tensor_value_info(name, kind, shape)

    body = helper.make_graph(
        graph.nodes,
        "controller",
        [port(name) for name in inputs],
        [port(name) for name in outputs],
        [package.numpy_helper.from_array(array, key) for key, array in graph.constants.items()],
    )
    file = helper.make_model(
        body,
        producer_name="nfriction",
        producer_version=__version__,
        opset_imports=[helper.make_opsetid("", OPSET)],
        ir_version=IR_VERSION,
    )
    package.checker.check_model(file)
    return file


def _evaluator(file: Any, path: str | Path) -> Callable[[dict[str, Any]], Any]:
    """A function from named inputs to the outputs in order."""
    try:
        onnxruntime = importlib.import_module("onnxruntime")
    except ImportError:
        reference = importlib.import_module("onnx.reference").ReferenceEvaluator(file)
        return lambda given: reference.run(None, given)
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    state = onnxruntime.capi.onnxruntime_pybind11_state
    refusals = (state.Fail, state.InvalidArgument, state.InvalidGraph, state.InvalidProtobuf,
                state.NotImplemented, state.RuntimeException)  # fmt: skip

    def refused(error: Exception) -> ExportError:
        return ExportError(f"{path}: ONNX Runtime refuses it ({first_line(error)}).")

    try:
        session = onnxruntime.InferenceSession(
            file.SerializeToString(), options, providers=["CPUExecutionProvider"]
        )
    except refusals as error:
        raise refused(error) from error

    def evaluate(given: dict[str, Any]) -> Any:
        try:
            return session.run(None, given)
        except refusals as error:
            raise refused(error) from error

    return evaluate

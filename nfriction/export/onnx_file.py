"""ONNX: a graph for ONNX Runtime and its kin, in double or single precision."""

import importlib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from nfriction.export.contract import OUTPUTS, Contract, Runner, contract_of, write_verified
from nfriction.export.controller import controller_of, for_single_precision
from nfriction.export.errors import ExportError, first_line
from nfriction.export.onnx_graph import OnnxGraph
from nfriction.export.torch_code.archive import METADATA
from nfriction.export.torch_code.pt2 import exported, run_from_nan, silent
from nfriction.friction.models import FrictionModel
from nfriction.io.model_info import ModelInfo

# Old enough for runtimes in the field; nothing newer is needed.
OPSET, IR_VERSION = 18, 8
LARGEST_FILE = 256 * 2**20
REAL = {"float64": np.float64, "float32": np.float32}


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
    Where the controller has a state, it is the input `state` and the output `next_state`, (batch,
    joint, number); one that is NaN is a fresh start. The metadata (see `Contract`) are JSON under
    `nfriction.json` in `metadata_props`. The file is run and compared with the model before it
    takes its place, by ONNX Runtime where that is installed, else by ONNX's own evaluator.

    Args:
        model: a friction model.
        path: file to write, by custom `.onnx`; missing folders are made.
        info: description of the model besides its parameters.
        dtype: "float64" or "float32", of inputs, outputs and all between.
        torque_limit, with_filter, cutoff_hz: see `controller_of`.

    Returns:
        The path.

    Raises:
        ImportError: if the package `onnx` is missing.
        ExportError: if an operation of the model has no ONNX form here, or the artefact differs
            from the model.
        ValueError: if `info` or an option is malformed.
        OSError: if the file cannot be written.
    """
    package = _package()
    if dtype == "float32" and with_filter:
        # Differences of positions over a millisecond have half the digits of the positions.
        raise ValueError('the filter needs dtype="float64"; or filter outside, in double.')
    controller = controller_of(
        model, info, torque_limit=torque_limit, with_filter=with_filter, cutoff_hz=cutoff_hz
    )
    contract = contract_of(model, controller, info, dtype=dtype)
    inputs, outputs = list(contract.inputs), list(OUTPUTS)
    if controller.state_size:
        inputs, outputs = [*inputs, "state"], [*outputs, "next_state"]
    if dtype == "float32":
        controller = for_single_precision(controller)
    with silent():
        program = exported(controller).run_decompositions()
    graph = OnnxGraph(program, inputs, outputs, REAL[dtype])
    file = _model_file(package, graph, inputs, outputs, contract)
    return write_verified(path, file.SerializeToString(deterministic=True), open_onnx, "ONNX graph")


def open_onnx(path: str | Path) -> tuple[Contract, Runner]:
    """Load an artefact; returns its contract, and how to run it.

    Raises:
        ImportError: if the package `onnx` is missing.
        ExportError: if it is no ONNX graph, or not one with these inputs.
        ContractError: if its metadata are absent or damaged.
    """
    package = _package()
    file, contract = _read(path)
    try:
        package.checker.check_model(file)
    except (ValueError, RuntimeError, package.checker.ValidationError) as error:
        raise ExportError(f"{path}: no ONNX graph ({first_line(error)}).") from error
    size, real = contract.state_size, REAL[contract.description["dtype"]]
    names = [value.name for value in file.graph.input]
    evaluate = _evaluator(package, file, path)

    def step(*inputs: torch.Tensor) -> Sequence[Any]:
        given = {name: x.numpy().astype(real) for name, x in zip(names, inputs, strict=True)}
        return evaluate(given)

    return contract, lambda *x: run_from_nan(step, x, size)


def contract_of_onnx(path: str | Path) -> Contract:
    """Read the contract of an ONNX graph.

    Raises: as `open_onnx`.
    """
    return _read(path)[1]


def _read(path: str | Path) -> tuple[Any, Contract]:
    """The file as a protocol buffer, and its contract."""
    package = _package()
    if Path(path).stat().st_size > LARGEST_FILE:
        raise ExportError(f"{path}: too large for a graph of nfriction.")
    broken = importlib.import_module("google.protobuf.message").DecodeError
    try:
        file = package.load_model_from_string(Path(path).read_bytes())
    except (broken, ValueError, RuntimeError) as error:
        raise ExportError(f"{path}: no ONNX graph ({first_line(error)}).") from error
    properties = {prop.key: prop.value for prop in file.metadata_props}
    return file, Contract.from_json(properties.get(METADATA, ""))


def _package() -> Any:
    """The package `onnx`, which is an extra."""
    try:
        package = importlib.import_module("onnx")
    except ImportError as error:
        raise ImportError(
            "ONNX needs the packages `onnx` and, to run it, `onnxruntime`; install them with "
            "`pip install nfriction[onnx]`."
        ) from error
    return package


def _model_file(
    package: Any,
    graph: OnnxGraph,
    inputs: Sequence[str],
    outputs: Sequence[str],
    contract: Contract,
) -> Any:
    """The whole file as a protocol buffer."""
    helper = package.helper
    real = helper.np_dtype_to_tensor_dtype(graph.real)
    tau_f, coefficients = contract.outputs["tau_f"], contract.outputs["coefficients"]
    joints, size = tau_f.shape[1], contract.state_size

    def port(name: str) -> Any:
        last = {"coefficients": [coefficients.shape[2]], "state": [size], "next_state": [size]}
        kind = package.TensorProto.INT32 if name == "status" else real
        return helper.make_tensor_value_info(name, kind, ["batch", joints, *last.get(name, [])])

    body = helper.make_graph(
        graph.nodes,
        str(contract.description["model"]),
        [port(name) for name in inputs],
        [port(name) for name in outputs],
        [package.numpy_helper.from_array(array, key) for key, array in graph.constants.items()],
    )
    file = helper.make_model(
        body,
        producer_name="nfriction",
        producer_version=str(contract.description["version"]),
        opset_imports=[helper.make_opsetid("", OPSET)],
        ir_version=IR_VERSION,
    )
    helper.set_model_props(file, {METADATA: contract.to_json()})
    package.checker.check_model(file)
    return file


def _evaluator(package: Any, file: Any, path: str | Path) -> Callable[[dict[str, Any]], Any]:
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

"""Timers of `latency.py` for what needs torch or ONNX Runtime: each gives nanoseconds a call.

Every one takes the case of `latency.py` (model, info, inputs, calls, folder) and calls its target
with one sample of all joints at a time.
"""

from __future__ import annotations

import importlib
import subprocess
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch

from nfriction.export import onnx, torchscript

HOST = Path(__file__).resolve().parents[1] / "examples" / "libtorch_host"
WARM_UP = 1000


def eager(case: Any) -> np.ndarray:
    """The model itself."""
    samples = [torch.as_tensor(x) for x in case.inputs]
    rows = list(zip(*(x.unbind(0) for x in samples), strict=True))
    with torch.inference_mode():
        return _timed(lambda row: case.model(*row), rows, min(case.calls, 20_000))


def torchscript_python(case: Any) -> np.ndarray:
    """The TorchScript artefact, called from Python."""
    path = torchscript(case.model, case.folder / f"python_{case.model.joints}.pt", case.info)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        module = torch.jit.load(str(path))
    samples = [torch.as_tensor(x) for x in case.inputs]
    rows = list(zip(*(x.unbind(0) for x in samples), strict=True))
    with torch.inference_mode(), torch.jit.optimized_execution(False):
        return _timed(lambda row: module(*row), rows, min(case.calls, 20_000))


def torchscript_cpp(case: Any) -> np.ndarray:
    """The TorchScript artefact in `examples/libtorch_host`, which needs cmake and a compiler."""
    build = case.folder / "libtorch_host"
    prefix = f"-DCMAKE_PREFIX_PATH={torch.utils.cmake_prefix_path}"
    if not (build / "libtorch_host").exists():
        for command in (["cmake", "-S", HOST, "-B", build, prefix], ["cmake", "--build", build]):
            subprocess.run(command, check=True, capture_output=True)
    path = torchscript(case.model, case.folder / f"host_{case.model.joints}.pt", case.info)
    times = case.folder / "microseconds.txt"
    command = [build / "libtorch_host", path, str(min(case.calls, 50_000)), times]
    subprocess.run(command, check=True, capture_output=True)
    return 1e3 * np.loadtxt(times)


def onnx_runtime(case: Any, dtype: str = "float64") -> np.ndarray:
    """The ONNX artefact in ONNX Runtime, which is an extra."""
    runtime = importlib.import_module("onnxruntime")
    path = onnx(case.model, case.folder / f"{dtype}_{case.model.joints}.onnx", case.info,
                dtype=dtype)  # fmt: skip
    options = runtime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    session = runtime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
    names = [port.name for port in session.get_inputs()]
    columns = [x.astype(dtype)[:, None] for x in case.inputs]
    rows = [dict(zip(names, row, strict=True)) for row in zip(*columns, strict=True)]
    return _timed(lambda row: session.run(None, row), rows, min(case.calls, 20_000))


def _timed(call: Callable[[Any], Any], rows: list[Any], calls: int) -> np.ndarray:
    """Nanoseconds of every call, after a warm-up."""
    clock = time.perf_counter_ns
    ns = np.empty(calls)
    for k in range(-WARM_UP, calls):
        row = rows[k % len(rows)]
        start = clock()
        call(row)
        ns[max(k, 0)] = clock() - start
    return ns

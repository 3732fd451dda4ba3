"""C for controllers: one source file with its header, a self-test, and skeletons for hosts."""

import ctypes
import os
import shlex
import shutil
import subprocess
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from nfriction.export.c_dialect import ControllerC, Real, is_identifier
from nfriction.export.c_model import source_of
from nfriction.export.contract import (
    COEFFICIENT_SLACK,
    LARGEST_FILE,
    Contract,
    ContractError,
    ExportError,
    contract_of,
)
from nfriction.export.controller import controller_of
from nfriction.friction.models import FrictionModel
from nfriction.io.files import write_atomically
from nfriction.io.model_file import ModelInfo
from nfriction.plant.rigs import from_dict

# Factor on the tolerance of a controller that rounds motions between filter and model.
ROUNDED = 5.0
REALS: dict[str, Real] = {"float64": "double", "float32": "float"}


def c(
    model: FrictionModel,
    folder: str | Path,
    info: ModelInfo | None = None,
    *,
    dtype: str = "float64",
    name: str = "nfriction",
    with_filter: bool = False,
    torque_limit: float | Sequence[float] | None = None,
    cutoff_hz: float = 20.0,
) -> list[Path]:
    """Write a model as C for controllers.

    The code is valid C89 and C++, allocates no memory, has no mutable globals, and calls only
    functions such as `exp` and `tanh`, in its own precision. The models' formulas are readable and
    use tables of parameters; a neuro-fuzzy joint takes about 2.3 kB on a Cortex-M4F. A user's own
    schedule is written as its traced operations.

    Args:
        folder: to write into; made if missing. The same model gives the same bytes.
        info: description of the model besides its parameters. With its rig, C of a law that reads
            the load has a function `<name>_load(q, qd, load)` for it.
        dtype: "float64" or "float32", in which the controller computes.
        name: of the files, and prefix of all functions, types and macros: controllers with
            different names can be linked into one program.
        with_filter: include the causal filter from raw positions.
        torque_limit, cutoff_hz: see `controller_of`.

    Returns:
        Files written: `<name>.c` and `<name>.h`; `<name>.contract.json` with the metadata and
        test vectors; `<name>_selftest.c`, a program that returns 0 if the outputs agree with
        these; `<name>.hpp` for C++; `<name>_sfun.c` for Simulink and `<name>.ino` for Arduino.

    Raises:
        ExportError: if the law or schedule uses an operation that has no C form.
        ValueError: if `info` or an option is malformed.
        OSError: if a file cannot be written.
    """
    if not is_identifier(name):
        raise ValueError(f"`name` must be an identifier of C of up to 31 letters, got {name!r}.")
    controller = controller_of(
        model, info, torque_limit=torque_limit, with_filter=with_filter, cutoff_hz=cutoff_hz
    )
    contract = contract_of(model, controller, info, dtype=dtype)
    dialect = ControllerC(REALS[dtype], name)
    plant = None if info is None or info.rig is None else from_dict(info.rig)
    about = contract.description
    code, header = source_of(controller, about, dialect, name, plant)
    words = {
        "name": name,
        "title": f"Friction of {about['joints']} joint" + "s" * (about["joints"] > 1),
        "unit": str(about["unit"]),
        "torque_unit": str(about["units"]["tau_f"]),
        "period": str(max(1, round(1e6 * (about["sample_time"] or 1e-3)))),
    }
    # A hidden state advances by one sample in every call, also in minor steps of a solver.
    held = about["sample_time"] if controller.memory_size else None
    files = {
        f"{name}.c": code,
        f"{name}.h": header,
        f"{name}.contract.json": contract.to_json() + "\n",
        f"{name}_selftest.c": dialect.text("selftest.c", **words, **_vectors(contract, dialect)),
        f"{name}.hpp": dialect.text("wrapper.hpp", **words),
        f"{name}_sfun.c": dialect.text("simulink.c", **words, held=held),
        f"{name}.ino": dialect.text("arduino.ino", **words, loaded=controller.loaded),
    }
    return [write_atomically(Path(folder) / key, text.encode("ascii"))
            for key, text in files.items()]  # fmt: skip


def _vectors(contract: Contract, dialect: ControllerC) -> dict[str, str]:
    """The test vectors as tables of the self-test."""
    tables = []
    for key, values in contract.inputs.items():
        kinds = torch.isnan(values).int() + 2 * torch.isposinf(values) + 3 * torch.isneginf(values)
        finite = torch.nan_to_num(values, 0.0, 0.0, 0.0)
        tables += [
            _table(f"test_{key}", finite, dialect),
            _table(f"test_{key}_kind", kinds, dialect, "unsigned char"),
        ]
    tau, coefficients, status = (
        torch.nan_to_num(contract.outputs[key], 0.0) for key in ("tau_f", "coefficients", "status")
    )
    # The output of the filter is rounded to single precision before it reaches the model.
    rounded = dialect.real == "float" and contract.description["filter"] is not None
    tolerance = (ROUNDED if rounded else 1.0) * contract.tolerance
    tables += [
        _table("test_tau", tau, dialect),
        _table("test_coefficients", coefficients.flatten(1), dialect),
        _table("test_status", status, dialect, "unsigned char"),
        _table("test_torque_scale", contract.scales["tau_f"][None], dialect),
        _table("test_coefficient_scale", contract.scales["coefficients"][None], dialect),
    ]
    return {
        "count": str(len(tau)),
        "arrays": "\n".join(tables),
        "torque_tolerance": dialect.literal(tolerance),
        "coefficient_tolerance": dialect.literal(COEFFICIENT_SLACK * tolerance),
    }


def _table(name: str, values: Tensor, dialect: ControllerC, kind: str = "") -> str:
    literal = str if kind else dialect.literal
    rows = ",\n".join(f"    {{{', '.join(map(literal, row.tolist()))}}}" for row in values)
    count, columns = values.shape
    return f"static const {kind or dialect.real} {name}[{count}][{columns}] = {{\n{rows}\n}};\n"


# Usual flags for controllers; standard-conforming, because fast-math is the user's choice.
FLAGS = ("-std=c89", "-O2")


def find_compiler() -> list[str] | None:
    """The C compiler as an argument list: `CC`, else the first of cc, gcc and clang; or None."""
    named = shlex.split(os.environ.get("CC", ""))
    if named:
        return [found, *named[1:]] if (found := shutil.which(named[0])) else None
    return next(([path] for name in ("cc", "gcc", "clang") if (path := shutil.which(name))), None)


def beside(source: str | Path) -> Path:
    """Path of an exported C file's contract; a model file may have the same stem."""
    return Path(source).with_suffix(".contract.json")


def c_contract(source: str | Path) -> Contract:
    """Read the contract in the folder of an exported C file, which must have its original name."""
    source, metadata = Path(source), beside(source)
    if not metadata.is_file():
        raise ContractError(f"{source}: its metadata, {metadata.name}, are not in the same folder.")
    if max(source.stat().st_size, metadata.stat().st_size) > LARGEST_FILE:
        raise ExportError(f"{source}: too large for a controller from nfriction.")
    if not is_identifier(source.stem):
        raise ContractError(
            f"{source}: the file must have the name of its functions; restore its original name."
        )
    return Contract.from_json(metadata.read_text("utf-8"))


def c_runner(source: str | Path, flags: Sequence[str] = FLAGS) -> Callable[..., tuple[Any, ...]]:
    """Compile an exported C file; return a function that runs it, see `verify`."""
    source = Path(source)
    description = c_contract(source).description
    joints, count = int(description["joints"]), len(description["coefficients"])
    function = _library(source, description["filter"] is not None, flags).run_rows
    function.restype = None

    def run(*inputs: Any) -> tuple[Any, ...]:
        given = [np.ascontiguousarray(x, dtype=np.float64) for x in inputs]
        rows = len(given[0])
        if any(x.shape != (rows, joints) for x in given):
            raise ValueError(f"inputs must be (sample, {joints}), got {[x.shape for x in given]}.")
        pointers = (ctypes.c_void_p * len(given))(*(x.ctypes.data for x in given))
        tau, coefficients = np.empty((rows, joints)), np.empty((rows, joints, count))
        status = np.empty((rows, joints), dtype=np.intc)
        outputs = [ctypes.c_void_p(x.ctypes.data) for x in (tau, coefficients, status)]
        function(ctypes.c_long(rows), pointers, *outputs)
        return tau, coefficients, status

    return run


def _library(source: Path, filters: bool, flags: Sequence[str]) -> ctypes.CDLL:
    compiler = find_compiler()
    if compiler is None:
        raise ExportError("no C compiler (CC, cc, gcc, clang) was found to build the C code.")
    # After a filter the first motion is that of a joint at rest.
    first = "t, t" if filters else "x[0], x[1]"
    text = ControllerC(prefix=source.stem).text("rows.c", name=source.stem, first=first)
    with tempfile.TemporaryDirectory(prefix="nfriction-") as folder:
        driver = Path(folder) / "rows.c"
        driver.write_text(text, encoding="ascii")
        parts, library = driver.with_suffix(".o"), driver.with_suffix(".so")
        compiling = [*compiler, *flags, "-fPIC", f"-I{source.resolve().parent}", "-c", "-o",
                     str(parts), str(driver)]  # fmt: skip
        # Linked without the flags: with -ffast-math gcc would add code that makes the whole process
        # flush small numbers to zero once the library is loaded.
        for command in (compiling, [*compiler, "-shared", "-o", str(library), str(parts), "-lm"]):
            result = subprocess.run(command, capture_output=True, text=True, check=False)
            if result.returncode:
                raise ExportError(f"{shlex.join(command)} failed:\n{result.stderr[-2000:]}")
        return ctypes.CDLL(str(library))

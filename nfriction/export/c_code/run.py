"""Compile and run exported C on this machine, to compare it with its model."""

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

from nfriction.export.c_code.dialect import ControllerC, is_identifier
from nfriction.export.contract import Contract, Runner
from nfriction.export.errors import ContractError, ExportError

# As controllers are built; standard, since fast-math is the user's own choice.
FLAGS = ("-std=c89", "-O2")
LARGEST_FILE = 256 * 2**20


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
    """The contract that lies beside an exported C file.

    Raises:
        ContractError: if it is damaged.
        OSError: if it cannot be read.
    """
    return Contract.from_json(beside(source).read_text("utf-8"))


def c_runner(source: str | Path, flags: Sequence[str] = FLAGS) -> Callable[..., tuple[Any, ...]]:
    """Compile an exported C file and hand back a function for `verify` and `compare`.

    Args:
        source: the `.c` file; its `.h` and `.contract.json` lie beside it.
        flags: of the compiler.

    Returns:
        A function that takes the inputs, (sample, joint) each, and gives torque, coefficients and
        status of all samples in order.

    Raises:
        ExportError: if there is no C compiler, or it refuses the file.
        ContractError: if the metadata are damaged.
    """
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


def open_c(path: str | Path) -> tuple[Contract, Runner]:
    """Compile a controller's C; returns the contract beside it, and how to run it.

    Raises:
        ExportError: if there is no compiler, or it refuses the file.
        ContractError: if the metadata are absent or damaged.
    """
    path = Path(path)
    metadata = beside(path)
    if not metadata.is_file():
        raise ContractError(f"{path}: its metadata, {metadata.name}, do not lie beside it.")
    if max(path.stat().st_size, metadata.stat().st_size) > LARGEST_FILE:
        raise ExportError(f"{path}: too large for a controller of nfriction.")
    if not is_identifier(path.stem):
        raise ContractError(
            f"{path}: the file is named as its functions are; give it its old name."
        )
    return c_contract(path), c_runner(path)


def _library(source: Path, filters: bool, flags: Sequence[str]) -> ctypes.CDLL:
    compiler = find_compiler()
    if compiler is None:
        raise ExportError("no C compiler (CC, cc, gcc, clang) was found to run the C with.")
    # Behind a filter the first motion is that of a joint at rest.
    first = "t, t" if filters else "x[0], x[1]"
    text = ControllerC(prefix=source.stem).text("rows.c", name=source.stem, first=first)
    with tempfile.TemporaryDirectory(prefix="nfriction-") as folder:
        driver = Path(folder) / "rows.c"
        driver.write_text(text, encoding="ascii")
        parts, library = driver.with_suffix(".o"), driver.with_suffix(".so")
        compiling = [*compiler, *flags, "-fPIC", f"-I{source.resolve().parent}", "-c", "-o",
                     str(parts), str(driver)]  # fmt: skip
        # Linked without the flags: with -ffast-math gcc would add code that has the whole process
        # flush small numbers to zero as soon as the library is loaded.
        for command in (compiling, [*compiler, "-shared", "-o", str(library), str(parts), "-lm"]):
            result = subprocess.run(command, capture_output=True, text=True, check=False)
            if result.returncode:
                raise ExportError(f"{shlex.join(command)} failed:\n{result.stderr[-2000:]}")
        return ctypes.CDLL(str(library))

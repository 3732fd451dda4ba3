"""Run exported C on this machine: what proves it equal to its model."""

import ctypes
import shlex
import subprocess
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from nfriction.codegen.build import find_compiler
from nfriction.export.contract import Contract
from nfriction.export.errors import ExportError

# As controllers are built; standard, since fast-math is the user's own choice.
FLAGS = ("-std=c89", "-O2")

_ROWS = """
#include "{name}.c"

void nf_rows(long rows, const double *const *in, double *tau, double *coefficients, int *status);

void nf_rows(long rows, const double *const *in, double *tau, double *coefficients, int *status)
{{
    {prefix}_real x[3][{P}_JOINTS], t[{P}_JOINTS], c[{P}_JOINTS * {P}_COEFFICIENTS];
    long row;
    int j;
#if {P}_STATE_SIZE
    {prefix}_state state;
#endif
#if {P}_FILTER_SIZE
    {prefix}_filter filter;
    double q[{P}_JOINTS];
#endif
    for (row = 0; row < rows; ++row) {{
#if {P}_FILTER_SIZE
        for (j = 0; j < {P}_JOINTS; ++j) {{
            q[j] = in[0][row * {P}_JOINTS + j];
            x[2][j] = ({prefix}_real)in[1][row * {P}_JOINTS + j];
            t[j] = 0;
        }}
        if (row == 0)
            {prefix}_filter_init(&filter, q);
        {prefix}_filter_step(&filter, q, x[0], x[1]);
#else
        int i;
        for (i = 0; i < 3; ++i)
            for (j = 0; j < {P}_JOINTS; ++j)
                x[i][j] = ({prefix}_real)in[i][row * {P}_JOINTS + j];
#endif
#if {P}_STATE_SIZE
        if (row == 0)
            {prefix}_init(&state, {first});
        {prefix}_step(&state, x[0], x[1], x[2], t, c, status + row * {P}_JOINTS);
#else
        {prefix}_step(x[0], x[1], x[2], t, c, status + row * {P}_JOINTS);
#endif
        for (j = 0; j < {P}_JOINTS; ++j)
            tau[row * {P}_JOINTS + j] = (double)t[j];
        for (j = 0; j < {P}_JOINTS * {P}_COEFFICIENTS; ++j)
            coefficients[row * {P}_JOINTS * {P}_COEFFICIENTS + j] = (double)c[j];
    }}
}}
"""


def beside(source: str | Path) -> Path:
    """Where the contract of an exported C file lies: apart from a model file of the same name."""
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
    prefix, joints = str(description["prefix"]), int(description["joints"])
    count = len(description["coefficients"])
    function = _library(source, prefix, description["filter"] is not None, flags).nf_rows
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


def _library(source: Path, prefix: str, filters: bool, flags: Sequence[str]) -> ctypes.CDLL:
    compiler = find_compiler()
    if compiler is None:
        raise ExportError("no C compiler (CC, cc, gcc, clang) was found to run the C with.")
    first = "t, t" if filters else "x[0], x[1]"
    text = _ROWS.format(name=source.stem, prefix=prefix, P=prefix.upper(), first=first)
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

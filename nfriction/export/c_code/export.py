"""C for controllers: one source file and its header, a self-test, and skeletons around them."""

from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor

from nfriction.export.c_code.dialect import ControllerC, Real, is_identifier
from nfriction.export.c_code.model import source_of
from nfriction.export.contract import COEFFICIENT_SLACK, Contract, contract_of
from nfriction.export.controller import controller_of
from nfriction.friction.models import FrictionModel
from nfriction.io.atomic import write_atomically
from nfriction.io.model_info import ModelInfo

# How much more a controller may err that rounds motions between filter and model.
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

    The C is C89 and C++ alike, allocates nothing, has no globals that change, and calls nothing
    but `exp`, `tanh` and their like, in its own precision. The models' formulas are written to be
    read, over tables of their parameters; a neuro-fuzzy joint takes about 2.3 kB on a Cortex-M4F.
    A schedule of one's own is written out as it computes.

    Args:
        model: a friction model.
        folder: where to write; made if missing. The same model gives the same bytes.
        info: description of the model besides its parameters.
        dtype: "float64" or "float32", in which the controller computes.
        name: of the files, and prefix of all functions, types and macros: controllers of
            different names link into one program.
        with_filter: write the causal filter from raw positions too.
        torque_limit, cutoff_hz: see `controller_of`.

    Returns:
        What was written: `<name>.c` and `<name>.h`; `<name>.contract.json` with the metadata
        and test vectors; `<name>_selftest.c`, a program that returns 0 where these agree;
        `<name>.hpp` for C++; `<name>_sfun.c` for Simulink and `<name>.ino` for Arduino.

    Raises:
        ExportError: if the law or schedule uses an operation that has no C form.
        ValueError: if `info` or an option is malformed.
        OSError: if a file cannot be written.
    """
    if dtype not in REALS:
        raise ValueError(f'`dtype` must be "float64" or "float32", got {dtype!r}.')
    if not is_identifier(name):
        raise ValueError(f"`name` must be an identifier of C of up to 31 letters, got {name!r}.")
    controller = controller_of(
        model, info, torque_limit=torque_limit, with_filter=with_filter, cutoff_hz=cutoff_hz
    )
    contract = contract_of(model, controller, info, dtype=dtype)
    dialect = ControllerC(REALS[dtype], name)
    source = source_of(controller, contract.description, dialect, name)
    words = _words(contract, name)
    files = {
        f"{name}.c": source.code,
        f"{name}.h": source.header,
        f"{name}.contract.json": contract.to_json() + "\n",
        f"{name}_selftest.c": dialect.text("selftest.c", **words, **_vectors(contract, dialect)),
        f"{name}.hpp": dialect.text("wrapper.hpp", **words),
        f"{name}_sfun.c": dialect.text("simulink.c", **words),
        f"{name}.ino": dialect.text("arduino.ino", **words),
    }
    return [write_atomically(Path(folder) / key, text.encode("ascii"))
            for key, text in files.items()]  # fmt: skip


def _words(contract: Contract, name: str) -> dict[str, str]:
    description = contract.description
    sample_time = description["sample_time"] or 1e-3
    return {
        "name": name,
        "title": f"Friction of {description['joints']} joints",
        "unit": str(description["unit"]),
        "torque_unit": str(description["units"]["tau_f"]),
        "period": str(max(1, round(1e6 * sample_time))),
    }


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
    # What the filter gives is rounded to single precision on its way to the model.
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

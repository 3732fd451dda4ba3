"""Run an artefact of torch in a process of its own, which may perish of it."""

import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from nfriction.export.archive import contract_of_archive
from nfriction.export.contract import Contract, ContractError
from nfriction.export.errors import ExportError
from nfriction.export.program import open_pt2
from nfriction.export.script import open_torchscript
from nfriction.io import sandbox

OPENERS = {".pt": open_torchscript, ".pt2": open_pt2}
# Processor time [s]: to begin with, and for a sample of a controller with a state.
STARTING, BY_SAMPLE = 120.0, 0.01
ROOM = 2**34
# Numbers that come out for one that goes in: expanded from nothing, they would fill the disk.
MOST_BY_NUMBER = 1000
_INPUTS, _OUTPUTS = "inputs.npz", "outputs.npz"


def open_apart(path: str | Path) -> tuple[Contract, Any]:
    """What an artefact says of itself, and how to run several batches of samples through it.

    Raises:
        ExportError: if it is no artefact; when run, also if it holds more than arithmetic of
            tensors, or ends the process that runs it.
        ContractError: if its metadata are absent or damaged.
        OSError: if it cannot be read.
    """
    contract = contract_of_archive(path)

    def run(*batches: Sequence[Tensor]) -> list[tuple[Tensor, ...]]:
        with tempfile.TemporaryDirectory() as folder:
            return _run(Path(path), batches, Path(folder))

    return contract, run


def _run(path: Path, batches: Sequence[Sequence[Tensor]], folder: Path) -> list[tuple[Tensor, ...]]:
    given = {f"{k}_{i}": x.numpy() for k, b in enumerate(batches) for i, x in enumerate(b)}
    np.savez(folder / _INPUTS, **given)  # type: ignore[arg-type]
    seconds = STARTING + BY_SAMPLE * sum(len(batch[0]) for batch in batches)
    asked = {"path": str(path.absolute()), "batches": [len(batch) for batch in batches]}
    try:
        sandbox.run_isolated(__name__, asked, folder, seconds=seconds)
        with np.load(folder / _OUTPUTS, allow_pickle=False) as found:
            return [
                tuple(torch.from_numpy(found[f"{k}_{i}"]) for i in range(3))
                for k in range(len(batches))
            ]
    except sandbox.InvalidFile as error:
        raise ExportError(str(error)) from None
    except (sandbox.WorkerDied, OSError, ValueError, LookupError, TypeError) as error:
        raise ExportError(f"{path}: cannot be run ({error}).") from None


def main() -> None:
    """What the process does."""
    torch.set_num_threads(1)
    sandbox.worker_main(work, refusals=(ExportError, ContractError), memory=ROOM)


def work(asked: Mapping[str, Any], folder: Path) -> None:
    """Run batches of a file through an artefact, and write what comes out.

    Args:
        asked: `path` of the artefact, and for every one of `batches` its number of inputs.
        folder: where inputs lie and outputs go.

    Raises:
        ExportError, ContractError: as the openers do, or if its outputs are none of a controller.
    """
    path = Path(asked["path"])
    _, run = OPENERS[path.suffix](path)
    found: dict[str, Any] = {}
    with np.load(folder / _INPUTS, allow_pickle=False) as given:
        for k, count in enumerate(asked["batches"]):
            inputs = [torch.from_numpy(given[f"{k}_{i}"]) for i in range(count)]
            try:
                outputs = [torch.as_tensor(x) for x in run(*inputs)]
                if max(x.numel() for x in outputs) > MOST_BY_NUMBER * inputs[0].numel():
                    raise ValueError("its outputs are too large")
                found |= {f"{k}_{i}": x.numpy() for i, x in enumerate(outputs)}
            except (RuntimeError, TypeError, AttributeError, LookupError, ValueError) as error:
                told = f"{path}: cannot be run by its metadata ({error})."
                raise ExportError(told) from error
    np.savez(folder / _OUTPUTS, **found)

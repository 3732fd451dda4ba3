"""Settings for every test: one thread, float64 unless a test sets another type."""

import gc
import os
import re
from pathlib import Path

import pytest
import torch
from hypothesis import settings

from nfriction.codegen import jit

# Several threads make small tensors up to 100 times slower on a busy machine.
torch.set_num_threads(1)
settings.register_profile("default", deadline=None, max_examples=50, derandomize=True)
settings.load_profile("default")


@pytest.fixture(autouse=True)
def compiler_effort(request: pytest.FixtureRequest) -> None:
    """Compile kernels in a third of the time and to a third of the speed, except in the compiler's
    tests.

    Elsewhere most tests call a kernel only a few times. Child processes compile as users' do.
    """
    jit.EFFORT = 1 if request.path.parent.name == "codegen" else 0


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """Folder of the real recordings: `NFRICTION_DATA`, else `../shared/data`."""
    default = Path(__file__).resolve().parents[2] / "shared" / "data"
    folder = Path(os.environ.get("NFRICTION_DATA", default))
    if not folder.is_dir():
        pytest.skip(f"no real recordings at {folder}; set NFRICTION_DATA to run these tests")
    return folder


@pytest.fixture(scope="session")
def reference_dir(request: pytest.FixtureRequest) -> Path:
    """Folder of exact plant states: `NFRICTION_REFERENCE`, else `../shared/reference`."""
    default = Path(__file__).resolve().parents[2] / "shared" / "reference"
    folder = Path(os.environ.get("NFRICTION_REFERENCE", default))
    if not folder.is_dir():
        pytest.skip(f"no reference states at {folder}; set NFRICTION_REFERENCE to run these tests")
    return folder


# Of the long tests over all models, the short run takes only those of the richest laws.
LEFT_TO_THE_SLOW_RUN = {
    *("CFM", "ACFM", "NFCFM"), *("CVFM", "ACVFM", "NFCVFM"), "ANCFM", "NFNCFM",
}  # fmt: skip


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark tests of a nested law as slow if they repeat those of the full law."""
    for item in items:
        named = LEFT_TO_THE_SLOW_RUN.intersection(re.split(r"\W+", item.name))
        if named and item.path.parent.name in ("export", "simulation", "codegen"):
            item.add_marker(pytest.mark.slow)


def pytest_collection_finish() -> None:
    """Exclude libraries and collected tests from garbage collection, since they all stay."""
    gc.collect()
    gc.freeze()
    gc.set_threshold(20_000)

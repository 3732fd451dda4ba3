"""Settings for every test: one thread, float64 by default where a test does not say."""

import os
from pathlib import Path

import pytest
import torch
from hypothesis import settings

# Several threads make small tensors up to 100 times slower on a busy machine.
torch.set_num_threads(1)
settings.register_profile("default", deadline=None, max_examples=50, derandomize=True)
settings.load_profile("default")


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """Folder of the real recordings: `NFRICTION_DATA`, else `../shared/data`."""
    beside = Path(__file__).resolve().parents[2] / "shared" / "data"
    folder = Path(os.environ.get("NFRICTION_DATA", beside))
    if not folder.is_dir():
        pytest.skip(f"no real recordings at {folder}; set NFRICTION_DATA to run these tests")
    return folder


@pytest.fixture(scope="session")
def reference_dir(request: pytest.FixtureRequest) -> Path:
    """Folder of exact plant states: `NFRICTION_REFERENCE`, else `../shared/reference`."""
    beside = Path(__file__).resolve().parents[2] / "shared" / "reference"
    folder = Path(os.environ.get("NFRICTION_REFERENCE", beside))
    if not folder.is_dir():
        pytest.skip(f"no reference states at {folder}; set NFRICTION_REFERENCE to run these tests")
    return folder


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Leave one law's turn of the long tests over all models to the slow run.

    Viscous and Coulomb friction is a part of NLFM's, whose turn is kept.
    """
    for item in items:
        if "CVFM" in item.name and item.path.parent.name in ("export", "simulation"):
            item.add_marker(pytest.mark.slow)

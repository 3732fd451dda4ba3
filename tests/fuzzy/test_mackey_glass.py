"""The chaotic benchmark series: its integration and its input-output pairs."""

import importlib.util
from pathlib import Path
from types import ModuleType

import pytest
import torch

FLOAT64 = torch.float64


@pytest.fixture(scope="module")
def series() -> ModuleType:
    path = Path(__file__).parents[2] / "benchmarks" / "mackey_glass.py"
    if not path.exists():
        pytest.skip("a distribution has no benchmarks")
    specification = importlib.util.spec_from_file_location("mackey_glass", path)
    assert specification is not None
    assert specification.loader is not None
    module = importlib.util.module_from_spec(specification)
    specification.loader.exec_module(module)
    return module


def test_series_decays_until_the_delayed_value_arrives(series: ModuleType) -> None:
    # For t <= tau the delayed value is 0, so that x(t) = 1.2 exp(-0.1 t).
    t = torch.arange(18, dtype=FLOAT64)
    wanted = 1.2 * torch.exp(-0.1 * t)
    torch.testing.assert_close(series.mackey_glass(17), wanted, rtol=1e-8, atol=0)


def test_the_integration_is_of_fourth_order(series: ModuleType) -> None:
    coarse, fine, finest = (series.mackey_glass(60, step=h) for h in (0.1, 0.05, 0.025))
    ratio = float((coarse - fine).norm() / (fine - finest).norm())
    assert 12 < ratio < 20  # 2^4 and higher-order terms
    # Chaos amplifies the remaining error some thousand times over the whole series.
    whole = series.mackey_glass(1123) - series.mackey_glass(1123, step=0.05)
    assert whole.abs().max() < 1e-5


def test_pairs_are_four_past_values_and_one_future_value(series: ModuleType) -> None:
    x, y = series.pairs(torch.arange(1124, dtype=FLOAT64))
    assert x.shape == (1000, 4)
    assert x[0].tolist() == [100, 106, 112, 118]
    assert (y[:, 0] - x[:, 3] == 6).all()
    assert y[-1].item() == 1123

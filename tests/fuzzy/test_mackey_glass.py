"""The chaotic series of the benchmark: its integration, and Jang's result on it."""

import importlib.util
from pathlib import Path
from types import ModuleType

import pytest
import torch

from nfriction.fuzzy import Anfis, train_hybrid

FLOAT64 = torch.float64


@pytest.fixture(scope="module")
def benchmark() -> ModuleType:
    path = Path(__file__).parents[2] / "benchmarks" / "mackey_glass.py"
    if not path.exists():
        pytest.skip("a distribution has no benchmarks")
    specification = importlib.util.spec_from_file_location("mackey_glass", path)
    assert specification is not None
    assert specification.loader is not None
    module = importlib.util.module_from_spec(specification)
    specification.loader.exec_module(module)
    return module


def test_it_decays_until_the_delayed_value_arrives(benchmark: ModuleType) -> None:
    # For t <= tau the delayed value is 0, so that x(t) = 1.2 exp(-0.1 t).
    t = torch.arange(18, dtype=FLOAT64)
    wanted = 1.2 * torch.exp(-0.1 * t)
    torch.testing.assert_close(benchmark.mackey_glass(17), wanted, rtol=1e-8, atol=0)


def test_the_integration_is_of_fourth_order(benchmark: ModuleType) -> None:
    coarse, fine, finest = (benchmark.mackey_glass(60, step=h) for h in (0.1, 0.05, 0.025))
    ratio = float((coarse - fine).norm() / (fine - finest).norm())
    assert 12 < ratio < 20  # 2^4, and terms of higher order
    # Chaos grows what is left by some thousand times over the whole series.
    whole = benchmark.mackey_glass(1123) - benchmark.mackey_glass(1123, step=0.05)
    assert whole.abs().max() < 1e-5


def test_pairs_are_four_past_values_and_one_to_come(benchmark: ModuleType) -> None:
    x, y = benchmark.pairs(torch.arange(1124, dtype=FLOAT64))
    assert x.shape == (1000, 4)
    assert x[0].tolist() == [100, 106, 112, 118]
    assert (y[:, 0] - x[:, 3] == 6).all()
    assert y[-1].item() == 1123


@pytest.mark.slow
def test_hybrid_learning_finds_jangs_error(benchmark: ModuleType) -> None:
    # Jang (1993): after 500 epochs an RMSE of 0.0016 on the pairs learnt from and of 0.0015 on the
    # others, an NDEI of 0.007 on these.
    x, y = benchmark.pairs(benchmark.mackey_glass(1123))
    layer = Anfis(1, 4, [2] * 4, 1, kind="bell")
    layer.init_grid(x[:500].amin(0), x[:500].amax(0))
    course = train_hybrid(layer, x[:500].unsqueeze(1), y[:500].unsqueeze(1), 500)
    with torch.no_grad():
        said = layer(x[500:].unsqueeze(1))[:, 0]
    assert course.rmse.min().item() == pytest.approx(0.0016, abs=1e-4)
    assert (said - y[500:]).square().mean().sqrt().item() == pytest.approx(0.0015, abs=1e-4)
    assert benchmark.ndei(said, y[500:]) == pytest.approx(0.007, abs=5e-4)

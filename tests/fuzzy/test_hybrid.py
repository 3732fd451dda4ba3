"""Classical hybrid training: a documented run, the step-size rules, independent groups."""

import pytest
import torch

from nfriction.fuzzy import Anfis, hybrid_step, train_hybrid

FLOAT64 = torch.float64


def damped_sine() -> tuple[torch.Tensor, torch.Tensor]:
    x = torch.arange(101, dtype=FLOAT64) / 10
    return x[:, None, None], (torch.sin(2 * x) / torch.exp(x / 5))[:, None, None]


def test_it_reproduces_the_documented_run_of_matlab() -> None:
    # Errors of MATLAB's `anfis` in its first three epochs, taken after the least squares and before
    # the sets move. Four falls are first seen after the fifth epoch, so the sixth step is longer.
    x, y = damped_sine()
    layer = Anfis(1, 1, [5], 1, kind="bell")
    layer.init_grid(0.0, 10.0)
    centres, widths = layer.sets()
    assert centres[0].tolist() == pytest.approx([0, 2.5, 5, 7.5, 10])
    assert widths[0].tolist() == pytest.approx([1.25] * 5)
    course = train_hybrid(layer, x, y, 6)
    # Half a unit of the last printed digit, and the solver's prior.
    assert course.rmse[:3, 0].tolist() == pytest.approx([0.0694086, 0.0680259, 0.066663], abs=1e-7)
    assert course.step[:, 0].tolist() == pytest.approx([0.01] * 5 + [0.011], rel=1e-12)


def test_the_step_has_its_length_and_the_error_falls() -> None:
    x, y = damped_sine()
    layer = Anfis(1, 1, [5], 1, kind="bell")
    layer.init_grid(0.0, 10.0)

    def natural() -> torch.Tensor:
        return torch.cat([*layer.sets(), layer.log_slopes.exp()], 1).detach().clone()

    before = natural()
    first = hybrid_step(layer, x, y, 0.01)
    assert (natural() - before).norm().item() == pytest.approx(0.01, rel=1e-9)
    assert hybrid_step(layer, x, y, 0.01) < first


def test_oscillation_shrinks_the_step_and_the_best_epoch_is_kept() -> None:
    x, y = damped_sine()
    layer = Anfis(1, 1, [5], 1)
    layer.init_grid(0.0, 10.0)
    course = train_hybrid(layer, x, y, 40, step=0.4)
    assert course.step[-1, 0] < 0.4
    kept = (layer(x) - y).square().mean().sqrt()
    assert kept.item() == pytest.approx(course.rmse.min().item(), rel=1e-9)


def test_groups_train_as_if_alone() -> None:
    x, y = damped_sine()
    alone = Anfis(1, 1, [4], 1, kind="bell")
    both = Anfis(2, 1, [4], 1, kind="bell")
    alone.init_grid(0.0, 10.0)
    both.init_grid(0.0, 10.0)
    single = train_hybrid(alone, x, y, 8)
    pair = train_hybrid(both, x.expand(-1, 2, 1), torch.cat([y, y.flip(0)], 1), 8)
    torch.testing.assert_close(pair.rmse[:, :1], single.rmse, rtol=1e-9, atol=0)
    torch.testing.assert_close(pair.step[:, :1], single.step, rtol=1e-12, atol=0)


def test_interpretable_layers_and_no_epochs_are_refused() -> None:
    x, y = damped_sine()
    with pytest.raises(ValueError, match="interpretable"):
        hybrid_step(Anfis(1, 1, [3], 1, interpretable=True), x, y, 0.01)
    with pytest.raises(ValueError, match="epochs"):
        train_hybrid(Anfis(1, 1, [3], 1), x, y, 0)

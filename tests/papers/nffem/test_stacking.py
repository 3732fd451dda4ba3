"""Shares of a correction that hold-out windows support."""

import pytest
import torch

from nfriction.papers.nffem.correction import stacking_weights

F64 = torch.float64


def rms(residuals):
    return residuals.square().mean(1).sqrt()


def noise(seed, *shape):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=F64)


def test_what_helps_one_joint_and_hurts_another_is_taken_on_the_first():
    slope = torch.tensor([-0.5, 0.5], dtype=F64)
    shares = stacking_weights(lambda s: (1.0 + slope * s).expand(9, 2), 2)
    assert shares.tolist() == [1.0, 0.0]


def test_what_a_joint_s_own_gain_costs_another_is_not_taken():
    # The first joint's part moves the second joint, too; of half of it the second's makes up.
    def errors(s):
        return torch.stack([1.0 - 0.5 * s[0], 1.0 + 0.2 * s[0] - 0.1 * s[1]]).expand(9, 2)

    assert stacking_weights(errors, 2).tolist() == [0.5, 1.0]


@pytest.mark.parametrize("seed", range(20))
def test_nothing_is_taken_of_noise_and_all_of_what_is_true(seed):
    left = noise(seed, 40, 50, 2)
    useless = noise(100 + seed, 40, 50, 2)
    assert stacking_weights(lambda s: rms(left + s * useless), 2).tolist() == [0.0, 0.0]
    # What is right up to an error as small as what stays behind.
    right = 3.0 * noise(200 + seed, 40, 50, 2)
    assert stacking_weights(
        lambda s: rms(left + right - s * (right + 0.5 * useless)), 2
    ).tolist() == [1.0, 1.0]


def test_what_overshoots_is_taken_in_part():
    assert stacking_weights(lambda s: (0.1 + (0.5 - s).abs()).expand(9, 2), 2).tolist() == [0.5] * 2


def test_of_what_serves_alike_the_least_is_taken():
    assert stacking_weights(lambda s: torch.ones(9, 3, dtype=F64), 3).tolist() == [0.0] * 3


def test_a_single_wild_window_does_not_outvote_the_others():
    def errors(s):
        found = (1.0 - 0.5 * s).repeat(40, 1)
        found[7] = 1.0 + 1000.0 * s
        return found

    assert stacking_weights(errors, 2).tolist() == [1.0, 1.0]


def test_what_makes_a_window_diverge_is_not_taken():
    for lost in (torch.nan, torch.inf):

        def errors(s, lost=lost):
            found = (1.0 - 0.5 * s).repeat(9, 1)
            found[3] = torch.where(s.amax() > 0.5, lost, found[3])
            return found

        assert stacking_weights(errors, 2).tolist() == [0.5, 0.5]

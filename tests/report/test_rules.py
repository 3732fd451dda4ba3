"""Rules in words equal the model's coefficients at the centres of their sets."""

import pytest
import torch

from nfriction import LFM, NFCVFM, NFLFM
from nfriction.report import rules_in_words
from tests.report.runs import neuro_fuzzy


def test_rule_values_equal_the_models_coefficients_at_their_sets():
    model = neuro_fuzzy()
    for j, of in enumerate(rules_in_words(model, ["one", "two"])):
        assert len(of.rules) == 25
        velocity = {t.name: t.centre for t in of.velocity}
        acceleration = {t.name: t.centre for t in of.acceleration}
        for rule in of.rules:
            qd = torch.full((2,), velocity[rule.velocity], dtype=torch.float64)
            qdd = torch.full((2,), acceleration[rule.acceleration], dtype=torch.float64)
            if qd[j] == 0:  # acceleration along the motion has no meaning at rest
                continue
            expected = torch.tensor(rule.values, dtype=torch.float64)
            # tanh of the direction is 1 to rounding at these speeds.
            torch.testing.assert_close(
                expected, model.coefficients(qd, qdd)[j].detach(), rtol=1e-9, atol=0
            )


def test_untrained_model_has_its_constant_law_in_every_rule():
    (of,) = rules_in_words(NFLFM(1, [2e-3, 1e-2]))
    assert all(rule.values == pytest.approx((2e-3, 1e-2), rel=1e-9) for rule in of.rules)
    sentence = of.rules[12].sentence([("B", "N m s/rad"), ("C", "N m")])
    assert sentence == (
        "IF velocity is medium AND acceleration is about zero "
        "THEN B = 0.002 N m s/rad AND C = 0.01 N m"
    )


@pytest.mark.parametrize("terms", [(1, 1), (2, 3), (4, 2), (7, 9)])
def test_words_are_unique_and_in_order(terms):
    model = NFLFM(1, terms=terms)
    (of,) = rules_in_words(model)
    for words, count in ((of.velocity, terms[0]), (of.acceleration, terms[1])):
        assert len({t.name for t in words}) == len(words) == count
        assert [t.centre for t in words] == sorted(t.centre for t in words)


def test_zero_is_named_correctly_in_asymmetric_ranges():
    model = NFLFM(1)
    model.schedule.set_range(10.0, [-100.0, 20.0])
    (of,) = rules_in_words(model)
    nearest = min(of.acceleration, key=lambda t: abs(t.centre))
    assert nearest.name == "about zero"
    below = [t.name for t in of.acceleration if t.centre < nearest.centre]
    assert all("braking" in name for name in below)
    signed = NFLFM(1, acceleration="signed")
    assert {t.name.split()[-1] for t in rules_in_words(signed)[0].acceleration} == {
        "negative", "zero", "positive",
    }  # fmt: skip


def test_swapped_sets_swap_words():
    model = NFLFM(1)
    with torch.no_grad():
        centres = model.schedule.network.anfis.partition.centres
        centres[0, :5] = centres[0, :5].flip(0)
    (of,) = rules_in_words(model)
    assert [t.name for t in of.velocity] == ["very fast", "fast", "medium", "slow", "very slow"]


def test_rules_do_not_depend_on_heat():
    model = NFCVFM(1, [2e-3, 1e-2, 0.3, 0.0], inputs=["heat"])
    rule = rules_in_words(model)[0].rules[12]
    assert rule.values == pytest.approx((2e-3, 1e-2))
    own = [(c.name, c.unit) for c in model.law.coefficients]
    assert rule.sentence(own) == rule.sentence(own[:2])
    assert rule.sentence(own).endswith("THEN F_c = 0.002 N m AND F_v = 0.01 N m s/rad")


def test_a_set_beyond_the_range_is_named_where_its_rules_hold():
    model = NFLFM(1, terms=(3, 3))
    model.schedule.set_range(10.0, [-50.0, 50.0])
    with torch.no_grad():
        centres = model.schedule.network.anfis.partition.centres
        centres[0] = torch.tensor([-0.2, -0.1, 1.1, 0.2, 0.5, 1.5])
    (of,) = rules_in_words(model)
    assert [t.name for t in of.velocity] == ["slow", "medium", "fast"]
    assert [t.centre for t in of.velocity] == [0.0, 0.0, 10.0]
    assert [t.centre for t in of.acceleration] == pytest.approx([-30.0, 0.0, 50.0])


def test_models_without_rules_have_none_and_names_must_fit():
    assert rules_in_words(LFM(2)) == []
    with pytest.raises(ValueError, match="2 names"):
        rules_in_words(NFLFM(2), ["one"])


def test_every_sample_of_a_motion_fires_some_rule() -> None:
    model = NFLFM(1, terms=(3, 3))
    model.schedule.set_range(10.0, [-50.0, 50.0])
    step = torch.tensor([0.5, 1.5, 1.0]).double()
    qd, qdd = torch.tensor([[0.0, 0.0], [10.0, 50.0], [-10.0, 50.0]]).double().T[..., None]
    seconds = model.schedule.fuzzy_rules().seconds(step, qd, qdd)[0].reshape(3, 3)
    assert seconds.sum().item() == pytest.approx(3.0)
    # Fastest and speeding up, fastest and braking, at rest.
    assert seconds[2, 2] > 0.85 * 1.5
    assert seconds[2, 0] > 0.85 * 1.0
    assert seconds[0, 1] > 0.8 * 0.5

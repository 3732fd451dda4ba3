"""Evolution of controllers: start, result, and resumption."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from nfriction.friction.laws import LINEAR
from nfriction.papers.controller import evolve as module
from nfriction.papers.controller.evolve import (
    Candidate,
    EvolutionOptions,
    TorqueSamples,
    evolve,
    pareto,
    torque_error,
)
from nfriction.papers.controller.mamdani import MamdaniController, paper_controller

START = paper_controller(2)
V_SMOOTH = 3e-3
OPTIONS = EvolutionOptions(prices=(0.0, 0.5), population=9, generations=4)


def samples() -> TorqueSamples:
    """Friction of a controller with half of the paper's outputs."""
    random = torch.Generator().manual_seed(0)
    qd, qdd, load = (
        scale * (2 * torch.rand(120, generator=random, dtype=torch.float64) - 1)
        for scale in (15.0, 100.0, 1.0)
    )
    coefficients = 0.5 * START(qd.abs(), qdd)
    return TorqueSamples(qd, qdd, load.abs(), LINEAR.torque(qd, load.abs(), coefficients, V_SMOOTH))


def test_controller_genome_round_trip_is_exact() -> None:
    again = module._expressed(START, module._genes_of(START).tolist())
    given = samples()
    torch.testing.assert_close(
        again(given.qd.abs(), given.qdd), START(given.qd.abs(), given.qdd), rtol=1e-12, atol=0
    )


def test_evolution_improves_and_rule_penalty_removes_rules() -> None:
    given = samples()
    front = evolve(START, LINEAR, given, v_smooth=V_SMOOTH, options=OPTIONS)
    assert min(c.error for c in front) < 0.9 * torque_error(START, LINEAR, given, V_SMOOTH)
    rules, errors = [c.rules for c in front], [c.error for c in front]
    assert rules == sorted(set(rules))
    assert errors == sorted(errors, reverse=True)
    assert rules[0] < len(START.rule_base.rules)
    for one in front:
        assert isinstance(one.controller, MamdaniController)
        assert one.error == torque_error(one.controller, LINEAR, given, V_SMOOTH)


@pytest.mark.slow
def test_resumed_evolution_equals_the_uninterrupted_one(tmp_path: Path) -> None:
    given, file = samples(), tmp_path / "kept.json"
    whole = evolve(START, LINEAR, given, v_smooth=V_SMOOTH, options=OPTIONS)
    half = replace(OPTIONS, generations=2, checkpoint=file)
    evolve(START, LINEAR, given, v_smooth=V_SMOOTH, options=half)
    seen: list[tuple[float, int]] = []
    again = evolve(
        START, LINEAR, given, v_smooth=V_SMOOTH, options=replace(OPTIONS, checkpoint=file),
        callback=lambda *about: seen.append(about),
    )  # fmt: skip
    assert [g for _, g in seen] == [2, 3, 2, 3]
    assert [c.controller.rule_base for c in again] == [c.controller.rule_base for c in whole]
    with pytest.raises(ValueError, match="no checkpoint of these options"):
        evolve(START, LINEAR, given, v_smooth=V_SMOOTH, options=replace(half, seed=7))


def test_front_contains_no_dominated_candidate() -> None:
    def candidate(rules: int, error: float) -> Candidate:
        return Candidate(START, error, rules)

    front = pareto([candidate(*x) for x in ((3, 2.0), (3, 1.5), (5, 1.5), (7, 1.0), (9, 1.2))])
    assert [(c.rules, c.error) for c in front] == [(3, 1.5), (7, 1.0)]


def test_invalid_arguments_are_refused() -> None:
    with pytest.raises(ValueError, match="population"):
        EvolutionOptions(population=3)


def test_controller_keeps_at_least_one_rule() -> None:
    genes = module._genes_of(START)
    genes[-len(START.rule_base.rules) :] = np.linspace(0.0, 0.4, len(START.rule_base.rules))
    assert len(module._expressed(START, genes.tolist()).rule_base.rules) == 1


def test_averages_over_blocks_ignore_alternating_noise() -> None:
    given = samples()
    noise = 0.1 * (-1.0) ** torch.arange(len(given.qd))
    noisy = replace(given, torque=torque_of_the_start(given) + noise)
    assert torque_error(START, LINEAR, noisy, V_SMOOTH) == pytest.approx(0.1)
    assert torque_error(START, LINEAR, replace(noisy, block=2), V_SMOOTH) < 1e-12


def torque_of_the_start(given: TorqueSamples) -> torch.Tensor:
    coefficients = START(given.qd.abs(), given.qdd)
    return LINEAR.torque(given.qd, given.load, coefficients, V_SMOOTH)

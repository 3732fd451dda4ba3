"""A stage tells its steps, ends where it creeps, and says so."""

import pytest
import torch

from nfriction import LFM
from nfriction.fitting.data.inputs import mixing_of
from nfriction.fitting.data.windows import cut_windows
from nfriction.fitting.strategy.continuation import PATIENCE, SETTLED, Refinement, _Watch
from nfriction.optim.least_squares import Step
from nfriction.signals import kalman_smoother
from tests.fitting.recordings import F64, pendulum, swing


def stops(costs, tolerance=1e-3, callback=None):
    """After how many steps the watch ends a search of these costs."""
    _, problem = short_search()
    watch, x = _Watch("stage", tolerance, callback, problem), problem.unknowns.start()
    # Damped, so that a point that stays is no rest.
    return [watch(x, Step(cost, 10.0, 1.0)) for cost in costs], watch


def test_only_a_search_that_creeps_is_ended():
    falling, watch = stops([0.9**k for k in range(20)])
    assert not any(falling)
    assert not watch.creeps
    creeping, watch = stops([1.0, 0.5] + [0.4 - 1e-5 * k for k in range(10)])
    assert creeping.index(True) == 2 + PATIENCE
    assert watch.creeps


def test_the_caller_hears_every_step_and_may_stop():
    heard = []

    def callback(stage, step):
        heard.append((stage, step.cost))
        return step.cost < 0.5

    ended, watch = stops([0.9, 0.7, 0.4], callback=callback)
    assert ended == [False, False, True]
    assert heard == [("stage", 0.9), ("stage", 0.7), ("stage", 0.4)]
    assert not watch.creeps


def short_search():
    """A search of one short swing, and its problem."""
    plant, model = pendulum(), LFM(2, [[1e-3, 1e-3]] * 2, v_smooth=0.05)
    recording = swing(plant, LFM(2, [[2e-3, 3e-3]] * 2, v_smooth=0.05), seconds=1.0)
    motion = kalman_smoother(recording.time, recording.q)
    mixing = mixing_of(plant, recording.resolve_convention(plant))
    search = Refinement(plant, model, [recording], mixing, [], max_steps=20)
    return search, search.problem(cut_windows([recording], [motion], 0.5), 1e-3)


@pytest.mark.parametrize(("why", "status"), [("creeps", "creeping"), ("settles", "converged_step")])
def test_only_a_search_that_settled_claims_convergence(monkeypatch, why, status):
    def end(self, x, step):
        setattr(self, why, True)
        return True

    monkeypatch.setattr(_Watch, "__call__", end)
    search, problem = short_search()
    ended = search.search(problem, torch.zeros(0, dtype=F64), 1e-9, "")
    assert ended.result.status == status
    assert ended.result.converged == (why == "settles")
    assert ended.vector.shape == (0,)


def test_what_is_shared_has_settled_once_it_moves_no_more():
    """Window states may go on; a step that damping cut short is no rest."""
    _, problem = short_search()
    x = problem.unknowns.start()
    problem.quadratic(x)
    spread, count = problem.spread(), problem.unknowns.shared_count
    far, near, states = x.clone(), x.clone(), x.clone()
    far[:count] += spread
    near[:count] += 0.5 * SETTLED * spread
    states[count:] += 1.0

    def settles(points, damping=0.0):
        watch = _Watch("stage", 0.0, None, problem)
        for k, point in enumerate(points):
            watch(point, Step(0.5**k, damping, 1.0))
        return watch.settles

    assert settles([x, near, x, near])
    assert settles([x, states, x, states])
    assert not settles([x, far, x, far])
    assert not settles([x, near, far, near])
    assert not settles([x, near, x, near], damping=10.0)

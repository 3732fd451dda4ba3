"""A stage tells its steps, ends where it creeps, and says so."""

import torch

from nfriction import LFM
from nfriction.fitting.preparation import mixing_of
from nfriction.fitting.stages import PATIENCE, Refinement, _Watch
from nfriction.fitting.windows import cut_windows
from nfriction.signals import kalman_smoother
from nfriction.solve.levenberg import Step
from tests.fitting.recordings import F64, pendulum, swing

X = torch.zeros(1, dtype=F64)


def stops(costs, tolerance=1e-3, callback=None):
    """After how many steps the watch ends a search of these costs."""
    watch = _Watch("stage", tolerance, callback)
    return [watch(X, Step(cost, 1.0, 1.0)) for cost in costs], watch


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


def test_a_search_that_creeps_does_not_claim_convergence():
    """With a tolerance that every step falls short of, it ends after as many as patience has."""
    plant, model = pendulum(), LFM(2, [[1e-3, 1e-3]] * 2, v_smooth=0.05)
    recording = swing(plant, LFM(2, [[2e-3, 3e-3]] * 2, v_smooth=0.05), seconds=1.0)
    motion = kalman_smoother(recording.time, recording.q)
    mixing = mixing_of(plant, recording.convention_on(plant))
    search = Refinement(plant, model, [recording], mixing, [], max_steps=20)
    problem = search.problem(cut_windows([recording], [motion], 0.5), 1e-3)
    ended = search.search(problem, torch.zeros(0, dtype=F64), 1e-9, "")
    assert ended.result.status in ("stalled", "converged_cost", "converged_step")
    assert (ended.result.status == "stalled") != ended.result.converged
    assert ended.vector.shape == (0,)

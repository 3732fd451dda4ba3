"""Closed loops: the motion equals a rollout's; encoders, delay and drives act as specified."""

import math

import numpy as np
import pytest
import torch

from nfriction import ALFM, rigs, rollout
from nfriction.friction.memory import LuGre
from nfriction.friction.models import LFM
from nfriction.simulation.closed_loop import Electronics, control

PLANT = rigs.tlrip()
START = torch.tensor([math.pi + 0.4, 0.2, -0.3], dtype=torch.float64)


def spring(time: float, q: np.ndarray) -> np.ndarray:
    return 0.5 * math.cos(3.0 * time) - 0.8 * (q - math.pi * np.eye(3)[0])


def friction(kind: type = LFM) -> LFM:
    return kind(3, [0.02, 0.01]).requires_grad_(False)


@pytest.mark.parametrize("kind", [LFM, ALFM])
def test_closed_loop_equals_the_rollout_of_its_torques(kind: type) -> None:
    found = control(PLANT, friction(kind), spring, START, 0 * START, steps=300)
    again = rollout(PLANT, friction(kind), START, 0 * START, found.tau)
    assert torch.equal(found.q, again.q)
    assert torch.equal(found.qd, again.qd)


def test_friction_with_memory_keeps_its_state_from_sample_to_sample() -> None:
    bristles = LuGre(3, [0.02, 0.01, 0.1, 50.0, 0.05, 0.01]).requires_grad_(False)
    found = control(PLANT, bristles, spring, START, 0 * START, steps=300)
    again = rollout(PLANT, bristles, START, 0 * START, found.tau)
    assert torch.equal(found.q, again.q)
    assert torch.equal(found.law_state, again.law_state)


def test_batch_equals_its_single_motions() -> None:
    starts = torch.stack([START, START + 0.1])
    together = control(PLANT, friction(), spring, starts, 0 * starts, steps=50)
    for k, start in enumerate(starts):
        alone = control(PLANT, friction(), spring, start, 0 * start, steps=50)
        torch.testing.assert_close(together.q[k], alone.q, rtol=0, atol=1e-12)


def test_encoders_delay_and_drives_act_as_specified() -> None:
    seen = []

    def controller(time: float, q: np.ndarray) -> np.ndarray:
        seen.append(q)
        return np.full(3, 1.0 + 10.0 * time)

    electronics = Electronics(counts=1000, delay=2, torque_limit=1.05, torque_bits=8)
    found = control(PLANT, None, controller, START, 0 * START, steps=10, electronics=electronics)
    np.testing.assert_array_equal(found.measured.numpy(), np.stack(seen))
    counts = found.measured.numpy() / (2 * math.pi / 1000)
    np.testing.assert_allclose(counts, np.rint(counts), atol=1e-9)
    assert (np.abs(found.measured.numpy() - found.q[:-1].numpy()) <= math.pi / 1000).all()
    step = 1.05 / 128
    wanted = np.rint(np.clip(1.0 + 0.01 * np.arange(8), -1.05, 1.05) / step) * step
    np.testing.assert_allclose(found.tau[:, 0].numpy(), [0.0, 0.0, *wanted], atol=1e-12)


def test_diverging_motion_does_not_stop_the_others() -> None:
    starts = torch.stack([START, START])

    def controller(time: float, q: np.ndarray) -> np.ndarray:
        return np.stack([np.full(3, 1e9), np.zeros(3)])

    found = control(PLANT, friction(), controller, starts, 0 * starts, steps=20)
    assert found.diverged.tolist() == [True, False]
    again = rollout(PLANT, friction(), starts, 0 * starts, found.tau)
    torch.testing.assert_close(found.diverged_at, again.diverged_at)
    assert torch.isnan(found.q[0, -1]).all()
    assert torch.isfinite(found.q[1]).all()


@pytest.mark.parametrize("bad", [np.zeros(2), np.full(3, np.nan)])
def test_invalid_controller_output_is_refused(bad: np.ndarray) -> None:
    with pytest.raises(ValueError, match="finite torques"):
        control(PLANT, None, lambda *_: bad, START, 0 * START, steps=3)


@pytest.mark.parametrize(
    "options",
    [{"counts": 0}, {"delay": -1}, {"delay": 1.5}, {"torque_limit": 0.0}, {"torque_bits": 8}],
)
def test_invalid_electronics_are_refused(options: dict) -> None:
    with pytest.raises(ValueError, match=next(iter(options))):
        Electronics(**options)

"""Exports of laws with memory: torques of a motion, first samples, lost samples, refusals."""

import math
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from nfriction import ModelInfo, export
from nfriction.export.c_file import c_runner, find_compiler
from nfriction.friction.coefficients import Constant
from nfriction.friction.hysteresis import ELEMENTS, LoadSlip, Slip
from nfriction.friction.laws import Coefficient, Law, Memory
from nfriction.friction.memory import Dahl, ElastoPlastic, LuGre, MaxwellSlip, NFLuGre
from nfriction.friction.models import FrictionModel
from nfriction.friction.sampled import sampled

F64 = torch.float64
STEP = 2e-3
INFO = ModelInfo(sample_time=STEP)
HYSTERESIS = [0.1, 0.2, 0.3, 0.1, 0.2, 0.03, 1e-3, 0.0]
HYSTERESIS += [*[0.05] * ELEMENTS, *[10.0 ** (0.2 * k - 4) for k in range(ELEMENTS)]]


def corrected(model: FrictionModel, size: float = 0.2) -> FrictionModel:
    """A model whose network is anything that a fit may find."""
    model.schedule.set_range(0.5, [-3.0, 3.0])
    lower, upper = model.schedule.bounds()
    noise = torch.randn(lower.shape, generator=torch.Generator().manual_seed(0), dtype=F64)
    model.schedule.set_parameter_vector(torch.where(lower < upper, size * noise, 0.0))
    return model


MODELS: dict[str, FrictionModel] = {
    "lugre": LuGre(2, [[1.0, 0.5, 0.001, 1e5, 300.0, 0.4], [0.3, 0.1, 0.01, 1e3, 1.0, 0.1]]),
    "elasto-plastic": ElastoPlastic(2, [1.0, 0.5, 0.001, 1e5, 300.0, 0.4, 0.7]),
    "dahl": Dahl(2, [0.5, 0.1, 1e3]),
    "maxwell-slip": MaxwellSlip(2, elements=3),
    "slip": Slip(2, HYSTERESIS),
    "load-slip": LoadSlip(2, HYSTERESIS),
    "neuro-fuzzy lugre": corrected(NFLuGre(2, [1.0, 0.5, 0.05, 1e3, 3.0, 0.4], terms=(3, 2))),
}
every_model = pytest.mark.parametrize("name", MODELS)
needs_compiler = pytest.mark.skipif(find_compiler() is None, reason="no C compiler")


def motion(count: int) -> Tensor:
    """Velocities from presliding to sliding and back, (sample, joint)."""
    t = torch.arange(count, dtype=F64)[:, None] * STEP
    size = torch.exp(6.0 * torch.sin(0.9 * t) - 5.0)
    return size * torch.sin(torch.tensor([7.0, 11.0], dtype=F64) * t)


def torques(model: FrictionModel, qd: Tensor) -> Tensor:
    """Torques along a motion by the law's own two functions."""
    law = model.law.memory
    assert law is not None
    state, one = torch.zeros(2, law.size, dtype=F64), torch.ones(2, dtype=F64)
    along, found = model.coefficients(qd, 0.0 * qd).detach().expand(*qd.shape, -1), []
    for v, c in zip(qd, along, strict=True):
        state = law.advance(state, v, one, c, STEP)
        found.append(law.torque(state, v, one, c))
    return torch.stack(found)


@needs_compiler
@every_model
def test_c_gives_the_torques_of_the_law(name: str, tmp_path: Path) -> None:
    qd = motion(3000)
    run = c_runner(export.c(MODELS[name], tmp_path, INFO)[0])
    tau, coefficients, status = run(qd.numpy(), np.zeros(qd.shape), np.ones(qd.shape))
    expected = torques(MODELS[name], qd).numpy()
    assert np.abs(tau - expected).max() <= 1e-14 * np.abs(expected).max()
    assert not status.any()
    # Behind the law's coefficients the state is given out.
    law = MODELS[name].law
    assert coefficients.shape[-1] == len(law.names) + law.state_size
    assert np.ptp(coefficients[:, 0, len(law.names)]) > 0


@needs_compiler
def test_c_begins_anew_after_a_reset_and_keeps_its_state_over_a_lost_sample(tmp_path: Path) -> None:
    model, qd = MODELS["lugre"], motion(400)
    run = c_runner(export.c(model, tmp_path, INFO)[0])
    zero, one = np.zeros(qd.shape), np.ones(qd.shape)
    first, again = (run(qd.numpy(), zero, one)[0] for _ in range(2))
    assert np.array_equal(first, again)
    lost = qd.clone()
    lost[200, 0] = math.nan
    lost[201, 0] = math.inf
    tau, _, status = run(lost.numpy(), zero, one)
    assert np.isnan(tau[200:202, 0]).all()
    assert (status[200:202, 0] == 2).all()
    assert np.array_equal(tau[:, 1], first[:, 1])
    # The joint goes on from where it was, as if the two samples had not been.
    kept = torch.cat([qd[:200], qd[202:]])
    np.testing.assert_allclose(tau[202:, 0], torques(model, kept)[200:, 0], rtol=1e-12)


@every_model
def test_torchscript_steps_with_a_state(name: str, tmp_path: Path) -> None:
    qd = motion(300)
    module = torch.jit.load(str(export.torchscript(MODELS[name], tmp_path / "model.pt", INFO)))
    rest, one = torch.zeros_like(qd), torch.ones_like(qd)
    state = module.initial_state(qd[0], rest[0])
    assert not state.any()
    found = []
    for k in range(len(qd)):
        tau, _, _, state = module.step(qd[k], rest[k], one[k], state)
        found.append(tau)
    expected = torques(MODELS[name], qd)
    assert float((torch.stack(found) - expected).abs().max() / expected.abs().max()) < 1e-14


def test_a_model_without_sample_time_is_refused(tmp_path: Path) -> None:
    for write in (export.c, export.torchscript, export.onnx, export.pt2):
        with pytest.raises(ValueError, match="has memory, which a controller advances by"):
            write(MODELS["lugre"], tmp_path / "x")


def wound(state: Tensor, qd: Tensor, load: Tensor, coefficients: Tensor, step: float) -> Tensor:
    return state + (load * qd * step).unsqueeze(-1)


def spring(state: Tensor, qd: Tensor, load: Tensor, coefficients: Tensor) -> Tensor:
    return coefficients.select(-1, 0) * state.select(-1, 0)


def nothing(qd: Tensor, load: Tensor, coefficients: Tensor, v_smooth: float) -> Tensor:
    return 0.0 * qd


def test_a_state_that_the_load_moves_is_refused() -> None:
    law = Law("wound", (Coefficient("k", "N m/rad"),), nothing, memory=Memory(1, wound, spring))
    with pytest.raises(ValueError, match="depends on the load"):
        sampled(FrictionModel(law, Constant(law, 2)), 1e-3)

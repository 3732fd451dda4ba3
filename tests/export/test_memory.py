"""Exports of laws with memory: torques of a motion, first samples, lost samples, refusals."""

import math
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from nfriction import ModelInfo, export
from nfriction.export.c_file import c_runner, find_compiler
from nfriction.friction.hysteresis import ELEMENTS, LoadSlip, Slip
from nfriction.friction.memory import Dahl, ElastoPlastic, Gear, LuGre, MaxwellSlip, NFLuGre
from nfriction.friction.models import FrictionModel
from tests.friction.samples import warming_network

F64 = torch.float64
STEP = 2e-3
INFO = ModelInfo(sample_time=STEP)
HYSTERESIS = [0.1, 0.2, 0.3, 0.1, 0.2, 0.03, 1e-3, 0.0]
HYSTERESIS += [*[0.05] * ELEMENTS, *[10.0 ** (0.2 * k - 4) for k in range(ELEMENTS)]]


def corrected(model: FrictionModel, size: float = 0.2) -> FrictionModel:
    """A model with a randomised network, as general as any that a fit may find."""
    model.schedule.set_range(0.5, [-3.0, 3.0])
    lower, upper = model.schedule.bounds()
    noise = torch.randn(lower.shape, generator=torch.Generator().manual_seed(0), dtype=F64)
    model.schedule.set_parameter_vector(torch.where(lower < upper, size * noise, 0.0))
    return model


MODELS: dict[str, FrictionModel] = {
    "lugre": LuGre(2, [[1.0, 0.5, 0.001, 1e5, 300.0, 0.4], [0.3, 0.1, 0.01, 1e3, 1.0, 0.1]]),
    "elasto-plastic": ElastoPlastic(2, [1.0, 0.5, 0.001, 1e5, 300.0, 0.4, 0.7]),
    "dahl": Dahl(2, [0.5, 0.1, 1e3]),
    "gear": Gear(2, [[0.4, 0.08, 0.2, 0.3, 400.0], [0.1, 0.3, 0.1, 0.05, 1e3]]),
    "maxwell-slip": MaxwellSlip(2, elements=3),
    "slip": Slip(2, HYSTERESIS),
    "load-slip": LoadSlip(2, HYSTERESIS),
    "neuro-fuzzy lugre": corrected(NFLuGre(2, [1.0, 0.5, 0.05, 1e3, 3.0, 0.4], terms=(3, 2))),
}
# The others are special cases of these, or have the same elements.
QUICK = {"elasto-plastic", "gear", "maxwell-slip", "neuro-fuzzy lugre"}
every_model = pytest.mark.parametrize(
    "name", [pytest.param(x, marks=[pytest.mark.slow] * (x not in QUICK)) for x in MODELS]
)
needs_compiler = pytest.mark.skipif(find_compiler() is None, reason="no C compiler")


def motion(count: int) -> Tensor:
    """Velocities from presliding to sliding and back, (sample, joint)."""
    t = torch.arange(count, dtype=F64)[:, None] * STEP
    size = torch.exp(6.0 * torch.sin(0.9 * t) - 5.0)
    return size * torch.sin(torch.tensor([7.0, 11.0], dtype=F64) * t)


def loads(qd: Tensor) -> Tensor:
    """Loads along a motion, with either sign as for transmitted torques, (sample, joint)."""
    t = torch.arange(len(qd), dtype=F64)[:, None] * STEP
    return 2.0 * torch.sin(torch.tensor([3.0, 5.0], dtype=F64) * t + 0.4)


def torques(model: FrictionModel, qd: Tensor, load: Tensor | None = None) -> Tensor:
    """Torques along a motion by the law's own two functions, by default with the `loads`."""
    law = model.law.memory
    assert law is not None
    state, load = torch.zeros(2, law.size, dtype=F64), loads(qd) if load is None else load
    along, found = model.coefficients(qd, 0.0 * qd).detach().expand(*qd.shape, -1), []
    for v, n, c in zip(qd, load, along, strict=True):
        state = law.advance(state, v, n, c, STEP)
        found.append(law.torque(state, v, n, c))
    return torch.stack(found)


@needs_compiler
@every_model
def test_c_equals_the_law(name: str, tmp_path: Path) -> None:
    qd = motion(3000)
    run = c_runner(export.c(MODELS[name], tmp_path, INFO)[0])
    tau, coefficients, status = run(qd.numpy(), np.zeros(qd.shape), loads(qd).numpy())
    expected = torques(MODELS[name], qd).numpy()
    assert np.abs(tau - expected).max() <= 1e-14 * np.abs(expected).max()
    assert not status.any()
    # The state is returned after the law's coefficients.
    law = MODELS[name].law
    assert coefficients.shape[-1] == len(law.names) + law.state_size
    assert np.ptp(coefficients[:, 0, len(law.names)]) > 0


@needs_compiler
@pytest.mark.parametrize("name", ["lugre", "gear"])
def test_c_restarts_after_a_reset_and_keeps_its_state_over_lost_samples(
    name: str, tmp_path: Path
) -> None:
    model, qd = MODELS[name], motion(400)
    run = c_runner(export.c(model, tmp_path, INFO)[0])
    zero, load = np.zeros(qd.shape), loads(qd)
    first, again = (run(qd.numpy(), zero, load.numpy())[0] for _ in range(2))
    assert np.array_equal(first, again)
    lost, unknown = qd.clone(), load.clone()
    lost[200, 0] = math.nan
    lost[201, 0] = math.inf
    rows = [*range(200), *range(202, 400)]
    if name == "gear":
        # The state of this law cannot follow an unknown load.
        unknown[202, 0] = math.nan
        rows.remove(202)
    tau, _, status = run(lost.numpy(), zero, unknown.numpy())
    bad = np.setdiff1d(np.arange(400), rows)
    assert np.isnan(tau[bad, 0]).all()
    assert (status[bad, 0] == 2).all()
    assert np.array_equal(tau[:, 1], first[:, 1])
    # The joint continues from its last state, as if these samples did not exist.
    expected = torques(model, qd[rows], load[rows])
    np.testing.assert_allclose(tau[rows, 0], expected[:, 0], rtol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["gear.pt2", "gear.onnx"])
def test_load_dependent_state_is_in_all_formats(name: str, tmp_path: Path) -> None:
    if name.endswith("onnx"):
        pytest.importorskip("onnx")
    write = export.onnx if name.endswith("onnx") else export.pt2
    path = write(MODELS["gear"], tmp_path / name, INFO)
    verdict = export.verify_artefact(path, MODELS["gear"], INFO, points=500)
    assert verdict.passed
    assert verdict.points.torque_error < 1e-12


@every_model
def test_torchscript_is_stepped_with_a_state(name: str, tmp_path: Path) -> None:
    qd = motion(300)
    module = torch.jit.load(str(export.torchscript(MODELS[name], tmp_path / "model.pt", INFO)))
    rest, load = torch.zeros_like(qd), loads(qd)
    state = module.initial_state(qd[0], rest[0])
    assert not state.any()
    found = []
    for k in range(len(qd)):
        tau, _, _, state = module.step(qd[k], rest[k], load[k], state)
        found.append(tau)
    expected = torques(MODELS[name], qd)
    assert float((torch.stack(found) - expected).abs().max() / expected.abs().max()) < 1e-14


def test_torchscript_refuses_a_memory_without_a_state(tmp_path: Path) -> None:
    path, zero = tmp_path / "model.pt", torch.zeros(2, dtype=F64)
    heated = warming_network()
    for model, with_filter in ((MODELS["dahl"], False), (MODELS["gear"], True), (heated, False)):
        module = torch.jit.load(str(export.torchscript(model, path, INFO, with_filter=with_filter)))
        with pytest.raises(torch.jit.Error, match=r"depends on earlier samples.*module\.step"):
            module(zero, zero, zero)
    assert export.verify_artefact(path, heated, INFO, points=50).passed


def test_a_model_without_sample_time_is_refused(tmp_path: Path) -> None:
    for write in (export.c, export.torchscript, export.onnx, export.pt2):
        with pytest.raises(ValueError, match="has memory, which a controller advances by"):
            write(MODELS["lugre"], tmp_path / "x")

"""Exports of friction that falls with heat, which is a state of the controller."""

import copy
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from nfriction import ModelInfo, export
from nfriction.export.c_file import c_runner, find_compiler
from nfriction.export.contract import contract_of
from nfriction.export.controller import controller_of
from tests.friction.samples import motion, warming_network

MODEL, INFO = warming_network(), ModelInfo(sample_time=2e-3)


def along(qd: Tensor, qdd: Tensor, load: Tensor) -> tuple[Tensor, Tensor]:
    """Torque and heat at each sample of a motion that starts cold."""
    state, found = MODEL.initial_state(qd[0], qdd[0]), []
    for v, a, n in zip(qd, qdd, load, strict=True):
        state = MODEL.advance(v, a, state)
        found.append((MODEL.torque(v, n, MODEL.coefficients_from(v, a, state)), state[..., 0]))
    torque, heat = zip(*found, strict=True)
    return torch.stack(torque), torch.stack(heat)


@pytest.mark.skipif(find_compiler() is None, reason="no C compiler")
def test_heat_in_c_equals_the_models_and_is_zero_after_a_reset(tmp_path: Path) -> None:
    given = motion(400, 2)
    torque, heat = along(*given)
    run = c_runner(export.c(MODEL, tmp_path, INFO)[0])
    for _ in range(2):
        tau, coefficients, status = run(*(x.numpy() for x in given))
        np.testing.assert_allclose(tau, torque, rtol=0, atol=1e-13 * float(torque.abs().max()))
        np.testing.assert_allclose(coefficients[..., -1], heat, rtol=1e-12, atol=1e-15)
        assert not (status & 2).any()
    assert heat[-1].min() > 0.05


@pytest.mark.slow
@pytest.mark.skipif(find_compiler() is None, reason="no C compiler")
def test_c_in_single_precision_keeps_small_heat_increments(tmp_path: Path) -> None:
    model = copy.deepcopy(MODEL)
    model.schedule.set_heat(3.0, 1e6, 2e-3)
    # A hot joint that then creeps: one increment of its heat is below half an ulp in float.
    qd = np.full((200_000, 2), 2e-4)
    qd[:10] = 20.0
    heats = []
    for dtype in ("float64", "float32"):
        run = c_runner(export.c(model, tmp_path, INFO, dtype=dtype)[0])
        heats.append(run(qd, 0.0 * qd, 0.0 * qd + 1.0)[1][..., -1])
    assert (heats[0][-1] - heats[0][10]).min() > 1e-3
    np.testing.assert_allclose(heats[1], heats[0], rtol=1e-6)


def test_onnx_in_single_precision_that_would_lose_heat_is_refused(tmp_path: Path) -> None:
    pytest.importorskip("onnx")
    model = copy.deepcopy(MODEL)
    model.schedule.set_heat(3.0, 600.0, 2e-3)
    with pytest.raises(ValueError, match="time constant of 600 s loses its steps of"):
        export.onnx(model, tmp_path / "m.onnx", INFO, dtype="float32")


@pytest.mark.parametrize(("info", "expected"), [(ModelInfo(sample_time=1e-3), 1e-3), (None, 2e-3)])
def test_heat_is_integrated_with_the_stated_sample_time(info, expected: float) -> None:
    controller = controller_of(MODEL, info)
    assert controller.model.schedule.sample_time == pytest.approx(expected)
    description = contract_of(MODEL, controller, info).description
    assert description["sample_time"] == pytest.approx(expected)
    assert MODEL.schedule.sample_time == pytest.approx(2e-3)


def test_heat_in_torchscript_equals_the_models(tmp_path: Path) -> None:
    given = motion(200, 2)
    module = torch.jit.load(str(export.torchscript(MODEL, tmp_path / "model.pt", INFO)))
    state, found = module.initial_state(given[0][0], given[1][0]), []
    for sample in zip(*given, strict=True):
        tau, _, _, state = module.step(*sample, state)
        found.append(tau)
    torch.testing.assert_close(torch.stack(found), along(*given)[0], rtol=1e-12, atol=1e-13)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["model.pt2", "model.onnx"])
def test_heat_in_other_formats_equals_the_models(name: str, tmp_path: Path) -> None:
    if name.endswith("onnx"):
        pytest.importorskip("onnx")
    write = export.onnx if name.endswith("onnx") else export.pt2
    path = write(MODEL, tmp_path / name, INFO)
    verdict = export.verify_artefact(path, MODEL, INFO, points=500)
    assert verdict.passed
    assert verdict.points.torque_error < 1e-12

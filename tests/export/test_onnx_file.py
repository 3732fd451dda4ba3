"""ONNX: equal to the model in double, close to it in single precision; refusals."""

import importlib.util
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from nfriction.export import ExportError, onnx, verify_artefact
from nfriction.export.contract import ContractError, compare, draw
from nfriction.export.controller import controller_of
from nfriction.export.onnx_file import contract_of_onnx
from nfriction.export.torch_files import METADATA
from nfriction.friction.coefficients import Constant
from nfriction.friction.laws import Coefficient, Law
from nfriction.friction.models import LFM, FrictionModel
from nfriction.io.model_file import ModelInfo
from tests.export.artefacts import INFO, rising, runner_of
from tests.friction.samples import named_models

MODELS = named_models()
QUICK = ["NLFM", "ALFM", "NFLFM"]

needs_onnx = pytest.mark.skipif(
    importlib.util.find_spec("onnx") is None, reason="the extra onnx is not installed"
)


@needs_onnx
@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=[pytest.mark.slow] * (n != "NFLFM")) for n in QUICK]
)
def test_model_and_double_export_agree(name: str, tmp_path: Path) -> None:
    check_parity(MODELS[name], tmp_path / "m.onnx", "float64", 5000)


@needs_onnx
@pytest.mark.parametrize("name", ["LFM", pytest.param("NFLFM", marks=pytest.mark.slow)])
def test_model_and_single_export_agree_to_single_precision(name: str, tmp_path: Path) -> None:
    check_parity(MODELS[name], tmp_path / "m.onnx", "float32", 5000)


@needs_onnx
def test_range_edges_are_exact_despite_single_precision(tmp_path: Path) -> None:
    """With either rounding direction: no edge counts as outside, and nothing beyond as inside."""
    info = ModelInfo(input_ranges={"qd": [[-0.1, 0.7]] * 3, "qdd": [[-20.1, 1 / 3]] * 3})
    # Compared with the model, including the edges, when it is written.
    assert onnx(MODELS["LFM"], tmp_path / "m.onnx", info, dtype="float32").is_file()


@needs_onnx
@pytest.mark.slow
@pytest.mark.parametrize("dtype", ["float64", "float32"])
@pytest.mark.parametrize("joints", [1, 2, 3, 4])
@pytest.mark.parametrize("name", MODELS)
def test_parity_over_very_many_points(name: str, joints: int, dtype: str, tmp_path: Path) -> None:
    check_parity(named_models(joints)[name], tmp_path / "m.onnx", dtype, 200_000, joints)


@needs_onnx
@pytest.mark.slow
@pytest.mark.parametrize("name", ["LFM", "ALFM", "NFLFM"])
def test_filter_initialises_itself(name: str, tmp_path: Path) -> None:
    assert onnx(MODELS[name], tmp_path / "m.onnx", INFO, with_filter=True).is_file()


def check_parity(
    model: FrictionModel, path: Path, dtype: str, points: int, joints: int = 3
) -> None:
    info = INFO if joints == 3 else None
    contract = contract_of_onnx(onnx(model, path, info, dtype=dtype))
    controller = controller_of(model, info)
    run = runner_of(path, controller, dtype)
    inputs = draw(controller, points if not model.state_size else min(points // 20, 3000), seed=11)
    if dtype == "float32":
        inputs = tuple(x.float().double() for x in inputs)
    scales = None if dtype == "float64" else contract.scales
    parity = compare(controller.run(*inputs), run(*inputs), contract.tolerance, scales)
    assert parity.passed, parity


@needs_onnx
def test_user_defined_schedule_is_clamped_and_metadata_are_stored(tmp_path: Path) -> None:
    package: Any = pytest.importorskip("onnx")
    check_parity(rising(), tmp_path / "m.onnx", "float64", 1000)
    file = package.load(tmp_path / "m.onnx")
    assert [prop.key for prop in file.metadata_props] == [METADATA]
    assert [x.name for x in file.graph.input] == ["qd", "qdd", "load"]
    assert [x.name for x in file.graph.output] == ["tau_f", "coefficients", "status"]
    doubles = {package.TensorProto.DOUBLE, package.TensorProto.INT32, package.TensorProto.INT64,
               package.TensorProto.BOOL}  # fmt: skip
    # No double value was converted to single precision on the way.
    assert {x.data_type for x in file.graph.initializer} <= doubles


@needs_onnx
def test_without_onnx_runtime_the_reference_evaluator_is_used(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    check_parity(MODELS["NLFM"], tmp_path / "m.onnx", "float64", 500)


@needs_onnx
def test_the_arctangent_is_double_everywhere(tmp_path: Path) -> None:
    law = Law("arctangent", (Coefficient("a", "N m"),), arctangent)
    model = FrictionModel(law, Constant(law, 1, [1.0]))
    run = runner_of(onnx(model, tmp_path / "m.onnx"), controller_of(model))
    x = torch.cat([torch.linspace(-40, 40, 4001), torch.logspace(-12, 30, 500)]).double()[:, None]
    tau_f = run(x, torch.zeros_like(x), torch.zeros_like(x))[0]
    np.testing.assert_allclose(np.asarray(tau_f), np.arctan(x.numpy()), rtol=0, atol=1e-15)


def arctangent(qd: Tensor, load: Tensor, coefficients: Tensor, v_smooth: float) -> Tensor:
    return coefficients.select(-1, 0) * torch.atan(qd)


def through_erf(qd: Tensor, load: Tensor, coefficients: Tensor, v_smooth: float) -> Tensor:
    return coefficients.select(-1, 0) * torch.erf(qd)


@needs_onnx
def test_operation_without_onnx_form_is_named(tmp_path: Path) -> None:
    law = Law("error function", (Coefficient("a", "N m"),), through_erf)
    with pytest.raises(ExportError, match=r"aten\.erf.*no ONNX form"):
        onnx(FrictionModel(law, Constant(law, 2)), tmp_path / "m.onnx")
    assert not list(tmp_path.iterdir())


@needs_onnx
def test_hostile_files_are_refused(tmp_path: Path) -> None:
    package: Any = pytest.importorskip("onnx")
    good = onnx(LFM(2), tmp_path / "good.onnx")
    bad = tmp_path / "bad.onnx"
    for content in (b"", b"junk", good.read_bytes()[:300]):
        bad.write_bytes(content)
        with pytest.raises((ExportError, ContractError)):
            contract_of_onnx(bad)
    file = package.load(good)
    del file.metadata_props[:]
    package.save(file, bad)
    with pytest.raises(ContractError, match="not JSON"):
        contract_of_onnx(bad)


@needs_onnx
def test_other_graphs_are_not_run_and_changed_numbers_are_detected(tmp_path: Path) -> None:
    package: Any = pytest.importorskip("onnx")
    model = LFM(2, [1e-3, 2e-3])
    path = onnx(model, tmp_path / "m.onnx")
    file = package.load(path)
    numbers = next(x for x in file.graph.initializer if list(x.dims) == [2, 2])  # coefficients
    numbers.raw_data = (1.001 * np.frombuffer(numbers.raw_data)).tobytes()
    package.save(file, path)
    verdict = verify_artefact(path, model, points=50)
    assert not verdict.points.passed
    assert verdict.points.coefficient_error == pytest.approx(1e-3)
    file.graph.node[0].op_type = "Loop"
    package.save(file, path)
    with pytest.raises(ExportError, match=r"m\.onnx: its program is not the one"):
        verify_artefact(path, model, points=50)


def test_a_filter_in_single_precision_is_refused(tmp_path: Path) -> None:
    if importlib.util.find_spec("onnx") is None:
        pytest.skip("the extra onnx is not installed")
    with pytest.raises(ValueError, match="filter of ONNX needs float64"):
        onnx(LFM(3), tmp_path / "m.onnx", INFO, dtype="float32", with_filter=True)

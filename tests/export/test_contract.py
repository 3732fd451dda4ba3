"""Contents of an artefact: test vectors that cover the edges, lossless JSON, hostile metadata."""

import json
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from nfriction import export, rigs
from nfriction.export.contract import (
    Contract,
    ContractError,
    compare,
    contract_of,
    verify,
)
from nfriction.export.controller import NOT_FINITE, controller_of
from nfriction.friction.laws import LINEAR
from nfriction.friction.models import LFM, FrictionModel
from nfriction.io.model_file import ModelInfo
from nfriction.signals import Motion
from tests.export.artefacts import INFO, Rising
from tests.friction.samples import named_models

MODELS = named_models()


@cache
def contract(name: str = "LFM", with_filter: bool = False, **options: Any) -> Contract:
    controller = controller_of(MODELS[name], INFO, with_filter=with_filter)
    return contract_of(MODELS[name], controller, INFO, **options)


@pytest.mark.parametrize("name", ["LFM", "ALFM", "NFLFM"])
@pytest.mark.parametrize("with_filter", [False, True])
def test_vectors_cover_the_range_its_outside_and_broken_inputs(
    name: str, with_filter: bool
) -> None:
    found = contract(name, with_filter)
    status = found.outputs["status"]
    assert len(status) >= 200
    for x in found.inputs.values():
        for test in (torch.isnan, torch.isposinf, torch.isneginf):
            assert test(x).any(0).all()
    assert all((status == code).any() for code in (0, 1, NOT_FINITE))
    if not with_filter:
        qd = found.inputs["qd"]
        low, high = torch.tensor(INFO.input_ranges["qd"]).unbind(-1)
        finite = torch.where(torch.isfinite(qd), qd, 0.0)
        assert (finite > high).any(0).all()
        assert (finite < low).any(0).all()
        assert (finite <= high + 0.1 * (high - low) + 1e-9).all()
        assert (qd == 0).any(0).all()


@pytest.mark.parametrize("name", ["LFM", "ALFM"])
def test_json_is_lossless_and_deterministic(name: str) -> None:
    found = contract(name)
    text = found.to_json()
    assert text == contract(name).to_json()
    json.loads(text, parse_constant=pytest.fail)  # a bare NaN is not JSON; some readers refuse it
    back = Contract.from_json(text)
    assert back.to_json() == text
    for side in ("inputs", "outputs"):
        for key, value in getattr(found, side).items():
            torch.testing.assert_close(
                getattr(back, side)[key], value, rtol=0, atol=0, equal_nan=True
            )


def test_json_contains_what_a_host_needs() -> None:
    info = ModelInfo(joint_names=["a", "b", "c"], sample_time=2e-3, training_data={"run": "ab12"})
    controller = controller_of(MODELS["LFM"], info, torque_limit=2.0)
    contract = json.loads(contract_of(MODELS["LFM"], controller, info).to_json())
    assert contract["joint_names"] == ["a", "b", "c"]
    assert contract["units"]["tau_f"] == "N m"
    assert contract["sample_time"] == 2e-3
    assert contract["training_data"] == {"run": "ab12"}
    assert contract["torque_limit"] == [2.0, 2.0, 2.0]
    assert contract["status_bits"] == {"outside": 1, "not_finite": 2, "saturated": 4}
    assert {
        "version",
        "schema",
        "parameter_hash",
        "model",
        "edges",
        "tolerance",
        "scales",
    } <= contract.keys()


def broken_torque(tau_f: Tensor, coefficients: Tensor, status: Tensor) -> tuple[Tensor, ...]:
    tau_f = tau_f.clone()
    tau_f[5, 1] += 1e-11 * tau_f[:200].abs().max()
    return tau_f, coefficients, status


def broken_coefficient(tau_f: Tensor, coefficients: Tensor, status: Tensor) -> tuple[Tensor, ...]:
    return tau_f, coefficients * (1 + 1e-9), status


def broken_status(tau_f: Tensor, coefficients: Tensor, status: Tensor) -> tuple[Tensor, ...]:
    status = status.clone()
    status[0, 0] ^= 1
    return tau_f, coefficients, status


def without_nan(tau_f: Tensor, coefficients: Tensor, status: Tensor) -> tuple[Tensor, ...]:
    return torch.nan_to_num(tau_f), coefficients, status


def infinite(tau_f: Tensor, coefficients: Tensor, status: Tensor) -> tuple[Tensor, ...]:
    tau_f = tau_f.clone()
    tau_f[3, 0] = torch.inf
    return tau_f, coefficients, status


@pytest.mark.parametrize(
    "harm", [broken_torque, broken_coefficient, broken_status, without_nan, infinite]
)
def test_every_difference_is_found(harm: Callable[..., tuple[Tensor, ...]]) -> None:
    found = contract("NFLFM")
    controller = controller_of(MODELS["NFLFM"], INFO)
    assert verify(lambda *x: controller.run(*x), found).passed
    assert not verify(lambda *x: harm(*controller.run(*x)), found).passed


def test_errors_are_relative_to_each_joints_own_scale() -> None:
    tau_f = torch.tensor([[1e-3, 1e3], [-2e-3, 1e3]], dtype=torch.float64)
    rest = torch.ones(2, 2, 1), torch.zeros(2, 2)
    moved = tau_f + torch.tensor([2e-9, 0.0], dtype=torch.float64)
    assert compare((tau_f, *rest), (moved, *rest), 1e-12).torque_error == pytest.approx(1e-6)
    with pytest.raises(ContractError, match="shapes"):
        compare((tau_f, *rest), (tau_f[:1], *rest), 1e-12)


@pytest.mark.parametrize("name", list(MODELS))
def test_scales_are_largest_values_or_larger_for_round_off(name: str) -> None:
    for dtype, tolerance in (("float64", 1e-12), ("float32", 5e-7)):
        found = contract(name, dtype=dtype)
        assert found.tolerance == tolerance
        for key, scale in found.scales.items():
            largest = found.outputs[key].abs().nan_to_num(0.0).flatten(0, -2).amax(0)
            assert (scale >= largest).all()
            assert (scale <= 20.0 * largest).all()


def test_double_only_model_is_judged_by_its_values() -> None:
    class Double(Rising):
        def forward(self, qd: Tensor, qdd: Tensor) -> Tensor:
            return super().forward(qd, qdd) @ torch.eye(2, dtype=torch.float64)

    model = FrictionModel(LINEAR, Double(LINEAR, 3, [1e-3, 2e-3]))
    found = contract_of(model, controller_of(model, INFO), INFO)
    largest = found.outputs["tau_f"].abs().nan_to_num(0.0).amax(0)
    assert torch.equal(found.scales["tau_f"], largest)


def test_dtype_is_float32_or_float64() -> None:
    with pytest.raises(ValueError, match="float32"):
        contract("LFM", dtype="float16")


def edited(**changes: Any) -> str:
    content = json.loads(contract().to_json())
    for key, value in changes.items():
        if value is None:
            del content[key]
        else:
            content[key] = value
    return json.dumps(content)


VECTORS = contract().to_dict()["vectors"]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "not JSON"),
        (contract().to_json()[:-50], "cut short"),
        ("[]", "not those of a controller"),
        ("[" * 100_000, "not JSON|not those"),
        (edited(format="other"), "not those of a controller"),
        (edited(schema=99), "schema is '99', not 1"),
        (edited(vectors=None), "missing or damaged"),
        (edited(vectors={"inputs": {}, "outputs": {}}), "do not fit"),
        (edited(vectors={**VECTORS, "inputs": {"qd": [["one"]]}}), "damaged"),
        (edited(vectors={**VECTORS, "inputs": {"qd": [[True]]}}), "damaged"),
        (edited(vectors={**VECTORS, "inputs": {"qd": [[1.0]]}}), "do not fit"),
        (edited(vectors={**VECTORS, "inputs": {"qd": [0.0] * 200_000}}), "too long"),
        (edited(tolerance="wide"), "damaged"),
        (edited(tolerance=2.0), "do not fit"),
        (edited(tolerance=True), "damaged"),
        (edited(tolerance=10**400), "finite"),
        (edited(scales=None), "missing or damaged"),
        (edited(scales={"tau_f": [1.0] * 3}), "do not fit"),
        (edited(scales={"tau_f": [1.0] * 3, "coefficients": ["nan"] * 2}), "do not fit"),
        (edited(scales={"tau_f": [1.0] * 3, "coefficients": [True] * 2}), "damaged"),
        (edited(vectors={**VECTORS, "inputs": {"qd": [[10**400]]}}), "finite"),
        (edited(state_size=-1), "lack"),
        (edited(state_size=10**9), "lack"),
        (edited(dtype="float8"), "lack"),
        (edited(inputs=["a"]), "lack"),
    ],
)
def test_hostile_metadata_are_refused(text: str, message: str) -> None:
    with pytest.raises(ContractError, match=message):
        Contract.from_json(text)


@pytest.mark.parametrize(
    ("info", "message"),
    [
        (ModelInfo(joint_names=["a"]), "name 2 joints"),
        (
            ModelInfo(rig=rigs.tlrip().to_dict()),
            "`rig` has 3 joints, the model 2: give that",
        ),
    ],
)
def test_names_and_rig_must_have_the_models_joints(
    info: ModelInfo, message: str, tmp_path: Path
) -> None:
    model, motion = LFM(2), Motion(*(np.ones((4, 2)) for _ in range(4)))
    for write in (
        lambda: export.c(model, tmp_path, info),  # its load function would read beyond its array
        lambda: export.torchscript(model, tmp_path / "m.pt", info),
        lambda: export.pt2(model, tmp_path / "m.pt2", info),
        lambda: export.fit_damping_frictionloss(model, motion, info=info),
    ):
        with pytest.raises(ValueError, match=message):
            write()
    assert not list(tmp_path.iterdir())

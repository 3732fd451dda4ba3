"""Verification of artefacts: those of the model pass; altered ones and other models' fail."""

import json
import subprocess
from pathlib import Path
from typing import Any

import pytest
import torch

from nfriction.export import (
    ContractError,
    ExportError,
    c,
    contract_of,
    controller_of,
    onnx,
    pt2,
    torchscript,
    verify_artefact,
)
from nfriction.export.c_file import find_compiler
from nfriction.export.contract import Contract, verify
from nfriction.friction.models import LFM
from nfriction.friction.neurofuzzy import NFNLFM
from tests.export.artefacts import INFO
from tests.friction.samples import named_models, randomise

MODELS = named_models()


@pytest.mark.parametrize("name", ["LFM", "NFLFM", "ALFM"])
def test_torchscript_passes(name: str, tmp_path: Path) -> None:
    path = torchscript(MODELS[name], tmp_path / "m.pt", INFO, torque_limit=[5.0, 6.0, 7.0])
    verdict = verify_artefact(path, MODELS[name], INFO, points=200)
    assert verdict.passed
    assert verdict.vectors.points >= 200
    assert verdict.points.points == 200


@pytest.mark.parametrize(("write", "name"), [(torchscript, "m.pt"), (pt2, "m.pt2")])
def test_one_joint_with_a_torque_limit_passes(write: Any, name: str, tmp_path: Path) -> None:
    model = LFM(1, [0.1, 0.2])
    path = write(model, tmp_path / name, torque_limit=0.2)
    assert verify_artefact(path, model, points=50).passed


@pytest.mark.skipif(find_compiler() is None, reason="needs a C compiler")
@pytest.mark.parametrize("name", [pytest.param("LFM", marks=pytest.mark.slow), "NFLFM", "ALFM"])
@pytest.mark.parametrize("with_filter", [False, True])
@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_c_passes(name: str, with_filter: bool, dtype: str, tmp_path: Path) -> None:
    c(MODELS[name], tmp_path, INFO, name="m", with_filter=with_filter, dtype=dtype)
    verdict = verify_artefact(tmp_path / "m.c", MODELS[name], INFO, points=200)
    assert verdict.passed, verdict


def vanishing(names: set[str]) -> NFNLFM:
    """A model whose named coefficients training has driven to about 1e-9 of their scale."""
    model = NFNLFM(3)
    randomise(model, 0.1)
    chosen = [name in names for name in model.law.names]
    with torch.no_grad():
        model.schedule.network.anfis.consequents[:, chosen, :, 2] -= 15.0
    return model


ONE, ALL = {"f_a"}, {"f_c", "f_v", "f_a", "f_b"}


@pytest.mark.parametrize(
    ("kind", "names"),
    [
        *(("c", ONE), ("c float", ALL), ("pt", ALL)),
        *(
            pytest.param(*x, marks=pytest.mark.slow)
            for x in (("c float", ONE), ("pt", ONE), ("c", ALL))
        ),
        # The same arithmetic as a `.pt`, in formats that are slow to write.
        *(pytest.param(kind, ALL, marks=pytest.mark.slow) for kind in ("onnx", "onnx float")),
    ],
)
def test_coefficient_near_zero_passes(kind: str, names: set[str], tmp_path: Path) -> None:
    """It is a small difference of large numbers: rounding errors are relative to those."""
    if kind.startswith("c") and find_compiler() is None:
        pytest.skip("needs a C compiler")
    model = vanishing(names)
    ending, _, single = kind.partition(" ")
    dtype = {"dtype": "float32"} if single else {}
    path = tmp_path / f"m.{ending}"
    if ending != "c":  # compared with the model when it is written
        {"pt": torchscript, "onnx": onnx}[ending](model, path, INFO, **dtype)
        return
    c(model, tmp_path, INFO, name="m", **dtype)
    verdict = verify_artefact(path, model, INFO, points=500)
    assert verdict.passed, verdict
    for command in (["cc", "m_selftest.c", "m.c", "-o", "m", "-lm"], ["./m"]):
        subprocess.run(command, cwd=tmp_path, check=True)


def test_torque_error_is_found_despite_a_coefficient_near_zero() -> None:
    model = vanishing({"f_a"})
    controller = controller_of(model, INFO)
    contract = contract_of(model, controller, INFO)
    names = list(model.law.names)
    for name in set(names) - {"f_a"}:
        factor = torch.ones(len(names), dtype=torch.float64)
        factor[names.index(name)] += 1e-9

        def run(*x: torch.Tensor, factor: torch.Tensor = factor) -> tuple[torch.Tensor, ...]:
            tau_f, coefficients, status = controller.run(*x)
            return tau_f, coefficients * factor, status

        assert not verify(run, contract).passed, name


def test_an_artefact_is_not_judged_by_its_own_scales(tmp_path: Path) -> None:
    if find_compiler() is None:
        pytest.skip("needs a C compiler")
    other = LFM(3, [1e-3, 2.1e-3])
    c(other, tmp_path, INFO, name="m")
    contract = tmp_path / "m.contract.json"
    content = json.loads(contract.read_text())
    content["tolerance"] = 0.9
    content["scales"] = {name: [1e9] * len(x) for name, x in content["scales"].items()}
    contract.write_text(json.dumps(content))
    verdict = verify_artefact(tmp_path / "m.c", LFM(3, [1e-3, 2e-3]), INFO, points=100)
    assert not verdict.points.passed


def test_artefact_of_another_model_is_detected(tmp_path: Path) -> None:
    other = LFM(3, [1e-3, 2e-3])
    randomise(other, 1e-9)
    path = torchscript(other, tmp_path / "m.pt", INFO)
    verdict = verify_artefact(path, LFM(3, [1e-3, 2e-3]), INFO)
    assert verdict.vectors.passed  # it is consistent with its own vectors, but
    assert not verdict.points.passed
    assert not verdict.passed
    assert ["parameters" in x for x in verdict.differences] == [True]
    with pytest.raises(ExportError, match="3 joints, the model 2"):
        verify_artefact(path, LFM(2), INFO)


@pytest.mark.skipif(find_compiler() is None, reason="needs a C compiler")
def test_an_artefact_of_another_law_is_refused(tmp_path: Path) -> None:
    c(LFM(3), tmp_path, name="m")
    with pytest.raises(ContractError, match="the artefact gives shapes"):
        verify_artefact(tmp_path / "m.c", NFNLFM(3), points=50)


@pytest.mark.skipif(find_compiler() is None, reason="needs a C compiler")
def test_altered_c_is_detected(tmp_path: Path) -> None:
    c(MODELS["LFM"], tmp_path, INFO, name="m")
    source = tmp_path / "m.c"
    text = source.read_text()
    assert "tanh" in text
    source.write_text(text.replace("tanh", "sin"))
    verdict = verify_artefact(source, MODELS["LFM"], INFO, points=100)
    assert not verdict.vectors.passed
    source.write_text("no C at all")
    with pytest.raises(ExportError, match="failed"):
        verify_artefact(source, MODELS["LFM"], INFO)
    contract = tmp_path / "m.contract.json"
    contract.write_text(contract.read_text()[:-100])
    with pytest.raises(ContractError, match="cut short"):
        verify_artefact(source, MODELS["LFM"], INFO)
    contract.unlink()
    with pytest.raises(ContractError, match="not in the same folder"):
        verify_artefact(source, MODELS["LFM"], INFO)


def test_other_files_are_refused(tmp_path: Path) -> None:
    (tmp_path / "m.exe").touch()
    with pytest.raises(ExportError, match=r"one of \.c, \.pt, \.pt2, \.onnx"):
        verify_artefact(tmp_path / "m.exe", LFM(2))
    with pytest.raises(FileNotFoundError):
        verify_artefact(tmp_path / "absent.pt", LFM(2))


def test_huge_files_are_refused_before_they_are_read(tmp_path: Path) -> None:
    for name in ("m.pt", "m.c"):
        with (tmp_path / name).open("wb") as file:
            file.truncate(2**29)  # sparse
    (tmp_path / "m.contract.json").write_text(a_contract().to_json())
    for name in ("m.pt", "m.c"):
        with pytest.raises(ExportError, match="too large"):
            verify_artefact(tmp_path / name, LFM(2))


def a_contract() -> Contract:
    return contract_of(LFM(2), controller_of(LFM(2)))

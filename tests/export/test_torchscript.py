"""TorchScript: equal to the model, needs only torch, silent, never partially written."""

import json
import subprocess
import sys
import warnings
from pathlib import Path

import pytest
import torch
from torch import Tensor

from nfriction.export import ExportError, torchscript
from nfriction.export.contract import compare, draw, draw_motion
from nfriction.export.controller import controller_of
from nfriction.export.torch_files import METADATA, contract_of_archive
from nfriction.friction.coefficients import Constant
from nfriction.friction.laws import Coefficient, Law, TorqueFunction
from nfriction.friction.models import LFM, FrictionModel
from nfriction.friction.neurofuzzy import NFLFM, NeuroFuzzy
from nfriction.io.model_file import ModelInfo, parameter_hash
from tests.export.artefacts import INFO, rising, runner_of
from tests.friction.samples import QUADRATIC, named_models, randomise

# Any warning that the export does not suppress fails the test.
pytestmark = pytest.mark.filterwarnings("error")


def load(path: Path) -> torch.nn.Module:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return torch.jit.load(str(path))


def sample_inputs(model: FrictionModel, count: int, seed: int) -> tuple[torch.Tensor, ...]:
    return draw_motion(controller_of(model), count, seed)


def assert_equal(model: FrictionModel, path: Path) -> None:
    inputs = sample_inputs(model, 2000, seed=7)
    with torch.no_grad():
        expected, found = model(*inputs), load(path)(*inputs)
    assert found.dtype == torch.float64
    # Sums may be taken in another order: a few rounding errors of full scale.
    assert (found - expected).abs().max() <= 1e-12 * expected.abs().max()


@pytest.mark.parametrize("name", named_models())
def test_scripted_models_equal_the_original_without_warnings(name: str, tmp_path: Path) -> None:
    model = named_models()[name]
    training = model.training
    path = torchscript(model, tmp_path / "model.pt")
    if not model.state_size:
        assert_equal(model, path)
    # The model itself is unchanged.
    assert model.training == training
    assert all(p.requires_grad for p in model.parameters())


@pytest.mark.parametrize("make", [Constant, NeuroFuzzy])
def test_user_defined_law_is_scripted(make: type, tmp_path: Path) -> None:
    model = FrictionModel(QUADRATIC, make(QUADRATIC, 2))
    randomise(model, 0.3)
    assert_equal(model, torchscript(model, tmp_path / "own.pt"))


def test_any_batch_shape_and_nan(tmp_path: Path) -> None:
    model = named_models()["NFLFM"]
    loaded = load(torchscript(model, tmp_path / "model.pt"))
    qd, qdd, load_ = sample_inputs(model, 20, seed=1)
    flat = loaded(qd, qdd, load_)
    shaped = loaded(*(x.reshape(4, 5, 3) for x in (qd, qdd, load_)))
    torch.testing.assert_close(shaped.reshape(20, 3), flat, rtol=1e-12, atol=1e-14)
    one = loaded(qd[0], qdd[0], load_[0])
    torch.testing.assert_close(one, flat[0], rtol=1e-12, atol=1e-14)
    qdd[3, 1] = torch.nan
    lost = torch.isnan(loaded(qd, qdd, load_))
    assert lost[3, 1]
    assert lost.sum() == 1


def test_single_precision_models_are_written_in_double(tmp_path: Path) -> None:
    model = NFLFM(2).to(torch.float32)
    path = torchscript(model, tmp_path / "model.pt")
    assert_equal(model.to(torch.float64), path)


ALONE = """
import json, sys
import torch

files = {"nfriction.json": ""}
module = torch.jit.load(sys.argv[1], _extra_files=files)
told = json.loads(files["nfriction.json"])
inputs = torch.load(sys.argv[2], weights_only=True)
torch.save(module(*inputs), sys.argv[3])
assert "nfriction" not in sys.modules
json.dump(told, sys.stdout)
"""


def test_file_runs_and_contains_its_contract_with_torch_alone(tmp_path: Path) -> None:
    model = named_models()["NFNLFM"]
    info = ModelInfo(
        joint_names=["a", "b", "c"], sample_time=1e-3, input_ranges={"qd": [[-1.0, 1.0]] * 3}
    )
    path = torchscript(model, tmp_path / "model.pt", info)
    inputs = sample_inputs(model, 100, seed=3)
    torch.save(inputs, tmp_path / "inputs")
    run = subprocess.run(
        [sys.executable, "-c", ALONE, path, tmp_path / "inputs", tmp_path / "outputs"],
        capture_output=True, text=True, cwd=tmp_path, check=False,
    )  # fmt: skip
    assert run.returncode == 0, run.stderr
    found = torch.load(tmp_path / "outputs", weights_only=True)
    expected = model(*inputs).detach()
    assert (found - expected).abs().max() <= 1e-12 * expected.abs().max()
    contract = json.loads(run.stdout)
    assert contract["joint_names"] == ["a", "b", "c"]
    assert contract["sample_time"] == 1e-3
    assert contract["input_ranges"] == {"qd": [[-1.0, 1.0]] * 3}
    assert contract["units"]["tau_f"] == "N m"
    assert contract["parameter_hash"] == parameter_hash(model.state_dict())
    assert METADATA == "nfriction.json"  # others read it by this name


# The contract


@pytest.mark.parametrize("name", named_models())
def test_step_fulfils_the_contract_within_and_beyond_the_range(name: str, tmp_path: Path) -> None:
    model = named_models()[name]
    check_parity(model, tmp_path / "model.pt", 5000 if not model.state_size else 300)


@pytest.mark.slow
@pytest.mark.parametrize("name", named_models())
def test_parity_over_very_many_points(name: str, tmp_path: Path) -> None:
    model = named_models()[name]
    check_parity(model, tmp_path / "model.pt", 200_000 if not model.state_size else 5000)


def check_parity(model: FrictionModel, path: Path, points: int) -> None:
    torchscript(model, path, INFO, torque_limit=50.0)
    controller = controller_of(model, INFO, torque_limit=50.0)
    inputs = draw(controller, points, seed=11)
    parity = compare(controller.run(*inputs), runner_of(path, controller)(*inputs), 1e-12)
    assert parity.points == points
    assert parity.passed, parity


def test_user_defined_schedule_is_clamped_in_the_artefact(tmp_path: Path) -> None:
    check_parity(rising(), tmp_path / "model.pt", 1000)


def test_nan_and_infinity_give_nan_in_the_short_call_too(tmp_path: Path) -> None:
    model = named_models()["NCFM"]  # whose law uses neither acceleration nor load
    loaded = load(torchscript(model, tmp_path / "model.pt"))
    for which in range(3):
        for bad in (torch.nan, torch.inf, -torch.inf):
            inputs = sample_inputs(model, 5, seed=2)
            inputs[which][3, 1] = bad
            lost = torch.isnan(loaded(*inputs))
            assert lost[3, 1]
            assert lost.sum() == 1


@pytest.mark.parametrize("name", ["LFM", "ALFM", "NFLFM"])
def test_exported_filter_equals_the_external_one(name: str, tmp_path: Path) -> None:
    model = named_models()[name]
    path = torchscript(model, tmp_path / "model.pt", INFO, with_filter=True)
    assert contract_of_archive(path).state_size == 6 + model.state_size
    if not model.state_size:
        assert_equal(model, path)  # the short call still takes motions


# Refusals


def law(function: TorqueFunction) -> Law:
    return Law("odd one", (Coefficient("a", "N m"),), function)


def through_numpy(qd: Tensor, load: Tensor, coefficients: Tensor, v_smooth: float) -> Tensor:
    return coefficients.select(-1, 0) * torch.as_tensor(qd.numpy().copy())


def any_number(*inputs: Tensor) -> Tensor:
    return inputs[2].select(-1, 0) * inputs[0]


def without_annotations(qd, load, coefficients, v_smooth):
    return coefficients.select(-1, 0) * torch.tanh(qd / v_smooth)


@pytest.mark.parametrize(
    ("function", "message"),
    [
        (lambda qd, load, coefficients, v_smooth: coefficients.select(-1, 0) * qd, "the law 'odd "),
        (through_numpy, "the law 'odd one' cannot be scripted.*numpy"),
        (any_number, "the law 'odd one' cannot be scripted.*variable number of arguments"),
        (without_annotations, "the law 'odd one' cannot be scripted.*v_smooth"),
    ],
    ids=["lambda", "numpy", "any number", "without annotations"],
)
def test_unscriptable_models_are_refused_without_leftover_files(
    function: TorqueFunction, message: str, tmp_path: Path
) -> None:
    model = FrictionModel(law(function), Constant(law(function), 2))
    for _ in range(2):  # a second attempt must give the same message
        with pytest.raises(ExportError, match=f"(?s){message}"):
            torchscript(model, tmp_path / "model.pt")
    assert not list(tmp_path.iterdir())
    # Later exports are unaffected.
    torchscript(LFM(2), tmp_path / "good.pt")


def training_only(qd: Tensor, load: Tensor, coefficients: Tensor, v_smooth: float) -> Tensor:
    """A law that computes something else when it is scripted."""
    if torch.jit.is_scripting():
        return coefficients.select(-1, 0) * qd * (1 + 1e-9)
    return coefficients.select(-1, 0) * qd


def test_an_artefact_that_differs_from_its_model_is_not_written(tmp_path: Path) -> None:
    path = torchscript(LFM(2), tmp_path / "model.pt")
    before = path.read_bytes()
    model = FrictionModel(law(training_only), Constant(law(training_only), 2))
    with pytest.raises(ExportError, match=r"differs from its model by 1\.0e-09"):
        torchscript(model, path)
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


def test_joint_names_must_match_the_number_of_joints(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="name 2 joints"):
        torchscript(LFM(2), tmp_path / "model.pt", ModelInfo(joint_names=["a"]))


def test_an_impossible_path_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(OSError, match=r"cannot write the file .*model\.pt"):
        torchscript(LFM(2), tmp_path / "file" / "model.pt")

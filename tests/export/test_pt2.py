"""torch.export programs: equal to the model for any batch."""

import logging
from pathlib import Path

import pytest
import torch

from nfriction.export import pt2
from nfriction.export.contract import compare, draw
from nfriction.export.controller import controller_of
from nfriction.export.torch_files import METADATA
from nfriction.friction.models import FrictionModel
from tests.export.artefacts import INFO, rising, runner_of
from tests.friction.samples import motion, named_models

MODELS = named_models()
# The others are among the slow tests, as an export takes seconds.
QUICK = ["NLFM", "NFLFM"]


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return pt2(MODELS["LFM"], tmp_path_factory.mktemp("pt2") / "model.pt2", INFO)


def check_parity(model: FrictionModel, path: Path, points: int) -> None:
    pt2(model, path, INFO, torque_limit=50.0)
    controller = controller_of(model, INFO, torque_limit=50.0)
    inputs = draw(controller, points, seed=11)
    parity = compare(controller.run(*inputs), runner_of(path, controller)(*inputs), 1e-12)
    assert parity.passed, parity


@pytest.mark.parametrize("name", QUICK)
def test_program_equals_the_model_within_and_beyond_the_range(name: str, tmp_path: Path) -> None:
    check_parity(MODELS[name], tmp_path / "m.pt2", 5000 if not MODELS[name].state_size else 200)


@pytest.mark.slow
@pytest.mark.parametrize("name", MODELS)
def test_parity_over_very_many_points(name: str, tmp_path: Path) -> None:
    points = 200_000 if not MODELS[name].state_size else 5000
    check_parity(MODELS[name], tmp_path / "m.pt2", points)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["LFM", "ALFM", "NFLFM"])
def test_filter_initialises_itself(name: str, tmp_path: Path) -> None:
    # Compared with the model when it is written.
    assert pt2(MODELS[name], tmp_path / "m.pt2", INFO, with_filter=True).is_file()


def test_user_defined_schedule_is_clamped_in_the_artefact(tmp_path: Path) -> None:
    check_parity(rising(), tmp_path / "m.pt2", 1000)


@pytest.mark.parametrize("batch", [1, 2, 7, 100])
def test_any_batch_size_is_accepted(written: Path, batch: int) -> None:
    inputs = motion(batch, 3)
    files = {METADATA: ""}
    found = torch.export.load(written, extra_files=files).module()(*inputs)
    torch.testing.assert_close(found[0], MODELS["LFM"](*inputs).detach())
    assert files[METADATA].startswith("{")


def test_file_is_replaced_atomically(written: Path) -> None:
    assert list(written.parent.iterdir()) == [written]


def test_export_is_silent(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING):
        pt2(MODELS["NCFM"], tmp_path / "m.pt2", INFO)
    assert not caplog.records

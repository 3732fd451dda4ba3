"""torch.export programs: equal to the model at any batch, and no way in for foreign objects."""

import io
import zipfile
from pathlib import Path

import pytest
import torch

from nfriction.export import ExportError, pt2
from nfriction.export.contract import ContractError, compare, draw, verify
from nfriction.export.controller import controller_of
from nfriction.export.torch_archive import METADATA
from nfriction.export.torch_files import open_pt2
from nfriction.friction.models import FrictionModel
from tests.export.artefacts import INFO, rising
from tests.friction.samples import motion, named_models

MODELS = named_models()
# Each schedule once; the others only among the slow tests, as an export takes seconds.
QUICK = ["NLFM", "ALFM", "NFLFM"]


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return pt2(MODELS["LFM"], tmp_path_factory.mktemp("pt2") / "model.pt2", INFO)


def check_parity(model: FrictionModel, path: Path, points: int) -> None:
    contract, run = open_pt2(pt2(model, path, INFO, torque_limit=50.0))
    controller = controller_of(model, INFO, torque_limit=50.0)
    inputs = draw(controller, points, seed=11)
    parity = compare(controller.run(*inputs), run(*inputs), 1e-12)
    assert parity.passed, parity
    assert verify(run, contract).passed


@pytest.mark.parametrize("name", QUICK)
def test_it_equals_the_model_to_beyond_the_range(name: str, tmp_path: Path) -> None:
    check_parity(MODELS[name], tmp_path / "m.pt2", 5000 if not MODELS[name].state_size else 200)


@pytest.mark.slow
@pytest.mark.parametrize("name", MODELS)
def test_parity_over_very_many_points(name: str, tmp_path: Path) -> None:
    points = 200_000 if not MODELS[name].state_size else 5000
    check_parity(MODELS[name], tmp_path / "m.pt2", points)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["LFM", "ALFM", "NFLFM"])
def test_the_filter_starts_by_itself(name: str, tmp_path: Path) -> None:
    contract, run = open_pt2(pt2(MODELS[name], tmp_path / "m.pt2", INFO, with_filter=True))
    assert verify(run, contract).passed


def test_a_schedule_of_ones_own_is_clamped_in_the_artefact(tmp_path: Path) -> None:
    check_parity(rising(), tmp_path / "m.pt2", 1000)


@pytest.mark.parametrize("batch", [1, 2, 7, 100])
def test_any_batch(written: Path, batch: int) -> None:
    inputs = motion(batch, 3)
    files = {METADATA: ""}
    found = torch.export.load(written, extra_files=files).module()(*inputs)
    torch.testing.assert_close(found[0], MODELS["LFM"](*inputs).detach())
    assert files[METADATA].startswith("{")


def test_it_replaces_the_file_whole_and_leaves_nothing_else(written: Path) -> None:
    assert list(written.parent.iterdir()) == [written]


def rewritten(source: Path, target: Path, changes: dict[str, bytes | None]) -> Path:
    """An archive with files of it replaced, added or (None) left out."""
    with zipfile.ZipFile(source) as archive:
        root = archive.namelist()[0].partition("/")[0]
        files = {name: archive.read(name) for name in archive.namelist()}
    files |= {f"{root}/{name}": content for name, content in changes.items()}  # type: ignore
    with zipfile.ZipFile(target, "w") as archive:
        for name, content in files.items():
            if content is not None:
                archive.writestr(name, content)
    return target


def test_hostile_archives_are_refused(written: Path, tmp_path: Path) -> None:
    bad = tmp_path / "bad.pt2"
    for content in (b"", b"junk", written.read_bytes()[:1000]):
        bad.write_bytes(content)
        with pytest.raises(ExportError, match="no program"):
            open_pt2(bad)
    foreign = {"data/constants/opaque_obj_0": b"x", "data/aotinductor/a.so": b"x"}
    for name, content in foreign.items():
        with pytest.raises(ExportError, match="not ours"):
            open_pt2(rewritten(written, bad, {name: content}))
    pickled = b'{"config": {"a": {"path_name": "weight_0", "use_pickle": true}}}'
    config = "data/weights/model_weights_config.json"
    with pytest.raises(ExportError, match="pickled"):
        open_pt2(rewritten(written, bad, {config: pickled}))
    with pytest.raises(ExportError, match="damaged"):
        open_pt2(rewritten(written, bad, {config: b"[]"}))
    inputs = io.BytesIO()
    torch.save(torch.zeros(2), inputs)
    with pytest.raises(ExportError, match="pickled inputs"):
        open_pt2(rewritten(written, bad, {"data/sample_inputs/model.pt": inputs.getvalue()}))
    with pytest.raises(ContractError):
        open_pt2(rewritten(written, bad, {f"extra/{METADATA}": b"{}"}))

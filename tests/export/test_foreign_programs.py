"""Untrusted programs are never run: torch runs our own program with the file's numbers, or none."""

import json
import warnings
import zipfile
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from nfriction.export import ContractError, ExportError, pt2, torchscript, verify_artefact
from nfriction.export.torch_files import METADATA, contract_of_archive, own_program
from nfriction.friction.models import LFM, NLFM
from tests.export.artefacts import INFO

MODEL = LFM(3, [1e-3, 2e-3])
ATTACK = "__import__('pathlib').Path('attacked').touch()"
IMPORT = '[1, {"type": "builtins.tuple", "context": {"__enum__": 1, "fqn": "antigravity:x"}}]'
KINDS = {".pt": torchscript, ".pt2": pt2}


@pytest.fixture(scope="module")
def artefacts(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """A valid artefact of each kind."""
    folder = tmp_path_factory.mktemp("artefacts")
    return {kind: write(MODEL, folder / f"model{kind}", INFO) for kind, write in KINDS.items()}


def files_of(path: Path) -> dict[str, bytes]:
    """Files of an archive by their name in its folder."""
    with zipfile.ZipFile(path) as archive:
        return {n.partition("/")[2]: archive.read(n) for n in archive.namelist()}


def packed(path: Path, files: dict[str, bytes]) -> Path:
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in files.items():
            archive.writestr(f"archive/{name}", content)
    return path


def changed(value: Any, key: str, to: Any) -> Any:
    """Nested JSON with every value of a key replaced."""
    if isinstance(value, dict):
        return {k: to if k == key else changed(v, key, to) for k, v in value.items()}
    return [changed(v, key, to) for v in value] if isinstance(value, list) else value


def refuse(path: Path, sound: Path) -> None:
    """Assert that the file is refused with the reason, before torch reads anything of it."""
    contract_of_archive(path)
    with pytest.raises(ExportError, match=rf"{path.name}: its program is not the one"):
        own_program(path, sound.read_bytes())


def refuse_to_run(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that verification refuses the file without having run any of it."""
    monkeypatch.chdir(path.parent)
    with pytest.raises(ExportError, match=rf"{path.name}: its program is not the one"):
        verify_artefact(path, MODEL, INFO, points=50)
    assert [x.name for x in path.parent.iterdir()] == [path.name]


@pytest.mark.parametrize("kind", KINDS)
def test_valid_artefact_passes_and_changed_numbers_are_detected(
    kind: str, artefacts: dict[str, Path], tmp_path: Path
) -> None:
    assert verify_artefact(artefacts[kind], MODEL, INFO, points=50).passed
    files = files_of(artefacts[kind])
    # The raw parameters, or B and C of three joints.
    names = [n for n, x in files.items() if "constants/" in n or "weights/weight" in n]
    name = next(n for n in names if len(files[n]) == 3 * 2 * 8)
    values = torch.frombuffer(bytearray(files[name]), dtype=torch.float64)
    files[name] = (values * 1.001).numpy().tobytes()
    verdict = verify_artefact(packed(tmp_path / f"m{kind}", files), MODEL, INFO, points=50)
    assert not verdict.vectors.passed
    assert 1e-4 < verdict.points.torque_error < 1e-1


@pytest.mark.parametrize("kind", KINDS)
def test_metadata_cannot_loosen_the_tolerance(
    kind: str, artefacts: dict[str, Path], tmp_path: Path
) -> None:
    files = files_of(artefacts[kind])
    metadata = json.loads(files[f"extra/{METADATA}"]) | {"dtype": "float32"}
    files[f"extra/{METADATA}"] = json.dumps(metadata).encode()
    with pytest.raises(ContractError, match="state float32, but the program computes in float64"):
        verify_artefact(packed(tmp_path / f"m{kind}", files), MODEL, INFO, points=50)


def test_an_artefact_of_another_law_is_named(artefacts: dict[str, Path]) -> None:
    with pytest.raises(
        ExportError, match=r"pt belongs to another model: model LFM instead of NLFM\."
    ):
        verify_artefact(artefacts[".pt"], NLFM(3), INFO)


def test_programs_do_not_depend_on_earlier_exports(tmp_path: Path) -> None:
    """torch numbers the classes that it scripts, and their names are in the file."""
    first, second = (torchscript(MODEL, tmp_path / f"{k}.pt", INFO) for k in "ab")
    assert files_of(first).keys() != files_of(second).keys()
    for path in (first, second):
        assert verify_artefact(path, MODEL, INFO, points=50).passed


@pytest.mark.parametrize(
    ("key", "to"),
    [
        ("expr_str", ATTACK),
        ("guards_code", [f"L['qd'].size()[0] == 1 and {ATTACK}"]),
        ("target", "torch.ops.aten.from_file.default"),
        ("in_spec", IMPORT),
        ("metadata", {"source_fn_stack": f"x,{ATTACK}"}),
    ],
)
def test_a_program_that_torch_would_run_as_python_is_refused(
    artefacts: dict[str, Path], key: str, to: Any, tmp_path: Path
) -> None:
    files = files_of(artefacts[".pt2"])
    document = json.loads(files["models/model.json"])
    evil = changed(document, key, to)
    assert evil != document
    files["models/model.json"] = json.dumps(evil).encode()
    refuse(packed(tmp_path / "bad.pt2", files), artefacts[".pt2"])


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("data/aotinductor/a.so", b"x"),
        ("data/weights/model_weights_config.json", b'{"config": {"a": {"use_pickle": true}}}'),
        ("data/sample_inputs/model.pt", b"pickled"),
        ("data/weights/weight_0", bytes(64 * 8)),
    ],
)
def test_files_that_are_not_ours_are_refused(
    artefacts: dict[str, Path], name: str, content: bytes, tmp_path: Path
) -> None:
    files = files_of(artefacts[".pt2"]) | {name: content}
    refuse(packed(tmp_path / "bad.pt2", files), artefacts[".pt2"])


@pytest.mark.parametrize("kind", KINDS)
def test_files_that_are_no_artefacts_are_refused(
    kind: str, artefacts: dict[str, Path], tmp_path: Path
) -> None:
    bad = tmp_path / f"bad{kind}"
    for content in (b"", b"junk", artefacts[kind].read_bytes()[:1000]):
        bad.write_bytes(content)
        with pytest.raises(ExportError, match=rf"bad{kind} is no artefact of nfriction"):
            verify_artefact(bad, MODEL, INFO)
    files = files_of(artefacts[kind])
    with zipfile.ZipFile(packed(bad, files), "a") as archive:
        archive.writestr(f"archive/{[*files][-1].upper()}", b"other")
    with pytest.raises(ExportError, match=rf"bad{kind} contains .* twice"):
        verify_artefact(bad, MODEL, INFO)
    packed(bad, files | {f"extra/{METADATA}": b"{}"})
    with pytest.raises(ContractError):
        verify_artefact(bad, MODEL, INFO)


@pytest.mark.parametrize("kind", KINDS)
def test_artefacts_do_not_reveal_the_machine_that_wrote_them(
    kind: str, artefacts: dict[str, Path]
) -> None:
    content = b"".join(x for n, x in files_of(artefacts[kind]).items() if "debug_pkl" not in n)
    assert str(Path(__file__).parents[2]).encode() not in content


class Saving(nn.Module):
    def forward(self, qd: Tensor, qdd: Tensor, load: Tensor) -> Tensor:
        return qd

    @torch.jit.export
    def step(self, qd: Tensor, qdd: Tensor, load: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        torch.save(qd, "attacked")
        return qd, qdd, load


class Waking(Saving):
    """A program that runs while it is loaded."""

    @torch.jit.export
    def __getstate__(self) -> int:
        return 0

    @torch.jit.export
    def __setstate__(self, state: int) -> None:
        self.training = False


@pytest.mark.parametrize("kind", [Saving, Waking])
def test_script_with_more_than_arithmetic_is_refused(
    kind: type[nn.Module],
    artefacts: dict[str, Path],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    metadata = {METADATA: files_of(artefacts[".pt"])[f"extra/{METADATA}"]}
    path = tmp_path / "bad.pt"
    with warnings.catch_warnings():  # newer versions of torch deprecate it
        warnings.simplefilter("ignore")
        torch.jit.save(torch.jit.script(kind()), str(path), _extra_files=metadata)
    refuse_to_run(path, monkeypatch)


def test_script_that_runs_while_it_is_loaded_is_refused(
    artefacts: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    evil = b'load: Tensor, x: Tensor=torch.from_file("attacked", True, 8))'
    files = {n: x.replace(b"load: Tensor)", evil) for n, x in files_of(artefacts[".pt"]).items()}
    assert any(evil in x for x in files.values())
    refuse_to_run(packed(tmp_path / "bad.pt", files), monkeypatch)

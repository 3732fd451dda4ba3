"""Programs of torch from strangers are arithmetic of tensors, or are refused before they run."""

import json
import warnings
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from nfriction.export import ExportError, pt2, torchscript, verification, verify_artefact
from nfriction.export.contract import draw
from nfriction.export.controller import controller_of
from nfriction.export.torch_archive import METADATA, check_program, check_source
from nfriction.export.torch_files import open_pt2, open_torchscript
from nfriction.friction.models import LFM
from tests.export.artefacts import INFO
from tests.export.test_pt2 import rewritten

MODEL = LFM(3, [1e-3, 2e-3])
ATTACK = "__import__('pathlib').Path('attacked').touch()"
IMPORT = '[1, {"type": "builtins.tuple", "context": {"__enum__": 1, "fqn": "antigravity:x"}}]'


@pytest.fixture(scope="module")
def program(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return pt2(MODEL, tmp_path_factory.mktemp("pt2") / "model.pt2", INFO)


def changed(value: Any, key: str, to: Any) -> Any:
    """Nested JSON with every value of a key replaced."""
    if isinstance(value, dict):
        return {k: to if k == key else changed(v, key, to) for k, v in value.items()}
    return [changed(v, key, to) for v in value] if isinstance(value, list) else value


@pytest.mark.parametrize(
    ("key", "to"),
    [
        ("expr_str", ATTACK),
        ("expr_str", "Integer(9)**Integer(9)**Integer(9)"),
        ("guards_code", [ATTACK]),
        ("guards_code", [f"L['qd'].size()[0] == 1 and {ATTACK}"]),
        ("target", "torch.hub.load"),
        ("target", "torch.ops.aten.from_file.default"),
        ("target", "math.factorial"),
        ("target", "torch.ops.aten.add.__init__"),
        ("target", "torch.ops.aten.add.op"),
        ("in_spec", IMPORT),
        ("out_spec", IMPORT),
        ("name", f"x, y={ATTACK}"),
        ("metadata", {"source_fn_stack": f"x,{ATTACK}"}),
        ("arg", {"as_custom_obj": {"name": "x", "class_fqn": "y"}}),
        ("dtype", {f"os.system({ATTACK})": 1}),
    ],
)
def test_a_program_that_torch_would_run_as_python_is_refused(
    program: Path, key: str, to: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with zipfile.ZipFile(program) as archive:
        name = next(n for n in archive.namelist() if n.endswith("models/model.json"))
        document = json.loads(archive.read(name))
    check_program(document)
    evil = changed(document, key, to)
    assert evil != document
    bad = rewritten(program, tmp_path / "bad.pt2", {"models/model.json": json.dumps(evil).encode()})
    with pytest.raises(ExportError, match=r"bad\.pt2: it holds .* no part of a controller"):
        open_pt2(bad)
    assert [x.name for x in tmp_path.iterdir()] == ["bad.pt2"]


def test_artefacts_say_nothing_of_the_machine_that_wrote_them(program: Path) -> None:
    with zipfile.ZipFile(program) as archive:
        told = b"".join(archive.read(name) for name in archive.namelist())
    assert str(Path(__file__).parents[2]).encode() not in told


def test_files_of_the_same_name_are_refused(program: Path, tmp_path: Path) -> None:
    bad = rewritten(program, tmp_path / "bad.pt2", {})
    with zipfile.ZipFile(bad, "a") as archive, pytest.warns(UserWarning, match="Duplicate"):
        archive.writestr(zipfile.ZipFile(program).namelist()[0], b"other")
    with pytest.raises(ExportError, match="not ours"):
        open_pt2(bad)


class Saving(nn.Module):
    def forward(self, qd: Tensor, qdd: Tensor, load: Tensor) -> Tensor:
        return qd

    @torch.jit.export
    def step(self, qd: Tensor, qdd: Tensor, load: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        torch.save(qd, "attacked")
        return qd, qdd, load


class Reading(Saving):
    @torch.jit.export
    def step(self, qd: Tensor, qdd: Tensor, load: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        if qd.numel() > 0:
            qd = torch.from_file("/etc/passwd", False, 8)
        return qd, qdd, load


class Endless(Saving):
    @torch.jit.export
    def step(self, qd: Tensor, qdd: Tensor, load: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        while qd.numel() >= 0:
            qd = qd.neg()
        return qd, qdd, load


class Swollen(Saving):
    @torch.jit.export
    def step(self, qd: Tensor, qdd: Tensor, load: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        large = torch.zeros([1], dtype=torch.float64).expand(100_000_000_000)
        return large, large, large


class Waking(Saving):
    """Runs as it is loaded."""

    @torch.jit.export
    def __getstate__(self) -> int:
        return 0

    @torch.jit.export
    def __setstate__(self, state: int) -> None:
        self.training = False


def scripted(module: nn.Module, path: Path) -> Path:
    """With the metadata of a sound artefact."""
    with zipfile.ZipFile(torchscript(MODEL, path, INFO)) as archive:
        metadata = archive.read(f"{archive.namelist()[0].partition('/')[0]}/extra/{METADATA}")
    with warnings.catch_warnings():  # newer versions of torch deprecate it
        warnings.simplefilter("ignore")
        torch.jit.save(torch.jit.script(module), str(path), _extra_files={METADATA: metadata})
    return path


@pytest.mark.parametrize(
    ("kind", "said"), [(Saving, "save"), (Reading, "from_file"), (Waking, "__setstate__")]
)
def test_a_script_that_does_more_than_arithmetic_is_refused(
    kind: type[nn.Module], said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    path = scripted(kind(), tmp_path / "bad.pt")
    with pytest.raises(ExportError, match=rf"bad\.pt.*{said}"):
        open_torchscript(path)
    assert [x.name for x in tmp_path.iterdir()] == ["bad.pt"]


@pytest.mark.parametrize(
    ("before", "after"),
    [
        ("load: Tensor)", "load: Tensor, x: Tensor=torch.{})"),
        ("load: Tensor)", "load: Tensor, x: Tensor=torch . {})"),
        ("load: Tensor)", "load: Tensor, x: Tensor=torch.# more\n    {})"),
        ("load: Tensor)", "load: Tensor, x: Tensor=ops.aten.{})"),
        ("load: Tensor)", "load: Tensor, x: Tensor=getattr(torch, 'from_' 'file')('a', True, 8))"),
        ("  def forward", "  k : Final[Tensor] = torch.{}\n  def forward"),
    ],
)
def test_a_script_that_runs_as_it_is_loaded_is_refused(
    before: str, after: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    sound, bad = torchscript(MODEL, tmp_path / "good.pt", INFO), tmp_path / "bad.pt"
    evil = after.format('from_file("attacked", True, 8)')
    with zipfile.ZipFile(sound) as archive, zipfile.ZipFile(bad, "w") as written:
        for name in archive.namelist():
            text = archive.read(name)
            if name.endswith(".py"):
                text = text.replace(before.encode(), evil.encode())
                assert evil.encode() in text
            if not name.endswith("debug_pkl"):
                written.writestr(name, text)
    with pytest.raises(ExportError, match=r"bad\.pt: it holds .* no part of a controller"):
        open_torchscript(bad)
    assert sorted(x.name for x in tmp_path.iterdir()) == ["bad.pt", "good.pt"]


def test_objects_of_torchs_own_classes_are_refused() -> None:
    state = b"\x80\x02c__torch__.torch.classes.quantized\nLinearPackedParamsBase\n"
    with pytest.raises(ExportError, match="'classes'"):
        check_source("data.pkl", state)


def test_numbers_without_an_end_are_refused_at_once(program: Path, tmp_path: Path) -> None:
    with zipfile.ZipFile(program) as archive:
        name = next(n for n in archive.namelist() if n.endswith("models/model.json"))
        evil = changed(json.loads(archive.read(name)), "in_spec", 100 * "1" + "x")
    bad = rewritten(program, tmp_path / "bad.pt2", {"models/model.json": json.dumps(evil).encode()})
    with pytest.raises(ExportError, match="no part of a controller"):
        open_pt2(bad)


def test_views_of_memory_beyond_a_tensor_are_refused() -> None:
    with pytest.raises(ExportError, match="_reshape_alias"):
        check_program({"target": "torch.ops.aten._reshape_alias.default"})


def test_a_script_without_an_end_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(verification, "STARTING", 3.0)
    monkeypatch.setattr(verification, "BY_SAMPLE", 0.0)
    with pytest.raises(ExportError, match="does not come to an end"):
        verify_artefact(scripted(Endless(), tmp_path / "bad.pt"), MODEL, INFO)


def test_outputs_that_would_fill_the_disk_are_refused(tmp_path: Path) -> None:
    path = scripted(Swollen(), tmp_path / "bad.pt")
    inputs = draw(controller_of(MODEL, INFO), 50)
    np.savez(tmp_path / "inputs.npz", **{f"0_{i}": x.numpy() for i, x in enumerate(inputs)})
    with pytest.raises(ExportError, match="too large"):
        verification.work({"path": str(path), "batches": [len(inputs)]}, tmp_path)
    assert not (tmp_path / "outputs.npz").exists()


def test_what_verification_refuses_is_told_across_the_process(tmp_path: Path) -> None:
    with pytest.raises(ExportError, match="'save'"):
        verify_artefact(scripted(Saving(), tmp_path / "bad.pt"), MODEL, INFO)

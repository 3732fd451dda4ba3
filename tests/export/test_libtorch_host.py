"""The C++ example builds with the wheel's LibTorch, verifies artefacts, rejects altered ones."""

import shutil
import subprocess
import zipfile
from pathlib import Path

import pytest
import torch

from nfriction.export import torchscript
from nfriction.export.torch_files import METADATA
from tests.export.artefacts import INFO
from tests.friction.samples import named_models

SOURCE = Path(__file__).resolve().parents[2] / "examples" / "libtorch_host"

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(
        not (shutil.which("cmake") and shutil.which("g++")), reason="needs cmake and g++"
    ),
]


@pytest.fixture(scope="module")
def host(tmp_path_factory: pytest.TempPathFactory) -> Path:
    build = tmp_path_factory.mktemp("build")
    prefix = f"-DCMAKE_PREFIX_PATH={torch.utils.cmake_prefix_path}"
    for command in (["cmake", "-S", SOURCE, "-B", build, prefix], ["cmake", "--build", build]):
        run = subprocess.run(command, capture_output=True, text=True, check=False)
        assert run.returncode == 0, run.stdout + run.stderr
    return build / "libtorch_host"


def run(host: Path, path: Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run([host, path, "200"], capture_output=True, text=True, check=False)


@pytest.mark.parametrize("name", ["LFM", "Stribeck", "ALFM", "NFNLFM"])
@pytest.mark.parametrize("with_filter", [False, True])
def test_host_verifies_an_artefact(
    host: Path, name: str, with_filter: bool, tmp_path: Path
) -> None:
    path = torchscript(named_models()[name], tmp_path / "m.pt", INFO, with_filter=with_filter)
    found = run(host, path)
    assert found.returncode == 0, found.stdout + found.stderr
    assert f"{name} of 3 joints" in found.stdout
    assert "p99" in found.stdout


def test_host_detects_altered_artefacts(host: Path, tmp_path: Path) -> None:
    good = torchscript(named_models()["LFM"], tmp_path / "good.pt", INFO)
    bad = tmp_path / "bad.pt"
    with zipfile.ZipFile(good) as archive, zipfile.ZipFile(bad, "w") as other:
        for entry in archive.namelist():
            content = archive.read(entry)
            if entry.endswith(METADATA):
                content = content.replace(b'"status": [[0', b'"status": [[1')
                content = content.replace(b'"status": [[1, 0', b'"status": [[0, 1')
            other.writestr(entry, content)
    assert run(host, bad).returncode == 1
    bad.write_bytes(good.read_bytes()[:500])
    assert run(host, bad).returncode == 2

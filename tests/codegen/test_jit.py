"""Machine code needs no C compiler; its cache is safe, private and reused."""

import errno
import logging
import multiprocessing
import os
import stat
import subprocess
import sys
from collections import OrderedDict

import numpy as np
import pytest
import torch

from nfriction.codegen import jit
from nfriction.export.c_file import find_compiler
from nfriction.simulation import compiled

F64 = torch.float64
SOURCE = """
define void @answer(i64 %a, i64 %b, ptr %x, ptr %y, ptr %z) { store i64 42, ptr %x ret void }
"""


@pytest.fixture
def cache(tmp_path, monkeypatch):
    folder = tmp_path / "cache"
    monkeypatch.setenv("NFRICTION_CACHE", str(folder))
    return folder


def answer():
    x = np.zeros(1, dtype=np.int64)
    jit.build(SOURCE, "answer")(0, 0, x.ctypes.data, 0, 0)
    return int(x[0])


def objects(folder):
    return sorted(p.name for p in folder.iterdir() if p.suffix == ".object")


def test_code_is_compiled_once_and_reused(cache, monkeypatch):
    assert answer() == 42
    made = objects(cache)
    assert len(made) == 1

    def forbidden(*_):
        raise AssertionError("compiled again")

    monkeypatch.setattr(jit, "_compile", forbidden)
    assert answer() == 42
    assert objects(cache) == made
    assert not list(cache.glob("building-*"))


@pytest.mark.parametrize("content", [b"", b"not code", None])
def test_damaged_code_is_recompiled(cache, content):
    answer()
    (name,) = objects(cache)
    whole = (cache / name).read_bytes()
    (cache / name).write_bytes(whole[:-1] if content is None else content)
    assert answer() == 42
    assert (cache / name).read_bytes() == whole


@pytest.mark.parametrize("changed", ["processor", "version"])
def test_code_of_another_machine_or_version_is_not_used(cache, monkeypatch, changed):
    answer()
    _, features = jit._processor()
    with monkeypatch.context() as patch:
        if changed == "processor":
            patch.setattr(jit, "_processor", lambda: ("some-cpu", features))
        else:
            patch.setattr("llvmlite.__version__", "0.0")
        patch.setattr(jit, "_compile", lambda source: (_ for _ in ()).throw(InterruptedError))
        with pytest.raises(InterruptedError):
            answer()


@pytest.mark.skipif(os.name != "posix", reason="permissions of POSIX")
def test_the_cache_folder_is_private(cache):
    answer()
    assert stat.S_IMODE(cache.stat().st_mode) == 0o700
    cache.chmod(0o777)
    with pytest.raises(PermissionError, match="chmod 700"):
        jit.cache_folder()


@pytest.mark.skipif(os.name != "posix", reason="owners of POSIX")
def test_cache_folder_of_another_user_is_refused(cache, monkeypatch):
    jit.cache_folder()
    monkeypatch.setattr(jit.os, "getuid", lambda: cache.stat().st_uid + 1)
    with pytest.raises(PermissionError, match="belong to you"):
        jit.cache_folder()


@pytest.mark.parametrize("obstacle", ["open to others", "a file", "full", "read-only"])
def test_without_a_usable_cache_code_is_compiled_in_memory(cache, monkeypatch, caplog, obstacle):
    if obstacle == "a file":
        cache.write_text("")
    elif obstacle == "open to others":
        cache.mkdir()
        cache.chmod(0o777)
    elif obstacle == "read-only":
        cache.mkdir(mode=0o700)

        def refuse(*_, **__):
            raise OSError(errno.EROFS, "Read-only file system", "building-0")

        monkeypatch.setattr(jit.tempfile, "mkstemp", refuse)
    else:
        cache.mkdir(mode=0o700)

        def full(*_):
            raise OSError("no space left on device")

        monkeypatch.setattr(jit.os, "replace", full)
    with caplog.at_level(logging.WARNING, "nfriction"):
        assert answer() == 42
        assert answer() == 42
    assert caplog.text.count("not kept") == 1
    assert "set NFRICTION_CACHE to a folder that you can write to" in caplog.text
    assert str(cache) in caplog.text
    if cache.is_dir():
        assert not list(cache.iterdir())


def test_without_the_override_the_platforms_cache_is_used(tmp_path, monkeypatch):
    monkeypatch.delenv("NFRICTION_CACHE")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setenv("LOCALAPPDATA", str(tmp_path))
    monkeypatch.setenv("HOME", str(tmp_path))
    folder = jit.cache_folder()
    assert folder.name == "nfriction"
    assert tmp_path in folder.parents


def test_without_a_home_code_is_compiled_in_memory(monkeypatch, caplog):
    def homeless():
        raise RuntimeError("Could not determine home directory.")

    for name in ("NFRICTION_CACHE", "XDG_CACHE_HOME"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(jit.sys, "platform", "linux")
    monkeypatch.setattr(jit.Path, "home", homeless)
    jit._warn_not_kept.cache_clear()
    assert answer() == 42
    assert "NFRICTION_CACHE" in caplog.text


def _build(folder, barrier, queue):
    os.environ["NFRICTION_CACHE"] = folder
    barrier.wait()
    queue.put(answer())


@pytest.mark.skipif(not hasattr(os, "fork"), reason="processes that import nothing anew")
def test_two_processes_may_build_at_once(cache):
    context = multiprocessing.get_context("fork")
    barrier, queue = context.Barrier(2), context.Queue()
    args = (str(cache), barrier, queue)
    workers = [context.Process(target=_build, args=args) for _ in range(2)]
    for worker in workers:
        worker.start()
    assert [queue.get(timeout=60) for _ in workers] == [42, 42]
    for worker in workers:
        worker.join()
    assert all(worker.exitcode == 0 for worker in workers)
    assert not list(cache.glob("building-*"))


SWINGS = """
import torch
from nfriction import LFM, NFLFM, PendulumChain, rollout
def ends():
    plant, rest = PendulumChain([0.3, 0.2], [0.2, 0.15]), torch.zeros(2, dtype=torch.float64)
    models = LFM(2, v_smooth=0.1), NFLFM(2, v_smooth=0.1, terms=(2, 2), head_units=2)
    given = {"steps": 50, "substeps": 20, "backend": "compiled", "gradients": False}
    return [rollout(plant, model, rest + 2.0, rest, **given).q[-1].tolist() for model in models]
"""


def test_neither_a_compiler_nor_numba_is_needed(cache, tmp_path, monkeypatch):
    """A fresh process with an empty PATH and no numba compiles; a second one reuses its code."""
    script = f"import sys; sys.modules['numba'] = None\n{SWINGS}\nprint(ends())"
    environment = dict(os.environ, PATH=str(tmp_path)) | {"CC": ""}
    run = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=True, env=environment
    )
    for known in ("_known", "_compiled_graphs"):
        monkeypatch.setattr(compiled, known, OrderedDict())
    monkeypatch.setattr(jit, "_compile", lambda source: pytest.fail("compiled again"))
    names: dict = {}
    exec(SWINGS, names)
    assert str(names["ends"]()) == run.stdout.strip()


def test_importing_codegen_and_tracing_stay_light():
    """Neither torch._dynamo, torch.distributed nor LLVM is loaded before it is needed."""
    script = (
        "import sys, torch; before = set(sys.modules)\n"
        "from nfriction.codegen.graph import FunctionalModule, Method\n"
        "m = torch.nn.Linear(2, 2).double()\n"
        "FunctionalModule(Method(m)).trace({'x': torch.ones(2, dtype=torch.float64)})\n"
        "new = {n for n in set(sys.modules) - before}\n"
        "heavy = ('torch._dynamo', 'torch.distributed.tensor', 'llvmlite')\n"
        "print([n for n in heavy if n in new])"
    )
    run = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert run.stdout.strip() == "[]"


@pytest.mark.skipif(find_compiler() is None, reason="no C compiler")
def test_cc_names_the_compiler_and_its_arguments(monkeypatch):
    compiler = find_compiler()
    monkeypatch.setenv("CC", f"{compiler[0]} -DX=1")
    assert find_compiler() == [compiler[0], "-DX=1"]
    monkeypatch.setenv("CC", "no-such-compiler")
    assert find_compiler() is None

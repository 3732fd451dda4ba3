"""Compilers come and go; the cache is safe, private and reused."""

import multiprocessing
import os
import stat
import subprocess
import sys

import pytest
import torch

from nfriction.codegen import (
    CompilerError,
    NoBackend,
    build,
    compile_function,
    compile_rollout,
)
from tests.codegen.mechanisms import F64, Coulomb, Pendulum

SOURCE = "int answer(void) { return 42; }\n"


@pytest.fixture
def cache(tmp_path, monkeypatch):
    folder = tmp_path / "cache"
    monkeypatch.setenv("NFRICTION_CACHE", str(folder))
    return folder


@pytest.fixture
def no_compiler(tmp_path, monkeypatch):
    monkeypatch.delenv("CC", raising=False)
    monkeypatch.setenv("PATH", str(tmp_path))


@pytest.fixture
def no_numba(monkeypatch):
    found = build.importlib.util.find_spec
    monkeypatch.setattr(
        build.importlib.util, "find_spec", lambda n, *a: None if n == "numba" else found(n, *a)
    )


def libraries(folder):
    return sorted(p.name for p in folder.iterdir() if p.suffix in (".so", ".dylib", ".dll"))


def test_an_artefact_is_built_once_and_reused(cache, monkeypatch):
    assert build.build_c(SOURCE).answer() == 42
    built = libraries(cache)

    def forbidden(*_):
        raise AssertionError("compiled again")

    monkeypatch.setattr(build, "_compile", forbidden)
    assert build.build_c(SOURCE).answer() == 42
    assert libraries(cache) == built
    assert not list(cache.glob("building-*"))


def test_a_damaged_artefact_is_built_anew(cache):
    build.build_c(SOURCE)
    (name,) = libraries(cache)
    (cache / name).unlink()
    (cache / name).write_bytes(b"not a library")
    assert build.build_c(SOURCE).answer() == 42


@pytest.mark.skipif(os.name != "posix", reason="permissions of POSIX")
def test_the_cache_folder_is_private(cache):
    build.build_c(SOURCE)
    assert stat.S_IMODE(cache.stat().st_mode) == 0o700
    cache.chmod(0o777)
    with pytest.raises(PermissionError, match="chmod 700"):
        build.cache_folder()


@pytest.mark.skipif(os.name != "posix", reason="owners of POSIX")
def test_a_cache_folder_of_somebody_else_is_refused(cache, monkeypatch):
    build.cache_folder()
    monkeypatch.setattr(build.os, "getuid", lambda: cache.stat().st_uid + 1)
    with pytest.raises(PermissionError, match="belong to you"):
        build.cache_folder()


def test_without_the_override_the_platforms_cache_serves(tmp_path, monkeypatch):
    monkeypatch.delenv("NFRICTION_CACHE")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setenv("LOCALAPPDATA", str(tmp_path))
    monkeypatch.setenv("HOME", str(tmp_path))
    folder = build.cache_folder()
    assert folder.name == "nfriction"
    assert tmp_path in folder.parents


def _build(folder, source, barrier, queue):
    os.environ["NFRICTION_CACHE"] = folder
    barrier.wait()
    queue.put(build.build_c(source).answer())


def test_two_processes_may_build_at_once(cache):
    context = multiprocessing.get_context("fork" if sys.platform == "linux" else "spawn")
    barrier, queue = context.Barrier(2), context.Queue()
    args = (str(cache), SOURCE, barrier, queue)
    workers = [context.Process(target=_build, args=args) for _ in range(2)]
    for worker in workers:
        worker.start()
    assert [queue.get(timeout=60) for _ in workers] == [42, 42]
    for worker in workers:
        worker.join()
    assert all(worker.exitcode == 0 for worker in workers)
    assert not list(cache.glob("building-*"))


def test_the_compilers_message_is_passed_on(cache):
    with pytest.raises(CompilerError, match="nonsense"):
        build.build_c("nonsense here;\n")


def test_cc_names_the_compiler_and_its_arguments(monkeypatch):
    compiler = build.find_compiler()
    monkeypatch.setenv("CC", f"{compiler[0]} -DX=1")
    assert build.find_compiler() == [compiler[0], "-DX=1"]
    monkeypatch.setenv("CC", "no-such-compiler")
    assert build.find_compiler() is None


@pytest.mark.usefixtures("no_compiler")
def test_without_a_compiler_numba_serves():
    compiled = compile_rollout(Pendulum(1), Coulomb(1))
    assert compiled.backend == "numba"
    out = compiled([[1.0]], [[0.0]], steps=3, time_step=1e-3)
    assert out.diverged_step.tolist() == [-1]
    with pytest.raises(NoBackend, match="No C compiler"):
        build.choose("c")


@pytest.mark.usefixtures("no_compiler", "no_numba")
def test_without_numba_too_the_error_says_what_to_install():
    with pytest.raises(NoBackend, match=r"nfriction\[numba\].*backend=\"torch\""):
        compile_rollout(Pendulum(1), Coulomb(1))


@pytest.mark.usefixtures("no_numba")
def test_numba_asked_for_but_missing():
    with pytest.raises(NoBackend, match="numba was not found"):
        compile_function(torch.sin, [torch.ones(1, dtype=F64)], backend="numba")


def test_an_unknown_backend_is_refused():
    with pytest.raises(ValueError, match='"auto", "c" or "numba"'):
        build.choose("fortran")


def test_a_fresh_process_takes_numbas_code_from_the_cache(cache):
    """Machine code is loaded, not made again: without numba, and the answer is the same."""
    script = (
        "from nfriction.codegen import compile_function; import sys, torch\n"
        "f = compile_function(torch.sin, [torch.ones(1, dtype=torch.float64)], backend='numba')\n"
        "print(repr(f([[1.5]]).item()), 'numba' in sys.modules)"
    )
    runs = [
        subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
        for _ in range(2)
    ]
    (first, compiled), (second, again) = (run.stdout.split() for run in runs)
    assert first == second
    assert (compiled, again) == ("True", "False")
    assert len(list(cache.iterdir())) == 1


def test_importing_codegen_and_tracing_stay_light():
    """Neither torch._dynamo, torch.distributed nor numba is loaded before it is needed."""
    script = (
        "import sys, torch; before = set(sys.modules)\n"
        "from nfriction.codegen.function import fold\n"
        "m = torch.nn.Linear(2, 2).double()\n"
        "fold(m, {'x': torch.ones(2, dtype=torch.float64)})\n"
        "new = {n for n in set(sys.modules) - before}\n"
        "print([n for n in ('torch._dynamo', 'torch.distributed.tensor', 'numba') if n in new])"
    )
    run = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert run.stdout.strip() == "[]"

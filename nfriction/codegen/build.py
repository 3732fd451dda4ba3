"""Turn emitted source into functions: through the machine's C compiler, or through numba.

Artefacts are kept in a private cache folder under the hash of everything that shapes them, so an
unchanged model is compiled once per machine.
"""

import contextlib
import ctypes
import hashlib
import importlib.util
import os
import platform
import shlex
import shutil
import stat
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import Literal

from nfriction.codegen.errors import CompilerError, NoBackend

Backend = Literal["auto", "c", "numba"]

# No errno and no traps let the compiler use its own square root and pair sin with cos; fused
# multiply-add only removes roundings. NaN keeps its meaning, unlike under -ffast-math.
FLAGS = ("-fno-math-errno", "-fno-trapping-math", "-ffp-contract=fast")
_NATIVE = "-march=native"
_SHARED = ("-shared", "-fPIC")
_IMAGE = ".image"


def cache_folder() -> Path:
    """The private folder for compiled models; `NFRICTION_CACHE` overrides the platform's choice.

    Raises:
        PermissionError: if the folder belongs to somebody else or others may write to it.
    """
    given = os.environ.get("NFRICTION_CACHE")
    folder = Path(given) if given else _user_cache() / "nfriction"
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    if os.name == "posix":
        status = folder.stat()
        if status.st_uid != os.getuid() or status.st_mode & (stat.S_IWGRP | stat.S_IWOTH):
            raise PermissionError(
                f"the cache folder {folder} must belong to you and be writable by you alone, "
                "because code is loaded from it; `chmod 700` it or set NFRICTION_CACHE."
            )
    return folder


def _user_cache() -> Path:
    if sys.platform == "win32":
        return Path(os.environ.get("LOCALAPPDATA", Path.home() / "AppData" / "Local"))
    if sys.platform == "darwin":
        return Path.home() / "Library" / "Caches"
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")


def find_compiler() -> list[str] | None:
    """The C compiler as an argument list: `CC`, else the first of cc, gcc and clang; or None."""
    named = shlex.split(os.environ.get("CC", ""))
    if named:
        return [found, *named[1:]] if (found := shutil.which(named[0])) else None
    return next(([path] for name in ("cc", "gcc", "clang") if (path := shutil.which(name))), None)


def choose(backend: Backend) -> Literal["c", "numba"]:
    """The backend that will serve.

    Raises:
        NoBackend: if the one asked for, or with "auto" every one, is missing.
    """
    if backend not in ("auto", "c", "numba"):
        raise ValueError(f'`backend` must be "auto", "c" or "numba", got {backend!r}.')
    if backend != "numba" and find_compiler():
        return "c"
    if backend != "c" and importlib.util.find_spec("numba"):
        return "numba"
    missing = {
        "auto": "Neither a C compiler (CC, cc, gcc, clang) nor numba was found",
        "c": "No C compiler (CC, cc, gcc, clang) was found",
        "numba": "numba was not found",
    }[backend]
    raise NoBackend(
        f"{missing}. Install one (for instance `pip install nfriction[numba]`), or use the torch "
        'rollout (`backend="torch"`), which needs neither.'
    )


def build_c(source: str, level: str = "-O3") -> ctypes.CDLL:
    """Compile C source to a shared library, or take it from the cache.

    Args:
        source: the translation unit.
        level: how hard the compiler should optimise.

    Raises:
        CompilerError: with the compiler's message.
        NoBackend: if there is no compiler.
    """
    compiler = find_compiler()
    if compiler is None:
        choose("c")
    assert compiler is not None
    folder = cache_folder()
    recipe = (source, *compiler, _version(tuple(compiler)), level, *FLAGS, _processor())
    key = hashlib.sha256("\0".join(recipe).encode()).hexdigest()[:32]
    library = _intact(folder, key, _suffix()) or _compile([*compiler, level], source, folder, key)
    return ctypes.CDLL(str(library))


def build_numba(source: str, name: str, arguments: Sequence[type]) -> Callable[..., None]:
    """Compile a function of emitted Python with numba, or take it from the cache.

    Args:
        source: the module.
        name: of the function, which has a signature.
        arguments: types of its arguments for ctypes.
    """
    from nfriction.codegen import machine  # brings LLVM, which C does without

    folder = cache_folder()
    versions = (sys.platform, metadata.version("numba"), metadata.version("llvmlite"))
    recipe = (source, name, *versions, _processor())
    key = hashlib.sha256("\0".join(recipe).encode()).hexdigest()[:32]
    kept = _intact(folder, key, _IMAGE)
    if kept:
        return machine.load(kept.read_bytes(), arguments)
    image, alone = machine.compile_python(source, name)
    if alone:
        with _scratch(folder) as scratch:
            draft = scratch / "image"
            draft.write_bytes(image)
            _keep(draft, folder, key, _IMAGE)
    return machine.load(image, arguments)


def _intact(folder: Path, key: str, suffix: str) -> Path | None:
    """A cached artefact whose contents still have the digest that its name tells."""
    for path in sorted(folder.glob(f"{key}-*{suffix}")):
        if path.name == f"{key}-{_digest(path)}{suffix}":
            return path
    return None


def _keep(made: Path, folder: Path, key: str, suffix: str) -> Path:
    """Move an artefact into the cache. The rename is atomic: others see the whole or nothing."""
    target = folder / f"{key}-{_digest(made)}{suffix}"
    os.replace(made, target)
    return target


def _digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()[:32]


def _compile(compiler: list[str], source: str, folder: Path, key: str) -> Path:
    with _scratch(folder) as scratch:
        text, library = scratch / "model.c", scratch / f"model{_suffix()}"
        text.write_text(source, encoding="utf-8")
        math = [] if sys.platform == "win32" else ["-lm"]
        for native in ([_NATIVE], []):  # some compilers know no -march=native
            command = [*compiler, *FLAGS, *native, *_SHARED, "-o", str(library), str(text), *math]
            result = subprocess.run(command, capture_output=True, text=True, check=False)
            if result.returncode == 0:
                break
        else:
            raise CompilerError(f"{shlex.join(command)} failed:\n{result.stderr[-4000:]}")
        return _keep(library, folder, key, _suffix())


@contextlib.contextmanager
def _scratch(folder: Path) -> Iterator[Path]:
    with tempfile.TemporaryDirectory(dir=folder, prefix="building-") as scratch:
        yield Path(scratch)


def _suffix() -> str:
    return {"win32": ".dll", "darwin": ".dylib"}.get(sys.platform, ".so")


@cache
def _version(compiler: tuple[str, ...]) -> str:
    result = subprocess.run([*compiler, "--version"], capture_output=True, text=True, check=False)
    return result.stdout


@cache
def _processor() -> str:
    """What `-march=native` depends on: a cache shared by machines must tell them apart."""
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists():
        lines = cpuinfo.read_text(encoding="utf-8", errors="replace").splitlines()
        wanted = ("model name", "flags", "Features", "CPU part")
        return "\n".join(sorted({line for line in lines if line.startswith(wanted)}))
    return f"{platform.machine()} {platform.processor()} {platform.node()}"

"""Machine code from LLVM IR, cached in a private folder of the user.

Object code is cached by a hash of the IR, LLVM's optimisation level and version, and the processor,
so an unchanged model is compiled once per machine. If the folder cannot be used, code is compiled
in memory.
"""

import ctypes
import hashlib
import logging
import os
import stat
import sys
import tempfile
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

logger = logging.getLogger(__name__)

_KEPT = ".object"
# LLVM's optimisation level, 0 to 3: with 2, compilation takes a fifth longer and code is no faster;
# with 0, it takes a third of the time, but fits take three times as long.
EFFORT = 1
# C library functions called by emitted code.
LIBRARY = (
    *("exp", "expm1", "log", "log1p", "pow", "fmod", "sin", "cos", "tan", "asin", "acos", "atan"),
    *("atan2", "sinh", "cosh", "tanh"),
)


def cache_folder() -> Path:
    """The private folder for compiled models; `NFRICTION_CACHE` overrides the platform's choice.

    Raises PermissionError if it belongs to another user or others may write to it.
    """
    given = os.environ.get("NFRICTION_CACHE")
    folder = Path(given) if given else _user_cache() / "nfriction"
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    if os.name == "posix":
        status = folder.stat()
        if status.st_uid != os.getuid() or status.st_mode & (stat.S_IWGRP | stat.S_IWOTH):
            raise PermissionError(
                f"the cache folder {folder} must belong to you and be writable by you alone, "
                "because code is loaded from it; `chmod 700` it"
            )
    return folder


def _user_cache() -> Path:
    if sys.platform == "win32":
        return Path(os.environ.get("LOCALAPPDATA", Path.home() / "AppData" / "Local"))
    if sys.platform == "darwin":
        return Path.home() / "Library" / "Caches"
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")


def build(source: str, name: str) -> Callable[..., None]:
    """Compile a function of an LLVM IR module; it releases the GIL.

    It takes two integers and three addresses, as written by `Driver.entry`.

    Args:
        name: of the function, which returns nothing.
    """
    from llvmlite import __version__  # slow to import
    from llvmlite import binding as llvm

    recipe = (source, llvm.get_process_triple(), *_processor(), __version__, str(EFFORT))
    key = hashlib.sha256("\0".join(recipe).encode()).hexdigest()[:32]
    folder = None
    try:
        folder = cache_folder()
    except (OSError, RuntimeError) as error:  # RuntimeError if there is no home folder
        _warn_not_kept(str(error))
    code = _kept(folder, key) if folder else None
    if code is None:
        code = _compile(source)
        if folder:
            _keep(folder, key, code)
    if sys.platform == "win32":
        # Functions that LLVM does not find there; a missing one ends the process.
        for library, names in (("ucrtbase", LIBRARY), ("ntdll", ("__chkstk",))):
            for each in names:
                address = ctypes.cast(ctypes.CDLL(library)[each], ctypes.c_void_p).value
                llvm.add_symbol(each, address)
    # The engine also owns the target machine, so each engine has its own.
    engine = llvm.create_mcjit_compiler(llvm.parse_assembly(""), _target_machine())
    engine.add_object_file(llvm.ObjectFileRef.from_data(code))
    engine.finalize_object()
    kinds = [ctypes.c_ssize_t] * 2 + [ctypes.c_void_p] * 3
    function = ctypes.CFUNCTYPE(None, *kinds)(engine.get_function_address(name))

    def call(*given: Any, engine: Any = engine) -> None:  # the engine owns the code
        function(*given)

    return call


@cache
def _warn_not_kept(reason: str) -> None:
    logger.warning(
        "compiled models are not kept (%s), so every process compiles them anew; set "
        "NFRICTION_CACHE to a folder that you can write to.", reason,
    )  # fmt: skip


def _kept(folder: Path, key: str) -> bytes | None:
    """Object code whose contents match the digest in its file name."""
    for path in sorted(folder.glob(f"{key}-*{_KEPT}")):
        try:
            code = path.read_bytes()
        except OSError:
            continue
        if path.name == f"{key}-{_digest(code)}{_KEPT}":
            return code
    return None


def _keep(folder: Path, key: str, code: bytes) -> None:
    """Write object code. The rename is atomic: other processes see the whole file or none."""
    draft = None
    try:
        handle, draft = tempfile.mkstemp(dir=folder, prefix="building-")
        with os.fdopen(handle, "wb") as file:
            file.write(code)
        os.replace(draft, folder / f"{key}-{_digest(code)}{_KEPT}")
    except OSError as error:
        _warn_not_kept(f"{folder}: {error.strerror or error}")
        if draft and os.path.exists(draft):
            os.unlink(draft)


def _digest(code: bytes) -> str:
    return hashlib.sha256(code).hexdigest()[:32]


@cache
def _processor() -> tuple[str, str]:
    """Name and features of this processor, which a cache shared by machines must distinguish."""
    from llvmlite import binding as llvm

    return llvm.get_host_cpu_name(), llvm.get_host_cpu_features().flatten()


def _target_machine() -> Any:
    from llvmlite import binding as llvm

    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    target = llvm.Target.from_triple(llvm.get_process_triple())
    cpu, features = _processor()
    return target.create_target_machine(
        cpu=cpu, features=features, opt=EFFORT, reloc="default", codemodel="jitdefault", jit=True
    )


def _compile(source: str) -> bytes:
    from llvmlite import binding as llvm

    machine = _target_machine()
    module = llvm.parse_assembly(source)
    module.triple = machine.triple
    module.data_layout = str(machine.target_data)
    module.verify()
    # The graph is already simplified and its values are shared, so LLVM's own passes, which take as
    # long as everything else, gain nothing.
    return bytes(machine.emit_object(module))

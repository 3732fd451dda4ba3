"""Machine code of functions that numba compiles: made with numba, loaded without it.

numba takes seconds to load itself and to compile. What it makes needs the C library alone, so in a
later process LLVM's loader is enough.
"""

import ctypes
import math
import sys
from collections.abc import Callable, Sequence
from typing import Any

from llvmlite import binding as llvm  # type: ignore[import-untyped]


def compile_python(source: str, name: str) -> tuple[bytes, bool]:
    """Compile a function of emitted Python that has a signature.

    Returns:
        Its symbol and its object code, in one, and whether that can be loaded without numba.
    """
    scope: dict[str, Any] = {"__name__": "nfriction_emitted"}
    exec(compile(source, "<emitted by nfriction>", "exec"), scope)
    (result,) = scope[name].overloads.values()
    _, _, (code, bitcode) = result.library.serialize_using_object_code()
    called = [f.name for f in llvm.parse_bitcode(bitcode).functions if f.is_declaration]
    # On Windows numba brings functions of the C library that LLVM does not find by itself, and
    # what it does not find ends the process.
    alone = sys.platform != "win32"
    alone = alone and all(n.startswith("llvm.") or hasattr(math, n) for n in called)
    return result.fndesc.llvm_func_name.encode() + b"\n" + code, alone


def load(image: bytes, arguments: Sequence[type]) -> Callable[..., None]:
    """What `compile_python` made as a function, which lets go of the GIL.

    Args:
        image: symbol and object code.
        arguments: types of the arguments for ctypes.
    """
    symbol, code = image.split(b"\n", 1)
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    target = llvm.Target.from_triple(llvm.get_process_triple()).create_target_machine()
    engine = llvm.create_mcjit_compiler(llvm.parse_assembly(""), target)
    engine.add_object_file(llvm.ObjectFileRef.from_data(code))
    engine.finalize_object()
    # numba's functions write what they return, and the exception, through two pointers in front.
    slot = ctypes.c_void_p
    entry = ctypes.CFUNCTYPE(ctypes.c_int, slot, slot, *arguments)(
        engine.get_function_address(symbol.decode())
    )

    def call(*given: Any, engine: Any = engine) -> None:  # the engine owns the code
        returned, raised = slot(), slot()
        failed = entry(ctypes.addressof(returned), ctypes.addressof(raised), *given)
        assert not failed, "emitted code raises nothing"

    return call

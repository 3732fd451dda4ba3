"""Arrays as bare pointers, for the Python that numba compiles.

numba takes half as long to compile them as arrays, and a function of pointers can be called as one
in C. Imported by emitted code alone.
"""

from typing import Any

from numba import types
from numba.extending import intrinsic

COUNT, REAL = types.intp, types.float64
COUNTS, REALS = types.CPointer(COUNT), types.CPointer(REAL)


@intrinsic
def moved(typing: Any, pointer: Any, count: Any) -> Any:
    """The pointer to the element so many further on."""

    def code(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.gep(arguments[0], [arguments[1]])

    return pointer(pointer, types.intp), code

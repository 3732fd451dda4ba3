"""Built rollouts as functions of candidates and flat arrays, whatever the language."""

import ctypes
from collections.abc import Callable
from typing import Any

import numpy as np

from nfriction.codegen import build, driver

Array = np.ndarray

COUNT, REAL, ARRAY = ctypes.c_ssize_t, ctypes.c_double, ctypes.c_void_p
_ARGUMENTS: list[type] = [
    *(COUNT, COUNT, COUNT, COUNT, COUNT, REAL, ARRAY, COUNT, ARRAY, ARRAY, ARRAY, COUNT, COUNT),
    *(ARRAY, COUNT, COUNT, ARRAY, ARRAY, COUNT, COUNT, ARRAY, COUNT),
    *(ARRAY, ARRAY, ARRAY, ARRAY),
]


def of_arrays(function: Callable[..., None]) -> Callable[..., None]:
    """A function of addresses as one of arrays."""

    def call(*args: Any) -> None:
        function(*(a.ctypes.data if isinstance(a, np.ndarray) else a for a in args))

    return call


def c_kernel(source: str) -> Callable[..., None]:
    """The entry point of a rollout in C; it lets go of the GIL."""
    function = build.build_c(source).nf_rollout
    function.restype, function.argtypes = None, _ARGUMENTS
    return of_arrays(function)


def numba_kernel(source: str, parts: driver.Pieces) -> Callable[..., None]:
    """The entry point of a rollout for numba; its two further arguments are room to work in."""
    arguments: list[type] = [ARRAY, ARRAY, *_ARGUMENTS]
    function = of_arrays(build.build_numba(source, "nf_rollout", arguments))
    once, step = len(parts.once), len(parts.step)
    return lambda *args: function(np.empty(once), np.empty(step), *args)

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
    """The entry point of a rollout for numba, with what C computes once a candidate done here."""
    more: list[type] = [ARRAY, ARRAY, COUNT, ARRAY]
    function = of_arrays(build.build_numba(source, "nf_rollout", [*more, *_ARGUMENTS]))

    def call(first: int, last: int, *args: Any) -> None:
        p, p_row, q0, qd0 = args[4:8]
        tau, tau_row = args[11:13]
        n, count = parts.joints, last - first

        def rows(flat: Array, stride: int, width: int) -> Array:
            begins = stride * np.arange(first, last) if stride else np.zeros(1, dtype=int)
            return flat[begins[:, None] + np.arange(width)]

        # Once a candidate, so NumPy is quick enough, and numba has less to compile.
        given = {"p": rows(p, p_row, parts.parameters), "tau": rows(tau, tau_row, n)}
        given |= {"q": rows(q0, n, n), "qd": rows(qd0, n, n)}
        once = parts.evaluate(parts.once, given, count if p_row else 1)
        start = parts.evaluate(parts.start, given, count)
        step = np.empty(len(parts.step))
        function(step, once, len(parts.once) if p_row else 0, start, first, last, *args)

    return call

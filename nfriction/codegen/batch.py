"""Batches of arguments as compiled code reads them, and kernels that work through them."""

import math
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from torch import Tensor

from nfriction.codegen.graph import FunctionalModule
from nfriction.codegen.llvm import jit
from nfriction.codegen.llvm.driver import AXES, Driver, Layout

Array = np.ndarray

# Rows computed together where all share their parameters.
WIDTH = 8
# From that many rows on they are; it costs another compilation.
FEW = 3


@dataclass(frozen=True)
class Series:
    """A quantity over rows, steps and elements; a stride of zero repeats one value.

    Attributes:
        values: the array that the strides refer to.
        rows: number of rows given, 1 where it is the same for all.
        strides: in numbers, along `AXES`.
    """

    values: Array
    rows: int
    strides: tuple[int, int, int]


def to_array(value: Any) -> Array:
    """A float64 array from NumPy, torch or numbers."""
    if isinstance(value, Tensor):
        value = value.detach().cpu().numpy()
    return np.asarray(value, dtype=np.float64)


def series(name: str, value: Any, steps: int, width: tuple[int, ...]) -> Series:
    """`value` of shape width, (steps, *width) or (candidate, steps, *width), which is not copied.

    Raises:
        ValueError: for any other shape.
    """
    array = to_array(value)
    full = (steps, *width)
    if array.shape == width:
        array = np.broadcast_to(array, full)
    if array.shape == full:
        array = array[None]
    if array.shape[1:] != full:
        shown = ", ".join(map(str, full))
        raise ValueError(f"`{name}` must be ({shown}) or (candidate, {shown}), got {array.shape}.")
    return _strided(array if width else array[..., None])


def rows_of(name: str, value: Any, shape: tuple[int, ...]) -> Series:
    """`value` of shape (row, *shape), the same in all steps.

    Raises:
        ValueError: for any other shape.
    """
    array = to_array(value)
    if not array.ndim or array.shape[1:] != shape:
        shown = ", ".join(map(str, shape))
        raise ValueError(
            f"`{name}` must be (batch, {shown}), got {array.shape}; a single one is `{name}[None]`."
        )
    flat = array.reshape(len(array), math.prod(shape))
    return _strided(np.broadcast_to(flat[:, None], (len(flat), 1, flat.shape[1])))


def _strided(array: Array) -> Series:
    row, step, element = (stride // array.itemsize for stride in array.strides)
    return Series(array, len(array), (row if len(array) > 1 else 0, step, element))


def common_rows(rows: Mapping[str, int]) -> int:
    """The one number of rows that all arguments agree on; single rows are for all.

    Raises:
        ValueError: if they disagree.
    """
    counts = {count for count in rows.values() if count != 1} or {1}
    if len(counts) > 1:
        shown = ", ".join(f"`{name}` {count}" for name, count in rows.items() if count != 1)
        raise ValueError(f"the numbers of rows must agree or be 1, got {shown}.")
    return counts.pop()


def parameter_rows(
    module: FunctionalModule, overrides: Mapping[str, Any]
) -> tuple[Array, dict[str, int]]:
    """Parameter vectors, one row a candidate (or one for all), and the rows that each name gave.

    Args:
        module: has the values that are not overridden.
        overrides: values by name, of the parameter's shape or (candidate, *shape).

    Raises:
        ValueError: for an unknown name or a shape that does not fit.
    """
    unknown = [name for name in overrides if name not in module.shapes]
    if unknown:
        raise ValueError(f"no parameter {unknown}; there are {list(module.shapes)}.")
    given: dict[str, Array] = {}
    for name, shape in module.shapes.items():
        array = to_array(overrides[name] if name in overrides else module.value(name))
        if array.shape == shape:
            array = array[None]
        elif array.shape[1:] != shape or not array.ndim:
            raise ValueError(
                f"parameter `{name}` must be {shape} or (candidate, *{shape}), got {array.shape}."
            )
        given[name] = array.reshape(len(array), math.prod(shape))
    counts = {f"parameters[{name!r}]": len(given[name]) for name in overrides}
    rows = common_rows(counts)
    columns = [a if len(a) == rows else np.repeat(a, rows, axis=0) for a in given.values()]
    return np.concatenate([np.empty((rows, 0)), *columns], axis=1), counts


class Kernel:
    """Compiled code over the rows of a batch.

    Args:
        write: the driver of so many rows together, 0 for one at a time.
        layout: its arguments.
    """

    def __init__(self, write: Callable[[int], Driver], layout: Layout) -> None:
        self.layout = layout
        self._write = write
        self._built: dict[int, tuple[Callable[..., None], int]] = {}

    def __call__(
        self,
        rows: int,
        parameters: Array,
        given: Mapping[str, Series],
        outputs: Mapping[str, Array],
        settings: Mapping[str, int] | None = None,
        threads: int = 1,
    ) -> None:
        """Fill the outputs.

        Args:
            rows: of the batch.
            parameters: (row, value), or a single row for all.
            given: series by name; one that is left out must not be read.
            outputs: contiguous arrays to write to, by name.
            settings: further numbers.
            threads: rows are shared out among this many.
        """
        own = len(parameters) > 1
        numbers = {"p_row": parameters.shape[1] if own else 0, **(settings or {})}
        arrays = {"p": parameters, **outputs}
        for name, one in given.items():
            arrays[name] = one.values
            numbers |= {f"{name}_{axis}": n for axis, n in zip(AXES, one.strides, strict=True)}
        addresses = [arrays[n].ctypes.data if n in arrays else 0 for n in self.layout.addresses]
        where = np.array(addresses, dtype=np.uintp)
        sizes = np.array([numbers.get(n, 0) for n in self.layout.numbers], dtype=np.int64)
        function, room = self._function(WIDTH if rows >= FEW and not own else 0)

        def part(first: int, last: int) -> None:
            space = np.empty(room + 8)
            # Vectors of eight doubles are read by instructions that need 64-byte alignment.
            aligned = space.ctypes.data + -space.ctypes.data % 64
            function(first, last, where.ctypes.data, sizes.ctypes.data, aligned)

        if min(threads, rows) <= 1:
            part(0, rows)
            return
        # More parts than threads, since candidates that diverge early leave a thread idle.
        borders = np.linspace(0, rows, min(rows, 4 * threads) + 1).astype(int).tolist()
        with ThreadPoolExecutor(threads) as pool:
            for job in [pool.submit(part, *pair) for pair in pairwise(borders)]:
                job.result()

    def source(self, width: int = 0) -> str:
        """LLVM IR for so many rows together, 0 for one at a time."""
        return self._write(width).body.text()

    def _function(self, width: int) -> tuple[Callable[..., None], int]:
        if width not in self._built:
            driver = self._write(width)
            self._built[width] = jit.build(driver.body.text(), "nf_entry"), driver.room
        return self._built[width]

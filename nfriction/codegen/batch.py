"""Batches: arguments in the form that compiled code reads, and code that loops over rows."""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from torch import Tensor

from nfriction.codegen import jit
from nfriction.codegen.emit import write_function
from nfriction.codegen.graph import FunctionalModule
from nfriction.codegen.ir import Body
from nfriction.codegen.scalar import Node

Array = np.ndarray

AXES = ("row", "step", "element")
# Rows computed together if all share their parameters.
WIDTH = 8
# Smallest number of rows for which this is worthwhile, since it needs another compilation.
FEW = 3


@dataclass(frozen=True)
class Series:
    """A quantity over rows, steps and elements; a stride of zero repeats one value."""

    values: Array  # to which the strides refer
    rows: int  # number given; 1 if the same for all
    strides: tuple[int, int, int]  # in elements, along `AXES`


def to_array(value: Any) -> Array:
    """A float64 array from NumPy, torch or numbers."""
    if isinstance(value, Tensor):
        value = value.detach().cpu().numpy()
    return np.asarray(value, dtype=np.float64)


def series(name: str, value: Any, steps: int, width: tuple[int, ...]) -> Series:
    """`value` of shape width, (steps, *width) or (candidate, steps, *width), without a copy."""
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
    """`value` of shape (row, *shape), the same in all steps."""
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
    """The number of rows on which all arguments agree; single rows apply to all."""
    counts = {count for count in rows.values() if count != 1} or {1}
    if len(counts) > 1:
        shown = ", ".join(f"`{name}` {count}" for name, count in rows.items() if count != 1)
        raise ValueError(f"the numbers of rows must agree or be 1, got {shown}.")
    return counts.pop()


def parameter_rows(
    module: FunctionalModule, overrides: Mapping[str, Any]
) -> tuple[Array, dict[str, int]]:
    """Parameter vectors, one row per candidate (or one for all), and the number of rows by name.

    Overrides have the parameter's shape or (candidate, *shape); other values come from the module.
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


@dataclass(frozen=True)
class Layout:
    """Arguments of an entry point, in order."""

    series: tuple[str, ...]  # inputs with strides along `AXES`
    outputs: tuple[str, ...]  # arrays that are written
    settings: tuple[str, ...] = ()  # further integers

    @property
    def addresses(self) -> tuple[str, ...]:
        """Names of all arrays; `p` are the parameters."""
        return ("p", *self.series, *self.outputs)

    @property
    def numbers(self) -> tuple[str, ...]:
        """Names of all integers."""
        strides = (f"{name}_{axis}" for name in self.series for axis in AXES)
        return ("p_row", *self.settings, *strides)


class Driver:
    """Text of an entry point that processes rows `first` to `last`, several at a time if possible.

    Functions of the graph read and write arrays in the caller's workspace; every element has one
    slot for each of the rows that are computed together. `sizes` are elements of each array,
    `places` array and index of the input nodes.

    Args:
        width: number of rows computed together as vectors, which share all parameters; 0 for one.
        once: nodes computed once, with one slot each.
    """

    def __init__(
        self,
        layout: Layout,
        width: int,
        sizes: Mapping[str, int],
        once: Sequence[Node],
        places: Mapping[int, tuple[str, int]],
    ) -> None:
        self.body = Body()
        self.layout = layout
        self.width = width
        self.lanes = max(1, width)
        self.offset: dict[str, int] = {}
        self.room = 0
        for name, size in sizes.items():
            self.offset[name] = self.room
            self.room += size * self.lanes
        self.offset["once"] = self.room
        self.room += len(once)
        self.value: dict[str, str] = {}
        write_function(self.body, "nf_once", {"once": once}, places, ["p"], [], seldom=True)
        self._places = {**places, **{n.number: ("once", i) for i, n in enumerate(once)}}

    def function(
        self,
        name: str,
        inputs: Sequence[str],
        outputs: Mapping[str, Sequence[Node]],
        seldom: bool = False,
    ) -> None:
        """Write a function of workspace arrays, the parameters and the values computed once."""
        shared = ["p", "once"]
        write_function(self.body, name, outputs, self._places, shared, inputs, self.width, seldom)

    @contextmanager
    def entry(self) -> Iterator[None]:
        """The function; in its body, `first` is the first of the rows computed together."""
        body = self.body
        arguments = "i64 %first, i64 %last, ptr %addresses, ptr %numbers, ptr %room"
        with body.function(f"define void @nf_entry({arguments})"):
            for i, name in enumerate(self.layout.addresses):
                self.value[name] = body.load("%addresses", i, "ptr")
            for i, name in enumerate(self.layout.numbers):
                self.value[name] = body.load("%numbers", i, "i64")
            for name in self.offset:
                self.value[f"room.{name}"] = self.element(name, 0)
            self.value["final"] = body.let("sub i64 %last, 1")
            span = body.let("sub i64 %last, %first")
            filled = body.let(f"add i64 {span}, {self.lanes - 1}")
            with body.loop("0", body.let(f"sdiv i64 {filled}, {self.lanes}")) as block:
                ahead = body.let(f"mul i64 {block}, {self.lanes}")
                self.value["first"] = body.let(f"add i64 %first, {ahead}")
                own = body.let(f"mul i64 {self.value['first']}, {self.value['p_row']}")
                self.value["own_p"] = body.at(self.value["p"], own)
                self.call("nf_once")
                yield
            body.run("ret void")

    def element(self, name: str, index: int) -> str:
        """Address of an element's slots in the workspace."""
        return self.body.at("%room", self.offset[name] + index * self.lanes)

    def call(self, name: str, *arguments: str) -> None:
        """Call a function of addresses, given by their names in `value`."""
        given = ", ".join(f"ptr {self.value[a]}" for a in ("own_p", "room.once", *arguments))
        self.body.run(f"call void @{name}({given})")

    def least(self, a: str, b: str) -> str:
        less = self.body.let(f"icmp slt i64 {a}, {b}")
        return self.body.let(f"select i1 {less}, i64 {a}, i64 {b}")

    @contextmanager
    def each(self) -> Iterator[tuple[str, str]]:
        """Rows that are computed together, and their slots; the last row fills spare slots."""
        if not self.width:
            yield self.value["first"], "0"
            return
        with self.body.loop("0", str(self.lanes)) as lane:
            row = self.body.let(f"add i64 {self.value['first']}, {lane}")
            yield self.least(row, self.value["final"]), lane

    def gather(self, name: str, count: int, target: str, sample: str = "0") -> None:
        """Read elements of a series into slots starting at `target`."""
        body = self.body
        ahead = body.let(f"mul i64 {sample}, {self.value[f'{name}_step']}")
        with self.each() as (row, lane):
            start = body.let(f"mul i64 {row}, {self.value[f'{name}_row']}")
            source = body.at(self.value[name], body.let(f"add i64 {start}, {ahead}"))
            with body.loop("0", str(count)) as i:
                index = body.let(f"mul i64 {i}, {self.value[f'{name}_element']}")
                body.store(body.load(source, index), target, self._place(i, lane))

    def scatter(self, name: str, count: int) -> None:
        """Write a workspace array to the rows of the output with the same name."""
        body = self.body
        with self.each() as (row, lane):
            target = body.at(self.value[name], body.let(f"mul i64 {row}, {count}"))
            with body.loop("0", str(count)) as i:
                value = body.load(self.value[f"room.{name}"], self._place(i, lane))
                body.store(value, target, i)

    def _place(self, element: str, lane: str) -> str:
        ahead = self.body.let(f"mul i64 {element}, {self.lanes}")
        return self.body.let(f"add i64 {ahead}, {lane}")


class Kernel:
    """Compiled code over the rows of a batch; `write(width)` returns the driver, see there."""

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
        """Fill contiguous outputs by name from series and parameters, (row, value) or a single row.

        Rows are divided among threads; the code must not read a series that is omitted.
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
        # More parts than threads, because candidates that diverge early leave a thread idle.
        borders = np.linspace(0, rows, min(rows, 4 * threads) + 1).astype(int).tolist()
        with ThreadPoolExecutor(threads) as pool:
            for job in [pool.submit(part, *pair) for pair in pairwise(borders)]:
                job.result()

    def source(self, width: int = 0) -> str:
        """LLVM IR for a number of rows computed together, 0 for one at a time."""
        return self._write(width).body.text()

    def _function(self, width: int) -> tuple[Callable[..., None], int]:
        if width not in self._built:
            driver = self._write(width)
            self._built[width] = jit.build(driver.body.text(), "nf_entry"), driver.room
        return self._built[width]

"""Loops over a batch: what compiled code reads and writes, and who is computed together."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass

from nfriction.codegen.llvm.body import Body

AXES = ("row", "step", "element")


@dataclass(frozen=True)
class Layout:
    """Arguments of an entry point, in order.

    Attributes:
        series: inputs that have strides along `AXES`.
        outputs: arrays that are written.
        settings: further whole numbers.
    """

    series: tuple[str, ...]
    outputs: tuple[str, ...]
    settings: tuple[str, ...] = ()

    @property
    def addresses(self) -> tuple[str, ...]:
        """Names of all arrays; `p` are the parameters."""
        return ("p", *self.series, *self.outputs)

    @property
    def numbers(self) -> tuple[str, ...]:
        """Names of all whole numbers."""
        strides = (f"{name}_{axis}" for name in self.series for axis in AXES)
        return ("p_row", *self.settings, *strides)


class Driver:
    """Text of an entry point that works through rows `first` to `last`, some of them together.

    What functions of the graph read and write are arrays in the caller's working room; every
    element has a place for each row that is computed together with others.

    Args:
        layout: its arguments.
        width: rows computed together as vectors, which then share all parameters; 0 for one.
        sizes: elements of each array in the room.
        once: values computed once, of which there is one each.
    """

    def __init__(self, layout: Layout, width: int, sizes: Mapping[str, int], once: int) -> None:
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
        self.room += once
        self.value: dict[str, str] = {}

    @contextmanager
    def entry(self) -> Iterator[None]:
        """The function; within, `first` is the first of the rows that are computed together."""
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
                yield
            body.run("ret void")

    def element(self, name: str, index: int) -> str:
        """Address of an element's places in the room."""
        return self.body.at("%room", self.offset[name] + index * self.lanes)

    def call(self, name: str, *arguments: str) -> None:
        """A function of addresses, by their names in `value`."""
        given = ", ".join(f"ptr {self.value[a]}" for a in arguments)
        self.body.run(f"call void @{name}({given})")

    def least(self, a: str, b: str) -> str:
        less = self.body.let(f"icmp slt i64 {a}, {b}")
        return self.body.let(f"select i1 {less}, i64 {a}, i64 {b}")

    @contextmanager
    def each(self) -> Iterator[tuple[str, str]]:
        """Rows that are computed together and their places; the last row fills up."""
        if not self.width:
            yield self.value["first"], "0"
            return
        with self.body.loop("0", str(self.lanes)) as lane:
            row = self.body.let(f"add i64 {self.value['first']}, {lane}")
            yield self.least(row, self.value["final"]), lane

    def gather(self, name: str, count: int, target: str, sample: str = "0") -> None:
        """Read elements of a series into places from `target` on."""
        body = self.body
        ahead = body.let(f"mul i64 {sample}, {self.value[f'{name}_step']}")
        with self.each() as (row, lane):
            start = body.let(f"mul i64 {row}, {self.value[f'{name}_row']}")
            source = body.at(self.value[name], body.let(f"add i64 {start}, {ahead}"))
            with body.loop("0", str(count)) as i:
                index = body.let(f"mul i64 {i}, {self.value[f'{name}_element']}")
                body.store(body.load(source, index), target, self._place(i, lane))

    def scatter(self, name: str, output: str, count: int, index: str, blocks: str) -> None:
        """Write an array of the room to block `index` of the `blocks` that each row has."""
        body = self.body
        with self.each() as (row, lane):
            block = body.let(f"add i64 {body.let(f'mul i64 {row}, {blocks}')}, {index}")
            target = body.at(self.value[output], body.let(f"mul i64 {block}, {count}"))
            with body.loop("0", str(count)) as i:
                value = body.load(self.value[f"room.{name}"], self._place(i, lane))
                body.store(value, target, i)

    def _place(self, element: str, lane: str) -> str:
        ahead = self.body.let(f"mul i64 {element}, {self.lanes}")
        return self.body.let(f"add i64 {ahead}, {lane}")

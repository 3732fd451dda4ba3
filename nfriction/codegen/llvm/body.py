"""LLVM IR as text, function by function."""

import struct
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

from nfriction.codegen.llvm import simd_math


def real(width: int) -> str:
    return f"<{width} x double>" if width else "double"


def truth(width: int) -> str:
    return f"<{width} x i1>" if width else "i1"


class Body:
    """Text of a module, written function by function."""

    def __init__(self) -> None:
        self.lines: list[str] = []
        self.declared: dict[str, str] = {}
        self.label = ""
        self._count = 0
        self._widths: set[int] = set()

    def text(self) -> str:
        """The whole module."""
        for width in sorted(self._widths):
            simd_math.far_sincos(self, width)
        weights = '!0 = !{!"branch_weights", i32 1048575, i32 1}'
        return "\n".join([*sorted(self.declared.values()), *self.lines, weights, ""])

    @contextmanager
    def function(self, head: str) -> Iterator[None]:
        self.lines.append(f"{head} {{")
        self.block("entry")
        yield
        self.lines.append("}\n")

    def fresh(self, stem: str = "v") -> str:
        self._count += 1
        return f"{stem}{self._count}"

    def let(self, text: str) -> str:
        """A new value."""
        name = f"%{self.fresh()}"
        self.lines.append(f"  {name} = {text}")
        return name

    def run(self, text: str) -> None:
        self.lines.append(f"  {text}")

    def block(self, label: str) -> None:
        self.lines.append(f"{label}:")
        self.label = label

    @contextmanager
    def loop(self, first: str, last: str) -> Iterator[str]:
        """Repeat for integers from `first` to below `last`."""
        before, index, following = self.label, f"%{self.fresh()}", f"%{self.fresh()}"
        head, inside, after = (self.fresh(stem) for stem in ("head", "inside", "after"))
        self.run(f"br label %{head}")
        self.block(head)
        place = len(self.lines)
        self.run("")
        self.run(f"%{head}.more = icmp slt i64 {index}, {last}")
        self.run(f"br i1 %{head}.more, label %{inside}, label %{after}")
        self.block(inside)
        yield index
        self.run(f"{following} = add nsw i64 {index}, 1")
        self.run(f"br label %{head}")
        phi = f"phi i64 [ {first}, %{before} ], [ {following}, %{self.label} ]"
        self.lines[place] = f"  {index} = {phi}"
        self.block(after)

    @contextmanager
    def when(self, condition: str) -> Iterator[None]:
        inside, after = self.fresh("inside"), self.fresh("after")
        self.run(f"br i1 {condition}, label %{inside}, label %{after}")
        self.block(inside)
        yield
        self.run(f"br label %{after}")
        self.block(after)

    def at(self, pointer: str, index: str | int, kind: str = "double") -> str:
        """Address of an element."""
        return self.let(f"getelementptr {kind}, ptr {pointer}, i64 {index}")

    def load(self, pointer: str, index: str | int, kind: str = "double") -> str:
        return self.let(f"load {kind}, ptr {self.at(pointer, index, kind)}, align 8")

    def store(self, value: str, pointer: str, index: str | int, kind: str = "double") -> None:
        self.run(f"store {kind} {value}, ptr {self.at(pointer, index, kind)}, align 8")

    def constant(self, value: float | bool, width: int = 0) -> str:
        """A literal, repeated where a vector of some width is wanted."""
        if isinstance(value, bool):
            kind, text = "i1", "true" if value else "false"
        else:
            kind, text = "double", f"0x{struct.pack('>d', value).hex().upper()}"
        return f"<{', '.join([f'{kind} {text}'] * width)}>" if width else text

    def call(self, name: str, operands: Sequence[str], width: int = 0) -> str:
        """A function that LLVM has for vectors too."""
        kind = real(width)
        full = f"llvm.{name}.{f'v{width}f64' if width else 'f64'}"
        self._declare(kind, full, len(operands))
        return self.let(f"call {kind} @{full}({', '.join(f'{kind} {x}' for x in operands)})")

    def each(self, op: str, operands: Sequence[str], width: int) -> str:
        """A function of the C library, called for every element; operands with their types."""
        self._declare("double", op, len(operands))
        if not width:
            return self.let(f"call double @{op}({', '.join(operands)})")
        found = "poison"
        for i in range(width):
            parts = [self.let(f"extractelement {x}, i64 {i}") for x in operands]
            one = self.let(f"call double @{op}({', '.join(f'double {x}' for x in parts)})")
            found = self.let(f"insertelement {real(width)} {found}, double {one}, i64 {i}")
        return found

    def _declare(self, kind: str, name: str, count: int) -> None:
        text = f"declare {kind} @{name}({', '.join([kind] * count)})"
        self.declared[name] = f"{text} nounwind"

    def family(self, name: str, x: str, width: int) -> tuple[str, ...]:
        """A function of `simd_math` of a vector."""
        if name == "sincos":
            self._widths.add(width)
            return simd_math.sincos(self, x, width)
        return (getattr(simd_math, name)(self, x, width),)

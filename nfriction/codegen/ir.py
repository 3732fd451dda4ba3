"""LLVM IR as text, function by function, with exp, tanh, sin and cos of vectors.

These four take most of the time of a rollout, and the C library computes them one number at a time.
Here polynomials are evaluated by Estrin's scheme, whose short chains of dependent operations suit
a step whose stages are sequential. Errors are below 3 units in the last place; NaN and infinity
behave as in the library; sin and cos of arguments beyond 1e5 come from the library.

References:
    Argument reduction by a constant in several exact parts: W. J. Cody and W. Waite, Software
    Manual for the Elementary Functions, 1980. The polynomials are Taylor's.
"""

import struct
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import partialmethod
from math import factorial

_EXP_SERIES = [1.0 / factorial(k) for k in range(2, 14)]
_SIN_SERIES = [(-1.0) ** k / factorial(2 * k + 1) for k in range(1, 9)]
_COS_SERIES = [(-1.0) ** k / factorial(2 * k) for k in range(2, 9)]

# Adding 1.5 * 2^52 rounds to an integer, which then occupies the lowest bits.
_ROUND = 6755399441055744.0


def real(width: int) -> str:
    return f"<{width} x double>" if width else "double"


def truth(width: int) -> str:
    return f"<{width} x i1>" if width else "i1"


class Body:
    """Text of an LLVM module, written function by function."""

    def __init__(self) -> None:
        self.lines: list[str] = []
        self.declared: dict[str, str] = {}
        self.label = ""
        self._count = 0
        self._widths: set[int] = set()

    def text(self) -> str:
        """The whole module."""
        for width in sorted(self._widths):
            _far_sincos(self, width)
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
        """Define a new value."""
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
        # Written last, because the label from which the loop returns is known only now.
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
        """A literal, repeated if a vector of some width is needed."""
        if isinstance(value, bool):
            kind, text = "i1", "true" if value else "false"
        else:
            # As bits, since decimal literals of LLVM must be exact.
            kind, text = "double", f"0x{struct.pack('>d', value).hex().upper()}"
        return f"<{', '.join([f'{kind} {text}'] * width)}>" if width else text

    def call(self, name: str, operands: Sequence[str], width: int = 0) -> str:
        """Call an LLVM intrinsic, which also exists for vectors."""
        kind = real(width)
        full = f"llvm.{name}.{f'v{width}f64' if width else 'f64'}"
        self._declare(kind, full, len(operands))
        return self.let(f"call {kind} @{full}({', '.join(f'{kind} {x}' for x in operands)})")

    def each(self, op: str, operands: Sequence[str], width: int) -> str:
        """Call a function of the C library for every element; operands include their types."""
        self._declare("double", op, len(operands))
        if not width:
            return self.let(f"call double @{op}({', '.join(operands)})")
        found = "poison"
        # Vectors are split, because the C library has only the scalar function.
        for i in range(width):
            parts = [self.let(f"extractelement {x}, i64 {i}") for x in operands]
            one = self.let(f"call double @{op}({', '.join(f'double {x}' for x in parts)})")
            found = self.let(f"insertelement {real(width)} {found}, double {one}, i64 {i}")
        return found

    def _declare(self, kind: str, name: str, count: int) -> None:
        text = f"declare {kind} @{name}({', '.join([kind] * count)})"
        self.declared[name] = f"{text} nounwind"

    def family(self, name: str, x: str, width: int) -> tuple[str, ...]:
        """Call one of the vector functions; sine and cosine are computed together."""
        if name == "sincos":
            self._widths.add(width)
            return _sincos(_Vectors(self, width), x)
        return ({"exp": _exp, "tanh": _tanh}[name](_Vectors(self, width), x),)


class _Vectors:
    """Arithmetic on vectors of one width; scalars are repeated."""

    def __init__(self, body: Body, width: int) -> None:
        self.body = body
        self.width = width
        self.real = f"<{width} x double>"
        self.bits = f"<{width} x i64>"

    def _operand(self, x: str | float) -> str:
        return x if isinstance(x, str) else self.body.constant(x, self.width)

    def _two(self, op: str, a: str | float, b: str | float) -> str:
        return self.body.let(f"{op} {self.real} {self._operand(a)}, {self._operand(b)}")

    add = partialmethod(_two, "fadd")
    sub = partialmethod(_two, "fsub")
    mul = partialmethod(_two, "fmul")
    div = partialmethod(_two, "fdiv")

    def mul_add(self, a: str | float, b: str | float, c: str | float) -> str:
        return self.body.call("fmuladd", [self._operand(x) for x in (a, b, c)], self.width)

    def where(self, a: str, sign: str, b: float, then: float, otherwise: str) -> str:
        test = self._two(f"fcmp {sign}", a, b)
        choice = f"{self.real} {self._operand(then)}, {self.real} {otherwise}"
        return self.body.let(f"select <{self.width} x i1> {test}, {choice}")

    def as_bits(self, x: str) -> str:
        return self.body.let(f"bitcast {self.real} {x} to {self.bits}")

    def as_real(self, x: str) -> str:
        return self.body.let(f"bitcast {self.bits} {x} to {self.real}")

    def bitwise(self, op: str, a: str, b: str | int) -> str:
        if isinstance(b, int):
            b = f"<{', '.join([f'i64 {b}'] * self.width)}>"
        return self.body.let(f"{op} {self.bits} {a}, {b}")

    def polynomial(self, x: str, coefficients: Sequence[float]) -> str:
        """Evaluate by Estrin's scheme; coefficients in order of ascending power."""
        terms: list[str | float] = list(coefficients)
        power = x
        while len(terms) > 1:
            pairs = zip(terms[::2], terms[1::2], strict=False)
            raised: list[str | float] = [self.mul_add(b, power, a) for a, b in pairs]
            terms = raised + terms[len(terms) - len(terms) % 2 :]
            power = self.mul(power, power) if len(terms) > 1 else power
        return self._operand(terms[0])


def _exp(v: _Vectors, x: str) -> str:
    # NaN compares false and is therefore propagated.
    x = v.where(x, "ogt", 709.5, 709.5, v.where(x, "olt", -708.0, -708.0, x))
    fraction, power = _halving(v, x)
    return v.mul(v.add(fraction, 1.0), power)


def _tanh(v: _Vectors, x: str) -> str:
    bits = v.as_bits(x)
    sign = v.bitwise("and", bits, -(2**63))
    size = v.as_real(v.bitwise("xor", bits, sign))
    fraction, power = _halving(v, v.where(size, "ogt", 20.0, 40.0, v.mul(size, 2.0)))
    e = v.mul_add(power, fraction, v.sub(power, 1.0))  # exp(2 x) - 1 without cancellation
    ratio = v.div(e, v.add(e, 2.0))
    return v.as_real(v.bitwise("xor", v.as_bits(ratio), sign))


def _sincos(v: _Vectors, x: str) -> tuple[str, str]:
    body, width = v.body, v.width
    pair = f"{{ {v.real}, {v.real} }}"
    size = body.call("fabs", [x], width)
    within = body.let(f"fcmp olt {v.real} {size}, {body.constant(1e5, width)}")
    mask = body.let(f"bitcast <{width} x i1> {within} to i{width}")
    all_near = body.let(f"icmp eq i{width} {mask}, -1")
    near, far, done = (body.fresh(stem) for stem in ("near", "far", "done"))
    body.run(f"br i1 {all_near}, label %{near}, label %{far}, !prof !0")
    body.block(far)
    found = body.let(f"call {pair} @nf_far{width}({v.real} {x})")
    from_far = [body.let(f"extractvalue {pair} {found}, {i}") for i in range(2)]
    body.run(f"br label %{done}")
    body.block(near)
    from_near = _near(v, x)
    body.run(f"br label %{done}")
    body.block(done)
    sine, cosine = (
        body.let(f"phi {v.real} [ {a}, %{near} ], [ {b}, %{far} ]")
        for a, b in zip(from_near, from_far, strict=True)
    )
    return sine, cosine


def _far_sincos(body: Body, width: int) -> None:
    """Write a rarely called function for the library's sines and cosines."""
    real = f"<{width} x double>"
    pair = f"{{ {real}, {real} }}"
    with body.function(f"define internal {pair} @nf_far{width}({real} %x) noinline cold"):
        found = "poison"
        for i, op in enumerate(("sin", "cos")):
            values = body.each(op, [f"{real} %x"], width)
            found = body.let(f"insertvalue {pair} {found}, {real} {values}, {i}")
        body.run(f"ret {pair} {found}")


def _halving(v: _Vectors, x: str) -> tuple[str, str]:
    """exp(x) as (1 + fraction) times a power of two."""
    t = v.mul_add(x, 1.4426950408889634, _ROUND)
    n = v.sub(t, _ROUND)
    r = v.mul_add(n, -1.9082149292705877e-10, v.mul_add(n, -0.6931471803691238, x))
    p = v.polynomial(r, _EXP_SERIES)
    power = v.bitwise("shl", v.bitwise("add", v.as_bits(t), 1023), 52)
    return v.mul_add(v.mul(r, r), p, r), v.as_real(power)


def _near(v: _Vectors, x: str) -> tuple[str, str]:
    t = v.mul_add(x, 0.6366197723675814, _ROUND)
    n = v.sub(t, _ROUND)
    r = v.mul_add(n, -6.077100506303966e-11, v.mul_add(n, -1.5707963267341256, x))
    r = v.mul_add(n, -2.0222662487959506e-21, r)
    z = v.mul(r, r)
    sine = v.as_bits(v.mul_add(v.mul(r, z), v.polynomial(z, _SIN_SERIES), r))
    w = v.mul_add(z, -0.5, 1.0)
    rest = v.mul_add(z, -0.5, v.sub(1.0, w))
    tail = v.mul_add(v.mul(z, z), v.polynomial(z, _COS_SERIES), rest)
    cosine = v.as_bits(v.add(w, tail))
    turns = v.as_bits(t)
    zero = v.bitwise("xor", turns, turns)
    odd = v.bitwise("sub", zero, v.bitwise("and", turns, 1))
    swap = v.bitwise("and", v.bitwise("xor", sine, cosine), odd)

    def turned(value: str, turns: str) -> str:
        sign = v.bitwise("shl", v.bitwise("and", turns, 2), 62)
        return v.as_real(v.bitwise("xor", v.bitwise("xor", value, swap), sign))

    return turned(sine, turns), turned(cosine, v.bitwise("add", turns, 1))

"""exp, tanh, sin and cos of whole vectors, as LLVM IR.

These functions take most of a rollout's time, and the C library computes them one number at a time.
Here polynomials are evaluated by Estrin's scheme, whose short chains of dependent operations suit
a step that waits for each of its stages. Errors stay below 3 units in the last place; NaN and
infinity behave as in the library; sin and cos of arguments beyond 1e5 are the library's.

References:
    Argument reduction by a constant in several exact parts: W. J. Cody and W. Waite, Software
    Manual for the Elementary Functions, 1980. The polynomials are Taylor's.
"""

from collections.abc import Sequence
from math import factorial
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from nfriction.codegen.llvm.body import Body

_EXP = [1.0 / factorial(k) for k in range(2, 14)]
_SIN = [(-1.0) ** k / factorial(2 * k + 1) for k in range(1, 9)]
_COS = [(-1.0) ** k / factorial(2 * k) for k in range(2, 9)]

# Adding 1.5 * 2^52 rounds to an integer, which is then in the lowest bits.
_ROUND = 6755399441055744.0


class _Vectors:
    """Arithmetic on vectors of one width; numbers are repeated."""

    def __init__(self, body: "Body", width: int) -> None:
        self.body = body
        self.width = width
        self.real = f"<{width} x double>"
        self.bits = f"<{width} x i64>"

    def _operand(self, x: str | float) -> str:
        return x if isinstance(x, str) else self.body.constant(x, self.width)

    def _two(self, op: str, a: str | float, b: str | float) -> str:
        return self.body.let(f"{op} {self.real} {self._operand(a)}, {self._operand(b)}")

    def add(self, a: str | float, b: str | float) -> str:
        return self._two("fadd", a, b)

    def sub(self, a: str | float, b: str | float) -> str:
        return self._two("fsub", a, b)

    def mul(self, a: str | float, b: str | float) -> str:
        return self._two("fmul", a, b)

    def div(self, a: str | float, b: str | float) -> str:
        return self._two("fdiv", a, b)

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
        """Estrin's scheme; coefficients of rising powers."""
        terms: list[str | float] = list(coefficients)
        power = x
        while len(terms) > 1:
            pairs = zip(terms[::2], terms[1::2], strict=False)
            raised: list[str | float] = [self.mul_add(b, power, a) for a, b in pairs]
            terms = raised + terms[len(terms) - len(terms) % 2 :]
            power = self.mul(power, power) if len(terms) > 1 else power
        return self._operand(terms[0])


def exp(body: "Body", x: str, width: int) -> str:
    v = _Vectors(body, width)
    # NaN compares false and so stays.
    x = v.where(x, "ogt", 709.5, 709.5, v.where(x, "olt", -708.0, -708.0, x))
    fraction, power = _halving(v, x)
    return v.mul(v.add(fraction, 1.0), power)


def tanh(body: "Body", x: str, width: int) -> str:
    v = _Vectors(body, width)
    bits = v.as_bits(x)
    sign = v.bitwise("and", bits, -(2**63))
    size = v.as_real(v.bitwise("xor", bits, sign))
    fraction, power = _halving(v, v.where(size, "ogt", 20.0, 40.0, v.mul(size, 2.0)))
    e = v.mul_add(power, fraction, v.sub(power, 1.0))  # exp(2 x) - 1 without cancellation
    ratio = v.div(e, v.add(e, 2.0))
    return v.as_real(v.bitwise("xor", v.as_bits(ratio), sign))


def sincos(body: "Body", x: str, width: int) -> tuple[str, str]:
    v = _Vectors(body, width)
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


def far_sincos(body: "Body", width: int) -> None:
    """A function of the library's sines and cosines, seldom called."""
    real = f"<{width} x double>"
    pair = f"{{ {real}, {real} }}"
    with body.function(f"define internal {pair} @nf_far{width}({real} %x) noinline cold"):
        found = "poison"
        for i, op in enumerate(("sin", "cos")):
            values = body.each(op, [f"{real} %x"], width)
            found = body.let(f"insertvalue {pair} {found}, {real} {values}, {i}")
        body.run(f"ret {pair} {found}")


def _halving(v: _Vectors, x: str) -> tuple[str, str]:
    """exp(x) as 1 + fraction times a power of two."""
    t = v.mul_add(x, 1.4426950408889634, _ROUND)
    n = v.sub(t, _ROUND)
    r = v.mul_add(n, -1.9082149292705877e-10, v.mul_add(n, -0.6931471803691238, x))
    p = v.polynomial(r, _EXP)
    power = v.bitwise("shl", v.bitwise("add", v.as_bits(t), 1023), 52)
    return v.mul_add(v.mul(r, r), p, r), v.as_real(power)


def _near(v: _Vectors, x: str) -> tuple[str, str]:
    t = v.mul_add(x, 0.6366197723675814, _ROUND)
    n = v.sub(t, _ROUND)
    r = v.mul_add(n, -6.077100506303966e-11, v.mul_add(n, -1.5707963267341256, x))
    r = v.mul_add(n, -2.0222662487959506e-21, r)
    z = v.mul(r, r)
    sine = v.as_bits(v.mul_add(v.mul(r, z), v.polynomial(z, _SIN), r))
    w = v.mul_add(z, -0.5, 1.0)
    rest = v.mul_add(z, -0.5, v.sub(1.0, w))
    tail = v.mul_add(v.mul(z, z), v.polynomial(z, _COS), rest)
    cosine = v.as_bits(v.add(w, tail))
    turns = v.as_bits(t)
    zero = v.bitwise("xor", turns, turns)
    odd = v.bitwise("sub", zero, v.bitwise("and", turns, 1))
    swap = v.bitwise("and", v.bitwise("xor", sine, cosine), odd)

    def turned(value: str, turns: str) -> str:
        sign = v.bitwise("shl", v.bitwise("and", turns, 2), 62)
        return v.as_real(v.bitwise("xor", v.bitwise("xor", value, swap), sign))

    return turned(sine, turns), turned(cosine, v.bitwise("add", turns, 1))

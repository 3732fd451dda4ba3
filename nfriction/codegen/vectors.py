"""sin, cos, exp and tanh four at a time, for the Python that numba compiles.

The same formulas, accuracy and limits as the C of `lanes`, written as LLVM instructions on vectors
of four: numba calls the functions of `math` one by one. Imported by emitted code alone.
"""

from collections.abc import Callable, Sequence
from typing import Any

from llvmlite import ir  # type: ignore[import-untyped]

from nfriction.codegen.lanes import COS, EXP, SIN, WIDTH
from nfriction.codegen.straight import Value, builder_of, code_of

_REAL = ir.VectorType(ir.DoubleType(), WIDTH)
_BITS = ir.VectorType(ir.IntType(64), WIDTH)
_LANES = [ir.Constant(ir.IntType(32), i) for i in range(WIDTH)]
_ROUND = 6755399441055744.0  # adding it rounds to an integer, which stands in the lowest bits


class _Vectors:
    """Arithmetic on vectors; numbers stand for vectors of them."""

    def __init__(self, builder: Any) -> None:
        self.builder = builder

    def of(self, x: Any) -> Any:
        return ir.Constant(_REAL, [x] * WIDTH) if isinstance(x, float) else x

    def bits(self, x: Any) -> Any:
        if isinstance(x, int):
            return ir.Constant(_BITS, [x] * WIDTH)
        return self.builder.bitcast(x, _BITS)

    def real(self, bits: Any) -> Any:
        return self.builder.bitcast(bits, _REAL)

    def add(self, a: Any, b: Any) -> Any:
        return self.builder.fadd(self.of(a), self.of(b), ("contract",))

    def sub(self, a: Any, b: Any) -> Any:
        return self.builder.fsub(self.of(a), self.of(b), ("contract",))

    def mul(self, a: Any, b: Any) -> Any:
        return self.builder.fmul(self.of(a), self.of(b), ("contract",))

    def where(self, a: Any, sign: str, b: Any, then: Any, otherwise: Any) -> Any:
        condition = self.builder.fcmp_ordered(sign, self.of(a), self.of(b))
        return self.builder.select(condition, self.of(then), self.of(otherwise))

    def polynomial(self, x: Any, divisors: Sequence[str], top: float) -> Any:
        value: Any = 1.0 / top
        for divisor in divisors:
            value = self.add(self.mul(value, x), 1.0 / float(divisor))
        return value


def _halving(v: _Vectors, x: Any) -> tuple[Any, Any]:
    """exp(x) as 1 + fraction times a power of two."""
    t = v.add(v.mul(x, 1.4426950408889634), _ROUND)
    n = v.sub(t, _ROUND)
    r = v.sub(v.sub(x, v.mul(n, 0.6931471803691238)), v.mul(n, 1.9082149292705877e-10))
    p = v.polynomial(r, EXP, 6227020800.0)
    power = v.builder.shl(v.builder.add(v.bits(t), v.bits(1023)), v.bits(52))
    return v.add(r, v.mul(v.mul(r, r), p)), v.real(power)


def _exp(v: _Vectors, x: Any) -> list[Any]:
    # NaN compares false and so stays.
    x = v.where(x, ">", 709.5, 709.5, v.where(x, "<", -708.0, -708.0, x))
    fraction, power = _halving(v, x)
    return [v.mul(v.add(fraction, 1.0), power)]


def _tanh(v: _Vectors, x: Any) -> list[Any]:
    sign = v.builder.and_(v.bits(x), v.bits(-(2**63)))
    size = v.real(v.builder.xor(v.bits(x), sign))
    fraction, power = _halving(v, v.where(size, ">", 20.0, 40.0, v.mul(size, 2.0)))
    e = v.add(v.mul(power, fraction), v.sub(power, 1.0))  # exp(2 x) - 1 without cancellation
    ratio = v.builder.fdiv(e, v.add(e, 2.0))
    return [v.real(v.builder.xor(v.bits(ratio), sign))]


def _near(v: _Vectors, x: Any) -> list[Any]:
    b = v.builder
    t = v.add(v.mul(x, 0.6366197723675814), _ROUND)
    n = v.sub(t, _ROUND)
    r = v.sub(v.sub(x, v.mul(n, 1.5707963267341256)), v.mul(n, 6.077100506303966e-11))
    r = v.sub(r, v.mul(n, 2.0222662487959506e-21))
    z = v.mul(r, r)
    s = v.polynomial(z, SIN, 355687428096000.0)
    c = v.polynomial(z, COS, 20922789888000.0)
    sine = v.bits(v.add(r, v.mul(v.mul(r, z), s)))
    half = v.mul(z, 0.5)
    w = v.sub(1.0, half)
    cosine = v.bits(v.add(w, v.add(v.sub(v.sub(1.0, w), half), v.mul(v.mul(z, z), c))))
    turns = v.bits(t)
    odd = b.sub(v.bits(0), b.and_(turns, v.bits(1)))
    swap = b.and_(b.xor(sine, cosine), odd)

    def turned(value: Any, turns: Any) -> Any:
        sign = b.shl(b.and_(turns, v.bits(2)), v.bits(62))
        return v.real(b.xor(b.xor(value, swap), sign))

    return [turned(sine, turns), turned(cosine, b.add(turns, v.bits(1)))]


def _far(v: _Vectors, x: Any) -> list[Any]:
    """The C library's, one by one."""
    real, results = ir.DoubleType(), []
    for name in ("llvm.sin", "llvm.cos"):
        function = v.builder.module.declare_intrinsic(name, [real])
        results.append(x)
        for i in _LANES:
            one = v.builder.call(function, [v.builder.extract_element(x, i)])
            results[-1] = v.builder.insert_element(results[-1], one, i)
    return results


def _sincos(v: _Vectors, x: Any) -> list[Any]:
    b = v.builder
    size = v.real(b.and_(v.bits(x), v.bits(2**63 - 1)))
    every = ir.IntType(WIDTH)
    near = b.bitcast(b.fcmp_ordered("<", size, v.of(1e5)), every)
    found = []
    with b.if_else(b.icmp_unsigned("==", near, every(2**WIDTH - 1))) as branches:
        for branch, function in zip(branches, (_near, _far), strict=True):
            with branch:
                found.append((function(v, x), b.block))
    merged = [b.phi(_REAL), b.phi(_REAL)]
    for values, block in found:
        for phi, value in zip(merged, values, strict=True):
            phi.add_incoming(value, block)
    return merged


def _four(function: Callable[[_Vectors, Any], list[Any]]) -> Callable[..., tuple[Value, ...]]:
    """A function of four recorded numbers."""

    def call(*given: Any) -> tuple[Value, ...]:
        builder = builder_of(given)
        x = ir.Constant(_REAL, ir.Undefined)
        for i, one in zip(_LANES, given, strict=True):
            x = builder.insert_element(x, code_of(one), i)
        values = function(_Vectors(builder), x)
        return tuple(Value(builder, builder.extract_element(y, i)) for y in values for i in _LANES)

    return call


exp4, tanh4, sincos4 = map(_four, (_exp, _tanh, _sincos))

"""Emitted Python as LLVM instructions.

Functions without branches and loops need not be analysed: called with values that write down what
is done with them, they yield their instructions. numba, which works out the type of every
expression, takes ten times as long. What it compiles around them uses pointers for arrays, whose
bookkeeping is as dear as the arithmetic. Imported by emitted code alone.
"""

from collections.abc import Callable, Sequence
from functools import partial
from types import SimpleNamespace
from typing import Any

from llvmlite import ir  # type: ignore[import-untyped]
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

COUNT, REAL = types.intp, types.float64
COUNTS, REALS = types.CPointer(COUNT), types.CPointer(REAL)

_REAL, _TRUTH = ir.DoubleType(), ir.IntType(1)
_FUSED = ("contract",)


@intrinsic
def moved(typing: Any, pointer: Any, count: Any) -> Any:
    """The pointer to the element so many further on."""

    def code(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.gep(arguments[0], [arguments[1]])

    return pointer(pointer, COUNT), code


def code_of(x: Any) -> Any:
    """LLVM's value of a recorded one or a literal."""
    if isinstance(x, (Value, _Array)):
        return x.code
    return ir.Constant(_TRUTH if isinstance(x, bool) else _REAL, x)


def _real(builder: Any, x: Any) -> Any:
    """LLVM's value as a number: truth counts as one."""
    code = code_of(x)
    return builder.uitofp(code, _REAL) if code.type == _TRUTH else code


def _truth(builder: Any, x: Any) -> Any:
    """LLVM's value as a truth value: whatever is not zero is true, NaN too."""
    code = code_of(x)
    return code if code.type == _TRUTH else builder.fcmp_unordered("!=", code, _REAL(0.0))


def _operators(
    instruction: str, taken: Callable[..., Any], *flags: Any
) -> tuple[Callable[..., Any], Callable[..., Any]]:
    """An operator with the recorded value on its left, and on its right."""

    def apply(a: Any, b: Any, builder: Any) -> "Value":
        pair = (taken(builder, x) for x in (a, b))
        return Value(builder, getattr(builder, instruction)(*pair, *flags))

    return (
        lambda self, other: apply(self, other, self.builder),
        lambda self, other: apply(other, self, self.builder),
    )


def _comparison(sign: str) -> Callable[..., Any]:
    def compare(self: "Value", other: Any) -> "Value":
        b = self.builder
        test = b.fcmp_unordered if sign == "!=" else b.fcmp_ordered  # of NaN only that is true
        return Value(b, test(sign, _real(b, self), _real(b, other)))

    return compare


class Value:
    """A number or a truth value that records what is done with it."""

    def __init__(self, builder: Any, code: Any) -> None:
        self.builder = builder
        self.code = code

    __add__, __radd__ = _operators("fadd", _real, "", _FUSED)
    __sub__, __rsub__ = _operators("fsub", _real, "", _FUSED)
    __mul__, __rmul__ = _operators("fmul", _real, "", _FUSED)
    __truediv__, __rtruediv__ = _operators("fdiv", _real, "", _FUSED)
    __and__, __rand__ = _operators("and_", _truth)
    __or__, __ror__ = _operators("or_", _truth)
    __lt__, __le__, __gt__, __ge__ = map(_comparison, ("<", "<=", ">", ">="))
    __eq__, __ne__ = map(_comparison, ("==", "!="))
    __hash__ = None  # type: ignore[assignment]

    def __neg__(self) -> "Value":
        return Value(self.builder, self.builder.fneg(_real(self.builder, self)))

    def __invert__(self) -> "Value":
        return Value(self.builder, self.builder.not_(_truth(self.builder, self)))


class _Array:
    """A pointer whose elements are recorded."""

    def __init__(self, builder: Any, code: Any) -> None:
        self.builder = builder
        self.code = code

    def _at(self, index: int) -> Any:
        return self.builder.gep(self.code, [ir.Constant(ir.IntType(64), index)])

    def __getitem__(self, index: int) -> Value:
        return Value(self.builder, self.builder.load(self._at(index)))

    def __setitem__(self, index: int, value: Any) -> None:
        self.builder.store(_real(self.builder, value), self._at(index))


def builder_of(given: Sequence[Any]) -> Any:
    """Where the values of a call are recorded; literals alone are folded before."""
    return next(x.builder for x in given if isinstance(x, Value))


def _call(name: str, *given: Any) -> Value:
    """A function of LLVM or of the C library."""
    builder = builder_of(given)
    kind = ir.FunctionType(_REAL, [_REAL] * len(given))
    if name.startswith("llvm."):
        function = builder.module.declare_intrinsic(name, [_REAL], kind)
    else:
        known = builder.module.globals
        function = known[name] if name in known else ir.Function(builder.module, kind, name)
    return Value(builder, builder.call(function, [_real(builder, x) for x in given]))


def _where(condition: Any, a: Any, b: Any) -> Value:
    builder = builder_of((condition, a, b))
    taken = _truth if code_of(a).type == code_of(b).type == _TRUTH else _real
    pair = (taken(builder, x) for x in (a, b))
    return Value(builder, builder.select(_truth(builder, condition), *pair))


def _fmod(a: Any, b: Any) -> Value:
    builder = builder_of((a, b))
    return Value(builder, builder.frem(_real(builder, a), _real(builder, b)))


def _extreme(sign: str, a: Any, b: Any) -> Value:
    builder = builder_of((a, b))
    x, y = _real(builder, a), _real(builder, b)
    first = builder.fcmp_ordered(sign, x, y)
    missing = builder.fcmp_unordered("uno", x, x)  # NaN stays
    return Value(builder, builder.select(builder.or_(first, missing), x, y))


_OWN = ("sqrt", "exp", "log", "sin", "cos", "floor", "ceil", "trunc", "pow")
_LIBRARY = ("tan", "asin", "acos", "atan", "atan2", "sinh", "cosh", "tanh", "expm1", "log1p")

op = SimpleNamespace(
    **{name: partial(_call, f"llvm.{name}") for name in _OWN},
    **{name: partial(_call, name) for name in _LIBRARY},
    abs=partial(_call, "llvm.fabs"),
    max=partial(_extreme, ">"),
    min=partial(_extreme, "<"),
    fmod=_fmod,
    where=_where,
)
"""The operations that have no sign in Python."""


def straight(results: int) -> Callable[..., Any]:
    """Decorate a function of numbers and pointers that returns so many numbers, or None.

    Compiled code calls it by its name, other recorded functions through its attribute `within`.
    """
    returned = types.UniTuple(REAL, results) if results else types.none
    kind = ir.ArrayType(_REAL, results) if results else ir.VoidType()

    def decorate(function: Callable[..., Any]) -> Any:
        def invoke(builder: Any, arguments: Sequence[Any]) -> Any:
            name, known = function.__name__, builder.module.globals
            made = known[name] if name in known else _record(function, builder, arguments, kind)
            return builder.call(made, arguments)

        @intrinsic
        def call(typing: Any, *given: Any) -> Any:
            def code(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
                found = invoke(builder, cgutils.unpack_tuple(builder, arguments[0]))
                return found if results else context.get_dummy_value()

            return returned(types.StarArgTuple(given)), code

        def within(*given: Any) -> tuple[Value, ...]:
            builder = builder_of(given)
            found = invoke(builder, [code_of(x) for x in given])
            return tuple(Value(builder, builder.extract_value(found, i)) for i in range(results))

        call.within = within  # type: ignore[attr-defined]
        return call

    return decorate


def _record(function: Callable[..., Any], caller: Any, arguments: Any, kind: Any) -> Any:
    """The function in the caller's module."""
    types_ = [a.type for a in arguments]
    made = ir.Function(caller.module, ir.FunctionType(kind, types_), function.__name__)
    made.linkage = "internal"
    builder = ir.IRBuilder(made.append_basic_block())
    found = function(*((_Array if a.type.is_pointer else Value)(builder, a) for a in made.args))
    if found is None:
        builder.ret_void()
    else:
        values = ir.Constant(kind, ir.Undefined)
        for i, value in enumerate(found):
            values = builder.insert_value(values, _real(builder, value), i)
        builder.ret(values)
    return made

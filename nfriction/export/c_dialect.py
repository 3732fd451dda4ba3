"""C89 that is C++ as well: literals, functions of `math.h`, and tests by the bits."""

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from nfriction.codegen.emit import C, Real

# What the math.h of C89 has; the rest, and every function in single precision, came with C99.
_C89 = frozenset(
    ("acos", "asin", "atan", "atan2", "ceil", "cos", "cosh", "exp", "fabs", "floor", "fmod", "log",
     "pow", "sin", "sinh", "sqrt", "tan", "tanh")
)  # fmt: skip
_TWO_ARGUMENTS = frozenset({"atan2", "fmod", "pow"})
_LARGEST = {"double": float(np.finfo(np.float64).max), "float": float(np.finfo(np.float32).max)}


@dataclass(frozen=True)
class ControllerC(C):
    """The dialect of exported C.

    Attributes:
        prefix: of every name in the file.
        used: functions that the emitted text calls, filled as it is written.
    """

    prefix: str = "nf"
    used: set[str] = field(default_factory=set)

    def literal(self, value: float | bool) -> str:
        if not isinstance(value, bool):
            if math.isnan(value):
                raise ValueError("NaN among the numbers of a model; check its parameters.")
            # C89 has no infinity. Emitted code sees finite numbers only, on which comparisons
            # with the largest one come out the same.
            largest = _LARGEST[self.real]
            value = min(max(float(value), -largest), largest)
        return super().literal(value)

    def call(self, op: str, args: Sequence[str]) -> str:
        if op in ("max", "min"):
            self.used.add(op)
            return f"{self.prefix}_{op}({', '.join(args)})"
        if op == "finite":
            return f"{self.prefix}_finite(&{args[0]})"
        if op == "abs" and self.real == "float":
            self.used.add("abs")  # fabsf came with C99: a compiler of C89 would call it
            return f"{self.prefix}_abs({args[0]})"
        name = {"abs": "fabs"}.get(op, op) + ("f" if self.real == "float" else "")
        self.used.add(name)
        return f"{name}({', '.join(args)})"

    def array_exp(self, less: float) -> str:
        """A call of `c_exp.exponential` on `{array}` of `{count}`."""
        self.used.add("array_exp")
        return f"{self.prefix}_exp({{array}}, {{count}}, {self.literal(less)});"

    def functions(self) -> str:
        """Prototypes that C89 lacks, and the maximum and minimum where they are used."""
        single = "f" if self.real == "float" else ""
        late = sorted(f for f in self.used - {"abs", "max", "min", "array_exp"} if f not in _C89)
        parts = []
        if late:
            two = {name + single for name in _TWO_ARGUMENTS}
            lines = [
                f"extern {self.real} {f}({self.real}{f', {self.real}' if f in two else ''});"
                for f in late
            ]
            parts.append(
                "/* Compilers of C89 may have these in their library but not in math.h. */\n"
                "#if !defined(__cplusplus) && "
                "(!defined(__STDC_VERSION__) || __STDC_VERSION__ < 199901L)\n"
                + "\n".join(lines)
                + "\n#endif\n"
            )
        for op, sign in (("max", ">"), ("min", "<")):
            if op in self.used:
                parts.append(
                    f"static {self.real} {self.prefix}_{op}({self.real} a, {self.real} b)\n"
                    f"{{\n    return a {sign} b ? a : b;\n}}\n"
                )
        if "abs" in self.used:
            parts.append(
                f"static {self.real} {self.prefix}_abs({self.real} a)\n"
                "{\n    return a > 0 ? a : 0 - a;\n}\n"
            )
        return "\n".join(parts)


def bits(prefix: str, real: Real) -> str:
    """Functions that test for NaN and infinity and write NaN by the bits.

    Comparisons would not do: `-ffast-math` lets a compiler assume that every number is finite.
    Words and numbers share the order of their bytes; which word of a double comes first is asked
    of the number 1, so any byte order will do.
    """
    words = 1 if real == "float" else 2
    high = "0" if real == "float" else f"{prefix}_high()"
    asked = (
        ""
        if real == "float"
        else f"""
/* Which of the two words of a double holds its exponent. */
static int {prefix}_high(void)
{{
    const double one = 1.0;
    {prefix}_word words[2];
    memcpy(words, &one, sizeof words);
    return words[0] == 0 ? 1 : 0;
}}
"""
    )
    exponent, quiet = ("0x7F800000", "0x7FC00000") if real == "float" else ("0x7FF00000",
                                                                          "0x7FF80000")  # fmt: skip
    clear = "" if real == "float" else f"    words[1 - {high}] = 0;\n"
    return f"""/* A word of 32 bits; the build stops where {real} has not {32 * words}. */
#if UINT_MAX == 0xFFFFFFFFUL
typedef unsigned int {prefix}_word;
#else
typedef unsigned long {prefix}_word;
#endif
typedef char {prefix}_{real}_has_{32 * words}_bits[
    sizeof({real}) == {words} * sizeof({prefix}_word) ? 1 : -1];
{asked}
static int {prefix}_finite(const {real} *x)
{{
    {prefix}_word words[{words}];
    memcpy(words, x, sizeof words);
    return (words[{high}] & {exponent}UL) != {exponent}UL;
}}

static void {prefix}_fill_nan({real} *x, int count)
{{
    {prefix}_word words[{words}];
    int i;
    words[{high}] = {quiet}UL;
{clear}    for (i = 0; i < count; ++i)
        memcpy(x + i, words, sizeof words);
}}
"""


def table(name: str, real: Real, rows: np.ndarray, dialect: C) -> str:
    """A `static const` array of rows; empty where there are no columns."""
    if not rows.size:
        return ""
    count, columns = rows.shape
    body = ",\n".join(
        "    {\n        " + _wrapped([dialect.literal(float(x)) for x in row]) + "\n    }"
        for row in rows
    )
    return f"static const {real} {name}[{count}][{columns}] = {{\n{body}\n}};\n"


def array(name: str, kind: str, values: Sequence[str]) -> str:
    """A `static const` array."""
    return f"static const {kind} {name}[{len(values)}] = {{\n    {_wrapped(values, 4)}\n}};\n"


def _wrapped(literals: Sequence[str], indent: int = 8) -> str:
    lines = [", ".join(literals[i : i + 4]) for i in range(0, len(literals), 4)]
    return (",\n" + " " * indent).join(lines)


def comment(text: str) -> str:
    """Foreign text for the inside of a C comment: it can neither end it nor continue a line."""
    # Question marks could be trigraphs, of which one is a backslash.
    plain = "".join(c if " " <= c <= "~" and c not in "?\\" else "." for c in text)
    return plain.replace("*/", "* /").replace("/*", "/ *")


def is_identifier(name: str) -> bool:
    """Whether a name is one of C, and none that the language has taken."""
    return re.fullmatch(r"[A-Za-z][A-Za-z0-9_]{0,30}", name) is not None and name not in _TAKEN


# Of C and C++ up to C++17.
_TAKEN_WORDS = """
    alignas alignof and and_eq asm auto bitand bitor bool break case catch char class compl const
    const_cast constexpr continue decltype default delete do double dynamic_cast else enum explicit
    export extern false float for friend goto if inline int long mutable namespace new noexcept not
    not_eq nullptr operator or or_eq private protected public register reinterpret_cast return short
    signed sizeof static static_assert static_cast struct switch template this thread_local throw
    true try typedef typeid typename union unsigned using virtual void volatile wchar_t while xor
    xor_eq main
"""
_TAKEN = frozenset(re.findall(r"\w+", _TAKEN_WORDS))

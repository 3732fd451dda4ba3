"""C89 that is also C++: literals, tables, templates, and scalar nodes as expressions.

Values used once are written where they are used, the others become constants of the function.
The text depends only on the graph, so the same model gives the same bytes.
"""

import math
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib import resources
from typing import Any, Literal

import jinja2
import numpy as np

from nfriction.codegen.scalar import Node, is_predicate, reachable

Real = Literal["double", "float"]

# Functions of C89's math.h; others, and all single-precision ones, came with C99.
_C89 = frozenset(
    ("acos", "asin", "atan", "atan2", "ceil", "cos", "cosh", "exp", "fabs", "floor", "fmod", "log",
     "pow", "sin", "sinh", "sqrt", "tan", "tanh")
)  # fmt: skip
_C99 = frozenset({"expm1", "log1p", "trunc"})
_TWO_ARGUMENTS = frozenset({"atan2", "fmod", "pow"})
_LARGEST = {"double": float(np.finfo(np.float64).max), "float": float(np.finfo(np.float32).max)}
# Helpers by name: arguments and value.
_HELPERS = {
    "nf_max": ("REAL a, REAL b", "a > b ? a : b"),
    "nf_min": ("REAL a, REAL b", "a < b ? a : b"),
    # With a comparison, because fabsf came with C99 but compilers of C89 would call it.
    "nf_abs": ("REAL a", "a > -a ? a : -a"),
    "nf_clamp": ("REAL x, REAL low, REAL high", "x < low ? low : x > high ? high : x"),
    "nf_square": ("REAL a", "a * a"),
}


@dataclass(frozen=True)
class ControllerC:
    """The dialect of exported C."""

    real: Real = "double"  # type of all numbers
    prefix: str = "nfriction"  # of every name in the file, for which templates write `nf`
    templates: tuple[str, ...] = ("nfriction.export", "templates")  # package, folders in it

    def literal(self, value: float | bool) -> str:
        """A number in C, in brackets if it is negative."""
        if isinstance(value, bool):
            return "1" if value else "0"
        if math.isnan(value):
            raise ValueError("NaN among the numbers of a model; check its parameters.")
        # C89 has no infinity. Emitted code gets only finite numbers, for which comparisons with
        # the largest one have the same result.
        largest = _LARGEST[self.real]
        value = min(max(float(value), -largest), largest)
        single = self.real == "float"
        text = f"{np.float32(value)!s}f" if single else repr(value)
        return f"({text})" if text.startswith("-") else text

    def call(self, op: str, args: Sequence[str]) -> str:
        own = op in ("max", "min") or (op == "abs" and self.real == "float")
        name = f"{self.prefix}_{op}" if own else {"abs": "fabs"}.get(op, op) + self.suffix
        return f"{name}({', '.join(args)})"

    @property
    def suffix(self) -> str:
        """Ending of the functions of `math.h` for this type."""
        return "f" if self.real == "float" else ""

    def table(self, name: str, values: Any, *sizes: int | str) -> str:
        """A `static const` array whose sizes are numbers or names of macros."""
        spelled = "".join(f"[{n if isinstance(n, int) else f'NF_{n}'}]" for n in sizes)
        head = self.own(f"static const REAL NF_{name.upper()}{spelled}")
        return f"{head} = {self._initialiser(values, 4)};"

    def _initialiser(self, values: Any, indent: int) -> str:
        array = np.asarray(values, dtype=np.float64)
        if array.ndim == 1:
            return f"{{{', '.join(self.literal(x).strip('()') for x in array.tolist())}}}"
        rows = [self._initialiser(row, indent + 4) for row in array]
        inline = f"{{{', '.join(rows)}}}"
        if len(inline) + indent < 100 and "\n" not in inline:
            return inline
        pad = "\n" + indent * " "
        return "{" + pad + _filled(rows, 100 - indent, pad) + "\n" + (indent - 4) * " " + "}"

    def text(self, template: str, **words: Any) -> str:
        """A template with its words filled in."""
        single = self.real == "float"
        given = {
            "real": self.real, "number": self.literal, "prefix": self.prefix,
            "words": 1 if single else 2,
            "high": "0" if single else self.own("nf_high()"),
            "exponent": "0x7F800000" if single else "0x7FF00000",
            "quiet": "0x7FC00000" if single else "0x7FF80000",
        }  # fmt: skip
        return _templates(self).get_template(template).render({**given, **words})

    def own(self, text: str) -> str:
        """Text of a template in this type, with this prefix."""
        text = re.sub(r"\breal_abs\(", "nf_abs(" if self.real == "float" else "fabs(", text)
        text = re.sub(r"\breal_(\w+)\(", rf"\1{self.suffix}(", text)
        text = re.sub(r"\bREAL\b", self.real, text)
        text = re.sub(r"\bnf_", f"{self.prefix}_", text)
        return re.sub(r"\bNF_", f"{self.prefix.upper()}_", text)

    def functions(self, text: str) -> str:
        """Prototypes that C89 lacks, and helpers, if `text` calls them."""
        single = bool(self.suffix)
        called = set(re.findall(r"\b(\w+)\(", text))
        late = [
            f"extern {self.real} {f}{self.suffix}({self.real}"
            f"{f', {self.real}' if f in _TWO_ARGUMENTS else ''});"
            for f in sorted(_C89 | _C99)
            if f + self.suffix in called and (single or f in _C99)
        ]
        parts = []
        if late:
            parts.append(
                "/* Compilers of C89 may have these in their library but not in math.h. */\n"
                "#if !defined(__cplusplus) && "
                "(!defined(__STDC_VERSION__) || __STDC_VERSION__ < 199901L)\n"
                + "\n".join(late)
                + "\n#endif\n"
            )
        parts += [
            self.own(f"static REAL {name}({arguments})\n{{\n    return {value};\n}}\n")
            for name, (arguments, value) in _HELPERS.items()
            if self.own(name) in called
        ]
        return "\n".join(parts)


@cache
def _templates(dialect: ControllerC) -> jinja2.Environment:
    package, *inside = dialect.templates
    folder = resources.files(package).joinpath(*inside)

    def load(name: str) -> str:
        return dialect.own(folder.joinpath(name).read_text("ascii"))

    return jinja2.Environment(
        loader=jinja2.FunctionLoader(load), undefined=jinja2.StrictUndefined,
        trim_blocks=True, lstrip_blocks=True, keep_trailing_newline=True,
    )  # fmt: skip


def _filled(parts: Sequence[str], width: int, pad: str) -> str:
    """Parts with commas between them, as many per line as fit."""
    lines: list[str] = []
    for part in parts:
        fits = bool(lines) and "\n" not in part and "\n" not in lines[-1]
        if fits and len(lines[-1]) + len(part) + 2 <= width:
            lines[-1] += f", {part}"
        else:
            lines.append(part)
    return f",{pad}".join(lines)


def comment(text: str) -> str:
    """Untrusted text for a C comment, which it can neither end nor continue over a line."""
    # Question marks could be trigraphs, of which one is a backslash.
    plain = "".join(c if " " <= c <= "~" and c not in "?\\" else "." for c in text)
    return plain.replace("*/", "* /").replace("/*", "/ *")


def is_identifier(name: str) -> bool:
    """True for a C identifier that is not a keyword."""
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

_INLINE = 64  # characters; longer single-use values get their own line

# How tightly an operator binds; an atom or a call binds tightest.
ATOM, _UNARY, _PRODUCT, _SUM, _COMPARE, _NOT, _AND, _OR = 9, 8, 7, 6, 5, 4, 3, 2
_INFIX = {
    "add": ("+", _SUM),
    "sub": ("-", _SUM),
    "mul": ("*", _PRODUCT),
    "div": ("/", _PRODUCT),
    "lt": ("<", _COMPARE),
    "le": ("<=", _COMPARE),
    "eq": ("==", _COMPARE),
    "ne": ("!=", _COMPARE),
}


def statements(
    outputs: Sequence[Node], bound: Mapping[int, str], dialect: ControllerC
) -> tuple[list[str], list[str]]:
    """Definitions of local values, and one expression per output.

    `bound` has the text of available nodes (inputs, hoisted values), by node number.
    """
    nodes = reachable(outputs, bound)
    uses = Counter(a.number for node in nodes if node.number not in bound for a in node.args)
    uses.update(node.number for node in outputs)
    lines: list[str] = []
    texts: dict[int, tuple[str, int]] = {}
    for node in nodes:
        if node.number in bound:
            texts[node.number] = bound[node.number], ATOM
        elif node.op == "constant":
            texts[node.number] = dialect.literal(node.value), ATOM
        elif node.op == "input":
            raise AssertionError(f"input {node.value} has no name here")
        else:
            text, binding = expression(node.op, [texts[a.number] for a in node.args], dialect)
            if uses[node.number] > 1 or len(text) > _INLINE:
                name = f"t{len(lines)}"
                kind = "int" if is_predicate(node) else dialect.real
                lines.append(f"const {kind} {name} = {text};")
                text, binding = name, ATOM
            texts[node.number] = text, binding
    return lines, [texts[node.number][0] for node in outputs]


def expression(
    op: str, operands: Sequence[tuple[str, int]], dialect: ControllerC
) -> tuple[str, int]:
    """Text of an operation and its binding strength, from those of its operands."""

    def operand(i: int, binding: int) -> str:
        text, own = operands[i]
        return text if own >= binding else f"({text})"

    if op in _INFIX:
        sign, binding = _INFIX[op]
        # Compilers warn of comparisons side by side.
        left = operand(0, binding + (binding == _COMPARE))
        return f"{left} {sign} {operand(1, binding + 1)}", binding
    if op == "neg":
        return f"-{operand(0, ATOM)}", _UNARY
    if op == "not":
        return f"!{operand(0, ATOM)}", _NOT
    if op in ("and", "or"):
        sides = [operand(i, ATOM) for i in range(len(operands))]
        return (" && ".join(sides), _AND) if op == "and" else (" || ".join(sides), _OR)
    if op == "where":
        condition, a, b = (operand(i, _SUM) for i in range(3))
        return f"({condition} ? {a} : {b})", ATOM
    return dialect.call(op, [text for text, _ in operands]), ATOM

"""An exponential in C that compilers vectorise, for arguments of which a model has many.

The exponential of `math.h` is a call for every number. This one is a loop over an array without
branches or tables: x = k ln 2 + r, a polynomial in r, and 2^k by the bits of a float.
"""

from collections.abc import Sequence

from nfriction.codegen.emit import C, Real
from nfriction.codegen.finite import rebuilt
from nfriction.codegen.scalar import Graph, Node

# Arguments it takes. Below -87.3 the result is 0; further down k would not fit its integer, and
# above zero it would be rounded to the wrong side, which a rounding may come to.
LEAST, LARGEST = -1e9, 0.1
# What it takes off, by operation.
LESS = {"exp": 0.0, "expm1": 1.0}
# Beyond half of this exp(x) - 1 is -1 and tanh is 1, in double and in single precision.
_SATURATED = -40.0

# Of (exp(r) - 1) / r for |r| <= ln(2) / 2, minimax; relative errors of exp(r) are below 4e-18 and
# 2e-9, beside the roundings of what is computed with them.
_COEFFICIENTS: dict[Real, tuple[float, ...]] = {
    "double": (1.0, 0.5000000000000012, 0.16666666666666222, 0.0416666666665181,
               0.008333333333548278, 0.0013888888946297076, 0.0001984126943904723,
               2.480149068146982e-05, 2.755762504761142e-06, 2.763102156119972e-07,
               2.4991890031105645e-08),
    "float": (1.0, 0.49999994, 0.16666432, 0.041667998, 0.008374143, 0.0013843952),
}  # fmt: skip
# ln 2 as a number of few bits, whose products with k are exact, and the rest.
_LN2: dict[Real, tuple[float, float]] = {
    "double": (0.693145751953125, 1.4286068203094173e-06),
    "float": (0.693359375, -0.00021219444),
}


def exponential(prefix: str, real: Real) -> str:
    """`{prefix}_exp(x, count, less)`: exp(x) - less in place, for numbers of LEAST to LARGEST.

    With less = 1 small numbers keep their digits. NaN stays NaN. It needs `{prefix}_word` of
    `c_dialect.bits`.
    """
    dialect = C(real)
    high, low = map(dialect.literal, _LN2[real])
    one, half = map(dialect.literal, (1.4426950408889634, 0.5))
    check = (
        ""
        if real == "float"
        else f"typedef char {prefix}_float_has_32_bits"
        f"[sizeof(float) == sizeof({prefix}_word) ? 1 : -1];\n"
    )
    return f"""#if UINT_MAX == 0xFFFFFFFFUL
typedef int {prefix}_whole;
#else
typedef long {prefix}_whole;
#endif
{check}
/* exp(x) - less of numbers <= 0, in place; without branches, so that compilers vectorise it. */
static void {prefix}_exp({real} *x, int count, {real} less)
{{
    int i;
    for (i = 0; i < count; ++i) {{
        const {prefix}_whole k = ({prefix}_whole)(x[i] * {one} - {half});
        const {real} t = ({real})k, r = (x[i] - t * {high}) - t * {low}, s = r * r;
        const {real} p =
            {_pairs([dialect.literal(c) for c in _COEFFICIENTS[real]])};
        /* 2^k as a float; 0 where that is too small for one. */
        const {prefix}_word word =
            (({prefix}_word)(k + 127) & (0 - ({prefix}_word)(k > -127))) << 23;
        float power;
        memcpy(&power, &word, sizeof power);
        {{
            const {real} scale = ({real})power;
            x[i] = scale * (r * p) + (scale - less);
        }}
    }}
}}
"""


def _pairs(literals: list[str]) -> str:
    """A polynomial in r by pairs of terms, of s = r^2: half as long a chain as Horner's."""
    pairs = [
        f"({literals[i]} + r * {literals[i + 1]})" if i + 1 < len(literals) else literals[i]
        for i in range(0, len(literals), 2)
    ]
    text = pairs[-1]
    for pair in reversed(pairs[:-1]):
        text = f"{pair} + s * ({text})" if " " in text else f"{pair} + s * {text}"
    return text


def by_exponentials(graph: Graph, nodes: Sequence[Node]) -> list[Node]:
    """`nodes` with every tanh by this exponential: -e / (e + 2) with e = exp(-2 |x|) - 1.

    The tanh of `math.h` takes another branch for another size of its argument, which costs where
    that is not foreseen.
    """

    def rule(node: Node, args: tuple[Node, ...]) -> Node | None:
        if node.op != "tanh":
            return None
        (x,) = args
        size = graph.apply("mul", graph.constant(-2.0), graph.apply("abs", x))
        e = graph.apply("expm1", graph.apply("max", graph.constant(_SATURATED), size))
        ratio = graph.apply("div", e, graph.apply("add", e, graph.constant(2.0)))
        negative = graph.apply("lt", x, graph.constant(0.0))
        return graph.apply("where", negative, ratio, graph.apply("neg", ratio))

    return rebuilt(graph, nodes, rule)

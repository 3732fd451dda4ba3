"""sin, cos, exp and tanh four at a time, in C.

In a rollout these functions take most of the time, and the C library computes them one by one.
Calls that do not wait for each other are therefore collected into lanes of four, for which the
compiler makes vector instructions out of plain loops (the functions must not be inlined: unrolled
they stay scalar). Errors stay below 3 units in the last place; NaN and infinity behave as in the
library; arguments of sin and cos beyond 1e5 go to the library.

References:
    Argument reduction by a constant in several exact parts: W. J. Cody and W. Waite, Software
    Manual for the Elementary Functions, 1980. The polynomials are Taylor's.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from nfriction.codegen.scalar import Node

WIDTH = 4
FAMILY = {"sin": "sincos", "cos": "sincos", "exp": "exp", "tanh": "tanh"}
"""Operations that are collected, by the function that serves them."""


def phases(nodes: Sequence[Node], bound: Mapping[int, str]) -> dict[int, int]:
    """How many collected calls have to come before each node, by node number."""
    phase: dict[int, int] = {}
    for node in nodes:
        if node.number in bound or not node.args:
            phase[node.number] = 0
        else:
            phase[node.number] = max(
                phase[a.number] + (a.op in FAMILY and a.number not in bound) for a in node.args
            )
    return phase


@dataclass(frozen=True)
class Call:
    """Statements of a collected call, and where each argument's results are found."""

    lines: list[str]
    results: list[str]
    cosines: list[str]


def call(family: str, serial: int, arguments: Sequence[str]) -> Call:
    """A collected call in C, through arrays of its own."""
    filled = [*arguments, *["0.0"] * (-len(arguments) % WIDTH)]
    pair = family == "sincos"
    sines, cosines = f"g{serial}", f"g{serial}c"
    lines = [f"double {sines}[{len(filled)}]{f', {cosines}[{len(filled)}]' if pair else ''};"]
    lines += [f"{sines}[{i}] = {text};" for i, text in enumerate(filled)]
    for i in range(0, len(filled), WIDTH):
        lines.append(f"nf_{family}4({sines} + {i}{f', {cosines} + {i}' if pair else ''});")
    count = range(len(arguments))
    return Call(lines, [f"{sines}[{i}]" for i in count], [f"{cosines}[{i}]" for i in count])


def _horner(target: str, variable: str, coefficients: Sequence[str]) -> str:
    return "\n".join(f"        {target} = {target} * {variable} + {c};" for c in coefficients)


EXP = ["479001600.0", "39916800.0", "3628800.0", "362880.0", "40320.0", "5040.0", "720.0",
        "120.0", "24.0", "6.0", "2.0"]  # fmt: skip
SIN = ["-1307674368000.0", "6227020800.0", "-39916800.0", "362880.0", "-5040.0", "120.0", "-6.0"]
COS = ["-87178291200.0", "479001600.0", "-3628800.0", "40320.0", "-720.0", "24.0"]

PRELUDE = f"""
#include <stdint.h>
#include <string.h>

#if defined(__GNUC__)
#define NF_LANES __attribute__((noinline)) static
#define NF_APART __restrict
#else
#define NF_LANES static
#define NF_APART
#endif

/* Adding 1.5 * 2^52 rounds to an integer, which then stands in the lowest bits. */
#define NF_ROUND 6755399441055744.0

NF_LANES void nf_exp4(double *x)
{{
    int i;
    for (i = 0; i < 4; ++i) {{
        const double v = x[i] > 709.5 ? 709.5 : x[i] < -708.0 ? -708.0 : x[i];
        const double t = v * 1.4426950408889634 + NF_ROUND, n = t - NF_ROUND;
        const double r = (v - n * 0.6931471803691238) - n * 1.9082149292705877e-10;
        double p = 1.0 / 6227020800.0, scale;
        uint64_t bits;
{_horner("p", "r", [f"1.0 / {c}" for c in EXP])}
        memcpy(&bits, &t, 8);
        bits = (bits + 1023) << 52;
        memcpy(&scale, &bits, 8);
        x[i] = (1.0 + (r + r * r * p)) * scale;
    }}
}}

NF_LANES void nf_tanh4(double *x)
{{
    int i;
    for (i = 0; i < 4; ++i) {{
        const double u = x[i] < 0.0 ? -x[i] : x[i];
        const double v = u > 20.0 ? 40.0 : 2.0 * u;
        const double t = v * 1.4426950408889634 + NF_ROUND, n = t - NF_ROUND;
        const double r = (v - n * 0.6931471803691238) - n * 1.9082149292705877e-10;
        double p = 1.0 / 6227020800.0, scale, e;
        uint64_t bits;
{_horner("p", "r", [f"1.0 / {c}" for c in EXP])}
        memcpy(&bits, &t, 8);
        bits = (bits + 1023) << 52;
        memcpy(&scale, &bits, 8);
        e = scale * (r + r * r * p) + (scale - 1.0); /* exp(v) - 1 without cancellation */
        e = e / (e + 2.0);
        x[i] = x[i] < 0.0 ? -e : e;
    }}
}}

/* Replaces x by its sine and fills c with its cosine. */
NF_LANES void nf_sincos4(double *NF_APART x, double *NF_APART c)
{{
    double far[4];
    int i, apart = 0;
    for (i = 0; i < 4; ++i) {{
        far[i] = x[i];
        apart |= !(fabs(x[i]) < 1e5);
    }}
    for (i = 0; i < 4; ++i) {{
        const double t = x[i] * 0.6366197723675814 + NF_ROUND, n = t - NF_ROUND;
        const double r = ((x[i] - n * 1.5707963267341256) - n * 6.077100506303966e-11)
            - n * 2.0222662487959506e-21;
        const double z = r * r;
        double s = 1.0 / 355687428096000.0, d = 1.0 / 20922789888000.0, w;
        uint64_t bits, sine, cosine, swap;
{_horner("s", "z", [f"1.0 / {c}" for c in SIN])}
{_horner("d", "z", [f"1.0 / {c}" for c in COS])}
        s = r + r * z * s;
        w = 1.0 - 0.5 * z;
        d = w + (((1.0 - w) - 0.5 * z) + z * z * d);
        memcpy(&bits, &t, 8);
        memcpy(&sine, &s, 8);
        memcpy(&cosine, &d, 8);
        swap = (sine ^ cosine) & (0 - (bits & 1)); /* odd quarter turns */
        sine = sine ^ swap ^ ((bits & 2) << 62);
        cosine = cosine ^ swap ^ (((bits + 1) & 2) << 62);
        memcpy(&s, &sine, 8);
        memcpy(&d, &cosine, 8);
        x[i] = s;
        c[i] = d;
    }}
    if (apart)
        for (i = 0; i < 4; ++i)
            if (!(fabs(far[i]) < 1e5)) {{
                x[i] = sin(far[i]);
                c[i] = cos(far[i]);
            }}
}}
"""

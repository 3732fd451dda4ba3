"""An exponential in C that compilers vectorise, for arguments of which a model has many.

The exponential of `math.h` is a call for every number. This one is a loop over an array without
branches or tables.
"""

from nfriction.export.c_code.dialect import ControllerC
from nfriction.export.c_code.emit import Real

_POLYNOMIAL: dict[Real, tuple[float, ...]] = {
    "double": (1.0, 0.5000000000000012, 0.16666666666666222, 0.0416666666665181,
               0.008333333333548278, 0.0013888888946297076, 0.0001984126943904723,
               2.480149068146982e-05, 2.755762504761142e-06, 2.763102156119972e-07,
               2.4991890031105645e-08),
    "float": (1.0, 0.49999994, 0.16666432, 0.041667998, 0.008374143, 0.0013843952),
}  # fmt: skip
"""Of (exp(r) - 1) / r for |r| <= ln(2) / 2, minimax: exp(r) to 4e-18 and 2e-9, beside roundings."""

# ln 2 as a number of few bits, whose products with whole numbers are exact, and the rest.
_LN2: dict[Real, tuple[float, float]] = {
    "double": (0.693145751953125, 1.4286068203094173e-06),
    "float": (0.693359375, -0.00021219444),
}


def exponential(dialect: ControllerC, joints: int, signs: int) -> str:
    """Write `nf_exp`, and `nf_tanh` where there are `signs` numbers a joint to take it of."""
    return dialect.text(
        "exponential.c", joints=joints, signs=signs, ln2=_LN2[dialect.real],
        polynomial=_by_pairs(dialect), spare=lambda count: spare(count, dialect),
    )  # fmt: skip


def spare(count: int, dialect: ControllerC) -> str:
    """Spell the numbers by which an array is longer, so that exponentials vectorise by four.

    At -O2 gcc vectorises only where it knows that no numbers remain. Single precision is for
    microcontrollers, which have no vectors.
    """
    return f" + {-count % 4}" if dialect.real == "double" and count % 4 else ""


def _by_pairs(dialect: ControllerC) -> str:
    """The polynomial in r by pairs of terms, of s = r^2: half as long a chain as Horner's."""
    texts = [dialect.literal(x) for x in _POLYNOMIAL[dialect.real]]
    pairs = [
        f"({texts[i]} + r * {texts[i + 1]})" if i + 1 < len(texts) else texts[i]
        for i in range(0, len(texts), 2)
    ]
    text = pairs[-1]
    for pair in reversed(pairs[:-1]):
        text = f"{pair} + s * ({text})" if " " in text else f"{pair} + s * {text}"
    return text

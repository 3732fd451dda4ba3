"""Fuzzy sets: membership functions, sets from printed ranges, and the sets of a network's rules.

The functions work elementwise on tensors that broadcast, keep dtype and device, and can be
scripted. Functions named `log_...` stay finite where the membership itself underflows.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from inspect import signature
from itertools import pairwise

import torch
import torch.nn.functional as F  # noqa: N812
from torch import Tensor

HALF_WIDTH_OF_GAUSSIAN = math.sqrt(2.0 * math.log(2.0))
"""Half-width at half maximum of a Gaussian set with sigma 1."""


def log_gaussian(x: Tensor, centre: Tensor, sigma: Tensor) -> Tensor:
    """Logarithm of a Gaussian membership, `-((x - centre)/sigma)^2 / 2`."""
    z = (x - centre) / sigma
    return -0.5 * z * z


def gaussian(x: Tensor, centre: Tensor, sigma: Tensor) -> Tensor:
    """Gaussian membership, `exp(-((x - centre)/sigma)^2 / 2)`."""
    return torch.exp(log_gaussian(x, centre, sigma))


def log_bell(x: Tensor, centre: Tensor, width: Tensor, slope: Tensor) -> Tensor:
    """Logarithm of a generalised bell, `1 / (1 + |(x - centre)/width|^(2 slope))`.

    It is also differentiable at the centre, because 1e-37 (which float32 can still represent) is
    added to z^2 before its logarithm is taken.
    """
    z = (x - centre) / width
    return F.logsigmoid(-slope * torch.log(z * z + 1e-37))


def bell(x: Tensor, centre: Tensor, width: Tensor, slope: Tensor) -> Tensor:
    """Generalised bell membership, equal to 0.5 at `centre ± width`; `slope` sets the steepness.

    References:
        Jang (1993), ANFIS: Adaptive-Network-Based Fuzzy Inference System, eq. (11).
    """
    return torch.exp(log_bell(x, centre, width, slope))


def left_shoulder(x: Tensor, centre: Tensor, sigma: Tensor) -> Tensor:
    """Membership 1 up to `centre`, then the falling half of a Gaussian."""
    return gaussian(torch.maximum(x, centre), centre, sigma)


def right_shoulder(x: Tensor, centre: Tensor, sigma: Tensor) -> Tensor:
    """The rising half of a Gaussian up to `centre`, then membership 1."""
    return gaussian(torch.minimum(x, centre), centre, sigma)


def two_sided_gaussian(
    x: Tensor, left: Tensor, left_sigma: Tensor, right: Tensor, right_sigma: Tensor
) -> Tensor:
    """Product of a Gaussian that rises up to `left` and one that falls from `right`.

    An infinite sigma removes that side, which turns the set into a shoulder.
    """
    return right_shoulder(x, left, left_sigma) * left_shoulder(x, right, right_sigma)


def trapezoid(x: Tensor, a: Tensor, b: Tensor, c: Tensor, d: Tensor) -> Tensor:
    """Membership that rises from a to b, is 1 up to c and falls to 0 at d; a = b makes a jump."""
    # The comparisons are false for NaN, which therefore stays NaN.
    rising = torch.where(x >= b, torch.ones_like(x), (x - a) / (b - a).clamp(min=1e-37))
    falling = torch.where(x <= c, torch.ones_like(x), (d - x) / (d - c).clamp(min=1e-37))
    return torch.minimum(rising, falling).clamp(0.0, 1.0)


def triangle(x: Tensor, a: Tensor, b: Tensor, c: Tensor) -> Tensor:
    """Membership that rises from 0 at a to 1 at b and falls to 0 at c."""
    return trapezoid(x, a, b, b, c)


_FUNCTIONS: dict[str, Callable[..., Tensor]] = {
    function.__name__: function
    for function in (
        *(gaussian, left_shoulder, right_shoulder, two_sided_gaussian, bell, triangle, trapezoid),
    )
}
SHAPES = {name: (*signature(of).parameters,)[1:] for name, of in _FUNCTIONS.items()}
"""Names of the shapes a `FuzzySet` may have, and of their parameters in order."""


@dataclass(frozen=True)
class FuzzySet:
    """A named set: one of `SHAPES` with its parameters, in the unit of its variable."""

    name: str
    shape: str
    parameters: tuple[float, ...]

    def __post_init__(self) -> None:
        where = f"fuzzy set {self.name!r}"
        if self.shape not in SHAPES:
            raise ValueError(f"{where}: unknown shape {self.shape!r}; use one of {list(SHAPES)}.")
        names = SHAPES[self.shape]
        if len(self.parameters) != len(names):
            raise ValueError(
                f"{where}: {self.shape} takes {len(names)} numbers {names}, "
                f"got {len(self.parameters)}."
            )
        if not all(math.isfinite(value) for value in self.parameters):
            raise ValueError(f"{where}: numbers must be finite, got {self.parameters}.")
        for name, value in zip(names, self.parameters, strict=True):
            # Functions divide by these.
            if ("sigma" in name or name in ("width", "slope")) and value <= 0:
                raise ValueError(f"{where}: `{name}` must be positive, got {value}.")
        if self.shape in ("triangle", "trapezoid") and list(self.parameters) != sorted(
            self.parameters
        ):
            raise ValueError(f"{where}: corners must ascend, got {self.parameters}.")

    def __call__(self, x: Tensor) -> Tensor:
        """Membership of `x`, same shape."""
        return _FUNCTIONS[self.shape](x, *(x.new_tensor(value) for value in self.parameters))

    @property
    def core(self) -> float:
        """Middle of the interval in which the membership is 1; terms are ordered by it."""
        if self.shape in ("triangle", "trapezoid"):
            return 0.5 * (self.parameters[1] + self.parameters[-2])
        if self.shape == "two_sided_gaussian":
            return 0.5 * (self.parameters[0] + self.parameters[2])
        return self.parameters[0]


def sets_from_ranges(
    names: Sequence[str], ranges: Sequence[tuple[float, float]]
) -> tuple[FuzzySet, ...]:
    """Gaussian sets from the range [low, high] of each.

    A table of ranges does not define the shape. The choice here: an interior set is centred in its
    range with sigma = range/4, so that it has fallen to 0.135 at both ends; the first and last sets
    are shoulders at the outer end of their range with sigma = range/2, so that they fall to the
    same 0.135 at the inner end.

    Args:
        names: one per set, in ascending order of the values.
        ranges: (low, high) of each set; lows and highs both ascend.
    Raises:
        ValueError: if the ranges are empty, not finite, or do not ascend.
    """
    if len(names) != len(ranges):
        raise ValueError(f"got {len(names)} names but {len(ranges)} ranges; one range a set.")
    if len(ranges) < 2:
        raise ValueError("at least two sets are needed to span a universe with shoulders.")
    spans = list(zip(names, ranges, strict=True))
    for name, (low, high) in spans:
        if not (math.isfinite(low) and math.isfinite(high) and low < high):
            raise ValueError(f"range of {name!r} must be finite with low < high, got {low, high}.")
    for (name, before), (after_name, after) in pairwise(spans):
        if not (before[0] < after[0] and before[1] < after[1]):
            raise ValueError(
                f"ranges must ascend: {after_name!r} {list(after)} comes after "
                f"{name!r} {list(before)}; write the sets from the smallest values to the largest."
            )
    sets = [
        FuzzySet(name, "gaussian", ((low + high) / 2, (high - low) / 4))
        for name, (low, high) in spans
    ]
    (first, (low, high)), (last, (last_low, last_high)) = spans[0], spans[-1]
    # The outermost sets have membership 1 beyond the universe, as "very fast" should.
    sets[0] = FuzzySet(first, "left_shoulder", (low, (high - low) / 2))
    sets[-1] = FuzzySet(last, "right_shoulder", (last_high, (last_high - last_low) / 2))
    return tuple(sets)


@dataclass(frozen=True, eq=False)
class FuzzyRules:
    """Gaussian sets over |velocity| and acceleration, and the coefficients of every pair of them.

    The coefficients of a rule are those at the centres of its sets, held within the trained range;
    the rules of the first velocity set come first.
    """

    lower: Tensor  # of the trained range of both inputs, (joint, input)
    upper: Tensor  # likewise
    centres: tuple[Tensor, ...]  # of the sets of each input, (joint, set)
    widths: tuple[Tensor, ...]  # likewise
    coefficients: Tensor  # of each rule, (joint, rule, coefficient)
    along_motion: bool  # whether acceleration is positive when the motion speeds up

    @property
    def constant(self) -> bool:
        """True if all rules of a joint have the same coefficients, as in a rejected network."""
        first = self.coefficients[:, :1].expand_as(self.coefficients)
        # The sums of a network have rounding errors.
        return torch.allclose(self.coefficients, first, rtol=1e-9, atol=0.0)

    def memberships(self, variable: int, joint: int, x: Tensor) -> Tensor:
        """Memberships (point, set) of values (point,) of an input, clamped to its range."""
        held = x.clamp(self.lower[joint, variable], self.upper[joint, variable])[:, None]
        z = (held - self.centres[variable][joint]) / self.widths[variable][joint]
        return torch.exp(-0.5 * z * z)

    def seconds(self, step: Tensor, qd: Tensor, qdd: Tensor) -> Tensor:
        """Time for which a motion fired each rule [s], (joint, rule).

        Each sample is divided among the rules in proportion to their strengths.

        Args:
            step: duration represented by each sample [s], (sample,).
            qd, qdd: velocity and acceleration, (sample, joint).
        """
        along = qdd * qd.sign() if self.along_motion else qdd
        found = []
        for j in range(qd.shape[1]):
            v, a = (self.memberships(i, j, x[:, j]) for i, x in enumerate((qd.abs(), along)))
            v, a = v / v.sum(1, keepdim=True), a / a.sum(1, keepdim=True)
            found.append(((step[:, None] * v).T @ a).flatten())
        return torch.stack(found)

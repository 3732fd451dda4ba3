"""Rules of a neuro-fuzzy model in words: IF velocity is slow AND ... THEN B = ..."""

from collections.abc import Sequence
from dataclasses import dataclass

from nfriction.friction.models import FrictionModel

_SPEEDS = {
    1: ("any",),
    2: ("slow", "fast"),
    3: ("slow", "medium", "fast"),
    4: ("very slow", "slow", "fast", "very fast"),
    5: ("very slow", "slow", "medium", "fast", "very fast"),
}
_SIZES = ("", "strongly ", "very strongly ")


@dataclass(frozen=True)
class Term:
    """A fuzzy set of one input: its name in words, middle and standard deviation in SI."""

    name: str
    centre: float
    width: float


@dataclass(frozen=True)
class Rule:
    """One rule: the names of its terms, and the coefficients in SI where these hold fully.

    The values are those of the whole model, neighbouring rules and radial basis head included.
    """

    velocity: str
    acceleration: str
    values: tuple[float, ...]

    def sentence(self, coefficients: Sequence[tuple[str, str]]) -> str:
        """The rule in words; `coefficients` are names and units."""
        then = " AND ".join(
            f"{name} = {value:.4g} {unit}".rstrip()
            for (name, unit), value in zip(coefficients, self.values, strict=True)
        )
        return f"{self.condition} THEN {then}"

    @property
    def condition(self) -> str:
        """The rule's premise in words."""
        return f"IF velocity is {self.velocity} AND acceleration is {self.acceleration}"


@dataclass(frozen=True)
class JointRules:
    """Sets and rules of one joint; velocity's set by velocity's set, acceleration's faster."""

    joint: str
    velocity: tuple[Term, ...]
    acceleration: tuple[Term, ...]
    rules: tuple[Rule, ...]


def rules_in_words(model: FrictionModel, joint_names: Sequence[str] = ()) -> list[JointRules]:
    """The rules of a neuro-fuzzy model, joint by joint; none of a model without rules.

    Sets are named by their order and by where zero lies. Acceleration counts along the motion
    (braking, speeding up) unless the model takes it signed.

    Args:
        model: any friction model.
        joint_names: default joint1, joint2, ...

    Raises:
        ValueError: if the names are not one a joint.
    """
    fuzzy = model.schedule.fuzzy_rules()
    if fuzzy is None:
        return []
    names = list(joint_names) or [f"joint{k + 1}" for k in range(model.joints)]
    if len(names) != model.joints:
        raise ValueError(f"`joint_names` must be {model.joints} names, got {names}.")
    described = []
    for j, joint in enumerate(names):
        (speeds, speed_widths), (accelerations, widths) = (
            (c[j].tolist(), w[j].tolist()) for c, w in zip(fuzzy.centres, fuzzy.widths, strict=True)
        )
        names_v = _in_order(speeds, _speed_names(len(speeds)))
        names_a = _acceleration_names(sorted(accelerations), fuzzy.along_motion)
        v = tuple(map(Term, names_v, speeds, speed_widths))
        a = tuple(map(Term, _in_order(accelerations, names_a), accelerations, widths))
        # The order of the rule table: the acceleration varies faster.
        pairs = [(x.name, y.name) for x in v for y in a]
        values = fuzzy.coefficients[j].tolist()
        rules = [Rule(*pair, tuple(of)) for pair, of in zip(pairs, values, strict=True)]
        described.append(JointRules(joint, v, a, tuple(rules)))
    return described


def _speed_names(count: int) -> Sequence[str]:
    # Language has no words for more than five.
    return _SPEEDS.get(count) or [f"speed {k + 1}" for k in range(count)]


def _acceleration_names(ordered: Sequence[float], along_motion: bool) -> list[str]:
    below, above = ("braking", "speeding up") if along_motion else ("negative", "positive")
    # The set nearest to zero: after training none need lie exactly there.
    zero = min(range(len(ordered)), key=lambda k: abs(ordered[k]))
    return [
        *(_size(zero - k) + below for k in range(zero)),
        "about zero",
        *(_size(k - zero) + above for k in range(zero + 1, len(ordered))),
    ]


def _size(rank: int) -> str:
    return _SIZES[rank - 1] if rank <= len(_SIZES) else f"{rank} times "


def _in_order(centres: Sequence[float], names: Sequence[str]) -> list[str]:
    """Names from the lowest centre to the highest, in the order of the centres."""
    # Training may move sets past each other.
    order = sorted(range(len(centres)), key=lambda k: centres[k])
    named = dict(zip(order, names, strict=True))
    return [named[k] for k in range(len(centres))]

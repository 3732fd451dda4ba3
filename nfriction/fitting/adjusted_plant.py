"""A plant at a vector of adjustable terms.

At x = 0 the plant is as given. Ratios are relative changes, `buffer = nominal (1 + x) (1 + x')` if
two of them scale an entry; offsets are in SI units, `buffer = nominal + x`.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from torch import Tensor, nn

from nfriction.plant import Plant

TORQUE_DELAY = "torque delay [s]"


@dataclass(frozen=True)
class PlantParameter:
    """One adjustable term.

    The delay of the torque changes no buffer.
    """

    name: str  # as in reports
    change: Mapping[str, Tensor]  # of the plant's buffers per unit, in their shapes
    lower: float
    upper: float
    prior_sd: float  # standard deviation of the prior around 0
    ratio: bool = False  # whether it scales the entries that are 1, rather than adding to them
    to_none: bool = False  # true if the lower bound means that the effect is absent


def delay_index(terms: Sequence[PlantParameter]) -> int | None:
    """Index of the torque's delay among the terms; None if it is not fitted."""
    return next((i for i, term in enumerate(terms) if term.name == TORQUE_DELAY), None)


def adjusted_buffers(
    plant: nn.Module, parameters: Sequence[PlantParameter], vector: Tensor
) -> dict[str, Tensor]:
    """Buffers of the plant at a parameter vector, shape (*batch, parameter)."""
    nominal = dict(plant.named_buffers())
    changed: dict[str, Tensor] = {}
    for i, parameter in enumerate(parameters):
        for name, change in parameter.change.items():
            value = vector[..., i].reshape(*vector.shape[:-1], *[1] * change.ndim)
            before = changed.get(name, nominal[name])
            step = value * change
            changed[name] = before * (1.0 + step) if parameter.ratio else before + step
    return changed


def adjusted_plant(plant: Plant, parameters: Sequence[PlantParameter], vector: Tensor) -> Plant:
    """A copy of the plant at a parameter vector; the plant itself without parameters."""
    return plant.replace(**adjusted_buffers(plant, parameters, vector)) if parameters else plant

"""Laws whose friction depends on more than the speed: on direction, load or position, and heat."""

from collections.abc import Sequence
from functools import lru_cache
from typing import Any, Final

import torch
from torch import Tensor, nn

from nfriction.friction.heat import FALL, HEAT
from nfriction.friction.laws import Coefficient, Law, TorqueFunction

# A coefficient for each input, behind the law's own.
INPUTS = {
    # Relative to the friction, so that it vanishes at rest, and below 1 brakes in both directions;
    # a constant torque would be the offset of a drive.
    "direction": Coefficient("d", "-", positive=False, prior_scale=1.0),
    "load": Coefficient("F_n", "N m", prior_scale=1.0),
    # Replaces the load; it is periodic, between 0 and 1.
    "position": Coefficient("F_p", "N m", prior_scale=1.0),
    # Friction that falls with the heat of the joint, whose last coefficient is that heat.
    "heat": FALL,
}


def with_inputs(law: Law, inputs: Sequence[str]) -> Law:
    """A law with further inputs.

    Load gives `f + F_n load sgn(qd)`; so does position, with a plant whose load is
    `(1 + cos(k q + p)) / 2` (`Plant.load`); direction multiplies the result by `1 + d sgn(qd)`, and
    heat by `exp(-k_h h)`, with h a hidden state of the coefficients (`nfriction.friction.heat`).

    Raises:
        ValueError: for an input that does not exist or is repeated; for load with position, or one
            of them for a law of the load.
    """
    listed = isinstance(inputs, list | tuple)
    chosen = tuple(name for name in INPUTS if listed and name in inputs)
    if not listed or len(chosen) != len(inputs):
        raise ValueError(f"`inputs` must be different ones of {', '.join(INPUTS)}, got {inputs!r}.")
    if "position" in chosen and ("load" in chosen or reads_load(law)):
        raise ValueError(
            'the input "position" replaces the load, on which this friction depends already: leave '
            'out one of them, or take a law without the load, such as "arctan".'
        )
    if not chosen:
        return law
    own = (*law.coefficients, *(INPUTS[name] for name in chosen), *(HEAT,) * ("heat" in chosen))
    torque = _torque_with_inputs(law.torque, len(law.names), chosen)
    return Law(f"{law.name}_by_{'_'.join(chosen)}", own, torque)


# One object for equal arguments: laws with the same inputs are equal.
@lru_cache
def _torque_with_inputs(torque: TorqueFunction, own: int, inputs: tuple[str, ...]) -> "_WithInputs":
    return _WithInputs(torque, own, inputs)


# A module and no closure, which TorchScript would not compile.
class _WithInputs(nn.Module):
    own: Final[int]
    turns: Final[bool]
    loaded: Final[bool]
    heated: Final[bool]

    def __init__(self, torque: TorqueFunction, own: int, inputs: tuple[str, ...]) -> None:
        super().__init__()
        self.torque, self.own, self.given = torque, own, inputs
        self.turns, load, position, self.heated = (name in inputs for name in INPUTS)
        self.loaded = load or position

    def __reduce__(self) -> tuple[Any, ...]:
        return _torque_with_inputs, (self.torque, self.own, self.given)

    def forward(self, qd: Tensor, load: Tensor, coefficients: Tensor, v_smooth: float) -> Tensor:
        tau_f = self.torque(qd, load, coefficients[..., : self.own], v_smooth)
        sign = torch.tanh(qd / v_smooth)
        if self.loaded:
            tau_f = tau_f + coefficients.select(-1, self.own + int(self.turns)) * load * sign
        if self.turns:
            tau_f = tau_f * (1.0 + coefficients.select(-1, self.own) * sign)
        if self.heated:
            tau_f = tau_f * torch.exp(-coefficients.select(-1, -2) * coefficients.select(-1, -1))
        return tau_f


def has_input(law: Law, name: str) -> bool:
    """True of a law with a further input; with `"heat"` its coefficients have a hidden state."""
    return isinstance(law.torque, _WithInputs) and name in law.torque.given


def reads_load(law: Law) -> bool:
    """True of a law whose torque depends on the load."""
    one = torch.ones(1, 1, dtype=torch.float64)
    coefficients = one.expand(1, 1, len(law.names))
    return not torch.equal(*(law.torque(one, k * one, coefficients, 1.0) for k in (0.5, 2.0)))


def require_loads(law: Law, plant: object) -> None:
    """Refuse a plant whose loads are not those that a law depends on.

    Raises:
        ValueError: if the law has the input `"load"` and the plant gives the loads of links, or if
            only one of them depends on the position.
    """
    if has_input(law, "load") and getattr(plant, "has_link_load", False):
        raise ValueError(
            "the friction depends on the loads of the bearings, and this plant gives those of "
            "single links: take the plant of the fit (`FitResult.plant`, `nfriction.load_plant`), "
            'or one with `normal_load` "bearing".'
        )
    by_position = has_input(law, "position")
    placed = getattr(plant, "has_position_load", by_position)
    loads = ("normal loads", "loads that follow the position")
    if placed != by_position and (not placed or reads_load(law)):
        raise ValueError(
            f"the friction depends on {loads[not placed]}, this plant gives {loads[placed]}: take "
            "the plant of the same fit (`FitResult.plant`, `nfriction.load_plant`)."
        )

"""Terms of a plant that a fit may adjust, with their bounds and priors."""

import math
from collections.abc import Iterator, Mapping, Sequence

import torch
from torch import Tensor, nn

from nfriction.fitting.adjusted_plant import TORQUE_DELAY, PlantParameter
from nfriction.fitting.options import DEFAULTS, FitOptions

# Squared frequency of a swing below which the weight of a chain does not matter [1/s^2].
WEIGHS = 1e-3


def plant_parameters(
    plant: nn.Module,
    *,
    driven: Sequence[int],
    largest_torque: float = 0.0,
    largest_rate: float = 0.0,
    drag: bool = False,
    eccentricity: bool = False,
    options: FitOptions = DEFAULTS,
) -> list[PlantParameter]:
    """The terms of a plant that a recording can identify.

    Args:
        plant: `PendulumChain` or `LinearAxis`.
        driven: joints with a measured torque. Without any, a free swing determines only ratios,
            so the first gravity term is fixed as the scale.
        largest_torque: largest torque in the recordings [N m; N]; bounds its offset.
        largest_rate: largest velocity in the recordings [m/s]; scale of an axis' asymmetry.
        drag: fit air drag on the links: one quadratic coefficient for all; with several links also
            a linear one, and the length of the last link in the air.
        eccentricity: fit the eccentricity of the encoders, two numbers per link.

    Returns:
        Ratios of inertia, gravity, length, armature and mass terms, angle offsets, torque gains of
        driven joints (without an arm, relative to the first), gear losses, torque offsets, drag,
        and eccentricity.
    """
    buffers = dict(plant.named_buffers())
    found = [*_chain_terms(buffers, bool(driven), options)] if "inertia_coupling" in buffers else []
    # Without torque a single mass only sets the scale of the friction.
    for name in ("armature", "mass") if driven else ("armature",):
        for j in range(buffers[name].shape[-1] if name in buffers else 0):
            found += _ratio(buffers, f"{name} {j + 1}", _at(buffers, name, j), options.ratio_term)
    # All gains together only set the scale of the masses, so the first is fixed; with an arm, its
    # inertia is fixed instead.
    for j in driven[0 if "arm_inertia" in buffers else 1 :] if "torque_gain" in buffers else ():
        unit = _at(buffers, "torque_gain", j)
        found += _ratio(buffers, f"torque gain {j + 1}", unit, options.gain_term)
    for j in driven if "gear_loss" in buffers else ():
        unit = _at(buffers, "gear_loss", j)
        found.append(_amount(buffers, f"gear loss {j + 1}", unit, options.loss_term))
    # The bias of a sensor; the drive of an inclined axis also holds its weight.
    shares = options.asymmetry_term if plant.unit == "m" else options.offset_term
    bound, sd = (share * largest_torque for share in shares)
    for j in driven:
        unit = _at(buffers, "torque_offset", j)
        name = f"{plant.effort} offset {j + 1} [{plant.effort_unit}]"
        found.append(PlantParameter(name, unit, -bound, bound, sd))
    if driven and "asymmetry" in buffers and largest_rate > 0:
        bound, sd = (share * largest_torque / largest_rate for share in options.asymmetry_term)
        unit = {"asymmetry": torch.ones_like(buffers["asymmetry"])}
        found.append(PlantParameter("asymmetry [N s/m]", unit, -bound, bound, sd))
    if drag:
        found += _drag_terms(buffers, options)
    if eccentricity:
        bound, sd = options.eccentricity_term
        joints = buffers["angle_offset"].shape[-1]
        for j in range(joints - len(buffers["length"]), joints):
            for part in ("cosine", "sine"):
                unit = _at(buffers, f"encoder_{part}", j)
                name = f"encoder {part} {j + 1} [rad]"
                found.append(PlantParameter(name, unit, -bound, bound, sd))
    return found


def position_terms(plant: nn.Module) -> list[PlantParameter]:
    """Phases of loads that follow the position, which may have any value."""
    buffers, most = dict(plant.named_buffers()), math.pi
    units = [_at(buffers, "load_phase", j) for j in range(len(buffers["load_phase"]))]
    return [
        PlantParameter(f"load phase {j + 1} [rad]", unit, -most, most, most)
        for j, unit in enumerate(units)
    ]


def torque_delay_term(options: FitOptions = DEFAULTS) -> PlantParameter:
    """Time by which torques are recorded later than positions."""
    most = options.largest_delay
    return PlantParameter(TORQUE_DELAY, {}, -most, most, options.delay_sd)


def has_weight(gravity_moment: Tensor, inertia_coupling: Tensor) -> bool:
    """True if gravity depends on a chain's pose: neither balanced nor in a horizontal plane."""
    own = inertia_coupling.diagonal(dim1=-2, dim2=-1)
    return bool((gravity_moment.abs() > WEIGHS * own).any())


def _chain_terms(
    buffers: Mapping[str, Tensor], driven: bool, options: FitOptions
) -> Iterator[PlantParameter]:
    """Inertia, gravity, length and angle offset of the links of a chain."""
    links = buffers["gravity_moment"].shape[-1]

    def coupled(*pairs: tuple[int, int]) -> dict[str, Tensor]:
        return _at(buffers, "inertia_coupling", *pairs, *((j, i) for i, j in pairs))

    weight = has_weight(buffers["gravity_moment"], buffers["inertia_coupling"])
    # Without torque and gravity, the inertia only sets the scale of the friction.
    for i in range(links) if driven or weight else ():
        yield from _ratio(buffers, f"inertia {i + 1}{i + 1}", coupled((i, i)), options.ratio_term)
    # The off-diagonal inertia a_ij = L_i b_j shares the first moment b_j with gravity, so both
    # scale together.
    for j in range(0 if driven and weight else 1, links):
        moment = _at(buffers, "gravity_moment", j) | coupled(*((i, j) for i in range(j)))
        yield from _ratio(buffers, f"gravity {j + 1}", moment, options.ratio_term)
    # Without weight, lengths only set the scale of these.
    for i in range(links - 1) if weight else ():
        carried = coupled(*((i, j) for j in range(i + 1, links)))
        yield from _ratio(buffers, f"length {i + 1}", carried, options.length_term)
    joints = buffers["angle_offset"].shape[-1]
    bound, sd = options.angle_term
    for j in range(joints - links, joints) if weight else ():
        unit = _at(buffers, "angle_offset", j)
        yield PlantParameter(f"angle offset {j + 1} [rad]", unit, -bound, bound, sd)


def _drag_terms(buffers: Mapping[str, Tensor], options: FitOptions) -> Iterator[PlantParameter]:
    length = buffers["length"]
    # On a single link, linear drag is viscous friction of the joint, and the reach only sets the
    # scale of the quadratic drag.
    for name in ("drag_linear", "drag_quadratic") if len(length) > 1 else ("drag_quadratic",):
        unit = {name: torch.ones_like(buffers[name])}
        yield _amount(buffers, name.replace("_", " "), unit, options.drag_term)
    if len(length) > 1:
        last = torch.zeros_like(length)
        last[-1] = length[-1]
        yield PlantParameter("drag reach", {"length": last}, *options.reach_term)


def _at(
    buffers: Mapping[str, Tensor], name: str, *index: int | tuple[int, int]
) -> dict[str, Tensor]:
    """1 at some entries of a buffer, 0 elsewhere."""
    chosen = torch.zeros_like(buffers[name])
    for i in index:
        chosen[i] = 1.0
    return {name: chosen}


def _ratio(
    buffers: Mapping[str, Tensor], name: str, change: dict[str, Tensor], term: tuple[float, float]
) -> Iterator[PlantParameter]:
    """A relative change; none if all entries that it scales are zero."""
    bound, sd = term
    if any(bool((buffers[buffer] * chosen).any()) for buffer, chosen in change.items()):
        yield PlantParameter(name, change, -bound, bound, sd, ratio=True)


def _amount(
    buffers: Mapping[str, Tensor], name: str, change: dict[str, Tensor], term: tuple[float, float]
) -> PlantParameter:
    """A term whose total value lies between zero and the bound."""
    ((buffer, unit),) = change.items()
    given, (most, sd) = buffers[buffer][unit > 0], term
    low, high = 0.0 - float(given.min()), max(most - float(given.max()), 0.0)
    return PlantParameter(name, change, low, high, sd, to_none=True)

"""Which terms of a plant a fit may adjust, and by how much.

With x = 0 the plant is as given: ratios are deviations from 1, `buffer = nominal (1 + x) (1 + x')`
where two act on an entry; offsets are in SI, `buffer = nominal + x`.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn

# Inertia and gravity terms of a bench are known to about a tenth; the bound is the data cards'.
RATIO_BOUND, RATIO_SD = 0.3, 0.1
# A length from joint to joint is read off a drawing or a ruler.
LENGTH_BOUND, LENGTH_SD = 0.1, 0.01
# An encoder's zero is known to about a degree.
ANGLE_BOUND, ANGLE_SD = 0.1, 0.02
# A disc sits on its shaft to within some hundredths of a millimetre, at a radius of a centimetre.
ECCENTRICITY_BOUND, ECCENTRICITY_SD = 0.02, 0.002
# Of two drives, torque constants and losses of gears stand to each other as told to about a tenth.
GAIN_BOUND, GAIN_SD = 0.3, 0.1
# A stage of a gear loses some hundredths of the torque, a worm much more.
LOSS_BOUND, LOSS_SD = 0.5, 0.05
# A force offset is a bias of the drive's current sensor; where friction is dry, a large one and a
# wrong zero of an angle pass for each other.
OFFSET_SHARE = 0.01
# Of the largest force over the largest speed, a guide's asymmetry is a small part.
ASYMMETRY_SHARE = 0.1
# Air drag: the quadratic term of a slender bar is 0.5 rho c_d width, below 0.1 N s^2/m^3.
DRAG_BOUND, DRAG_SD = 1.0, 0.05
# The last link's end is where nobody measures: what stands in the air may end before the tip or
# be widest near the joint.
REACH_LOWER, REACH_UPPER, REACH_SD = -0.7, 1.0, 0.3


@dataclass(frozen=True)
class PlantParameter:
    """One adjustable term.

    Attributes:
        name: what a report calls it.
        change: of the plant's buffers per unit, each in the shape of its buffer; of a ratio, 1 at
            the entries that it scales.
        lower, upper: bounds.
        prior_sd: standard deviation of the prior around 0.
        ratio: whether it scales its entries, and does not add to them.
        to_none: at its lower bound, nothing is left of what it adjusts.
    """

    name: str
    change: Mapping[str, Tensor]
    lower: float
    upper: float
    prior_sd: float
    ratio: bool = False
    to_none: bool = False


def plant_parameters(
    plant: nn.Module,
    *,
    driven: Sequence[int],
    largest_torque: float = 0.0,
    largest_rate: float = 0.0,
    drag: bool = False,
    eccentricity: bool = False,
) -> list[PlantParameter]:
    """The terms of a plant that a recording can tell.

    Args:
        plant: `PendulumChain` or `LinearAxis`.
        driven: joints whose torque was measured. Where there is none, free swing tells only
            ratios, so the first gravity term is kept as the scale.
        largest_torque: largest torque in the recordings [N m; N]; bounds its offset.
        largest_rate: largest velocity in the recordings [m/s]; scale of an axis' asymmetry.
        drag: fit air drag on the links: one quadratic coefficient for all; of several links also
            a linear one, and how far the last reaches into the air.
        eccentricity: fit how far the encoders sit off their shafts, two numbers a link.

    Returns:
        Ratios of inertia, gravity, length, armature and mass terms, angle offsets, torque gains of
        driven joints (without an arm, beside the first's), their gears' losses, torque offsets,
        drag, and eccentricity.
    """
    buffers = dict(plant.named_buffers())
    found: list[PlantParameter] = []

    def only(buffer: str, *index: tuple[int, ...]) -> dict[str, Tensor]:
        chosen = torch.zeros_like(buffers[buffer])
        for i in index:
            chosen[i] = 1.0
        return {buffer: chosen}

    def ratio(
        label: str, change: dict[str, Tensor], bound: float = RATIO_BOUND, sd: float = RATIO_SD
    ) -> None:
        if any(bool((buffers[name] * chosen).any()) for name, chosen in change.items()):
            found.append(PlantParameter(label, change, -bound, bound, sd, ratio=True))

    def shift(label: str, buffer: str, unit: Tensor, low: float, high: float, sd: float) -> None:
        found.append(PlantParameter(label, {buffer: unit}, low, high, sd))

    def amount(label: str, buffer: str, unit: Tensor, most: float, sd: float) -> None:
        given = buffers[buffer][unit > 0]
        low, high = 0.0 - float(given.min()), max(most - float(given.max()), 0.0)
        found.append(PlantParameter(label, {buffer: unit}, low, high, sd, to_none=True))

    if "inertia_coupling" in buffers:
        links = buffers["gravity_moment"].shape[-1]

        def coupled(*pairs: tuple[int, int]) -> dict[str, Tensor]:
            return only("inertia_coupling", *pairs, *((j, i) for i, j in pairs))

        for i in range(links):
            ratio(f"inertia {i + 1}{i + 1}", coupled((i, i)))
        # What hangs on joint j couples to the link i before it by its first moment, which gravity
        # pulls at, times that link's length: a_ij = L_i b_j.
        for j in range(0 if driven else 1, links):
            moved = coupled(*((i, j) for i in range(j)))
            ratio(f"gravity {j + 1}", only("gravity_moment", (j,)) | moved)
        for i in range(links - 1):
            carried = coupled(*((i, j) for j in range(i + 1, links)))
            ratio(f"length {i + 1}", carried, LENGTH_BOUND, LENGTH_SD)
        joints = buffers["angle_offset"].shape[-1]
        for j in range(joints - links, joints):
            unit = torch.eye(joints, dtype=torch.float64)[j]
            shift(f"angle offset {j + 1} [rad]", "angle_offset", unit, -ANGLE_BOUND, ANGLE_BOUND,
                  ANGLE_SD)  # fmt: skip
    # Without torque a mass alone is but the scale of the friction.
    for name in ("armature", "mass") if driven else ("armature",):
        for j in range(buffers[name].shape[-1] if name in buffers else 0):
            ratio(f"{name} {j + 1}", only(name, (j,)))
    # All gains alike are but the scale of the masses, so the first is kept; beside an arm, whose
    # inertia is kept, it is not.
    for j in driven[0 if "arm_inertia" in buffers else 1 :] if "torque_gain" in buffers else ():
        ratio(f"torque gain {j + 1}", only("torque_gain", (j,)), GAIN_BOUND, GAIN_SD)
    for j in driven if "gear_loss" in buffers else ():
        unit = torch.eye(len(buffers["gear_loss"]), dtype=torch.float64)[j]
        amount(f"gear loss {j + 1}", "gear_loss", unit, LOSS_BOUND, LOSS_SD)
    if driven:
        joints = buffers["torque_offset"].shape[-1]
        kind, force = ("force", "N") if plant.unit == "m" else ("torque", "N m")
        bound = 0.3 * largest_torque
        for j in driven:
            unit = torch.eye(joints, dtype=torch.float64)[j]
            shift(f"{kind} offset {j + 1} [{force}]", "torque_offset", unit, -bound, bound,
                  OFFSET_SHARE * largest_torque)  # fmt: skip
    if driven and "asymmetry" in buffers and largest_rate > 0:
        unit, sd = torch.ones_like(buffers["asymmetry"]), largest_torque / largest_rate
        shift("asymmetry [N s/m]", "asymmetry", unit, -sd, sd, ASYMMETRY_SHARE * sd)
    if drag:
        length = buffers["length"]
        # On a single link, linear drag is viscous friction of the joint, and the reach the scale
        # of the quadratic drag.
        for name in ("drag_linear", "drag_quadratic") if len(length) > 1 else ("drag_quadratic",):
            ones = torch.ones_like(buffers[name])
            amount(name.replace("_", " "), name, ones, DRAG_BOUND, DRAG_SD)
        if len(length) > 1:
            last = torch.zeros_like(length)
            last[-1] = length[-1]
            shift("drag reach", "length", last, REACH_LOWER, REACH_UPPER, REACH_SD)
    if eccentricity:
        joints = buffers["angle_offset"].shape[-1]
        for j, unit in enumerate(torch.eye(joints, dtype=torch.float64)):
            for part in ("cosine", "sine") if j >= joints - len(buffers["length"]) else ():
                shift(f"encoder {part} {j + 1} [rad]", f"encoder_{part}", unit,
                      -ECCENTRICITY_BOUND, ECCENTRICITY_BOUND, ECCENTRICITY_SD)  # fmt: skip
    return found


def adjusted_buffers(
    plant: nn.Module, parameters: list[PlantParameter], vector: Tensor
) -> Mapping[str, Tensor]:
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

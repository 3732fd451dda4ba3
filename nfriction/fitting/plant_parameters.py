"""Which terms of a plant a fit may adjust, and by how much.

Every adjustable term enters its buffer linearly, `buffer = nominal + sum_p basis_p x_p`, with
x = 0 the plant as given: ratios are deviations from 1, offsets are in SI.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn

# Inertia and gravity terms of a bench are known to about a tenth; the bound is the data cards'.
RATIO_BOUND, RATIO_SD = 0.3, 0.1
# An encoder's zero is known to about a degree.
ANGLE_BOUND, ANGLE_SD = 0.1, 0.02
# A disc sits on its shaft to within some hundredths of a millimetre, at a radius of a centimetre.
ECCENTRICITY_BOUND, ECCENTRICITY_SD = 0.02, 0.002
# A force offset is a bias of the drive's current sensor; where friction is dry, a large one and a
# wrong zero of an angle pass for each other.
OFFSET_SHARE = 0.01
# Of the largest force over the largest speed, a guide's asymmetry is a small part.
ASYMMETRY_SHARE = 0.1
# Air drag: the quadratic term of a slender bar is 0.5 rho c_d width, below 0.1 N s^2/m^3.
DRAG_SD = 0.05
# The last link's end is where nobody measures: what stands in the air may end before the tip or
# be widest near the joint.
REACH_LOWER, REACH_UPPER, REACH_SD = -0.7, 1.0, 0.3


@dataclass(frozen=True)
class PlantParameter:
    """One adjustable term.

    Attributes:
        name: what a report calls it.
        buffer: the plant's buffer that it changes.
        basis: change of the buffer per unit, shape of the buffer.
        lower, upper: bounds.
        prior_sd: standard deviation of the prior around 0.
    """

    name: str
    buffer: str
    basis: Tensor
    lower: float
    upper: float
    prior_sd: float


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
        Ratios of inertia, gravity, armature and mass terms, angle offsets, torque offsets of
        driven joints, drag, and eccentricity.
    """
    buffers = dict(plant.named_buffers())
    found: list[PlantParameter] = []

    def ratio(label: str, buffer: str, *index: tuple[int, ...]) -> None:
        nominal = buffers[buffer]
        basis = torch.zeros_like(nominal)
        for i in index:
            basis[i] = nominal[i]
        if basis.abs().sum() > 0:
            found.append(PlantParameter(label, buffer, basis, -RATIO_BOUND, RATIO_BOUND, RATIO_SD))

    def shift(label: str, buffer: str, basis: Tensor, low: float, high: float, sd: float) -> None:
        found.append(PlantParameter(label, buffer, basis, low, high, sd))

    if "inertia_coupling" in buffers:
        links = buffers["gravity_moment"].shape[-1]
        for i in range(links):
            for j in range(i, links):
                ratio(f"inertia {i + 1}{j + 1}", "inertia_coupling", (i, j), (j, i))
        for i in range(0 if driven else 1, links):
            ratio(f"gravity {i + 1}", "gravity_moment", (i,))
        joints = buffers["angle_offset"].shape[-1]
        for j in range(joints - links, joints):
            unit = torch.eye(joints, dtype=torch.float64)[j]
            shift(f"angle offset {j + 1} [rad]", "angle_offset", unit, -ANGLE_BOUND, ANGLE_BOUND,
                  ANGLE_SD)  # fmt: skip
    # Without torque a mass alone is but the scale of the friction.
    for name in ("armature", "mass") if driven else ("armature",):
        for j in range(buffers[name].shape[-1] if name in buffers else 0):
            ratio(f"{name} {j + 1}", name, (j,))
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
            shift(name.replace("_", " "), name, ones, 0.0, 1.0, DRAG_SD)
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
        before = changed.get(parameter.buffer, nominal[parameter.buffer])
        value = vector[..., i].reshape(*vector.shape[:-1], *[1] * parameter.basis.ndim)
        changed[parameter.buffer] = before + value * parameter.basis
    return changed

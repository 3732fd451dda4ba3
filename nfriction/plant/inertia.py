"""Inertia of links as given by a user, and bounds on a chain's mass matrix over all poses."""

import math
import warnings
from typing import Any
from weakref import WeakKeyDictionary

import torch
from torch import Tensor

from nfriction.plant.base import numbers, vector


def inertia_tensors(inertia: object, links: int) -> Tensor:
    """Inertia about the mass centre as rows (Ixx, Iyy, Izz, Ixy, Ixz, Iyz) [kg m^2].

    The link frame has x along the link, z along the joint axis and y = z cross x; products are
    the matrix entries.

    `inertia` is None (point masses), one Izz per link (slender rods: Iyy = Izz, Ixx = 0), or
    (links, 6) numbers in the order above. Warns if no rigid body can have such an inertia.
    """
    rows = torch.zeros(links, 6, dtype=torch.float64)
    if inertia is None:
        return rows
    given = numbers("inertia", inertia)
    if tuple(given.shape) == (links, 6):
        rows = vector("inertia", given.flatten(), 6 * links).reshape(links, 6)
    elif tuple(given.shape) == (links,):
        rows[:, 1] = rows[:, 2] = vector("inertia", given, links)
    else:
        raise ValueError(
            f"`inertia` must be None, ({links},) for Izz per link or ({links}, 6) for "
            f"(Ixx, Iyy, Izz, Ixy, Ixz, Iyz), got shape {tuple(given.shape)}."
        )
    xx, yy, zz, xy, xz, yz = rows.unbind(-1)
    matrix = torch.stack([xx, xy, xz, xy, yy, yz, xz, yz, zz], -1).reshape(-1, 3, 3)
    small, middle, large = torch.linalg.eigvalsh(matrix).unbind(-1)
    # A slender rod lies on the border: round-off must not cause a warning.
    slack = 1e-9 * rows.abs().amax(-1)
    wrong = (small < -slack) | (large > small + middle + slack)
    # Only a warning, because identified values absorb effects that a model omits.
    if wrong.any():
        bad = [i + 1 for i in wrong.nonzero().flatten().tolist()]
        warnings.warn(
            f"the inertia of link {bad} about its mass centre belongs to no rigid body "
            f"(principal inertias must be >= 0 and obey the triangle inequality): "
            f"{rows[wrong].tolist()}; if it was identified, the motion may still be right.",
            stacklevel=3,
        )
    return rows


# Values of the buffers, and M^-1 over the grid for them. Cached, because every rollout needs it and
# it costs as much as thousands of compiled steps.
_known: WeakKeyDictionary[Any, tuple[Tensor, Tensor]] = WeakKeyDictionary()


def fastest_mode(plant: Any, damping: Tensor) -> Tensor:
    """Largest eigenvalue of M^-1 D over a grid of poses of a chain [1/s].

    `damping` is the diagonal of D, not negative, (joint,) or (*batch of the plant, joint).
    """
    values = torch.cat([buffer.reshape(-1) for buffer in plant.buffers()])
    known = _known.get(plant)
    # Buffers may be changed in place, so values are compared and not objects.
    if known is None or not torch.equal(known[0], values):
        mass = plant.mass_matrix(configuration_grid(plant.joints).to(values))
        poses = torch.linalg.inv(mass).reshape(-1, *mass.shape[-3:])
        known = _known[plant] = values, poses
    damping = damping.reshape(-1, 1, plant.joints)
    products = damping.mT * damping
    # D^1/2 M^-1 D^1/2 has the same eigenvalues and is symmetric: its Frobenius norm bounds them, so
    # that few poses need a decomposition.
    bound = (known[1].square() * products.unsqueeze(1)).sum((-1, -2))
    scale = products.sqrt().expand(len(bound), -1, -1)
    inverse = known[1].expand(len(bound), -1, -1, -1)

    def largest(where: Tensor) -> Tensor:
        batch, pose = where.nonzero(as_tuple=True)
        return torch.linalg.eigvalsh(inverse[batch, pose] * scale[batch]).amax()

    least = largest(bound == bound.amax())
    return largest(bound >= (least * (1 - 1e-9)).square())


def configuration_grid(joints: int) -> Tensor:
    """A grid of joint angles over which M varies, (poses, joints) [rad].

    The first coordinate stays 0: neither a fixed chain's first angle nor a free arm's changes M.
    """
    turning = joints - 1
    if not turning:
        return torch.zeros(1, 1)
    count = min(72, max(4, 4 * int(20_000 ** (1 / turning) / 4)))
    axis = torch.arange(count, dtype=torch.float64) * (math.tau / count)
    if turning > 7:  # too many poses: random ones, the straight and the folded one
        chosen = torch.randint(4, (2_000, turning), generator=torch.Generator().manual_seed(0))
        chosen[0], chosen[1] = 0, 2
        poses = axis[chosen]
    else:
        poses = torch.cartesian_prod(*[axis] * turning).reshape(-1, turning)
    return torch.nn.functional.pad(poses, (1, 0))


def require_positive_definite(coupling: Tensor, aligned: Tensor) -> None:
    """Refuse inertias that do not resist every motion.

    M over absolute angles is a_ij cos(phi_i - phi_j) plus the rotors. The cosines are a Gram
    matrix, so by Schur's product theorem a positive semidefinite `coupling` (a_ij) keeps M so in
    every pose. `aligned` is the links' mass matrix, rotors included, with all links in line.
    """
    # Point masses may give a singular coupling, with eigenvalues of plus or minus round-off.
    rounding = 1e-12 * aligned.trace().item()
    smallest = torch.linalg.eigvalsh(aligned)[0].item()
    alone = torch.linalg.eigvalsh(coupling)[0].item()
    if smallest > 0 and alone > -rounding:
        return
    raise ValueError(
        f"the mass matrix must be positive definite, but its smallest eigenvalue is "
        f"{min(smallest, alone):.3g} kg m^2; check `mass`, `com` and `inertia` (a link without "
        "inertia needs `com` away from its joint)."
    )

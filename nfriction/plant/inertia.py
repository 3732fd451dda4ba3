"""Inertia of links as given by a user: three spellings into one tensor, and a physical check."""

import warnings

import torch
from torch import Tensor

from nfriction.plant.base import vector

COLUMNS = ("Ixx", "Iyy", "Izz", "Ixy", "Ixz", "Iyz")


def inertia_tensors(inertia: object, links: int) -> Tensor:
    """Inertia about the mass centre as rows (Ixx, Iyy, Izz, Ixy, Ixz, Iyz) [kg m^2].

    The link frame has x along the link, z along the joint axis and y = z cross x; products are
    the matrix entries.

    Args:
        inertia: None (point masses), one Izz per link (slender rods: Iyy = Izz, Ixx = 0), or
            (links, 6) numbers in the order above.
        links: how many rows.
    Returns:
        float64 tensor of shape (links, 6).
    Raises:
        ValueError: for another shape.
    Warns:
        UserWarning: where no rigid body has such an inertia.
    """
    rows = torch.zeros(links, 6, dtype=torch.float64)
    if inertia is None:
        return rows
    try:
        given = torch.as_tensor(inertia, dtype=torch.float64).detach().cpu()
    except (TypeError, ValueError, RuntimeError) as error:
        raise ValueError(f"`inertia` must be numbers, got {inertia!r}.") from error
    if tuple(given.shape) == (links, 6):
        rows = vector("inertia", given.flatten(), 6 * links).reshape(links, 6)
    elif tuple(given.shape) == (links,):
        rows[:, 1] = rows[:, 2] = vector("inertia", given, links)
    else:
        raise ValueError(
            f"`inertia` must be None, ({links},) for Izz per link or ({links}, 6) for {COLUMNS}, "
            f"got shape {tuple(given.shape)}."
        )
    _warn_impossible(rows)
    return rows


def _warn_impossible(rows: Tensor) -> None:
    """A body's principal inertias are not negative, and none exceeds the sum of the others."""
    xx, yy, zz, xy, xz, yz = rows.unbind(-1)
    matrix = torch.stack([xx, xy, xz, xy, yy, yz, xz, yz, zz], -1).reshape(-1, 3, 3)
    small, middle, large = torch.linalg.eigvalsh(matrix).unbind(-1)
    slack = 1e-9 * rows.abs().amax(-1)
    wrong = (small < -slack) | (large > small + middle + slack)
    if wrong.any():
        links = [i + 1 for i in wrong.nonzero().flatten().tolist()]
        warnings.warn(
            f"the inertia of link {links} about its mass centre belongs to no rigid body "
            f"(principal inertias must be >= 0 and obey the triangle inequality): "
            f"{rows[wrong].tolist()}; the motion may still be right where it was identified so.",
            stacklevel=4,
        )

"""What holds for the mass matrix over all poses of a chain."""

import math

import torch
from torch import Tensor


def turning_poses(joints: int) -> Tensor:
    """A grid of joint angles over which M varies, (poses, joints) [rad].

    The first coordinate stays 0: neither a fixed chain's first angle nor a free arm's changes M.
    """
    turning = joints - 1
    if not turning:
        return torch.zeros(1, 1)
    count = min(72, max(4, 4 * int(20_000 ** (1 / turning) / 4)))
    axis = torch.arange(count, dtype=torch.float64) * (math.tau / count)
    poses = torch.cartesian_prod(*[axis] * turning).reshape(-1, turning)
    return torch.nn.functional.pad(poses, (1, 0))


def refuse_indefinite(coupling: Tensor, aligned: Tensor) -> None:
    """Refuse inertias that do not resist every motion.

    M over absolute angles is a_ij cos(phi_i - phi_j) plus the rotors. The cosines are a Gram
    matrix, so by Schur's product theorem a positive semidefinite `coupling` (a_ij) keeps M so in
    every pose.

    Args:
        coupling: a_ij, (links, links) [kg m^2].
        aligned: the links' mass matrix, rotors included, with all links in line.
    Raises:
        ValueError: where `coupling` has a negative eigenvalue, or `aligned` one not positive.
    """
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

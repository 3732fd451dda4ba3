"""Air drag spread along the links, in closed form.

A point at distance s from the joint of link i moves at v = s phi_i' + sum_{j<i} L_j phi_j'
cos(phi_i - phi_j) across the link and meets the force k1 v + k2 v |v| per length. Along a link
v is linear in s, so the force and its moment have closed forms even where v changes sign: no
quadrature, no branch.
"""

from collections.abc import Sequence

from torch import Tensor

from nfriction.plant.dynamics import Pose, dot

_TINY = 1e-30  # keeps 0/0 away where a whole link is at rest; its numerators are cubic in v


def drag_forces(
    pose: Pose,
    rate: Sequence[Tensor],
    length: Sequence[Tensor],
    linear: Sequence[Tensor],
    quadratic: Sequence[Tensor],
) -> list[Tensor]:
    """Generalised drag torques int f(v) dv/dphi_j' ds on the absolute angles [N m].

    They oppose the motion, on the left-hand side: their product with the absolute rates phi_i'
    `rate` is the power lost, never negative for k1, k2 >= 0 (`linear`, `quadratic`).
    """
    torque: list[Tensor] = []
    for i, (size, k1, k2) in enumerate(zip(length, linear, quadratic, strict=True)):
        reach = [length[j] * pose.cos_between[j, i] for j in range(i)]
        sweep = size * rate[i]
        if i == 0:  # its joint is fixed, so that v grows from 0
            torque.append(size * size * sweep * (k1 / 3 + k2 / 4 * sweep.abs()))
            continue
        start = dot(reach, rate[:i])
        end = start + sweep
        mean, first = square_moments(start, end)
        push = size * (k1 / 2 * (start + end) + k2 * mean)
        torque = [t + lever * push for t, lever in zip(torque, reach, strict=True)]
        torque.append(size * size * (k1 / 6 * (start + 2 * end) + k2 * first))
    return torque


def square_moments(start: Tensor, end: Tensor) -> tuple[Tensor, Tensor]:
    """Integrals over t in [0, 1] of v |v| and of t v |v| for v = start + t (end - start).

    Exact for either sign of both ends. With w = start * end, the second is half the first plus
    the moment about the middle; |w| - w is zero unless v changes sign on the way.
    """
    w = start * end
    both = w.abs()
    total = start.abs() + end.abs() + _TINY
    squares = start * start + end * end + both
    mean = (start + end) / total * squares / 3
    crossing = both / total * ((both - w) / total)
    about_middle = (end - start) / total * (squares + w - crossing) / 12
    return mean, mean / 2 + about_middle

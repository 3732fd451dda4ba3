"""Cases of the benchmarks: a swing of the three-link rig that friction ends, two frictions."""

import math
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from nfriction import NFLFM, FrictionModel, PendulumChain, rigs
from nfriction.friction.coefficients import Constant
from nfriction.friction.laws import Coefficient, Law, smooth_sign
from nfriction.friction.neurofuzzy import NeuroFuzzy

STEPS, DT = 40_000, 1e-3
# Strong enough that the release below stays regular: states of all contestants can be compared at
# the end, where a weaker friction would have turned rounding errors into other motions.
VISCOUS = (0.010, 0.006, 0.004)  # [N m s/rad]
COULOMB = (0.05, 0.03, 0.02)  # [N m]


def _torque(qd: Tensor, load: Tensor, coefficients: Tensor, v_smooth: float) -> Tensor:
    viscous, coulomb = coefficients.unbind(-1)
    return viscous * qd + coulomb * smooth_sign(qd, v_smooth)


VISCOUS_COULOMB = Law(
    "viscous and Coulomb", (Coefficient("B", "N m s/rad"), Coefficient("C", "N m")), _torque
)


def rig() -> PendulumChain:
    """The papers' three links on the fixed arm."""
    return rigs.tlrip(arm="fixed")


def constant() -> FrictionModel:
    """Viscous plus Coulomb friction without load dependence, which MuJoCo knows as well."""
    values = torch.tensor([VISCOUS, COULOMB], dtype=torch.float64).T
    return FrictionModel(VISCOUS_COULOMB, Constant(VISCOUS_COULOMB, 3, values))


def neurofuzzy(seed: int = 0, terms: tuple[int, int] = (5, 5), spread: float = 0.2) -> NFLFM:
    """Load-dependent friction with a network of random rules around the same constants."""
    values = torch.tensor([VISCOUS, COULOMB], dtype=torch.float64).T
    model = NFLFM(3, values, terms=terms)
    random = torch.Generator().manual_seed(seed)
    schedule = model.schedule
    assert isinstance(schedule, NeuroFuzzy)
    with torch.no_grad():
        for p in (*schedule.trained(), schedule.network.head.output_bias):
            p.add_(spread * torch.randn(p.shape, generator=random, dtype=p.dtype))
    schedule.set_range(8.0, [-60.0, 60.0])
    return model


def release(count: int | None = None, seed: int = 0) -> tuple[Tensor, Tensor]:
    """Displaced from hanging, at rest: one state (3,), or `count` around it."""
    q0 = torch.tensor([math.pi + 0.8, 0.4, -0.3], dtype=torch.float64)
    if count is not None:
        random = torch.Generator().manual_seed(seed)
        q0 = q0 + 0.2 * torch.randn(count, 3, generator=random, dtype=torch.float64)
    return q0, torch.zeros_like(q0)


class Numbers(NamedTuple):
    """A rig and a friction model as plain arrays, for contestants that know no torch."""

    coupling: np.ndarray
    gravity: np.ndarray
    lever: np.ndarray
    v_smooth: float
    constant: np.ndarray  # (joint, coefficient)
    network: dict[str, np.ndarray] | None


def numbers(plant: PendulumChain, friction: FrictionModel) -> Numbers:
    network = None
    schedule = friction.schedule
    if isinstance(schedule, NeuroFuzzy):
        anfis, head = schedule.network.anfis, schedule.network.head
        sets = [part.detach().reshape(3, 2, -1) for part in anfis.sets()]
        tensors = {
            "velocity_range": schedule.velocity_range,
            "lower": schedule.acceleration_lower,
            "span": schedule.acceleration_upper - schedule.acceleration_lower,
            "centre": sets[0],
            "width": sets[1],
            "plane": anfis.consequents,  # (joint, output, rule, column)
            "unit_centre": head.centres,
            "unit_precision": 0.5 * torch.exp(-2.0 * head.log_widths),
            "unit_out": head.output_weight,
            "bias": head.output_bias,
            "reference": schedule.reference,
            "scale": schedule.scale,
        }
        network = {name: t.detach().numpy() for name, t in tensors.items()}
        for name in ("turn", "reach", "roundness"):
            network[name] = np.array(getattr(schedule, name))
    rest = torch.zeros(3, dtype=torch.float64)
    values = friction.coefficients(rest, rest).detach().numpy()
    return Numbers(
        coupling=plant.inertia_coupling.numpy(),
        gravity=plant.gravity_moment.numpy(),
        lever=plant.load_lever.numpy(),
        v_smooth=friction.v_smooth,
        constant=values,
        network=network,
    )

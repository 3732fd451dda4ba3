"""A user-defined law, and models and motions for tests."""

import torch
from torch import Tensor

from nfriction.friction import model_by_name, model_names
from nfriction.friction.laws import (
    COULOMB,
    COULOMB_VISCOUS,
    LINEAR,
    NONLINEAR,
    STRIBECK,
    VISCOUS,
    Coefficient,
    Law,
)
from nfriction.friction.models import FrictionModel

LAWS = (VISCOUS, COULOMB, COULOMB_VISCOUS, LINEAR, NONLINEAR, STRIBECK)


def quadratic(qd: Tensor, load: Tensor, coefficients: Tensor, v_smooth: float) -> Tensor:
    """Linear and quadratic drag; the latter grows with the load."""
    d1, d2 = coefficients.unbind(-1)
    return d1 * qd + d2 * load * qd * qd.abs()


QUADRATIC = Law(
    "quadratic", (Coefficient("D_1", "N m s/rad"), Coefficient("D_2", "N m s^2/rad^2")), quadratic
)


def normal(*shape: int, seed: int = 0) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(shape, dtype=torch.float64, generator=generator)


def motion(*shape: int, seed: int = 0) -> tuple[Tensor, Tensor, Tensor]:
    """Velocity, acceleration and load, partly outside the default trained range."""
    qd, qdd, load = (normal(*shape, seed=3 * seed + i) for i in range(3))
    return 10 * qd, 100 * qdd, load.abs()


@torch.no_grad()
def randomise(model: torch.nn.Module, spread: float = 1.0, seed: int = 0) -> None:
    """Change every parameter, as training could."""
    for i, p in enumerate(model.parameters()):
        p.add_(spread * normal(*p.shape, seed=1000 * seed + i).to(p))


def named_models(joints: int = 3) -> dict[str, FrictionModel]:
    """Every named model with changed parameters, and the neuro-fuzzy one with every option."""
    models: dict[str, FrictionModel] = {name: model_by_name(name)(joints) for name in model_names()}
    models["NFLFM, other options"] = model_by_name("NFLFM")(
        joints, [1e-3, 2e-3, 1e-3], v_smooth=1e-2, terms=(3, 2), head_units=4,
        acceleration="signed", interpretable=True, prior_sd=0.1, inputs=["load"],
    )  # fmt: skip
    for seed, model in enumerate(models.values()):
        randomise(model, 0.3, seed)
    return models


def warming_network() -> FrictionModel:
    """A neuro-fuzzy model of friction that falls with heat, with parameters as after a fit."""
    model = model_by_name("NFCVFM")(
        2, [0.1, 0.2, 0.5, 0.0], inputs=["heat"], terms=(3, 2), head_units=2
    )
    # Not the heat coefficients, which networks do not change.
    lower, upper = model.schedule.bounds()
    moved = torch.where(lower < upper, 0.1 * normal(len(lower)), 0.0)
    model.schedule.set_parameter_vector(moved)
    model.schedule.set_heat([3.0, 4.0], 2.0, 2e-3)
    return model.requires_grad_(False)

"""Fits by class with the classes given: those of the measured motion, sample by sample."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from nfriction.fitting.data.windows import Windows
from nfriction.fitting.equation_error import coefficient_scale
from nfriction.fitting.result.fit_result import FitResult
from nfriction.fitting.shooting.problem import ShootingProblem
from nfriction.friction.model import FrictionModel
from nfriction.papers.afem.adaptive import Adaptive
from nfriction.papers.afem.classes import AccelerationClasses
from nfriction.plant import Plant
from nfriction.recording import Recording
from nfriction.signals import Motion
from nfriction.simulation.rollout import Rollout, integrate


class Labelled(Adaptive):
    """A table by class whose class is given: it takes the place of the acceleration.

    So that whatever drives coefficients by a measured motion drives them by known classes.

    Args:
        model: the model whose law and joints are taken.
        reference: constant coefficients toward which every class is pulled, (joint, coefficient).
        sd: standard deviation around them, (joint, coefficient).
    """

    state_size = 0

    def __init__(self, model: FrictionModel, reference: Tensor, sd: Tensor) -> None:
        super().__init__(model.law, model.joints, reference)
        shape = self.raw.shape
        self._mean = reference[:, None].expand(shape).reshape(-1)
        self._sd = sd[:, None].expand(shape).reshape(-1)

    def initial_state(self, qd: Tensor, qdd: Tensor) -> Tensor:
        return torch.stack([qdd, qdd], -1)

    def prior(self) -> tuple[Tensor, Tensor]:
        return self._mean, self._sd


@dataclass(frozen=True, eq=False)
class LabelledProblem(ShootingProblem):
    """A trajectory problem whose coefficients follow given classes.

    Args:
        classes: class of every sample, (window, step, joint).
    """

    classes: Tensor | None = None

    def _integrate(
        self, plant: Plant, model: FrictionModel, q0: Tensor, qd0: Tensor, tau: Tensor, step: Tensor
    ) -> Rollout:
        assert self.classes is not None
        classes = self.classes.repeat_interleave(self.substeps, 1)
        measured = (torch.zeros_like(classes), classes)
        motion = integrate(plant, model, q0, qd0, tau, step, measured=measured)
        # What a step's derivatives are taken at must be what drove it.
        return replace(motion, qdd=torch.cat([classes, classes[:, -1:]], 1))


def labelled_model(
    model: FrictionModel,
    constant: FitResult,
    joint: Sequence[Recording],
    motions: Sequence[Motion],
    prior_sd: float,
) -> FrictionModel:
    """The model with given classes, at the constant law's coefficients."""
    values = constant.model.schedule.coefficient_sets()["always"]
    natural = coefficient_scale(model, constant.plant, joint, motions)
    sd = prior_sd * torch.maximum(values.abs(), natural)
    # Where neither tells a size, the coefficient stays free.
    sd = torch.where(sd > 0, sd, torch.inf)
    schedule = Labelled(model, values, sd)
    return FrictionModel(model.law, schedule, model.v_smooth).requires_grad_(False)


def driving_classes(classes: AccelerationClasses, cut: Windows) -> Tensor:
    """Class that drives every step of windows, those without data as the one they stand for."""
    taken = [
        torch.stack([of[known] for of, known in zip(classes.stands_for, labels.T, strict=True)], -1)
        for labels in classes.labels
    ]
    driving = torch.zeros_like(cut.tau)
    for w, (place, first, last) in enumerate(cut.spans):
        driving[w, : last - first] = taken[place][first:last].to(driving.dtype)
    return driving

"""The classes of a fit by class, and how much of it is taken."""

import logging
from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from nfriction.fitting.data.windows import Windows
from nfriction.fitting.result.fit_result import FitResult
from nfriction.friction.model import FrictionModel
from nfriction.papers.afem.adaptive import CLASSES, Adaptive
from nfriction.papers.afem.classes import AccelerationClasses, find_classes
from nfriction.papers.afem.labelled import Labelled
from nfriction.papers.afem.position_error import PositionError
from nfriction.plant import Plant
from nfriction.recording import Recording
from nfriction.signals import Motion

logger = logging.getLogger(__name__)

# How far a class may deviate from the constant law, in units of a coefficient's natural scale.
PRIOR_SD = 0.5


def adopt_classes(
    schedule: Adaptive,
    classes: AccelerationClasses | None,
    joint: Sequence[Recording],
    motions: Sequence[Motion],
    plant: Plant,
) -> AccelerationClasses:
    """Classes of the recordings, the schedule set to them."""
    if classes is None:
        classes = find_classes(schedule, joint, motions, plant.joint_names)
    elif [len(known) for known in classes.labels] != [len(r.time) for r in joint]:
        raise ValueError("`classes` are of other recordings; find them in those to be fitted.")
    elif not torch.equal(classes.thresholds, schedule.thresholds):
        raise ValueError("`classes` were found with another model's schedule.")
    for note in classes.notes:
        logger.info("%s", note)
    return classes


def settled(
    model: FrictionModel,
    labelled: FrictionModel,
    classes: AccelerationClasses,
    constant: FitResult,
    found: FitResult,
    windows: Windows,
    mixing: Tensor,
    substeps: int,
    baseline: float,
) -> FitResult:
    """Take the classes' coefficients as far as they serve where the simulation drives them."""
    schedule = model.schedule
    assert isinstance(schedule, Adaptive)
    assert isinstance(labelled.schedule, Labelled)
    flat = constant.model.schedule.coefficient_sets()["always"][:, None]
    table = labelled.schedule.values
    table = torch.stack([row[of] for row, of in zip(table, classes.stands_for, strict=True)])
    model.requires_grad_(False)
    along = [schedule.states(torch.as_tensor(m.qd), torch.as_tensor(m.qdd)) for m in found.motions]
    memory = torch.stack([along[place][first] for place, first, _ in windows.spans])
    for share in (1.0, 0.5, 0.25):
        schedule.set_coefficients(flat + share * (table - flat))
        error = PositionError(found.plant, model, windows, mixing, substeps=substeps, memory=memory)
        residuals = error.residuals(schedule.parameter_vector())
        rms = float((residuals.square().sum() / error.values).sqrt())
        if rms <= baseline:
            part = "" if share == 1.0 else f" {share:g} of the way from the constant law is taken."
            taken = replace(
                found, model=model, residual=rms, residuals=residuals,
                status=found.status + part + _said(classes),
            )  # fmt: skip
            return taken.with_warnings(constant.data_warnings)
    schedule.set_coefficients(flat.expand(-1, len(CLASSES), -1))
    return replace(
        constant, model=model,
        status=f"{constant.status} The classes simulate no better: the constant law is kept.",
    )  # fmt: skip


def _said(classes: AccelerationClasses) -> str:
    return "".join(f" {note}." for note in classes.notes)

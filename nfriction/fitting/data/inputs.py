"""Arguments of a fit, checked and converted: recordings, motions, adjustable plant terms."""

import logging
import textwrap
import warnings
from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from nfriction.fitting.options import DEFAULTS, FitOptions
from nfriction.fitting.plant_parameters import (
    PlantParameter,
    plant_parameters,
    torque_delay_term,
)
from nfriction.friction import model_by_name
from nfriction.friction.models import FrictionModel
from nfriction.plant import PendulumChain, Plant
from nfriction.recording import Recording, RecordingLike
from nfriction.recording.angles import AngleConvention
from nfriction.signals import Motion, kalman_smoother
from nfriction.simulation.rk4 import required_substeps

logger = logging.getLogger(__name__)


def as_model(model: FrictionModel | str, joints: int) -> FrictionModel:
    """A model as it is, or a new one by its name.

    Raises:
        TypeError: for anything else.
        ValueError: if no model has that name.
    """
    if isinstance(model, str):
        return model_by_name(model)(joints)
    if not isinstance(model, FrictionModel):
        raise TypeError(
            "`model` must be a friction model such as LFM(joints=3), or the name of one, got "
            f"{type(model).__name__} {textwrap.shorten(repr(model), 60)}."
        )
    return model


def as_recording_list(
    recordings: RecordingLike | Iterable[RecordingLike], plant: Plant
) -> list[Recording]:
    """The recordings of a fit as a list.

    Raises:
        TypeError: if one is something else than `Recording.of` takes.
        ValueError: if a recording is given twice.
    Warns:
        UserWarning: if only some recordings have torques.
    """
    given = Recording.many(recordings, plant=plant)
    _refuse_repeated(given)
    warn_of_undriven(given)
    return given


def _refuse_repeated(recordings: Sequence[Recording]) -> None:
    """Refuse the same data twice, by whatever name: counted twice, it would narrow intervals."""
    first: dict[str, int] = {}
    for k, recording in enumerate(recordings):
        # Blocks of a recording may hold the same rest.
        if not np.ptp(recording.q, axis=0).any():
            continue
        before = first.setdefault(recording.digest(), k)
        if before != k:
            names = (recordings[before].name or "unnamed", recording.name or "unnamed")
            raise ValueError(
                f"a fit takes every recording once, got the same data as recordings {before + 1} "
                f"({names[0]}) and {k + 1} ({names[1]}); leave one out."
            )


def warn_of_undriven(recordings: Sequence[Recording]) -> None:
    """Warn of recordings without torque beside others that have it."""
    free = [r.name or f"recording {k + 1}" for k, r in enumerate(recordings) if r.tau is None]
    if 0 < len(free) < len(recordings):
        names = ", ".join(dict.fromkeys(free))
        # Not of a category that is silenced once recordings are read. One place, so shown once.
        warnings.warn(
            f"no torque is recorded in {names}, unlike in other recordings, so nothing "
            f"is taken to drive the joints there; add the torque, or zeros where there was none.",
            stacklevel=1,
        )


def in_joint_coordinates(
    plant: Plant, model: FrictionModel, recordings: Sequence[Recording]
) -> list[Recording]:
    """The recordings in joint coordinates, checked against plant and model."""
    if not recordings:
        raise ValueError("at least one recording is needed to fit a model.")
    for recording in recordings:
        joints = recording.q.shape[1]
        if joints != plant.joints or joints != model.joints:
            raise ValueError(
                f"{recording.name}: {joints} joints recorded, the plant has {plant.joints}, the "
                f"model {model.joints}; they must agree."
            )
    conventions = {str(r.resolve_convention(plant)) for r in recordings}
    # Residuals are formed as the encoders read, by one matrix for all windows.
    if len(conventions) > 1:
        raise ValueError(
            "recordings fitted together must share one angle convention, got "
            f"{' and '.join(sorted(conventions))}."
        )
    return [r.joint_coordinates(plant) for r in recordings]


def smoothed_motions(
    joint: Sequence[Recording], motions: Sequence[Motion] | None
) -> tuple[Motion, ...]:
    """The smoothed motion of each recording in joint coordinates; those given, if they match."""
    if not motions:
        return tuple(kalman_smoother(r.time, r.q) for r in joint)
    if [len(m.q) for m in motions] != [len(r) for r in joint]:
        raise ValueError(
            f"`motions` must be one of each recording, sample by sample, got {len(motions)} of "
            f"{sum(len(m.q) for m in motions)} samples for {len(joint)} recordings of "
            f"{sum(map(len, joint))}; left out, they are computed."
        )
    return tuple(motions)


def largest_torques(joint: Sequence[Recording]) -> NDArray[np.float64]:
    """Largest torque of each joint over all recordings, (joint,) [N m; N]."""
    none = np.zeros_like(joint[0].q[0])
    return np.max([none if r.tau is None else np.abs(r.tau).max(0) for r in joint], axis=0)


def is_undriven_pendulum(plant: Plant, joint: Sequence[Recording]) -> bool:
    """True for a chain on a fixed pivot that gravity moves, without any torque."""
    fixed = isinstance(plant, PendulumChain) and not plant.first_link
    return fixed and weighs(plant) and not largest_torques(joint).any()


def weighs(plant: Plant) -> bool:
    """True for a chain whose pose matters to gravity, unlike a balanced rotor's."""
    return isinstance(plant, PendulumChain) and bool(plant.gravity_moment.any())


def adjustable_terms(
    plant: Plant,
    joint: Sequence[Recording],
    options: FitOptions = DEFAULTS,
    *,
    eccentric: bool = False,
    per_recording: bool = False,
) -> list[PlantParameter]:
    """Terms of the plant that a fit adjusts; `drag=None` includes drag for undriven pendulums.

    If encoders have an offset `per_recording`, the plant's would only be the mean of these. The
    torque's delay comes last.
    """
    delay = [torque_delay_term(options)] if options.fit_delay else []
    if not options.fit_plant:
        return delay
    largest = largest_torques(joint)
    # Over spans that are long against a step of the encoder.
    spans = [max(1, len(r) // 200) for r in joint]
    rates = [
        np.abs(r.q[k:] - r.q[:-k]) / (r.time[k:] - r.time[:-k])[:, None]
        for r, k in zip(joint, spans, strict=True)
    ]
    terms = plant_parameters(
        plant, driven=np.flatnonzero(largest).tolist(), largest_torque=float(largest.max()),
        largest_rate=max(float(rate.max()) for rate in rates),
        drag=is_undriven_pendulum(plant, joint) if options.drag is None else options.drag,
        eccentricity=eccentric, options=options,
    )  # fmt: skip
    return [t for t in terms if not (per_recording and "angle_offset" in t.change)] + delay


def advanced_torques(recordings: Sequence[Recording], delay: float) -> list[Recording]:
    """Recordings of equal length with the torque recorded `delay` [s] later; held at the ends."""
    if not delay:
        return list(recordings)
    return [r if r.tau is None else r._replace(tau=r.torque_at(r.time + delay)) for r in recordings]


def apply_encoder_offsets(
    offsets: Sequence[Sequence[float]],
    plant: Plant,
    recordings: Sequence[Recording],
    motions: Sequence[Motion],
) -> tuple[list[Recording], tuple[Motion, ...]]:
    """Recordings and motions as if their encoders had no offsets.

    Args:
        offsets: `FitResult.encoder_offsets`, one row a recording; none leaves all as it is.
        plant: the mechanism.
        recordings: in any one convention.
        motions: theirs, in joint coordinates.
    """
    if not offsets:
        return list(recordings), tuple(motions)
    matrix = measurement_matrix(plant, recordings[0].resolve_convention(plant)).numpy()
    rows = [np.array(row) for row in offsets]
    shifted = [r._replace(q=r.q + matrix @ row) for r, row in zip(recordings, rows, strict=True)]
    return shifted, tuple(replace(m, q=m.q + row) for m, row in zip(motions, rows, strict=True))


def measurement_matrix(plant: Plant, convention: AngleConvention) -> Tensor:
    """C of the measurement y = C q + const, (joint, joint): from joint to recorded coordinates."""
    unit = np.eye(plant.joints)
    return torch.as_tensor(convention.rate_from_joint(unit, plant.first_link).T.copy())


def integration_substeps(
    plant: Plant, model: FrictionModel, longest_step: float, options: FitOptions = DEFAULTS
) -> int:
    """Integration steps per sample of at most `longest_step` [s]."""
    needed, most = required_substeps(plant, model, longest_step), options.max_substeps
    if needed > most:
        logger.warning("friction needs %d substeps at rest, %d are used", needed, most)
    # Twice the present need, as coefficients may grow during the search.
    return min(1 if needed == 1 else 2 * needed, most)

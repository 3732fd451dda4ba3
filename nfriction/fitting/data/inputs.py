"""What every fit needs before it searches: joint coordinates, adjustable terms, substeps."""

import logging
import textwrap
import warnings
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from nfriction.fitting.data.windows import begins_still
from nfriction.fitting.plant_parameters import PlantParameter, plant_parameters
from nfriction.fitting.result.fit_result import FitResult
from nfriction.friction.coefficients import Constant
from nfriction.friction.models import FrictionModel
from nfriction.optim.least_squares import Step
from nfriction.plant import LinearAxis, PendulumChain, Plant
from nfriction.recording import Recording
from nfriction.recording.angles import AngleConvention
from nfriction.signals import Motion, kalman_smoother
from nfriction.simulation.rk4 import required_substeps

logger = logging.getLogger(__name__)

# Substeps beyond this say that the sign's passage is too steep for the sample time.
MOST_SUBSTEPS = 8
# An encoder that was just set to zero may flicker by some of its counts [rad].
AT_ZERO = 2e-3


def told_of(
    callback: Callable[[str, Step], bool | None] | None, stage: str
) -> Callable[[Tensor, Step], bool | None] | None:
    """A solver's callback that tells a fit's callback the stage."""
    return None if callback is None else lambda _, step: callback(stage, step)


def listed(
    model: FrictionModel, plant: Plant, recordings: Recording | Iterable[Recording]
) -> list[Recording]:
    """The recordings of a fit as a list.

    Raises:
        TypeError: if model, plant or recordings are something else.
        ValueError: if a recording is given twice.
    Warns:
        UserWarning: if only some recordings have torques.
    """
    many = [recordings] if isinstance(recordings, Recording) else recordings
    given = list(many) if isinstance(many, Iterable) and not isinstance(many, str) else [many]
    wanted: list[tuple[str, object, tuple[type, ...], str]] = [
        ("model", model, (FrictionModel,), "a friction model such as LFM(joints=3)"),
        ("plant", plant, (PendulumChain, LinearAxis), "a PendulumChain or LinearAxis"),
        *(("recordings", r, (Recording,), "one Recording or a list of them") for r in given),
    ]
    for name, value, kinds, what in wanted:
        if not isinstance(value, kinds):
            raise TypeError(f"`{name}` must be {what}, got {textwrap.shorten(repr(value), 60)}.")
    _refuse_repeated(given)
    warn_of_undriven(given)
    return given


def _refuse_repeated(recordings: Sequence[Recording]) -> None:
    """Whatever a copy is called: the same errors counted twice would narrow the intervals."""
    first: dict[str, int] = {}
    for k, recording in enumerate(recordings):
        # Cut into blocks, recordings may hold the same rest.
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
    """Say which recordings count as undriven where others have torques."""
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
    if len(conventions) > 1:
        raise ValueError(
            "recordings fitted together must share one angle convention, got "
            f"{' and '.join(sorted(conventions))}."
        )
    return [r.joint_coordinates(plant) for r in recordings]


def motions_of(joint: Sequence[Recording], motions: Sequence[Motion] | None) -> tuple[Motion, ...]:
    """The smoothed motion of each recording in joint coordinates, found where none are given."""
    if not motions:
        return tuple(kalman_smoother(r.time, r.q) for r in joint)
    if [len(m.q) for m in motions] != [len(r) for r in joint]:
        raise ValueError(
            f"`motions` must be one of each recording, sample by sample, got {len(motions)} of "
            f"{sum(len(m.q) for m in motions)} samples for {len(joint)} recordings of "
            f"{sum(map(len, joint))}; left out, they are computed."
        )
    return tuple(motions)


def constant_schedule(model: FrictionModel) -> Constant:
    """The model's schedule, which must be constant."""
    if not isinstance(model.schedule, Constant):
        raise ValueError(f"cannot fit coefficients of type {type(model.schedule).__name__}.")
    return model.schedule


def _largest_torques(joint: Sequence[Recording]) -> NDArray[np.float64]:
    """Of every joint, (joint,)."""
    still = np.zeros_like(joint[0].q[0])
    return np.max([still if r.tau is None else np.abs(r.tau).max(0) for r in joint], axis=0)


def _largest_rate(joint: Sequence[Recording]) -> float:
    """Over spans long against a step of the encoder."""
    spans = [max(1, len(r) // 200) for r in joint]
    rates = [
        np.abs(r.q[k:] - r.q[:-k]) / (r.time[k:] - r.time[:-k])[:, None]
        for r, k in zip(joint, spans, strict=True)
    ]
    return max(float(rate.max()) for rate in rates)


def swings_freely(plant: Plant, joint: Sequence[Recording]) -> bool:
    """Whether nothing drives a chain on a fixed pivot."""
    fixed = isinstance(plant, PendulumChain) and not plant.first_link
    return fixed and not _largest_torques(joint).any()


def adjustable_terms(
    plant: Plant,
    joint: Sequence[Recording],
    fit_plant: bool,
    drag: bool | None,
    eccentricity: bool = False,
    *,
    zeroed_once: bool = True,
) -> list[PlantParameter]:
    """Terms of the plant that a fit adjusts; `drag` None means where a chain swings freely.

    Beside zeros of each recording, an angle offset would be no more than their mean.
    """
    if not fit_plant:
        return []
    if drag is None:
        drag = swings_freely(plant, joint)
    largest = _largest_torques(joint)
    terms = plant_parameters(
        plant, driven=np.flatnonzero(largest).tolist(), largest_torque=float(largest.max()),
        largest_rate=_largest_rate(joint), drag=drag, eccentricity=eccentricity,
    )  # fmt: skip
    return [t for t in terms if zeroed_once or "angle_offset" not in t.change]


def is_eccentric(asked: bool | None, known: Iterable[str]) -> bool:
    """Whether to fit eccentric encoders; None means where an earlier fit's plant terms have them.

    A chain of fits asks for them once, in its first.
    """
    return bool(asked) or (asked is None and any(name.startswith("encoder ") for name in known))


def zeroed_each(plant: Plant, recordings: Sequence[Recording]) -> bool:
    """Whether it looks as if encoders were set to zero at the start of each recording.

    Links that dry friction holds stop where they stop. Where a driven chain begins several
    recordings at rest, and all of its encoders read zero each time, they were set to it.
    """
    return (
        isinstance(plant, PendulumChain)
        and bool(_largest_torques(recordings).any())
        and len(recordings) > 1
        and all(begins_still(r) and np.abs(r.q[0]).max() <= AT_ZERO for r in recordings)
    )


def zeros_serve(start: FitResult, motions: Sequence[Motion], each: bool) -> bool:
    """Whether an earlier fit has zeros of just these recordings, or none where none are sought."""
    if not each:
        return not start.zeros
    pairs = zip(start.motions, motions, strict=False)
    return len(start.zeros) == len(motions) and all(np.array_equal(a.q, b.q) for a, b in pairs)


def at_zeros(
    zeros: Sequence[Sequence[float]],
    plant: Plant,
    recordings: Sequence[Recording],
    motions: Sequence[Motion],
) -> tuple[list[Recording], tuple[Motion, ...]]:
    """Recordings and motions as if their encoders had no zeros of their own.

    Args:
        zeros: of a `FitResult`; where there are none, all stays.
        plant: the mechanism.
        recordings: one for each row of `zeros`.
        motions: theirs, in joint coordinates.
    """
    if not zeros:
        return list(recordings), tuple(motions)
    mixing = mixing_of(plant, recordings[0].resolve_convention(plant)).numpy()
    off = [np.array(zero) for zero in zeros]
    shifted = [r._replace(q=r.q + mixing @ z) for r, z in zip(recordings, off, strict=True)]
    return shifted, tuple(replace(m, q=m.q + z) for m, z in zip(motions, off, strict=True))


def mixing_of(plant: Plant, convention: AngleConvention) -> Tensor:
    """Matrix from joint coordinates to the recordings', offsets aside."""
    unit = np.eye(plant.joints)
    return torch.as_tensor(convention.rate_from_joint(unit, plant.first_link).T.copy())


def substeps_of(plant: Plant, model: FrictionModel, joint: Sequence[Recording]) -> int:
    """Integration steps to a sample."""
    step = max(r.longest_step for r in joint)
    needed = required_substeps(plant, model, step)
    if needed > MOST_SUBSTEPS:
        logger.warning("friction needs %d substeps at rest, %d are used", needed, MOST_SUBSTEPS)
    # Twice what is needed now, as coefficients may grow on the way.
    return min(1 if needed == 1 else 2 * needed, MOST_SUBSTEPS)

"""A constant law by single shooting with SciPy: what one writes without a library of one's own.

Friction, ratios of inertia, gravity and armature, and angle offsets at once, within the bounds that
a fit of ours has, but without priors: `scipy.optimize.least_squares` on the position error of whole
recordings, simulated from their first states. That is how the baselines on the cards of the
recordings came about. Friction starts where the torques of the smoothed motion put it, and the
first second counts before the first three, and those before all: from further away it fails.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import least_squares

from nfriction import Recording
from nfriction.fitting.adjusted_plant import PlantParameter, adjusted_buffers
from nfriction.fitting.fit import fit
from nfriction.fitting.plant_parameters import plant_parameters
from nfriction.friction.models import FrictionModel
from nfriction.simulation.rollout import rollout
from nfriction.simulation.validate import required_substeps

Array = NDArray[np.float64]
SECONDS = (1.0, 3.0, np.inf)
# A simulation that diverges is off by no more [rad or m].
LOST = 9.0
STEP = 1e-5
# Friction that needs more would take minutes to simulate.
MOST_SUBSTEPS = 20
ADJUSTED = ("inertia", "gravity", "armature", "mass", "angle offset")


def single_shooting(
    model: FrictionModel,
    plant: Any,
    recordings: Sequence[Recording],
    states: Sequence[tuple[Array, Array] | None],
) -> Any:
    """Set the model to what was found, and return the plant.

    Args:
        model: of a constant law; changed in place.
        plant: the mechanism as given.
        recordings: as they are written.
        states: initial position and velocity of each, as they are written; None for the smoothed
            motion's.
    """
    motions = fit(model, plant, recordings, method="equation_error").motions
    driven = np.flatnonzero(sum(np.abs(_torque(r)).sum(0) for r in recordings))
    terms = [
        t for t in plant_parameters(plant, driven=driven.tolist()) if t.name.startswith(ADJUSTED)
    ]
    starts = [
        (motion.q[0], motion.qd[0])
        if state is None
        else (r.resolve_convention(plant).position_to_joint(state[0]),
              r.resolve_convention(plant).rate_to_joint(state[1]))
        for r, motion, state in zip(recordings, motions, states, strict=True)
    ]  # fmt: skip
    problem = _Problem(model, plant, terms, recordings, starts)
    x = problem.start()
    lower, upper = problem.bounds()
    free = lower < upper
    lower, upper = lower[free], upper[free]

    def errors(some: Array, seconds: float) -> Array:
        x[free] = some
        return problem.errors(x, seconds)

    for seconds in SECONDS:
        inside = x[free].clip(lower + STEP, upper - STEP)
        x[free] = least_squares(
            errors, inside, bounds=(lower, upper), x_scale="jac", diff_step=STEP, max_nfev=50,
            args=(seconds,),
        ).x  # fmt: skip
    return problem.at(x)


class _Problem:
    """Position errors as a function of ratios, offsets and coefficients in one row."""

    def __init__(
        self,
        model: FrictionModel,
        plant: Any,
        terms: list[PlantParameter],
        recordings: Sequence[Recording],
        starts: Sequence[tuple[Array, Array]],
    ) -> None:
        self.model, self.plant, self.terms, self.recordings = model, plant, terms, recordings
        self.starts = starts
        self.joint = [r.joint_coordinates(plant) for r in recordings]
        self.conventions = [r.resolve_convention(plant) for r in recordings]
        # Coefficients in units of the largest of their kind.
        values = model.schedule.values
        size = values.abs().amax(0).expand_as(values).reshape(-1).clamp_min(1e-6)
        self.scale = np.concatenate([np.ones(len(terms)), size])

    def start(self) -> Array:
        coefficients = self.model.schedule.parameter_vector()
        return np.concatenate([np.zeros(len(self.terms)), coefficients]) / self.scale

    def bounds(self) -> tuple[Array, Array]:
        low, high = self.model.schedule.bounds()
        of_terms = np.array([(t.lower, t.upper) for t in self.terms]).reshape(-1, 2).T
        low, high = (np.concatenate(x) for x in zip(of_terms, (low, high), strict=True))
        return low / self.scale, high / self.scale

    def at(self, x: Array) -> Any:
        """Set the model, and return the plant."""
        count, vector = len(self.terms), torch.as_tensor(x * self.scale)
        self.model.schedule.set_parameter_vector(vector[count:])
        return self.plant.replace(**adjusted_buffers(self.plant, self.terms, vector[:count]))

    def errors(self, x: Array, seconds: float) -> Array:
        plant, rows = self.at(x), []
        for own, joint, convention, (q0, qd0) in zip(
            self.recordings, self.joint, self.conventions, self.starts, strict=True
        ):
            count = int(np.searchsorted(own.time - own.time[0], seconds))
            substeps = required_substeps(plant, self.model, joint.longest_step)
            error = np.full_like(own.q[:count], LOST)
            if substeps <= MOST_SUBSTEPS:
                run = rollout(
                    plant, self.model, torch.as_tensor(q0), torch.as_tensor(qd0),
                    torch.as_tensor(_torque(joint)[: count - 1]), substeps=substeps,
                    sample_time=torch.as_tensor(np.diff(own.time[:count])), gradients=False,
                )  # fmt: skip
                error = convention.position_from_joint(run.q.numpy()) - own.q[:count]
            rows.append(np.nan_to_num(error, nan=LOST).clip(-LOST, LOST).ravel())
        return np.concatenate(rows)


def _torque(recording: Recording) -> Array:
    return np.zeros_like(recording.q) if recording.tau is None else recording.tau.copy()

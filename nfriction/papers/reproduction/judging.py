"""A fitted model on every recording of its bench: both drives, and what the figures show."""

from typing import Any

import numpy as np
import torch

from nfriction.evaluation.score import RMSE, score
from nfriction.friction.constant import Constant
from nfriction.friction.model import FrictionModel
from nfriction.papers.reproduction.workspace import Array, Bench
from nfriction.plant import PendulumChain
from nfriction.recording import Recording
from nfriction.signals import causal_motion
from nfriction.simulation.rk4 import required_substeps
from nfriction.simulation.rollout import rollout

COUNTS = 8192
"""Counts a revolution of the papers' encoders, four edges to each of 2048 lines."""


def judge(
    bench: Bench, plant: PendulumChain, model: FrictionModel
) -> tuple[dict[str, Any], dict[str, Array]]:
    """Position errors on every recording by name, and simulated positions of the test recordings.

    The coefficients are driven by the simulated motion, which is honest, and also by the measured
    one, as in the papers; with constant coefficients the two are the same.
    """
    scores: dict[str, Any] = {}
    simulated: dict[str, Array] = {}
    for split, recordings in (("train", bench.train), ("test", bench.test)):
        for recording in recordings:
            state = bench.states[recording.name]
            found = score(
                plant,
                model,
                recording,
                motion=bench.motions[recording.name],
                initial_state=state,
            )
            entry: dict[str, Any] = found.to_dict() | {"split": split}
            driven = found.simulated
            if not isinstance(model.schedule, Constant):
                driven = driven_by_measurement(plant, model, recording, state)
            entry["measured_drive"] = RMSE.of(driven - recording.q).to_dict()
            scores[recording.name] = entry
            if split == "test":
                simulated[recording.name] = found.simulated
                simulated[f"{recording.name}_measured_drive"] = driven
    return scores, simulated


def driven_by_measurement(
    plant: PendulumChain,
    model: FrictionModel,
    recording: Recording,
    state: tuple[Array, Array],
) -> Array:
    """Positions of a free run whose coefficients follow the measured motion, as in the papers.

    Velocity and acceleration are those that a controller has: frequency counting and filters.

    Args:
        plant: the mechanism.
        model: the friction model.
        recording: what was measured.
        state: q0 and qd0 in the recording's convention.

    Returns:
        Positions in the recording's convention, (sample, joint).

    References:
        TLRIP paper, friction experiment (2048 pulses, frequency counting, second-order filter).
    """
    convention, first = recording.resolve_convention(plant), plant.first_link
    joint = recording.joint_coordinates(plant)
    motion = causal_motion(joint.time, joint.q, COUNTS)
    q0 = convention.position_to_joint(np.asarray(state[0]), first)
    qd0 = convention.rate_to_joint(np.asarray(state[1]), first)
    step = np.diff(joint.time)
    with torch.no_grad():
        run = rollout(
            plant, model, torch.tensor(q0), torch.tensor(qd0), sample_time=torch.tensor(step),
            substeps=required_substeps(plant, model, float(step.max())), drive="measured",
            measured=(torch.tensor(motion.qd[:-1]), torch.tensor(motion.qdd[:-1])),
        )  # fmt: skip
    return convention.position_from_joint(run.q.numpy(), first)

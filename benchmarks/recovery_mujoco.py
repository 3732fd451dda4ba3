"""MuJoCo's system identification toolbox on the recordings that `recovery` simulates.

It is given more than a fit of ours: the true plant, and bounds around the true friction. Its
damping and friction loss are viscous and Coulomb friction; only about rest does the latter yield
in another way than the smooth sign that made the recordings. Needs `mujoco[sysid]`.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import peers
from numpy.typing import NDArray

from nfriction import PendulumChain, Recording
from nfriction.signals import Motion

Array = NDArray[np.float64]

# Where its search ends, in units of the truth.
MOST = 10.0
TERMS = ("damping", "frictionloss")
# As stiff as its solver takes at this time step: the softer default is off by 2 mrad within 2 s.
FRICTION_SOLREF = (2 * peers.DT, 1.0)


@dataclass(frozen=True)
class Found:
    """Estimates of the toolbox of viscous and Coulomb coefficients, each (joint, 2)."""

    values: Array
    half_widths: Array
    at_bounds: tuple[str, ...]


def identified(
    plant: PendulumChain,
    recording: Recording,
    motion: Motion,
    truth: Array,
    start: float,
    length: float | None,
) -> Found:
    """Identify damping and friction loss of every joint.

    Args:
        plant: the mechanism that made the recording.
        recording: in joint coordinates.
        motion: of it, smoothed; gives the states that windows start from.
        truth: viscous and Coulomb coefficients, (joint, 2).
        start: where the search starts, in units of the truth.
        length: of the windows [s]; None simulates the whole recording from its first state.
    """
    from mujoco import MjSpec, sysid  # type: ignore[attr-defined]

    spec = MjSpec.from_string(peers.mjcf(plant, *truth.T))
    names = [f"joint{i + 1}" for i in range(plant.joints)]
    for name, joint in zip(names, spec.joints, strict=True):
        joint.name = name
        joint.solref_friction = FRICTION_SOLREF
    parameters = sysid.ParameterDict()
    for name, row in zip(names, truth.tolist(), strict=True):
        for term, true in zip(TERMS, row, strict=True):
            setting = partial(_set, name, term)
            parameters.add(
                sysid.Parameter(f"{name} {term}", start * true, 0, MOST * true, modifier=setting)
            )
    sequences = _sequences(spec, names, recording, motion, length)
    residual = sysid.build_residual_fn(
        models_sequences=[sequences], n_threads=1, resample_true=False
    )
    found, result = sysid.optimize(parameters, residual, verbose=False)
    left, _, _ = residual(result.x, found)
    _, half = sysid.calculate_intervals([np.ravel(r) for r in left], result.jac)
    values = found.as_vector()
    lower, upper = found.get_bounds()
    near = np.minimum(values - lower, upper - values) <= 1e-6 * upper
    at_bounds = tuple(key for key, at in zip(found.keys(), near, strict=True) if at)
    return Found(values.reshape(truth.shape), np.reshape(half, truth.shape), at_bounds)


def _sequences(
    spec: Any, names: Sequence[str], recording: Recording, motion: Motion, length: float | None
) -> Any:
    """The recording's windows in the toolbox's terms."""
    from mujoco import sysid

    model = spec.compile()
    steps = len(recording) - 1 if length is None else round(length / peers.DT)
    clock = peers.DT * np.arange(steps + 1)
    signals = [(f"{name}_qpos", 1, sysid.SignalType.MjStateQPos) for name in names]
    firsts = range(0, len(recording) - steps, steps)
    return sysid.ModelSequences(
        "rig",
        spec,
        [str(first) for first in firsts],
        [sysid.create_initial_state(model, motion.q[k], motion.qd[k]) for k in firsts],
        [sysid.TimeSeries(clock, np.zeros((steps + 1, 0))) for _ in firsts],
        [
            sysid.TimeSeries.from_custom_map(clock, recording.q[k : k + steps + 1], signals)
            for k in firsts
        ],
        allow_missing_sensors=True,
    )


def _set(joint: str, term: str, spec: Any, parameter: Any) -> None:
    """Write a parameter into a model's specification."""
    value, owner = float(parameter.value[0]), spec.joint(joint)
    if term == "damping":
        # A number, or coefficients of a polynomial in the velocity, linear term first.
        owner.damping = value if np.ndim(owner.damping) == 0 else [value, *owner.damping[1:]]
    else:
        owner.frictionloss = value

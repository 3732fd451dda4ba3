"""Time-stepping with dry friction that truly sticks: joints stop instead of creeping.

A smoothed sign lets a joint that ought to rest creep at a share of its smoothing velocity. Here
friction is an impulse that at most stops its joint within the step; the torque that holds a joint
below breakaway is solved for, not modelled.
"""

import logging
from collections.abc import Callable

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from tqdm import tqdm

from nfriction import codegen
from nfriction.simulation.protocols import Friction, Plant, RolloutInputs, as_stateful

logger = logging.getLogger(__name__)

# In units of the smoothing velocity: from there on a joint slides, with the law's friction.
SLIDING = 5.0
# Gauss-Seidel sweeps over the joints' impulses; a single joint takes one.
SWEEPS = 20


def moreau_step(
    plant: Plant,
    friction: Friction,
    q: Tensor,
    qd: Tensor,
    tau: Tensor,
    coefficients: Tensor,
    step: Tensor,
) -> tuple[Tensor, Tensor, Tensor]:
    """One semi-implicit Euler step with friction that stops a joint, then holds it.

    The impulse of friction brings each joint to rest, limited to what the law gives while it
    slides. With several joints impulses are found in turns (projected Gauss-Seidel).

    Args:
        plant: the mechanism.
        friction: friction model.
        q, qd: state at the start of the step, (*batch, joint).
        tau: torque over the step, (*batch, joint).
        coefficients: held over the step, (*batch, joint, coefficient).
        step: its length [s], (*batch, 1).

    Returns:
        q and qd at the end of the step, and the mean qdd over it.

    References:
        M. Duclusaud et al., Extended friction models for the physics simulation of servo
        actuators, ICRA 2025 (the stop torque of one joint).
        J. J. Moreau, in: Nonsmooth Mechanics and Applications, Springer (1988), 1-82.
    """
    load, slow = plant.load(q, qd), SLIDING * getattr(friction, "v_smooth", 0.0)
    sliding = torch.clamp(qd.abs(), min=slow)
    most = (step * friction.torque(sliding, load, coefficients)).unbind(-1)
    least = (step * friction.torque(-sliding, load, coefficients)).unbind(-1)
    zero = torch.zeros_like(qd)
    rest = plant.forward_dynamics(q, zero, zero)
    unit = torch.eye(plant.joints, dtype=qd.dtype, device=qd.device)
    inverse = [
        (plant.forward_dynamics(q, zero, zero + unit[j]) - rest).unbind(-1)
        for j in range(plant.joints)
    ]
    if getattr(plant, "has_gear", False):
        # A gear's loss is a share of the torque without friction, which the impulses add.
        drag = friction.torque(qd, load, coefficients)
        taken = sum(torch.stack(c, -1) * drag[..., j : j + 1] for j, c in enumerate(inverse))
        qdd = plant.forward_dynamics(q, qd, tau - drag) + taken
    else:
        qdd = plant.forward_dynamics(q, qd, tau)
    v = list((qd + step * qdd).unbind(-1))
    impulse = list(zero.unbind(-1))
    for _ in range(SWEEPS if plant.joints > 1 else 1):
        for j, column in enumerate(inverse):
            stopping = impulse[j] + v[j] / column[j]
            found = torch.minimum(torch.maximum(stopping, least[j]), most[j])
            change, impulse[j] = found - impulse[j], found
            v = [v[i] - column[i] * change for i in range(plant.joints)]
    after = torch.stack(v, -1)
    return q + step * after, after, (after - qd) / step


class _Stepper:
    """Steps whose coefficients follow their own motion, compiled where there is a compiler.

    A call costs more than its arithmetic, so a step maps one array to another: position, velocity,
    acceleration, then torque and step length.
    """

    def __init__(self, plant: Plant, friction: Friction) -> None:
        self.plant, self.friction = plant, friction
        self._compiled: Callable[..., list[NDArray[np.float64]]] | None = None
        example = torch.full((4 * plant.joints + 1,), 1e-3, dtype=torch.float64)
        try:
            self._compiled = codegen.compile_function(self._after, [example]).bound()
        except codegen.CodegenError as error:
            logger.warning("stiction is simulated in eager torch, slowly: %s", error)

    def _after(self, given: Tensor) -> Tensor:
        joints = self.plant.joints
        q, qd, qdd, tau, step = given.split([joints] * 4 + [1], -1)
        held = self.friction.coefficients(qd, qdd)
        return torch.cat(moreau_step(self.plant, self.friction, q, qd, tau, held, step), -1)

    def __call__(self, given: NDArray[np.float64]) -> NDArray[np.float64]:
        if self._compiled is None:
            return self._after(torch.from_numpy(given)).numpy()
        return self._compiled(len(given), given.reshape(-1))[0]


@torch.no_grad()
def simulate_stiction(
    plant: Plant, friction: Friction, inputs: RolloutInputs, progress: bool
) -> tuple[Tensor, ...]:
    """States at every sample: q, qd, qdd, each (*batch, steps + 1, joint).

    Raises:
        ValueError: if the coefficients have a hidden state.
    """
    if as_stateful(friction) is not None:
        raise ValueError(
            'scheme="time_stepping" does not simulate coefficients with a hidden state; use '
            'scheme="rk4".'
        )
    q, qd, tau, step = inputs.q0, inputs.qd0, inputs.tau, inputs.step
    joints, steps = q.shape[-1], step.shape[-1]
    shape = torch.broadcast_shapes(q.shape[:-1], tau.shape[:-2], step.shape[:-1])
    inner = (step / inputs.substeps).expand(*shape, steps)[..., None]
    each = torch.cat([tau.expand(*shape, steps, joints), inner], -1)
    driven = each.reshape(-1, steps, joints + 1).to("cpu", torch.float64).numpy()
    first = torch.cat([q, qd, plant.forward_dynamics(q, qd, tau[..., 0, :])], -1)
    given = np.zeros((len(driven), 4 * joints + 1))
    given[:, : 3 * joints] = first.expand(*shape, -1).reshape(-1, 3 * joints).cpu()
    stepper, states = _Stepper(plant, friction), np.empty((steps + 1, len(driven), 3 * joints))
    states[0] = given[:, : 3 * joints]
    for k in tqdm(range(steps), disable=not progress, unit="step", leave=False):
        given[:, 3 * joints :] = driven[:, k]
        for _ in range(inputs.substeps):
            given[:, : 3 * joints] = stepper(given)
        states[k + 1] = given[:, : 3 * joints]
    motion = torch.from_numpy(states).transpose(0, 1).reshape(*shape, steps + 1, 3 * joints)
    return motion.to(q).chunk(3, -1)

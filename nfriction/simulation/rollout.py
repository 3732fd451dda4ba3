"""Rollouts: the motion of a plant with friction by classical Runge-Kutta steps.

Coefficients that depend on the motion are held over a step, as in a controller at the sample rate;
this also breaks the algebraic loop in which friction depends on the acceleration and the
acceleration on friction. The next step is `nfriction.fitting.fit`: the coefficients with which such
a simulation follows a recording.
"""

from dataclasses import replace
from typing import Literal, get_args

import torch
from torch import Tensor

from nfriction.simulation import validate
from nfriction.simulation.adjoint import adjoint_rollout, wants_gradients
from nfriction.simulation.compiled import Backend, System, integrate_compiled, wants_compiled
from nfriction.simulation.memory_step import memory_of, memory_step
from nfriction.simulation.protocols import (
    Friction,
    NoFriction,
    Plant,
    Rollout,
    RolloutInputs,
    StepFunction,
    with_sample_time,
)
from nfriction.simulation.rk4 import rk4_step, simulate_eager
from nfriction.simulation.stiction import simulate_stiction

Scheme = Literal["rk4", "time_stepping"]


@validate.outside_inference_mode
def rollout(
    plant: Plant,
    friction: Friction | None,
    q0: Tensor,
    qd0: Tensor,
    tau: Tensor | None = None,
    *,
    sample_time: float | Tensor = 1e-3,
    steps: int | None = None,
    substeps: int = 1,
    scheme: Scheme = "rk4",
    drive: Literal["simulated", "measured"] = "simulated",
    measured: tuple[Tensor, Tensor] | None = None,
    hidden_state: Tensor | None = None,
    law_state: Tensor | None = None,
    gradients: bool | None = None,
    backend: Backend = "auto",
    threads: int = 1,
) -> Rollout:
    """Simulate a plant with friction from an initial state.

    Models from `fit` and `load` require no gradients and are compiled, thousands of times faster
    than eager torch. To train through a rollout call `model.requires_grad_(True)` first; newly
    constructed models require gradients.

    Args:
        plant: the mechanism, e.g. `rigs.tlrip()`.
        friction: friction model, or None for no friction.
        q0, qd0: initial state [rad, rad/s] in joint coordinates, shape (*batch, joint). Like all
            tensors here they may be arrays or lists; the run has the widest type among all.
        tau: joint torque [N m] held over each step, (steps, joint) or (*batch, steps, joint).
        sample_time: sample time [s], a number, (steps,) or (*batch, steps).
        steps: number of samples after the first; optional if `tau` or `sample_time` implies it.
        substeps: integration steps per sample. A hidden state advances once per sample; other
            coefficients are evaluated at each of these steps.
        scheme: `"rk4"` integrates friction as a smooth function of velocity, so that joints creep
            where they ought to rest. `"time_stepping"` takes semi-implicit steps of first order
            in which dry friction stops a joint and holds it, however steep; it needs shorter
            steps, and has no gradients or measured drive.
        drive: motion that drives the coefficients: `"simulated"`, or `"measured"` as in the papers.
        measured: velocity and acceleration for `drive="measured"`, each (*batch, steps, joint).
        hidden_state: of the coefficients after the first sample (see `Schedule.states`), (*batch,
            joint, state_size), to continue an earlier motion; by default that of the sample alone.
        law_state: internal state of a friction law with memory at the start, (*batch, joint,
            state), to continue an earlier motion; by default undeflected.
        gradients: make the motion differentiable; by default if any input requires it, `backend` is
            not `"compiled"`, and there are at most 10,000 steps.
        backend: `"torch"` steps in eager torch; `"compiled"` compiles the same definition (no
            gradients); `"auto"` compiles if possible. Its gradients come from an adjoint sweep, of
            first order only; for higher ones `"torch"` records every step.
        threads: number of threads that share a compiled batch.

    Returns:
        Rollout with `q` and `qd` of shape (*batch, steps + 1, joint). Divergence is not an error:
        the motion is NaN from `diverged_at` on.

    Raises:
        TypeError: if plant or friction has another type.
        ValueError: if shapes do not fit, inputs are not finite, friction is too steep at rest for
            a stable integration, or the scheme does not support an option.
        CodegenError: if `backend="compiled"` and the model cannot be compiled.
    """
    model = NoFriction(plant.joints) if friction is None else friction
    inputs = validate.validate_inputs(plant, model, q0, qd0, tau, sample_time, steps, substeps)
    inputs = replace(inputs, measured=validate.validate_measured(drive, measured, inputs))
    model = with_sample_time(model, inputs.step)
    inputs = validate.with_states(inputs, model, hidden_state, law_state)
    if scheme not in get_args(Scheme):
        raise ValueError(f"`scheme` must be one of {get_args(Scheme)}, got {scheme!r}.")
    if scheme == "time_stepping":
        return Rollout.of(inputs, simulate_stiction(plant, model, inputs, gradients))
    system = System.of(plant, model)
    validate.require_stability(system, inputs)
    if gradients is None:
        gradients = backend != "compiled" and wants_gradients(inputs, system.tensors.values())
    states = simulate(system, inputs, gradients, backend, threads)
    return Rollout.of(inputs, states)


def integrate(plant: Plant, friction: Friction | None, inputs: RolloutInputs) -> Rollout:
    """`rollout` without checks and gradients, for searches whose trials may be unstable."""
    model = NoFriction(plant.joints) if friction is None else friction
    inputs = validate.with_states(inputs, model, inputs.hidden_state, inputs.law_state)
    return Rollout.of(inputs, simulate(System.of(plant, model), inputs))


def simulate(
    system: System,
    inputs: RolloutInputs,
    gradients: bool = False,
    backend: Backend = "auto",
    threads: int = 1,
) -> tuple[Tensor, ...]:
    """States q, qd, qdd, each (*batch, steps + 1, joint), from the backend that supports them."""
    compiled = wants_compiled(backend, inputs.q0, gradients)
    step_function: StepFunction = rk4_step if memory_of(system.friction) is None else memory_step
    states = None
    # With gradients the motion itself may still be compiled: the adjoint sweep adds them.
    if gradients and backend == "auto":
        states = adjoint_rollout(
            lambda: simulate(system, inputs, threads=threads), system.plant, system.friction, inputs
        )
    elif compiled:
        states = integrate_compiled(system, inputs, backend, threads, step_function=step_function)
    if states is None:
        with torch.set_grad_enabled(gradients and torch.is_grad_enabled()):
            states = simulate_eager(system.plant, system.friction, inputs, step_function)
    return states

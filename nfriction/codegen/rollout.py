"""Compile the rollout of a plant with friction, and run many at once."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from nfriction.codegen.batch import (
    Kernel,
    common_rows,
    parameter_rows,
    rows_of,
    series,
    to_array,
)
from nfriction.codegen.graph import FunctionalModule
from nfriction.codegen.rollout_program import LAYOUT, ForcedSystem, RolloutDriver, arrange
from nfriction.codegen.scalar import SelfCheckFailed

# Of accelerations over steps of 0.1 ms: velocities of 10 rad/s round to 2e-15, rates to 2e-11.
_CHECK_TOLERANCE = 1e-9


@dataclass(frozen=True)
class RolloutSignals:
    """Sample times of rollouts, and all that drives the motion.

    Attributes:
        steps: number of samples.
        time_step: sample time [s]: a number, (steps,) or (candidate, steps).
        tau: joint torque held over each sample [N m], (steps, joint) or (candidate, steps, joint);
            zero by default.
        drive: measured velocity and acceleration that drive the coefficients instead of the
            simulated ones, each (steps, joint) or (candidate, steps, joint).
        substeps: steps to each sample. Coefficients with a memory are held over the sample; others
            are held anew at each of these steps.
        memory: memory of the coefficients after the first sample, (candidate, joint, state_size),
            one row is for all; by default that of this sample alone.
        law_state: of a friction law with memory at the start, (candidate, joint, state), one row is
            for all; by default zero.
    """

    steps: int
    time_step: Any
    tau: Any = None
    drive: tuple[Any, Any] | None = None
    substeps: int = 1
    memory: Any = None
    law_state: Any = None


class Trajectories(NamedTuple):
    """Simulated motions, NumPy or torch as the initial state was.

    Attributes:
        q, qd: positions and velocities [rad, rad/s], shape (candidate, sample + 1, joint); NaN
            from where a candidate diverged.
        qdd: acceleration known at each sample [rad/s^2]: of the first stage of the step before it,
            at the start that without friction; same shape.
        diverged_at: number of the sample at which the state was not finite or too fast, -1 where
            it never was, shape (candidate,).
        law_state: of a friction law with memory, (candidate, sample + 1, joint, state); else None.
    """

    q: Any
    qd: Any
    qdd: Any
    diverged_at: Any
    law_state: Any = None


class CompiledRollout:
    """Rollouts of a plant with friction, traced at once and compiled at the first call.

    Parameters and floating-point buffers stay inputs: they are read at every call, so a fit may
    change them, and may differ from candidate to candidate. Everything else (Python numbers,
    integer and boolean buffers, the modules' structure) is baked in.

    Args:
        plant: module with `joints`, `forward_dynamics` and `load`.
        friction: module with `coefficients` and `torque`; one whose coefficients have a memory
            also has `state_size` > 0, `initial_state`, `advance` and `coefficients_from`.
        step: `(plant, friction, q, qd, tau, coefficients, step) -> (q, qd, qdd)`, which is
            repeated; for instance `nfriction.simulation.rk4.rk4_step`.

    Attributes:
        parameter_names: names under which `parameters` may be given.
        digest: a hash of all that is computed; code of another plant and friction model with the
            same digest computes the same, given the same parameters.

    Raises:
        UnsupportedOperation: the modules use an operation that has no scalar form here.
        TypeError: one of them is no module.
    """

    def __init__(self, plant: Any, friction: Any, step: Callable[..., Any]) -> None:
        for name, module in (("plant", plant), ("friction", friction)):
            if not isinstance(module, nn.Module):
                raise TypeError(f"`{name}` must be a torch module, got {type(module).__name__}.")
        system = ForcedSystem(plant, friction, step)
        self._system = system
        self.joints = int(system.plant.joints)
        self._module = FunctionalModule(system)
        self.parameter_names = tuple(self._module.shapes)
        self._traced = self._module.trace(self._examples())
        self.digest = f"{self._module.shapes} {self._traced.digest()}"

    @cached_property
    def _kernel(self) -> Kernel:
        program = arrange(self._traced, self._system.law_size)
        return Kernel(lambda width: RolloutDriver(program, width), LAYOUT)

    def source(self, width: int = 0) -> str:
        """LLVM IR that computes so many candidates together, 0 for one at a time."""
        return self._kernel.source(width)

    def _examples(self) -> dict[str, Tensor]:
        n, device = self.joints, self._module.device
        generator = torch.Generator().manual_seed(0)
        shapes = {"q": 1.0, "qd": 3.0, "tau": 1.0, "seen_qd": 3.0, "seen_qdd": 10.0}
        found = {
            name: scale * torch.randn(n, generator=generator, dtype=torch.float64)
            for name, scale in shapes.items()
        }
        seen = [found[name].to(device) for name in ("seen_qd", "seen_qdd")]
        with torch.no_grad():
            held = self._system.friction.coefficients(*seen)
            if self._system.remembers:
                found["memory"] = self._system.friction.initial_state(*seen)
        if self._system.law_size:
            found["law"] = torch.zeros(n, self._system.law_size, dtype=torch.float64)
        step = torch.full((1,), 1e-3, dtype=torch.float64)
        return {**found, "step": step, "held": held}

    def __call__(
        self,
        q0: Any,
        qd0: Any,
        inputs: RolloutSignals,
        parameters: Mapping[str, Any] | None = None,
        threads: int = 1,
    ) -> Trajectories:
        """Integrate all candidates from their initial states.

        Args:
            q0, qd0: initial state [rad, rad/s], shape (candidate, joint); one row is for all.
            inputs: sample times, and all that drives the motion.
            parameters: values that differ from the modules', by name ("plant.…", "friction.…"),
                shape (candidate, *the parameter's own) or just the parameter's own.
            threads: candidates are shared out among this many.

        Returns:
            Trajectories, in NumPy or (where `q0` is one) torch.

        Raises:
            ValueError: for shapes that do not fit, or a name that is not there.
        """
        steps, substeps, drive, memory = inputs.steps, inputs.substeps, inputs.drive, inputs.memory
        if steps < 0 or substeps < 1 or threads < 1:
            raise ValueError(
                "`steps` must be 0 or more, `substeps` and `threads` 1 or more, got "
                f"{steps}, {substeps} and {threads}."
            )
        n = self.joints
        step = inputs.time_step if substeps == 1 else to_array(inputs.time_step) / substeps
        given = {
            "q0": rows_of("q0", q0, (n,)),
            "qd0": rows_of("qd0", qd0, (n,)),
            "tau": series("tau", np.zeros(n) if inputs.tau is None else inputs.tau, steps, (n,)),
            "step": series("time_step", step, steps, ()),
        }
        if drive is not None:
            for name, value in zip(("drive_qd", "drive_qdd"), drive, strict=True):
                given[name] = series("drive", value, steps, (n,))
        if memory is not None:
            size = getattr(self._system.friction, "state_size", 0)
            given["memory"] = rows_of("memory", memory, (n, size))
        size = self._system.law_size
        if size:
            law = np.zeros((1, n, size)) if inputs.law_state is None else inputs.law_state
            given["law"] = rows_of("law_state", law, (n, size))
        p, rows = parameter_rows(self._module, parameters or {})
        count = common_rows(rows | {name: one.rows for name, one in given.items()})
        outputs: dict[str, np.ndarray] = {
            name: np.empty((count, steps + 1, n)) for name in LAYOUT.outputs[:3]
        }
        outputs["diverged"] = np.empty(count, dtype=np.int64)
        if size:
            outputs["law_out"] = np.empty((count, steps + 1, n, size))
        settings = {"samples": steps, "substeps": substeps, "driven": drive is not None,
                    "remembered": memory is not None}  # fmt: skip
        self._kernel(count, p, given, outputs, settings, threads)
        results: dict[str, Any] = dict(outputs)
        if isinstance(q0, Tensor):
            results = {name: torch.from_numpy(x) for name, x in results.items()}
        q, qd, qdd, diverged = (results[name] for name in LAYOUT.outputs[:4])
        return Trajectories(q, qd, qdd, diverged, results.get("law_out"))

    def check(self) -> None:
        """Compare two steps from random states with the same steps in eager torch.

        Raises:
            SelfCheckFailed: if they differ by more than rounding explains.
        """
        # Two steps, so that a memory advances once; short ones, so that errors show in the rate.
        steps, dt = 2, 1e-4
        generator = torch.Generator().manual_seed(1)
        scales = (1.0, 1.0, 3.0)  # of torque, position and velocity, as mechanisms move
        for _ in range(3):
            tau, q, qd = (
                s * torch.randn(self.joints, generator=generator, dtype=torch.float64)
                for s in scales
            )
            expected = to_array(self._eager(q, qd, tau, steps, dt)) - qd.numpy()
            ours = self(q[None], qd[None], RolloutSignals(steps, dt, tau.expand(steps, -1)))
            rate, eager = (ours.qd[0, -1].numpy() - qd.numpy()) / dt, expected / dt
            scale = _CHECK_TOLERANCE * (1.0 + np.abs(eager).max())
            if not np.allclose(rate, eager, rtol=0.0, atol=scale, equal_nan=True):
                raise SelfCheckFailed(
                    f"compiled code accelerates by {rate} where torch gives {eager} at q={q}, "
                    f"qd={qd}; please report this, and use the torch rollout "
                    '(`backend="torch"`) meanwhile.'
                )

    @torch.no_grad()
    def _eager(self, q: Tensor, qd: Tensor, tau: Tensor, steps: int, dt: float) -> Tensor:
        """Velocity after some steps in torch."""
        q, qd, tau = (x.to(self._module.device) for x in (q, qd, tau))
        plant, friction = self._system.plant, self._system.friction
        qdd, memory = plant.forward_dynamics(q, qd, tau), None
        size = self._system.law_size
        law = (q.new_zeros(self.joints, size),) if size else ()
        for k in range(steps):
            if not self._system.remembers:
                held = friction.coefficients(qd, qdd)
            else:
                memory = friction.advance(qd, qdd, memory) if k else friction.initial_state(qd, qdd)
                held = friction.coefficients_from(qd, qdd, memory)
            q, qd, qdd, *law = self._system.step(plant, friction, q, qd, tau, held, dt, *law)
        return qd

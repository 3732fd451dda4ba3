"""Compile the rollout of a plant with friction, and run many at once."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

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
class RolloutInputs:
    """Initial state and inputs of a rollout.

    Attributes:
        q0, qd0: initial state [rad, rad/s], (*batch, joint).
        tau: torque held over each step [N m], (steps, joint) or (*batch, steps, joint).
        step: sample times [s], (steps,) or (*batch, steps).
        substeps: integration steps to each sample.
        measured: velocity and acceleration that drive the coefficients in place of the simulated
            ones, each (*batch, steps, joint) or without batch; None for the simulated ones.
        hidden_state: of the coefficients after the first sample, (*batch, joint, state_size);
            None for that of the first sample alone.
        law_state: internal state of the friction law at the start, (*batch, joint, state); None of
            a law without.
    """

    q0: Tensor
    qd0: Tensor
    tau: Tensor
    step: Tensor
    substeps: int = 1
    measured: tuple[Tensor, Tensor] | None = None
    hidden_state: Tensor | None = None
    law_state: Tensor | None = None


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
        inputs: RolloutInputs,
        parameters: Mapping[str, Tensor] | None = None,
        threads: int = 1,
    ) -> tuple[Tensor, ...]:
        """States at every sample: q, qd, qdd, each (*batch, steps + 1, joint), and that of the law.

        They are NaN from the sample on at which a state is not finite or too fast. The
        acceleration is that of the first stage of the step before, at the start without friction.

        Args:
            inputs: initial states, sample times, and all that drives the motion.
            parameters: values that differ from the modules', by name ("plant.…", "friction.…"),
                shape (batch, *the parameter's own) or just the parameter's own.
            threads: the batch is shared out among this many.

        Raises:
            ValueError: for shapes that do not fit, or a name that is not there.
        """
        steps, substeps, n = inputs.step.shape[-1], inputs.substeps, self.joints
        if substeps < 1 or threads < 1:
            raise ValueError(
                f"`substeps` and `threads` must be 1 or more, got {substeps} and {threads}."
            )
        batch = inputs.q0.shape[:-1]

        def rows(x: Tensor, trailing: int) -> Tensor:
            """Candidates on one leading axis; what all share keeps none."""
            x = x.detach()
            own = x.shape[x.ndim - trailing :]
            if x.ndim > trailing:
                x = x.expand(*batch, *own).reshape(-1, *own)
            # An expanded constant needs no value for each step.
            return x[0] if x.ndim == trailing and not x.stride(0) else x

        given = {
            name: rows_of(name, value.detach().reshape(-1, n), (n,))
            for name, value in (("q0", inputs.q0), ("qd0", inputs.qd0))
        }
        given["tau"] = series("tau", rows(inputs.tau, 2), steps, (n,))
        given["step"] = series("step", to_array(rows(inputs.step, 1)) / substeps, steps, ())
        if inputs.measured is not None:
            for name, value in zip(("drive_qd", "drive_qdd"), inputs.measured, strict=True):
                given[name] = series("measured", rows(value, 2), steps, (n,))
        size, law = self._system.law_size, inputs.law_state
        if size:
            law = inputs.q0.new_zeros(n, size) if law is None else law
            given["law"] = rows_of(
                "law_state", rows(law, 2).reshape(-1, *law.shape[-2:]), (n, size)
            )
        if (memory := inputs.hidden_state) is not None:
            own = n, int(getattr(self._system.friction, "state_size", 0))
            flat = rows(memory, 2).reshape(-1, *memory.shape[-2:])
            given["memory"] = rows_of("hidden_state", flat, own)
        p, counts = parameter_rows(self._module, parameters or {})
        count = common_rows(counts | {name: one.rows for name, one in given.items()})
        outputs = {name: np.empty((count, steps + 1, n)) for name in LAYOUT.outputs[:3]}
        outputs |= {"law_out": np.empty((count, steps + 1, n, size))} if size else {}
        settings = {"samples": steps, "substeps": substeps,
                    "driven": inputs.measured is not None,
                    "remembered": inputs.hidden_state is not None}  # fmt: skip
        lost = {"diverged": np.empty(count, dtype=np.int64)}
        self._kernel(count, p, given, outputs | lost, settings, threads)
        found = map(torch.from_numpy, outputs.values())
        return tuple(x.reshape(*batch, *x.shape[1:]) for x in found)

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
            step = torch.full((steps,), dt, dtype=torch.float64)
            inputs = RolloutInputs(q, qd, tau.expand(steps, -1), step)
            rate, eager = (self(inputs)[1][-1].numpy() - qd.numpy()) / dt, expected / dt
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

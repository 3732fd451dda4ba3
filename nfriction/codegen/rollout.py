"""Compile the rollout of a plant with friction, and run many at once."""

from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise
from typing import Any, NamedTuple, cast

import numpy as np
import torch
from torch import Tensor, nn

from nfriction.codegen import arguments, build, driver, driver_c, driver_python
from nfriction.codegen.arguments import series
from nfriction.codegen.errors import SelfCheckFailed
from nfriction.codegen.fused import Friction, Fused, Plant
from nfriction.codegen.kernels import c_kernel, numba_kernel
from nfriction.codegen.lift import Lifted

Array = np.ndarray

SPEED_LIMIT = 1e6
"""Above this velocity [rad/s or m/s] a candidate counts as diverged."""

# Of accelerations over steps of 0.1 ms: velocities of 10 rad/s round to 2e-15, rates to 2e-11.
_CHECK_TOLERANCE = 1e-9


class Trajectories(NamedTuple):
    """Simulated motions, NumPy or torch as the initial state was.

    Attributes:
        q, qd: positions and velocities [rad, rad/s], shape (candidate, record, joint); NaN from
            where a candidate diverged.
        qdd: acceleration known at each record [rad/s^2]: of the first stage of the step before it,
            at the start that without friction; same shape.
        diverged_step: step after which the state was not finite or too fast, -1 where it never
            was, shape (candidate,).
    """

    q: Any
    qd: Any
    qdd: Any
    diverged_step: Any


def compile_rollout(
    plant: Plant, friction: Friction, *, backend: build.Backend = "auto", hold: bool = True
) -> "CompiledRollout":
    """Compile RK4 rollouts of a plant with friction from their torch definition.

    Parameters and floating-point buffers stay inputs: they are read at every call, so a fit may
    change them, and may differ from candidate to candidate. Everything else (Python numbers,
    integer and boolean buffers, the modules' structure) is baked in.

    Args:
        plant: module with `joints`, `forward_dynamics` and `load`.
        friction: module with `coefficients` and `torque`.
        backend: "c", "numba", or "auto" for the first of them that is there.
        hold: hold the coefficients over a step, from its first state and the step before's
            acceleration; otherwise evaluate them in every stage, with that same acceleration.
            Coefficients with a memory are always held.

    Raises:
        NoBackend: no C compiler and no numba.
        UnsupportedOperation: the modules use an operation that has no scalar form here.
        CompilerError: the C compiler failed; the message tells how.
        SelfCheckFailed: the compiled acceleration is not the eager one.
        ValueError: coefficients with a memory are not to be held.
    """
    served = build.choose(backend)
    for name, module in (("plant", plant), ("friction", friction)):
        if not isinstance(module, nn.Module):
            raise TypeError(f"`{name}` must be a torch module, got {type(module).__name__}.")
    fused = Fused(plant, friction, hold)
    if fused.remembers and not hold:
        raise ValueError("coefficients with a memory are held over a step; use `hold=True`.")
    lifted = Lifted(fused)
    examples = dict(zip(EXAMPLES, _states(plant.joints, seed=0), strict=True))
    if fused.remembers:
        with torch.no_grad():
            rest = torch.zeros(plant.joints, dtype=torch.float64, device=lifted.device)
            examples["memory"] = fused.friction.initial_state(rest, rest)
    parts = driver.pieces(lifted.trace(examples, driver.LEVELS))
    source = (driver_c.c_source if served == "c" else driver_python.python_source)(parts)
    kernel = c_kernel(source) if served == "c" else numba_kernel(source, parts)
    compiled = CompiledRollout(served, source, lifted, kernel)
    compiled.check()
    return compiled


EXAMPLES = ("qd_held", "qdd_held", "tau", "q", "qd")


def _states(joints: int, seed: int) -> list[Tensor]:
    generator = torch.Generator().manual_seed(seed)
    scales = (3.0, 10.0, 1.0, 1.0, 3.0)  # of `EXAMPLES`, as mechanisms move
    return [s * torch.randn(joints, generator=generator, dtype=torch.float64) for s in scales]


class CompiledRollout:
    """Rollouts of one plant and friction model; made by `compile_rollout`.

    Attributes:
        backend: "c" or "numba".
        source: what was compiled.
        parameter_names: names under which `parameters` may be given, in the source's order.
    """

    def __init__(
        self, backend: str, source: str, lifted: Lifted, kernel: Callable[..., None]
    ) -> None:
        self.backend = backend
        self.source = source
        self.parameter_names = lifted.names
        self._lifted = lifted
        self._kernel = kernel
        self._fused = cast(Fused, lifted.module)
        self.joints = int(self._fused.plant.joints)

    def __call__(
        self,
        q0: Any,
        qd0: Any,
        *,
        steps: int,
        time_step: Any,
        tau: Any = None,
        parameters: Mapping[str, Any] | None = None,
        drive: tuple[Any, Any] | None = None,
        threads: int = 1,
        record_every: int | None = 1,
        hold_for: int = 1,
        memory: Any = None,
        speed_limit: float = SPEED_LIMIT,
    ) -> Trajectories:
        """Integrate all candidates from their initial states.

        Args:
            q0, qd0: initial state [rad, rad/s], shape (candidate, joint); one row serves all.
            steps: number of steps.
            time_step: step length [s]: a number, (steps,) or (candidate, steps).
            tau: joint torque held over each step [N m], (steps, joint) or (candidate, steps,
                joint); zero by default.
            parameters: values that differ from the modules', by name ("plant.…", "friction.…"),
                shape (candidate, *the parameter's own) or just the parameter's own.
            drive: measured velocity and acceleration that drive the coefficients instead of the
                simulated ones, each (steps, joint) or (candidate, steps, joint).
            threads: candidates are shared out among this many.
            record_every: record the initial state and every `record_every`-th one; None records the
                initial and the final state.
            hold_for: steps over which held coefficients stay as they are; where they have a
                memory, it advances as often.
            memory: what the coefficients remember after the first sample, (candidate, joint,
                state_size), one row serves all; by default what they would of that sample alone.
            speed_limit: a candidate faster than this [rad/s] has diverged and is stopped.

        Returns:
            Trajectories, in NumPy or (where `q0` is one) torch.

        Raises:
            ValueError: for shapes that do not fit, or a name that is not there.
        """
        if steps < 0 or (record_every is not None and record_every < 1) or threads < 1:
            raise ValueError(
                "`steps` must be 0 or more, `record_every` and `threads` 1 or more, got "
                f"{steps}, {record_every} and {threads}."
            )
        if hold_for < 1 or (hold_for > 1 and not self._fused.hold):
            raise ValueError(
                f"`hold_for` must be 1 or more, and 1 unless compiled with `hold=True`, got "
                f"{hold_for}."
            )
        if drive is not None and not self._fused.hold:
            raise ValueError("`drive` holds the coefficients; compile with `hold=True` for it.")
        n, every = self.joints, record_every or max(steps, 1)
        q, qd = arguments.states("q0", q0, n), arguments.states("qd0", qd0, n)
        h = series("time_step", time_step, steps, ())
        torque = series("tau", np.zeros(n) if tau is None else tau, steps, (n,))
        measured = [
            series(f"drive[{i}]", values, steps, (n,))
            for i, values in enumerate(drive or (np.zeros(n), np.zeros(n)))
        ]
        if len({(m.rows, m.step) for m in measured}) > 1 or (drive and not measured[0].step):
            raise ValueError("`drive` must be two arrays of one shape, each with a value a step.")
        p, counts = arguments.parameter_rows(self._lifted.values(), parameters or {})
        counts |= {} if memory is None else {"memory": len(memory)}
        counts |= {"q0": len(q), "qd0": len(qd), "time_step": h.rows, "tau": torque.rows}
        count = arguments.candidates({**counts, "drive": measured[0].rows})
        remembered = self._memory(memory, count)
        out = [np.empty((count, steps // every + 1, n)) for _ in range(3)]
        diverged = np.empty(count, dtype=np.intp)
        shared = (
            *(steps, every, hold_for, float(speed_limit)),
            *(p.reshape(-1), p.shape[1] if len(p) > 1 else 0),
            *(arguments.repeated(q, count), arguments.repeated(qd, count)),
            *(h.values, h.row, h.step, torque.values, torque.row, torque.step),
            *(measured[0].values, measured[1].values, measured[0].row, measured[0].step),
            *(remembered, int(memory is not None)),
            *(*(a.reshape(-1) for a in out), diverged),
        )
        self._run(count, threads, shared)
        if isinstance(q0, Tensor):
            tensors = [torch.from_numpy(a) for a in (*out, diverged)]
            return Trajectories(tensors[0], tensors[1], tensors[2], tensors[3])
        return Trajectories(out[0], out[1], out[2], diverged)

    def _memory(self, memory: Any, count: int) -> Array:
        """Given memory of every candidate, flat; a placeholder where none is given."""
        if memory is None:
            return np.zeros(1)
        array = arguments.to_array(memory)
        shape = (self.joints, getattr(self._fused.friction, "state_size", 0))
        if array.shape[1:] != shape or not shape[1]:
            raise ValueError(f"`memory` must be (candidate, {shape[0]}, {shape[1]}), got "
                             f"{array.shape}.")  # fmt: skip
        return arguments.repeated(array, count)

    def check(self, states: int = 3) -> None:
        """Compare two steps from random states with the same steps in eager torch.

        Raises:
            SelfCheckFailed: if they differ by more than rounding explains.
        """
        steps, dt = 2, 1e-4
        for seed in range(states):
            _, _, tau, q, qd = _states(self.joints, seed)
            expected = arguments.to_array(self._eager(q, qd, tau, steps, dt)) - qd.numpy()
            ours = self(q[None], qd[None], steps=steps, time_step=dt, tau=tau.expand(steps, -1))
            rate, eager = (ours.qd[0, -1].numpy() - qd.numpy()) / dt, expected / dt
            scale = _CHECK_TOLERANCE * (1.0 + np.abs(eager).max())
            if not np.allclose(rate, eager, rtol=0.0, atol=scale, equal_nan=True):
                raise SelfCheckFailed(
                    f"compiled code accelerates by {rate} where torch gives {eager} at q={q}, "
                    f"qd={qd}; please report this, and use the torch rollout "
                    '(`backend="torch"`) meanwhile.'
                )

    def _eager(self, q: Tensor, qd: Tensor, tau: Tensor, steps: int, dt: float) -> Tensor:
        """Velocity after some steps in torch."""
        device = self._lifted.device
        q, qd, tau = (x.to(device) for x in (q, qd, tau))
        with torch.no_grad():
            friction = self._fused.friction
            prev = self._fused.plant.forward_dynamics(q, qd, tau)
            memory: tuple[Tensor, ...] = ()
            for k in range(steps):
                held: tuple[Tensor, ...] = (qd, prev)
                if self._fused.remembers:
                    begun = friction.advance(*held, *memory) if k else friction.initial_state(*held)
                    memory = (begun,)
                held += memory
                a1 = self._fused(q, qd, tau, *held)[0]
                v2 = qd + dt / 2 * a1
                a2 = self._fused(q + dt / 2 * qd, v2, tau, *held)[0]
                v3 = qd + dt / 2 * a2
                a3 = self._fused(q + dt / 2 * v2, v3, tau, *held)[0]
                v4 = qd + dt * a3
                a4 = self._fused(q + dt * v3, v4, tau, *held)[0]
                q = q + dt / 6 * (qd + 2 * (v2 + v3) + v4)
                qd, prev = qd + dt / 6 * (a1 + 2 * (a2 + a3) + a4), a1
        return qd

    def _run(self, count: int, threads: int, shared: tuple[Any, ...]) -> None:
        chunks = min(threads, count)
        if chunks <= 1:
            self._kernel(0, count, *shared)
            return
        # More chunks than threads, since candidates that diverge early leave a thread idle.
        borders = np.linspace(0, count, min(count, 4 * chunks) + 1).astype(int).tolist()
        with ThreadPoolExecutor(threads) as pool:
            jobs = [
                pool.submit(self._kernel, first, last, *shared) for first, last in pairwise(borders)
            ]
            for job in jobs:
                job.result()

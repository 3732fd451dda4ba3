"""The peers' side of `rollout.py`: the same mechanism and friction in their own terms.

Each function gives a contestant, or raises ImportError where its package is missing.
"""

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from cases import COULOMB, DT, STEPS, VISCOUS, Numbers
from timing import Contestant
from torch import Tensor

from nfriction import FrictionModel, PendulumChain
from nfriction.simulation.rk4 import acceleration as torch_acceleration

SHORT = 2_000  # steps of those so slow that their time is scaled


def accelerations(m: Any, n: Numbers, q: Any, qd: Any, c: Any, loaded: bool) -> list:
    """Joint accelerations, scalar by scalar; `m` has sin, cos and tanh (math or jax.numpy)."""
    a, b = n.coupling.tolist(), n.gravity.tolist()
    angle = [q[0], q[0] + q[1], q[0] + q[1] + q[2]]
    rate = [qd[0], qd[0] + qd[1], qd[0] + qd[1] + qd[2]]
    friction = []
    for j, lever in enumerate(n.lever.tolist()):
        load = abs(lever * qd[j] * qd[j] - m.cos(angle[j])) if loaded else 1.0
        friction.append(c[j][0] * qd[j] + c[j][1] * load * m.tanh(qd[j] / n.v_smooth))
    force = [friction[j + 1] - friction[j] for j in range(2)] + [-friction[2]]
    force = [f + b[j] * m.sin(angle[j]) for j, f in enumerate(force)]
    mass = {}
    for (i, j), between in {(0, 1): q[1], (1, 2): q[2], (0, 2): q[1] + q[2]}.items():
        mass[i, j] = a[i][j] * m.cos(between)
        strength = a[i][j] * m.sin(between)
        force[i] = force[i] + strength * rate[j] * rate[j]
        force[j] = force[j] - strength * rate[i] * rate[i]
    l1, l2 = mass[0, 1] / a[0][0], mass[0, 2] / a[0][0]
    d11, d12 = a[1][1] - l1 * mass[0, 1], mass[1, 2] - l1 * mass[0, 2]
    force[1], force[2] = force[1] - l1 * force[0], force[2] - l2 * force[0]
    l3 = d12 / d11
    x2 = (force[2] - l3 * force[1]) / (a[2][2] - l2 * mass[0, 2] - l3 * d12)
    x1 = (force[1] - d12 * x2) / d11
    x0 = (force[0] - mass[0, 1] * x1 - mass[0, 2] * x2) / a[0][0]
    return [x0, x1 - x0, x2 - x1]


def _jax() -> tuple[Any, Any]:
    import jax
    import jax.numpy as jnp

    jax.config.update("jax_enable_x64", True)
    jax.config.update("jax_platforms", "cpu")
    return jax, jnp


def jax_parts(n: Numbers) -> tuple[Callable, Callable]:
    """Rate (q, qd, c) -> qdd and coefficients (qd, qdd) -> c in jax.numpy."""
    _, jnp = _jax()
    loaded = n.network is not None

    def rate(q: Any, qd: Any, c: Any) -> Any:
        return jnp.stack(accelerations(jnp, n, q, qd, c, loaded))

    def coefficients(qd: Any, qdd: Any) -> Any:
        if n.network is None:
            return jnp.asarray(n.constant)
        w = n.network
        v = qd / w["velocity_range"]
        along = (qdd * jnp.tanh(v / w["turn"]) - w["lower"]) / w["span"]
        given = jnp.stack([jnp.abs(v), along], -1)
        x = jnp.clip(given, 0.0, 1.0)
        beyond = (given - x) / w["reach"]
        left = jnp.maximum(1.0 - (beyond * beyond).sum(-1, keepdims=True), 0.0)
        z = (x[:, :, None] - w["centre"]) / w["width"]
        logs = -0.5 * z * z
        share = jnp.exp(logs - logs.max(-1, keepdims=True))
        share = share / share.sum(-1, keepdims=True)
        strength = (share[:, 0, :, None] * share[:, 1, None, :]).reshape(3, -1)
        plane = jnp.einsum("jr,jorc->joc", strength, w["plane"])
        y = (plane[:, :, :2] * x[:, None, :]).sum(-1) + plane[:, :, 2]
        d = jnp.concatenate([x, y], -1)[:, None, :] - w["unit_centre"]
        units = jnp.exp(-(d * d * w["unit_precision"]).sum(-1))
        u = y + w["bias"] + jnp.einsum("ju,jou->jo", units, w["unit_out"])
        u = w["reference"] + left * left * u
        return w["scale"] * 0.5 * (u + jnp.sqrt(u * u + 4.0 * w["roundness"] ** 2))

    return rate, coefficients


def jax_scan(n: Numbers, q0: np.ndarray, qd0: np.ndarray) -> Contestant:
    jax, jnp = _jax()
    rate, coefficients = jax_parts(n)

    def step(state: Any, _: None) -> Any:
        q, qd, qdd = state
        c = coefficients(qd, qdd)
        a1 = rate(q, qd, c)
        v2 = qd + 0.5 * DT * a1
        a2 = rate(q + 0.5 * DT * qd, v2, c)
        v3 = qd + 0.5 * DT * a2
        a3 = rate(q + 0.5 * DT * v2, v3, c)
        v4 = qd + DT * a3
        a4 = rate(q + DT * v3, v4, c)
        after = (
            q + DT / 6 * (qd + 2 * (v2 + v3) + v4),
            qd + DT / 6 * (a1 + 2 * (a2 + a3) + a4),
            a1,
        )
        return after, after

    @jax.jit
    def motion(q: Any, qd: Any) -> Any:
        start = (q, qd, rate(q, qd, jnp.zeros((3, 2))))
        return jax.lax.scan(step, start, None, length=STEPS)

    def run() -> np.ndarray:
        (q, qd, _), _ = jax.block_until_ready(motion(q0, qd0))
        return np.concatenate([q, qd])

    return Contestant("JAX lax.scan", run)


def _diffrax_rk4(diffrax: Any) -> Any:
    """The classical tableau; diffrax brings embedded pairs only, so its error estimate is zero."""

    class RK4(diffrax.AbstractERK):
        tableau = diffrax.ButcherTableau(
            c=np.array([0.5, 0.5, 1.0]),
            b_sol=np.array([1, 2, 2, 1]) / 6,
            b_error=np.zeros(4),
            a_lower=(np.array([0.5]), np.array([0.0, 0.5]), np.array([0.0, 0.0, 1.0])),
        )
        interpolation_cls = diffrax.ThirdOrderHermitePolynomialInterpolation.from_k

        def order(self, terms: Any) -> int:
            return 4

    return RK4()


def diffrax(n: Numbers, q0: np.ndarray, qd0: np.ndarray) -> Contestant:
    """Constant coefficients: `diffeqsolve` at fixed steps, every step saved.

    Held ones: the same solver's `step` in a scan, as `diffeqsolve` can hold nothing over a step.
    """
    import diffrax

    jax, jnp = _jax()
    rate, coefficients = jax_parts(n)
    solver = _diffrax_rk4(diffrax)
    y0 = (jnp.asarray(q0), jnp.asarray(qd0))
    held = n.network is not None
    term = diffrax.ODETerm(lambda t, y, c: (y[1], rate(y[0], y[1], c)))

    def step(state: Any, k: Any) -> Any:
        y, qdd = state
        c = coefficients(y[1], qdd)
        t = k * DT
        after, *_ = solver.step(term, t, t + DT, y, c, (False, term.vf(t, y, c)), False)
        now = (after, rate(*y, c))
        return now, now

    @jax.jit
    def motion(y: Any) -> Any:
        if held:
            start = (y, rate(*y, jnp.zeros((3, 2))))
            return jax.lax.scan(step, start, jnp.arange(STEPS))[0][0]
        solution = diffrax.diffeqsolve(
            term, solver, 0.0, STEPS * DT, DT, y, coefficients(None, None),
            saveat=diffrax.SaveAt(steps=True), max_steps=STEPS + 1,
        )  # fmt: skip
        # Rounding of the time may add a last step of no length.
        return [x[solution.stats["num_steps"] - 1] for x in solution.ys]

    def run() -> np.ndarray:
        return np.concatenate(jax.block_until_ready(motion(y0)))

    note = "its solver's RK4 step in a scan" if held else "fixed steps, classical RK4 tableau"
    return Contestant(f"diffrax {diffrax.__version__}", run, note=note)


def torchdiffeq(
    plant: PendulumChain, friction: FrictionModel, q0: Tensor, qd0: Tensor, expected: np.ndarray
) -> Contestant:
    from torchdiffeq import odeint

    def rate(t: Tensor, y: Tensor) -> Tensor:
        q, qd = y.chunk(2)
        c = friction.coefficients(qd, qd)
        return torch.cat([qd, torch_acceleration(plant, friction, q, qd, torch.zeros(3).to(q), c)])

    time = torch.arange(SHORT + 1, dtype=torch.float64) * DT

    def run() -> np.ndarray:
        with torch.no_grad():
            return odeint(rate, torch.cat([q0, qd0]), time, method="rk4")[-1].numpy()

    # Its "rk4" is the 3/8 rule: as accurate, so the two differ by the error of a step of 1 ms.
    return Contestant("torchdiffeq rk4", run, STEPS / SHORT, 1e-3, 3,
                      f"{SHORT} steps, scaled; 3/8 rule", expected)  # fmt: skip


def scipy(n: Numbers, q0: np.ndarray, qd0: np.ndarray) -> Contestant:
    from scipy.integrate import solve_ivp

    c = n.constant.tolist()

    def rate(t: float, y: np.ndarray) -> list[float]:
        q, qd = y[:3].tolist(), y[3:].tolist()
        return [*qd, *accelerations(math, n, q, qd, c, False)]

    time = np.arange(STEPS + 1) * DT

    def run() -> np.ndarray:
        found = solve_ivp(
            rate, (0.0, STEPS * DT), np.concatenate([q0, qd0]), t_eval=time, rtol=1e-6, atol=1e-8
        )
        return found.y[:, -1]

    # RK4 at 1 ms is off by 5e-6 rad at the end and 7e-4 rad on the way (against 0.1 ms).
    return Contestant("SciPy RK45 rtol=1e-6", run, tolerance=1e-3, rounds=3, note="plain floats")


def mjcf(plant: PendulumChain, damping: Any, frictionloss: Any) -> str:
    """The rig as a MuJoCo model: link frame x along the link, joint axis z, first link up."""
    given = plant.to_dict()
    inner = ""
    for i in reversed(range(plant.links)):
        place = "0 0 0" if i == 0 else f"{given['length'][i - 1]!r} 0 0"
        frame = 'xyaxes="0 0 1 0 -1 0"' if i == 0 else ""
        inertia = given["inertia"][i]
        inner = f"""<body pos="{place}" {frame}>
          <joint type="hinge" axis="0 0 1" damping="{damping[i]}" frictionloss="{frictionloss[i]}"/>
          <inertial pos="{given["com"][i]!r} 0 0" mass="{given["mass"][i]!r}"
            diaginertia="1e-2 {max(1e-2, inertia - 1e-2)!r} {inertia!r}"/>{inner}</body>"""
    return f"""<mujoco><option gravity="0 0 {-given["gravity"]!r}" integrator="RK4"
      timestep="{DT}"><flag contact="disable"/></option><worldbody>{inner}</worldbody></mujoco>"""


def mujoco(
    plant: PendulumChain,
    q0: np.ndarray,
    qd0: np.ndarray,
    *,
    steps: int,
    coulomb: bool = True,
    tolerance: float = 1e-9,
    rounds: int = 5,
) -> Contestant:
    """`mujoco.rollout` on one thread, states of all steps kept; q0 (3,) or (candidate, 3)."""
    import mujoco
    import mujoco.rollout

    model = mujoco.MjModel.from_xml_string(mjcf(plant, VISCOUS, COULOMB if coulomb else (0.0,) * 3))
    data = mujoco.MjData(model)
    start = np.concatenate([np.atleast_2d(q0), np.atleast_2d(qd0)], 1)
    # Full physics state: time, positions, velocities.
    start = np.concatenate([np.zeros((len(start), 1)), start], 1)

    def run() -> np.ndarray:
        states, _ = mujoco.rollout.rollout(model, [data], start, nstep=steps)
        return states[:, -1, 1:7].squeeze()

    name = f"MuJoCo {mujoco.__version__} RK4"
    note = "damping + frictionloss (soft constraint)" if coulomb else "damping only"
    return Contestant(name + ("" if coulomb else ", damping"), run, 1.0, tolerance, rounds, note)

"""Rollouts side by side: ours, hand-written C, and the field's simulators, on one pinned thread.

Run from the repository's root: `python benchmarks/rollout.py [--rounds 9] [--candidates 1000]`.
Peers that are not installed are named and left out.
"""

import argparse
import sys
import tempfile
from collections.abc import Callable
from functools import partial
from typing import Any

import timing  # first: it sets what libraries read when they are loaded

# isort: split
import cases
import numpy as np
import peers
import torch
from cases import DT, STEPS
from limit import hand_written
from timing import Contestant, verdict

from nfriction import CVFM, FrictionModel, PendulumChain, Stribeck, rollout
from nfriction.codegen import CompiledRollout, RolloutInputs
from nfriction.friction.memory import LuGre, MaxwellSlip
from nfriction.simulation.rk4 import rk4_step

BATCH_STEPS = 2_000


def present(makers: list[Callable[[], Contestant]]) -> list[Contestant]:
    """The contestants whose packages are here; the others are named."""
    found = []
    for make in makers:
        try:
            found.append(make())
        except ImportError as error:
            print(f"  left out: {error}")
    return found


def ours(
    plant: PendulumChain, friction: FrictionModel, q0: Any, qd0: Any, **options: Any
) -> Callable[[], np.ndarray]:
    """The public call, checks included."""

    def run() -> np.ndarray:
        motion = rollout(plant, friction, q0, qd0, sample_time=DT, gradients=False, **options)
        return torch.cat([motion.q[..., -1, :], motion.qd[..., -1, :]], -1).numpy()

    return run


def bare(plant: PendulumChain, friction: FrictionModel, q0: Any, qd0: Any) -> Callable:
    """The compiled code without the public call's checks, as hand-written C has none."""
    compiled = CompiledRollout(plant, friction, rk4_step)
    step = torch.tensor(DT, dtype=q0.dtype).expand(STEPS)
    inputs = RolloutInputs(q0, qd0, torch.zeros_like(q0).expand(STEPS, -1), step)

    def run() -> np.ndarray:
        q, qd, _ = compiled(inputs)
        return np.concatenate([q[-1], qd[-1]])

    return run


def single(friction: FrictionModel, label: str, rounds: int, folder: str) -> dict[str, float]:
    plant = cases.rig()
    q0, qd0 = cases.release()
    n = cases.numbers(plant, friction)
    start = (q0.numpy(), qd0.numpy())
    our = partial(ours, plant, friction, q0, qd0)
    early = our(steps=peers.SHORT, backend="compiled")()
    by_hand = hand_written(n, folder)
    fewer_sines = hand_written(n, folder, "-DADDITION")
    contestants = [
        Contestant("ours, compiled", our(steps=STEPS, backend="compiled")),
        Contestant("ours, bare", bare(plant, friction, q0, qd0), note="without checks"),
        Contestant("ours, torch", our(steps=peers.SHORT, backend="torch"), STEPS / peers.SHORT,
                   rounds=3, note=f"{peers.SHORT} steps, scaled", expected=early),
        Contestant("C by hand", lambda: by_hand(*start)),
        Contestant("C by hand, addition theorems", lambda: fewer_sines(*start),
                   note="fewer sines than the definition"),
    ]  # fmt: skip
    makers: list[Callable[[], Contestant]] = [
        lambda: peers.jax_scan(n, *start),
        lambda: peers.diffrax(n, *start),
    ]
    if n.network is None:
        makers += [
            # A constraint solver replaces tanh, so its motion is close but another one.
            lambda: peers.mujoco(plant, *start, steps=STEPS, tolerance=0.2),
            lambda: peers.torchdiffeq(plant, friction, q0, qd0, early),
            lambda: peers.scipy(n, *start),
        ]
    return timing.compare(
        f"{STEPS:,} RK4 steps of {DT * 1e3:g} ms, three links, {label}",
        contestants + present(makers),
        rounds,
    )


def batched(count: int, rounds: int) -> dict[str, float]:
    plant, friction = cases.rig(), cases.constant()
    q0, qd0 = cases.release(count)
    makers: list[Callable[[], Contestant]] = [
        lambda: peers.mujoco(
            plant, q0.numpy(), qd0.numpy(), steps=BATCH_STEPS, tolerance=np.inf, rounds=2
        )
    ]
    own = Contestant(
        "ours, compiled", ours(plant, friction, q0, qd0, steps=BATCH_STEPS, backend="compiled")
    )
    title = f"{count:,} candidates x {BATCH_STEPS:,} steps, constant, one thread each"
    return timing.compare(title, [own, *present(makers)], rounds)


def with_memory(rounds: int) -> dict[str, float]:
    """A law with memory beside the memoryless one to which it settles at a constant velocity."""
    plant = cases.rig()
    q0, qd0 = cases.release()
    # In sliding the same; smooth enough at rest that RK4 needs no steps within a sample.
    models = {
        "Stribeck": Stribeck(3, [2e-3, 1e-3, 2e-3, 0.05, 2.0], v_smooth=0.1),
        "LuGre": LuGre(3, [2e-3, 1e-3, 0.05, 50.0, 0.05, 2e-3]),
        "Maxwell-slip": MaxwellSlip(3),
        "Coulomb-viscous": CVFM(3, [2e-3, 2e-3], v_smooth=0.1),
    }
    contestants = [
        Contestant(
            name, ours(plant, model, q0, qd0, steps=STEPS, backend="compiled"), tolerance=np.inf
        )
        for name, model in models.items()
    ]
    return timing.compare(
        f"{STEPS:,} steps of {DT * 1e3:g} ms, three links, laws with memory", contestants, rounds
    )


def same_mechanism() -> None:
    """MuJoCo without frictionloss must give our motion: then its model is our rig."""
    plant, friction = cases.rig(), cases.constant()
    with torch.no_grad():
        friction.schedule.raw[:, 1] = -800.0  # exp of it is zero: no Coulomb friction
    q0, qd0 = cases.release()
    expected = ours(plant, friction, q0, qd0, steps=1_000, backend="compiled")()
    try:
        peer = peers.mujoco(plant, q0.numpy(), qd0.numpy(), steps=1_000, coulomb=False)
    except ImportError:
        return
    deviation = float(np.abs(peer.run() - expected).max())
    if deviation > 1e-9:  # rounding of 1e-15, grown by 1,000 steps of a triple pendulum
        raise SystemExit(f"the MuJoCo model is another mechanism: {deviation:.1e} after 1 s")
    print(f"MuJoCo with damping alone agrees to {deviation:.1e} after 1,000 steps")


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rounds", type=int, default=9)
    parser.add_argument("--candidates", type=int, default=1_000)
    options = parser.parse_args(argv)
    torch.set_num_threads(1)
    print(f"one thread, {timing.pin()}; torch {torch.__version__}; {timing.yardstick()}")
    same_mechanism()
    with tempfile.TemporaryDirectory() as folder:
        plain = single(cases.constant(), "constant coefficients", options.rounds, folder)
        fuzzy = single(cases.neurofuzzy(), "neuro-fuzzy, held", options.rounds, folder)
    batch = batched(options.candidates, options.rounds)
    memory = with_memory(options.rounds)
    print("\nTargets")

    def ratio(times: dict[str, float], top: str, base: str, target: float, most: bool) -> None:
        over = next((t for name, t in times.items() if name.startswith(top)), None)
        if over is not None and base in times:
            verdict(f"{top} / {base}", over / times[base], target, at_least=not most)

    for times, label, limits in (
        (plain, "constant", (1.1, 7.0)),
        (fuzzy, "neuro-fuzzy", (1.2, 5.0)),
    ):
        print(f"  {label}")
        ratio(times, "ours, compiled", "C by hand", limits[0], True)
        ratio(times, "ours, bare", "C by hand", limits[0], True)
        ratio(times, "ours, compiled", "ours, bare", 1.1, True)
        ratio(times, "diffrax", "ours, compiled", limits[1], False)
    ratio(plain, "MuJoCo", "ours, compiled", 30.0, False)
    ratio(fuzzy, "ours, torch", "ours, compiled", 300.0, False)
    print("  laws with memory")
    ratio(memory, "LuGre", "Stribeck", 1.5, True)
    print("  candidates")
    ratio(batch, "MuJoCo", "ours, compiled", 30.0, False)
    return 0


if __name__ == "__main__":
    sys.exit(main())

"""Rigs of a new user: is the friction found, or does the fit say what it cannot tell?"""

import math
import time
from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from nfriction import FrictionModel, LinearAxis, PendulumChain, Plant, Recording, rollout
from nfriction.evaluation.score import score
from nfriction.fitting.adjusted_plant import adjusted_buffers
from nfriction.fitting.fit import fit
from nfriction.fitting.plant_parameters import plant_parameters
from nfriction.fitting.result.fit_result import FitResult
from nfriction.friction import model_by_name
from nfriction.signals import quantise

COUNTS, RATE, SECONDS = 4096, 500, 10.0
# Integration steps in a sample, of a scheme of first order.
STEPS = 100
TORQUE_NOISE = 0.01  # [N m]
FLYWHEEL = (0.35, 0.15, 0.12, 0.3, 2.0)
# An error up to here counts as found.
ENOUGH = 0.03
LAWS = ("CFM", "CVFM", "LFM", "Stribeck", "NLFM")
# Of contacts with memory: an encoder of 14 bits, a record below breakaway and one that slides [N].
FINE_COUNTS, FINE_RATE, EFFORTS = 2**14, 1000, (0.35, 1.1)
# Errors up to here count as found; of the bristles' stiffness and damping twice as much.
CLOSE = 0.05


class Rig(NamedTuple):
    """A mechanism with its true friction, and what a user knows of it."""

    name: str
    plant: Plant
    given: Plant
    law: str
    truth: tuple[tuple[float, ...], ...]
    effort: tuple[float, ...] = ()
    counts: int = COUNTS
    rate: int = RATE
    torque_noise: float = TORQUE_NOISE
    substeps: int = 8
    sticks: bool = False

    @property
    def driven(self) -> bool:
        """True if torques drive it, of this root mean square at each joint [N m]."""
        return bool(self.effort)


def own_rigs(seeds: int, rigs: int) -> None:
    """Print the error of every coefficient of the flywheel over seeds, and of random rigs."""
    print(f"{'rig':28} {'coefficient':20} {'truth':>9} {'error [%]':>10} {'95 % [%]':>9}  said")
    counts = {"found": 0, "said": 0, "MISSED": 0}
    for of in cases(seeds, rigs):
        number = int(of.name.split()[-1])
        begun = time.perf_counter()
        recordings = recorded(of._replace(sticks=True, substeps=STEPS), number)
        found = fit(of.law, of.given, recordings)
        for line, verdict in judged(of, found):
            counts[verdict] += 1
            print(f"{of.name:28} {line}  {verdict}", flush=True)
        windows = max((length for length, _ in found.stages), default=math.nan)
        print(
            f"{'':28} {found.status}  windows up to {windows:g} s, residual "
            f"{1e3 * found.residual:.3g} m{of.plant.unit}, {time.perf_counter() - begun:.0f} s",
            flush=True,
        )
    print(", ".join(f"{count} {verdict}" for verdict, count in counts.items()))


def within_limit(releases: int) -> None:
    """Print how often the true law on the true rig scores within the limit of the data."""
    names = ("free run", "1", "2", "5")
    held = []
    for number in range(releases):
        of = random_rig(number)
        friction = model_by_name(of.law)(of.plant.joints, of.truth)
        begun = time.perf_counter()
        found = score(of.plant, friction, recorded(of, number)[0])
        assert found.limit is not None
        errors, limits = (
            np.array([x.free_run.all, *(x.windows[name].all for name in names[1:])])
            for x in (found, found.limit)
        )
        held.append(errors <= limits)
        print(
            f"{of.name:28} " + "  ".join(f"{1e3 * e:9.3g} of {1e3 * m:7.3g}"
                                         for e, m in zip(errors, limits, strict=True))
            + f"  ({time.perf_counter() - begun:.1f} s)", flush=True,
        )  # fmt: skip
    for name, share in zip(names, 100 * np.mean(held, axis=0), strict=True):
        print(f"{name}: {share:.0f} % within the limit")


def presliding(seeds: int, torque_noise: float, substeps: int) -> None:
    """Print how well LuGre friction is found again from presliding and sliding."""
    axis, errors, held = LinearAxis(0.13), [], []
    names = model_by_name("LuGre").definition.names
    print(f"{'seed':>4} " + " ".join(f"{name:>9}" for name in names) + "  [%] off; held; says")
    for seed in range(seeds):
        random = np.random.default_rng([7, seed])
        f_c, f_d, viscous = random.uniform((0.25, 0.1, 0.08), (0.45, 0.2, 0.16))
        # A contact yields over half a count to ten, and its oscillation is damped at 0.3 to 1.
        stiffness = (f_c + f_d) / float(2e-4 * 20 ** random.uniform())
        damping = 2 * random.uniform(0.3, 1.0) * math.sqrt(stiffness * 0.13)
        truth = np.array([f_c, f_d, random.uniform(0.03, 0.2), stiffness, damping, viscous])
        friction = model_by_name("LuGre")(1, truth.tolist())
        rig = Rig(
            f"presliding {seed}", axis, known(axis, seed, True), "LuGre", (tuple(truth),), (1.0,),
            FINE_COUNTS, FINE_RATE, torque_noise, substeps,
        )  # fmt: skip
        recordings = [
            recording(rig._replace(effort=(effort,)), friction, random, f"{rig.name} {effort}", "m")
            for effort in EFFORTS
        ]
        begun = time.perf_counter()
        found = fit(model_by_name("LuGre")(1), rig.given, recordings)
        own = found.intervals[: len(truth)]
        error = np.array([i.value for i in own]) / truth - 1
        inside = [i.low <= x <= i.high for i, x in zip(own, truth, strict=True)]
        errors.append(error)
        held.append(inside)
        print(
            f"{seed:4} " + " ".join(f"{100 * x:9.2f}" for x in error)
            + f"  {sum(inside)}/{len(inside)}; {', '.join(found.unidentifiable) or found.status}"
            f" ({time.perf_counter() - begun:.0f} s)", flush=True,
        )  # fmt: skip
    size = np.abs(errors)
    bristle = np.array([name in ("sigma_0", "sigma_1") for name in names])
    near = size <= np.where(bristle, 2 * CLOSE, CLOSE)
    print("median and worst error [%]: " + ", ".join(
        f"{name} {100 * np.median(x):.2g} {100 * x.max():.2g}"
        for name, x in zip(names, size.T, strict=True)
    ))  # fmt: skip
    print(f"within 5 % (bristles 10 %): {100 * near.mean():.1f} %; "
          f"intervals hold {100 * np.mean(held):.1f} %")  # fmt: skip


def cases(seeds: int, rigs: int) -> Iterator[Rig]:
    """The flywheel as axis and as chain, a seed each, then random rigs."""
    axis = LinearAxis(0.13)
    wheel = PendulumChain(
        [1.0], [0.1], com=[0.0], inertia=[0.13], convention=("relative", "hanging")
    )
    for seed in range(seeds):
        for name, plant in (("axis", axis), ("chain", wheel)):
            yield Rig(f"flywheel as {name} {seed}", plant, known(plant, seed, True), "Stribeck",
                      (FLYWHEEL,), effort=(1.1,))  # fmt: skip
    for number in range(rigs):
        yield random_rig(number)


def random_rig(number: int) -> Rig:
    """One link or two with a random law, driven if the number is even."""
    random = np.random.default_rng(1000 + number)
    driven = number % 2 == 0
    links = int(random.integers(1, 3))
    mass = random.uniform(0.2, 0.8, links)
    length = random.uniform(0.15, 0.4, links)
    plant = PendulumChain(
        mass.tolist(), length.tolist(), inertia=(mass * length**2 / 12).tolist(),
        armature=((0.2 if driven else 0.0) * mass * length**2).tolist(),
        convention=("relative", "hanging"),
    )  # fmt: skip
    law = LAWS[number // 2 % len(LAWS)]
    weights = 9.81 * np.cumsum((mass * length)[::-1])[::-1]
    # Shares of the weight: of a drive with its gears, of a bearing.
    size = (0.05 if driven else 0.015) * weights
    truth = tuple(random_friction(law, scale, random) for scale in size)
    name = f"{'driven' if driven else 'free'} {links} x {law} {number}"
    effort = tuple((0.15 * weights).tolist()) if driven else ()
    return Rig(name, plant, known(plant, number, driven), law, truth, effort)


def random_friction(law: str, scale: float, random: np.random.Generator) -> tuple[float, ...]:
    """Coefficients of a law whose friction is of this size [N m]."""

    def share(low: float, high: float) -> float:
        return float(scale * random.uniform(low, high))

    dry, slow, viscous = share(0.5, 1.0), share(0.2, 0.5), share(0.05, 0.15)
    by_law: dict[str, Callable[[], tuple[float, ...]]] = {
        "CFM": lambda: (dry,),
        "CVFM": lambda: (dry, viscous),
        "LFM": lambda: (viscous, dry),
        "Stribeck": lambda: (dry, slow, viscous, float(random.uniform(0.2, 0.8)), 2.0),
        "NLFM": lambda: (0.0, dry, viscous, slow, float(random.uniform(0.5, 3.0))),
    }
    return by_law[law]()


def known(plant: Plant, seed: int, driven: bool) -> Plant:
    """A plant whose terms are off by as much as a fit expects of a user's drawing."""
    joints = range(plant.joints) if driven else ()
    terms = plant_parameters(plant, driven=[*joints])
    kept = [t for t in terms if t.ratio or "angle" in t.name]
    sd = torch.tensor([t.prior_sd for t in kept], dtype=torch.float64)
    random = torch.Generator().manual_seed(seed)
    while True:
        off = torch.randn(len(kept), generator=random, dtype=torch.float64).clamp(-2.0, 2.0)
        given = plant.replace(**adjusted_buffers(plant, kept, sd * off))
        # No masses have these inertias otherwise.
        inertia = getattr(given, "inertia_coupling", None)
        if inertia is None or torch.linalg.eigvalsh(inertia).min() > 0:
            return given


def recorded(rig: Rig, seed: int) -> list[Recording]:
    """Two recordings of ten seconds, rounded as an encoder reads them."""
    unit = rig.plant.unit
    # A real joint sticks: the sign turns at once.
    known = {"v_smooth": 1e-5} if rig.sticks else {}
    friction = model_by_name(rig.law)(rig.plant.joints, rig.truth, **known)
    return [
        recording(rig, friction, np.random.default_rng([seed, place]), f"{rig.name}.{place}", unit)
        for place in (0, 1)
    ]


def recording(
    rig: Rig, friction: FrictionModel, random: np.random.Generator, name: str, unit: str
) -> Recording:
    joints, steps = rig.plant.joints, round(SECONDS * rig.rate)
    rest = torch.zeros(joints, dtype=torch.float64)
    # Joint angles are from upright; a driven rig starts hanging at rest.
    begin = rest.clone()
    if isinstance(rig.plant, PendulumChain):
        begin[0] = math.pi
    if not rig.driven:
        begin = begin + torch.as_tensor(random.uniform(0.5, 1.2, joints))
    tau = torch.as_tensor(smooth_torque(rig, random)) if rig.driven else None
    run = rollout(
        rig.plant, friction, begin, rest, tau, sample_time=1 / rig.rate, steps=steps,
        substeps=rig.substeps, gradients=False,
        scheme="time_stepping" if rig.sticks else "rk4",
    )  # fmt: skip
    q = run.q.numpy() - [
        math.pi if isinstance(rig.plant, PendulumChain) else 0.0,
        *[0.0] * (joints - 1),
    ]
    read = None
    if tau is not None:
        read = np.vstack([tau.numpy(), tau[-1:].numpy()])
        read = read + rig.torque_noise * random.standard_normal(read.shape)
    return Recording(run.time.numpy(), quantise(q, rig.counts), tau=read, unit=unit, name=name)


def smooth_torque(rig: Rig, random: np.random.Generator) -> NDArray[np.float64]:
    """Random smooth torque of a few hertz that overcomes friction again and again [N m]."""
    t = np.arange(round(SECONDS * rig.rate))[:, None, None] / rig.rate
    joints, waves = rig.plant.joints, 6
    rates = 2 * math.pi * random.uniform(0.1, 1.5, (joints, waves))
    phases = random.uniform(0, 2 * math.pi, (joints, waves))
    return rig.effort * np.sin(rates * t + phases).sum(-1) / math.sqrt(waves / 2)


def judged(rig: Rig, found: FitResult) -> Iterator[tuple[str, str]]:
    """A line for every coefficient, and its verdict."""
    names = found.model.schedule.parameter_names(rig.plant.joint_names)
    truth = [value for row in rig.truth for value in row]
    values = found.model.schedule.parameter_vector().tolist()
    intervals = {i.name: i for i in found.intervals}
    for name, true, value in zip(names, truth, values, strict=True):
        if name not in intervals or true == 0.0:
            continue
        error, i = abs(value / true - 1), intervals[name]
        width = (i.high - i.low) / 2 / true
        lost = any(name in direction for direction in found.unidentifiable)
        covered = width > ENOUGH and i.low <= true <= i.high
        said = (
            lost
            or covered
            or not found.converged
            or bool(found.at_bounds and name in found.at_bounds)
        )
        verdict = "found" if error <= ENOUGH else "said" if said else "MISSED"
        line = f"{name:20} {true:9.4g} {100 * error:10.2f} {100 * width:9.2f}"
        yield f"{line} {'not identifiable' if lost else ''}", verdict

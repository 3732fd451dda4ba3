"""Control of the papers' rig on its driven arm with friction compensation by each class of model.

A single link is balanced upright; models are fitted to driven recordings of the hanging link, and
then compensate the friction of the arm, the only joint with a motor. All three links are also swung
up and balanced: there, the noise of encoder counts moves the arm by more than friction does.

The rig is that of the RTIP twin with its arm free and ball bearings at all links: with the twin's
bushing at the last link, linear feedback on encoder counts cannot hold the links. The true friction
is not in any of the fitted model classes.
"""

import logging
import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import torch
from matplotlib.figure import Figure
from torch import Tensor

from nfriction.codegen import CompiledFunction
from nfriction.fitting.fit import fit
from nfriction.fitting.options import Method
from nfriction.friction import model_by_name
from nfriction.friction.coefficients import Constant
from nfriction.friction.laws import Coefficient, Law, smooth_sign
from nfriction.friction.models import FrictionModel
from nfriction.papers.control.feedback import (
    Compensation,
    Feedback,
    Gains,
    Weights,
    balance_gains,
    gains_along,
    linearise,
    plan_swing_up,
    still,
)
from nfriction.papers.twin.dataset import COUNTS, SPECIFICATIONS
from nfriction.plant import PendulumChain, rigs
from nfriction.plant.chain import Arm
from nfriction.plots import style
from nfriction.recording import Array, Recording
from nfriction.recording.angles import AngleConvention
from nfriction.simulation.closed_loop import ControlledMotion, Electronics, control
from nfriction.simulation.rollout import rollout

logger = logging.getLogger(__name__)

MODELS = ("NCFM", "LFM", "NLFM", "Stribeck", "ALFM", "NFLFM")
"""One or more of each class: constant, adaptive, neuro-fuzzy."""
NONE, TRUTH, SHARED = "none", "true friction", "LFM"
THINNED = 10  # one sample of this many is kept for figures
SHARES = (0.5, 0.8, 1.2)
"""Compensated fractions of the friction torque, in addition to full compensation."""
# The arm's motor and slip ring: dry friction (independent of and proportional to load), Stribeck's
# rise and velocity, asymmetry, viscous friction and the velocity above which it thins. Our choice.
ARM = (0.12, 0.03, 0.4, 0.2, 0.06, 0.05, 4.0)
ELECTRONICS = Electronics(counts=COUNTS, delay=1, torque_limit=20.0, torque_bits=16)
# Weights of the arm and of each link in the linear-quadratic cost: angle and rate.
ARM_WEIGHT, LINK_WEIGHT = (10.0, 1.0), (100.0, 1.0)
TORQUE_NOISE = 0.1  # SD of unknown torques for the Kalman filter [N m]
AMPLITUDE, FREQUENCY = 0.3, 0.1  # of the arm's reference [rad, Hz]
SAMPLE_TIME = ELECTRONICS.sample_time
WINDOWS = (0.5,)  # of fits that simulate [s]
TILT = 0.5  # of the first link at the start [deg]


def _hidden_torque(qd: Tensor, load: Tensor, coefficients: Tensor, v_smooth: float) -> Tensor:
    seal, bearing, rise, v_s, asymmetry, viscous, v_t = coefficients.unbind(-1)
    sign = smooth_sign(qd, v_smooth)
    dry = (1.0 + rise * torch.exp(-(qd / v_s).square())) * (seal + bearing * load)
    grease = viscous * qd * (1.0 + (qd / v_t).square()) ** -0.15
    return dry * (1.0 + asymmetry * sign) * sign + grease


_HIDDEN = Law(
    "hidden",
    tuple(
        Coefficient(name, unit, positive=False)
        for name, unit in (
            ("seal", "N m"), ("bearing", "N m"), ("rise", "1"), ("v_s", "rad/s"),
            ("asymmetry", "1"), ("viscous", "N m s/rad"), ("v_t", "rad/s"),
        )
    ),
    _hidden_torque,
)  # fmt: skip


def true_friction(plant: PendulumChain) -> FrictionModel:
    """The friction of the simulated rig: the twin's, with the papers' load for bearing forces.

    A friction model knows the force that a bearing carries only on a fixed pivot.
    """
    twin = replace(
        SPECIFICATIONS["rtip"].friction, seal=(8e-4,) * 3, bearing_arm=(5e-5,) * 3,
        viscous=(1e-2,) * 3,
    )  # fmt: skip
    mass = torch.as_tensor(plant.to_dict()["mass"])
    weight = plant.to_dict()["gravity"] * mass.flip(0).cumsum(0).flip(0)
    links = [
        (twin.seal[k], twin.bearing_arm[k] * float(weight[k]), twin.stribeck_rise[k],
         twin.stribeck_velocity[k], twin.asymmetry[k], twin.viscous[k], twin.shear_velocity[k])
        for k in range(plant.joints - 1)
    ]  # fmt: skip
    values = torch.tensor([ARM, *links], dtype=torch.float64)
    model = FrictionModel(_HIDDEN, Constant(_HIDDEN, plant.joints, values))
    return model.requires_grad_(False)


def driven_recording(
    plant: PendulumChain, friction: FrictionModel, *, seconds: float, seed: int = 0
) -> Recording:
    """A recording of the hanging rig with a random multisine torque at the arm."""
    steps = round(seconds * 1000)
    time = np.arange(steps + 1) / 1000
    frequency = np.geomspace(0.2, 2.0, 6)
    phase = np.random.default_rng(seed).uniform(0, 2 * np.pi, len(frequency))
    tau = np.zeros((steps + 1, plant.joints))
    tau[:, 0] = 0.9 * np.sin(2 * np.pi * frequency * time[:, None] + phase).sum(1)
    # From hanging, since motion about upright would need a controller during the recording.
    hanging = torch.zeros(plant.joints, dtype=torch.float64)
    hanging[1] = math.pi
    run = rollout(plant, friction, hanging, torch.zeros_like(hanging), torch.tensor(tau[:-1]),
                  sample_time=1e-3)  # fmt: skip
    return Recording(
        time=time, q=ELECTRONICS.read(run.q.numpy()), tau=tau, names=plant.joint_names,
        convention=AngleConvention.of("relative,upright"), name="driven_1",
    )  # fmt: skip


def fitted_model(plant: PendulumChain, recording: Recording, name: str) -> FrictionModel:
    """A model fitted to a driven recording: constants by equation error, others on windows."""
    model = model_by_name(name)(plant.joints)
    method: Method = "output_error" if model.schedule.follows_motion else "equation_error"
    return fit(
        model, plant, recording, method=method, windows=WINDOWS, max_steps=3, fit_plant=False
    ).model


def compensation_of(model: FrictionModel) -> Compensation:
    """Compiled friction torque of a model, sample by sample; classes advance with each sample."""
    example = torch.zeros(model.joints, dtype=torch.float64)
    schedule = model.schedule
    memory: list[Array] = []

    def step(qd: Tensor, qdd: Tensor, load: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
        # The class of this sample first; otherwise it would lag each change of direction by a step.
        following = schedule.advance(qd, qdd, state)
        return model.torque(qd, load, schedule.coefficients_from(qd, qdd, following)), following

    start = schedule.initial_state(example, example)
    advance = CompiledFunction(step, (example, example, example, start))

    def torque(qd: Array, qdd: Array, load: Array) -> Array:
        given = [np.ascontiguousarray(x).reshape(-1, x.shape[-1]) for x in (qd, qdd, load)]
        if not memory:
            first = schedule.initial_state(*map(torch.as_tensor, given[:2]))
            memory.append(first.detach().numpy())
        tau_f, memory[0] = advance(*given, memory[0])
        return np.asarray(tau_f).reshape(qd.shape)

    return torque


def reference(time: float) -> tuple[float, float]:
    """Reference angle and velocity of the arm: slow, so that friction matters most."""
    w = 2.0 * math.pi * FREQUENCY
    return AMPLITUDE * math.sin(w * time), AMPLITUDE * w * math.cos(w * time)


def weights(joints: int) -> Weights:
    """Weights of regulator and Kalman filter; the encoder noise is that of counts."""
    state = np.array([ARM_WEIGHT, *[LINK_WEIGHT] * (joints - 1)]).T.reshape(-1)
    return Weights(state, TORQUE_NOISE, 2.0 * math.pi / COUNTS / math.sqrt(12.0))


def top_gains(plant: PendulumChain) -> Gains:
    """Gains that keep the plant upright."""
    still = torch.zeros(plant.joints, dtype=torch.float64)
    return balance_gains(linearise(plant, still, still, still, SAMPLE_TIME), weights(plant.joints))


def way_up(plant: PendulumChain, friction: FrictionModel | None) -> list[Gains]:
    """Gains along a swing-up from hanging that is planned with a model's friction.

    Their torque does not include the friction of the arm, which is compensated during the motion.
    """
    plan = plan_swing_up(plant, friction, sample_time=SAMPLE_TIME)
    q, qd = torch.tensor(plan.q), torch.tensor(plan.qd)
    tau = torch.zeros_like(q)
    tau[:, 0] = torch.tensor(plan.tau)
    if friction is not None:
        opposing = compensation_of(friction)
        load = plant.load(q, qd).numpy()
        qdd = np.gradient(plan.qd, SAMPLE_TIME, axis=0)
        rows = zip(plan.qd, qdd, load, strict=True)
        tau -= torch.tensor(np.stack([opposing(*row) for row in rows]))
    along = linearise(plant, q, qd, tau, SAMPLE_TIME)
    top = top_gains(plant).linear
    return gains_along(along, tau[:, 0].numpy(), top, weights(plant.joints))


def controlled(
    plant: PendulumChain,
    friction: FrictionModel,
    controllers: Mapping[str, Feedback],
    *,
    seconds: float,
) -> dict[str, ControlledMotion]:
    """Motions of the rig with its true friction, one per controller, simulated together.

    The controllers, by name, all have a swing-up of the same duration, or none. `seconds` is the
    duration of the upright motion.
    """
    each = list(controllers.values())

    def torque(time: float, q: Array) -> Array:
        return np.stack([one(time, row) for one, row in zip(each, q, strict=True)])

    way = len(each[0].way)
    start = torch.zeros(len(each), plant.joints, dtype=torch.float64)
    start[:, 1] = math.pi if way else math.radians(TILT)
    run = control(plant, friction, torque, start, torch.zeros_like(start),
                  steps=way + round(seconds / SAMPLE_TIME), electronics=ELECTRONICS)  # fmt: skip
    return {
        name: ControlledMotion(
            run.step, run.q[k], run.qd[k], run.qdd[k], run.diverged_at[k],
            tau=run.tau[k], measured=run.measured[k],
        )
        for k, name in enumerate(controllers)
    }  # fmt: skip


def performance(run: ControlledMotion, *, follow: bool, settled: float) -> dict[str, float]:
    """Performance of a balanced motion after the time `settled` [s].

    Tracking error of the arm (if it has to `follow` the reference) and its largest excursion from
    the reference, largest angle of a link from upright, mean power of the motor and root mean
    square of its torque; infinite if the links fell.
    """
    late = run.time >= settled
    asked = np.array([reference(t)[0] if follow else 0.0 for t in run.time[late].tolist()])
    error = run.q[late, 0].numpy() - asked
    links = run.q[late, 1:].cumsum(-1).abs().numpy()
    torque, rate = run.tau[late[1:], 0].numpy(), run.qd[1:][late[1:], 0].numpy()
    found = {
        "tracking error [mrad]": 1e3 * float(np.sqrt(np.mean(error**2))),
        "limit cycle [mrad]": 1e3 * float(np.ptp(error)),
        "largest tilt [mrad]": 1e3 * float(links.max()),
        "power [W]": float(np.mean(np.abs(torque * rate))),
        "torque [N m]": float(np.sqrt(np.mean(torque**2))),
    }
    # The tracking error of a rig that fell is meaningless.
    fallen = not math.isfinite(found["largest tilt [mrad]"]) or links.max() > 0.5 * math.pi
    return dict.fromkeys(found, math.inf) if fallen else found


def run_study(
    single: Mapping[str, FrictionModel],
    three: Mapping[str, FrictionModel],
    *,
    seconds: float,
    settled: float,
) -> tuple[dict[str, dict[str, dict[str, float | None]]], dict[str, Array]]:
    """Balance, tracking and swing-up with the friction compensation of each model.

    Args:
        single, three: models fitted to the rig of `true_friction` with one link and with three, by
            name; for a single link, fractions of the torque of `SHARED` are also tried.
        seconds, settled: duration of each upright motion, and start of its evaluation [s].

    Returns:
        `performance` by task ("still", "follow", "swing-up", "three links") and compensation, with
        None for infinity; and thinned motions for figures. For the swing-up, planned with the
        friction of the model, also the largest deviation of a link from the plan; a model for
        which no plan is found has no row.
    """
    found: dict[str, dict[str, dict[str, float | None]]] = {}
    kept: dict[str, Array] = {}
    for task, models in (("still", single), ("follow", single), ("swing-up", three),
                         ("three links", three)):  # fmt: skip
        plant = single_link() if models is single else rigs.rtip("free")
        follow, rows = task in ("follow", "three links"), {}
        friction = true_friction(plant)
        for name, (model, share) in _compensated(models, friction, shares=models is single).items():
            # Created anew, because that of an adaptive model remembers the previous motion.
            given = model and compensation_of(model)
            way: Sequence[Gains] = ()
            if task == "swing-up":
                try:
                    way = way_up(plant, model)
                except ValueError as error:
                    logger.warning("%s, %s: %s", task, name, error)
                    continue
            rows[name] = Feedback(
                plant, top_gains(plant), way, reference=reference if follow else still,
                compensation=given, share=share,
            )  # fmt: skip
        found[task] = {}
        for name, run in controlled(plant, friction, rows, seconds=seconds).items():
            way = rows[name].way
            start = SAMPLE_TIME * len(way)
            row = performance(run, follow=follow, settled=start + settled)
            if way:
                planned = np.stack([gains.linear.q0 for gains in way])
                off = (run.q[: len(way)].numpy() - planned)[:, 1:].cumsum(-1)
                row = {"off the plan [mrad]": 1e3 * float(np.abs(off).max())} | row
            found[task][name] = {k: v if math.isfinite(v) else None for k, v in row.items()}
            kept[f"{task}, {name}"] = run.q[::THINNED].numpy()
    return found, kept


def _compensated(
    models: Mapping[str, FrictionModel], friction: FrictionModel, *, shares: bool
) -> dict[str, tuple[FrictionModel | None, float]]:
    """Models and compensated fractions of their torque, by name."""
    rows: dict[str, tuple[FrictionModel | None, float]] = {NONE: (None, 0.0)}
    rows |= {name: (model, 1.0) for name, model in models.items()}
    if shares and SHARED in models:
        rows |= {f"{SHARED}, {g:g} of it": (models[SHARED], g) for g in SHARES}
    return rows | {TRUTH: (friction, 1.0)}


def single_link() -> PendulumChain:
    """The rig with only its first link."""
    whole = rigs.rtip("free").to_dict()
    first = {key: whole[key][:1] for key in ("mass", "length", "com", "inertia")}
    return PendulumChain(
        **first, arm=Arm(**whole["arm"]), gravity=whole["gravity"], name="rtip_single",
        joint_names=whole["joint_names"][:2], convention=("relative", "upright"),
    )  # fmt: skip


def balance_figure(motions: Mapping[str, Array]) -> Figure:
    """Arm and tilt of the links as the arm follows its reference, one line per compensation."""
    shown = {n: motions[f"follow, {n}"] for n in (NONE, SHARED, TRUTH) if f"follow, {n}" in motions}
    figure, axes = style.panels(2, 1, style.PAGE, 3.6, sharex=True)
    looks = style.looks(shown)
    above, below = axes[:, 0]
    for name, q in shown.items():
        time = THINNED * SAMPLE_TIME * np.arange(len(q))
        above.plot(time, q[:, 0], **looks[name].line)
        tilt = np.abs(q[:, 1:].cumsum(-1)).max(-1)
        below.plot(time, 1e3 * tilt, **looks[name].line)
    (asked,) = above.plot(time, [reference(t)[0] for t in time.tolist()], **style.MEASURED)
    asked.set_zorder(0)
    above.set_ylabel("arm [rad]")
    below.set_ylabel("largest tilt [mrad]")
    below.set_xlabel("time [s]")
    handles = [asked, *(looks[name].handle for name in shown)]
    labels = {n: f"{n} compensated" for n in shown} | {NONE: "no compensation"}
    style.legend(figure, handles, ["reference", *(labels[name] for name in shown)])
    return figure

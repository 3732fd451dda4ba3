"""Corrections of one mistake each, under which the balance of torques is tried."""

import math
import warnings
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from nfriction.fitting.adjusted_plant import PlantParameter, adjusted_plant
from nfriction.fitting.data.inputs import names_of, weighs
from nfriction.fitting.diagnosis.balance import (
    Mistake,
    Samples,
    balance_equations,
    best_amount,
    least_unexplained,
    noise_share,
    share_and_factors,
    solve_balance,
    torque_share,
    unexplained_share,
    usual_errors,
)
from nfriction.fitting.plant_parameters import plant_parameters
from nfriction.plant import PendulumChain, Plant
from nfriction.recording.angles import AngleConvention, Angles, MeasuredFrom

Array = NDArray[np.float64]

# Samples in a block from which a curvature is visible despite their noise.
FEWEST_FOR_CURVATURE = 5
# Logarithms of the ratios between which gears of robots lie.
LOG_RATIOS = math.log(1.5), math.log(300.0)
# Cogging repeats with the least common multiple of slots and poles, at most about this.
MOST_PER_TURN = 300
# Heavier loads, in masses of the links, are mistakes in a unit.
MOST_PAYLOAD = 100.0
# Linear solutions for terms that multiply each other; their error is squared each time.
SOLUTIONS = 5
# Other units of inertia than kg m^2, as CAD programs and data sheets give them.
UNITS_OF_INERTIA = {"g m^2": 1e-3, "kg cm^2": 1e-4, "kg mm^2": 1e-6, "g cm^2": 1e-7, "g mm^2": 1e-9}


def tried(text: str, rig: Plant, data: Samples) -> Mistake:
    """A mistake that is corrected in the rig or in the data."""
    return Mistake(text, unexplained_share(rig, data), (rig, data))


def corrected_positions(
    plant: Plant, convention: AngleConvention, given: Samples
) -> Iterator[Mistake]:
    names, first, joints = plant.joint_names, plant.first_link, plant.joints
    chain = isinstance(plant, PendulumChain)
    eye, none, degree = np.eye(joints), np.zeros(joints), math.pi / 180

    def recorded(
        matrix: Array, offset: Array = none, reading: AngleConvention = convention
    ) -> Samples:
        """The data if recorded positions were `matrix @ q + offset` in the convention `reading`."""
        if not chain:
            turn = torch.as_tensor(matrix.T)
            return replace(given, q=given.q @ turn, qd=given.qd @ turn, qdd=given.qdd @ turn)
        q = convention.position_from_joint(given.q.numpy(), first) @ matrix.T + offset
        given_rates = given.qd.numpy(), given.qdd.numpy()
        rates = (convention.rate_from_joint(x, first) @ matrix.T for x in given_rates)
        qd, qdd = (torch.as_tensor(reading.rate_to_joint(x, first)) for x in rates)
        return replace(
            given, q=torch.as_tensor(reading.position_to_joint(q, first)), qd=qd, qdd=qdd
        )

    for j, name in enumerate(names):
        own = np.diag(eye[j])
        mirrored = recorded(eye - 2 * own)
        yield tried(f"the sign of {name}'s position is reversed", plant, mirrored)
        if joints > 1 and j in given.driven:
            text = f"the signs of {name}'s position and {plant.effort} are reversed"
            yield tried(
                text, plant, replace(mirrored, tau=given.tau * torch.as_tensor(1 - 2 * eye[j]))
            )
        # The counts of an encoder's revolution, in quadrature or not, and columns in two units.
        causes = dict.fromkeys((0.25, 0.5, 2.0, 4.0), "counts per revolution")
        if joints > 1 and plant.unit == "rad":
            causes |= {degree: "degrees read as radians", 1 / degree: "radians read as degrees"}
        for factor, cause in causes.items():
            text = f"{name}'s position {_wrong_by(factor, f' ({cause})')}"
            yield tried(text, plant, recorded(eye + (factor - 1) * own))
        # A half turn of the first link is a matter of the convention.
        turns = (-90, 90) if j == first else (-90, 90, 180)
        for degrees in turns if chain and j >= first else ():
            text = f"{name}'s position is {-degrees if degrees < 180 else 180} degrees off"
            yield tried(text, plant, recorded(eye, math.radians(degrees) * eye[j]))
    # On a driven rig this is equivalent to reversed torques, which are also listed.
    yield tried("the signs of all positions are reversed", plant, recorded(-eye))
    units = {"degrees": degree, f"m{plant.unit}": 1e-3}
    if plant.unit == "rad":
        units["radians, but were read as degrees"] = 1 / degree
    for unit, factor in units.items():
        yield tried(f"positions are in {unit}", plant, recorded(factor * eye))
    yield tried("time runs backwards: the motion gains energy", plant, given.at_rate(-1.0))
    if chain:
        zero: MeasuredFrom = "hanging" if convention.measured_from == "upright" else "upright"
        other = AngleConvention(convention.angles, zero)
        text = f"angles are measured from {zero}, not from {convention.measured_from}"
        yield tried(f"{text} (`convention`)", plant, recorded(eye, reading=other))
    if chain and joints - first > 1:
        angles: Angles = "relative" if convention.angles == "absolute" else "absolute"
        other = AngleConvention(angles, convention.measured_from)
        # Motors turn their joints, so a convention cannot make their angles absolute.
        remedy = "`convention`" if plant.motor is None else "a belt drive? convert its columns"
        text = f"angles are {angles}, not {convention.angles} ({remedy})"
        yield tried(text, plant, recorded(eye, reading=other))
    # Columns of motors are exchanged before their gears.
    geared = plant.motor_factors
    turn, torque = (np.array(geared.get(key, [1.0] * joints)) for key in ("motor", "current"))
    if (turn != 1).any():
        text = "positions are of the joints, but were read as those of their motors (`q1`, ...)"
        yield tried(text, plant, recorded(np.diag(1 / turn)))
        text = "positions are of the motors, but were read as those of the joints (`motor1`, ...)"
        yield tried(text, plant, recorded(np.diag(turn)))
    for i in range(joints):
        for j in range(i + 1, joints):
            order = np.arange(joints)
            order[[i, j]] = j, i
            swapped = recorded(eye[order] * (turn / turn[order])[:, None])
            both = f"{names[i]} and {names[j]}"
            yield tried(f"the positions of {both} are exchanged", plant, swapped)
            if given.tau.any():
                tau = given.tau[:, order] * torch.as_tensor(torque / torque[order])
                yield tried(f"the torques of {both} are exchanged", plant, replace(given, tau=tau))
                yield tried(
                    f"the columns of {both} are exchanged", plant, replace(swapped, tau=tau)
                )


def corrected_rigs(plant: Plant, driven: bool) -> Iterator[tuple[str, Plant]]:
    data = plant.to_dict()
    if "buffers" in data:
        return  # they would override the corrected arguments
    motor = data.get("motor") or {}
    given = data | motor
    rotor, milli = "rotor_inertia" if motor else "armature", {"length": 1e-3, "com": 1e-3}
    mistakes: dict[str, dict[str, float]] = {}
    if driven:
        # The keys of a rotor differ.
        none = {"gravity": 1e-6} if "gravity" in given else {"mass": 0.0, "com": 0.0}
        remedy = "`gravity`: 1e-6" if "gravity" in given else "no `mass`"
        text = f"torques show no gravity: joints turn in a horizontal plane ({remedy}), or a"
        mistakes[f"{text} controller compensates it with torques that are not recorded"] = none
    # Of a horizontal rig, at most that of a small tilt.
    if 0 < (level := given.get("gravity", 0.0)) < 0.01:
        text = "the motion shows gravity: joints turn in a vertical plane (`gravity`: 9.81)"
        mistakes[text] = {"gravity": 9.81 / level}
    mistakes |= {
        "masses are in g": {"mass": 1e-3},
        "masses are in g, and inertias in g m^2": {"mass": 1e-3, "inertia": 1e-3},
        "lengths are in mm": milli,
        "lengths are in mm, and inertias in kg mm^2": {**milli, "inertia": 1e-6},
        "the rig is in g, mm and g mm^2": {**milli, "mass": 1e-3, "inertia": 1e-9},
    }
    for unit, factor in UNITS_OF_INERTIA.items():
        mistakes[f"inertias are in {unit}"] = {"inertia": factor}
        mistakes[f"each `{rotor}` is in {unit}"] = {rotor: factor}
        mistakes[f"inertias and each `{rotor}` are in {unit}"] = {"inertia": factor, rotor: factor}
    changes = {
        text: {k: np.array(given[k]) * f for k, f in factors.items() if given.get(k) is not None}
        for text, factors in mistakes.items()
    }
    inertia = np.array(data.get("inertia") or ())
    if inertia.ndim == 1 and len(inertia):
        central = inertia - np.array(data["mass"]) * np.array(data["com"]) ** 2
        changes["inertias are about the joints, not about the mass centres"] = {"inertia": central}
    alike: list[dict[str, Any]] = []
    for text, change in changes.items():
        parts = {key: values.tolist() for key, values in change.items()}
        # A rig without inertias has them in no wrong unit.
        if change and change.keys() <= given.keys() and parts not in alike:
            alike.append({**parts})
            if motor:
                parts["motor"] = motor | {k: parts.pop(k) for k in motor if k in parts}
            # Some would be no mechanism, or a strange one.
            with suppress(ValueError), warnings.catch_warnings():
                warnings.simplefilter("ignore")
                yield text, plant.from_dict({**data, **parts})


def missing_rotors(plant: Plant, given: Samples) -> Iterator[Mistake]:
    own = dict(plant.named_buffers())
    for j, name in enumerate(plant.joint_names) if "armature" in own else ():
        unit = torch.zeros_like(own["armature"])
        unit[j] = 1.0
        x = best_amount(plant, {"armature": unit}, given)
        if x > given.options.ratio_term[0] * float(own["armature"][j]):
            armature = own["armature"] + x * unit
            seen = f"of {float(armature[j]):.3g} kg m^2 seen at the joint"
            text = f"{name} has a rotor inertia {seen} (`armature`, or that of its `motor`)"
            yield tried(text, plant.replace(armature=armature), given)


def payloads(plant: Plant, given: Samples) -> Iterator[Mistake]:
    """Each link with a mass at its end, unless the fit corrects its effects by itself."""
    own, drawn = dict(plant.named_buffers()), plant.to_dict()
    gravity = drawn.get("gravity")
    if not (isinstance(plant, PendulumChain) and gravity) or plant.first_link:
        return
    for k, name in enumerate(plant.joint_names):
        reach = torch.where(torch.arange(plant.joints) <= k, plant.length, 0.0)
        unit = {"inertia_coupling": torch.outer(reach, reach), "gravity_moment": gravity * reach}
        mass, (bound, _) = best_amount(plant, unit, given), given.options.ratio_term
        seen = any((mass * part > bound * own[key]).any() for key, part in unit.items())
        if seen and 0 < mass < MOST_PAYLOAD * sum(drawn["mass"]):
            rig = plant.replace(**{key: own[key] + mass * part for key, part in unit.items()})
            text = f"the link of {name} carries {mass:.3g} kg at its end that the rig lacks"
            yield tried(f"{text} (`mass`, `com` and `inertia`)", rig, given)


def scaled_terms(plant: Plant, given: Samples) -> Iterator[tuple[PlantParameter, float, Plant]]:
    """Each term of inertia and gravity, the relative change that explains most, and its rig."""
    own = dict(plant.named_buffers())
    for term in plant_parameters(plant, driven=given.driven, options=given.options):
        if term.ratio and term.name.startswith(("inertia", "gravity", "mass")):
            x = best_amount(plant, {k: own[k] * part for k, part in term.change.items()}, given)
            if x > -1:
                yield term, x, adjusted_plant(plant, [term], given.q.new_tensor([x]))


def own_inertia(plant: Plant) -> float:
    """Inertia of a single joint with that of its rotor [kg m^2; kg]."""
    rest = torch.zeros(1, plant.joints, dtype=torch.float64)
    accelerated, held = (plant.inverse_dynamics(rest, rest, rest + k) for k in (1.0, 0.0))
    return float((accelerated - held)[0, -1])


def several_terms(plant: Plant, given: Samples) -> Iterator[Mistake]:
    """Inertia, gravity and length terms that together explain most, unless within their bounds.

    Masses and their centres are often guessed for a rig of one's own, all of them wrongly. Lengths
    are not: together they scale as the square of the time, as for a film in slow motion.
    """
    terms = [
        term
        for term in plant_parameters(plant, driven=given.driven, options=given.options)
        if term.ratio and term.name.startswith(("inertia", "gravity", "length", "mass"))
    ]
    one, x = given.q.new_ones(1), given.q.new_zeros(len(terms))
    for _ in range(SOLUTIONS if len(terms) > 1 else 0):
        rig = adjusted_plant(plant, terms, x)
        needed = given.needed(rig)
        slopes = [needed - given.needed(adjusted_plant(rig, [term], one)) for term in terms]
        _, change = solve_balance(given, given.tau - needed, torch.stack(slopes, -1))
        x = (1.0 + x) * (1.0 + change) - 1.0
        if not (x > -1.0).all():
            return
    pairs = [*zip(terms, x.tolist(), strict=True)]
    if any(not term.lower <= value <= term.upper for term, value in pairs):
        times = ", ".join(f"{term.name} {1 + value:.3g}" for term, value in pairs)
        rig = adjusted_plant(plant, terms, x)
        # A motion without torque determines only ratios.
        scale = "" if given.driven else ", for gravity 1 as given"
        text = f"several terms of the rig are wrong (times the given ones{scale}: {times})"
        lengths = [1.0 + value for term, value in pairs if term.name.startswith("length")]
        far = any(abs(value - 1.0) > given.options.length_term[0] for value in lengths)
        timed = far and max(lengths) / min(lengths) - 1.0 < given.options.length_term[0]
        if timed:
            rate = math.sqrt(math.prod(lengths) ** (1 / len(lengths)))
            text += f", or the true sample rate is {rate:.3g} times that in `time`"
        ratios = {term.name: 1.0 + value for term, value in pairs}
        yield Mistake(text, unexplained_share(rig, given), None, rig, ratios, timed)


def torque_gains(plant: Plant, given: Samples) -> Iterator[tuple[str, float, Samples]]:
    """Each drive, and all together, with the gain of the torque that explains most."""
    groups = [(f"the {plant.effort} of {plant.joint_names[j]}", [j]) for j in given.driven]
    if len(groups) > 1:
        groups.append((f"every {plant.effort}", given.driven))
    for what, joints in groups:
        part = torch.zeros_like(given.tau)
        part[:, joints] = given.tau[:, joints]
        # The gain is estimated together with the friction, which would bias a ratio of torques.
        without = replace(given, tau=given.tau - part)
        gain = float(solve_balance(without, without.tau - given.needed(plant), part)[1])
        yield what, gain, replace(given, tau=given.tau + (gain - 1) * part)


def corrected_torques(plant: Plant, given: Samples) -> Iterator[Mistake]:
    for what, gain, scaled in torque_gains(plant, given):
        if gain and abs(gain - 1) > given.options.gain_term[0]:
            text = f"{what} {_wrong_by(gain, ' (a unit, torque constant or gear ratio)')}"
            yield tried(text, plant, scaled)
    needed = given.needed(plant)
    for j in given.driven:
        tau = given.tau[:, j]
        # If gravity requires only one sign, this changes nothing.
        if bool((tau >= 0).all() or (tau <= 0).all()) and tau.min() < tau.max():
            signed = given.tau.clone()
            signed[:, j] = tau.abs() * torch.sign(needed[:, j])
            text = f"the {plant.effort} of {plant.joint_names[j]} is recorded without its sign"
            yield tried(text, plant, replace(given, tau=signed))


def _wrong_by(gain: float, causes: str = "") -> str:
    """The error of a torque or position that must be multiplied by a gain, in a clause."""
    if -1.5 < gain < -0.7:
        return "has the wrong sign"
    size, way = (1 / gain, "large") if abs(gain) < 1 else (gain, "small")
    # Three digits, but 1000 and not 1e+03.
    wrong = f"is {float(f'{abs(size):.3g}'):g} times too {way}{causes}"
    return "has the wrong sign and " * (gain < 0) + wrong


def unlike_gains(plant: Plant, given: Samples) -> Iterator[Mistake]:
    """A gain for each drive, as torque constants of different motors may all be wrong."""
    driven, needed = given.driven, given.needed(plant)
    without = replace(given, tau=torch.zeros_like(given.tau))
    _, gains = solve_balance(without, -needed, torch.diag_embed(given.tau)[..., driven])
    wrong = [
        f"that of {plant.joint_names[j]} {_wrong_by(gain)}"
        for j, gain in zip(driven, gains.tolist(), strict=True)
        if gain and abs(gain - 1) > given.options.gain_term[0]
    ]
    if len(wrong) > 1 and (gains != 0).all():
        scaled = given.tau.clone()
        scaled[:, driven] *= gains
        text = f"the {plant.effort}s are off by different factors: {' and '.join(wrong)}"
        text += " (torque constants or gear ratios)"
        yield Mistake(text, unexplained_share(plant, replace(given, tau=scaled)))


def saturated(plant: Plant, given: Samples) -> Iterator[Mistake]:
    """Each drive with the torque limit that explains most."""
    for j in given.driven:
        largest = float(given.tau[:, j].abs().max())

        def limited(limit: float, joint: int = j) -> Samples:
            tau = given.tau.clone()
            tau[:, joint] = tau[:, joint].clamp(-limit, limit)
            return replace(given, tau=tau)

        limit, _ = least_unexplained(
            lambda x: unexplained_share(plant, limited(x)), 0.1 * largest, largest
        )
        text = (
            f"the drive of {plant.joint_names[j]} saturates at {limit:.3g} {plant.effort_unit}, "
            f"and its {plant.effort} is recorded as commanded (clip the column there)"
        )
        yield tried(text, plant, limited(limit))


def switched_off(plant: Plant, given: Samples) -> Iterator[Mistake]:
    """Each drive, and all together, switched off during the piece where that explains most."""
    needed, driven = given.mean(given.needed(plant)), given.mean(given.tau)
    number, time = given.mean(given.number.to(given.q))[:, 0], given.mean(given.time)[:, 0]
    gained, joints = torch.zeros_like(needed), given.driven
    for j in joints:
        shapes, left = given.friction[:, j], given.moving[:, j] * (driven - needed)[:, j]
        left = left - shapes @ (torch.linalg.pinv(shapes) @ left)
        without = left - given.moving[:, j] * driven[:, j]
        gained[:, j] = (left.square() - without.square()) / driven[:, j].square().mean()
    groups = [(f"the drive of {plant.joint_names[j]} is", [j]) for j in joints]
    groups += [("all drives are", joints)] * (len(joints) > 1)
    for what, own in groups:
        found = []
        for k, name in enumerate(names_of(given.recordings)):
            blocks = (number == k).nonzero().flatten()
            # The consecutive blocks with the largest sum.
            total = np.append(0.0, gained[blocks][:, own].sum(1).cumsum(0).numpy())
            rise = total - np.minimum.accumulate(total)
            end = int(rise.argmax())
            piece = blocks[int(total[: end + 1].argmin()) : end]
            found.append((float(rise[end]), piece, name))
        most = max(gain for gain, *_ in found)
        tau, said = given.tau.reshape(-1, given.block, plant.joints).clone(), []
        for gain, piece, name in found:
            if gain > 0.5 * most:
                for j in own:
                    tau[piece, :, j] = 0.0
                said.append(f"from {time[piece[0]]:.3g} to {time[piece[-1]]:.3g} s of {name}")
        if said:
            text = f"{what} off {', '.join(said[:3])}, although a torque is recorded (set it to 0)"
            yield tried(text, plant, replace(given, tau=tau.reshape_as(given.tau)))


def elastic(plant: Plant, given: Samples) -> Iterator[Mistake]:
    """Each driven joint with a spring between the inertia of its drive and the link.

    The drive's inertia B then takes, in addition to the torque of a rigid joint, B/k times that
    torque's second derivative (M. W. Spong, J. Dyn. Sys. Meas. Control 109 (1987), 310-319),
    because it turns ahead of the joint by the torque over the stiffness k.
    """
    if given.block < FEWEST_FOR_CURVATURE:
        return
    place = torch.arange(given.block).to(given.q) - (given.block - 1) / 2
    place *= given.recordings[0].sample_time
    parabola = place.square() - place.square().mean()
    blocks = given.needed(plant).reshape(-1, given.block, plant.joints)
    curvature = 2 * torch.einsum("bsj,s->bj", blocks, parabola) / parabola.square().sum()
    curvature = curvature.repeat_interleave(given.block, 0)
    for j in given.driven:
        share, ratio = _with_torque(plant, given, j, curvature)
        if ratio > 0:
            text = (
                f"{plant.joint_names[j]} is elastic or has play between drive and encoder "
                f"(resonance near {1 / (math.tau * math.sqrt(ratio)):.2g} Hz), which a rigid rig "
                "cannot follow"
            )
            yield Mistake(text, share)


def springs(plant: Plant, given: Samples) -> Iterator[Mistake]:
    """Each driven joint with a spring to the frame, whose rest is anywhere."""
    for j in given.driven:
        share, stiffness = _with_torque(plant, given, j, given.q)
        unit = f"{plant.effort_unit}/{plant.unit}"
        name = plant.joint_names[j]
        text = (
            f"{name} has a spring of {stiffness:.3g} {unit} that the rig lacks (subtract stiffness "
            f"times position from the {plant.effort} of {name}), or it hardly slides and its "
            "contact is elastic (fit a law with memory, such as `dahl`)"
        )
        yield Mistake(text, share)


def _with_torque(plant: Plant, given: Samples, j: int, torque: Tensor) -> tuple[float, float]:
    """Unexplained share with a torque (sample, joint) at one joint, and its factor in the drive."""
    part = torch.where(torch.arange(plant.joints) == j, torque, 0.0)
    share, factors = share_and_factors(plant, given, part)
    return share, -float(factors)


def unbalanced(plant: Plant, given: Samples) -> Iterator[Mistake]:
    """A rotor without weight that gravity turns once per turn."""
    if plant.unit == "rad" and plant.joints == 1 and given.tau.any() and not weighs(plant):
        wave = torch.stack([given.q.sin(), given.q.cos()], -1)
        text = (
            f"{plant.joint_names[0]} has an unbalanced mass that the rig lacks (`mass` and `com`)"
        )
        yield Mistake(text, unexplained_share(plant, given, wave))


def cogging(plant: Plant, given: Samples) -> Iterator[Mistake]:
    """Each driven joint with a torque that repeats with its position, as of a motor's magnets."""
    left, terms, weight = balance_equations(given, given.tau - given.needed(plant))
    for j in given.driven if plant.unit == "rad" else ():
        q, known = given.q[:, j], terms[:, j]
        span = float(q.max() - q.min())
        # At least two periods within the motion.
        if not 2 * math.tau < MOST_PER_TURN * span < math.inf:
            continue
        rates = torch.arange(math.ceil(2 * math.tau / span), MOST_PER_TURN + 1)
        waves = torch.stack([(q[:, None] * rates).sin(), (q[:, None] * rates).cos()], 2)
        waves = (given.moving[:, [j], None] * given.mean(waves)).movedim(1, 0)
        known = torch.linalg.qr(known[:, known.any(0)]).Q
        rest, waves = (x - known @ (known.T @ x) for x in (left[:, j], waves))
        if not bool(rest.isfinite().all()):
            continue
        sizes = torch.linalg.pinv(waves) @ rest
        best = int((waves @ sizes[..., None]).square().sum((1, 2)).argmax())
        part = torch.zeros(*given.q.shape, 2, dtype=q.dtype)
        part[:, j] = torch.stack([(rates[best] * q).sin(), (rates[best] * q).cos()], 1)
        text = (
            f"{plant.joint_names[j]} has a torque of {float(sizes[best].norm() * weight[j]):.2g} "
            f"N m that repeats {rates[best]} times per turn (cogging of its motor)"
        )
        yield Mistake(text, unexplained_share(plant, given, part))


def geared(plant: Plant, convention: AngleConvention, given: Samples) -> Iterator[Mistake]:
    """Each joint, and all, as if recorded at the motor, before a gear of the best ratio.

    If the rig has motors, also each driven joint with the ratio of its gear that explains most.
    """
    if not isinstance(plant, PendulumChain) or not given.tau.any():
        return
    first, eye = plant.first_link, np.eye(plant.joints)
    q = convention.position_from_joint(given.q.numpy(), first)
    rates = [convention.rate_from_joint(x.numpy(), first) for x in (given.qd, given.qdd)]

    def share_at(x: float, group: Array, drive: Array) -> float:
        scale = np.exp(-x * group)
        at = torch.as_tensor(convention.position_to_joint(q * scale, first))
        qd, qdd = (torch.as_tensor(convention.rate_to_joint(r * scale, first)) for r in rates)
        gain = torch.as_tensor(np.exp(x * drive))
        data = replace(given, q=at, qd=qd, qdd=qdd, tau=given.tau * gain)
        rig = plant.replace(armature=plant.armature * gain.square()) if drive.any() else plant
        return unexplained_share(rig, data)

    every = [("all positions are", eye.sum(0))] * (plant.joints > 1)
    alone = [(f"{name}'s position is", eye[j]) for j, name in enumerate(plant.joint_names)]
    for what, group in (*alone, *every):
        ratio, share = least_unexplained(
            partial(share_at, group=group, drive=0 * group), *LOG_RATIOS, 41
        )
        text = f"{what} {math.exp(ratio):.3g} times too large (of the motor, before its gear)"
        yield Mistake(text, share)
    for j in given.driven if plant.motor is not None else ():
        most = math.log(4.0)  # ratios within a series of gears
        ratio, share = least_unexplained(
            partial(share_at, group=eye[j], drive=eye[j]), -most, most, 17
        )
        name = plant.joint_names[j]
        text = f"the gear ratio of {name} is {math.exp(ratio):.3g} times that of the rig"
        yield Mistake(text, share)


def wrong_rate(plant: Plant, given: Samples) -> Mistake:
    """Another sample rate, by the factor that explains most."""
    most = math.log(10)
    x, share = least_unexplained(
        lambda x: unexplained_share(plant, given.at_rate(math.exp(x))), -most, most, 17
    )
    return Mistake(f"the true sample rate is {math.exp(x):.3g} times that in `time`", share)


def balanced_delay(plant: Plant, given: Samples) -> tuple[float, float]:
    """Delay of torques after positions that explains most [s], and the unexplained share [-]."""
    most, options = given.options.largest_delay, given.options
    # Vibrations of a controlled joint make narrow valleys; block means show none that are faster.
    step = max(2 * given.recordings[0].sample_time, 0.1 * options.diagnosis_block)
    count = max(9, 1 + 2 * math.ceil(most / step))
    return least_unexplained(lambda x: unexplained_share(plant, given.late(x)), -most, most, count)


def drifting_clock(plant: Plant, given: Samples) -> Mistake:
    """A clock of the torques with the drift that explains most."""
    most = given.options.largest_delay / max(r.duration for r in given.recordings)
    drift, share = least_unexplained(
        lambda x: unexplained_share(plant, given.late(0.0, x)), -most, most
    )
    fast = "faster" if drift > 0 else "slower"
    off = f"{100 * abs(drift):.2g} % {fast}"
    return Mistake(f"the clock of the torques is {off} than that of the positions", share)


def delay_in_words(delay: float) -> str:
    """A delay of torques after positions [s], and how to remove it, as a clause."""
    words = ("torques", "positions") if delay > 0 else ("positions", "torques")
    return (
        f"{words[0]} are recorded {1e3 * abs(delay):.3g} ms later than {words[1]} "
        f"(`fit_delay=True`, or `recording.advance_torque({delay:.3g})`)"
    )


def delay_beside_usual_errors(plant: Plant, given: Samples) -> Iterator[Mistake]:
    """A delay that divides the share which usual errors of the rig leave.

    The balance of the rig as given hides a delay beside such errors.
    """
    most, needed = given.options.largest_delay, given.needed(plant)
    errors = usual_errors(plant, given)

    def unexplained(data: Samples) -> float:
        return torque_share(plant, data, solve_balance(data, data.tau - needed, *errors)[0], needed)

    if (sound := unexplained(given)) <= noise_share(plant, given, given.sd_of_mean):
        return
    delay, share = least_unexplained(lambda x: unexplained(given.late(x)), -most, most)
    if not given.held(delay) and given.options.diagnosis_ratio * share < sound:
        yield Mistake(f"{delay_in_words(delay)}, together with usual errors of the rig", share)

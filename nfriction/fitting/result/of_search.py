"""The result of a search or a regression: intervals and warnings."""

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from nfriction.fitting.data.inputs import ranges, too_few_steps
from nfriction.fitting.equation_error import TorqueFit, peak_dynamics_torque
from nfriction.fitting.result import identifiability
from nfriction.fitting.result.fit_result import FitResult
from nfriction.fitting.result.identifiability import CoefficientUncertainty, Information, Interval
from nfriction.fitting.robust_loss import Outliers, named_outliers, outlier_warning
from nfriction.fitting.shooting import uncertainty
from nfriction.fitting.shooting.autocorrelation import bandwidth, effective_noise, hac_sd
from nfriction.fitting.shooting.problem import ShootingProblem
from nfriction.fitting.shooting.variables import model_at
from nfriction.friction.models import FrictionModel
from nfriction.optim.least_squares import LeastSquaresResult
from nfriction.plant import Plant
from nfriction.recording import Recording
from nfriction.signals import Motion

BLURRED = (
    "The torque comes from a smoothed motion, which blurs friction at low speed and ignores errors "
    'of the plant; `method="output_error"` gives better estimates, and intervals that cover both.'
)
PROPORTIONAL = (
    "Without a recorded torque, friction is in proportion to the masses and inertias of the rig, "
    "which the intervals take as exact."
)
# Relative changes that agree within this fraction count as equal.
ALIKE = 0.1
# Only the logarithm of a positive coefficient has a lower bound as small as this, in SI.
NOTHING = 1e-9


def result_from_equation_error(
    model: FrictionModel,
    plant: Plant,
    start: FitResult | None,
    motions: tuple[Motion, ...],
    torque: TorqueFit,
) -> FitResult:
    """The result of a regression on torques; its coefficients are written into the model."""
    model.schedule.set_parameter_vector(torque.coefficients.reshape(-1))
    names = model.schedule.parameter_names(plant.joint_names)
    lower, upper = model.schedule.bounds()
    fitted = (lower < upper).nonzero().flatten()
    fitted_names = [names[i] for i in fitted.tolist()]
    values, lower, upper = (x[fitted] for x in (model.schedule.parameter_vector(), lower, upper))
    known = Information(torch.block_diag(*torque.information), torch.zeros(len(names)).double())
    known = known.subset(fitted)
    sd = identifiability.standard_deviations(known)
    low, high = values <= lower + NOTHING, values >= upper
    at_bounds, at_zero = (
        tuple(fitted_names[i] for i in mask.nonzero().flatten().tolist())
        for mask in (low | high, low & (lower.abs() <= NOTHING))
    )
    unidentifiable = identifiability.null_directions(fitted_names, known)
    unidentifiable += _of_resting(fitted_names, plant, motions)
    weak = identifiability.weakly_identified(fitted_names, values, known)
    unidentifiable += tuple(name for name in weak if not any(name in d for d in unidentifiable))
    unidentifiable = tuple(dict.fromkeys(unidentifiable))
    found = identifiability.warnings_of(
        converged=True, at_bounds=at_bounds, unidentifiable=unidentifiable, at_zero=at_zero
    )
    rig = start.plant if start else plant
    largest = _largest_friction(model, rig, motions)
    total = rig.torque_offset + torque.offset
    offsets = tuple(
        _one_way(rig, joint, True, float(total[joint]), largest)
        for joint in (total != plant.torque_offset).nonzero().flatten().tolist()
    )
    changes = {f"{plant.effort} offset {j + 1}": x for j, x in enumerate(torque.offset.tolist())}
    return FitResult(
        model=model.requires_grad_(False),
        plant=rig.replace(torque_offset=total) if torque.offset.any() else rig,
        plant_terms=tuple(
            (name, value + changes.get(name.partition(" [")[0], 0.0), bound)
            for name, value, bound in (start.plant_terms if start else ())
        ),
        status="Converged: linear least squares of the torque.",
        converged=True,
        residual=float(torque.residual.square().mean().sqrt()),
        at_bounds=at_bounds,
        steps=0,
        motions=motions,
        residuals=torch.zeros(0, dtype=torch.float64),
        intervals=identifiability.confidence_intervals(
            fitted_names, values, sd, lower, upper, model.law
        ),
        unidentifiable=unidentifiable,
        warnings=(*found, BLURRED, *offsets, *outlier_warning(torque.outliers)),
        outliers=torque.outliers,
    )


def result_from_shooting(
    model: FrictionModel,
    problem: ShootingProblem,
    result: LeastSquaresResult,
    motions: tuple[Motion, ...],
    ambiguous: Sequence[str] = (),
) -> FitResult:
    """The result of a search; its coefficients are written into the model.

    `ambiguous` are parameters for which very different values explain the data equally well.
    """
    plant, variables, x = problem.jacobian.plant, problem.variables, result.x
    friction, vector, _, offsets = variables.split(x)
    model.load_state_dict(model_at(problem.friction, friction).state_dict())
    count, terms = variables.shared_count, variables.terms
    names = [*model.schedule.parameter_names(plant.joint_names), *(t.name for t in terms)]
    lower, upper = (bound[:count] for bound in variables.bounds())
    # Equal bounds: not fitted.
    hit = (result.at_lower | result.at_upper)[:count] & (lower < upper)
    least = lower.abs() <= NOTHING
    least[count - len(terms) :] = torch.tensor([t.to_none for t in terms], dtype=torch.bool)
    at_lower, at_upper = (hit & end[:count] for end in (result.at_lower, result.at_upper))
    at_bounds, at_zero, at_most = (
        tuple(names[i] for i in mask.nonzero().flatten().tolist())
        for mask in (hit, at_lower & least, at_upper)
    )
    free = [name for name, moves in zip(names, (lower < upper).tolist(), strict=True) if moves]
    ambiguous = (*ambiguous, *_of_resting(free, plant, problem.windows.recordings))
    residuals = problem.errors(x)
    weights, counted = problem.loss.weight(residuals), problem.loss.counted(residuals)
    residual = float(counted.square().mean().sqrt())
    outliers = tuple(outliers_of(problem, weights))
    noise = uncertainty.measurement_noise(problem, x, residual)
    limit = problem.options.model_error_ratio
    rest = _remaining_step(problem, result)
    intervals, unidentifiable, root = _identifiability(
        problem, result, names, residuals * weights, motions, ambiguous, rest
    )
    ended = result.status in ("max_steps", "creeping", "stalled")
    noticed = problem.options.explained_ratio
    if ended and root is not None and _near_minimum(result, rest, root, noticed):
        result = replace(result, status="converged_interval")
    ends = {name: (float(a), float(b)) for name, a, b in zip(names, lower, upper, strict=True)}
    # Their bound is a matter of chance.
    vague = {i.name for i in intervals if i.low <= ends[i.name][0] and i.high >= ends[i.name][1]}
    favoured = [name for name in at_bounds if name not in vague]
    incomplete = residual > limit * noise
    scaled, far = scale_warning(problem, intervals, incomplete)
    gains = list(gain_warnings(problem, intervals))
    mistakes = lossless_motion(problem, at_zero) if incomplete else ()
    return FitResult(
        model=model.requires_grad_(False),
        plant=problem.plant_at(vector),
        plant_terms=tuple((t.name, float(v), t.upper) for t, v in zip(terms, vector, strict=True)),
        status=result.message if result.converged else f"Not converged: {result.message}",
        converged=result.converged,
        residual=residual,
        at_bounds=at_bounds,
        steps=result.steps,
        motions=motions,
        residuals=residuals,
        intervals=intervals,
        unidentifiable=unidentifiable,
        encoder_offsets=tuple(map(tuple, offsets.tolist())),
        noise=noise,
        stages=((problem.windows.length, residual),),
        mistakes=mistakes,
        unmodelled=scaled * far + tuple(text for text, wrong in gains if wrong),
        warnings=tuple(f"A mistake in data or rig is likely: {text}." for text in mistakes)
        + identifiability.warnings_of(
            converged=result.converged, at_bounds=favoured, unidentifiable=unidentifiable,
            at_zero=at_zero,
        )
        + identifiability.model_error_warning(
            residual, effective_noise(counted), noise, plant.unit, problem.options
        )
        + scaled
        + tuple(text for text, _ in gains)
        + (PROPORTIONAL,) * (not problem.windows.tau.any())
        + too_few_steps(
            problem.plant_at(vector), model, float(problem.windows.step.max()), problem.options
        )
        + rotor_warning(problem, at_bounds, at_most)
        + tuple(offset_warnings(problem, vector, intervals, model, motions))
        + outlier_warning(outliers),
        outliers=outliers,
        uncertainty=None if root is None else CoefficientUncertainty(model.schedule, root),
    )  # fmt: skip


def _of_resting(
    names: Sequence[str], plant: Plant, moved: Sequence[Recording] | Sequence[Motion]
) -> tuple[str, ...]:
    """Coefficients of joints that never move.

    The smoothed sign creeps in simulations, which looks like information.
    """
    still = np.flatnonzero(ranges(moved) == 0) if moved else ()
    ends = tuple(f" of {plant.joint_names[j]}" for j in still)
    return tuple(name for name in names if ends and name.endswith(ends))


def lossless_motion(problem: ShootingProblem, at_zero: Sequence[str]) -> tuple[str, ...]:
    """A clause if friction and drag of a free motion are all at zero."""
    law, plant = problem.friction.law.coefficients, problem.jacobian.plant
    losses = [f"{c.name} of {j}" for c in law if c.unit.startswith("N") for j in plant.joint_names]
    losses += [term.name for term in problem.variables.terms if term.to_none]
    if problem.windows.tau.any() or not losses or not set(losses) <= set(at_zero):
        return ()
    return (
        "a free motion fits best without any loss of energy: time runs backwards, or the torque of "
        "a drive is missing",
    )


def scale_warning(
    problem: ShootingProblem, intervals: Sequence[Interval], incomplete: bool
) -> tuple[tuple[str, ...], bool]:
    """A sentence if the fit scales the rig, and with it friction; true if that makes it doubtful.

    The terms of a driven rig are scaled if all change alike and friction leaves its interval, or if
    the change that they share exceeds what is their own, and 95 % of the prior. A single term, or
    one of a free rig, is named beyond the prior's standard deviation, and doubtful beyond 95 %.
    `incomplete` is true if the residual contains errors of the model.
    """
    plant, driven = problem.jacobian.plant, bool(problem.windows.tau.any())
    sd = problem.options.ratio_term[1]
    usual = identifiability.NORMAL_95 * sd
    weights = [
        i for i in intervals
        if i.name.startswith(("inertia", "gravity", "mass")) and i.low * i.high > 0
    ]  # fmt: skip
    changes = list(_relative_weights(plant, intervals))
    cause = "the rig is wrong, or torques are recorded {0} times as large as they are (torque "
    cause += "constant, gear ratio, unit); then so is the friction."
    if driven and len(changes or weights) > 1:
        change = sum(changes) / len(changes or weights)
        shared, own = len(changes) * change**2, sum((x - change) ** 2 for x in changes)
        # Like a delay, a scale matters if it takes a coefficient of torque out of its interval.
        # Networks have no such intervals.
        law, least = problem.friction.law.coefficients, problem.options.gain_term[1]
        of_torque = tuple(f"{c.name} of" for c in law if c.unit.startswith("N"))
        friction = [i for i in intervals if i.name.startswith(of_torque)]
        out = any(not i.low <= i.value / (1 + change) <= i.high for i in friction)
        matters = out if friction else abs(change) >= least
        alike = matters and all(abs(x - change) < ALIKE * abs(change) for x in changes)
        if not alike and shared <= max(own, usual**2):
            return (), False
        scale, far = f"{1 + change:.4g}", True
        found = f"Inertia and gravity are {'both' if alike else 'on average'} {scale} times those"
    else:
        worst = max(weights, key=lambda i: abs(i.value), default=None)
        if worst is None or abs(worst.value) <= sd:
            return (), False
        term, _, place = worst.name.partition(" ")
        joint = plant.joint_names[int(place[0]) - 1 + plant.first_link]
        scale, far = f"{1 + worst.value:.3g}", abs(worst.value) > usual
        found = f"The {term} of {joint} is {scale} times that"
        if not driven:
            cause = (
                "the masses, inertias and centres of mass of the rig do not agree with the motion; "
                "the friction is in proportion to them."
            )
    if incomplete:
        cause = f"The law lacks something, which may have changed this; or {cause}"
    else:
        cause = f"Either {cause}" if driven else cause.capitalize()
    return (f"{found} of the rig. {cause.format(scale)}",), far


def gain_warnings(
    problem: ShootingProblem, intervals: Sequence[Interval]
) -> Iterator[tuple[str, bool]]:
    """A sentence for each torque gain that matters, and whether the friction is doubtful.

    A gain matters if its whole interval takes a coefficient of torque out of its own, or beyond its
    prior's standard deviation; only then is the friction doubtful, as drives differ by less.
    """
    sd, law = problem.options.gain_term[1], problem.friction.law.coefficients
    for one in intervals:
        term, _, place = one.name.rpartition(" ")
        if term != "torque gain" or one.low * one.high <= 0:
            continue
        joint = problem.jacobian.plant.joint_names[int(place) - 1]
        own = {f"{c.name} of {joint}" for c in law if c.unit.startswith("N")}
        friction = [i for i in intervals if i.name in own]
        least = 1 + min(one.low, one.high, key=abs)
        out = any(not i.low <= i.value * least <= i.high for i in friction)
        scale, far = f"{1 / (1 + one.value):.3g}", abs(one.value) > sd
        if far or (out and scale != "1"):
            text = (
                f"Torques of {joint} are recorded {scale} times as large as those of the other "
                "joints (torque constant, gear ratio, unit), and its friction with them."
            )
            yield text, far


def rotor_warning(
    problem: ShootingProblem, at_bounds: Sequence[str], at_most: Sequence[str]
) -> tuple[str, ...]:
    """A sentence if a driven chain without rotors has a length or largest inertia at a bound."""
    tau, plant = problem.windows.tau, problem.jacobian.plant
    rotors = dict(plant.named_buffers()).get("armature", tau)
    if plant.motor is not None:
        rotors = rotors + plant.motor.reflected_inertia(plant.joints)
    bare = tau.any() and not rotors.any()
    largest = any(name.startswith("inertia") for name in at_most)
    hit = largest or any(name.startswith("length") for name in at_bounds)
    said = "The rig has no rotor inertia (`armature`, or that of a `motor`). With geared drives, "
    return (said + "inertias and lengths may therefore be at a bound.",) if bare and hit else ()


def offset_warnings(
    problem: ShootingProblem,
    vector: Tensor,
    intervals: Sequence[Interval],
    model: FrictionModel,
    motions: Sequence[Motion],
) -> Iterator[str]:
    """A sentence for each drive with a larger one-way torque than a sensor's usual bias."""
    plant, slides = problem.plant_at(vector), problem.jacobian.plant.unit == "m"
    # Friction brakes in both directions, so it differs between them by at most twice its mean.
    largest = _largest_friction(model, plant, motions)
    # Within its prior an offset is a bias like any other; so is what is as small at full speed.
    usual = problem.options.offset_term[1] / problem.options.asymmetry_term[1]
    kinds = {"torque_offset", "asymmetry"}
    terms = {t.name: t for t in problem.variables.terms if kinds & t.change.keys()}
    for one in (i for i in intervals if i.name in terms and i.low * i.high > 0):
        ((buffer, chosen),) = terms[one.name].change.items()
        constant, j = buffer == "torque_offset", int(chosen.argmax())
        if abs(one.value) > terms[one.name].prior_sd * (usual if slides or not constant else 1):
            # An asymmetry is on the side of the friction.
            whole = float(dict(plant.named_buffers())[buffer][j]) * (1 if constant else -1)
            yield _one_way(plant, j, constant, whole, largest)


def _one_way(plant: Plant, joint: int, constant: bool, value: float, largest: Tensor) -> str:
    """A sentence for a drive's torque in one direction, given the largest friction, (joint,)."""
    kind = f"{'constant ' * constant}drive {plant.effort}"
    unit = plant.effort_unit if constant else "N s/m times the speed"
    way = "backwards" if value > 0 else "forwards"
    cause = f"may equally be friction that is {2 * abs(value):.3g} {unit} larger {way}"
    if constant and abs(value) > largest[joint]:
        cause = "is larger than its friction: a weight, a spring, or a sensor's bias"
    sign = "subtract {} from" if value > 0 else "add {} to"
    remedy = f"{sign.format(f'{abs(value):.3g} {unit}')} a command"
    if constant:
        remedy += ", but not if it is a sensor's bias"
    return (
        f"The fitted plant has a {kind} of {value:.3g} {unit} at {plant.joint_names[joint]}, which "
        f"{cause}. The friction model and its exports lack it: {remedy}."
    )


def _largest_friction(model: FrictionModel, plant: Plant, motions: Sequence[Motion]) -> Tensor:
    """Largest friction torque of each joint in the motions, (joint,).

    Infinite where it is unknown: with a memory, or without motions.
    """
    if model.law.memory or model.schedule.state_size or not motions:
        return torch.full((plant.joints,), torch.inf)
    parts = ([getattr(m, key) for m in motions] for key in ("q", "qd", "qdd"))
    q, qd, qdd = (torch.tensor(np.concatenate(x)) for x in parts)
    return model(qd, qdd, plant.load(q, qd)).abs().amax(0)


def _relative_weights(plant: Plant, intervals: Sequence[Interval]) -> Iterator[float]:
    """Relative changes of each link's gravity and inertia, 0 if not significant.

    Link and rotor of a geared joint count as one, since the data show only their sum.
    """
    terms, own = {i.name: i for i in intervals}, dict(plant.named_buffers())
    for k in range(plant.joints - plant.first_link):
        inertia = terms.get(f"inertia {k + 1}{k + 1}")
        rotor = terms.get(f"armature {k + 1 + plant.first_link}")
        alone = [terms.get(f"gravity {k + 1}"), inertia if rotor is None else None]
        for term in alone:
            if term is not None:
                yield term.value if term.low * term.high > 0 else 0.0
        if inertia is not None and rotor is not None:
            sizes = own["inertia_coupling"][k, k], own["armature"][k + plant.first_link]
            moved = sizes[0] * inertia.value + sizes[1] * rotor.value
            yield float(moved / (sizes[0] + sizes[1]))


def outliers_of(problem: ShootingProblem, weights: Tensor) -> Iterator[Outliers]:
    """Samples to which a robust loss gives less than half weight, by recording."""
    if problem.loss.name == "linear":
        return
    windows = problem.windows
    for place, recording in enumerate(windows.recordings):
        weight = np.ones_like(recording.q)
        for (of, first, last), row in zip(windows.spans, weights.numpy(), strict=True):
            if of == place:
                part = weight[first : last + 1]
                np.minimum(part, row[: last - first + 1], out=part)
        yield from named_outliers(recording, weight)


def _identifiability(
    problem: ShootingProblem,
    result: LeastSquaresResult,
    names: Sequence[str],
    residuals: Tensor,
    motions: Sequence[Motion],
    ambiguous: Sequence[str],
    rest: Tensor,
) -> tuple[tuple[Interval, ...], tuple[str, ...], Tensor | None]:
    """Confidence intervals, unidentifiable parameters, and a covariance root of the friction.

    With a network only plant terms have intervals, and no parameter counts as unidentifiable.
    `rest` is the step that remains to the minimum, a further error like that of integration; a
    network has another one, `_by_data`.
    """
    constant = not problem.friction.schedule.follows_motion
    if (belief := problem.friction.schedule.belief()) is None:
        off = torch.stack([uncertainty.integration_error(problem, result), rest.nan_to_num(0.0)], 1)
    else:
        problem, off = _by_data(problem, result.x, belief)
    variables, options = problem.variables, problem.options
    count, friction_count = variables.shared_count, variables.friction_count
    lower, upper = (bound[:count] for bound in variables.bounds())
    fitted = (lower < upper).nonzero().flatten()
    fitted_names = [names[i] for i in fitted.tolist()]
    # Residuals are exactly zero if no joint ever moved.
    if not torch.isfinite(result.hessian).all() or not effective_noise(residuals) > 0:
        return (), tuple(fitted_names) if constant else (), None
    sd = hac_sd(residuals, bandwidth(problem.windows.q, options), options)
    # Below breakaway a contact returns to the same positions, so the rounding recurs at any lag.
    quantum = uncertainty.encoder_count(problem) if problem.friction.law.memory else None
    rms = float(residuals.square().mean().sqrt())
    rounded = quantum and rms <= options.explained_ratio * quantum / 12**0.5
    known = uncertainty.gathered_information(problem, result.x, sd, quantum if rounded else None)
    known = known.subset(fitted)
    own = torch.cat([identifiability.covariance_root(known), off[fitted]], 1)
    root = own.new_zeros(count, own.shape[1])
    root[fitted] = own
    root[[names.index(name) for name in ambiguous]] = torch.inf
    sd = root.norm(dim=1)
    shown = fitted if constant else fitted[fitted >= friction_count]
    intervals = identifiability.confidence_intervals(
        [names[i] for i in shown.tolist()], result.x[shown], sd[shown], lower[shown], upper[shown],
        problem.friction.law,
    )  # fmt: skip
    unidentifiable: tuple[str, ...] = ()
    if constant:
        friction = fitted[fitted < friction_count]
        coefficients = fitted_names[: len(friction)]
        unidentifiable = identifiability.null_directions(fitted_names, known, options)
        unidentifiable = tuple(dict.fromkeys((*unidentifiable, *ambiguous)))
        slope, need = _torque_scale(problem, result, motions)
        weak = (
            *identifiability.weakly_identified(coefficients, result.x[friction], known, options),
            *identifiability.exceeds_drive_torque(
                coefficients, sd[friction], slope[friction], need[friction]
            ),
        )
        unidentifiable += tuple(
            name for name in dict.fromkeys(weak) if not any(name in d for d in unidentifiable)
        )
    return intervals, unidentifiable, root[:friction_count].clone()


def _by_data(
    problem: ShootingProblem, x: Tensor, belief: tuple[Tensor, Tensor]
) -> tuple[ShootingProblem, Tensor]:
    """A network's problem with hardly any prior, and the step from `x` to its minimum.

    Priors chosen by evidence or hold-out keep a network near its law even where the truth is not,
    and its search ends in a narrow valley before the minimum. Its intervals are computed with a
    prior of one unit and without that on unvisited motion, so that they rest on the data and not on
    priors. The step counts as a further error.
    """
    mean, sd = problem.friction_prior or belief
    wide = torch.maximum(sd, belief[1])
    problem = replace(problem, friction_prior=(mean, wide), extrapolation=None)
    local = problem.linearise(x)
    lower, upper = problem.variables.bounds()
    off = uncertainty.full_step(local.hessian, local.gradient, lower < upper)
    return problem, off.nan_to_num(0.0)[:, None]


def _remaining_step(problem: ShootingProblem, result: LeastSquaresResult) -> Tensor:
    """Step from the end of a search to the minimum of its quadratic, zero if it converged."""
    if result.converged:
        return torch.zeros_like(result.x)
    lower, upper = problem.variables.bounds()
    slope = result.gradient
    held = (result.at_lower & (slope > 0)) | (result.at_upper & (slope < 0))
    return uncertainty.full_step(result.hessian, slope, (lower < upper) & ~held)


def _near_minimum(result: LeastSquaresResult, rest: Tensor, root: Tensor, noticed: float) -> bool:
    """True if the remaining step is within the intervals and hardly lowers the residual.

    It changes each friction parameter by at most one standard deviation, which excludes this step.
    Intervals are also wide if the residual is large, so the step must not divide it by `noticed`.
    """
    saved = -float(result.gradient @ rest + 0.5 * rest @ (result.hessian @ rest))
    small = 2.0 * rest[: len(root)].square() <= root.square().sum(1)
    return saved <= (1.0 - noticed**-2) * result.cost and bool(small.all())


def _torque_scale(
    problem: ShootingProblem, result: LeastSquaresResult, motions: Sequence[Motion]
) -> tuple[Tensor, Tensor]:
    """Largest |derivative| of the friction torque with respect to each constant coefficient at its
    joint's peak speed, and the largest torque that moves this joint, (friction parameter,) each.
    """
    friction, vector, _, _ = problem.variables.split(result.x)
    speed, moved = peak_dynamics_torque(problem.plant_at(vector), motions, problem.options)
    need = torch.maximum(moved, problem.windows.tau.abs().amax((0, 1)))
    table = friction.reshape(len(speed), -1).clone().requires_grad_()
    # A gear's loss is a share of the torque, which may drive the joint or brake it.
    loads = (need, -need) if problem.friction.law.reads_drive else (torch.ones_like(speed),)
    with torch.enable_grad():
        # A law is elementwise, so the sum's gradient is each coefficient's own slope.
        torques = [problem.friction.steady_torque(speed, load, table).sum() for load in loads]
        slopes = [torch.autograd.grad(torque, table)[0].abs() for torque in torques]
    slope = torch.stack(slopes).amax(0)
    return slope.flatten(), need[:, None].expand_as(slope).flatten()

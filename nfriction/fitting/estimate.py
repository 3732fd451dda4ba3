"""Fit a friction model to recordings: torques first, then trajectories."""

import logging
from collections.abc import Sequence
from dataclasses import replace
from typing import Literal, get_args

import torch
from torch import Tensor

from nfriction.fitting.eccentricity import may_be_eccentric, richer_by_evidence
from nfriction.fitting.holdback import HEAD_START, gain_on, judged_windows
from nfriction.fitting.neurofuzzy_start import is_constant_fit, settle_on, start_at
from nfriction.fitting.outcome import Fit, Plant, torque_outcome, trajectory_outcome
from nfriction.fitting.preparation import (
    adjustable_terms,
    constant_schedule,
    has_encoder_terms,
    in_joint_coordinates,
    listed,
    mixing_of,
)
from nfriction.fitting.residuals import effective_noise, stride_of
from nfriction.fitting.stages import Callback, Refinement, Stage
from nfriction.fitting.torque import fit_torque, prior_sd
from nfriction.fitting.windows import cut_windows
from nfriction.friction import Adaptive, Constant, FrictionModel
from nfriction.friction.neurofuzzy import NeuroFuzzy
from nfriction.recording import Recording
from nfriction.signals import Motion, kalman_smoother

logger = logging.getLogger(__name__)

Method = Literal["trajectory", "torque"]
# How encoders were zeroed: once for all recordings, or anew at the start of each.
Zeroed = Literal["once", "each"]
# Dry friction of a tenth of a link's largest gravity moment lets it rest up to 0.1 rad off [rad].
ZERO_SD = 0.05
# First guess of what a model of a bench leaves unexplained, before a fit tells [rad or m].
FIRST_NOISE = 1e-3
# Short windows converge from far away, long ones tell small friction and small drag apart [s].
WINDOWS = (0.5, 2.0, 5.0)
# Relative fall of the cost that ends a search of which only the neighbourhood matters.
LOOSE = 1e-4
# Priors of a network that are tried, over its own: windows held back choose among them.
PRIOR_SHARES = (1.0, 1 / 3)
# Errors that count for less would be rounding [rad or m].
LEAST_NOISE = 1e-9


def fit(
    model: FrictionModel,
    plant: Plant,
    recordings: Recording | Sequence[Recording],
    *,
    method: Method = "trajectory",
    windows: Sequence[float] = WINDOWS,
    fit_plant: bool = True,
    drag: bool | None = None,
    eccentricity: bool | None = False,
    zeroed: Zeroed = "once",
    start: Fit | None = None,
    motions: Sequence[Motion] | None = None,
    max_steps: int = 30,
    callback: Callback | None = None,
) -> Fit:
    """Estimate a friction model from recordings.

    The friction torque that the smoothed motion implies gives constant coefficients; simulated
    windows of growing length then refine them, and what the data tell of the plant. A
    neuro-fuzzy model starts at the constant fit of its own law and is pulled toward it, by its
    own prior or a tighter one that serves windows held back better. So
    does every class of an adaptive model; `fit_adaptive` has its further settings.

    Args:
        model: the model to fit; changed in place.
        plant: the mechanism as given.
        recordings: one or several, all in one convention; where they say none, in the plant's.
        method: `"torque"` stops after the torque fit (constant coefficients only).
        windows: lengths of the windows [s], in the order in which they are used.
        fit_plant: adjust ratios of inertia and gravity terms and offsets, within bounds.
        drag: also fit air drag on the links. None fits it where nothing drives a chain on a
            fixed pivot: a free swing loses as much to the air as to its joints, and without drag
            the joints' coefficients take it over and are wrong.
        eccentricity: also fit how far the encoders sit off their shafts; not with an adaptive
            model. None asks the evidence, or takes what `start` found. Off by default: the
            evidence trusts the law, and where that is wrong a sine of the angle takes over part of
            it that other amplitudes do not have.
        zeroed: when incremental encoders were set to zero. `"once"`: before all recordings, so
            that an angle offset is part of the plant. `"each"`: at the start of each recording,
            wherever dry friction held the links then; how far that was off is found for each
            recording and left out of the plant, whose offset stays as given, as that of a further
            recording cannot be known. Not with an adaptive model.
        start: an earlier fit to start from: of the same law for a neuro-fuzzy model, of any model
            for the plant's terms.
        motions: smoothed motions in joint coordinates, to save smoothing again.
        max_steps: limit of steps to each window length.
        callback: called with a stage name after every step; True stops.

    Returns:
        The fit; read `converged` and `status`.

    Raises:
        TypeError: if model, plant or recordings are something else.
        ValueError: if recordings and plant do not match, or there is no such method or zero.
    """
    if method not in get_args(Method):
        raise ValueError(f"`method` must be one of {get_args(Method)}, got {method!r}.")
    if zeroed not in get_args(Zeroed):
        raise ValueError(f"`zeroed` must be one of {get_args(Zeroed)}, got {zeroed!r}.")
    given = listed(model, plant, recordings)
    joint = in_joint_coordinates(plant, model, given)
    if eccentricity and not may_be_eccentric(plant):
        raise ValueError(f"{plant.name or 'the axis'} has no encoders that turn with its joints.")
    moved = tuple(motions or (kalman_smoother(r.time, r.q) for r in joint))
    if isinstance(model.schedule, Adaptive):
        if zeroed == "each":
            raise ValueError('`zeroed="each"` is not for an adaptive model; fit its constant law.')
        if method == "torque":
            raise ValueError("an adaptive model is fitted to trajectories, not to torques.")
        # It fits the constant law first, so it stands above this module.
        from nfriction.fitting.adaptive import fit_adaptive

        return fit_adaptive(
            model, plant, given, windows=windows, fit_plant=fit_plant, drag=drag, start=start,
            motions=moved, max_steps=max_steps, callback=callback,
        )  # fmt: skip
    if isinstance(model.schedule, NeuroFuzzy):
        if method == "torque":
            raise ValueError("a neuro-fuzzy model is fitted to trajectories, not to torques.")
        if start is None or not is_constant_fit(start, model):
            constant = FrictionModel(model.law, Constant(model.law, model.joints), model.v_smooth)
            start = fit(
                constant, plant, given, windows=windows, fit_plant=fit_plant, drag=drag,
                eccentricity=eccentricity, zeroed=zeroed, start=start, motions=moved,
                max_steps=max_steps, callback=callback,
            )  # fmt: skip
        start_at(model, start, joint, moved)
    else:
        torque = fit_torque(
            model.law, start.plant if start else plant, joint, moved, model.v_smooth
        )
        schedule = constant_schedule(model)
        schedule.set_coefficients(torque.coefficients)
        schedule.set_prior_sd(prior_sd(model.law, torque))
        if method == "torque":
            return torque_outcome(model, start, plant, moved, torque)
    if not windows:
        raise ValueError("`windows` must name at least one window length [s].")
    mixing = mixing_of(plant, given[0].convention_on(plant))
    known = {name: value for name, value, _ in start.plant_terms} if start else {}
    # A chain of fits asks for the encoders once, in its first.
    eccentric = eccentricity or (eccentricity is None and has_encoder_terms(known))

    def refinement(eccentric: bool) -> Refinement:
        terms = adjustable_terms(plant, joint, fit_plant, drag, eccentric)
        # A shared offset beside them is no more than their mean.
        zero_sd = ZERO_SD if zeroed == "each" and fit_plant else 0.0
        if zero_sd:
            terms = [t for t in terms if t.buffer != "angle_offset"]
        return Refinement(plant, model, joint, mixing, terms, max_steps, callback, zero_sd)

    search = refinement(bool(eccentric))
    vector = torch.tensor([known.get(t.name, 0.0) for t in search.terms], dtype=torch.float64)
    if isinstance(model.schedule, NeuroFuzzy):
        assert start is not None
        return _refine_network(search, start, vector, windows[-1], moved)
    stage = _through_windows(search, windows, vector, moved)
    undecided = start is None and eccentricity is None and fit_plant and may_be_eccentric(plant)
    if undecided and stage.result.status != "stopped":
        tolerance = _flat(stage.result.cost)
        stage = richer_by_evidence(stage, refinement(True), tolerance) or stage
    return trajectory_outcome(stage.problem, stage.result, stage.residuals, moved)


def _through_windows(
    search: Refinement, windows: Sequence[float], vector: Tensor, motions: tuple[Motion, ...]
) -> Stage:
    """Stages of growing length, each from the states and weighed by the errors of the last."""
    reached: Stage | None = None
    zeros: Tensor | None = None
    noise, traced = FIRST_NOISE, motions
    for length in windows:
        problem = search.problem(cut_windows(search.joint, traced, length), noise)
        tolerance = LOOSE
        if length == windows[-1]:
            # Of a start far away the cost says nothing; the last stage's minimum is as high.
            near = reached and _least(reached.residuals, noise)
            tolerance = _flat(near or float(problem.cost(problem.start(vector))))
        stage = search.search(problem, vector, tolerance, f"{length:g} s windows", zeros)
        if reached is not None and stage.lost_since(reached):
            logger.warning("%g s windows are too long for this motion; left out", length)
            schedule = search.model.schedule
            schedule.set_parameter_vector(reached.problem.split(reached.result.x)[0])
            break
        reached, vector, noise = stage, stage.vector, max(stage.noise, LEAST_NOISE)
        zeros = stage.zeros
        if stage.result.status == "stopped":
            break
        traced = problem.traced(stage.result.x, traced)
    assert reached is not None
    return reached


def _refine_network(
    search: Refinement, start: Fit, vector: Tensor, length: float, motions: tuple[Motion, ...]
) -> Fit:
    """Refine a network that starts at a constant fit, and keep it where it earns its place."""
    # What the constant law left over, at the same window length, is the noise that the prior is
    # weighed against.
    noise = effective_noise(start._residuals)
    stride = stride_of(start._residuals)
    seen, held_back = judged_windows(search, motions, length)
    part = search.problem(seen, noise, vector, stride)
    # The constant law's own cost, in which the gain of a step is judged.
    tolerance = _flat(_least(start._residuals, noise))
    schedule = search.model.schedule
    assert isinstance(schedule, NeuroFuzzy)
    widest, trials = schedule.prior_sd, []
    for share in PRIOR_SHARES:
        # From nothing: on from another prior's end a search stays near it, and judges that.
        schedule.set_parameter_vector(torch.zeros_like(schedule.parameter_vector()))
        schedule.prior_sd = share * widest
        stage = search.search(part, vector, tolerance, "a third held back")
        if stage.result.status == "stopped":
            return trajectory_outcome(stage.problem, stage.result, stage.residuals, motions)
        ratio = gain_on(held_back, stage, vector)
        trials.append((ratio, schedule.prior_sd, schedule.parameter_vector(), stage))
    ratio, schedule.prior_sd, network, stage = min(trials, key=lambda trial: trial[0])
    schedule.set_parameter_vector(network)
    if ratio > HEAD_START:
        settle_on(search.model, start)
        note = (
            f"The network predicts windows held back {100 * (ratio - 1):.3g} % worse than its "
            "constant law, which is kept."
        )
        return replace(
            start, model=search.model.requires_grad_(False), status=f"{start.status} {note}",
            warnings=(*start.warnings, note),
        )  # fmt: skip
    whole = search.problem(cut_windows(search.joint, motions, length), noise, vector, stride)
    stage = search.search(whole, stage.vector, tolerance, f"{length:g} s windows")
    return trajectory_outcome(stage.problem, stage.result, stage.residuals, motions)


def _least(residuals: Tensor, noise: float) -> float:
    """Cost of residuals counted in what they turned out to be."""
    return float(0.5 * (residuals / noise).square().sum())


def _flat(cost: float) -> float:
    """Relative fall of the cost that changes the log likelihood by a tenth."""
    return 0.1 / max(cost, 1.0)

"""Fit a friction model to recordings: torques first, then trajectories."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, Literal, get_args

import torch
from torch import Tensor

from nfriction.fitting.eccentricity import may_be_eccentric, richer_by_evidence
from nfriction.fitting.misgivings import misgivings, refuse_motionless
from nfriction.fitting.neurofuzzy_start import is_constant_fit
from nfriction.fitting.outcome import Continuity, Fit, Plant, torque_outcome, trajectory_outcome
from nfriction.fitting.preparation import (
    adjustable_terms,
    constant_schedule,
    in_joint_coordinates,
    is_eccentric,
    listed,
    mixing_of,
    motions_of,
    zeroed_each,
    zeros_serve,
)
from nfriction.fitting.stages import JUMP_SD, Callback, Refinement, Stage, flat, least
from nfriction.fitting.torque import fit_torque, prior_sd
from nfriction.fitting.windows import check_lengths, cut_windows
from nfriction.friction import Adaptive, Constant, FrictionModel
from nfriction.friction.neurofuzzy import NeuroFuzzy
from nfriction.recording import Recording
from nfriction.signals import Motion

Method = Literal["trajectory", "torque"]
# How encoders were zeroed: once for all recordings, anew at the start of each, or as it looks.
Zeroed = Literal["auto", "once", "each"]
ZEROED_EACH = (
    "Every recording begins at rest with all encoders at zero, so they were taken for set to zero "
    'there, wherever the links stood; `zeroed="once"` where they were not.'
)
TOO_LONG = (
    "Windows of {:g} s are too long for this motion, which forgets its start within them, or for a "
    "law or plant that is wrong; left out."
)
# Dry friction of a tenth of a link's largest gravity moment lets it rest up to 0.1 rad off [rad].
ZERO_SD = 0.05
# First guess of what a model of a bench leaves unexplained, before a fit tells [rad or m].
FIRST_NOISE = 1e-3
# Short windows converge from far away, long ones tell small friction and small drag apart [s].
WINDOWS = (0.5, 2.0, 5.0)
# Relative fall of the cost that ends a search of which only the neighbourhood matters.
LOOSE = 1e-4
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
    zeroed: Zeroed = "auto",
    continuity: Continuity = "free",
    start: Fit | None = None,
    motions: Sequence[Motion] | None = None,
    max_steps: int = 30,
    callback: Callback | None = None,
) -> Fit:
    """Estimate a friction model from recordings.

    The friction torque that the smoothed motion implies gives constant coefficients; simulated
    windows of growing length then refine them, and what the data tell of the plant. Where the law
    is not linear in one, the first windows are searched again from the torques on that plant. A
    neuro-fuzzy model starts at the constant fit of its own law and is pulled toward it, by its
    own prior or a tighter one, whichever predicts windows held back better, and more so at motions
    that the recordings never came near; unless that is a fifth better than the law, the law is
    kept. Every class of an adaptive model starts there, too;
    `fit_adaptive` has its further settings.

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
            wherever dry friction held the links then, at rest: unless its first sample moves, a
            recording's first window starts there. How far a zero was off is found for each
            recording and left out of the plant, whose offset stays as given, as that of a further
            recording cannot be known. Whoever scores a recording that was trained on scores it as
            it is, zeros and all. `"auto"`: `"each"` where several recordings of a driven chain
            all begin at rest with every encoder at zero, which the fit then says.
        continuity: of the state from a window to the next. `"free"`: every window has a start of
            its own, as suits a law that is not wholly right, or motion that forgets its start.
            `"soft"`, `"hard"`: the windows of a recording make one motion, but for jumps of about
            0.3 mrad and 0.01 rad/s (mm, m/s), or for nothing; what then counts is the error of
            whole recordings. A neuro-fuzzy model takes `"hard"` for its constant law only, and is
            itself soft; an adaptive one is always free. Intervals take jumps for exact.
        start: an earlier fit to start from: of the same law for a neuro-fuzzy model, of any model
            for the plant's terms.
        motions: smoothed motions in joint coordinates, to save smoothing again.
        max_steps: limit of steps to each window length.
        callback: called with a stage name after every step; True stops.

    Returns:
        The fit; read `converged` and `status`.

    Raises:
        TypeError: if model, plant or recordings are something else.
        ValueError: if recordings and plant do not match, or there is no such method, zero or
            continuity.
    """
    if method not in get_args(Method):
        raise ValueError(f"`method` must be one of {get_args(Method)}, got {method!r}.")
    if zeroed not in get_args(Zeroed):
        raise ValueError(f"`zeroed` must be one of {get_args(Zeroed)}, got {zeroed!r}.")
    if zeroed == "each" and method == "torque":
        raise ValueError('`zeroed="each"` is found from trajectories, not from torques.')
    if continuity not in JUMP_SD:
        raise ValueError(f"`continuity` must be one of {tuple(JUMP_SD)}, got {continuity!r}.")
    if continuity != "free" and method == "torque":
        raise ValueError(f"`continuity={continuity!r}` is of trajectories, not of torques.")
    check_lengths(windows)
    given = listed(model, plant, recordings)
    joint = in_joint_coordinates(plant, model, given)
    if eccentricity and not may_be_eccentric(plant):
        raise ValueError(f"{plant.name or 'the axis'} has no encoders that turn with its joints.")
    told: tuple[str, ...] = ()
    if zeroed == "auto":
        each = method == "trajectory" and zeroed_each(plant, given)
        zeroed, told = ("each", (ZEROED_EACH,)) if each else ("once", ())
    moved = motions_of(joint, motions)
    told += misgivings(plant, given, joint, moved)
    if isinstance(model.schedule, (Adaptive, NeuroFuzzy)):
        if method == "torque":
            raise ValueError(
                "adaptive and neuro-fuzzy models are fitted to trajectories, not to torques."
            )
        refuse_motionless(plant, joint)
        same: dict[str, Any] = {
            "windows": windows, "fit_plant": fit_plant, "drag": drag, "max_steps": max_steps,
            "callback": callback,
        }  # fmt: skip
        if isinstance(model.schedule, NeuroFuzzy):
            same |= {"eccentricity": eccentricity, "continuity": continuity}
        return _saying(told, _fit_further(model, plant, given, moved, start, zeroed, same))
    torque = fit_torque(model.law, start.plant if start else plant, joint, moved, model.v_smooth)
    schedule = constant_schedule(model)
    schedule.set_coefficients(torque.coefficients)
    schedule.set_prior_sd(prior_sd(model.law, torque))
    if method == "torque":
        return _saying(told, torque_outcome(model, start, plant, moved, torque))
    mixing = mixing_of(plant, given[0].convention_on(plant))
    known = {name: value for name, value, _ in start.plant_terms} if start else {}
    zero_sd = torch.full((len(joint), plant.joints), ZERO_SD, dtype=torch.float64)

    def refinement(eccentric: bool) -> Refinement:
        once = zeroed == "once"
        terms = adjustable_terms(plant, joint, fit_plant, drag, eccentric, zeroed_once=once)
        return Refinement(
            plant, model, joint, mixing, terms, max_steps, callback, None if once else zero_sd,
            JUMP_SD[continuity],
        )  # fmt: skip

    search = refinement(is_eccentric(eccentricity, known))
    vector = torch.tensor([known.get(t.name, 0.0) for t in search.terms], dtype=torch.float64)

    def by_torque(found: Plant) -> Tensor:
        return fit_torque(model.law, found, joint, moved, model.v_smooth).coefficients

    linear = all(c.linear or not c.fitted for c in model.law.coefficients)
    stage, left_out = _through_windows(
        search, windows, vector, moved, None if linear else by_torque
    )
    undecided = start is None and eccentricity is None and fit_plant and may_be_eccentric(plant)
    if undecided and stage.result.status != "stopped":
        tolerance = flat(stage.result.cost)
        stage = richer_by_evidence(stage, refinement(True), tolerance) or stage
    found = trajectory_outcome(stage.problem, stage.result, stage.residuals, moved)
    return _saying((*told, *left_out), replace(found, continuity=continuity))


def _saying(told: tuple[str, ...], found: Fit) -> Fit:
    """A fit that says this first, and once."""
    return replace(found, warnings=(*told, *(w for w in found.warnings if w not in told)))


def _fit_further(
    model: FrictionModel,
    plant: Plant,
    recordings: Sequence[Recording],
    motions: tuple[Motion, ...],
    start: Fit | None,
    zeroed: Zeroed,
    settings: dict[str, Any],
) -> Fit:
    """The fit of coefficients that follow the motion, from that of the constant law."""
    alike = settings.get("continuity", "free")
    each = zeroed == "each"
    if not is_constant_fit(start, model, alike) or not zeros_serve(start, motions, each):
        constant = FrictionModel(model.law, Constant(model.law, model.joints), model.v_smooth)
        start = fit(
            constant, plant, recordings, zeroed=zeroed, start=start, motions=motions, **settings
        )
    # They fit or take a constant law first, so they stand above this module.
    from nfriction.fitting.adaptive import fit_adaptive
    from nfriction.fitting.network import fit_network

    further = fit_adaptive if isinstance(model.schedule, Adaptive) else fit_network
    return further(model, plant, recordings, start=start, motions=motions, **settings)


def _through_windows(
    search: Refinement,
    windows: Sequence[float],
    vector: Tensor,
    motions: tuple[Motion, ...],
    by_torque: Callable[[Plant], Tensor] | None,
) -> tuple[Stage, tuple[str, ...]]:
    """Stages of growing length, each from the states and weighed by the errors of the last.

    Lengths that the motion does not allow are left out, which is said in a sentence.

    With coefficients `by_torque` on a plant, the first stage is searched a second time from what
    they are on the plant that it found: a law that is not linear has several minima, and on an
    inertia that is a little wrong the torques lead to a worse one.
    """
    reached: Stage | None = None
    zeros: Tensor | None = None
    noise, traced = FIRST_NOISE, motions
    for length in windows:
        # Encoders that were zeroed where dry friction held the links were zeroed at rest.
        cut = cut_windows(search.joint, traced, length, from_rest=search.zero_sd is not None)
        problem = search.problem(cut, noise, far=reached is None and len(windows) > 1)
        tolerance = LOOSE
        if length == windows[-1]:
            # Of a start far away the cost says nothing; the last stage's minimum is as high.
            near = reached and least(reached.residuals, noise)
            tolerance = flat(near or float(problem.cost(problem.unknowns.start(vector))))
        name = f"{length:g} s windows"
        stage = search.search(problem, vector, tolerance, name, zeros)
        if reached is None and by_torque is not None and stage.result.status != "stopped":
            stage = _better_start(search, stage, tolerance, name, by_torque)
        if reached is not None and stage.lost_since(reached):
            schedule = search.model.schedule
            schedule.set_parameter_vector(reached.problem.unknowns.split(reached.result.x)[0])
            return reached, (TOO_LONG.format(length),)
        reached, vector, noise = stage, stage.vector, max(stage.noise, LEAST_NOISE)
        zeros = stage.zeros
        if stage.result.status == "stopped":
            break
        traced = problem.traced(stage.result.x, traced)
    assert reached is not None
    return reached, ()


def _better_start(
    search: Refinement,
    stage: Stage,
    tolerance: float,
    name: str,
    by_torque: Callable[[Plant], Tensor],
) -> Stage:
    """A stage, or the same searched from the coefficients by torque on its plant if that is better.

    The model is left with the coefficients of the one returned.
    """
    problem, schedule = stage.problem, constant_schedule(search.model)
    found = schedule.parameter_vector()
    schedule.set_coefficients(by_torque(problem.plant_at(stage.vector)))
    other = search.search(problem, stage.vector, tolerance, name, stage.zeros)
    if other.result.status == "stopped" or other.result.cost < stage.result.cost:
        return other
    schedule.set_parameter_vector(found)
    return stage

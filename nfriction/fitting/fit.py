"""Fit a friction model to recordings: the constant law first, then what follows the motion."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Literal, get_args

from nfriction.fitting.data.checks import as_it_looks, misgivings, refuse_motionless
from nfriction.fitting.data.inputs import in_joint_coordinates, listed, motions_of
from nfriction.fitting.data.windows import checked_lengths
from nfriction.fitting.result.fit_result import Continuity, FitResult
from nfriction.fitting.strategy.constant import WINDOWS, Settings, fit_by_torque, fit_constant
from nfriction.fitting.strategy.constant_start import constant_start
from nfriction.fitting.strategy.continuation import JUMP_SD, Callback
from nfriction.fitting.strategy.encoder_eccentricity import may_be_eccentric
from nfriction.fitting.strategy.neurofuzzy import fit_network
from nfriction.friction.models import FrictionModel
from nfriction.friction.neurofuzzy import NeuroFuzzy
from nfriction.papers.afem.adaptive import Adaptive
from nfriction.papers.afem.fit_adaptive import fit_adaptive
from nfriction.plant import Plant
from nfriction.recording import Recording
from nfriction.signals import Motion

Method = Literal["trajectory", "torque"]
# How encoders were zeroed: once for all recordings, anew at the start of each, or as it looks.
Zeroed = Literal["auto", "once", "each"]


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
    start: FitResult | None = None,
    motions: Sequence[Motion] | None = None,
    max_steps: int = 30,
    callback: Callback | None = None,
) -> FitResult:
    """Estimate a friction model from recordings.

    The friction torque that the smoothed motion implies gives constant coefficients; simulated
    windows of growing length then refine them, and what the data tell of the plant. A law that is
    not linear and contains a simpler one (Stribeck, NLFM: Coulomb and viscous friction) is searched
    again from where that ended; what leaves least over counts. A neuro-fuzzy model starts at the
    constant fit of its own law and is pulled toward it, by its own prior or a tighter one,
    whichever predicts windows held back better, and more so at motions that the recordings never
    came near; unless that is a fifth better than the law, the law is kept. Its plant stays near the
    law's, unless windows held back gain another fifth without. Every class of an adaptive model
    starts there, too; `fit_adaptive` has its further settings.

    Args:
        model: the model to fit; changed in place.
        plant: the mechanism as given.
        recordings: one or several, all in one convention; where they say none, in the plant's.
        method: `"torque"` stops after the torque fit (constant coefficients only).
        windows: lengths of the windows [s], in the order in which they are used.
        fit_plant: adjust ratios of inertia and gravity terms, lengths and offsets, within bounds.
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
        ValueError: if recordings and plant do not match, one is given twice or holds too little,
            or there is no such method, zero or continuity.
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
    windows = checked_lengths(windows)
    given = listed(model, plant, recordings)
    joint = in_joint_coordinates(plant, model, given)
    if eccentricity and not may_be_eccentric(plant):
        raise ValueError(f"{plant.name or 'the axis'} has no encoders that turn with its joints.")
    each = zeroed == "each"
    told: tuple[str, ...] = ()
    if zeroed == "auto" and method == "trajectory":
        each, told = as_it_looks(plant, given)
    moved = motions_of(joint, motions)
    told += misgivings(plant, given, joint, moved)
    settings = Settings(windows, fit_plant, drag, eccentricity, continuity, max_steps, callback)
    if isinstance(model.schedule, (Adaptive, NeuroFuzzy)):
        if method == "torque":
            raise ValueError(
                "adaptive and neuro-fuzzy models are fitted to trajectories, not to torques."
            )
        if isinstance(model.schedule, NeuroFuzzy):
            refuse_motionless(plant, joint)
        found = _fit_further(model, plant, given, moved, start, settings, each)
    elif method == "torque":
        found = fit_by_torque(model, plant, given, moved, start)
    else:
        found = fit_constant(model, plant, given, moved, start, settings, each=each)
    return found.with_warnings(told)


def _fit_further(
    model: FrictionModel,
    plant: Plant,
    recordings: Sequence[Recording],
    motions: tuple[Motion, ...],
    start: FitResult | None,
    settings: Settings,
    each: bool,
) -> FitResult:
    """The fit of coefficients that follow the motion, from that of the constant law."""
    if isinstance(model.schedule, NeuroFuzzy):
        constant = constant_start(model, plant, recordings, motions, start, settings, each)
        return fit_network(model, plant, recordings, motions, constant, settings)
    # By class there are no eccentric encoders, and windows are free.
    settings = replace(settings, eccentricity=False, continuity="free")
    constant = constant_start(model, plant, recordings, motions, start, settings, each)
    return fit_adaptive(
        model, plant, recordings, windows=settings.windows, fit_plant=settings.fit_plant,
        drag=settings.drag, start=constant, motions=motions, max_steps=settings.max_steps,
        callback=settings.callback,
    )  # fmt: skip

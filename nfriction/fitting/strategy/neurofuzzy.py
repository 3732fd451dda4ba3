"""Fit a neuro-fuzzy model: a network that corrects a constant law, where windows bear it out."""

import copy
import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from nfriction.fitting.data.inputs import (
    adjustable_terms,
    at_zeros,
    in_joint_coordinates,
    is_eccentric,
    mixing_of,
)
from nfriction.fitting.data.windows import cut_windows
from nfriction.fitting.plant_parameters import PlantParameter
from nfriction.fitting.result.fit_result import FitResult, trajectory_outcome
from nfriction.fitting.shooting.autocorrelation import effective_noise, stride_of
from nfriction.fitting.shooting.problem import TrajectoryProblem
from nfriction.fitting.strategy.constant import Settings
from nfriction.fitting.strategy.continuation import JUMP_SD, Refinement, Stage, flat, least
from nfriction.fitting.strategy.extrapolation_prior import anchors_where_unseen
from nfriction.fitting.strategy.holdout import WORTH, Judgement, error_on, judged_windows
from nfriction.fitting.strategy.neurofuzzy_start import settle_on, start_at
from nfriction.friction.models import FrictionModel
from nfriction.friction.neurofuzzy import NeuroFuzzy
from nfriction.plant import Plant
from nfriction.recording import Recording
from nfriction.signals import Motion

# Priors of a network that are tried, over its own: windows held back choose among them.
PRIOR_SHARES = (1.0, 1 / 3)
INTERRUPTED = "Stopped before the network was found; its constant law is kept."


def fit_network(
    model: FrictionModel,
    plant: Plant,
    recordings: Sequence[Recording],
    motions: tuple[Motion, ...],
    start: FitResult,
    settings: Settings,
) -> FitResult:
    """The fit of a neuro-fuzzy model from that of its constant law.

    Args:
        model, plant: see `fit`.
        recordings, motions: as they are; the zeros that the constant fit found are added here.
        start: the constant fit.
        settings: see `fit`; of the windows the last serves that the constant fit could follow.
    """
    given, moved = at_zeros(start.zeros, plant, recordings, motions)
    joint = in_joint_coordinates(plant, model, given)
    start_at(model, start, joint, moved)
    known = {name: value for name, value, _ in start.plant_terms}
    terms = adjustable_terms(
        plant, joint, settings.fit_plant, settings.drag,
        is_eccentric(settings.eccentricity, known), zeroed_once=not start.zeros,
    )  # fmt: skip
    mixing = mixing_of(plant, recordings[0].resolve_convention(plant))
    assert isinstance(model.schedule, NeuroFuzzy)
    # From smoothed states at full length a search creeps along hard seams.
    jump_sd = None if settings.continuity == "free" else JUMP_SD["soft"]
    free = Refinement(
        plant, model, joint, mixing, terms, settings.max_steps, settings.callback,
        jump_sd=jump_sd, anchors=anchors_where_unseen(model.schedule, moved),
    )  # fmt: skip
    near = replace(free, terms=_as_open_as(start, terms))
    vector = torch.tensor([known.get(t.name, 0.0) for t in terms], dtype=torch.float64)
    differ = [t.prior_sd for t in near.terms] != [t.prior_sd for t in terms]
    searches = (near, free) if differ else (near,)
    try:
        found = _refined(searches, start, vector, start.longest(settings.windows), moved)
    except KeyboardInterrupt:
        found = _constant_kept(near, start, INTERRUPTED, converged=False)
    found = replace(
        found, motions=motions, zeros=start.zeros, continuity=settings.continuity,
        left_out=start.left_out,
    )  # fmt: skip
    return found.with_warnings(start.told)


def _as_open_as(start: FitResult, terms: Sequence[PlantParameter]) -> list[PlantParameter]:
    """Terms that are expected as near to where a fit found them as it left them open.

    Within the motion recorded a plant and a network may make up for each other; beyond it, where
    the network fades, such a plant is wrong.
    """
    left = {i.name: i.sd for i in start.intervals}
    return [replace(t, prior_sd=min(t.prior_sd, left.get(t.name, math.inf))) for t in terms]


def _refined(
    searches: Sequence[Refinement],
    start: FitResult,
    vector: Tensor,
    length: float,
    motions: tuple[Motion, ...],
) -> FitResult:
    """Refine a network that starts at a constant fit, and keep it where it earns its place.

    Of searches that leave the plant ever freer, a freer one must earn its place, too.
    """
    free = searches[-1]
    # What the constant law left over, at the same window length, is the noise that the prior is
    # weighed against; its own cost is the one in which the gain of a step is judged.
    noise, stride = effective_noise(start._residuals), stride_of(start._residuals)
    tolerance = flat(least(start._residuals, noise))
    seen, held_back = judged_windows(free, motions, length)
    law = replace(free, model=copy.deepcopy(start.model), anchors=None)
    same = law.search(
        law.problem(seen, noise, vector, stride), vector, tolerance, "constants, a third held back"
    )
    if same.result.status == "stopped":
        raise KeyboardInterrupt
    law_of_all = replace(law, model=start.model).problem(held_back, noise, vector, stride)
    laws = [
        error_on(held_back, problem, found)
        for problem, found in ((same.problem, same.vector), (law_of_all, vector))
    ]

    def judge(network: Stage) -> Judgement:
        error = error_on(held_back, network.problem, network.vector)
        return Judgement(*(error / law if math.isfinite(error) else math.inf for law in laws))

    best: _Trial | None = None
    for search in searches:
        part = search.problem(seen, noise, vector, stride)
        trial = _best_prior(search, part, vector, tolerance, judge)
        if best is None or trial.judgement.score < WORTH * best.judgement.score:
            best = trial
    assert best is not None
    if best.judgement.score > 1:
        return _constant_kept(best.search, start, str(best.judgement))
    search, found = best.search, best.taken_up()
    whole = search.problem(cut_windows(search.joint, motions, length), noise, vector, stride)
    stage = search.search(whole, found, tolerance, f"{length:g} s windows")
    return trajectory_outcome(stage.problem, stage.result, stage.residuals, motions)


class _Trial(NamedTuple):
    """A network trained on some windows and judged on others, and how it was trained."""

    judgement: Judgement
    search: Refinement
    prior_sd: float
    network: Tensor
    vector: Tensor

    def taken_up(self) -> Tensor:
        """Terms of the plant; the model is left with the network and its prior."""
        schedule = self.search.model.schedule
        assert isinstance(schedule, NeuroFuzzy)
        schedule.prior_sd = self.prior_sd
        schedule.set_parameter_vector(self.network)
        return self.vector


def _best_prior(
    search: Refinement,
    part: TrajectoryProblem,
    vector: Tensor,
    tolerance: float,
    judge: Callable[[Stage], Judgement],
) -> _Trial:
    """Train under each prior, of which the schedule keeps its own: the best trial.

    Raises:
        KeyboardInterrupt: if stopped: half trained and unjudged, a network is worth nothing.
    """
    schedule = search.model.schedule
    assert isinstance(schedule, NeuroFuzzy)
    widest, trials = schedule.prior_sd, []
    try:
        for share in PRIOR_SHARES:
            # From nothing: on from another prior's end a search stays near it, and judges that.
            schedule.set_parameter_vector(torch.zeros_like(schedule.parameter_vector()))
            schedule.prior_sd = share * widest
            stage = search.search(part, vector, tolerance, "a third held back")
            if stage.result.status == "stopped":
                raise KeyboardInterrupt
            network = schedule.parameter_vector()
            trials.append(_Trial(judge(stage), search, schedule.prior_sd, network, stage.vector))
    finally:
        schedule.prior_sd = widest
    return min(trials, key=lambda trial: trial.judgement.score)


def _constant_kept(
    search: Refinement, start: FitResult, note: str, *, converged: bool = True
) -> FitResult:
    """The constant fit as the neuro-fuzzy model's."""
    settle_on(search.model, start)
    return replace(
        start,
        model=search.model.requires_grad_(False),
        status=f"{start.status} {note}" if converged else f"not converged: {note}",
        converged=start.converged and converged,
        warnings=(*start.warnings, note),
    )

"""Fit of the papers' network to trajectories, kept if it passes hold-out."""

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from nfriction.fitting.data.inputs import apply_encoder_offsets, require_motion
from nfriction.fitting.equation_error import coefficient_scale
from nfriction.fitting.result.fit_result import FitResult
from nfriction.fitting.result.of_search import result_from_shooting
from nfriction.fitting.result.paired_test import improves
from nfriction.fitting.shooting.sensitivity import StepJacobian
from nfriction.fitting.strategy.constant import constant_start
from nfriction.fitting.strategy.continuation import ShootingFitter
from nfriction.fitting.strategy.holdout import StoppedError, verdict
from nfriction.fitting.strategy.inputs import seeing_plant
from nfriction.fitting.strategy.neurofuzzy import INTERRUPTED, Validation, constant_kept
from nfriction.fitting.task import FitTask, constant_prior, regression
from nfriction.friction.neurofuzzy import LEAST_RATIO, PRIOR_SD
from nfriction.fuzzy import RBFNetwork
from nfriction.papers.nffem.rbf_coefficients import RBFCoefficients
from nfriction.signals import Motion

# Upper limit on coefficients of a radial basis network, in units of their scales.
LARGEST = 4.0
# Its units are placed using one of this many samples.
THINNED = 10


def fit_rbf(task: FitTask) -> FitResult:
    """Fit the output layer of the papers' network from the constant fit of its law.

    The units are placed along the smoothed motion; the output layer starts at the constant law and
    is pulled toward it. Like any network, it is kept if its error on hold-out windows is smaller;
    the plant stays as the constant fit found it.
    """
    require_motion(task.plant, task.recordings)
    model, options = task.model.requires_grad_(False), task.options
    task = replace(task, plant=seeing_plant(task.plant, getattr(model, "inputs", None) or ()))
    schedule = model.schedule
    assert isinstance(schedule, RBFCoefficients)
    start = constant_start(task)
    recordings, motions = apply_encoder_offsets(
        start.encoder_offsets, task.plant, task.recordings, task.motions
    )
    values = start.model.schedule.coefficient_sets()["always"]
    scale = torch.maximum(values.abs(), coefficient_scale(model, start.plant, recordings, motions))
    scale = torch.where(scale > 0, scale, torch.ones_like(scale))
    schedule.set_sample_time(recordings[0].sample_time)
    place_units(schedule, values, scale, motions)
    base = schedule.parameter_vector()
    sd = (PRIOR_SD * scale)[..., None].expand(-1, -1, schedule.head_units + 1).reshape(-1)
    fitter = ShootingFitter(
        StepJacobian(start.plant, model, []), model, recordings, task.measurement, options,
        task.callback, friction_prior=(base, sd), plant_prior=(base[:0], base[:0]),
    )  # fmt: skip
    prior = constant_prior(start.model, regression(task, start.model, task.plant), options)
    law = replace(fitter, friction=start.model, friction_prior=prior)
    length = start.longest_usable_horizon(options.windows)
    end = None
    try:
        validation = Validation(law, start, motions, length)
        trial = validation.judged(validation.trial(fitter, base, "network, hold-out"))
        note = verdict(trial.squares, validation.of_law)
        if improves(trial.squares, validation.of_law):
            end = validation.fit_all(trial)
            note = validation.lost_over_long_windows(end)
    except StoppedError:
        note = INTERRUPTED
    if end is None or note:
        return constant_kept(start, model, note, converged=note != INTERRUPTED)
    found = result_from_shooting(model, end.problem, end.result, task.motions)
    found = replace(
        found, plant_terms=start.plant_terms, encoder_offsets=start.encoder_offsets,
        skipped_horizons=start.skipped_horizons,
    )  # fmt: skip
    return found.with_warnings(start.data_warnings, unmodelled=start.unmodelled)


@torch.no_grad()
def place_units(
    schedule: RBFCoefficients, values: Tensor, scale: Tensor, motions: Sequence[Motion]
) -> None:
    """Set a network to constant coefficients, with its units placed by k-means along motions.

    `scale` is the size of each coefficient (joint, coefficient), which determines its universe.
    """
    qd, qdd, state = [], [], []
    for motion in motions:
        qd.append(torch.as_tensor(motion.qd))
        qdd.append(torch.as_tensor(motion.qdd))
        state.append(schedule.states(qd[-1], qdd[-1]))
    moved = torch.cat(qd), torch.cat(qdd), torch.cat(state)
    # No universe yet, since it would clamp the motion.
    schedule.input_lower.fill_(-torch.inf)
    schedule.input_upper.copy_(moved[0].abs().amax(0)[:, None].expand_as(schedule.input_upper))
    schedule.input_upper[:, 1:] = torch.inf
    x = schedule.inputs(*moved)
    joints, inputs = schedule.input_lower.shape
    network = RBFNetwork(joints, inputs, schedule.head_units, values.shape[1])
    network.init_kmeans(x[::THINNED])
    network.output_weight.zero_()
    # Starting at its bound, a coefficient could not rise.
    start = torch.where(schedule.positive, torch.maximum(values, LEAST_RATIO * scale), values)
    network.output_bias.copy_(start)
    lower = torch.where(schedule.positive, torch.zeros_like(scale), -LARGEST * scale)
    ends = torch.stack([x.amin(0), x.amax(0)])
    ends[0, :, 0] = 0.0
    schedule.set_network(network, ends, torch.stack([lower, LARGEST * scale]))

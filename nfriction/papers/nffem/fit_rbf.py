"""Fit of the papers' network on trajectories, kept as far as it helps on hold-out windows."""

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from nfriction.fitting.data.inputs import (
    apply_encoder_offsets,
    integration_substeps,
    require_motion,
)
from nfriction.fitting.equation_error import coefficient_scale
from nfriction.fitting.fit import FitTask
from nfriction.fitting.result.fit_result import FitResult
from nfriction.fitting.result.of_search import result_from_shooting
from nfriction.fitting.shooting.autocorrelation import decimation, effective_noise
from nfriction.fitting.shooting.problem import ShootingProblem
from nfriction.fitting.shooting.sensitivity import StepJacobian
from nfriction.fitting.strategy.constant import constant_start
from nfriction.fitting.strategy.continuation import ShootingFitter
from nfriction.fitting.strategy.holdout import cut_for_folds
from nfriction.friction.neurofuzzy import LEAST_RATIO, PRIOR_SD
from nfriction.fuzzy import RBFNetwork
from nfriction.papers.nffem.rbf_coefficients import RBFCoefficients
from nfriction.papers.nffem.refine_adaptive import FOLDS, kept_correction, taken
from nfriction.signals import Motion

# Coefficients may grow to so many of their scales.
LARGEST = 4.0
# Units are placed by one sample of this many.
THINNED = 10


def fit_rbf(task: FitTask) -> FitResult:
    """Fit the output layer of the papers' network from the constant fit of its law.

    The units are placed along the smoothed motion; the output layer starts at the constant law and
    is pulled toward it. Windows held out decide how much of the correction every joint takes, as
    in `refine_adaptive`.
    """
    require_motion(task.plant, task.recordings)
    schedule = task.model.schedule
    assert isinstance(schedule, RBFCoefficients)
    start = constant_start(task)
    recordings, motions = apply_encoder_offsets(
        start.encoder_offsets, task.plant, task.recordings, task.motions
    )
    model, plant = task.model.requires_grad_(False), start.plant
    values = start.model.schedule.coefficient_sets()["always"]
    natural = coefficient_scale(model, plant, recordings, motions)
    scale = torch.maximum(values.abs(), natural)
    scale = torch.where(scale > 0, scale, torch.ones_like(scale))
    schedule.set_sample_time(recordings[0].sample_time)
    place_units(schedule, values, scale, motions)
    base = schedule.parameter_vector()
    known = [schedule.states(torch.as_tensor(m.qd), torch.as_tensor(m.qdd)) for m in motions]
    length = start.longest_usable_horizon(task.options.windows)
    cut = cut_for_folds(recordings, motions, length, FOLDS)
    memory = torch.stack([known[place][first] for place, first, _ in cut.spans])
    substeps = integration_substeps(plant, model, max(r.longest_step for r in recordings))
    sd = (PRIOR_SD * scale)[..., None].expand(-1, -1, schedule.head_units + 1).reshape(-1)
    whole = ShootingProblem(
        StepJacobian(plant, model, []), model, cut, effective_noise(start.residuals),
        task.measurement, substeps, stride=decimation(start.residuals), friction_prior=(base, sd),
        memory=memory if schedule.state_size else None,
    )  # fmt: skip
    fitter = ShootingFitter(
        whole.jacobian, model, recordings, task.measurement, replace(task.options, patience=0),
        task.callback,
    )  # fmt: skip
    # The filters advance with every step of the integration while the search lasts.
    schedule.set_sample_time(recordings[0].sample_time / substeps)
    result, shares = kept_correction(
        schedule, whole, fitter, base, f"{length:g} s windows, network"
    )
    if result is not None:
        found = result_from_shooting(model, whole, result, motions)
        found = replace(
            found, plant_terms=start.plant_terms, encoder_offsets=start.encoder_offsets,
            skipped_horizons=start.skipped_horizons, motions=task.motions,
            status=f"{found.status} {taken(shares, plant.joint_names)}",
        )  # fmt: skip
    else:
        schedule.set_parameter_vector(base)
        note = "The network is no better: its constant law is kept."
        found = replace(start, model=model, status=f"{start.status} {note}")
    schedule.set_sample_time(recordings[0].sample_time)
    return found.with_warnings(start.data_warnings)


@torch.no_grad()
def place_units(
    schedule: RBFCoefficients, values: Tensor, scale: Tensor, motions: Sequence[Motion]
) -> None:
    """Set a network to constant coefficients, its units by k-means along motions.

    Args:
        schedule: changed in place.
        values: coefficients, (joint, coefficient).
        scale: size of each, (joint, coefficient), by which its universe is chosen.
        motions: in joint coordinates.
    """
    qd, qdd, state = [], [], []
    for motion in motions:
        qd.append(torch.as_tensor(motion.qd))
        qdd.append(torch.as_tensor(motion.qdd))
        state.append(schedule.states(qd[-1], qdd[-1]))
    moved = torch.cat(qd), torch.cat(qdd), torch.cat(state)
    # Without a universe yet, which would clamp the motion.
    schedule.input_lower.fill_(-torch.inf)
    schedule.input_upper.copy_(moved[0].abs().amax(0)[:, None].expand_as(schedule.input_upper))
    schedule.input_upper[:, 1:] = torch.inf
    x = schedule.inputs(*moved)
    joints, inputs = schedule.input_lower.shape
    network = RBFNetwork(joints, inputs, schedule.head_units, values.shape[1])
    network.init_kmeans(x[::THINNED])
    network.output_weight.zero_()
    # From its bound a coefficient could not rise.
    start = torch.where(schedule.positive, torch.maximum(values, LEAST_RATIO * scale), values)
    network.output_bias.copy_(start)
    lower = torch.where(schedule.positive, torch.zeros_like(scale), -LARGEST * scale)
    ends = torch.stack([x.amin(0), x.amax(0)])
    ends[0, :, 0] = 0.0
    schedule.set_network(network, ends, torch.stack([lower, LARGEST * scale]))

"""Derivatives of windows' positions, carried through time from step to step."""

from collections.abc import Iterator

import numpy as np
import torch
from torch import Tensor

from nfriction.fitting.shooting.sensitivity import StepJacobian, StepMaps, start_slope, step_maps
from nfriction.simulation.rollout import Rollout

# Samples, over all windows, whose sensitivities are accumulated together: enough for fast matrix
# products, few enough for the processor's cache.
PIECE = 2000


def propagated(
    jacobian: StepJacobian,
    friction_count: int,
    motion: Rollout,
    tau: Tensor,
    step: Tensor,
    vector: Tensor,
    substeps: int,
    stride: int,
    states: Tensor | None,
) -> Iterator[tuple[slice, Tensor]]:
    """Derivatives of the positions at the samples that count, some samples at a time.

    Args:
        jacobian: derivatives of one step.
        friction_count: number of the friction model's parameters.
        motion: of the windows, (window, step + 1, joint).
        tau, step: torque held over each step and its length, (window, step, ·).
        vector: parameters of the plant.
        substeps: steps to a sample.
        stride: samples to one that counts.
        states: see `step_maps`.

    Yields:
        Samples, and (window, sample, joint, column); columns are the friction model's parameters,
        the plant's, then the window's first state. The last piece is the windows' last sample,
        counted or not, and has rows of its velocities behind those of the positions.
    """
    windows, joints = motion.q.shape[0], motion.q.shape[-1]
    shared = friction_count + len(vector)
    carried = torch.zeros(windows, 3 * joints, shared + 2 * joints, dtype=torch.float64)
    carried[:, : 2 * joints, shared:] = torch.eye(2 * joints, dtype=torch.float64)
    by_state, by_plant = start_slope(
        jacobian, motion.q[:, 0], motion.qd[:, 0], tau[:, 0], vector
    ).tensor_split([2 * joints], -1)
    carried[:, 2 * joints :, friction_count:shared] = by_plant
    carried[:, 2 * joints :, shared:] = by_state
    block = stride * substeps
    run = max(1, PIECE // (windows * block))
    sample = 0
    for maps in step_maps(jacobian, motion, tau, step, vector, run, block, states):
        rows, carried = _carried(maps, carried, joints)
        end = sample + stride * rows.shape[1]
        yield slice(sample, end, stride), rows
        sample = end
    last = slice(step.shape[1] // substeps, None)
    yield last, carried[:, None, : 2 * joints]


def _carried(maps: StepMaps, start: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """Carry the derivatives of a state through a run of maps.

    Args:
        maps: of the run, one after another.
        start: derivatives before it, (window, row, column); what is shared comes first.
        count: leading rows that are kept.

    Returns:
        The kept rows before every map, (window, map, count, column), and all rows after the last.
    """
    # Thousands of products of small matrices: NumPy's cost a fifth of torch's.
    state = maps.state.numpy()
    shared = torch.cat([maps.parameters, maps.plant], -1).numpy()
    before = start.numpy().copy()
    after = np.empty_like(before)
    rows = np.empty((len(state), len(before), count, before.shape[-1]))
    # A search rejects a step at which derivatives overflow; NumPy need not speak of it.
    with np.errstate(over="ignore", invalid="ignore"):
        for k in range(len(state)):
            rows[k] = before[:, :count]
            np.matmul(state[k], before, out=after)
            after[..., : shared.shape[-1]] += shared[k]
            before, after = after, before
    return torch.from_numpy(rows).transpose(0, 1), torch.from_numpy(before)

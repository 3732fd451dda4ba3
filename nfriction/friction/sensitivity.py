"""Sensitivities: derivatives of a law's coefficients by a schedule's parameters and the motion."""

from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class Sensitivity:
    """Derivatives of the coefficients at given motions.

    A parameter acts on one joint's coefficients only, so the derivative by the parameters needs no
    joint axis.

    Attributes:
        parameters: by the parameter vector, (sample, coefficient, parameter).
        joint: the joint that each parameter acts on, (parameter,).
        qd: by the joint's own velocity, (sample, joint, coefficient).
        qdd: by the joint's own acceleration, (sample, joint, coefficient).
    """

    parameters: Tensor
    joint: Tensor
    qd: Tensor
    qdd: Tensor

    def contract(self, cotangent: Tensor) -> Tensor:
        """Derivatives by the parameters of quantities that depend on the coefficients.

        Args:
            cotangent: derivatives by the coefficients at many samples, (block, row, sample, joint,
                coefficient); the blocks' samples are those of this sensitivity, in order.

        Returns:
            Shape (block, row, parameter).
        """
        blocks, rows, samples, joints, k = cotangent.shape
        by_parameter = self.parameters.reshape(blocks, samples * k, -1)
        found = cotangent.new_empty(blocks, rows, len(self.joint))
        for joint in range(joints):
            own = (self.joint == joint).nonzero().squeeze(-1)
            found[..., own] = cotangent[..., joint, :].flatten(2) @ by_parameter[..., own]
        return found


@dataclass(frozen=True)
class FactoredSensitivity:
    """The same for a schedule whose outputs share features: kept as factors, never multiplied out.

    Parameters come in groups, each laid out as (joint, output, feature).

    Attributes:
        factors: of each group, the coefficients' derivatives by the outputs, (sample, joint,
            coefficient, output), and the outputs' by their parameters, (sample, joint, feature).
        qd, qdd: as in `Sensitivity`.
    """

    factors: tuple[tuple[Tensor, Tensor], ...]
    qd: Tensor
    qdd: Tensor

    @property
    def parameters(self) -> Tensor:
        """Multiplied out, as in `Sensitivity`."""
        whole = [torch.einsum("sjko,sjf->skjof", *factor).flatten(2) for factor in self.factors]
        return torch.cat(whole, -1)

    @property
    def joint(self) -> Tensor:
        """As in `Sensitivity`."""
        rows = []
        for mix, features in self.factors:
            joints = torch.arange(mix.shape[1], device=mix.device)
            rows.append(joints.repeat_interleave(mix.shape[-1] * features.shape[-1]))
        return torch.cat(rows)

    def contract(self, cotangent: Tensor) -> Tensor:
        """As in `Sensitivity`."""
        blocks, rows, samples = cotangent.shape[:3]
        by_sample = cotangent.permute(0, 2, 3, 1, 4)
        found = []
        for mix, features in self.factors:
            mixed = by_sample @ mix.unflatten(0, (blocks, samples))
            # (block, joint, row and output, sample) by (block, joint, sample, feature).
            left = mixed.permute(0, 2, 3, 4, 1).flatten(2, 3)
            both = left @ features.unflatten(0, (blocks, samples)).transpose(1, 2)
            found.append(both.unflatten(2, (rows, -1)).transpose(1, 2).flatten(2))
        return torch.cat(found, -1)

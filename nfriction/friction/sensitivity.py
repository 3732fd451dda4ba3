"""Derivatives of a law's coefficients by a schedule's parameters and by the motion."""

from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class Sensitivity:
    """Derivatives of the coefficients at given motions.

    A parameter acts on one joint's coefficients only. The parameters come in groups, each laid out
    as (joint, output, feature): an output is a sum of features with the parameters as weights, so
    the derivative is an outer product, which is kept as its two factors. A group without shared
    features has ones for its only feature.

    Attributes:
        factors: of each group, the coefficients' derivatives by the outputs, (sample, joint,
            coefficient, output), and the features, (sample, joint, feature).
        qd: by the joint's own velocity, (sample, joint, coefficient).
        qdd: by the joint's own acceleration, (sample, joint, coefficient).
    """

    factors: tuple[tuple[Tensor, Tensor], ...]
    qd: Tensor
    qdd: Tensor

    @property
    def parameters(self) -> Tensor:
        """By the parameter vector, multiplied out, (sample, coefficient, parameter)."""
        whole = [torch.einsum("sjko,sjf->skjof", *factor).flatten(2) for factor in self.factors]
        return torch.cat(whole, -1)

    @property
    def joint(self) -> Tensor:
        """The joint that each parameter acts on, (parameter,)."""
        rows = []
        for mix, features in self.factors:
            joints = torch.arange(mix.shape[1], device=mix.device)
            rows.append(joints.repeat_interleave(mix.shape[-1] * features.shape[-1]))
        return torch.cat(rows)

    def contract(self, cotangent: Tensor) -> Tensor:
        """Derivatives by the parameters of quantities that depend on the coefficients.

        Args:
            cotangent: derivatives by the coefficients at many samples, (block, row, sample, joint,
                coefficient); the blocks' samples are those of this sensitivity, in order.

        Returns:
            Shape (block, row, parameter).
        """
        blocks, rows, samples = cotangent.shape[:3]
        found = []
        for mix, features in self.factors:
            mix, features = (x.unflatten(0, (blocks, samples)) for x in (mix, features))
            if features.shape[-1] == 1:
                # Nothing is shared: one product over samples and coefficients is faster.
                by_parameter = (mix * features[..., None]).transpose(1, 2).flatten(2, 3)
                both = cotangent.permute(0, 3, 1, 2, 4).flatten(3) @ by_parameter
            else:
                # (block, joint, row and output, sample) by (block, joint, sample, feature).
                mixed = cotangent.permute(0, 2, 3, 1, 4) @ mix
                left = mixed.permute(0, 2, 3, 4, 1).flatten(2, 3)
                both = (left @ features.transpose(1, 2)).unflatten(2, (rows, -1))
            found.append(both.transpose(1, 2).flatten(2))
        return torch.cat(found, -1)

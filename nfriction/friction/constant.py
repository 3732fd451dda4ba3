"""Constant coefficients: the schedule that does not follow the motion."""

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from nfriction.friction.coefficients import Tabulated
from nfriction.friction.laws import Law
from nfriction.friction.sensitivity import Sensitivity


class Constant(Tabulated):
    """Coefficients that do not depend on the motion.

    Args:
        law: the law whose coefficients these are.
        joints: number of joints.
        initial: start values in SI, shape (joint, coefficient) or (coefficient,); default as in
            `Tabulated`.
    """

    follows_motion = False
    handles_range = True

    def __init__(self, law: Law, joints: int, initial: Tensor | Sequence | None = None) -> None:
        super().__init__(law, joints, initial)
        # Of the fit under way, and no part of the model.
        self._prior_sd: list[list[float]] = [[math.inf] * len(law.names)] * joints

    def forward(self, qd: Tensor, qdd: Tensor) -> Tensor:
        return self.table()

    def coefficient_sets(self) -> dict[str, Tensor]:
        return {"always": self.values}

    def prior(self) -> tuple[Tensor, Tensor]:
        vector = self.parameter_vector()
        return torch.zeros_like(vector), vector.new_tensor(self._prior_sd).reshape(-1)

    def set_prior_sd(self, sd: Tensor) -> None:
        """Set the standard deviation around zero that a fit expects of each coefficient.

        Args:
            sd: in SI, (joint, coefficient); infinite where nothing is known.
        """
        self._prior_sd = sd.tolist()

    def sensitivities(self, qd: Tensor, qdd: Tensor) -> Sensitivity:
        joints, k = self.raw.shape
        samples = qd.shape[0]
        identity = torch.eye(k, dtype=self.raw.dtype, device=self.raw.device).repeat(1, joints)
        zero = self.raw.new_zeros(()).expand(samples, joints, k)
        joint = torch.arange(joints, device=self.raw.device).repeat_interleave(k)
        return Sensitivity(identity.expand(samples, -1, -1), joint, zero, zero)

    def extra_repr(self) -> str:
        columns = [f"{v:.4g}" for v in self.values.mean(0)]
        mean = ", ".join(f"{n}={v}" for n, v in zip(self.coefficient_names, columns, strict=True))
        return f"joints={self.joints}, mean {mean}"

"""Constant coefficients: the schedule that does not follow the motion."""

import torch
from torch import Tensor

from nfriction.friction.coefficients import Tabulated
from nfriction.friction.sensitivity import Sensitivity


class Constant(Tabulated):
    """Coefficients that do not depend on the motion.

    Args:
        law: the law whose coefficients these are.
        joints: number of joints.
        initial: start values in SI, shape (joint, coefficient) or (coefficient,); default as in
            `Tabulated`.
    """

    fit_strategy = "nfriction.fitting.strategy.constant:fit_constant"
    follows_motion = False
    handles_range = True

    def forward(self, qd: Tensor, qdd: Tensor) -> Tensor:
        return self.table()

    def coefficient_sets(self) -> dict[str, Tensor]:
        return {"always": self.values}

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

"""Rules of fuzzy coefficients in SI, for figures and words."""

from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True, eq=False)
class FuzzyRules:
    """Gaussian sets over |velocity| and acceleration, and the coefficients of every pair of them.

    Attributes:
        lower, upper: trained range of both inputs, (joint, input).
        centres, widths: of the sets of each input, (joint, set) each.
        coefficients: where both sets of a rule hold fully, (joint, rule, coefficient); the rules of
            velocity's first set come first.
        along_motion: whether acceleration is positive where the motion speeds up.
    """

    lower: Tensor
    upper: Tensor
    centres: tuple[Tensor, ...]
    widths: tuple[Tensor, ...]
    coefficients: Tensor
    along_motion: bool

    def memberships(self, variable: int, joint: int, x: Tensor) -> Tensor:
        """Memberships (point, set) of values (point,) of an input, clamped to its range."""
        held = x.clamp(self.lower[joint, variable], self.upper[joint, variable])[:, None]
        z = (held - self.centres[variable][joint]) / self.widths[variable][joint]
        return torch.exp(-0.5 * z * z)

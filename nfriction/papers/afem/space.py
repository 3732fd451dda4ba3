"""Variables of a search, scaled to order 1, and their bounds."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor


@dataclass(frozen=True, eq=False)
class Space:
    """Between the caller's variables and those of the search, of order 1."""

    lower: Tensor
    upper: Tensor
    scale: Tensor
    logarithmic: Tensor

    @classmethod
    def build(
        cls,
        x0: Tensor,
        lower: Tensor | float | None,
        upper: Tensor | float | None,
        scale: Tensor | float | None,
        logarithmic: Sequence[bool] | bool,
    ) -> Space:
        if x0.ndim != 1 or len(x0) == 0 or not x0.is_floating_point():
            raise ValueError(
                f"`x0` must be a vector of floats, got {x0.dtype} of shape {tuple(x0.shape)}."
            )
        x0 = x0.detach()

        def vector(name: str, value: Any, dtype: torch.dtype = x0.dtype) -> Tensor:
            given = torch.as_tensor(value, dtype=dtype, device=x0.device)
            if given.shape not in ((), x0.shape):
                raise ValueError(
                    f"`{name}` must be one value or {len(x0)}, got shape {tuple(given.shape)}."
                )
            return given.expand_as(x0)

        low = vector("lower", -math.inf if lower is None else lower)
        high = vector("upper", math.inf if upper is None else upper)
        log = vector("logarithmic", logarithmic, torch.bool)
        if not (low <= high).all():
            raise ValueError("`lower` must not exceed `upper`, and neither may be NaN.")
        start = x0.clamp(low, high)
        if not torch.isfinite(start).all() or (log & (start <= 0)).any():
            raise ValueError(
                f"`x0` must be finite, and positive where logarithmic, got {x0.tolist()}."
            )
        # A lower bound of zero is no bound to a logarithm.
        inner = torch.where(log & (low <= 0), -math.inf, low)
        unit = cls(inner, high, torch.ones_like(x0), log)
        width = unit.to_unit(high) - unit.to_unit(torch.where(log & (low <= 0), torch.nan, low))
        default = torch.where(log | (start == 0), 1.0, start.abs())
        usable = torch.isfinite(width) & (width > 0)
        chosen = torch.where(usable, width, default) if scale is None else vector("scale", scale)
        if not (torch.isfinite(chosen) & (chosen > 0)).all():
            raise ValueError(f"`scale` must be positive and finite, got {chosen.tolist()}.")
        return cls(inner, high, chosen, log)

    def to_unit(self, x: Tensor) -> Tensor:
        return torch.where(self.logarithmic, x.log10(), x) / self.scale

    def from_unit(self, u: Tensor) -> Tensor:
        x = u * self.scale
        x = torch.where(self.logarithmic, 10.0**x, x).clamp(self.lower, self.upper)
        # On a bound means on it to the last bit, whatever the logarithm rounds to.
        x = torch.where(u <= self.to_unit(self.lower), self.lower, x)
        return torch.where(u >= self.to_unit(self.upper), self.upper, x)

    def project(self, u: Tensor) -> Tensor:
        """Onto the bounds, in search variables."""
        low = torch.where(self.lower == -math.inf, -math.inf, self.to_unit(self.lower))
        return u.clamp(low, self.to_unit(self.upper))

    def tensor(self, values: list[float]) -> Tensor:
        return torch.tensor(values, dtype=self.scale.dtype, device=self.scale.device)

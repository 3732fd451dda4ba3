"""Learnable fuzzy partitions of the inputs: free sets, or sets that keep their linguistic order."""

import torch
from torch import Tensor, nn

MIN_SPACING, MAX_SPACING = 0.25, 1.0
"""Spacing of neighbouring centres relative to the sum of their half-widths. At 1 the sets cross at
0.5; at 0.25 (Gaussians) at 0.96, above which two terms would mean the same."""

# Relative position of a single set in its range.
_MIDDLE = torch.tensor([0.5], dtype=torch.float64)


class FreePartition(nn.Module):
    """Sets with free centres and positive widths.

    Parameters `centres` and `log_widths` have shape (groups, sets), the sets of all inputs one
    after the other.
    """

    def __init__(self, groups: int, terms: list[int]) -> None:
        super().__init__()
        self.terms = terms
        sets = sum(terms)
        self.centres = nn.Parameter(torch.zeros(groups, sets, dtype=torch.float64))
        self.log_widths = nn.Parameter(torch.zeros(groups, sets, dtype=torch.float64))

    def forward(self) -> tuple[Tensor, Tensor]:
        """Centres and widths, each of shape (groups, sets)."""
        return self.centres, torch.exp(self.log_widths)

    @torch.no_grad()
    def assign(self, centres: Tensor, widths: Tensor, lower: Tensor, upper: Tensor) -> None:
        """Adopt sets of shape (groups, sets); the ranges are not needed."""
        self.centres.copy_(centres)
        self.log_widths.copy_(widths.log())

    @torch.no_grad()
    def jacobian(self) -> dict[str, Tensor]:
        """d (centres, widths) / d parameter over the width, (groups, 2 sets, sets), by name.

        Written by hand, because the first use of autograd in a process takes two seconds to load.
        """
        inverse = torch.exp(-self.log_widths)
        zero = torch.zeros_like(inverse).diag_embed()
        return {
            "centres": torch.cat([inverse.diag_embed(), zero], 1),
            "log_widths": torch.cat([zero, torch.ones_like(inverse).diag_embed()], 1),
        }


class OrderedPartition(nn.Module):
    """Sets that by construction are ordered, lie in their range and cross at 0.5 or more.

    The free parameters are the relative half-width h of each set (where its membership is 0.5) and
    the spacing s in (0.25, 1) of each pair of neighbours: centres lie s (h_t + h_{t+1}) apart, so
    at some point between them both memberships are at least 0.5. The first and last centres lie
    less than h inside the range, so at its ends a membership exceeds 0.5, too. All lengths are
    scaled together to fill the range. All such partitions can be reached, and all maps are smooth.

    Parameters: `log_widths`, shape (groups, sets); `spacings`, shape (groups, sets + inputs): for
    each input the margin, the spacings between its sets, the other margin, as logits.
    """

    lower: Tensor
    upper: Tensor

    def __init__(self, groups: int, terms: list[int], half_width: float) -> None:
        super().__init__()
        self.terms = terms
        self.half_width = half_width  # of a set of width 1
        # Attributes, because TorchScript cannot read globals.
        self.least, self.span = MIN_SPACING, MAX_SPACING - MIN_SPACING
        sets, inputs = sum(terms), len(terms)
        self.log_widths = nn.Parameter(torch.zeros(groups, sets, dtype=torch.float64))
        self.spacings = nn.Parameter(torch.zeros(groups, sets + inputs, dtype=torch.float64))
        self.register_buffer("lower", torch.zeros(groups, inputs, dtype=torch.float64))
        self.register_buffer("upper", torch.ones(groups, inputs, dtype=torch.float64))

    def forward(self) -> tuple[Tensor, Tensor]:
        """Centres and widths, each of shape (groups, sets)."""
        centres: list[Tensor] = []
        widths: list[Tensor] = []
        start = 0
        for i, terms in enumerate(self.terms):
            # Relative to the mean, so that only the shape of the partition matters.
            logs = self.log_widths[:, start : start + terms]
            half = torch.exp(logs - logs.mean(1, keepdim=True))
            logits = self.spacings[:, start + i : start + i + terms + 1]
            margins = torch.sigmoid(logits)
            spacing = self.least + self.span * margins[:, 1:-1]
            gaps = torch.cat(
                [
                    margins[:, :1] * half[:, :1],
                    spacing * (half[:, :-1] + half[:, 1:]),
                    margins[:, -1:] * half[:, -1:],
                ],
                1,
            )
            ends = torch.cumsum(gaps, 1)
            lower, upper = self.lower[:, i : i + 1], self.upper[:, i : i + 1]
            scale = (upper - lower) / ends[:, -1:]
            centres.append(lower + scale * ends[:, :-1])
            widths.append(scale * half / self.half_width)
            start += terms
        return torch.cat(centres, 1), torch.cat(widths, 1)

    @torch.no_grad()
    def assign(self, centres: Tensor, widths: Tensor, lower: Tensor, upper: Tensor) -> None:
        """Adopt the nearest ordered partition, with a margin of 2 % from the inputs' bounds."""
        self.lower.copy_(lower)
        self.upper.copy_(upper)
        start = 0
        for i, terms in enumerate(self.terms):
            c = centres[:, start : start + terms]
            half = widths[:, start : start + terms] * self.half_width
            spacing = c.diff(dim=1) / (half[:, :-1] + half[:, 1:])
            # The inverse of `forward`: margins and spacings as fractions of their open intervals.
            share = torch.cat(
                [
                    (c[:, :1] - self.lower[:, i : i + 1]) / half[:, :1],
                    (spacing - self.least) / self.span,
                    (self.upper[:, i : i + 1] - c[:, -1:]) / half[:, -1:],
                ],
                1,
            ).clamp(0.02, 0.98)
            self.log_widths[:, start : start + terms] = half.log()
            self.spacings[:, start + i : start + i + terms + 1] = torch.logit(share)
            start += terms

    @torch.no_grad()
    def jacobian(self) -> dict[str, Tensor]:
        """d (centres, widths) / d parameter over the width, (groups, 2 sets, entries), by name."""
        parameters = {name: value.detach() for name, value in self.named_parameters()}

        def sets(values: dict[str, Tensor]) -> Tensor:
            return torch.cat(torch.func.functional_call(self, values, ()), 1)

        found = torch.func.jacrev(sets)(parameters)
        widths = self()[1].repeat(1, 2).unsqueeze(-1)
        # The sets of a group depend only on its own parameters.
        return {n: J.diagonal(dim1=0, dim2=2).movedim(-1, 0) / widths for n, J in found.items()}


def even_centres(terms: list[int], lower: Tensor, upper: Tensor) -> list[Tensor]:
    """Centres from `lower` to `upper` (groups, inputs); one tensor (groups, terms) per input."""
    centres = []
    for i, count in enumerate(terms):
        low, span = lower[:, i, None], (upper - lower)[:, i, None]
        shares = torch.linspace(0, 1, count, dtype=torch.float64) if count > 1 else _MIDDLE
        centres.append(low + span * shares.to(lower))
    return centres


def crossing_half_widths(centres: list[Tensor], span: Tensor) -> list[Tensor]:
    """Half-widths for which neighbours cross at 0.5 or more: half of the wider adjacent gap.

    Args:
        centres: for each input, ascending, shape (groups, terms).
        span: of each input (groups, inputs); a single set gets half of it.
    """
    half_widths = []
    for i, c in enumerate(centres):
        if c.shape[1] == 1:
            half_widths.append(0.5 * span[:, i, None])
        else:
            gaps = c.diff(dim=1)
            padded = torch.cat([gaps[:, :1], gaps, gaps[:, -1:]], 1)
            half_widths.append(0.5 * torch.maximum(padded[:, :-1], padded[:, 1:]))
    return half_widths

"""The sets of one variable, evaluated together."""

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from nfriction.fuzzy.membership import FuzzySet, bell, trapezoid, two_sided_gaussian

_GAUSSIAN, _BELL, _TRAPEZOID = 0, 1, 2


class LinguisticTerms(nn.Module):
    """Memberships of one variable in all of its sets; scripts and exports."""

    numbers: Tensor
    families: list[int]

    def __init__(self, sets: Sequence[FuzzySet]) -> None:
        super().__init__()
        families, numbers = zip(*(_canonical(term) for term in sets), strict=True)
        self.families = list(families)
        self.register_buffer("numbers", torch.tensor(numbers, dtype=torch.float64))

    def forward(self, x: Tensor) -> Tensor:
        """Memberships, shape (terms, *x.shape)."""
        held: list[Tensor] = []
        for term, family in enumerate(self.families):
            p = self.numbers[term]
            # Numbers and not their names, for TorchScript sees no globals.
            if family == 0:
                held.append(two_sided_gaussian(x, p[0], p[1], p[2], p[3]))
            elif family == 1:
                held.append(bell(x, p[0], p[1], p[2]))
            else:
                held.append(trapezoid(x, p[0], p[1], p[2], p[3]))
        return torch.stack(held)


def _canonical(term: FuzzySet) -> tuple[int, tuple[float, ...]]:
    """Family of a set and its four numbers: an infinite sigma makes a shoulder."""
    p = term.parameters
    if term.shape == "gaussian":
        return _GAUSSIAN, (p[0], p[1], p[0], p[1])
    if term.shape == "left_shoulder":
        return _GAUSSIAN, (p[0], float("inf"), p[0], p[1])
    if term.shape == "right_shoulder":
        return _GAUSSIAN, (p[0], p[1], p[0], float("inf"))
    if term.shape == "two_sided_gaussian":
        return _GAUSSIAN, p
    if term.shape == "bell":
        return _BELL, (*p, 0.0)
    if term.shape == "triangle":
        return _TRAPEZOID, (p[0], p[1], p[1], p[2])
    return _TRAPEZOID, p

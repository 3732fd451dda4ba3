"""Small networks and data for the tests of Jacobians and evidence."""

import torch
from torch import Tensor, nn

F64 = torch.float64


class RadialBasis(nn.Module):
    """The paper's 2-10-2 network: 10 centres and widths in the plane, 2 outputs, 52 parameters."""

    def __init__(self, units: int = 10, seed: int = 0) -> None:
        super().__init__()
        generator = torch.Generator().manual_seed(seed)
        like = {"dtype": F64, "generator": generator}
        self.centres = nn.Parameter(2 * torch.rand(units, 2, **like) - 1)
        self.log_widths = nn.Parameter(0.3 * torch.randn(units, **like))
        self.weights = nn.Parameter(torch.randn(units, 2, **like))
        self.bias = nn.Parameter(torch.zeros(2, dtype=F64))

    def forward(self, x: Tensor) -> Tensor:
        first, second = (x[:, axis, None] - self.centres[:, axis] for axis in (0, 1))
        phi = torch.exp(-(first.square() + second.square()) * torch.exp(-2 * self.log_widths))
        return phi @ self.weights + self.bias


class Tanh(nn.Module):
    """1-S-1 network with tanh units, initially spread over [-1, 1] (Nguyen and Widrow)."""

    def __init__(self, units: int, seed: int) -> None:
        super().__init__()
        like = {"dtype": F64, "generator": torch.Generator().manual_seed(seed)}
        spread = 0.7 * units
        self.w1 = nn.Parameter(spread * torch.randn(units, **like).sign())
        self.b1 = nn.Parameter(spread * (2 * torch.rand(units, **like) - 1))
        self.w2 = nn.Parameter(torch.rand(units, **like) - 0.5)
        self.b2 = nn.Parameter(torch.rand(1, **like) - 0.5)

    def forward(self, x: Tensor) -> Tensor:
        return torch.tanh(x[:, None] * self.w1 + self.b1) @ self.w2 + self.b2


class Linear(nn.Module):
    """f = X w, with the coefficients w in one or two parameters, a and b."""

    def __init__(self, a: int, b: int = 0) -> None:
        super().__init__()
        self.a = nn.Parameter(torch.zeros(a, dtype=F64))
        if b:
            self.b = nn.Parameter(torch.zeros(b, dtype=F64))

    def forward(self, x: Tensor) -> Tensor:
        return x @ torch.cat(list(self.parameters()))


def noise(seed: int, *shape: int) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=F64)


def triangle_wave(seed: int, samples: int = 100, sigma: float = 0.1) -> tuple[Tensor, Tensor]:
    """One period on [-1, 1] with noise, as in Foresee and Hagan's first example."""
    x = torch.linspace(-1, 1, samples, dtype=F64)
    phase = 2 * (x + 1)
    clean = torch.where(phase < 1, phase, torch.where(phase < 3, 2 - phase, phase - 4))
    return x, clean + sigma * noise(seed, samples)

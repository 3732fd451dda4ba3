"""Fixed points of the prior precision updates maximise the evidence of a linear model."""

from itertools import pairwise

import torch

from nfriction.optim.group_evidence import group_evidence


def problem():
    random = torch.Generator().manual_seed(0)
    rows = torch.randn(40, 7, generator=random, dtype=torch.float64)
    data, known = rows.T @ rows, torch.diag(torch.linspace(0.0, 3.0, 7).double())
    known[0, 1] = known[1, 0] = 0.0
    truth = torch.tensor([0.1, -0.1, 0.2, 1.0, 2.0, -1.5, 0.5], dtype=torch.float64)
    slope = data @ truth + rows.T @ torch.randn(40, generator=random, dtype=torch.float64)
    groups = torch.tensor([0, 0, 0, 1, 1, 1, -1])
    return data, known, slope, groups


def optimum(precision):
    data, known, slope, groups = problem()
    alpha = torch.where(groups >= 0, precision[groups.clamp_min(0)], 0.0)
    return torch.linalg.solve(data + known + torch.diag(alpha), slope), alpha


def log_evidence(precision):
    data, known, slope, _ = problem()
    w, alpha = optimum(precision)
    prior = known + torch.diag(alpha)
    volume = 0.5 * (torch.logdet(prior) - torch.logdet(prior + data))
    return volume - 0.5 * w @ (prior + data) @ w + slope @ w


def test_gradients_equal_those_of_the_log_evidence():
    data, known, _, groups = problem()
    precision = torch.tensor([2.0, 0.3], dtype=torch.float64)
    w, _ = optimum(precision)
    found = group_evidence(data, known, w, groups, precision)
    logs = precision.log().requires_grad_()
    (expected,) = torch.autograd.grad(log_evidence(logs.exp()), logs)
    torch.testing.assert_close(found.slope, expected, rtol=1e-9, atol=1e-12)
    assert ((found.gamma > 0) & (found.gamma < 3)).all()


def test_updates_maximise_the_evidence():
    data, known, _, groups = problem()
    precision = torch.ones(2, dtype=torch.float64)
    seen = []
    for _ in range(100):
        found = group_evidence(data, known, optimum(precision)[0], groups, precision)
        seen.append(float(log_evidence(precision)))
        precision = found.precision
    assert all(b >= a - 1e-12 for a, b in pairwise(seen))
    assert found.slope.abs().max() < 1e-6


def test_a_group_without_information_keeps_its_prior():
    data, known, _, groups = problem()
    data = data * (groups != 0) * (groups != 0)[:, None]
    precision = torch.ones(2, dtype=torch.float64)
    found = group_evidence(data, known, torch.ones(7).double(), groups, precision)
    assert found.precision[0] == 1.0
    assert found.gamma[0] < 1e-9

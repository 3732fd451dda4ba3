"""Properties of the chunked per-sample Jacobians and normal equations."""

import pytest
import torch
from torch import Tensor

from nfriction.papers.nffem import jacobian
from nfriction.papers.nffem.jacobian import (
    assign,
    flatten,
    jacobian_pieces,
    normal_equations,
    sum_of_squares,
    trainable,
    unflatten,
)
from tests.papers.nffem.networks import Linear, RadialBasis, noise


def per_sample_jacobian(*arguments: object) -> Tensor:
    """The pieces together, (samples, outputs, parameters)."""
    return torch.cat([torch.stack(rows, 1) for _, _, rows in jacobian_pieces(*arguments)])


def test_flatten_and_unflatten_are_inverse_and_ordered() -> None:
    parameters = trainable(RadialBasis())
    vector = flatten(parameters)
    assert vector.shape == (52,)
    assert torch.equal(vector[:20].view(10, 2), parameters["centres"])
    back = unflatten(vector, parameters)
    assert list(back) == list(parameters)
    assert all(torch.equal(back[name], parameters[name]) for name in parameters)
    with pytest.raises(ValueError, match=r"\(52,\)"):
        unflatten(vector[1:], parameters)


def test_jacobian_equals_reverse_differentiation_of_each_sample() -> None:
    model, x = RadialBasis(), noise(0, 7, 2)
    J = per_sample_jacobian(model, x)
    assert J.shape == (7, 2, 52)
    for i in range(7):
        for k in range(2):
            gradient = torch.autograd.grad(model(x[i : i + 1])[0, k], list(model.parameters()))
            expected = torch.cat([g.flatten() for g in gradient])
            torch.testing.assert_close(J[i, k], expected, rtol=1e-12, atol=1e-14)


@pytest.mark.parametrize("chunk", [1, 3, 10, 1000])
def test_result_does_not_depend_on_the_chunks(chunk: int, monkeypatch: pytest.MonkeyPatch) -> None:
    model, x, y = RadialBasis(), noise(0, 10, 2), noise(1, 10, 2)
    # Other values than at first: derivatives must follow the parameters.
    assign(model, flatten(trainable(model)) + 0.1)
    J = per_sample_jacobian(model, x)
    close = {"rtol": 1e-12, "atol": 1e-13}
    monkeypatch.setattr(jacobian, "CHUNK_ENTRIES", chunk * 2 * 52)
    monkeypatch.setattr(jacobian, "CHUNK_SAMPLES", chunk)
    torch.testing.assert_close(per_sample_jacobian(model, x), J, **close)
    assert len(list(jacobian_pieces(model, x))) == -(-10 // chunk)
    got = normal_equations(model, x, y)
    error = (model(x) - y).detach().flatten()
    rows = J.reshape(20, 52)
    torch.testing.assert_close(got.JtJ, rows.T @ rows, **close)
    torch.testing.assert_close(got.Jte, rows.T @ error, **close)
    torch.testing.assert_close(got.squares, error @ error, **close)
    cheap = sum_of_squares(model, x, y)
    torch.testing.assert_close(cheap, got.squares, **close)


def test_frozen_parameters_have_no_column() -> None:
    model = RadialBasis()
    model.centres.requires_grad_(False)
    assert "centres" not in trainable(model)
    whole = per_sample_jacobian(RadialBasis(), noise(0, 4, 2))
    part = per_sample_jacobian(model, noise(0, 4, 2))
    torch.testing.assert_close(part, whole[:, :, 20:], rtol=1e-14, atol=0)


def test_memory_stays_bounded_on_a_long_recording() -> None:
    model = RadialBasis()
    sizes = [len(y) for _, y, _ in jacobian_pieces(model, noise(0, 40_000, 2))]
    assert sum(sizes) == 40_000
    # Ten intermediates of the size of a chunk's Jacobian are below 100 MB.
    assert max(sizes) * 2 * 52 * 8 * 10 < 100e6


def test_inconsistent_sizes_are_refused_on_entry() -> None:
    model, x = Linear(2), noise(0, 5, 2)
    with pytest.raises(ValueError, match="must agree"):
        normal_equations(model, x, noise(1, 5, 1))
    with pytest.raises(ValueError, match="number of samples"):
        normal_equations(model, x, noise(1, 4))
    with pytest.raises(ValueError, match="number of samples"):
        normal_equations(model, x[:0], noise(1, 5)[:0])

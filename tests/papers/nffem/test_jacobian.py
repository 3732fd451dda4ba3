"""Laws of the chunked per-sample Jacobians and normal equations."""

from collections.abc import Mapping

import pytest
import torch
from torch import Tensor

from nfriction.papers.nffem.jacobian import (
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


def test_jacobian_is_the_one_of_reverse_differentiation_sample_by_sample() -> None:
    model, x = RadialBasis(), noise(0, 7, 2)
    J = per_sample_jacobian(model, trainable(model), x)
    assert J.shape == (7, 2, 52)
    for i in range(7):
        for k in range(2):
            gradient = torch.autograd.grad(model(x[i : i + 1])[0, k], list(model.parameters()))
            expected = torch.cat([g.flatten() for g in gradient])
            torch.testing.assert_close(J[i, k], expected, rtol=1e-12, atol=1e-14)


@pytest.mark.parametrize("chunk", [1, 3, 10, 1000])
def test_chunks_change_nothing(chunk: int) -> None:
    model, x, y = RadialBasis(), noise(0, 10, 2), noise(1, 10, 2)
    # Other values than the module's own: derivatives must follow the argument.
    parameters = {name: value + 0.1 for name, value in trainable(model).items()}
    J = per_sample_jacobian(model, parameters, x)
    close = {"rtol": 1e-12, "atol": 1e-13}
    torch.testing.assert_close(per_sample_jacobian(model, parameters, x, chunk), J, **close)
    got = normal_equations(model, parameters, x, y, chunk)
    error = (torch.func.functional_call(model, parameters, (x,)) - y).flatten()
    rows = J.reshape(20, 52)
    torch.testing.assert_close(got.JtJ, rows.T @ rows, **close)
    torch.testing.assert_close(got.Jte, rows.T @ error, **close)
    torch.testing.assert_close(got.squares, error @ error, **close)
    cheap = sum_of_squares(model, parameters, x, y)
    torch.testing.assert_close(cheap, got.squares, **close)


def test_function_of_a_dictionary_serves_like_a_module() -> None:
    def function(parameters: Mapping[str, Tensor], x: Tensor) -> Tensor:
        return parameters["gain"] * torch.sin(parameters["rate"] * x)

    parameters = {"gain": torch.tensor(2.0).double(), "rate": torch.tensor(3.0).double()}
    x = noise(0, 5)
    J = per_sample_jacobian(function, parameters, x)
    expected = torch.stack([torch.sin(3 * x), 2 * x * torch.cos(3 * x)], -1)[:, None]
    torch.testing.assert_close(J, expected, rtol=1e-14, atol=1e-15)


def test_frozen_parameters_have_no_column() -> None:
    model = RadialBasis()
    model.centres.requires_grad_(False)
    parameters = trainable(model)
    assert "centres" not in parameters
    whole = per_sample_jacobian(RadialBasis(), trainable(RadialBasis()), noise(0, 4, 2))
    part = per_sample_jacobian(model, parameters, noise(0, 4, 2))
    torch.testing.assert_close(part, whole[:, :, 20:], rtol=1e-14, atol=0)


def test_memory_stays_bounded_on_a_long_recording() -> None:
    model = RadialBasis()
    sizes = [len(y) for _, y, _ in jacobian_pieces(model, trainable(model), noise(0, 40_000, 2))]
    assert sum(sizes) == 40_000
    # Ten intermediates of the size of a chunk's Jacobian are below 100 MB.
    assert max(sizes) * 2 * 52 * 8 * 10 < 100e6


def test_misfits_are_refused_at_the_border() -> None:
    model, x = Linear(2), noise(0, 5, 2)
    parameters = trainable(model)
    with pytest.raises(ValueError, match="must agree"):
        normal_equations(model, parameters, x, noise(1, 5, 1))
    with pytest.raises(ValueError, match="number of samples"):
        normal_equations(model, parameters, x, noise(1, 4))
    with pytest.raises(ValueError, match="number of samples"):
        normal_equations(model, parameters, x[:0], noise(1, 5)[:0])

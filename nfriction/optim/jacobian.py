"""Per-sample Jacobians of a model with respect to its parameters, in chunks of bounded memory.

A model is an `nn.Module` or a function `f(parameters, inputs)` of a dictionary and a batch whose
first axis runs over samples; sample i of the output must depend on sample i of the input only.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import NamedTuple, TypeAlias

import torch
from torch import Tensor, nn
from torch.func import functional_call, vjp, vmap

from nfriction.optim.shared_columns import accumulate_columns, shares_columns

Function: TypeAlias = Callable[[Mapping[str, Tensor], Tensor], Tensor]

# 4 MiB of Jacobian at a time: below, the calls cost more than the arithmetic; above, the backward
# pass falls out of the cache, and its some ten intermediates of that size out of 100 MB.
CHUNK_ENTRIES = 2**19
# Where only outputs are asked for: their intermediates stay in the cache, and need no memory that
# the system hands out anew, whose first touch costs more than the arithmetic.
CHUNK_SAMPLES = 2**14


class NormalEquations(NamedTuple):
    """J^T J (p, p), J^T e (p,) and sum e^2 of the errors e = f - target, all weighted."""

    JtJ: Tensor
    Jte: Tensor
    squares: Tensor


def flatten(parameters: Mapping[str, Tensor]) -> Tensor:
    """All parameters in one vector, in the dictionary's order."""
    return torch.cat([value.reshape(-1) for value in parameters.values()])


def unflatten(vector: Tensor, like: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Inverse of `flatten`: views of `vector` with the names and shapes of `like`.

    Raises:
        ValueError: if the number of entries differs.
    """
    sizes = [value.numel() for value in like.values()]
    if vector.shape != (sum(sizes),):
        raise ValueError(
            f"`vector` must have shape ({sum(sizes)},) to fill {list(like)}, got "
            f"{tuple(vector.shape)}."
        )
    parts = vector.split(sizes)
    return {
        name: part.view(value.shape)
        for part, (name, value) in zip(parts, like.items(), strict=True)
    }


def trainable(module: nn.Module) -> dict[str, Tensor]:
    """Detached parameters of the module that require a gradient, by name, in order."""
    return {n: p.detach() for n, p in module.named_parameters() if p.requires_grad}


def per_sample_jacobian(
    model: nn.Module | Function,
    parameters: Mapping[str, Tensor],
    inputs: Tensor,
    chunk: int | None = None,
) -> Tensor:
    """Derivative of every output of every sample with respect to every parameter.

    A module's own method `jacobian(inputs) -> (m, outputs, p)`, columns in the order of
    `trainable(module)`, takes the place of automatic differentiation where there is one.

    Args:
        model: module, or f(parameters, inputs) -> (m, *outputs).
        parameters: those to differentiate by; a module keeps its own values for others.
        inputs: shape (n, ...).
        chunk: samples differentiated at once; by default as many as fit a few megabytes.
    Returns:
        Shape (n, outputs, p), outputs flattened, columns as in `flatten(parameters)`.
    """
    if len(inputs) == 0:
        raise ValueError("`inputs` holds no samples.")
    pieces = jacobian_pieces(model, parameters, inputs, chunk)
    return torch.cat([torch.stack(jacobians, 1) for _, _, jacobians in pieces])


def jacobian_pieces(
    model: nn.Module | Function,
    parameters: Mapping[str, Tensor],
    inputs: Tensor,
    chunk: int | None = None,
) -> Iterator[tuple[slice, Tensor, tuple[Tensor, ...]]]:
    """Walk through the samples in chunks; arguments as for `per_sample_jacobian`.

    Yields:
        Slice of the samples, their outputs (m, *outputs), one Jacobian (m, p) for each output.
    """
    differentiate = _differentiated(model, parameters)
    if chunk is None:
        with torch.no_grad():
            outputs = _function(model)(parameters, inputs[:1]).numel()
        chunk = CHUNK_ENTRIES // (outputs * sum(value.numel() for value in parameters.values()))
    for start in range(0, len(inputs), max(1, chunk)):
        rows = slice(start, start + max(1, chunk))
        output, jacobians = differentiate(inputs[rows])
        yield rows, output.detach(), tuple(J.detach() for J in jacobians)


def normal_equations(
    model: nn.Module | Function,
    parameters: Mapping[str, Tensor],
    inputs: Tensor,
    targets: Tensor,
    weights: Tensor | None = None,
    chunk: int | None = None,
) -> NormalEquations:
    """Normal equations of the least-squares problem f(parameters, inputs) = targets.

    Accumulated chunk by chunk: 40,000 samples of 52 parameters never hold their whole Jacobian.
    A module that offers the columns its outputs share (`shared_columns`) is asked for these, one
    that offers `jacobian` for that, others are differentiated.

    Args:
        model, parameters, inputs, chunk: as for `per_sample_jacobian`.
        targets: shape (n, *outputs).
        weights: factors of the squared errors, shape (n,) or that of `targets`; 1 by default.
    Raises:
        ValueError: if targets or weights do not fit.
    """
    check_samples(inputs, targets, weights)
    if isinstance(model, nn.Module) and shares_columns(model) and _all_trained(model, parameters):
        _errors(_function(model)(parameters, inputs[:1]), targets[:1])
        return NormalEquations(
            *accumulate_columns(model, parameters, inputs, targets, weights, chunk)
        )
    p = sum(value.numel() for value in parameters.values())
    JtJ, Jte, squares = inputs.new_zeros(p, p), inputs.new_zeros(p), inputs.new_zeros(())
    for rows, output, jacobians in jacobian_pieces(model, parameters, inputs, chunk):
        error = _errors(output, targets[rows])
        root = None
        if weights is not None:
            root = weights[rows].reshape(len(error), -1).sqrt().expand_as(error)
            error = error * root
        # Output by output the matrix product takes any memory layout without a copy.
        for k, jacobian in enumerate(jacobians):
            J = jacobian if root is None else jacobian * root[:, k, None]
            JtJ.addmm_(J.T, J)
            Jte.addmv_(J.T, error[:, k])
        squares += error.square().sum()
    return NormalEquations(JtJ, Jte, squares)


def sum_of_squares(
    model: nn.Module | Function,
    parameters: Mapping[str, Tensor],
    inputs: Tensor,
    targets: Tensor,
    weights: Tensor | None = None,
) -> Tensor:
    """Weighted sum of squared errors alone: the cheap trial of a step."""
    function, total = _function(model), inputs.new_zeros(())
    with torch.no_grad():
        for start in range(0, len(inputs), CHUNK_SAMPLES):
            rows = slice(start, start + CHUNK_SAMPLES)
            errors = _errors(function(parameters, inputs[rows]), targets[rows]).square()
            if weights is not None:
                errors = errors * weights[rows].reshape(len(errors), -1)
            total += errors.sum()
    return total


def check_samples(inputs: Tensor, targets: Tensor, weights: Tensor | None) -> None:
    """Refuse samples, targets and weights that do not belong together."""
    if len(inputs) == 0 or len(inputs) != len(targets):
        raise ValueError(
            "`inputs` and `targets` must hold the same number of samples, at least one, got "
            f"{len(inputs)} and {len(targets)}."
        )
    if weights is not None:
        if weights.shape not in (targets.shape, targets.shape[:1]):
            raise ValueError(
                f"`weights` must be one per sample, shape {tuple(targets.shape[:1])}, or one per "
                f"target, shape {tuple(targets.shape)}, got {tuple(weights.shape)}."
            )
        if not (weights >= 0).all():
            raise ValueError("`weights` must not be negative or NaN.")


class _OwnJacobian(nn.Module):
    """Lets `functional_call` reach a module's `jacobian` instead of its `forward`."""

    def __init__(self, model: nn.Module) -> None:
        super().__init__()
        self.model = model

    def forward(self, inputs: Tensor) -> Tensor:
        jacobian: Callable[[Tensor], Tensor] = getattr(self.model, "jacobian")  # noqa: B009
        return jacobian(inputs)


def _function(model: nn.Module | Function) -> Function:
    if isinstance(model, nn.Module):
        return lambda parameters, inputs: functional_call(model, dict(parameters), (inputs,))
    return model


def _all_trained(model: nn.Module, parameters: Mapping[str, Tensor]) -> bool:
    """Whether these are what a module's own derivatives are by, in their order."""
    return list(parameters) == list(trainable(model))


def _differentiated(
    model: nn.Module | Function, parameters: Mapping[str, Tensor]
) -> Callable[[Tensor], tuple[Tensor, Sequence[Tensor]]]:
    """Batch of inputs -> outputs (m, *outputs) and a Jacobian (m, p) for each of them."""
    function = _function(model)
    written = callable(getattr(model, "jacobian", None))
    if isinstance(model, nn.Module) and written and _all_trained(model, parameters):
        own = _OwnJacobian(model)
        prefixed = {f"model.{name}": value for name, value in parameters.items()}

        def analytic(inputs: Tensor) -> tuple[Tensor, Sequence[Tensor]]:
            with torch.no_grad():
                jacobian = functional_call(own, prefixed, (inputs,))
                return function(parameters, inputs), jacobian.unbind(1)

        return analytic

    def one(vector: Tensor, sample: Tensor) -> tuple[Tensor, list[Tensor]]:
        # vjp's stub claims a third value that it returns for has_aux=True only.
        output, pull = vjp(  # type: ignore[misc]
            lambda given: function(unflatten(given, parameters), sample[None])[0], vector
        )
        units = torch.eye(output.numel(), dtype=output.dtype, device=output.device)
        # One plain backward pass per output: outputs are few, and `jacrev`'s second level of
        # vmap over them costs a fifth more.
        return output, [pull(unit.view(output.shape))[0] for unit in units]

    batch = vmap(one, in_dims=(None, 0))
    vector = flatten(parameters).detach()
    return lambda inputs: batch(vector, inputs)


def _errors(output: Tensor, targets: Tensor) -> Tensor:
    # Without this check (n,) against (n, 1) would broadcast to (n, n) and fit nonsense.
    if output.shape != targets.shape:
        raise ValueError(
            f"The model gives {tuple(output.shape)} for targets of shape {tuple(targets.shape)}; "
            "both must agree (a single output is `targets[:, None]` or `[:, 0]` of the model)."
        )
    return (output - targets).reshape(len(output), -1)

"""Normal equations of a model's least-squares problem, in chunks of bounded memory.

A model is a module, differentiated by the parameters that require a gradient at their current
values; sample i of the output must depend only on sample i of the input.

Models are differentiated by autograd, sample by sample. If the outputs of a network share a hidden
layer, their derivatives combine fewer columns than there are parameters, so one matrix product can
cover all outputs; this is about five times faster (52 parameters, 40,000 samples: 10 ms instead of
60). A `LinearOutputModule` provides these columns.
"""

from collections.abc import Iterator, Mapping
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.func import functional_call, vjp, vmap

from nfriction.fuzzy.grouped import LinearOutputModule

# 4 MiB of Jacobian or columns at a time: with less, calls cost more than arithmetic; with more, the
# numbers no longer fit into the cache, and the system allocates new memory for every call.
CHUNK_ENTRIES = 2**19
# Samples at a time if only outputs are computed, so that intermediate results stay in the cache.
CHUNK_SAMPLES = 2**14


class NormalEquations(NamedTuple):
    """J^T J (p, p), J^T e (p,) and sum e^2 of the errors e = f - target."""

    JtJ: Tensor
    Jte: Tensor
    squares: Tensor

    @property
    def finite(self) -> bool:
        """True if every entry is a finite number."""
        return all(bool(torch.isfinite(part).all()) for part in self)


def trainable(module: nn.Module) -> dict[str, Tensor]:
    """Detached parameters of the module that require a gradient, by name, in order."""
    return {n: p.detach() for n, p in module.named_parameters() if p.requires_grad}


def flatten(parameters: Mapping[str, Tensor]) -> Tensor:
    """All parameters in one vector, in the dictionary's order."""
    return torch.cat([value.reshape(-1) for value in parameters.values()])


def unflatten(vector: Tensor, like: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Inverse of `flatten`: views of `vector` with the names and shapes of `like`."""
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


def assign(module: nn.Module, vector: Tensor) -> None:
    """Set the parameters that require a gradient to the values of a vector, in place."""
    own = trainable(module)
    for name, value in unflatten(vector, own).items():
        own[name].copy_(value)


def jacobian_pieces(
    model: nn.Module, inputs: Tensor
) -> Iterator[tuple[slice, Tensor, tuple[Tensor, ...]]]:
    """Differentiate any module by its parameters, one chunk of samples (n, ...) after another.

    Yields slice of the samples, outputs (m, *outputs), one Jacobian (m, p) for each output.
    """
    parameters = trainable(model)
    vector = flatten(parameters)

    def one(vector: Tensor, sample: Tensor) -> tuple[Tensor, list[Tensor]]:
        output, pull = vjp(
            lambda given: functional_call(model, unflatten(given, parameters), (sample[None],))[0],
            vector,
        )
        units = torch.eye(output.numel(), dtype=output.dtype, device=output.device)
        # One plain backward pass per output: outputs are few, and `jacrev`'s second level of
        # vmap over them costs a fifth more.
        return output, [pull(unit.view(output.shape))[0] for unit in units]

    differentiated = vmap(one, in_dims=(None, 0))
    with torch.no_grad():
        outputs = model(inputs[:1]).numel()
    chunk = max(1, CHUNK_ENTRIES // (outputs * len(vector)))
    for start in range(0, len(inputs), chunk):
        rows = slice(start, start + chunk)
        output, jacobians = differentiated(vector, inputs[rows])
        yield rows, output.detach(), tuple(J.detach() for J in jacobians)


def normal_equations(model: nn.Module, inputs: Tensor, targets: Tensor) -> NormalEquations:
    """Normal equations of the least-squares problem model(inputs) = targets (n, *outputs)."""
    check_samples(inputs, targets)
    if isinstance(model, LinearOutputModule):
        return _from_columns(model, inputs, targets)
    p = sum(value.numel() for value in trainable(model).values())
    JtJ, Jte, squares = inputs.new_zeros(p, p), inputs.new_zeros(p), inputs.new_zeros(())
    for rows, output, jacobians in jacobian_pieces(model, inputs):
        error = _errors(output, targets[rows])
        # Output by output, the matrix product accepts any memory layout without a copy.
        for k, J in enumerate(jacobians):
            JtJ.addmm_(J.T, J)
            Jte.addmv_(J.T, error[:, k])
        squares += error.square().sum()
    return NormalEquations(JtJ, Jte, squares)


@torch.no_grad()
def sum_of_squares(model: nn.Module, inputs: Tensor, targets: Tensor) -> Tensor:
    """Sum of squared errors only, as a cheap trial of a step."""
    parts = zip(inputs.split(CHUNK_SAMPLES), targets.split(CHUNK_SAMPLES), strict=True)
    squares = (_errors(model(x), y).square().sum() for x, y in parts)
    return sum(squares, inputs.new_zeros(()))


def check_samples(inputs: Tensor, targets: Tensor) -> None:
    """Raise ValueError if samples and targets do not match."""
    # Slicing would silently shorten the longer of the two.
    if len(inputs) == 0 or len(inputs) != len(targets):
        raise ValueError(
            "`inputs` and `targets` must hold the same number of samples, at least one, got "
            f"{len(inputs)} and {len(targets)}."
        )


def _errors(output: Tensor, targets: Tensor) -> Tensor:
    # Without this check (n,) against (n, 1) would broadcast to (n, n) and fit nonsense.
    if output.shape != targets.shape:
        raise ValueError(
            f"The model gives {tuple(output.shape)} for targets of shape {tuple(targets.shape)}; "
            "both must agree (a single output is `targets[:, None]` or `[:, 0]` of the model)."
        )
    return (output - targets).reshape(len(output), -1)


@torch.no_grad()
def _from_columns(layer: LinearOutputModule, inputs: Tensor, targets: Tensor) -> NormalEquations:
    """Normal equations from products of all columns and errors, group by group."""
    _errors(layer(inputs[:1]), targets[:1])
    readout, parameters = layer.readout(), trainable(layer)
    maps = torch.cat(list(layer.jacobian_maps().values()), -1)
    groups, outputs, used = readout.shape
    columns = maps.shape[2]
    chunk = min(len(inputs), max(1, CHUNK_ENTRIES // (groups * (columns + outputs))))
    # Reused, because first access to new memory costs more than the arithmetic.
    buffer = inputs.new_empty(groups, columns + outputs, chunk)
    grams = inputs.new_zeros(groups, columns + outputs, columns + outputs)
    for x, y in zip(inputs.split(chunk), targets.split(chunk), strict=True):
        F = buffer[:, :, : len(x)]
        layer.jacobian_columns(x, F[:, :columns])
        torch.bmm(readout, F[:, :used], out=F[:, columns:])
        F[:, columns:].sub_(y.permute(1, 2, 0))
        grams.baddbmm_(F, F.mT)
    count = sum(value.numel() for value in parameters.values())
    numbers = unflatten(torch.arange(count, device=inputs.device), parameters).values()
    places = torch.cat([number.reshape(groups, -1) for number in numbers], 1)
    JtJ, Jte = inputs.new_zeros(count, count), inputs.new_zeros(count)
    # Groups share no parameters, so J^T J is block diagonal.
    for where, map_, gram in zip(places, maps, grams, strict=True):
        # From columns to parameters once per group, after the sum over all samples.
        JtJ[where[:, None], where] = (map_.mT @ gram[:columns, :columns] @ map_).sum(0)
        Jte[where] = torch.einsum("kcp,kc->p", map_, gram[columns:, :columns])
    squares = grams[:, columns:, columns:].diagonal(dim1=1, dim2=2).sum()
    return NormalEquations(JtJ, Jte, squares)

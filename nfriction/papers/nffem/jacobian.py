"""Normal equations of a model's least-squares problem, in chunks of bounded memory.

A model is an `nn.Module` or a function `f(parameters, inputs)` of a dictionary and a batch whose
first axis runs over samples; sample i of the output must depend on sample i of the input only.

Models are differentiated automatically, sample by sample. The outputs of a network with a common
hidden layer have derivatives that combine fewer columns than there are parameters, so one product
of matrices can cover all outputs; this is five times faster (52 parameters, 40,000 samples: 10 ms
instead of 60). A module offers it by three methods, for inputs x of shape (samples, groups, inputs)
and groups that share no parameter:

    jacobian_columns(x, out=None): shape (groups, columns, samples), written to `out`;
    jacobian_maps(): by the name of each trained parameter (groups, outputs, columns, entries of a
        group), with d y_k / d parameter = maps[name][g, k].T @ columns[g];
    readout(): shape (groups, outputs, n), the outputs as combinations of the first n columns.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import NamedTuple, Protocol, TypeAlias, cast

import torch
from torch import Tensor, nn
from torch.func import functional_call, vjp, vmap

Function: TypeAlias = Callable[[Mapping[str, Tensor], Tensor], Tensor]

# 4 MiB of Jacobian or columns at a time: below, the calls cost more than the arithmetic; above, the
# numbers fall out of the cache and into memory that the system hands out anew for every call.
CHUNK_ENTRIES = 2**19
# Samples at a time where only outputs are computed, whose intermediates then stay in the cache.
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


class SharedColumns(Protocol):
    """A module that offers the columns of its Jacobian; see the head of this file."""

    def jacobian_columns(self, x: Tensor, out: Tensor | None = None) -> Tensor: ...
    def jacobian_maps(self) -> dict[str, Tensor]: ...
    def readout(self) -> Tensor: ...


def shares_columns(model: object) -> bool:
    """True for a module that offers the columns that its outputs share."""
    names = ("jacobian_columns", "jacobian_maps", "readout")
    return all(callable(getattr(model, name, None)) for name in names)


def trainable(module: nn.Module) -> dict[str, Tensor]:
    """Detached parameters of the module that require a gradient, by name, in order."""
    return {n: p.detach() for n, p in module.named_parameters() if p.requires_grad}


def flatten(parameters: Mapping[str, Tensor]) -> Tensor:
    """All parameters in one vector, in the dictionary's order."""
    return torch.cat([value.reshape(-1) for value in parameters.values()])


def unflatten(vector: Tensor, like: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Inverse of `flatten`: views of `vector` with the names and shapes of `like`.

    Raises:
        ValueError: the number of entries differs.
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


def jacobian_pieces(
    model: nn.Module | Function,
    parameters: Mapping[str, Tensor],
    inputs: Tensor,
    chunk: int | None = None,
) -> Iterator[tuple[slice, Tensor, tuple[Tensor, ...]]]:
    """Differentiate a model by its parameters, one chunk of samples after the other.

    Args:
        model: module, or f(parameters, inputs) -> (m, *outputs).
        parameters: those to differentiate by; a module keeps its own values for others.
        inputs: shape (n, ...).
        chunk: samples at once; by default as many as fit a few megabytes.
    Yields:
        Slice of the samples, their outputs (m, *outputs), one Jacobian (m, p) for each output.
    """
    function, vector = _function(model), flatten(parameters).detach()

    def one(vector: Tensor, sample: Tensor) -> tuple[Tensor, list[Tensor]]:
        output, pull = vjp(
            lambda given: function(unflatten(given, parameters), sample[None])[0], vector
        )
        units = torch.eye(output.numel(), dtype=output.dtype, device=output.device)
        # One plain backward pass per output: outputs are few, and `jacrev`'s second level of
        # vmap over them costs a fifth more.
        return output, [pull(unit.view(output.shape))[0] for unit in units]

    differentiated = vmap(one, in_dims=(None, 0))
    if chunk is None:
        with torch.no_grad():
            outputs = function(parameters, inputs[:1]).numel()
        chunk = CHUNK_ENTRIES // (outputs * len(vector))
    for start in range(0, len(inputs), max(1, chunk)):
        rows = slice(start, start + max(1, chunk))
        output, jacobians = differentiated(vector, inputs[rows])
        yield rows, output.detach(), tuple(J.detach() for J in jacobians)


def normal_equations(
    model: nn.Module | Function,
    parameters: Mapping[str, Tensor],
    inputs: Tensor,
    targets: Tensor,
    chunk: int | None = None,
) -> NormalEquations:
    """Normal equations of the least-squares problem f(parameters, inputs) = targets.

    Args:
        model, parameters, inputs, chunk: as for `jacobian_pieces`.
        targets: shape (n, *outputs).
    Raises:
        ValueError: targets do not fit.
    """
    check_samples(inputs, targets)
    # A module's maps are those of all that it trains, in its order.
    offered = trainable(model) if isinstance(model, nn.Module) and shares_columns(model) else {}
    if isinstance(model, nn.Module) and list(parameters) == list(offered):
        _errors(_function(model)(parameters, inputs[:1]), targets[:1])
        return _from_columns(model, parameters, inputs, targets, chunk)
    p = sum(value.numel() for value in parameters.values())
    JtJ, Jte, squares = inputs.new_zeros(p, p), inputs.new_zeros(p), inputs.new_zeros(())
    for rows, output, jacobians in jacobian_pieces(model, parameters, inputs, chunk):
        error = _errors(output, targets[rows])
        # Output by output the matrix product takes any memory layout without a copy.
        for k, J in enumerate(jacobians):
            JtJ.addmm_(J.T, J)
            Jte.addmv_(J.T, error[:, k])
        squares += error.square().sum()
    return NormalEquations(JtJ, Jte, squares)


def sum_of_squares(
    model: nn.Module | Function,
    parameters: Mapping[str, Tensor],
    inputs: Tensor,
    targets: Tensor,
) -> Tensor:
    """Sum of squared errors alone: the cheap trial of a step."""
    function, total = _function(model), inputs.new_zeros(())
    with torch.no_grad():
        for start in range(0, len(inputs), CHUNK_SAMPLES):
            rows = slice(start, start + CHUNK_SAMPLES)
            total += _errors(function(parameters, inputs[rows]), targets[rows]).square().sum()
    return total


def check_samples(inputs: Tensor, targets: Tensor) -> None:
    """Raise ValueError where samples and targets do not belong together."""
    # Slicing would silently shorten the longer of the two.
    if len(inputs) == 0 or len(inputs) != len(targets):
        raise ValueError(
            "`inputs` and `targets` must hold the same number of samples, at least one, got "
            f"{len(inputs)} and {len(targets)}."
        )


def _function(model: nn.Module | Function) -> Function:
    if isinstance(model, nn.Module):
        return lambda parameters, inputs: functional_call(model, dict(parameters), (inputs,))
    return model


def _errors(output: Tensor, targets: Tensor) -> Tensor:
    # Without this check (n,) against (n, 1) would broadcast to (n, n) and fit nonsense.
    if output.shape != targets.shape:
        raise ValueError(
            f"The model gives {tuple(output.shape)} for targets of shape {tuple(targets.shape)}; "
            "both must agree (a single output is `targets[:, None]` or `[:, 0]` of the model)."
        )
    return (output - targets).reshape(len(output), -1)


@torch.no_grad()
def _from_columns(
    model: nn.Module,
    parameters: Mapping[str, Tensor],
    inputs: Tensor,
    targets: Tensor,
    chunk: int | None,
) -> NormalEquations:
    prefixed = {f"model.{name}": value for name, value in parameters.items()}
    grams, maps = functional_call(_Grams(model), prefixed, (inputs, targets, chunk))
    count = sum(value.numel() for value in parameters.values())
    JtJ, Jte = inputs.new_zeros(count, count), inputs.new_zeros(count)
    squares = inputs.new_zeros(())
    # Groups share no parameter: J^T J is block diagonal.
    for group, gram in enumerate(grams.unbind(0)):
        where = _entries(parameters, len(grams), group).to(inputs.device)
        # From columns to parameters once per group, after the sum over all samples.
        map_ = torch.cat([maps[name][group] for name in parameters], -1)
        columns = map_.shape[1]
        JtJ[where[:, None], where] = (map_.mT @ gram[:columns, :columns] @ map_).sum(0)
        Jte[where] = torch.einsum("kcp,kc->p", map_, gram[columns:, :columns])
        squares += gram[columns:, columns:].diagonal().sum()
    return NormalEquations(JtJ, Jte, squares)


class _Grams(nn.Module):
    """Products of all columns and errors, in a module that `functional_call` can reach through."""

    def __init__(self, model: nn.Module) -> None:
        super().__init__()
        self.model = model

    def forward(
        self, inputs: Tensor, targets: Tensor, chunk: int | None
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """Gram matrices (groups, rows, rows) of [columns, errors], and the maps."""
        model = cast(SharedColumns, self.model)
        readout, maps = model.readout(), model.jacobian_maps()
        groups, outputs, used = readout.shape
        columns = next(iter(maps.values())).shape[2]
        rows = columns + outputs
        chunk = CHUNK_ENTRIES // (groups * rows) if chunk is None else chunk
        chunk = min(len(inputs), max(1, chunk))
        # Reused: the first touch of fresh memory costs more than the arithmetic.
        buffer = inputs.new_empty(groups, rows, chunk)
        grams = inputs.new_zeros(groups, rows, rows)
        for start in range(0, len(inputs), chunk):
            part = slice(start, start + chunk)
            wanted = targets[part].permute(1, 2, 0)
            F = buffer[:, :, : wanted.shape[-1]]
            model.jacobian_columns(inputs[part], F[:, :columns])
            torch.bmm(readout, F[:, :used], out=F[:, columns:])
            F[:, columns:].sub_(wanted)
            grams.baddbmm_(F, F.mT)
        return grams, maps


def _entries(parameters: Mapping[str, Tensor], groups: int, group: int) -> Tensor:
    """Indices of a group's entries in the flat vector of all parameters."""
    places, start = [], 0
    for value in parameters.values():
        count = value.numel() // groups
        places.append(torch.arange(count) + start + group * count)
        start += value.numel()
    return torch.cat(places)

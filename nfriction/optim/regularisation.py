"""Bayesian regularisation of a module: weights, noise level, a prior precision per group."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from fnmatch import fnmatchcase
from typing import Literal

import torch
from torch import Tensor, nn

from nfriction.optim.evidence import (
    EvidenceOptions,
    EvidenceProblem,
    EvidenceResult,
    maximise_evidence,
)
from nfriction.optim.jacobian import (
    NormalEquations,
    check_samples,
    flatten,
    normal_equations,
    sum_of_squares,
    trainable,
    unflatten,
)


def bayesian_regularisation(
    model: nn.Module,
    x: Tensor,
    y: Tensor,
    *,
    groups: Mapping[str, str | Sequence[str]] | None = None,
    prior: Mapping[str, Tensor | float] | Literal["initial"] | None = None,
    options: EvidenceOptions | None = None,
) -> EvidenceResult:
    """Train a module in place on samples, with Bayesian regularisation and no validation set.

    Every trainable parameter is shrunk toward its prior value with the strength that the evidence
    assigns to its group. The weights are written when the fit ends, also if an interrupt or the
    callback ends it; a fit that fails from the start leaves the module unchanged.

    Args:
        model: outputs of sample i depend on sample i only; see `nfriction.optim.jacobian` for
            modules that offer their derivatives.
        x: inputs, shape (n, ...).
        y: targets, shape of the model's output.
        groups: group name -> pattern(s) of parameter names ("rules.*"); by default each named
            parameter is a group of its own.
        prior: values w0 by parameter name, 0 where missing; "initial" for the present weights.
        options: settings; the noise floor is in the unit of `y`.
    Returns:
        Weights, alpha, beta, gamma, log evidence, error bars and status.
    Raises:
        ValueError: samples, groups or prior do not fit the model.
    """
    options = EvidenceOptions() if options is None else options
    parameters = trainable(model)
    if not parameters:
        raise ValueError("`model` has no parameter that requires a gradient.")
    check_samples(x, y)
    if not (torch.isfinite(x).all() and torch.isfinite(y).all()):
        raise ValueError("`x` and `y` must be finite; drop the samples that are not.")
    names, index = group_index(parameters, groups)
    # Errors within the rounding of the targets carry no information.
    rounding = torch.finfo(y.dtype).eps * float(y.square().mean().sqrt())
    # Samples last in memory, as layers take them: kernels are vectorised over samples.
    x, y = (part.movedim(0, -1).contiguous().movedim(-1, 0) for part in (x, y))

    def equations(w: Tensor) -> NormalEquations:
        return normal_equations(model, unflatten(w, parameters), x, y)

    def squares(w: Tensor) -> Tensor:
        return sum_of_squares(model, unflatten(w, parameters), x, y)

    result = maximise_evidence(
        EvidenceProblem(
            equations=equations,
            samples=y.numel(),
            prior=_prior_vector(parameters, prior),
            groups=index,
            names=names,
            squares=squares,
        ),
        flatten(parameters),
        replace(options, noise_floor=max(options.noise_floor, rounding)),
    )
    best = unflatten(result.w.clone(), parameters)
    with torch.no_grad():
        for name, parameter in model.named_parameters():
            if name in best:
                parameter.copy_(best[name])
    return replace(result, model=model, parameters=best)


def group_index(
    parameters: Mapping[str, Tensor], groups: Mapping[str, str | Sequence[str]] | None
) -> tuple[list[str], Tensor]:
    """Group names and the group of every entry of `flatten(parameters)`, int64.

    Raises:
        ValueError: unless every parameter matches the patterns of exactly one group.
    """
    patterns = {
        group: [given] if isinstance(given, str) else list(given)
        for group, given in (groups or {name: name for name in parameters}).items()
    }
    index = []
    for name, value in parameters.items():
        found = [
            number
            for number, given in enumerate(patterns.values())
            if any(fnmatchcase(name, pattern) for pattern in given)
        ]
        if len(found) != 1:
            raise ValueError(
                f"Parameter {name!r} matches {len(found)} of the groups {patterns}; every "
                f"trainable parameter needs exactly one. Parameters: {list(parameters)}."
            )
        index.append(torch.full((value.numel(),), found[0], device=value.device))
    joined = torch.cat(index)
    # A mistyped pattern would otherwise be a group without effect.
    empty = [group for number, group in enumerate(patterns) if not (joined == number).any()]
    if empty:
        raise ValueError(f"Groups {empty} match no parameter of {list(parameters)}.")
    return list(patterns), joined


def _prior_vector(
    parameters: Mapping[str, Tensor], prior: Mapping[str, Tensor | float] | str | None
) -> Tensor:
    if isinstance(prior, str):
        if prior != "initial":
            raise ValueError(f'`prior` is a mapping, "initial" or None, got {prior!r}.')
        return flatten(parameters).clone()
    given = prior or {}
    unknown = sorted(set(given) - set(parameters))
    if unknown:
        raise ValueError(f"`prior` names {unknown}; trainable are {list(parameters)}.")
    centres = {
        name: torch.zeros_like(value) + given.get(name, 0.0) for name, value in parameters.items()
    }
    return flatten(centres)

"""Bayesian regularisation of a module: weights, noise level, a prior precision per group.

`maximise_evidence` does the same for whatever accumulates normal equations, a trajectory fit for
instance; the convention for alpha, beta and gamma is that of `posterior`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from fnmatch import fnmatchcase
from typing import Literal

import torch
from torch import Tensor, nn

from nfriction.optim import jacobian as jac
from nfriction.optim.evidence_result import EvidenceResult, EvidenceState
from nfriction.optim.jacobian import NormalEquations
from nfriction.optim.marginal import maximise_evidence


def bayesian_regularisation(
    model: nn.Module,
    x: Tensor,
    y: Tensor,
    *,
    groups: Mapping[str, str | Sequence[str]] | None = None,
    prior: Mapping[str, Tensor | float] | Literal["initial"] | None = None,
    weights: Tensor | None = None,
    max_steps: int = 300,
    tolerance: float = 1e-3,
    noise_floor: float = 0.0,
    initial_damping: float = 0.005,
    chunk: int | None = None,
    state: EvidenceState | None = None,
    callback: Callable[[EvidenceState], bool | None] | None = None,
    progress: bool = False,
) -> EvidenceResult:
    """Train a module in place on samples, with Bayesian regularisation and no validation set.

    Every trainable parameter is shrunk toward its prior value with the strength that its group
    deserves by the evidence. The weights are written when the fit ends, also if an interrupt or
    the callback ends it; a fit that fails from the start leaves the module as it was.

    Args:
        model: outputs of sample i depend on sample i only; an own `jacobian(x)` is used (see
            `per_sample_jacobian`).
        x: inputs, shape (n, ...).
        y: targets, shape of the model's output.
        groups: group name -> pattern(s) of parameter names ("rules.*"); by default each named
            parameter is a group of its own.
        prior: values w0 by parameter name, 0 where missing; "initial" for the present weights.
        weights: factors of the squared errors, shape (n,) or that of `y`; 0 leaves one out.
        max_steps, tolerance, initial_damping, callback, progress: see `maximise_evidence`.
        noise_floor: standard deviation below which an error is not worth fitting, unit of `y`.
        chunk: samples differentiated at once.
        state: of an earlier result or callback, to go on bit for bit from there.
    Returns:
        Weights, alpha, beta, gamma, log evidence, error bars and how the fit ended.
    Raises:
        ValueError: if samples, groups or prior do not fit the model.
    """
    parameters = jac.trainable(model)
    if not parameters:
        raise ValueError("`model` has no parameter that requires a gradient.")
    jac.check_samples(x, y, weights)
    if not (torch.isfinite(x).all() and torch.isfinite(y).all()):
        raise ValueError("`x` and `y` must be finite; drop the samples that are not.")
    names, index = group_index(parameters, groups)
    used = torch.ones_like(y) if weights is None else _per_error(weights, y)
    used = used[used > 0]
    # Errors within the rounding of the targets are no information about anything.
    rounding = torch.finfo(y.dtype).eps * float(y.square().mean().sqrt())
    # Samples last in memory, as layers take them: kernels are vectorised over samples.
    x, y = (part.movedim(0, -1).contiguous().movedim(-1, 0) for part in (x, y))

    def equations(w: Tensor) -> NormalEquations:
        return jac.normal_equations(model, jac.unflatten(w, parameters), x, y, weights, chunk)

    def squares(w: Tensor) -> Tensor:
        return jac.sum_of_squares(model, jac.unflatten(w, parameters), x, y, weights)

    result = maximise_evidence(
        equations,
        jac.flatten(parameters),
        samples=used.numel(),
        squares=squares,
        groups=index,
        names=names,
        prior=_prior_vector(parameters, prior),
        log_weights=float(used.log().sum()),
        max_steps=max_steps,
        tolerance=tolerance,
        noise_floor=max(noise_floor, rounding),
        initial_damping=initial_damping,
        state=state,
        callback=callback,
        progress=progress,
    )
    best = jac.unflatten(result.w.clone(), parameters)
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
    empty = [group for number, group in enumerate(patterns) if not (joined == number).any()]
    if empty:
        raise ValueError(f"Groups {empty} match no parameter of {list(parameters)}.")
    return list(patterns), joined


def _per_error(weights: Tensor, y: Tensor) -> Tensor:
    return weights.reshape(weights.shape + (1,) * (y.ndim - weights.ndim)).expand_as(y)


def _prior_vector(
    parameters: Mapping[str, Tensor], prior: Mapping[str, Tensor | float] | str | None
) -> Tensor:
    if isinstance(prior, str):
        if prior != "initial":
            raise ValueError(f'`prior` is a mapping, "initial" or None, got {prior!r}.')
        return jac.flatten(parameters).clone()
    given = prior or {}
    unknown = sorted(set(given) - set(parameters))
    if unknown:
        raise ValueError(f"`prior` names {unknown}; trainable are {list(parameters)}.")
    centres = {
        name: torch.zeros_like(value) + given.get(name, 0.0) for name, value in parameters.items()
    }
    return jac.flatten(centres)

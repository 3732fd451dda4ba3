"""Direct search of a cost within bounds: pattern search or sequential quadratic programming.

The papers' way. Every poll, and every gradient, is one batch of candidates.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

from nfriction.papers.afem.pattern_search import PatternSearch, PatternState

SearchMethod = Literal["pattern", "sqp"]
# Forward differences of a smooth simulation: half the digits.
DIFFERENCE = 1e-6
# What a candidate that diverges costs in a gradient, against the start: finite, but beyond all.
DIVERGED = 1e6


@dataclass(frozen=True)
class SearchState:
    """Where a search stands, in plain types, to go on from there.

    Attributes:
        method: `"pattern"` or `"sqp"`.
        vector: best parameter vector.
        value: its cost.
        evaluations: candidates simulated so far.
        pattern: all that a pattern search needs to go on bit for bit; None for SQP, which goes on
            from the vector.
    """

    method: SearchMethod
    vector: list[float]
    value: float
    evaluations: int
    pattern: PatternState | None = None

    def to_dict(self) -> dict[str, Any]:
        """Plain types, ready for JSON."""
        return asdict(self)

    @classmethod
    def from_dict(cls, state: Mapping[str, Any]) -> SearchState:
        """Inverse of `to_dict`, also after a trip through JSON."""
        pattern = state["pattern"]
        known = None if pattern is None else PatternState.from_dict(pattern)
        return cls(**{**state, "pattern": known})


@dataclass(frozen=True)
class SearchResult:
    """Outcome of a search: the best vector, and in words why it ended there."""

    vector: Tensor
    value: float
    converged: bool
    message: str
    iterations: int
    state: SearchState


@dataclass(frozen=True)
class Box:
    """The variables of a search.

    Attributes:
        start, lower, upper: (parameter,); equal bounds keep a parameter as it is.
        scale: a change that counts as large; in decades where logarithmic.
        logarithmic: variables searched by their logarithm, bool.
    """

    start: Tensor
    lower: Tensor
    upper: Tensor
    scale: Tensor
    logarithmic: Tensor

    @property
    def free(self) -> Tensor:
        return self.lower < self.upper

    def whole(self, part: Tensor) -> Tensor:
        """Vectors (m, parameter) from their free variables (m, free)."""
        vectors = self.start.expand(len(part), -1).clone()
        vectors[:, self.free] = part
        return vectors


Callback = Callable[[SearchState], bool | None]


def search(
    cost: Callable[[Tensor], Tensor],
    box: Box,
    method: SearchMethod,
    *,
    max_evaluations: int = 5000,
    tolerance: float = 1e-4,
    seed: int = 0,
    state: SearchState | None = None,
    callback: Callback | None = None,
    progress: bool = False,
) -> SearchResult:
    """Minimise a cost within bounds by pattern search or sequential quadratic programming.

    Args:
        cost: values (m,) of candidates (m, parameter).
        box: start, bounds and scales.
        method: `"pattern"` or `"sqp"`.
        max_evaluations: limit of candidates simulated.
        tolerance: change relative to the scales (pattern) or the cost (SQP) that ends the search.
        seed: of the pattern's rotations.
        state: of an earlier search, to go on from.
        callback: told after every iteration; True stops.
        progress: show a bar (pattern search).

    Raises:
        ValueError: if the state is another search's.
    """
    if state is not None and (state.method != method or len(state.vector) != len(box.start)):
        raise ValueError(
            f"`state` is of {state.method!r} with {len(state.vector)} parameters, the search is "
            f"{method!r} with {len(box.start)}."
        )
    if method == "sqp":
        return _sqp(cost, box, max_evaluations, tolerance, state, callback)
    return _pattern(cost, box, max_evaluations, tolerance, seed, state, callback, progress)


def _pattern(
    cost: Callable[[Tensor], Tensor],
    box: Box,
    max_evaluations: int,
    tolerance: float,
    seed: int,
    state: SearchState | None,
    callback: Callback | None,
    progress: bool,
) -> SearchResult:
    settings = PatternSearch(
        max_evaluations=max_evaluations, mesh_tolerance=tolerance, rotate=True, speculate=True,
        seed=seed,
    )  # fmt: skip
    best: tuple[float, Tensor] = (np.inf, box.start)

    def objective(part: Tensor) -> Tensor:
        nonlocal best
        vectors = box.whole(part)
        values = cost(vectors)
        least = int(values.nan_to_num(np.inf, np.inf).argmin())
        if values[least] < best[0]:
            best = float(values[least]), vectors[least]
        return values

    def told(at: PatternState) -> bool | None:
        return None if callback is None else callback(_state_of(at))

    def _state_of(at: PatternState) -> SearchState:
        kept = PatternState.from_dict(at.to_dict())
        return SearchState("pattern", best[1].tolist(), best[0], at.evaluations, kept)

    if state is not None:
        best = state.value, torch.tensor(state.vector, dtype=box.start.dtype)
    free = box.free
    result = settings.minimise(
        objective, box.start[free], lower=box.lower[free], upper=box.upper[free],
        scale=box.scale[free], logarithmic=box.logarithmic[free].tolist(),
        state=None if state is None else state.pattern, callback=told, progress=progress,
    )  # fmt: skip
    return SearchResult(
        best[1], best[0], result.converged, result.message, result.iterations,
        _state_of(result.state),
    )  # fmt: skip


class _StoppedError(Exception):
    """Leaves SciPy's loop."""


def _sqp(
    cost: Callable[[Tensor], Tensor],
    box: Box,
    max_evaluations: int,
    tolerance: float,
    state: SearchState | None,
    callback: Callback | None,
) -> SearchResult:
    """SciPy's SLSQP with forward differences, every gradient one batch of candidates."""
    from scipy.optimize import minimize  # slow to import

    free = box.free
    log, scale = box.logarithmic[free], box.scale[free]

    def inner(x: Tensor) -> Tensor:
        return torch.where(log, x.clamp_min(1e-300).log10(), x) / scale

    def outer(u: Tensor) -> Tensor:
        x = torch.where(log, 10.0 ** (u * scale), u * scale)
        return box.whole(x.clamp(box.lower[free], box.upper[free]))

    start = box.start if state is None else torch.tensor(state.vector, dtype=box.start.dtype)
    least, best = np.inf, start
    evaluations = 0 if state is None else state.evaluations
    iterations = 0
    reference = float(cost(start[None])[0])

    def values(u: Tensor) -> Tensor:
        nonlocal least, best, evaluations
        vectors = outer(u)
        found = cost(vectors).nan_to_num(np.inf, np.inf)
        evaluations += len(vectors)
        at = int(found.argmin())
        if found[at] < least:
            least, best = float(found[at]), vectors[at]
        # In units of the start, so that the tolerance is relative.
        return (found / reference).clamp_max(DIVERGED)

    def both(u: np.ndarray) -> tuple[float, np.ndarray]:
        point = torch.as_tensor(u)
        # Backward at an upper bound, where forward would not move.
        step = torch.where(point + DIFFERENCE > upper, -DIFFERENCE, DIFFERENCE)
        found = values(torch.cat([point[None], point + torch.diag(step)]))
        return float(found[0]), ((found[1:] - found[0]) / step).numpy()

    def current() -> SearchState:
        return SearchState("sqp", best.tolist(), least, evaluations)

    def told(xk: np.ndarray) -> None:
        nonlocal iterations
        iterations += 1
        if evaluations >= max_evaluations or (callback is not None and callback(current())):
            raise _StoppedError

    lower, upper = inner(box.lower[free]), inner(box.upper[free])
    bounds = list(zip(lower.tolist(), upper.tolist(), strict=True))
    options: Any = {"ftol": 1e-2 * tolerance, "maxiter": 1000}
    try:
        end = minimize(
            both, inner(start[free]).numpy(), jac=True, method="SLSQP", bounds=bounds,
            callback=told, options=options,
        )  # fmt: skip
        converged, message = bool(end.success), str(end.message)
    except _StoppedError:
        converged, message = False, "Stopped by the callback or the limit of evaluations."
    except KeyboardInterrupt:
        converged, message = False, "Interrupted; the best point found is kept."
    return SearchResult(best, least, converged, message, iterations, current())


def available_threads() -> int:
    """Processors that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1

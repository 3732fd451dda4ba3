"""Direct search of a cost within bounds, the papers' way: pattern search or SQP.

Every poll, and every gradient, is one batch of candidates.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from typing import Any, Literal, get_args

import numpy as np
import torch
from torch import Tensor

from nfriction.papers.afem.pattern_search import PatternSearch, PatternState, VariableScaling

SearchMethod = Literal["pattern", "sqp"]
# Forward differences of a smooth simulation: half the digits.
DIFFERENCE = 1e-6
# Cost of a diverged candidate in a gradient, relative to the start: finite, but beyond all others.
DIVERGED = 1e6
# Stands in for zero as the lower bound of a logarithmic variable.
TINY = 1e-300


@dataclass(frozen=True)
class SearchState:
    """An unfinished search in plain types, to resume it.

    Attributes:
        method: `"pattern"` or `"sqp"`.
        vector: best parameter vector.
        value: its cost.
        evaluations: candidates simulated so far.
        pattern: resumes a pattern search bit for bit; None for SQP, which restarts at the vector.
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
class SearchOptions:
    """Settings of a search.

    Attributes:
        method: `"pattern"` search or `"sqp"`.
        horizon: length of the simulated windows [s], restarted from the smoothed motion; None
            simulates each recording in one run, as the papers do. After seconds of chaotic motion
            that is a criterion of luck.
        prior_sd: of an adaptive model, see `fit_adaptive`.
        max_evaluations: limit of candidates simulated.
        tolerance: change relative to the scales (pattern) or the cost (SQP) that ends the search.
        seed: of the pattern's rotations.
        threads: candidates are divided among this many; all processors by default.
        state: of an earlier search, to resume it.
        progress: show a bar (pattern search).

    Raises:
        ValueError: if there is no such method.
    """

    method: SearchMethod = "pattern"
    horizon: float | None = 2.0
    prior_sd: float = 0.5
    max_evaluations: int = 5000
    tolerance: float = 1e-4
    seed: int = 0
    threads: int | None = None
    state: SearchState | None = None
    progress: bool = False

    def __post_init__(self) -> None:
        if self.method not in get_args(SearchMethod):
            raise ValueError(
                f"`method` must be one of {get_args(SearchMethod)}, got {self.method!r}."
            )


@dataclass(frozen=True)
class SearchResult:
    """Outcome of a search: the best vector, and in words why it ended there."""

    vector: Tensor
    value: float
    converged: bool
    message: str
    iterations: int


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
        """Variables that the search may change, bool."""
        return self.lower < self.upper

    def whole(self, part: Tensor) -> Tensor:
        """Vectors (..., parameter) from their free variables (..., free)."""
        vectors = self.start.expand(*part.shape[:-1], -1).clone()
        vectors[..., self.free] = part
        return vectors

    def scaling(self) -> VariableScaling:
        """Of the free variables."""
        free, log = self.free, self.logarithmic
        lower = torch.where(log, self.lower.clamp_min(TINY), self.lower)
        return VariableScaling.build(
            self.start[free], lower[free], self.upper[free], self.scale[free], log[free]
        )


Cost = Callable[[Tensor], Tensor]
Callback = Callable[[SearchState], "bool | None"]


def search(
    cost: Cost, box: Box, options: SearchOptions, callback: Callback | None = None
) -> SearchResult:
    """Minimise a cost within bounds by pattern search or sequential quadratic programming.

    Args:
        cost: values (m,) of candidates (m, parameter).
        box: start, bounds and scales.
        options: method, limits and the state to resume.
        callback: called after every iteration; True stops.

    Raises:
        ValueError: if the state is another search's.
    """
    state = options.state
    if state is not None and (state.method, len(state.vector)) != (options.method, len(box.start)):
        raise ValueError(
            f"`state` is of {state.method!r} with {len(state.vector)} parameters, the search is "
            f"{options.method!r} with {len(box.start)}."
        )
    method = _sqp if options.method == "sqp" else _pattern
    return method(cost, box, options, callback or (lambda _: None))


def _pattern(cost: Cost, box: Box, options: SearchOptions, callback: Callback) -> SearchResult:
    scaling, state = box.scaling(), options.state

    def step(at: PatternState) -> bool | None:
        best = box.whole(scaling.from_unit(scaling.tensor(at.x)))
        kept = PatternState.from_dict(at.to_dict())
        return callback(SearchState("pattern", best.tolist(), at.value, at.evaluations, kept))

    result = PatternSearch(
        max_evaluations=options.max_evaluations, mesh_tolerance=options.tolerance, rotate=True,
        speculate=True, seed=options.seed, progress=options.progress,
    ).minimise(
        lambda part: cost(box.whole(part)), box.start[box.free], lower=scaling.lower,
        upper=scaling.upper, scale=scaling.scale, logarithmic=scaling.logarithmic,
        state=None if state is None else state.pattern, callback=step,
    )  # fmt: skip
    return SearchResult(
        box.whole(result.x), result.value, result.converged, result.message,
        result.state.iterations,
    )  # fmt: skip


class _StoppedError(Exception):
    """Leaves SciPy's loop."""


def _sqp(cost: Cost, box: Box, options: SearchOptions, callback: Callback) -> SearchResult:
    """SciPy's SLSQP with forward differences, every gradient one batch of candidates."""
    from scipy.optimize import minimize  # slow to import

    scaling, state = box.scaling(), options.state
    lower, upper = scaling.to_unit(scaling.lower), scaling.to_unit(scaling.upper)
    start = box.start if state is None else torch.tensor(state.vector, dtype=box.start.dtype)
    least, best, iterations = np.inf, start, 0
    evaluations = 0 if state is None else state.evaluations
    reference = float(cost(start[None])[0])

    def value_and_gradient(u: np.ndarray) -> tuple[float, np.ndarray]:
        nonlocal least, best, evaluations
        point = torch.as_tensor(u)
        # Backward at an upper bound, where forward would not move.
        step = torch.where(point + DIFFERENCE > upper, -DIFFERENCE, DIFFERENCE)
        vectors = box.whole(scaling.from_unit(torch.cat([point[None], point + torch.diag(step)])))
        values = cost(vectors).nan_to_num(np.inf, np.inf)
        evaluations += len(vectors)
        at = int(values.argmin())
        if values[at] < least:
            least, best = float(values[at]), vectors[at]
        # In units of the start, so that the tolerance is relative.
        values = (values / reference).clamp_max(DIVERGED)
        return float(values[0]), ((values[1:] - values[0]) / step).numpy()

    def step(xk: np.ndarray) -> None:
        nonlocal iterations
        iterations += 1
        at = SearchState("sqp", best.tolist(), least, evaluations)
        if evaluations >= options.max_evaluations or callback(at):
            raise _StoppedError

    settings: Any = {"ftol": 1e-2 * options.tolerance, "maxiter": 1000}
    try:
        end = minimize(
            value_and_gradient, scaling.to_unit(start[box.free]).numpy(), jac=True, method="SLSQP",
            bounds=list(zip(lower.tolist(), upper.tolist(), strict=True)), callback=step,
            options=settings,
        )  # fmt: skip
        converged, message = bool(end.success), str(end.message)
    except _StoppedError:
        converged, message = False, "Stopped by the callback or the limit of evaluations."
    except KeyboardInterrupt:
        converged, message = False, "Interrupted; the best point found is kept."
    return SearchResult(best, least, converged, message, iterations)


def available_threads() -> int:
    """Processors that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1

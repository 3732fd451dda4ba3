"""Fits by direct search of the simulated position, the papers' way: pattern search or SQP.

Every poll, and every gradient, is one batch of simulated candidates.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Literal, get_args

import numpy as np
import torch
from torch import Tensor

from nfriction.fitting.data.inputs import integration_substeps
from nfriction.fitting.data.windows import cut_windows
from nfriction.fitting.equation_error import coefficient_scale
from nfriction.fitting.fit import FitTask, prepare_task
from nfriction.fitting.options import FitOptions, Method
from nfriction.fitting.result.fit_result import FitResult
from nfriction.fitting.shooting.autocorrelation import effective_noise
from nfriction.fitting.strategy.constant import constant_start, fit_constant
from nfriction.friction.coefficients import Constant, Tabulated
from nfriction.friction.models import FrictionModel
from nfriction.papers.afem.adaptive import Adaptive
from nfriction.papers.afem.classes import DEFAULTS, ClassOptions
from nfriction.papers.afem.fit_adaptive import like_start
from nfriction.papers.afem.given_classes import ClassFit, PositionError
from nfriction.papers.afem.pattern_search import PatternSearch, PatternState, VariableScaling
from nfriction.plant import Plant
from nfriction.recording import Recording
from nfriction.signals import Motion

SearchMethod = Literal["pattern", "sqp"]
# Forward differences of a smooth simulation: half the digits.
DIFFERENCE = 1e-6
# Cost of a diverged candidate in a gradient, relative to the start: finite, but beyond all others.
DIVERGED = 1e6
# Lower bound of a logarithmic variable, in place of zero.
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
        """Scaling of the free variables."""
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
        # A copy: the live state changes with the next iteration.
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
    value, iterations = result.state.value, result.state.iterations
    return SearchResult(box.whole(result.x), value, result.converged, result.message, iterations)


# SLSQP ignores the result of its callback; only an exception ends it.
class _StoppedError(Exception):
    """Leaves SciPy's loop."""


def _sqp(cost: Cost, box: Box, options: SearchOptions, callback: Callback) -> SearchResult:
    """SciPy's SLSQP with forward differences, every gradient one batch of candidates."""
    from scipy.optimize import minimize  # slow to import

    scaling, state = box.scaling(), options.state
    lower, upper = scaling.to_unit(scaling.lower), scaling.to_unit(scaling.upper)
    start = box.start if state is None else torch.tensor(state.vector, dtype=box.start.dtype)
    # SLSQP returns its last iterate, which need not be the best point that it evaluated.
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
        # SciPy limits iterations, but simulations are what takes time.
        if evaluations >= options.max_evaluations or callback(at):
            raise _StoppedError

    # SLSQP tests the change of one step, which is smaller than the distance to the minimum.
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


def fit_by_search(
    model: FrictionModel,
    plant: Plant,
    recordings: Recording | Sequence[Recording],
    *,
    options: SearchOptions = SearchOptions(),
    classes: ClassOptions = DEFAULTS,
    start: FitResult | None = None,
    motions: Sequence[Motion] | None = None,
    callback: Callback | None = None,
) -> FitResult:
    """Fit constant or adaptive coefficients by direct search of the simulation's position error.

    Args:
        model: a model with constant or adaptive coefficients; changed in place.
        plant: the mechanism as given; where `start` is given, as it left it.
        recordings: one or several.
        options: method, windows and limits.
        classes: of an adaptive model, see `fit_adaptive`.
        start: fit to start from; of the constant law for an adaptive model. By default the
            constant coefficients that the torques imply (adaptive: the trajectory fit).
        motions: smoothed motions in joint coordinates.
        callback: called after every iteration; True stops.

    Returns:
        The fit.

    Raises:
        ValueError: if the model's coefficients are neither constant nor adaptive, or recordings
            and plant do not match.

    References:
        Second paper: NCFM by sequential quadratic programming, LFM and NLFM by pattern search,
        on 80 s; TLRIP paper, AFEM.
    """
    schedule = model.schedule
    if not isinstance(schedule, Constant | Adaptive):
        raise ValueError(
            f"a search fits constant or adaptive coefficients, not {type(schedule).__name__}."
        )
    # Constants start from the torques, which cost no simulation; classes need a motion to follow.
    method: Method = "output_error" if schedule.follows_motion else "equation_error"
    asked = like_start(FitOptions(method), start)
    task = prepare_task(model, plant, recordings, asked, start, motions)
    longest = max(float(r.time[-1] - r.time[0]) for r in task.recordings)
    length, by_class, varied = options.horizon or longest, None, model
    table: Tabulated = schedule
    if isinstance(schedule, Adaptive):
        constant = constant_start(task)
        by_class = ClassFit.of(task, schedule, constant, length, classes)
        task, varied, windows = by_class.task, by_class.given, by_class.windows
        table = by_class.table
    else:
        constant = start or fit_constant(task)
        schedule.set_coefficients(constant.model.schedule.coefficient_sets()["always"])
        windows = cut_windows(task.recordings, task.motions, length)
    step = max(r.longest_step for r in task.recordings)
    error = PositionError(
        constant.plant, varied, windows, task.measurement,
        integration_substeps(plant, varied, step), threads=options.threads or available_threads(),
        drive=None if by_class is None else by_class.drive(),
    )  # fmt: skip
    box = _box(table, varied, constant, task)
    # Errors of the start set the weight of the prior; those of the end are not known yet.
    first = error.residuals(table.parameter_vector())
    noise = effective_noise(first.nan_to_num(1.0, 1.0, -1.0))
    mean, sd = table.prior()

    def cost(vectors: Tensor) -> Tensor:
        data = error.mean_square(vectors) * (error.values / noise**2)
        return 0.5 * (data + ((vectors - mean) / sd).square().sum(-1))

    result = search(cost, box, options, callback)
    table.set_parameter_vector(result.vector)
    names = table.parameter_names(plant.joint_names)
    hit = box.free & ((result.vector <= box.lower) | (result.vector >= box.upper))
    found = FitResult(
        model=model.requires_grad_(False),
        plant=constant.plant,
        plant_terms=constant.plant_terms,
        status=("Converged: " if result.converged else "Not converged: ") + result.message,
        converged=result.converged,
        residual=float(error.mean_square(result.vector[None])[0].sqrt()),
        at_bounds=tuple(n for n, h in zip(names, hit.tolist(), strict=True) if h),
        steps=result.iterations,
        motions=task.motions,
        residuals=error.residuals(result.vector),
    )
    if by_class is None:
        return found
    return by_class.backtracked(found, windows, float(error.mean_square(mean[None])[0].sqrt()))


def _box(table: Tabulated, model: FrictionModel, constant: FitResult, task: FitTask) -> Box:
    """Variables of a search, scaled by the natural size of each coefficient."""
    values = table.values
    natural = coefficient_scale(model, constant.plant, task.recordings, task.motions)
    natural = natural.reshape(len(natural), *(1,) * (values.ndim - 2), -1)
    log = torch.tensor([not c.linear for c in model.law.coefficients]).expand_as(values)
    scale = torch.maximum(values.abs(), natural)
    # A coefficient that is searched over decades moves by one of them.
    scale = torch.where(log | (scale == 0), 1.0, scale)
    lower, upper = table.bounds()
    return Box(table.parameter_vector(), lower, upper, scale.reshape(-1), log.reshape(-1))


def available_threads() -> int:
    """Processors that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1

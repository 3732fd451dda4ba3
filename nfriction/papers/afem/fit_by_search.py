"""Fits by direct search of the simulated position, the papers' way: pattern search or SQP.

Every poll, and every gradient, is one batch of simulated candidates.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, get_args

import numpy as np
import torch
from torch import Tensor

from nfriction.fitting.data.inputs import integration_substeps
from nfriction.fitting.data.windows import cut_windows
from nfriction.fitting.equation_error import coefficient_scale
from nfriction.fitting.options import FitOptions, Method
from nfriction.fitting.result.fit_result import FitResult
from nfriction.fitting.shooting.autocorrelation import effective_noise
from nfriction.fitting.strategy.constant import constant_start, fit_constant
from nfriction.fitting.strategy.continuation import loglik_tolerance
from nfriction.fitting.task import FitTask, prepare_task
from nfriction.friction.coefficients import Constant, Tabulated
from nfriction.friction.models import FrictionModel
from nfriction.optim import bounded_qp
from nfriction.optim.least_squares import Quadratic
from nfriction.papers.afem.adaptive import Adaptive
from nfriction.papers.afem.classes import DEFAULTS, ClassOptions
from nfriction.papers.afem.fit_adaptive import ClassFit, PositionError, along, like_start
from nfriction.plant import Plant
from nfriction.recording import Recording
from nfriction.signals import Motion

SearchMethod = Literal["pattern", "sqp"]
# Initial mesh of a pattern search, and its factor after a poll without a better point.
INITIAL_MESH, CONTRACTION = 0.25, 0.5
# Damping of the candidates from a local quadratic, relative to its curvature.
DAMPINGS = tuple(10.0**-power for power in range(8))
# Step of forward differences of a smooth simulation: half the digits.
DIFFERENCE = 1e-6
# Cost of a diverged candidate in a gradient, relative to the start: finite, but above all others.
DIVERGED = 1e6
# Lower bound of a logarithmic variable, instead of zero.
TINY = 1e-300
CONVERGED = "No poll point is better and the mesh is as fine as asked for."
LIMIT = "The limit of evaluations was reached."
STOPPED = "Stopped by the callback or by an interrupt; the best point found is kept."


@dataclass(frozen=True)
class SearchState:
    """An unfinished search in plain, JSON-compatible types, from which it can be resumed.

    A pattern search continues bit for bit; SQP restarts at the best point.
    """

    method: SearchMethod
    point: list[float]  # best point, in the search's coordinates (see `Box`)
    value: float  # its cost; infinite before the first evaluation
    evaluations: int  # candidates simulated so far
    iterations: int = 0
    mesh: float = INITIAL_MESH  # size of that of a pattern search, in the same coordinates
    step: Sequence[float] = ()  # last move of a pattern search; zero if the last poll found none


@dataclass(frozen=True)
class SearchOptions:
    """Settings of a search.

    Attributes:
        method: `"pattern"` search or `"sqp"`.
        horizon: length of the simulated windows [s], restarted from the smoothed motion; None
            simulates each recording in one run, as in the papers. After seconds of chaotic motion
            the outcome of that is a matter of luck.
        max_evaluations: limit on simulated candidates.
        tolerance: change relative to the scales (pattern) or the cost (SQP) that ends the search.
        seed: for the rotations of the pattern.
        threads: number of threads for the candidates; all processors by default.

    Raises:
        ValueError: if there is no such method, or the tolerance is not positive.
    """

    method: SearchMethod = "pattern"
    horizon: float | None = 2.0
    max_evaluations: int = 5000
    tolerance: float = 1e-4
    seed: int = 0
    threads: int | None = None
    state: SearchState | None = None

    def __post_init__(self) -> None:
        if self.method not in get_args(SearchMethod):
            raise ValueError(
                f"`method` must be one of {get_args(SearchMethod)}, got {self.method!r}."
            )
        if not self.tolerance > 0:
            raise ValueError(f"`tolerance` must be positive, got {self.tolerance}.")


@dataclass(frozen=True)
class SearchResult:
    """Outcome of a search: the best vector, its cost, and the reason for termination in words."""

    vector: Tensor
    value: float
    converged: bool
    message: str
    iterations: int


@dataclass(frozen=True, eq=False)
class Box:
    """The variables of a search, and their map to its internal coordinates of order 1."""

    start: Tensor
    lower: Tensor  # (parameter,); equal bounds fix a parameter
    upper: Tensor
    scale: Tensor  # a typical large change; in decades if logarithmic
    logarithmic: Tensor  # variables searched by their logarithm, bool; they must be positive

    @property
    def free(self) -> Tensor:
        """Variables that the search may change, bool."""
        return self.lower < self.upper

    @property
    def ends(self) -> tuple[Tensor, Tensor]:
        """Lower and upper bounds in the search's coordinates, (free,)."""
        return self.to_unit(self.lower), self.to_unit(self.upper)

    def to_unit(self, vector: Tensor) -> Tensor:
        """The search's coordinates (free,) of a vector (parameter,)."""
        x, log = vector[self.free], self.logarithmic[self.free]
        return torch.where(log, x.clamp_min(TINY).log10(), x) / self.scale[self.free]

    def from_unit(self, points: Tensor) -> Tensor:
        """Vectors (..., parameter) of points (..., free) in the search's coordinates."""
        free, (low, high) = self.free, self.ends
        log, lower, upper = self.logarithmic[free], self.lower[free], self.upper[free]
        lower = torch.where(log, lower.clamp_min(TINY), lower)
        x = points * self.scale[free]
        x = torch.where(log, 10.0**x, x).clamp(lower, upper)
        # A variable at its bound is exactly there, however the logarithm is rounded.
        x = torch.where(points <= low, lower, x)
        x = torch.where(points >= high, upper, x)
        vectors = self.start.expand(*points.shape[:-1], -1).clone()
        vectors[..., free] = x
        return vectors


Cost = Callable[[Tensor], Tensor]
Residuals = Callable[[Tensor], Iterable[Tensor]]
Callback = Callable[[SearchState], "bool | None"]


def search(
    cost: Cost,
    box: Box,
    options: SearchOptions,
    callback: Callback | None = None,
    residuals: Residuals | None = None,
    negligible: float = 0.0,
) -> SearchResult:
    """Minimise a cost within bounds by pattern search or sequential quadratic programming.

    Args:
        cost: values (m,) of candidates (m, parameter); values that are not finite are rejected.
        callback: called after every iteration; stops the search by returning True.
        residuals: of candidates (m, parameter), in parts (m, n) whose squares add up to twice the
            cost; a pattern search then also tries steps from the quadratic model of these.
        negligible: relative decrease of the cost that a pattern search treats as zero.

    Raises:
        ValueError: if the state belongs to a different search.
    """
    state, size = options.state, int(box.free.sum())
    if state is not None and (state.method, len(state.point)) != (options.method, size):
        raise ValueError(
            f"`state` is of {state.method!r} with {len(state.point)} variables, the search is "
            f"{options.method!r} with {size}."
        )
    callback = callback or (lambda _: None)
    if options.method == "sqp":
        return _sqp(cost, box, options, callback)
    return _pattern(cost, box, options, callback, residuals, negligible)


def _pattern(
    cost: Cost,
    box: Box,
    options: SearchOptions,
    callback: Callback,
    residuals: Residuals | None,
    negligible: float,
) -> SearchResult:
    """Generalised pattern search; every poll is one batch of candidates.

    An iteration polls x ± mesh along every axis and one point beyond x along the last successful
    step. It moves to the best of these, doubles the mesh if that is better than x by more than is
    negligible, else contracts it. Points outside the bounds are moved onto them. The axes are
    turned at random in every iteration, so that a ridge or a kink askew to them cannot stop the
    search. Of residuals it knows the local quadratic, whose damped minima are candidates, and in
    whose metric it polls: a mesh of m then changes the cost by about m^2 of itself.

    References:
        V. Torczon, SIAM J. Optim. 7 (1997); C. Audet and J. E. Dennis, SIAM J. Optim. 17 (2006);
        A. J. Booker et al., Struct. Optim. 17 (1999), on candidates from a model of the cost;
        T. G. Kolda, R. M. Lewis, V. Torczon, SIAM Review 45 (2003), on sufficient decrease.
    """
    start = box.to_unit(box.start.clamp(box.lower, box.upper))
    state = options.state or SearchState(
        "pattern", start.tolist(), math.inf, 0, step=[0.0] * len(start)
    )
    message = CONVERGED
    local, trials, poll = None, 0 if residuals is None else len(DAMPINGS), 2 * len(start) + 1
    try:
        if state.evaluations == 0:
            value = _values(cost, box, box.start.new_tensor(state.point)[None])[0]
            state = replace(state, value=float(value), evaluations=1)
        finest = max(options.tolerance, math.sqrt(negligible))
        while state.mesh >= finest:
            moved = residuals is not None and (state.iterations == 0 or any(state.step))
            most = poll + trials + moved * (len(start) + 1)
            # A partial poll would depend on the limit, and a resumed search would differ from an
            # uninterrupted one.
            if state.evaluations + most > options.max_evaluations:
                message = LIMIT
                break
            if residuals is not None and (moved or local is None):
                local = local_quadratic(residuals, box, box.start.new_tensor(state.point))
            state = _polled(cost, box, state, options.seed, local, negligible)
            state = replace(state, evaluations=state.evaluations + moved * (len(start) + 1))
            if callback(state):
                message = STOPPED
                break
    except KeyboardInterrupt:
        message = STOPPED
    if not math.isfinite(state.value) and message == CONVERGED:
        message = "The cost is finite nowhere that was tried."
    vector = box.from_unit(box.start.new_tensor(state.point))
    return SearchResult(vector, state.value, message == CONVERGED, message, state.iterations)


def local_quadratic(residuals: Residuals, box: Box, x: Tensor) -> Quadratic | None:
    """Quadratic of a cost near a point (free,) by forward differences; None if it diverges.

    A Gauss-Newton model: without second derivatives of the residuals.
    """
    # Backward at an upper bound, where forward would not move.
    step = torch.where(x + DIFFERENCE > box.ends[1], -DIFFERENCE, DIFFERENCE)
    zero = torch.zeros((), dtype=x.dtype)
    cost, gradient, hessian = zero, zero, zero
    for part in residuals(box.from_unit(torch.cat([x[None], x + torch.diag(step)]))):
        first, slopes = part[0], (part[1:] - part[0]) / step[:, None]
        cost = cost + 0.5 * first.square().sum()
        gradient, hessian = gradient + slopes @ first, hessian + slopes @ slopes.mT
    local = Quadratic(cost, gradient, hessian)
    return local if local.finite else None


def _steps(local: Quadratic, low: Tensor, high: Tensor) -> tuple[Tensor, Tensor]:
    """Shape of the polls (free, free), and minima of the quadratic in bounds (damping, free)."""
    values, axes = torch.linalg.eigh(local.hessian)
    # A poll steps far along a valley of the cost and little across it: to the points where the
    # squared errors double.
    reach = (2 * local.cost / values.clamp_min(TINY)).sqrt().clamp_max(1.0)
    inside = (low < 0) & (high > 0)
    diagonal = local.hessian.diagonal().clamp_min(TINY)
    trials = [
        bounded_qp.minimise(
            local.hessian + torch.diag(damping * diagonal), local.gradient, low, high, inside,
            lambda matrix, right, _: bounded_qp.solve_semidefinite(matrix, right),
        )
        for damping in DAMPINGS
    ]  # fmt: skip
    return axes * reach @ axes.mT, torch.stack(trials)


def _polled(
    cost: Cost, box: Box, state: SearchState, seed: int, local: Quadratic | None, negligible: float
) -> SearchState:
    x, last = box.start.new_tensor(state.point), box.start.new_tensor(state.step)
    # A separate generator per iteration, so a resumed search needs no generator state.
    random = torch.Generator().manual_seed(seed * 1_000_003 + state.iterations)
    axes, triangle = torch.linalg.qr(
        torch.randn(len(x), len(x), generator=random, dtype=torch.float64)
    )
    # The sign makes the factorisation unique and thus the rotations uniformly distributed.
    axes = axes * triangle.diagonal().sign()
    low, high = box.ends
    steps, trials = state.mesh * torch.cat([axes, -axes]), axes[:0]
    if local is not None:
        shape, trials = _steps(local, low - x, high - x)
        steps = steps @ shape
    # The direction of the last success comes first, so ties continue in the same direction.
    steps = steps[(steps @ last).argsort(descending=True, stable=True)]
    # Projected, not rejected: a minimum at a bound is approached along it.
    candidates = (x + torch.cat([last[None], steps, trials])).clamp(low, high)
    values = _values(cost, box, candidates)
    best = int(values.argmin())
    better = bool(values[best] < state.value)
    success = better and not values[best] >= (1.0 - negligible) * state.value
    return replace(
        state,
        point=candidates[best].tolist() if better else state.point,
        value=float(values[best]) if better else state.value,
        # A direction that failed once must not be preferred.
        step=(candidates[best] - x).tolist() if better else [0.0] * len(x),
        # A mesh larger than the range of the variables would only poll the bounds.
        mesh=min(2.0 * state.mesh, 1.0) if success else CONTRACTION * state.mesh,
        evaluations=state.evaluations + len(candidates),
        iterations=state.iterations + 1,
    )


def _values(cost: Cost, box: Box, points: Tensor) -> Tensor:
    values = cost(box.from_unit(points))
    return torch.where(torch.isfinite(values), values, math.inf)


# SLSQP ignores the result of its callback; only an exception ends it.
class _StoppedError(Exception):
    """Raised to leave SciPy's loop."""


def _sqp(cost: Cost, box: Box, options: SearchOptions, callback: Callback) -> SearchResult:
    """SciPy's SLSQP with forward differences; every gradient is one batch of candidates."""
    from scipy.optimize import minimize  # slow to import

    (lower, upper), state = box.ends, options.state
    vector = box.start if state is None else box.from_unit(box.start.new_tensor(state.point))
    reference, start = float(cost(vector[None])[0]), box.to_unit(vector)
    # SLSQP returns its last iterate, which need not be the best point that it evaluated.
    least, best, iterations = math.inf, start, 0
    evaluations = 0 if state is None else state.evaluations

    def value_and_gradient(u: np.ndarray) -> tuple[float, np.ndarray]:
        nonlocal least, best, evaluations
        point = torch.as_tensor(u)
        # Backward at an upper bound, where forward would not move.
        step = torch.where(point + DIFFERENCE > upper, -DIFFERENCE, DIFFERENCE)
        points = torch.cat([point[None], point + torch.diag(step)])
        values = cost(box.from_unit(points)).nan_to_num(math.inf, math.inf)
        evaluations += len(points)
        at = int(values.argmin())
        if values[at] < least:
            least, best = float(values[at]), points[at]
        # In units of the start, so that the tolerance is relative.
        values = (values / reference).clamp_max(DIVERGED)
        return float(values[0]), ((values[1:] - values[0]) / step).numpy()

    def step(xk: np.ndarray) -> None:
        nonlocal iterations
        iterations += 1
        state = SearchState("sqp", best.tolist(), least, evaluations, iterations)
        # SciPy limits iterations, but the simulations take the time.
        if evaluations >= options.max_evaluations or callback(state):
            raise _StoppedError

    # SLSQP tests the change in one step, which is smaller than the distance to the minimum.
    settings: Any = {"ftol": 1e-2 * options.tolerance, "maxiter": 1000}
    try:
        end = minimize(
            value_and_gradient, start.numpy(), jac=True, method="SLSQP", callback=step,
            bounds=list(zip(lower.tolist(), upper.tolist(), strict=True)), options=settings,
        )  # fmt: skip
        converged, message = bool(end.success), str(end.message)
    except (_StoppedError, KeyboardInterrupt):
        converged = False
        message = LIMIT if evaluations >= options.max_evaluations else STOPPED
    return SearchResult(box.from_unit(best), least, converged, message, iterations)


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
        plant: the mechanism as given, or as fitted by `start` if that is given.
        options: method, windows and limits.
        classes: of an adaptive model, see `fit_adaptive`.
        start: fit to start from; for an adaptive model, that of the constant law. By default the
            constant coefficients that the torques imply (adaptive: the output-error fit).
        motions: smoothed motions in joint coordinates.
        callback: called after every iteration; True stops.

    Returns:
        The fit; check `converged` and `status`.

    Raises:
        ValueError: if the model's coefficients are neither constant nor adaptive, or recordings
            and plant do not match.

    References:
        RTIP paper: NCFM by sequential quadratic programming, LFM and NLFM by pattern search, on
        80 s; TLRIP paper, AFEM.
    """
    schedule = model.schedule
    if not isinstance(schedule, Constant | Adaptive):
        raise ValueError(
            f"a search fits constant or adaptive coefficients, not {type(schedule).__name__}."
        )
    # Constants start from the torques, which needs no simulation; classes must follow a motion.
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
        constant = task.start or fit_constant(task)
        schedule.set_coefficients(constant.model.schedule.coefficient_sets()["always"])
        windows = cut_windows(task.recordings, task.motions, length)
    step = max(r.longest_step for r in task.recordings)
    limited = hasattr(os, "sched_getaffinity")
    usable = len(os.sched_getaffinity(0)) if limited else os.cpu_count() or 1
    error = PositionError(
        constant.plant, varied, windows, task.measurement,
        integration_substeps(plant, varied, step), threads=options.threads or usable,
        drive=None if by_class is None else along(windows, by_class.driving),
    )  # fmt: skip
    box = _box(table, varied, constant, task)
    objective = _Objective.of(error, table)
    # The noise is that of the start, so the cost there sets the scale of the log likelihood.
    negligible = loglik_tolerance(float(objective.cost(box.start[None])), asked)
    result = search(objective.cost, box, options, callback, objective.residuals, negligible)
    table.set_parameter_vector(result.vector)
    names = table.parameter_names(plant.joint_names)
    residuals = error.residuals(result.vector)
    hit = box.free & ((result.vector <= box.lower) | (result.vector >= box.upper))
    found = FitResult(
        model=model.requires_grad_(False),
        plant=constant.plant,
        plant_terms=constant.plant_terms,
        status=("Converged: " if result.converged else "Not converged: ") + result.message,
        converged=result.converged,
        residual=error.rms(residuals),
        at_bounds=tuple(n for n, h in zip(names, hit.tolist(), strict=True) if h),
        steps=result.iterations,
        motions=task.motions,
        residuals=residuals,
    )
    if by_class is not None:
        baseline = error.rms(error.residuals(objective.mean))
        found = by_class.backtracked(found, windows, baseline)
    return found.with_terms_times(task.ratios)


@dataclass(frozen=True, eq=False)
class _Objective:
    """Negative log posterior of a table's parameters: position errors over noise, and prior."""

    error: PositionError
    noise: float  # from the errors at the start; those at the end are unknown
    mean: Tensor  # of the prior, (parameter,)
    sd: Tensor

    @classmethod
    def of(cls, error: PositionError, table: Tabulated) -> _Objective:
        """The objective around the current values of the table."""
        first = error.residuals(table.parameter_vector())
        return cls(error, effective_noise(first.nan_to_num(1.0, 1.0, -1.0)), *table.prior())

    def residuals(self, vectors: Tensor) -> Iterator[Tensor]:
        """Parts (m, n) of the residuals of candidates (m, parameter)."""
        for part in self.error.parts(vectors):
            yield part.flatten(1) / self.noise
        yield (vectors - self.mean) / self.sd

    def cost(self, vectors: Tensor) -> Tensor:
        """Half the squared residuals of candidates (m, parameter), (m,)."""
        parts = (part.square().sum(-1) for part in self.residuals(vectors))
        return 0.5 * sum(parts, torch.zeros(()))


def _box(table: Tabulated, model: FrictionModel, constant: FitResult, task: FitTask) -> Box:
    """Variables of a search, scaled by the natural size of each coefficient."""
    values = table.values
    natural = coefficient_scale(model, constant.plant, task.recordings, task.motions)
    natural = natural.reshape(len(natural), *(1,) * (values.ndim - 2), -1)
    log = torch.tensor([not c.linear for c in model.law.coefficients]).expand_as(values)
    scale = torch.maximum(values.abs(), natural)
    # A logarithmic coefficient has a scale of one decade.
    scale = torch.where(log | (scale == 0), 1.0, scale)
    lower, upper = table.bounds()
    return Box(table.parameter_vector(), lower, upper, scale.reshape(-1), log.reshape(-1))

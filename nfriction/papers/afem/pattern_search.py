"""Generalised pattern search: bounded minimisation without derivatives, a poll as one batch."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any, Literal

import torch
from torch import Tensor
from tqdm.auto import tqdm

Status = Literal["mesh_tolerance", "max_evaluations", "not_finite", "stopped"]

MESSAGES: dict[str, str] = {
    "mesh_tolerance": "No poll point is better and the mesh is as fine as asked for.",
    "max_evaluations": "The limit of evaluations was reached before the mesh was fine enough.",
    "not_finite": "The objective is finite nowhere that was tried.",
    "stopped": "Stopped by the callback or by an interrupt; `x` is the best point found.",
}

Objective = Callable[[Tensor], Tensor]


@dataclass(frozen=True, eq=False)
class VariableScaling:
    """Map between the caller's variables and those of a search, which are of order 1.

    Attributes:
        lower, upper: bounds, (d,).
        scale: a change of each variable that counts as large; in decades where logarithmic.
        logarithmic: variables searched by their logarithm, bool.
    """

    lower: Tensor
    upper: Tensor
    scale: Tensor
    logarithmic: Tensor

    @classmethod
    def build(
        cls,
        x0: Tensor,
        lower: Tensor | float = -math.inf,
        upper: Tensor | float = math.inf,
        scale: Tensor | float | None = None,
        logarithmic: Tensor | Sequence[bool] | bool = False,
    ) -> VariableScaling:
        """The scaling of a search from `x0`; see `PatternSearch.minimise`."""
        if x0.ndim != 1 or len(x0) == 0 or not x0.is_floating_point():
            raise ValueError(
                f"`x0` must be a vector of floats, got {x0.dtype} of shape {tuple(x0.shape)}."
            )

        def vector(name: str, value: Any, dtype: torch.dtype = x0.dtype) -> Tensor:
            given = torch.as_tensor(value, dtype=dtype, device=x0.device)
            if given.shape not in ((), x0.shape):
                raise ValueError(
                    f"`{name}` must be one value or {len(x0)}, got shape {tuple(given.shape)}."
                )
            return given.expand_as(x0)

        low, high = vector("lower", lower), vector("upper", upper)
        log = vector("logarithmic", logarithmic, torch.bool)
        if not (low <= high).all():
            raise ValueError("`lower` must not exceed `upper`, and neither may be NaN.")
        start = x0.detach().clamp(low, high)
        if not torch.isfinite(start).all() or (log & (start <= 0)).any():
            raise ValueError(
                f"`x0` must be finite, and positive where logarithmic, got {x0.tolist()}."
            )
        # A lower bound of zero is no bound to a logarithm.
        unbounded = log & (low <= 0)
        low = torch.where(unbounded, -math.inf, low)
        # The width of an unbounded variable must come out as NaN, so that the default applies.
        unit = cls(low, high, torch.ones_like(start), log)
        width = unit.to_unit(high) - unit.to_unit(torch.where(unbounded, torch.nan, low))
        default = torch.where(log | (start == 0), 1.0, start.abs())
        usable = torch.isfinite(width) & (width > 0)
        chosen = torch.where(usable, width, default) if scale is None else vector("scale", scale)
        if not (torch.isfinite(chosen) & (chosen > 0)).all():
            raise ValueError(f"`scale` must be positive and finite, got {chosen.tolist()}.")
        return cls(low, high, chosen, log)

    def to_unit(self, x: Tensor) -> Tensor:
        """The search's variables from the caller's."""
        return torch.where(self.logarithmic, x.log10(), x) / self.scale

    def from_unit(self, u: Tensor) -> Tensor:
        """The caller's variables from the search's, within the bounds."""
        x = u * self.scale
        x = torch.where(self.logarithmic, 10.0**x, x).clamp(self.lower, self.upper)
        # A variable at its bound is there to the last bit, however the logarithm is rounded.
        x = torch.where(u <= self.to_unit(self.lower), self.lower, x)
        return torch.where(u >= self.to_unit(self.upper), self.upper, x)

    def project(self, u: Tensor) -> Tensor:
        """The nearest point within the bounds, in the search's variables."""
        low = torch.where(self.lower == -math.inf, -math.inf, self.to_unit(self.lower))
        return u.clamp(low, self.to_unit(self.upper))

    def tensor(self, values: list[float]) -> Tensor:
        """Numbers of a `PatternState` as a tensor."""
        return torch.tensor(values, dtype=self.scale.dtype, device=self.scale.device)


@dataclass(eq=True)
class PatternState:
    """Everything that a search needs to continue bit for bit, in plain types.

    Args:
        x: best point, in the search's variables.
        value: objective there; infinite before the first evaluation.
        mesh: mesh size in the same units.
        last_step: the last successful move, zero if there was none.
        evaluations, iterations: counts so far.
        history: (evaluations, value, mesh) after each iteration.
    """

    x: list[float]
    value: float
    mesh: float
    last_step: list[float]
    evaluations: int = 0
    iterations: int = 0
    history: list[tuple[int, float, float]] = field(default_factory=list)

    def to_dict(self) -> dict[str, Any]:
        """Plain types, ready for JSON."""
        return asdict(self)

    @classmethod
    def from_dict(cls, state: Mapping[str, Any]) -> PatternState:
        """Inverse of `to_dict`, also after a trip through JSON."""
        known = {**state, "history": [tuple(entry) for entry in state["history"]]}
        return cls(**known)


@dataclass(frozen=True, eq=False)
class PatternResult:
    """Outcome of a pattern search.

    Args:
        x: best point, shape (d,), in the caller's units.
        status: why the search ended; `message` says it in words.
        state: value, counts and history; resumes the search.
    """

    x: Tensor
    status: Status
    state: PatternState

    @property
    def converged(self) -> bool:
        """True if the mesh was refined to its tolerance without finding a better point."""
        return self.status == "mesh_tolerance"

    @property
    def message(self) -> str:
        """The status in words."""
        return MESSAGES[self.status]


Callback = Callable[[PatternState], "bool | None"]


@dataclass(frozen=True)
class PatternSearch:
    """Settings of a generalised pattern search.

    Each iteration polls x ± mesh along every axis in one call of the objective, moves to the best
    point and doubles the mesh if that is better than x, else contracts the mesh. Points outside the
    bounds are moved onto them; those that coincide with x are still evaluated, so that every call
    has the same number of rows.

    Args:
        max_evaluations: limit of points evaluated; a call that would pass it is not made.
        mesh_tolerance: mesh size, relative to the range of each variable, that ends the search.
        initial_mesh: first mesh size, in the same units.
        contraction: factor of the mesh after a failure.
        rotate: turn the axes at random in every iteration (seeded), as mesh-adaptive search does,
            so that a ridge or a kink askew to the axes cannot stop it.
        speculate: add one point beyond x along the last successful step to each poll.
        seed: of the rotations.
        progress: show a bar of evaluations.

    References:
        V. Torczon, SIAM J. Optim. 7 (1997); C. Audet and J. E. Dennis, SIAM J. Optim. 17 (2006).
    """

    max_evaluations: int = 10_000
    mesh_tolerance: float = 1e-6
    initial_mesh: float = 0.25
    contraction: float = 0.5
    rotate: bool = False
    speculate: bool = False
    seed: int = 0
    progress: bool = False

    def __post_init__(self) -> None:
        if not 0 < self.contraction < 1:
            raise ValueError(f"`contraction` must be between 0 and 1, got {self.contraction}.")
        if not (self.mesh_tolerance > 0 and self.initial_mesh > 0):
            raise ValueError(
                "`mesh_tolerance` and `initial_mesh` must be positive, got "
                f"{self.mesh_tolerance} and {self.initial_mesh}."
            )

    def poll_size(self, dimension: int) -> int:
        """Points in each call of the objective after the first (which has one)."""
        return 2 * dimension + self.speculate

    def minimise(
        self,
        objective: Objective,
        x0: Tensor,
        *,
        lower: Tensor | float = -math.inf,
        upper: Tensor | float = math.inf,
        scale: Tensor | float | None = None,
        logarithmic: Tensor | Sequence[bool] | bool = False,
        state: PatternState | None = None,
        callback: Callback | None = None,
    ) -> PatternResult:
        """Minimise from `x0`.

        Args:
            objective: values (m,) of candidates (m, d), all of a poll at once; a value that is
                not finite rejects its candidate.
            x0: start, shape (d,); projected into the bounds.
            lower, upper: bounds, shape (d,) or a number.
            scale: the change of each variable that counts as large, positive; by default the
                range between the bounds, else the size of x0, else 1. In decades for
                logarithmic variables.
            logarithmic: variables searched by their logarithm; they must be positive.
            state: of an earlier search, to continue bit for bit; replaces `x0`.
            callback: called after each iteration with the live state (keep its `to_dict()`);
                True stops.

        Returns:
            The best point found and why the search ended.

        Raises:
            ValueError: if shapes, bounds or scales do not fit, or the objective's shape is wrong.
        """
        scaling = VariableScaling.build(x0, lower, upper, scale, logarithmic)
        if state is None:
            start = scaling.to_unit(x0.clamp(scaling.lower, scaling.upper))
            state = PatternState(start.tolist(), math.inf, self.initial_mesh, [0.0] * len(x0))
        else:
            # The caller's state stays as it was, so that a search can be resumed from it twice.
            state = PatternState.from_dict(state.to_dict())
        if len(state.x) != len(x0):
            raise ValueError(f"`state` has {len(state.x)} variables, `x0` has {len(x0)}.")
        try:
            status = self._run(objective, scaling, state, callback)
        except KeyboardInterrupt:
            status = "stopped"
        return PatternResult(scaling.from_unit(scaling.tensor(state.x)), status, state)

    def _run(
        self,
        objective: Objective,
        scaling: VariableScaling,
        state: PatternState,
        callback: Callback | None,
    ) -> Status:
        if state.evaluations == 0:
            if self.max_evaluations < 1:
                return "max_evaluations"
            state.value = float(_evaluate(objective, scaling, scaling.tensor(state.x)[None])[0])
            state.evaluations = 1
        with tqdm(
            total=self.max_evaluations, initial=state.evaluations, disable=not self.progress
        ) as bar:
            while state.mesh >= self.mesh_tolerance:
                # A partial poll would depend on the limit, and a resumed search would differ from a
                # whole one.
                if state.evaluations + self.poll_size(len(state.x)) > self.max_evaluations:
                    return "max_evaluations"
                self._iterate(objective, scaling, state)
                bar.set_postfix(value=f"{state.value:.6g}", mesh=f"{state.mesh:.1e}", refresh=False)
                bar.update(state.evaluations - bar.n)
                if callback is not None and callback(state):
                    return "stopped"
        return "mesh_tolerance" if math.isfinite(state.value) else "not_finite"

    def _iterate(self, objective: Objective, scaling: VariableScaling, state: PatternState) -> None:
        x, last = scaling.tensor(state.x), scaling.tensor(state.last_step)
        axes = self._axes(len(x), state.iterations).to(x)
        steps = state.mesh * torch.cat([axes, -axes])
        # The direction of the last success comes first: ties then keep going the same way.
        steps = steps[(steps @ last).argsort(descending=True, stable=True)]
        if self.speculate:
            steps = torch.cat([last[None], steps])
        # Projected, not rejected: a minimum at a bound is approached along it.
        candidates = scaling.project(x + steps)
        values = _evaluate(objective, scaling, candidates)
        best = int(values.argmin())
        if values[best] < state.value:
            state.last_step = (candidates[best] - x).tolist()
            state.x, state.value = candidates[best].tolist(), float(values[best])
            # A mesh beyond the range of the variables would only poll the bounds.
            state.mesh = min(2.0 * state.mesh, max(1.0, self.initial_mesh))
        else:
            # A direction that failed once must not be preferred.
            state.last_step = [0.0] * len(x)
            state.mesh *= self.contraction
        state.evaluations += len(candidates)
        state.iterations += 1
        state.history.append((state.evaluations, state.value, state.mesh))

    def _axes(self, d: int, iteration: int) -> Tensor:
        """Unit poll directions (d, d) of this iteration."""
        if not self.rotate:
            return torch.eye(d, dtype=torch.float64)
        # A generator of its own per iteration: a resumed search needs no generator state.
        generator = torch.Generator().manual_seed(self.seed * 1_000_003 + iteration)
        drawn = torch.randn(d, d, generator=generator, dtype=torch.float64)
        axes, triangle = torch.linalg.qr(drawn)
        # The sign makes the factorisation unique, and so the rotations uniform.
        return axes * triangle.diagonal().sign()


def _evaluate(objective: Objective, scaling: VariableScaling, candidates: Tensor) -> Tensor:
    # Candidates are compared, never differentiated.
    values = torch.as_tensor(objective(scaling.from_unit(candidates))).detach()
    if values.shape != candidates.shape[:1]:
        raise ValueError(
            f"`objective` must give one value per candidate, shape ({len(candidates)},), got "
            f"{tuple(values.shape)}."
        )
    values = values.to(candidates)
    return torch.where(torch.isfinite(values), values, math.inf)

"""Generalised pattern search: bounded minimisation without derivatives, a poll as one batch."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any, Literal

import torch
from torch import Tensor
from tqdm.auto import tqdm

from nfriction.papers.afem.space import Space

Status = Literal["mesh_tolerance", "max_evaluations", "not_finite", "stopped"]

MESSAGES: dict[str, str] = {
    "mesh_tolerance": "No poll point is better and the mesh is as fine as asked for.",
    "max_evaluations": "The limit of evaluations was reached before the mesh was fine enough.",
    "not_finite": "The objective is finite nowhere that was tried.",
    "stopped": "Stopped by the callback or by an interrupt; `x` is the best point found.",
}

Objective = Callable[[Tensor], Tensor]


@dataclass(eq=True)
class PatternState:
    """All that a search needs to go on exactly where it stood, in plain types.

    Args:
        x: best point in the unit cube of the bounds or scales.
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
        value: objective there.
        status: why the search ended; `message` says it in words.
        evaluations, iterations: what it cost.
        mesh: final mesh size relative to the bounds or scales.
        at_lower, at_upper: which variables lie on a bound, bool, shape (d,).
        history: (evaluations, value, mesh) after each iteration.
        state: for resuming.
    """

    x: Tensor
    value: float
    status: Status
    evaluations: int
    iterations: int
    mesh: float
    at_lower: Tensor
    at_upper: Tensor
    history: list[tuple[int, float, float]]
    state: PatternState

    @property
    def converged(self) -> bool:
        """Whether the mesh was refined to its tolerance without finding a better point."""
        return self.status == "mesh_tolerance"

    @property
    def message(self) -> str:
        """The status in words."""
        return MESSAGES[self.status]


@dataclass(frozen=True)
class PatternSearch:
    """Settings of a generalised pattern search.

    Each iteration polls x + mesh * directions in one call of the objective, moves to the best
    point if it is better and expands the mesh, else contracts it. Points outside the bounds are
    moved onto them; points of the poll that coincide with x are still evaluated, so that every
    call has the same number of rows.

    Args:
        max_evaluations: limit of points evaluated; a call that would pass it is not made.
        mesh_tolerance: mesh size, relative to the range of each variable, that ends the search.
        initial_mesh: first mesh size, in the same units.
        expansion, contraction: factors of the mesh after success and failure.
        basis: "2d" polls both ways along every axis, "minimal" d axes and their negative sum.
        rotate: turn the basis at random in every iteration (seeded), as mesh-adaptive search
            does: a ridge or a kink askew to the axes cannot stop it then.
        choice: "best" of the poll, or "first" in poll order that is better (the poll is one
            batch in either case, so "first" saves no evaluation; it follows the last success).
        speculate: add one point beyond x along the last successful step to each poll.
        seed: of the rotations.
    References:
        V. Torczon, SIAM J. Optim. 7 (1997); C. Audet and J. E. Dennis, SIAM J. Optim. 17 (2006).
    """

    max_evaluations: int = 10_000
    mesh_tolerance: float = 1e-6
    initial_mesh: float = 0.25
    expansion: float = 2.0
    contraction: float = 0.5
    basis: Literal["2d", "minimal"] = "2d"
    rotate: bool = False
    choice: Literal["best", "first"] = "best"
    speculate: bool = False
    seed: int = 0

    def __post_init__(self) -> None:
        if not (self.expansion >= 1 > self.contraction > 0):
            raise ValueError(
                "`expansion` must be at least 1 and `contraction` between 0 and 1, got "
                f"{self.expansion} and {self.contraction}."
            )
        if not (self.mesh_tolerance > 0 and self.initial_mesh > 0):
            raise ValueError(
                "`mesh_tolerance` and `initial_mesh` must be positive, got "
                f"{self.mesh_tolerance} and {self.initial_mesh}."
            )
        if self.basis not in ("2d", "minimal") or self.choice not in ("best", "first"):
            raise ValueError(
                '`basis` is "2d" or "minimal" and `choice` "best" or "first", got '
                f"{self.basis!r} and {self.choice!r}."
            )

    def poll_size(self, dimension: int) -> int:
        """Points in each call of the objective after the first (which has one)."""
        directions = 2 * dimension if self.basis == "2d" else dimension + 1
        return directions + self.speculate

    def minimise(
        self,
        objective: Objective,
        x0: Tensor,
        *,
        lower: Tensor | float | None = None,
        upper: Tensor | float | None = None,
        scale: Tensor | float | None = None,
        logarithmic: Sequence[bool] | bool = False,
        state: PatternState | None = None,
        callback: Callable[[PatternState], bool | None] | None = None,
        progress: bool = False,
    ) -> PatternResult:
        """Minimise from `x0`.

        Args:
            objective: values (m,) of candidates (m, d), all of a poll at once; a value that is
                not finite rejects its candidate.
            x0: start, shape (d,); projected into the bounds.
            lower, upper: bounds, shape (d,) or a number; infinite where there is none.
            scale: the change of each variable that counts as large, positive; by default the
                range between the bounds, else the size of x0, else 1. In decades for
                logarithmic variables.
            logarithmic: variables searched by their logarithm; they must be positive.
            state: of an earlier search, to go on bit for bit from there; replaces `x0`.
            callback: called after each iteration with the live state (keep its `to_dict()`);
                True stops.
            progress: show a bar of evaluations.
        Returns:
            The best point found and why the search ended.
        Raises:
            ValueError: if shapes, bounds or scales do not fit, or the objective's shape is wrong.
        """
        space = Space.build(x0, lower, upper, scale, logarithmic)
        if state is None:
            start = space.to_unit(x0.clamp(space.lower, space.upper))
            state = PatternState(start.tolist(), math.inf, self.initial_mesh, [0.0] * len(x0))
        else:
            state = PatternState.from_dict(state.to_dict())
        if len(state.x) != len(x0):
            raise ValueError(f"`state` has {len(state.x)} variables, `x0` has {len(x0)}.")
        with tqdm(
            total=self.max_evaluations, initial=state.evaluations, disable=not progress
        ) as bar:
            try:
                status = self._run(objective, space, state, callback, bar)
            except KeyboardInterrupt:
                status = "stopped"
        return _result(space, state, status)

    def _run(
        self,
        objective: Objective,
        space: Space,
        state: PatternState,
        callback: Callable[[PatternState], bool | None] | None,
        bar: tqdm[Any],
    ) -> Status:
        if state.evaluations == 0:
            if self.max_evaluations < 1:
                return "max_evaluations"
            state.value = float(_evaluate(objective, space, space.tensor(state.x)[None])[0])
            state.evaluations = 1
        while state.mesh >= self.mesh_tolerance:
            if state.evaluations + self.poll_size(len(state.x)) > self.max_evaluations:
                return "max_evaluations"
            self._iterate(objective, space, state)
            bar.set_postfix(value=f"{state.value:.6g}", mesh=f"{state.mesh:.1e}", refresh=False)
            bar.update(state.evaluations - bar.n)
            if callback is not None and callback(state):
                return "stopped"
        return "mesh_tolerance" if math.isfinite(state.value) else "not_finite"

    def _iterate(self, objective: Objective, space: Space, state: PatternState) -> None:
        x, last = space.tensor(state.x), space.tensor(state.last_step)
        steps = state.mesh * self._directions(len(x), state.iterations).to(x)
        # The last success comes first: "first" and ties then keep going the same way.
        steps = steps[(steps @ last).argsort(descending=True, stable=True)]
        if self.speculate:
            steps = torch.cat([last[None], steps])
        candidates = space.project(x + steps)
        values = _evaluate(objective, space, candidates)
        better = values < state.value
        if better.any():
            # argmax of booleans is the first True; argmin the first of equal values.
            chosen = int(values.argmin() if self.choice == "best" else better.int().argmax())
            state.last_step = (candidates[chosen] - x).tolist()
            state.x, state.value = candidates[chosen].tolist(), float(values[chosen])
            state.mesh = min(state.mesh * self.expansion, max(1.0, self.initial_mesh))
        else:
            state.last_step = [0.0] * len(x)
            state.mesh *= self.contraction
        state.evaluations += len(candidates)
        state.iterations += 1
        state.history.append((state.evaluations, state.value, state.mesh))

    def _directions(self, d: int, iteration: int) -> Tensor:
        """Unit poll directions (m, d) of this iteration: a positive spanning set."""
        axes = torch.eye(d, dtype=torch.float64)
        if self.rotate:
            # A generator of its own per iteration: a resumed search needs no generator state.
            generator = torch.Generator().manual_seed(self.seed * 1_000_003 + iteration)
            axes, triangle = torch.linalg.qr(
                torch.randn(d, d, generator=generator, dtype=torch.float64)
            )
            axes = axes * triangle.diagonal().sign()
        back = -axes if self.basis == "2d" else -axes.sum(0, keepdim=True) / d**0.5
        return torch.cat([axes, back])


def _evaluate(objective: Objective, space: Space, candidates: Tensor) -> Tensor:
    values = torch.as_tensor(objective(space.from_unit(candidates))).detach()
    if values.shape != candidates.shape[:1]:
        raise ValueError(
            f"`objective` must give one value per candidate, shape ({len(candidates)},), got "
            f"{tuple(values.shape)}."
        )
    values = values.to(candidates)
    return torch.where(torch.isfinite(values), values, math.inf)


def _result(space: Space, state: PatternState, status: Status) -> PatternResult:
    x = space.from_unit(space.tensor(state.x))
    return PatternResult(
        x=x,
        value=state.value,
        status=status,
        evaluations=state.evaluations,
        iterations=state.iterations,
        mesh=state.mesh,
        at_lower=x <= space.lower,
        at_upper=x >= space.upper,
        history=state.history,
        state=state,
    )

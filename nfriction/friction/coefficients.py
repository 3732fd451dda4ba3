"""Schedules: the coefficients c of a law as a function of the motion.

A schedule is a module c = c(qd, qdd; theta) from joint velocity and acceleration, each
(*batch, joint), to the coefficients of a law, (*batch, joint, coefficient). Its parameters theta
are what a fit estimates; a fit sees them as one flat vector with bounds, a prior and the
derivatives dc/dtheta. The simplest schedule, `Constant`, ignores the motion and has the
coefficients themselves for parameters. The next step is `nfriction.friction.models`.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor, nn

from nfriction.friction.laws import Law
from nfriction.friction.parameters import Sensitivity, checked_coefficients
from nfriction.fuzzy.membership import FuzzyRules

# Smallest value of a positive coefficient: far below the resolution of any torque sensor.
SMALLEST = 1e-12


class Schedule(nn.Module, ABC):
    """Coefficients as a function of the motion.

    A schedule may have a hidden state, such as a filtered acceleration. At every sample a
    simulation or controller calls `advance` (at the first `initial_state`), then
    `coefficients_from`, and holds these coefficients until the next sample.

    Attributes:
        coefficient_names: names of the last axis.
        fitted_mask: which coefficients are estimated by default.
        limits: lower and upper bound of each coefficient in a fit.
        positive: which coefficients are positive by physics, a buffer (coefficient,).
        state_size: size of each joint's hidden state.
        loaded: whether the load moves that state, see `advance_loaded`.
        follows_motion: False where the coefficients are constants.
        handles_range: False where exports must clamp the inputs to the trained range.
        fit_strategy: function that fits such coefficients, as `"module:function"`; it takes a
            `nfriction.fitting.task.FitTask`. Empty where there is none.
        form: formula that exports have code of their own for; others are traced.
    """

    follows_motion: ClassVar[bool] = True
    handles_range: ClassVar[bool] = False
    form: ClassVar[str] = "traced"
    fit_strategy: ClassVar[str] = ""

    positive: Tensor
    state_size: int = 0
    loaded: bool = False

    def __init__(self, law: Law, joints: int) -> None:
        super().__init__()
        if not isinstance(law, Law):
            raise TypeError(f"`law` must be a Law, such as laws.VISCOUS, got {law!r}.")
        if not isinstance(joints, int | np.integer) or joints < 1:
            raise ValueError(f"`joints` must be a whole number of at least 1, got {joints!r}.")
        self.joints = int(joints)
        self.coefficient_names = list(law.names)
        self.fitted_mask = [c.fitted for c in law.coefficients]
        self.limits = [
            # Ten times beyond the start values, a change hardly shows in the range of the motion.
            (0.1 * min(c.initial_grid), 10.0 * max(c.initial_grid))
            if c.initial_grid
            else (SMALLEST if c.positive else -math.inf, math.inf)
            for c in law.coefficients
        ]
        # Not in model files: it follows from the law.
        positive = torch.tensor([c.positive for c in law.coefficients])
        self.register_buffer("positive", positive, persistent=False)

    @abstractmethod
    def forward(self, qd: Tensor, qdd: Tensor) -> Tensor:
        """Coefficients at velocity and acceleration of shape (*batch, joint).

        Shape (*batch, joint, coefficient), or without the batch where they are constants.
        """

    def initial_state(self, qd: Tensor, qdd: Tensor) -> Tensor:
        """Hidden state after the first sample, shape (*batch, joint, state_size)."""
        return qd.new_zeros((*qd.shape, 0))

    def advance(self, qd: Tensor, qdd: Tensor, state: Tensor) -> Tensor:
        """Hidden state after a sample (*batch, joint), given `state` after the one before."""
        return state

    def advance_loaded(self, qd: Tensor, qdd: Tensor, load: Tensor, state: Tensor) -> Tensor:
        """Hidden state after a sample with a load, on which only that of a sampled law depends."""
        return self.advance(qd, qdd, state)

    def coefficients_from(self, qd: Tensor, qdd: Tensor, state: Tensor) -> Tensor:
        """Coefficients at a sample, given the hidden state after it; `forward`: at a first one."""
        coefficients: Tensor = self(qd, qdd)
        return coefficients

    def states(self, qd: Tensor, qdd: Tensor, time: Tensor | None = None) -> Tensor:
        """Hidden state after each sample, (sample, joint, state); heat cools in gaps of `time`."""
        return self.states_from(self.initial_state(qd[0], qdd[0]), qd, qdd, time)

    def states_from(self, first: Tensor, qd: Tensor, qdd: Tensor, time: Any = None) -> Tensor:
        """The same with the state after the first sample given, (*batch, joint, state)."""
        # One by one, as each state needs the one before; a subclass may know a faster way.
        rows = [first]
        for v, a in zip(qd[1:], qdd[1:], strict=True):
            rows.append(self.advance(v, a, rows[-1]))
        return torch.stack(rows)

    def rest_coefficients(self) -> Tensor:
        """Every set of coefficients that is possible at rest, (*set, joint, coefficient)."""
        # Without parameters a schedule has no dtype of its own.
        like = next(self.parameters(), torch.zeros((), dtype=torch.float64))
        rest = torch.zeros(self.joints, dtype=like.dtype, device=like.device)
        coefficients: Tensor = self(rest, torch.zeros_like(rest))
        return coefficients

    def coefficient_sets(self) -> dict[str, Tensor]:
        """Coefficients that describe the model, (joint, coefficient) each, by where they apply.

        Coefficients that do not change have one set, `always`.
        """
        return {"at_rest": self.rest_coefficients().detach()}

    def fuzzy_rules(self) -> FuzzyRules | None:
        """Fuzzy sets and rules of the coefficients; None of a schedule without them."""
        return None

    @abstractmethod
    def parameter_vector(self) -> Tensor:
        """The parameters that a fit varies, (parameter,); a copy."""

    @abstractmethod
    def set_parameter_vector(self, vector: Tensor) -> None:
        """Write a vector of the form that `parameter_vector` gives."""

    def parameter_names(self, joint_names: Sequence[str]) -> list[str]:
        """A readable name for each entry of the parameter vector, given a name per joint."""
        return [f"parameter {k + 1}" for k in range(self.parameter_vector().numel())]

    @abstractmethod
    def bounds(self) -> tuple[Tensor, Tensor]:
        """Lower and upper bounds of the parameter vector; equal where nothing is to be fitted."""

    def prior(self) -> tuple[Tensor, Tensor]:
        """Mean and standard deviation of the parameter vector; infinite where nothing is known."""
        vector = self.parameter_vector()
        return torch.zeros_like(vector), torch.full_like(vector, torch.inf)

    def belief(self) -> tuple[Tensor, Tensor] | None:
        """The prior used for intervals, wider than that of a fit; None for that of the fit."""
        return None

    @abstractmethod
    def sensitivities(self, qd: Tensor, qdd: Tensor) -> Sensitivity:
        """Derivatives of the coefficients at motions of shape (sample, joint)."""

    def sensitivities_from(self, qd: Tensor, qdd: Tensor, state: Tensor) -> Sensitivity:
        """Derivatives of `coefficients_from` at a fixed hidden state (sample, joint, state)."""
        return self.sensitivities(qd, qdd)

    def within_range(self, qd: Tensor, qdd: Tensor) -> tuple[Tensor, Tensor]:
        """The motion clamped to the trained range."""
        return qd, qdd

    def options(self) -> dict[str, Any]:
        """Constructor arguments beyond law, joints and initial values, as plain JSON."""
        return {}


class Tabulated(Schedule):
    """A table of coefficients, one cell of which applies at a time.

    Positive coefficients are stored as logarithms. A fit varies the coefficients themselves,
    bounded below by zero, because the logarithm's gradient vanishes where a coefficient is zero.

    Args:
        law, joints: see `Schedule`.
        initial: start values in SI, the table's whole shape, (joint, coefficient) or
            (coefficient,); default 1e-3 (the middle of the initial grid of a nonlinear one, zero of
            a signed one).
        cells: shape of the table of one joint, before its coefficients.
    """

    def __init__(
        self, law: Law, joints: int, initial: Tensor | Sequence | None = None,
        cells: tuple[int, ...] = (),
    ) -> None:  # fmt: skip
        super().__init__(law, joints)
        shape = (self.joints, *cells, len(law.names))
        self.raw = nn.Parameter(torch.zeros(shape, dtype=torch.float64))
        if initial is None:
            # Small but not zero: a gradient step on the logarithm of zero would not leave it.
            initial = [
                c.initial_grid[len(c.initial_grid) // 2] if c.initial_grid else 1e-3 * c.positive
                for c in law.coefficients
            ]
        self.set_coefficients(initial)

    def table(self) -> Tensor:
        """The coefficients with their gradient, shape (joint, *cells, coefficient)."""
        return torch.where(self.positive, torch.exp(self.raw), self.raw)

    @property
    def values(self) -> Tensor:
        """The coefficients, shape (joint, *cells, coefficient)."""
        return self.table().detach()

    @torch.no_grad()
    def set_coefficients(self, values: Tensor | Sequence) -> None:
        """Set the coefficients in SI, the table's shape, (joint, coefficient) or (coefficient,).

        Raises:
            ValueError: for another shape, and a value that is not finite or has the wrong sign.
        """
        given = checked_coefficients(values, self.raw, self.coefficient_names, self.positive)
        raw = torch.where(self.positive, torch.log(given.clamp_min(SMALLEST)), given)
        # exp(log(x)) may differ from x in its last digits; unchanged coefficients keep their bits.
        self.raw.copy_(torch.where(given == self.values, self.raw, raw))

    def parameter_vector(self) -> Tensor:
        return self.values.reshape(-1)

    def set_parameter_vector(self, vector: Tensor) -> None:
        self.set_coefficients(vector.reshape(self.raw.shape))

    def parameter_names(self, joint_names: Sequence[str]) -> list[str]:
        return [f"{name} of {joint}" for joint in joint_names for name in self.coefficient_names]

    def bounds(self) -> tuple[Tensor, Tensor]:
        values = self.values
        # Equal bounds fix a coefficient, so that solvers need no other way to exclude one.
        fitted = torch.tensor(self.fitted_mask, device=values.device)
        lower, upper = (
            torch.where(fitted, limit, values).reshape(-1)
            for limit in values.new_tensor(self.limits).unbind(-1)
        )
        return lower, upper


class Constant(Tabulated):
    """Coefficients that do not depend on the motion; arguments as of `Tabulated`."""

    follows_motion = False
    handles_range = True
    fit_strategy = "nfriction.fitting.strategy.constant:fit_constant"
    form = "constant"

    def forward(self, qd: Tensor, qdd: Tensor) -> Tensor:
        return self.table()

    def coefficient_sets(self) -> dict[str, Tensor]:
        return {"always": self.values}

    def sensitivities(self, qd: Tensor, qdd: Tensor) -> Sensitivity:
        return Sensitivity.of_constants(torch.eye(self.raw.shape[-1]).to(self.raw), qd)

    def extra_repr(self) -> str:
        columns = [f"{v:.4g}" for v in self.values.mean(0)]
        mean = ", ".join(f"{n}={v}" for n, v in zip(self.coefficient_names, columns, strict=True))
        return f"joints={self.joints}, mean {mean}"

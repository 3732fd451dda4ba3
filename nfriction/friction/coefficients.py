"""Schedules: the coefficients of a law as a function of the motion.

A schedule is a module that maps joint velocity and acceleration to the coefficients of a law,
shape (*batch, joint) -> (*batch, joint, coefficient). A fit sees it through `parameter_vector`,
`bounds` and `sensitivities`, so every schedule can be estimated from torques and trajectories.
The next step is `nfriction.friction.models`, which joins a law and a schedule.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Any, ClassVar

import torch
from torch import Tensor, nn

from nfriction.friction.laws import Law
from nfriction.friction.sensitivity import Sensitivity
from nfriction.fuzzy.membership import FuzzyRules

# Smallest value of a positive coefficient: far below the resolution of any torque sensor.
SMALLEST = 1e-12


class Schedule(nn.Module, ABC):
    """Coefficients as a function of the motion.

    Args:
        law: the law whose coefficients are scheduled.
        joints: number of joints.

    Attributes:
        coefficient_names: names of the last axis.
        fitted_mask: which coefficients are estimated by default.
        limits: lower and upper bound of each coefficient in a fit.
        positive: which coefficients are positive by physics, a buffer (coefficient,).
        state_size: size of each joint's hidden state. At every sample a simulation or controller
            calls `advance` (`initial_state` at the first), then `coefficients_from`, and holds
            these coefficients until the next.
        follows_motion: False where the coefficients are constants.
        handles_range: True where the schedule itself handles inputs outside its trained range;
            exports clamp the inputs of any other.
        fit_strategy: function that fits such coefficients, as `"module:function"`; it takes a
            `nfriction.fitting.fit.FitTask`.
        form: formula that exports have code of their own for, named by the very class that
            computes it; a subclass is traced unless it names it again.
    """

    follows_motion: ClassVar[bool] = True
    handles_range: ClassVar[bool] = False
    form: ClassVar[str] = "traced"
    fit_strategy: ClassVar[str] = ""

    joints: int
    coefficient_names: list[str]
    fitted_mask: list[bool]
    limits: list[tuple[float, float]]
    positive: Tensor
    state_size: int = 0

    def __init__(self, law: Law, joints: int) -> None:
        super().__init__()
        if not isinstance(joints, int) or joints < 1:
            raise ValueError(f"`joints` must be a whole number of at least 1, got {joints!r}.")
        self.joints = joints
        self.coefficient_names = list(law.names)
        self.fitted_mask = [c.fitted for c in law.coefficients]
        self.limits = [
            # Ten times beyond the start values, a change hardly shows in the range of the motion.
            (0.1 * min(c.initial_grid), 10.0 * max(c.initial_grid))
            if c.initial_grid
            else (SMALLEST if c.positive else -math.inf, math.inf)
            for c in law.coefficients
        ]
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

    def coefficients_from(self, qd: Tensor, qdd: Tensor, state: Tensor) -> Tensor:
        """Coefficients at a sample, given the hidden state after it, (*batch, joint, coefficient).

        `forward` is this with the state of a first sample.
        """
        coefficients: Tensor = self(qd, qdd)
        return coefficients

    def states(self, qd: Tensor, qdd: Tensor) -> Tensor:
        """Hidden state after every sample of a motion (sample, joint): (sample, joint, state)."""
        rows = [self.initial_state(qd[0], qdd[0])]
        for v, a in zip(qd[1:], qdd[1:], strict=True):
            rows.append(self.advance(v, a, rows[-1]))
        return torch.stack(rows)

    def rest_coefficients(self) -> Tensor:
        """Every set of coefficients that is possible at rest, (*set, joint, coefficient)."""
        like = next(self.parameters(), torch.zeros((), dtype=torch.float64))
        rest = torch.zeros(self.joints, dtype=like.dtype, device=like.device)
        coefficients: Tensor = self(rest, torch.zeros_like(rest))
        return coefficients

    def coefficient_sets(self) -> dict[str, Tensor]:
        """Coefficients that describe the model, (joint, coefficient) each, by where they apply.

        `"always"` of constants, one set per class of an adaptive model, `"at_rest"` and the
        constant `"reference"` of a neuro-fuzzy one.
        """
        return {"at_rest": self.rest_coefficients().detach()}

    def fuzzy_rules(self) -> FuzzyRules | None:
        """Fuzzy sets and rules of the coefficients; None of a schedule without them."""
        return None

    @abstractmethod
    def parameter_vector(self) -> Tensor:
        """The parameters that a fit varies, flat; a copy."""

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
        law: the law whose coefficients these are.
        joints: number of joints.
        initial: start values in SI, the table's whole shape, (joint, coefficient) or
            (coefficient,); default 1e-3 (the middle of the initial grid of a nonlinear one, zero of
            a signed one).
        cells: shape of the table of one joint.
    """

    def __init__(
        self,
        law: Law,
        joints: int,
        initial: Tensor | Sequence | None = None,
        cells: tuple[int, ...] = (),
    ) -> None:
        super().__init__(law, joints)
        shape = (joints, *cells, len(law.names))
        self.raw = nn.Parameter(torch.zeros(shape, dtype=torch.float64))
        if initial is None:
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
            ValueError: if the shape does not fit, a coefficient is not finite, or one that is
                positive by physics is negative.
        """
        given = self._broadcast(values)
        bad = ~torch.isfinite(given) | (self.positive & (given < 0))
        if bad.any():
            where = tuple(int(i) for i in bad.nonzero()[0])
            joint, k = where[0], where[-1]
            raise ValueError(
                f"`{self.coefficient_names[k]}` of joint {joint + 1} must be finite"
                f"{' and not negative' if self.positive[k] else ''}, got {given[where]:g}."
            )
        raw = torch.where(self.positive, torch.log(given.clamp_min(SMALLEST)), given)
        # exp(log(x)) may differ from x in its last digits; unchanged coefficients keep their bits.
        self.raw.copy_(torch.where(given == self.values, self.raw, raw))

    def _broadcast(self, values: Tensor | Sequence) -> Tensor:
        """Given coefficients as a tensor (joint, *cells, coefficient)."""
        try:
            given = torch.as_tensor(values, dtype=self.raw.dtype, device=self.raw.device)
        except (TypeError, ValueError) as error:
            raise ValueError(
                f"coefficients must be an array of numbers, got {values!r}."
            ) from error
        flat = torch.Size([self.joints, self.raw.shape[-1]])
        if given.shape not in (self.raw.shape, flat, flat[1:]):
            whole = "" if self.raw.shape == flat else f"the whole table {tuple(self.raw.shape)}, "
            raise ValueError(
                f"coefficients must be {whole}(joint, coefficient) = {tuple(flat)} or one row "
                f"for all joints ({', '.join(self.coefficient_names)}), got shape "
                f"{tuple(given.shape)}."
            )
        if given.shape == flat:
            given = given.reshape(self.joints, *(1,) * (self.raw.ndim - 2), -1)
        return given.expand(self.raw.shape)

    def parameter_vector(self) -> Tensor:
        return self.values.reshape(-1)

    def set_parameter_vector(self, vector: Tensor) -> None:
        self.set_coefficients(vector.reshape(self.raw.shape))

    def parameter_names(self, joint_names: Sequence[str]) -> list[str]:
        return [f"{name} of {joint}" for joint in joint_names for name in self.coefficient_names]

    def bounds(self) -> tuple[Tensor, Tensor]:
        values = self.values
        fitted = torch.tensor(self.fitted_mask, device=values.device)
        lower, upper = values.new_tensor(self.limits).unbind(-1)
        return (
            torch.where(fitted, lower, values).reshape(-1),
            torch.where(fitted, upper, values).reshape(-1),
        )


class Constant(Tabulated):
    """Coefficients that do not depend on the motion.

    Args:
        law: the law whose coefficients these are.
        joints: number of joints.
        initial: start values in SI, shape (joint, coefficient) or (coefficient,); default as in
            `Tabulated`.
    """

    follows_motion = False
    handles_range = True
    fit_strategy = "nfriction.fitting.strategy.constant:fit_constant"
    form = "constant"

    def forward(self, qd: Tensor, qdd: Tensor) -> Tensor:
        return self.table()

    def coefficient_sets(self) -> dict[str, Tensor]:
        return {"always": self.values}

    def sensitivities(self, qd: Tensor, qdd: Tensor) -> Sensitivity:
        k = self.raw.shape[-1]
        identity = torch.eye(k, dtype=self.raw.dtype, device=self.raw.device)
        zero = self.raw.new_zeros(()).expand(*qd.shape, k)
        one = self.raw.new_ones(()).expand(*qd.shape, 1)
        return Sensitivity(((identity.expand(*qd.shape, k, k), one),), zero, zero)

    def extra_repr(self) -> str:
        columns = [f"{v:.4g}" for v in self.values.mean(0)]
        mean = ", ".join(f"{n}={v}" for n, v in zip(self.coefficient_names, columns, strict=True))
        return f"joints={self.joints}, mean {mean}"

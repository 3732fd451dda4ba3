"""Base class of plants: names and conventions, replaced buffers, conversion to plain numbers.

A plant is a module whose buffers are the constants of M(q) qdd + bias(q, qd) = tau +
torque_offset, with tau the torque at the joints, behind gears if there are any.
"""

from __future__ import annotations

import copy
import warnings
from collections.abc import Collection, Mapping, Sequence
from typing import TYPE_CHECKING, Any, ClassVar

import torch
from torch import Tensor, nn

if TYPE_CHECKING:
    from typing_extensions import Self

ANGLES = ("relative", "absolute")
ZEROS = ("upright", "hanging")


class Plant(nn.Module):
    """Base of the mechanisms; all methods take joint coordinates of shape (*batch, joint).

    A type for hints: fits know which terms of `PendulumChain` and `LinearAxis` they may adjust.

    Args:
        joints: number of joints.
        joint_names: one per joint; None for joint1, joint2, ...
        name: of the mechanism, in tables and files.
        unit: of a position, "rad" or "m".
        convention: of the angles in its recordings' columns, ("relative" | "absolute",
            "upright" | "hanging"). The methods here always take relative angles from upright.
        position_quantum: smallest step of the position sensor [rad or m]; None where unknown.
    """

    kind: ClassVar[str]  # in files
    required: ClassVar[tuple[str, ...]]  # constructor arguments that a file must hold
    optional: ClassVar[tuple[str, ...]]

    torque_offset: Tensor
    has_drag: bool = False
    first_link: int = 0
    _given: dict[str, Any]  # constructor arguments as plain numbers

    def __init__(
        self,
        joints: int,
        *,
        joint_names: Sequence[str] | None,
        name: str,
        unit: str,
        convention: Sequence[str] = ("relative", "upright"),
        position_quantum: float | None = None,
    ) -> None:
        super().__init__()
        names = tuple(joint_names or (f"joint{i + 1}" for i in range(joints)))
        if len(names) != joints or len(set(names)) != joints:
            raise ValueError(f"`joint_names` must be {joints} different names, got {names}.")
        angles, zero = (*convention, "", "")[:2]
        if len(convention) != 2 or angles not in ANGLES or zero not in ZEROS:
            raise ValueError(
                f"`convention` must be one of {ANGLES} followed by one of {ZEROS}, "
                f"got {tuple(convention)}."
            )
        if position_quantum is not None:
            position_quantum = number("position_quantum", position_quantum, positive=True)
        self.joints = joints
        self.joint_names = names
        self.name = name
        self.unit = unit
        self.convention = (angles, zero)
        self.position_quantum = position_quantum

    def forward(self, q: Tensor, qd: Tensor, tau: Tensor) -> Tensor:
        """Acceleration; the same as `forward_dynamics`, so that a plant can be exported."""
        return self.forward_dynamics(q, qd, tau)

    # Equations of motion, defined by each mechanism.

    def gravity(self, q: Tensor) -> Tensor:
        """The gravity part of the bias."""
        raise NotImplementedError(f"{type(self).__name__} has no gravity term.")

    def forward_dynamics(self, q: Tensor, qd: Tensor, tau: Tensor) -> Tensor:
        """Acceleration at a state under joint torques."""
        raise NotImplementedError(f"{type(self).__name__} has no equations of motion.")

    def inverse_dynamics(self, q: Tensor, qd: Tensor, qdd: Tensor) -> Tensor:
        """Joint torques that give the accelerations."""
        raise NotImplementedError(f"{type(self).__name__} has no inverse dynamics.")

    def load(self, q: Tensor, qd: Tensor) -> Tensor:
        """Normal load of each joint over its load at rest [-]."""
        raise NotImplementedError(f"{type(self).__name__} has no joint loads.")

    def decay_rate(self, damping: Tensor) -> Tensor:
        """Fastest decay of velocities [1/s] that slopes (*batch, joint) of friction can cause."""
        raise NotImplementedError(f"{type(self).__name__} has no bound on decay rates.")

    def replace(self, **buffers: Tensor) -> Self:
        """A shallow copy with some buffers swapped; this plant stays as it is.

        Args:
            **buffers: tensors by buffer name. They may carry gradients and extra leading
                dimensions that broadcast against the batch: `gravity_moment` of shape (P, 1, n)
                goes with `q` of shape (P, W, n).
        Returns:
            The copy; buffers not named are shared.
        Raises:
            ValueError: for a name that is no buffer, or trailing dimensions that differ.
            TypeError: for a value that is no floating-point tensor.
        """
        own = dict(self.named_buffers(recurse=False))
        for name, value in buffers.items():
            if name not in own:
                raise ValueError(f"no buffer `{name}` to replace; there are {sorted(own)}.")
            if not isinstance(value, Tensor) or not value.is_floating_point():
                raise TypeError(f"`{name}` must be a floating-point tensor, got {value!r}.")
            trailing = tuple(own[name].shape)
            # Leading dimensions are batches of plants; the trailing ones belong to the buffer.
            if tuple(value.shape[value.ndim - len(trailing) :]) != trailing:
                raise ValueError(
                    f"`{name}` must have shape (*batch, {', '.join(map(str, trailing))}), "
                    f"got {tuple(value.shape)}."
                )
        values = {**own, **buffers}
        for name, value in buffers.items():
            # A module lists each tensor once, but each buffer must be found by its own name.
            if sum(value is other for other in values.values()) > 1:
                values[name] = value.view_as(value)
        # A deep copy takes shared and replaced objects from its memo.
        shared = (*self.parameters(), *(v for v in vars(self).values() if not isinstance(v, dict)))
        memo: dict[int, Any] = {id(v): v for v in shared}
        memo |= {id(own[name]): value for name, value in values.items()}
        clone = copy.deepcopy(self, memo)
        clone._note_replaced(buffers)
        return clone

    def _note_replaced(self, names: Collection[str]) -> None:
        """Hook of `replace` for terms that are left out while their buffers are zero."""

    def _check(self, **states: Tensor) -> None:
        for name, value in states.items():
            if not value.ndim or value.shape[-1] != self.joints:
                raise ValueError(
                    f"`{name}` must be (*batch, {self.joints}), the joints {self.joint_names} "
                    f"last, got shape {tuple(value.shape)}."
                )

    def to_dict(self) -> dict[str, Any]:
        """Constructor arguments, and buffers that were replaced, as plain JSON types."""
        data = {
            "kind": self.kind,
            "name": self.name,
            "joint_names": list(self.joint_names),
            "position_quantum": self.position_quantum,
            **self._given,
        }
        data = {key: value for key, value in data.items() if value is not None}
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # shown when this plant was built
            fresh = dict(self.from_dict(data).named_buffers())
        # Only these: a file of untouched arguments stays readable, and follows a new derivation.
        changed = {
            name: value.tolist()
            for name, value in self.named_buffers()
            if not torch.equal(value.cpu(), fresh[name].to(value.dtype))
        }
        return {**data, "buffers": changed} if changed else data

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> Self:
        """The plant of `to_dict`.

        Args:
            data: constructor arguments by name (an arm as its `inertia` and `length`); optionally
                `buffers`, values that take the place of derived ones, and `kind`.
        Raises:
            ValueError: for missing or unknown keys, or values the constructor refuses.
        """
        check_keys("rig", data, cls.required, (*cls.optional, "buffers", "kind"))
        given = {key: data[key] for key in (*cls.required, *cls.optional) if key in data}
        buffers = data.get("buffers", {})
        values = {name: torch.tensor(v, dtype=torch.float64) for name, v in buffers.items()}
        cls._check_buffers(values)
        return cls(**cls._parse(given)).replace(**values)

    @classmethod
    def _check_buffers(cls, values: Mapping[str, Tensor]) -> None:
        """Refuse buffers of a file that no mechanism has."""
        for name, value in values.items():
            if not value.isfinite().all():
                raise ValueError(f"`{name}` must be finite, got {value.tolist()}.")

    @classmethod
    def _parse(cls, given: dict[str, Any]) -> dict[str, Any]:
        """Hook of `from_dict` for arguments that are no plain numbers."""
        return given


def check_keys(
    what: str, data: Mapping[str, Any], required: Collection[str], optional: Collection[str] = ()
) -> None:
    """Refuse a table with missing or unknown keys."""
    missing = [key for key in required if key not in data]
    unknown = [key for key in data if key not in {*required, *optional}]
    if missing or unknown:
        raise ValueError(
            f"{what}: missing keys {missing}, unknown keys {unknown}; "
            f"required {sorted(required)}, optional {sorted(optional)}."
        )


def number(name: str, value: object, *, positive: bool = False) -> float:
    """One finite number, or an error that names it."""
    return vector(name, [value], 1, positive=positive).item()


def vector(name: str, values: object, count: int | None, *, positive: bool = False) -> Tensor:
    """`count` (None: one or more) finite numbers as a float64 tensor on the CPU, or an error."""
    wanted = "one or more numbers" if count is None else f"a list of {count}"
    try:
        result = torch.as_tensor(values, dtype=torch.float64).detach().cpu()
    except (TypeError, ValueError, RuntimeError) as error:
        raise ValueError(f"`{name}` must be {wanted}, got {values!r}.") from error
    if result.ndim != 1 or not len(result) or count not in (None, len(result)):
        raise ValueError(f"`{name}` must be {wanted}, got {result.tolist()}.")
    if not result.isfinite().all() or (positive and not (result > 0).all()):
        rule = "positive and finite" if positive else "finite"
        raise ValueError(f"`{name}` must be {rule}, got {result.tolist()}.")
    return result

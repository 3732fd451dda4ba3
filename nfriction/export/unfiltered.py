"""Controllers of a motion: a friction model under the one contract of its edges.

    finite inputs      torque and coefficients of the model
    outside the range  coefficients as the schedule has them there, the law goes on; OUTSIDE
    NaN or infinity    NaN torque and coefficients of that joint, the others as ever; NOT_FINITE
    beyond a limit     torque at the limit; SATURATED

Schedules of the library know their trained range and are left to themselves: neuro-fuzzy ones
return to their constant law, and the torque is that of the model for all finite inputs. Any other
is given inputs clamped to `ModelInfo.input_ranges`. OUTSIDE always means: outside `input_ranges`.
"""

import copy
import math
from collections.abc import Sequence

import torch
from torch import Tensor, nn

from nfriction.friction.models import FrictionModel
from nfriction.io.model_info import ModelInfo

# Bits of the status.
OUTSIDE, NOT_FINITE, SATURATED = 1, 2, 4
# Edge of a range that nobody gave; the largest float, so that targets of single precision know it.
UNBOUNDED = float(torch.finfo(torch.float32).max)


class _Contracted(nn.Module):
    """What controllers with and without a memory share.

    Args:
        model: a friction model; a frozen copy is taken, in float64 on the CPU.
        info: tells the trained ranges.
        torque_limit: largest |torque| given out [N m], a number or one a joint.

    Raises:
        ValueError: if a range or the limit is malformed.
    """

    qd_lower: Tensor
    qd_upper: Tensor
    qdd_lower: Tensor
    qdd_upper: Tensor
    torque_limit: Tensor

    def __init__(
        self,
        model: FrictionModel,
        info: ModelInfo | None = None,
        torque_limit: float | Sequence[float] | None = None,
    ) -> None:
        super().__init__()
        self.model = copy.deepcopy(model).to("cpu", torch.float64).eval().requires_grad_(False)
        self.joints = model.joints
        self.coefficient_count = len(model.law.names)
        self.clamps = not getattr(model.schedule, "handles_range", False)
        ranges = dict((info or ModelInfo()).input_ranges)
        for name in ("qd", "qdd"):
            lower, upper = _range(name, ranges.get(name), model.joints)
            self.register_buffer(f"{name}_lower", lower)
            self.register_buffer(f"{name}_upper", upper)
        self.limited = torque_limit is not None
        self.register_buffer("torque_limit", _limit(torque_limit, model.joints))

    def _seen(self, qd: Tensor, qdd: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Velocity and acceleration that the schedule sees, and whether they leave the range."""
        if qd.size(-1) != self.joints:
            raise ValueError(
                f"inputs must be (*batch, joint) with {self.joints} joints, got last axis "
                f"{qd.size(-1)}."
            )
        qd_held = torch.clamp(qd, self.qd_lower, self.qd_upper)
        qdd_held = torch.clamp(qdd, self.qdd_lower, self.qdd_upper)
        outside = (qd_held != qd) | (qdd_held != qdd)
        if self.clamps:
            return qd_held, qdd_held, outside
        return qd, qdd, outside

    def _limited(
        self, qd: Tensor, load: Tensor, coefficients: Tensor, outside: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Torque within its limit, coefficients and status of inputs that are finite."""
        tau_f = self.model.torque(qd, load, coefficients)
        status = outside.to(torch.int32)
        if self.limited:
            held = torch.clamp(tau_f, -self.torque_limit, self.torque_limit)
            # SATURATED; TorchScript takes no global.
            status = status + 4 * (held != tau_f).to(torch.int32)
            tau_f = held
        return tau_f, coefficients, status

    def torque(self, qd: Tensor, qdd: Tensor, load: Tensor) -> Tensor:
        """The torque alone, by the same contract; a memory is that after a first sample."""
        qd_seen, qdd_seen, _ = self._seen(qd, qdd)
        tau_f = self.model.torque(qd, load, self.model.schedule(qd_seen, qdd_seen))
        held = torch.clamp(tau_f, -self.torque_limit, self.torque_limit) if self.limited else tau_f
        # Zero times what is not finite is NaN: a third of the operations of comparisons.
        held = torch.addcmul(held, qd, qdd, value=0.0)
        return torch.addcmul(held, load, tau_f, value=0.0)


def masked(
    finite: Tensor, tau_f: Tensor, coefficients: Tensor, status: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Outputs with NaN and its status where inputs, or the torque itself, are not finite.

    The comparisons serve for NaN as for infinity. Targets whose compiler takes every number for
    finite test the bits instead.
    """
    finite = finite & (tau_f.abs() < math.inf)
    return (
        torch.where(finite, tau_f, math.nan),
        torch.where(finite.unsqueeze(-1), coefficients, math.nan),
        torch.where(finite, status, 2),  # NOT_FINITE; TorchScript takes no global
    )


class Controller(_Contracted):
    """Friction torque, coefficients and status of a model without a memory.

    Args:
        model, info, torque_limit: see `controller_of`.

    Shape:
        qd, qdd, load: (*batch, joint); torque (*batch, joint), coefficients (*batch, joint,
        coefficient), status (*batch, joint), int32.
    """

    def __init__(
        self,
        model: FrictionModel,
        info: ModelInfo | None = None,
        torque_limit: float | Sequence[float] | None = None,
    ) -> None:
        if memory_of(model):
            raise ValueError("the model's schedule has a memory; use `MemoryController`.")
        super().__init__(model, info, torque_limit)

    def for_finite(self, qd: Tensor, qdd: Tensor, load: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """What `forward` gives where all is finite."""
        qd_seen, qdd_seen, outside = self._seen(qd, qdd)
        return self._limited(qd, load, self.model.schedule(qd_seen, qdd_seen), outside)

    def forward(self, qd: Tensor, qdd: Tensor, load: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Torque [N m], coefficients and status at velocity, acceleration and load."""
        tau_f, coefficients, status = self.for_finite(qd, qdd, load)
        finite = qd.abs() + qdd.abs() + load.abs() < math.inf
        return masked(finite, tau_f, coefficients, status)


class MemoryController(_Contracted):
    """The same for a model whose schedule carries a memory from sample to sample.

    A motion that is not finite leaves the memory of its joint as it was.

    Args:
        model, info, torque_limit: see `controller_of`.

    Shape:
        As in `Controller`, and state (*batch, joint, number).
    """

    def __init__(
        self,
        model: FrictionModel,
        info: ModelInfo | None = None,
        torque_limit: float | Sequence[float] | None = None,
    ) -> None:
        super().__init__(model, info, torque_limit)
        self.state_size = memory_of(model)
        if not self.state_size:
            raise ValueError("the model's schedule has no memory; use `Controller`.")

    def initial_state(self, qd: Tensor, qdd: Tensor) -> Tensor:
        """Memory before a first sample; a joint that is not finite counts as one at rest."""
        finite = qd.abs() + qdd.abs() < math.inf
        qd_seen, qdd_seen, _ = self._seen(
            torch.where(finite, qd, 0.0), torch.where(finite, qdd, 0.0)
        )
        return self.model.schedule.initial_state(qd_seen, qdd_seen)

    def for_finite(
        self, qd: Tensor, qdd: Tensor, load: Tensor, state: Tensor
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """What `forward` gives where all is finite."""
        qd_seen, qdd_seen, outside = self._seen(qd, qdd)
        following = self.model.schedule.advance(qd_seen, qdd_seen, state)
        coefficients = self.model.schedule.coefficients_from(qd_seen, qdd_seen, following)
        tau_f, coefficients, status = self._limited(qd, load, coefficients, outside)
        return tau_f, coefficients, status, following

    def forward(
        self, qd: Tensor, qdd: Tensor, load: Tensor, state: Tensor
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Torque [N m], coefficients, status and the memory after this sample."""
        tau_f, coefficients, status, following = self.for_finite(qd, qdd, load, state)
        motion = qd.abs() + qdd.abs()
        finite = motion + load.abs() < math.inf
        tau_f, coefficients, status = masked(finite, tau_f, coefficients, status)
        following = torch.where(motion.unsqueeze(-1) < math.inf, following, state)
        return tau_f, coefficients, status, following


def for_single_precision(
    controller: Controller | MemoryController,
) -> Controller | MemoryController:
    """With ranges such that no number in single precision changes its side by their rounding."""
    single = copy.deepcopy(controller)
    for name in ("qd", "qdd"):
        for edge, inward in (("lower", math.inf), ("upper", -math.inf)):
            exact = single.get_buffer(f"{name}_{edge}")
            near = exact.float()
            outside = near.double() < exact if edge == "lower" else near.double() > exact
            next_in = torch.nextafter(near, torch.full_like(near, inward))
            exact.copy_(torch.where(outside, next_in, near))
    return single


def memory_of(model: FrictionModel) -> int:
    """Numbers a joint that the model's schedule carries from sample to sample."""
    return int(getattr(model.schedule, "state_size", 0))


def _range(name: str, given: object, joints: int) -> tuple[Tensor, Tensor]:
    """Lower and upper edge by joint."""
    if given is None:
        edge = torch.full((joints,), UNBOUNDED, dtype=torch.float64)
        return -edge, edge
    try:
        pairs = torch.tensor(given, dtype=torch.float64)
    except (TypeError, ValueError, RuntimeError) as error:
        raise ValueError(f"`input_ranges` of {name} must be numbers, got {given!r}.") from error
    if pairs.shape != (joints, 2) or not (pairs[:, 0] <= pairs[:, 1]).all():
        raise ValueError(
            f"`input_ranges` of {name} must be [lowest, highest] for each of {joints} joints, got "
            f"{given!r}."
        )
    pairs = pairs.clamp(-UNBOUNDED, UNBOUNDED)
    return pairs[:, 0].clone(), pairs[:, 1].clone()


def _limit(given: float | Sequence[float] | None, joints: int) -> Tensor:
    """Largest |torque| by joint."""
    limit = torch.as_tensor(UNBOUNDED if given is None else given, dtype=torch.float64)
    if limit.shape not in ((), (joints,)) or not ((limit > 0) & (limit < math.inf)).all():
        raise ValueError(
            f"`torque_limit` must be positive and finite [N m], one number or one for each of "
            f"{joints} joints, got {given!r}."
        )
    return limit.expand(joints).clone()

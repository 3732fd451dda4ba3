"""Controllers: a friction model under one contract for its edge cases.

    finite inputs      torque and coefficients of the model
    outside the range  coefficients from the schedule, the law continues; OUTSIDE
    NaN or infinity    NaN torque and coefficients of that joint, the others unaffected; NOT_FINITE
    beyond a limit     torque at the limit; SATURATED

Schedules that handle their range themselves get all finite inputs: neuro-fuzzy ones return to their
constant law beyond it. Others get inputs clamped to `ModelInfo.input_ranges`. OUTSIDE always means
outside `input_ranges`.
"""

import copy
import math
from collections.abc import Callable, Iterable, Sequence
from typing import Any, Final, cast

import numpy as np
import torch
from torch import Tensor, nn

from nfriction.friction.models import FrictionModel
from nfriction.friction.sampled import sampled
from nfriction.io.files import numbers
from nfriction.io.model_file import ModelInfo, require_model
from nfriction.plant.rigs import from_dict
from nfriction.signals import SecondOrderLowPass

# Bits of the status.
OUTSIDE, NOT_FINITE, SATURATED = 1, 2, 4
# Edge of an unspecified range: the largest float in single precision, so that all targets have it.
UNBOUNDED = float(torch.finfo(torch.float32).max)
# State of the causal filter per joint: last position, last velocity, two numbers per low-pass.
FILTER_STATE = 6


def controller_of(
    model: FrictionModel,
    info: ModelInfo | None = None,
    *,
    torque_limit: float | Sequence[float] | None = None,
    with_filter: bool = False,
    cutoff_hz: float = 20.0,
) -> "Controller":
    """Make the controller that every target exports.

    Args:
        model: a friction model; the controller uses a frozen copy, in float64 on the CPU.
        info: the training ranges, and the sample time that a filter needs.
        torque_limit: limit of the |torque| [N m], one number or one per joint.
        with_filter: take raw positions and filter them causally.
        cutoff_hz: cut-off of that filter [Hz].

    Raises:
        ValueError: if a range or the limit is malformed, a filter or a law with memory lacks its
            sample time, or the rig gives other loads than the friction depends on.
    """
    info = info or ModelInfo()
    require_model(model)
    if info.rig is not None:
        model.check_loads(from_dict(info.rig))
    if model.law.memory is not None:
        if info.sample_time is None:
            raise ValueError(
                f"the law {model.law.name!r} has memory, which a controller advances by "
                "`ModelInfo.sample_time` [s], but it is None."
            )
        model = sampled(model, info.sample_time)
    elif info.sample_time is not None and hasattr(model.schedule, "set_sample_time"):
        model = copy.deepcopy(model)
        cast(Any, model.schedule).set_sample_time(info.sample_time)
    if not with_filter:
        return Controller(model, info, torque_limit)
    if info.sample_time is None:
        raise ValueError(
            "a filter needs `ModelInfo.sample_time` [s], but it is None: none was given, or the "
            "model was fitted to recordings with different ones."
        )
    low_pass = SecondOrderLowPass(numbers("cutoff_hz", cutoff_hz), float(info.sample_time))
    return Controller(model, info, torque_limit, low_pass)


class Controller(nn.Module):
    """Friction torque, coefficients and status of one sample after another.

    `controller(*inputs)` gives torque, coefficients and status; if the controller has a state,
    `controller(*inputs, state)` also gives the next state. Inputs are velocity, acceleration and
    load, or with the filter position and load: velocity is then the difference of the position
    through a causal second-order low-pass filter, acceleration the difference of that velocity
    through the same filter again. An input that is not finite leaves the state of its joint
    unchanged, a load only if the state depends on it; a filter forgets its last position, so that
    the next sample is NaN, too.

    Args:
        model, info, torque_limit: see `controller_of`.

    Shape:
        Inputs (*batch, joint), state (*batch, joint, state_size); torque (*batch, joint),
        coefficients (*batch, joint, coefficient), status (*batch, joint), int32.

    Attributes:
        state_size: numbers per joint that it carries from sample to sample, those of the filter
            before those of the schedule.
        memory_size: those of the schedule alone.

    References:
        TLRIP paper: a second-order IIR filter on the velocity (there from frequency counting).
    """

    qd_lower: Tensor
    qd_upper: Tensor
    qdd_lower: Tensor
    qdd_upper: Tensor
    torque_limit: Tensor

    # Constants, so that TorchScript compiles only the branches that are taken.
    clamps: Final[bool]
    limited: Final[bool]
    remembers: Final[bool]
    loaded: Final[bool]
    filters: Final[bool]

    def __init__(
        self,
        model: FrictionModel,
        info: ModelInfo,
        torque_limit: float | Sequence[float] | None = None,
        low_pass: SecondOrderLowPass | None = None,
    ) -> None:
        super().__init__()
        self.model = copy.deepcopy(model).to("cpu", torch.float64).eval().requires_grad_(False)
        self.joints = model.joints
        self.coefficient_count = len(model.law.names)
        self.clamps = not model.schedule.handles_range
        for name in ("qd", "qdd"):
            lower, upper = _range(name, info.input_ranges.get(name), model.joints)
            self.register_buffer(f"{name}_lower", lower)
            self.register_buffer(f"{name}_upper", upper)
        self.limited = torque_limit is not None
        self.register_buffer("torque_limit", _limit(torque_limit, model.joints))
        self.memory_size = model.state_size
        self.remembers = self.memory_size > 0
        self.loaded = model.schedule.loaded
        self.filters = low_pass is not None
        self.inputs = ("q", "load") if self.filters else ("qd", "qdd", "load")
        self.state_size = self.memory_size + (FILTER_STATE if self.filters else 0)
        self.b0, self.b1, self.b2, self.a1, self.a2, self.sample_time = 6 * (0.0,)
        self.filter_options: dict[str, float] | None = None
        if low_pass is not None:
            numerator, denominator = (c.tolist() for c in low_pass.coefficients)
            (self.b0, self.b1, self.b2), (_, self.a1, self.a2) = numerator, denominator
            self.sample_time = float(low_pass.sample_time)
            names = ("cutoff_hz", "damping", "sample_time")
            self.filter_options = {name: float(getattr(low_pass, name)) for name in names}

    @torch.jit.unused
    def forward(self, *given: Tensor) -> tuple[Tensor, ...]:
        """Torque [N m], coefficients, status and, if there is one, the next state."""
        if self.filters:
            return self.filtered_step(*given)
        if self.remembers:
            return self.step(*given)
        qd, qdd, load = given
        return self.step(qd, qdd, load, load)[:3]

    @torch.jit.unused
    def start(self, *inputs: Tensor) -> Tensor:
        """State before a first sample of these inputs, (*batch, joint, state_size)."""
        if self.filters:
            return self.filtered_start(inputs[0])
        return self.initial_memory(inputs[0], inputs[1])

    @torch.jit.unused
    @torch.no_grad()
    def run(self, *inputs: Tensor) -> tuple[Tensor, ...]:
        """Torque, coefficients and status of samples in order, (sample, joint, ...)."""
        if not self.state_size:
            return self(*inputs)
        if not len(inputs[0]):
            return self(*inputs, self.start(*inputs))[:3]
        return run_in_order(self, inputs, self.start(*(x[0] for x in inputs)))

    def step(
        self, qd: Tensor, qdd: Tensor, load: Tensor, memory: Tensor
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Torque, coefficients, status and next memory at velocity, acceleration and load.

        Without a memory, the given value is returned unchanged.
        """
        qd_seen, qdd_seen, outside = self.seen(qd, qdd)
        motion = qd.abs() + qdd.abs()
        if self.remembers:
            given = motion + load.abs() if self.loaded else motion
            following = self.model.schedule.advance_loaded(qd_seen, qdd_seen, load, memory)
            coefficients = self.model.schedule.coefficients_from(qd_seen, qdd_seen, following)
            memory = torch.where(given.unsqueeze(-1) < math.inf, following, memory)
        else:
            coefficients = self.model.schedule(qd_seen, qdd_seen)
        tau_f = self.model.torque(qd, load, coefficients)
        status = outside.to(torch.int32)
        if self.limited:
            held = torch.clamp(tau_f, -self.torque_limit, self.torque_limit)
            # SATURATED; TorchScript does not accept globals.
            status = status + 4 * (held != tau_f).to(torch.int32)
            tau_f = held
        # The comparisons are false for NaN and for infinity.
        finite = (motion + load.abs() < math.inf) & (tau_f.abs() < math.inf)
        return (
            torch.where(finite, tau_f, math.nan),
            torch.where(finite.unsqueeze(-1), coefficients, math.nan),
            torch.where(finite, status, 2),  # NOT_FINITE
            memory,
        )

    def filtered_step(
        self, q: Tensor, load: Tensor, state: Tensor
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Torque, coefficients, status and next state at a position, by the filter."""
        q_last, qd_last, first, second, third, fourth = state[..., :6].unbind(-1)
        qd, first, second = self._low_pass((q - q_last) / self.sample_time, first, second)
        qdd, third, fourth = self._low_pass((qd - qd_last) / self.sample_time, third, fourth)
        following = torch.stack([q, qd, first, second, third, fourth], -1)
        # After a missing sample there is no difference yet: the low-pass filters wait for one.
        waiting = torch.cat([_infinite_if_missing(q).unsqueeze(-1), state[..., 1:6]], -1)
        following = torch.where(qdd.abs().unsqueeze(-1) < math.inf, following, waiting)
        tau_f, coefficients, status, memory = self.step(qd, qdd, load, state[..., 6:])
        if self.remembers:
            following = torch.cat([following, memory], -1)
        return tau_f, coefficients, status, following

    def initial_memory(self, qd: Tensor, qdd: Tensor) -> Tensor:
        """Memory before a first sample; a joint with non-finite inputs counts as at rest."""
        finite = qd.abs() + qdd.abs() < math.inf
        qd_seen, qdd_seen, _ = self.seen(
            torch.where(finite, qd, 0.0), torch.where(finite, qdd, 0.0)
        )
        return self.model.schedule.initial_state(qd_seen, qdd_seen)

    def filtered_start(self, q: Tensor) -> Tensor:
        """State of a filter that has rested at `q`, (*batch, joint); a reset is the same."""
        rest = torch.zeros_like(q)
        state = torch.stack([_infinite_if_missing(q), rest, rest, rest, rest, rest], -1)
        if self.remembers:
            state = torch.cat([state, self.initial_memory(rest, rest)], -1)
        return state

    def torque(self, qd: Tensor, qdd: Tensor, load: Tensor) -> Tensor:
        """The torque alone, under the same contract; RuntimeError where it needs a memory."""
        if self.remembers:
            raise RuntimeError(
                "this friction depends on earlier samples: call `module.initial_state` once, then "
                "`module.step` with the state for every sample."
            )
        qd_seen, qdd_seen, _ = self.seen(qd, qdd)
        tau_f = self.model.torque(qd, load, self.model.schedule(qd_seen, qdd_seen))
        held = torch.clamp(tau_f, -self.torque_limit, self.torque_limit) if self.limited else tau_f
        # Zero times a non-finite number is NaN: a third of the operations of comparisons.
        held = torch.addcmul(held, qd, qdd, value=0.0)
        return torch.addcmul(held, load, tau_f, value=0.0)

    def seen(self, qd: Tensor, qdd: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Velocity and acceleration for the schedule, and whether they leave the range."""
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

    def _low_pass(self, x: Tensor, s0: Tensor, s1: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Output and next state of the filter, in transposed direct form II."""
        y = self.b0 * x + s0
        return y, self.b1 * x - self.a1 * y + s1, self.b2 * x - self.a2 * y


def _infinite_if_missing(q: Tensor) -> Tensor:
    # In a state, NaN means a fresh start to ONNX and `torch.export`.
    return torch.where(q.abs() < math.inf, q, math.inf)


def run_in_order(
    step: Callable[..., Any], inputs: Iterable[Tensor], state: Tensor
) -> tuple[Tensor, ...]:
    """Torque, coefficients and status of samples in order, (sample, joint, ...).

    `step` takes one sample of each input and the state, and gives the next state last.
    """
    found = []
    for sample in zip(*inputs, strict=True):
        *outputs, state = step(*sample, state)
        found.append(outputs)
    return tuple(torch.stack(column) for column in zip(*found, strict=True))


def for_single_precision(controller: Controller) -> Controller:
    """The controller with ranges whose rounding to single precision moves no input across them."""
    single = copy.deepcopy(controller)
    for name in ("qd", "qdd"):
        for edge, inward in (("lower", math.inf), ("upper", -math.inf)):
            exact = single.get_buffer(f"{name}_{edge}")
            near = exact.float()
            outside = near.double() < exact if edge == "lower" else near.double() > exact
            next_in = torch.nextafter(near, torch.full_like(near, inward))
            exact.copy_(torch.where(outside, next_in, near))
    return single


def _range(name: str, given: object, joints: int) -> tuple[Tensor, Tensor]:
    """Lower and upper edge by joint."""
    if given is None:
        edge = torch.full((joints,), UNBOUNDED, dtype=torch.float64)
        return -edge, edge
    pairs = torch.tensor(given, dtype=torch.float64)
    if len(pairs) != joints:
        raise ValueError(
            f"`input_ranges` of {name} must be [lowest, highest] for each of {joints} joints, got "
            f"{given!r}."
        )
    pairs = pairs.clamp(-UNBOUNDED, UNBOUNDED)
    return pairs[:, 0].clone(), pairs[:, 1].clone()


def _limit(given: float | Sequence[float] | None, joints: int) -> Tensor:
    """Largest |torque| by joint."""
    plain = UNBOUNDED if given is None else np.asarray(given, dtype=object).tolist()
    limit = torch.tensor(numbers("torque_limit", plain), dtype=torch.float64)
    if limit.shape not in ((), (joints,)) or not ((limit > 0) & (limit < math.inf)).all():
        raise ValueError(
            f"`torque_limit` must be positive and finite [N m], one number or one for each of "
            f"{joints} joints, got {given!r}."
        )
    return limit * torch.ones(joints, dtype=torch.float64)  # files of torch keep `expand`'s strides

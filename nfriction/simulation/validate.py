"""Validation of a rollout's arguments."""

import math
from collections.abc import Callable, Hashable
from dataclasses import replace
from functools import wraps
from numbers import Integral
from typing import Any, ParamSpec, TypeVar

import numpy as np
import torch
from torch import Tensor

from nfriction import codegen
from nfriction.simulation.compiled import System
from nfriction.simulation.memory_step import memory_of
from nfriction.simulation.protocols import Friction, NoFriction, Plant, RolloutInputs

P = ParamSpec("P")
R = TypeVar("R")

# RK4 is stable on the negative real axis down to h * lambda = -2.785.
RK4_STABILITY = 2.785
# Number of cached rates, a few tens of kilobytes each.
KEPT_RATES = 64
_decay_rates: dict[Hashable, float] = {}


def outside_inference_mode(function: Callable[P, R]) -> Callable[P, R]:
    """The function, without gradients and outside `torch.inference_mode()` if that is active.

    Inference tensors can be neither traced nor differentiated, but the slope at rest is a
    derivative.
    """

    @wraps(function)
    def call(*args: P.args, **kwargs: P.kwargs) -> R:
        if not torch.is_inference_mode_enabled():
            return function(*args, **kwargs)
        with torch.inference_mode(False), torch.no_grad():
            return function(*args, **kwargs)

    return call


def all_finite(x: Tensor) -> bool:
    """True if no element is NaN or infinite, in one pass over them."""
    if not x.numel():
        return True
    low, high = x.detach().aminmax()  # NaN if there is one
    return math.isfinite(low) and math.isfinite(high)


def as_tensor(name: str, value: Any) -> Tensor:
    """A tensor unchanged; arrays keep their precision, whole numbers and lists become float64."""
    if isinstance(value, Tensor):
        found = value
    else:
        try:
            # A copy, because arrays may be read-only or reversed, which tensors cannot be.
            found = torch.from_numpy(np.array(value, order="C"))
        except (TypeError, ValueError) as error:
            raise ValueError(
                f"`{name}` must be a tensor, an array or a list of numbers with rows of one "
                f"length, got {type(value).__name__}: {error}"
            ) from None
    if found.is_complex() or (found.is_floating_point() and found.element_size() < 4):
        raise ValueError(f"`{name}` must be real, float32 or float64, got {found.dtype}.")
    return found if found.is_floating_point() else found.to(torch.float64)


def validate_inputs(
    plant: Plant,
    friction: Friction,
    q0: Tensor,
    qd0: Tensor,
    tau: Tensor | None,
    sample_time: float | Tensor,
    steps: int | None,
    substeps: int,
) -> RolloutInputs:
    """Initial state, torque and sample times as tensors of matching shape."""
    for name, given, kind, method in (
        ("plant", plant, "mechanism", "forward_dynamics"),
        ("friction", friction, "friction model or None", "coefficients"),
    ):
        if not hasattr(given, method):
            raise TypeError(f"`{name}` must be a {kind}, got {type(given).__name__}.")
    for name, whole in (("steps", 1 if steps is None else steps), ("substeps", substeps)):
        if not isinstance(whole, Integral) or whole < 1:
            raise ValueError(f"`{name}` must be a whole number of at least 1, got {whole!r}.")
    joints = plant.joints
    if friction.joints != joints:
        raise ValueError(f"the plant has {joints} joints, the friction model {friction.joints}.")
    if check := getattr(friction, "check_loads", None):  # other frictions have none
        check(plant)
    q0 = as_tensor("q0", q0)
    qd0 = as_tensor("qd0", qd0).to(q0)
    modules = (m for m in (plant, friction) if isinstance(m, torch.nn.Module))
    devices = {x.device.type for m in modules for x in (*m.parameters(), *m.buffers(), q0)}
    if len(devices) > 1:
        raise ValueError(
            "plant, friction model and `q0` (of recordings: the CPU) must be on one device, got "
            f"{' and '.join(sorted(devices))}; move them with `.to(device)`."
        )
    for name, value in (("q0", q0), ("qd0", qd0)):
        if value.ndim == 0 or value.shape[-1] != joints:
            raise ValueError(
                f"`{name}` must be (*batch, joint) with {joints} joints, got {tuple(value.shape)}."
            )
        if not all_finite(value):
            raise ValueError(f"`{name}` must be finite, got NaN or infinity.")
    step = as_tensor("sample_time", sample_time).to(q0)
    if not step.numel() or not all_finite(step) or float(step.min()) <= 0:
        raise ValueError(
            "`sample_time` must be finite and positive [s], got "
            f"{float(step.min()) if step.numel() else 'none'}."
        )
    torque = None if tau is None else as_tensor("tau", tau).to(q0)
    if torque is not None and (torque.ndim < 2 or torque.shape[-1] != joints):
        raise ValueError(f"`tau` must be (*batch, steps, {joints}), got {tuple(torque.shape)}.")
    if torque is not None and not all_finite(torque):
        raise ValueError("`tau` must be finite, got NaN or infinity.")
    count = _step_count(steps, step, torque)
    if step.ndim == 0:
        step = step.expand(count)
    if torque is None:
        torque = q0.new_zeros(1, 1).expand(count, joints)
    batches = {"q0": q0.shape[:-1], "qd0": qd0.shape[:-1], "tau": torque.shape[:-2],
               "sample_time": step.shape[:-1]}  # fmt: skip
    try:
        shape = (*np.broadcast_shapes(*batches.values()), joints)
    except ValueError:
        shown = ", ".join(f"`{name}` {tuple(b)}" for name, b in batches.items() if b)
        raise ValueError(f"batches must be the same, 1 or omitted, got {shown}.") from None
    return RolloutInputs(q0.expand(shape), qd0.expand(shape), torque, step, int(substeps))


def _step_count(steps: int | None, step: Tensor, torque: Tensor | None) -> int:
    """The number of steps that all arguments agree on."""
    lengths = {
        "steps": steps,
        "sample_time": step.shape[-1] if step.ndim else None,
        "tau": None if torque is None else torque.shape[-2],
    }
    known = {name: int(n) for name, n in lengths.items() if n is not None}
    if not known or len(set(known.values())) != 1:
        raise ValueError(f"the number of steps must be given and agree, got {known or 'nothing'}.")
    count = next(iter(known.values()))
    if count < 1:
        raise ValueError("`tau` must have a row for at least one step, got none.")
    return count


def validate_measured(
    drive: str, measured: tuple[Tensor, Tensor] | None, inputs: RolloutInputs
) -> tuple[Tensor, Tensor] | None:
    """The measured motion that drives the coefficients."""
    if drive not in ("simulated", "measured") or (drive == "measured") != (measured is not None):
        raise ValueError(
            '`drive` must be "simulated", or "measured" together with `measured=(qd, qdd)`; got '
            f"{drive!r} {'without' if measured is None else 'with'} `measured`."
        )
    if measured is None:
        return None
    shape = inputs.step.shape[-1], inputs.q0.shape[-1]
    found = tuple(as_tensor("measured", x).to(inputs.q0) for x in measured)
    if len(found) != 2:
        raise ValueError(f"`measured` must be two, velocity and acceleration, got {len(found)}.")
    for x in found:
        if x.shape[-2:] != shape or not all_finite(x):
            raise ValueError(
                f"`measured` must be two finite (*batch, {shape[0]}, {shape[1]}), one per step, "
                f"got {tuple(found[0].shape)} and {tuple(found[1].shape)}."
            )
    return found[0], found[1]


def with_states(
    inputs: RolloutInputs,
    friction: Friction,
    hidden_state: Tensor | None = None,
    law_state: Tensor | None = None,
) -> RolloutInputs:
    """The inputs with the states from which coefficients and a law with memory continue."""
    law, size = memory_of(friction), getattr(friction, "state_size", 0)
    if hidden_state is not None and size == 0:
        raise ValueError("`hidden_state` is for friction whose coefficients have one; omit it.")
    if law_state is not None and law is None:
        raise ValueError("`law_state` is for a friction law with memory, such as LuGre; omit it.")
    if law is not None and law_state is None:
        law_state = inputs.q0.new_zeros(inputs.q0.shape[-1], law.size)
    sizes = {"hidden_state": size, "law_state": 0 if law is None else law.size}
    found: dict[str, Any] = {}
    shape = tuple(inputs.q0.shape)
    for name, given in (("hidden_state", hidden_state), ("law_state", law_state)):
        if given is not None:
            found[name] = state = as_tensor(name, given).to(inputs.q0)
            wanted = (shape[-1], sizes[name])
            if state.shape[-2:] != wanted or not all_finite(state):
                raise ValueError(
                    f"`{name}` must be finite (*batch, {wanted[0]}, {wanted[1]}), got "
                    f"{tuple(state.shape)}."
                )
            shape = np.broadcast_shapes(shape, state.shape[:-1])
    if not found:
        return inputs
    if law is not None:
        found["law_state"] = found["law_state"].expand(*shape, law.size)
    return replace(inputs, q0=inputs.q0.expand(shape), qd0=inputs.qd0.expand(shape), **found)


def required_substeps(plant: Plant, friction: Friction, sample_time: float) -> int:
    """Integration steps per sample that keep friction stable at rest, where it is steepest.

    Linearised there, friction damps each joint: M(q) d(qd)/dt = -D qd. The fastest mode decays at
    the largest eigenvalue lambda of M^-1 D, over all poses, so h lambda must stay below 2.785.
    """
    damping = friction.zero_velocity_damping()
    if not torch.isfinite(damping).all():
        raise ValueError(
            f"the slope of friction at rest must be finite, got {damping.tolist()}; in place of "
            "speed**n with n < 1 use (speed**2 + small)**(n / 2)."
        )
    rate = plant.decay_rate(damping)
    return max(1, int(torch.ceil(rate.max() * (sample_time / RK4_STABILITY * (1 - 1e-9)))))


def require_stability(system: System, inputs: RolloutInputs) -> None:
    """Refuse friction too steep at rest for stable Runge-Kutta steps."""
    plant, friction = system.plant, system.friction
    if isinstance(friction, NoFriction):
        return
    sample_time = float(inputs.step.max())
    longest_step = sample_time / inputs.substeps
    excess = _fastest_decay(system) * longest_step / RK4_STABILITY
    # The same tolerance as in `required_substeps`, so that its number is never refused.
    if not excess * (1 - 1e-9) > 1:  # false of NaN
        return
    rows = friction.zero_velocity_damping().reshape(-1, plant.joints)
    alone = torch.stack([plant.decay_rate(row.diag()) for row in rows]).amax(0)
    joint = int(alone.argmax())
    v_smooth = getattr(friction, "v_smooth", float("nan"))
    raise ValueError(
        f"friction is too steep at rest for steps of {longest_step:g} s, most at joint "
        f"{joint + 1} with a slope of {float(rows[:, joint].max()):.3g} N m s/rad: it damps "
        f"{excess:.3g} times as fast as RK4 can integrate. "
        f"Use substeps={required_substeps(plant, friction, sample_time)} or "
        # 5 % more outweighs the rounding to two digits.
        f"v_smooth >= {1.05 * v_smooth * excess:.2g} (now {v_smooth:g})."
    )


def _fastest_decay(system: System) -> float:
    """Decay rate of the fastest mode at rest [1/s], cached for the same system and values.

    A derivative and eigenvalues take as long as simulating a few thousand steps.
    """
    if isinstance(system.fingerprint, codegen.Incomparable):
        return float(system.plant.decay_rate(system.friction.zero_velocity_damping()).max())
    key = system.fingerprint, tuple(map(codegen.content, system.tensors.values()))
    if key not in _decay_rates:
        if len(_decay_rates) >= KEPT_RATES:
            _decay_rates.clear()
        rates = system.plant.decay_rate(system.friction.zero_velocity_damping())
        _decay_rates[key] = float(rates.max())
    return _decay_rates[key]

"""Compiled rollouts, cached by everything that plant and friction read.

Code is compiled once for all plants and friction models with the same computation: parameters and
buffers are inputs of the compiled code, so a fit may change them between calls. Constants, whether
in an attribute, a global or a closure, are part of the code; a change of one is detected.
"""

import logging
from collections import OrderedDict
from collections.abc import Hashable, Mapping
from dataclasses import dataclass
from typing import Any, Literal, get_args

import torch
from torch import Tensor, nn

from nfriction import codegen
from nfriction.simulation.memory_step import memory_of
from nfriction.simulation.protocols import RolloutInputs, StepFunction
from nfriction.simulation.rk4 import rk4_step, simulate_eager

logger = logging.getLogger(__name__)

Backend = Literal["auto", "compiled", "torch"]
# Compiled structures kept in memory, a few hundred kilobytes each.
KEPT = 32

# By the fingerprint of plant and friction, cheap enough for every call, and by the graph: a changed
# fingerprint needs a new trace, but only a changed graph needs another compilation.
_known: OrderedDict[Hashable, "codegen.CompiledRollout | codegen.CodegenError"] = OrderedDict()
_compiled_graphs: OrderedDict[Hashable, "codegen.CompiledRollout"] = OrderedDict()
_warned: set[str] = set()


@dataclass(frozen=True)
class System:
    """Plant and friction, with a fingerprint that reveals a later change."""

    plant: Any
    friction: Any
    tensors: Mapping[str, Tensor]  # floating-point ones, by "plant." or "friction." and name
    fingerprint: Hashable  # of all else that they read, or the error that prevents one

    @classmethod
    def of(cls, plant: Any, friction: Any) -> "System":
        """The two in their present state."""
        modules = {"plant": plant, "friction": friction}
        modules = {name: m for name, m in modules.items() if isinstance(m, nn.Module)}
        tensors = {
            f"{prefix}.{name}": value
            for prefix, module in modules.items()
            for name, value in (*module.named_parameters(), *module.named_buffers())
            if value.is_floating_point()
        }
        try:
            found = codegen.fingerprint(modules.values(), plant, friction)
        except codegen.Incomparable as reason:
            found = reason.with_traceback(None)
        return cls(plant, friction, tensors, found)


def wants_compiled(backend: Backend, q: Tensor, gradients: bool) -> bool:
    """True if compiled code should be tried."""
    if backend not in get_args(Backend):
        raise ValueError(f"`backend` must be one of {get_args(Backend)}, got {backend!r}.")
    able = not gradients and q.dtype == torch.float64 and q.device.type == "cpu"
    if backend == "compiled" and not able:
        raise ValueError(
            'backend="compiled" needs float64 on the CPU and records no gradients; use '
            'backend="torch", or `gradients=False`.'
        )
    return backend != "torch" and able


def integrate_compiled(
    system: System,
    inputs: RolloutInputs,
    backend: Backend,
    threads: int,
    parameters: Mapping[str, Tensor] | None = None,
    step_function: StepFunction = rk4_step,
) -> tuple[Tensor, ...] | None:
    """States at every sample: q, qd, qdd, each (*batch, steps + 1, joint), and that of the law.

    None if compilation fails with `backend="auto"`, so that eager torch has to be used. Parameters
    of the friction model that replace its own are given by name, (*batch, *its shape).
    """
    plant, friction = system.plant, system.friction
    if not all(isinstance(m, nn.Module) for m in (plant, friction)):
        if backend == "auto":
            return None
        raise codegen.CodegenError(
            "only a plant and a friction model that are torch modules can be compiled; use "
            'backend="torch".'
        )
    if isinstance(system.fingerprint, codegen.Incomparable):
        _warn_once(
            "compiled rollouts are traced again in every call, because they may read "
            f"{system.fingerprint}"
        )
        compiled = _attempt(plant, friction, step_function)
    else:
        key = system.fingerprint, step_function
        compiled = _known.get(key) or _attempt(plant, friction, step_function)
        _keep(_known, key, compiled)
    if isinstance(compiled, codegen.CodegenError):
        if backend != "auto":
            raise compiled
        return None
    dims = inputs.q0.ndim - 1
    values = {name: system.tensors[name].detach() for name in compiled.parameter_names}
    for name, value in (parameters or {}).items():
        values[f"friction.{name}"] = value.detach().reshape(-1, *value.shape[dims:])
    return compiled(inputs, values, threads)


def _attempt(
    plant: Any, friction: Any, step_function: StepFunction
) -> "codegen.CompiledRollout | codegen.CodegenError":
    """A compiled rollout, or the reason why there is none."""
    try:
        _check_compilable(plant, friction)
        traced = codegen.CompiledRollout(plant, friction, step_function)
        found = _compiled_graphs.get(traced.digest)
        if found is None:
            traced.check(lambda inputs: simulate_eager(plant, friction, inputs, step_function))
            found = traced
    except codegen.SelfCheckFailed:
        raise
    except codegen.CodegenError as error:
        _warn_once(f"rollouts run in eager torch, because they cannot be compiled: {error}")
        return error.with_traceback(None)
    _keep(_compiled_graphs, found.digest, found)
    return found


def _keep(cache: OrderedDict[Hashable, Any], key: Hashable, value: Any) -> None:
    """Keep the most recent entries."""
    cache[key] = value
    cache.move_to_end(key)
    if len(cache) > KEPT:
        cache.popitem(last=False)


def _warn_once(message: str) -> None:
    if message not in _warned:
        _warned.add(message)
        logger.warning("%s", message)


def _check_compilable(plant: Any, friction: Any) -> None:
    """Refuse modules that compiled code would misinterpret."""
    for module in (plant, friction):
        for name, value in (*module.named_parameters(), *module.named_buffers()):
            if value.is_floating_point() and value.dtype != torch.float64:
                raise codegen.CodegenError(
                    f"compiled rollouts need float64, but `{name}` is {value.dtype}"
                )
    with torch.no_grad():
        device = next((t.device for t in (*plant.parameters(), *plant.buffers())), None)
        rest = torch.zeros(plant.joints, dtype=torch.float64, device=device)
        held = friction.coefficients(rest, rest)
        law, load = memory_of(friction), plant.load(rest, rest)
        if law is None:
            tau_f = friction.torque(rest, load, held)
        else:
            tau_f = law.torque(rest.new_zeros(plant.joints, law.size), rest, load, held)
        if plant.forward_dynamics(rest, rest, tau_f).shape != rest.shape:
            raise codegen.CodegenError(
                "a plant or friction model with a batch of its own cannot be compiled"
            )

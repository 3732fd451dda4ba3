"""Compiled rollouts, found by the structure of plant and friction and kept for later calls.

What was compiled once serves every plant and friction model of the same structure: parameters and
buffers are inputs of the compiled code, so a fit may change them between calls.
"""

import logging
from collections import OrderedDict
from collections.abc import Hashable, Mapping
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor, nn

from nfriction import codegen

logger = logging.getLogger(__name__)

Backend = Literal["auto", "torch", "c", "numba"]
# Compiled structures kept in memory; each is some hundred kilobytes.
KEPT = 32

_cache: OrderedDict[Hashable, "codegen.CompiledRollout | None"] = OrderedDict()


class NoFriction(nn.Module):
    """Stands where a compiled rollout needs a friction model and there is none."""

    def __init__(self, joints: int) -> None:
        super().__init__()
        self.joints = joints

    def coefficients(self, qd: Tensor, qdd: Tensor) -> Tensor:
        return torch.zeros_like(qd)[..., None]

    def torque(self, qd: Tensor, load: Tensor, coefficients: Tensor) -> Tensor:
        return torch.zeros_like(qd)


def wants_compiled(backend: Backend, q: Tensor, gradients: bool) -> bool:
    """Whether a rollout should be tried in compiled code.

    Raises:
        ValueError: if a compiled backend is asked for together with gradients or off the CPU.
    """
    if backend not in ("auto", "torch", "c", "numba"):
        raise ValueError(f'`backend` is "auto", "torch", "c" or "numba", got {backend!r}.')
    able = not gradients and q.dtype == torch.float64 and q.device.type == "cpu"
    if backend in ("c", "numba") and not able:
        raise ValueError(
            f'backend="{backend}" needs float64 on the CPU and records no gradients; use '
            'backend="torch", or `gradients=False`.'
        )
    return backend != "torch" and able


def integrate_compiled(
    plant: Any,
    friction: Any,
    q: Tensor,
    qd: Tensor,
    tau: Tensor,
    step: Tensor,
    substeps: int,
    measured: tuple[Tensor, Tensor] | None,
    backend: Backend,
    threads: int,
    parameters: Mapping[str, Tensor] | None = None,
    memory: Tensor | None = None,
) -> tuple[Tensor, ...] | None:
    """States at every sample: q, qd, qdd, each (*batch, steps + 1, joint).

    Args:
        parameters: values of the friction model's parameters by name that differ from its own,
            each (*batch, *the parameter's shape); the other arguments as in `integrate`.

    Returns:
        None where `backend="auto"` finds no way to compile, so that eager torch serves.

    Raises:
        CodegenError: if a backend asked for by name cannot serve.
    """
    compiled = _compiled(plant, friction or NoFriction(plant.joints), backend)
    if compiled is None:
        return None
    batch, joints = q.shape[:-1], q.shape[-1]

    def rows(x: Tensor, trailing: int) -> Tensor:
        """Candidates on one leading axis; what all share keeps none."""
        x = x.detach()
        if x.ndim > trailing:
            x = x.expand(*batch, *x.shape[x.ndim - trailing :]).reshape(-1, *x.shape[-trailing:])
        # An expanded constant needs no value for each step.
        return x[0] if x.ndim == trailing and not x.stride(0) else x

    def finer(x: Tensor, trailing: int) -> Tensor:
        """Values of samples repeated for their substeps."""
        every = x.ndim >= trailing and substeps > 1
        return x.repeat_interleave(substeps, -trailing) if every else x

    steps = step.shape[-1] * substeps
    drive = None
    if measured is not None:
        drive = (finer(rows(measured[0], 2), 2), finer(rows(measured[1], 2), 2))
    values = _values(plant, friction, compiled.parameter_names)
    for name, value in (parameters or {}).items():
        own = value.shape[len(batch) :]
        values[f"friction.{name}"] = value.detach().reshape(-1, *own)
    # Coefficients with a memory are held as a controller would, at the sample rate.
    remembers = getattr(friction, "state_size", 0) > 0
    found = compiled(
        q.detach().reshape(-1, joints).contiguous(),
        qd.detach().reshape(-1, joints).contiguous(),
        steps=steps,
        time_step=finer(rows(step, 1) / substeps, 1),
        tau=finer(rows(tau, 2), 2),
        parameters=values,
        drive=drive,
        threads=threads,
        record_every=substeps,
        hold_for=substeps if remembers else 1,
        memory=None if memory is None else rows(memory, 2).reshape(-1, *memory.shape[-2:]),
    )
    return tuple(x.reshape(*batch, -1, joints) for x in (found.q, found.qd, found.qdd))


def _compiled(plant: Any, friction: Any, backend: Backend) -> "codegen.CompiledRollout | None":
    """The compiled rollout of this structure, from the cache where it is there."""
    if backend == "torch":
        return None
    if not all(isinstance(m, nn.Module) for m in (plant, friction)):
        if backend == "auto":
            return None
        raise codegen.CodegenError(
            "only a plant and a friction model that are torch modules can be compiled; use "
            'backend="torch".'
        )
    key = (backend, _structure(plant), _structure(friction))
    if key in _cache:
        _cache.move_to_end(key)
        return _cache[key]
    compiled = None
    try:
        _check_compilable(plant, friction)
        compiled = codegen.compile_rollout(plant, friction, backend=backend)
    except codegen.SelfCheckFailed:
        raise
    except codegen.CodegenError as error:
        if backend != "auto":
            raise
        logger.warning("rollouts run in eager torch, as they cannot be compiled: %s", error)
    _cache[key] = compiled
    while len(_cache) > KEPT:
        _cache.popitem(last=False)
    return compiled


def _check_compilable(plant: Any, friction: Any) -> None:
    """Refuse modules that compiled code would take for others than they are."""
    for module in (plant, friction):
        for name, value in (*module.named_parameters(), *module.named_buffers()):
            if value.is_floating_point() and value.dtype != torch.float64:
                raise codegen.CodegenError(
                    f"compiled rollouts need float64, but `{name}` is {value.dtype}"
                )
    with torch.no_grad():
        rest = torch.zeros(plant.joints, dtype=torch.float64)
        held = friction.coefficients(rest, rest)
        tau_f = friction.torque(rest, plant.load(rest, rest), held)
        if plant.forward_dynamics(rest, rest, tau_f).shape != rest.shape:
            raise codegen.CodegenError(
                "a plant or friction model with a batch of its own cannot be compiled"
            )


def _structure(module: nn.Module) -> Hashable:
    """All that compiled code bakes in: classes, plain attributes, shapes, tables of indices."""
    parts: list[Hashable] = []
    for name, part in module.named_modules():
        plain = tuple(
            (key, _baked(value))
            for key, value in sorted(vars(part).items())
            if not (key.startswith("_") and isinstance(value, list | dict))
        )
        parts.append((name, type(part), plain))
    for name, tensor in (*module.named_parameters(), *module.named_buffers()):
        baked = None if tensor.is_floating_point() else tensor.cpu().numpy().tobytes()
        parts.append((name, tuple(tensor.shape), tensor.dtype, baked))
    return tuple(parts)


def _baked(value: Any) -> Hashable:
    """A plain attribute as part of a key; functions and objects count as themselves."""
    if isinstance(value, Tensor):
        value = value.detach().cpu().numpy()
    if isinstance(value, np.ndarray):
        return value.shape, value.tobytes()
    if isinstance(value, list | tuple):
        return (type(value), *map(_baked, value))
    return value if isinstance(value, Hashable) else repr(value)


def _values(plant: nn.Module, friction: Any, names: Any) -> dict[str, Tensor]:
    """The parameters and buffers of these very modules."""
    found = {}
    for prefix, module in (("plant", plant), ("friction", friction)):
        if isinstance(module, nn.Module):
            for name, value in (*module.named_parameters(), *module.named_buffers()):
                found[f"{prefix}.{name}"] = value.detach()
    return {name: value for name, value in found.items() if name in names}

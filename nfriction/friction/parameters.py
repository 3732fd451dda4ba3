"""Parameters of a schedule: checks of given values, and derivatives of the coefficients."""

from __future__ import annotations

import math
import reprlib
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from inspect import signature
from typing import Any

import numpy as np
import torch
from torch import Tensor


def positive_number(name: str, value: object, unit: str = "") -> float:
    """The value as a positive finite number; otherwise raise an error that names it."""
    try:
        number = float(value)  # type: ignore[arg-type]
    except (TypeError, ValueError, OverflowError):
        # NaN fails every comparison, so a single message covers all cases.
        number = math.nan
    if not 0 < number < math.inf:
        unit = f" [{unit}]" if unit else ""
        raise ValueError(f"`{name}` must be positive and finite{unit}, got {reprlib.repr(value)}.")
    return number


def as_tensor(name: str, values: Any, like: Tensor | None = None) -> Tensor:
    """A tensor unchanged; an array or list in double precision or with the type of `like`."""
    if isinstance(values, Tensor) and like is None:
        return values
    dtype, device = (torch.float64, None) if like is None else (like.dtype, like.device)
    try:
        if isinstance(values, np.ndarray):
            # torch takes neither reversed nor big-endian arrays, and drops imaginary parts.
            values = values.astype(np.float64, casting="same_kind")
        return torch.as_tensor(values, dtype=dtype, device=device)
    # Ragged lists, strings, and integers too large for a float.
    except (TypeError, ValueError, RuntimeError, OverflowError) as error:
        raise ValueError(
            f"{name} must be an array of numbers, got {reprlib.repr(values)}."
        ) from error


def checked_coefficients(
    values: Tensor | Sequence, like: Tensor, names: Sequence[str], positive: Tensor
) -> Tensor:
    """Given coefficients as a tensor of the shape of `like`, (joint, *cells, coefficient).

    Args:
        values: of that shape, (joint, coefficient) or (coefficient,).
        like: a tensor of the wanted shape and type.
        names, positive: names of the coefficients, and which of them must not be negative.
    """
    given = as_tensor("coefficients", values, like)
    joints, count = like.shape[0], like.shape[-1]
    # Before any broadcast: a single column would silently be used for all coefficients.
    if given.shape not in (like.shape, (joints, count), (count,)):
        whole = "" if like.ndim == 2 else f"the whole table {tuple(like.shape)}, "
        raise ValueError(
            f"coefficients must be {whole}(joint, coefficient) = {(joints, count)} or one row "
            f"for all joints ({', '.join(names)}), got shape {tuple(given.shape)}."
        )
    if given.shape == (joints, count):
        given = given.reshape(joints, *(1,) * (like.ndim - 2), count)
    given = given.expand(like.shape)
    bad = ~torch.isfinite(given) | (positive & (given < 0))
    if bad.any():
        where = tuple(int(i) for i in bad.nonzero()[0])
        rule = "finite and not negative" if positive[where[-1]] else "finite"
        raise ValueError(
            f"`{names[where[-1]]}` of joint {where[0] + 1} must be {rule}, got {given[where]:g}."
        )
    return given


def require_options(
    of: str, make: Callable[..., object], given: Iterable[str], own: Iterable[str] = ()
) -> None:
    """Raise ValueError for options of neither a schedule nor the model that creates it."""
    # Options follow the law, the joints and the initial values; cells are internal to a schedule.
    taken = [p for p in signature(make).parameters.values() if p.name != "cells"][3:]
    if any(p.kind is p.VAR_KEYWORD for p in taken):
        # It passes options on to a callee, which checks them.
        return
    known = [*own, *(p.name for p in taken)]
    if unknown := [name for name in given if name not in known]:
        raise ValueError(
            f"{of} has no option {', '.join(unknown)}; it has {', '.join(known) or 'none'}."
        )


@dataclass(frozen=True)
class Sensitivity:
    """Derivatives of the coefficients at given motions.

    A parameter affects the coefficients of only one joint. The parameters form groups: outputs are
    sums of features weighted by the parameters, so the derivative is a product, which is stored as
    its two factors. The outputs share the features and have parameters (joint, output, feature), or
    share the parameters (joint, feature) and have features of their own.

    Attributes:
        factors: computes, for each group, the derivatives of the coefficients with respect to the
            outputs, (sample, joint, coefficient, output), and the features, (sample, joint,
            feature) or (sample, joint, output, feature); most of the work, and not needed for
            derivatives by the motion alone.
        qd: with respect to the joint's own velocity, (sample, joint, coefficient).
        qdd: with respect to the joint's own acceleration, (sample, joint, coefficient).
    """

    factors: Callable[[], tuple[tuple[Tensor, Tensor], ...]]
    qd: Tensor
    qdd: Tensor

    @classmethod
    def of_constants(cls, by_parameter: Tensor, motion: Tensor) -> Sensitivity:
        """Derivatives of coefficients that do not depend on the motion.

        Args:
            by_parameter: (coefficient, parameter of a joint), or (sample, joint, ...) in front.
            motion: joint velocities, (sample, joint), used for their shape.
        """
        count = by_parameter.shape[-2]
        zero = by_parameter.new_zeros(()).expand(*motion.shape, count)
        one = torch.eye(count).to(by_parameter).expand(*motion.shape, -1, -1)
        whole = by_parameter.expand(*motion.shape, count, -1)
        return cls(lambda: ((one, whole),), zero, zero)

    @property
    def parameters(self) -> Tensor:
        """Full derivative by the parameter vector, (sample, coefficient, parameter)."""
        # Large, but only computed for short segments; sums over a motion use `contract`.
        shared, own = "sjko,sjf->skjof", "sjko,sjof->skjf"
        whole = [
            torch.einsum(shared if features.ndim == 3 else own, mix, features).flatten(2)
            for mix, features in self.factors()
        ]
        return torch.cat(whole, -1)

    @property
    def joint(self) -> Tensor:
        """The joint whose coefficients each parameter affects, (parameter,)."""
        rows = []
        for mix, features in self.factors():
            joints = torch.arange(mix.shape[1], device=mix.device)
            outputs = mix.shape[-1] if features.ndim == 3 else 1
            rows.append(joints.repeat_interleave(outputs * features.shape[-1]))
        return torch.cat(rows)

    # A search rejects derivatives that overflow; a warning would be noise.
    @np.errstate(over="ignore", invalid="ignore")
    def contract(self, cotangent: Tensor, out: Tensor) -> None:
        """Write the parameter derivatives of quantities that depend on the coefficients.

        Args:
            cotangent: derivatives with respect to the coefficients at many samples, (block, row,
                sample, joint, coefficient); the blocks contain this sensitivity's samples in order.
            out: receives the derivatives, (block, row, parameter).
        """
        blocks, _, samples = cotangent.shape[:3]
        by_sample, place, groups = cotangent.permute(0, 2, 3, 1, 4), 0, self.factors()
        # Groups often have the same outputs. (block, joint, row, sample, output)
        mixes = {id(mix): mix.unflatten(0, (blocks, samples)) for mix, _ in groups}
        mixed = {k: (by_sample @ mix).permute(0, 2, 3, 1, 4) for k, mix in mixes.items()}
        for mix, features in groups:
            joints, outputs, count = mix.shape[1], mix.shape[-1], features.shape[-1]
            shape = (joints, outputs, count) if features.ndim == 3 else (joints, count)
            columns = slice(place, place := place + math.prod(shape))
            # (block, joint, row, ...); NumPy's products write there, torch's would be copied.
            found = out[..., columns].unflatten(-1, shape).transpose(1, 2)
            constant = mix.stride(0) == features.stride(0) == 0  # over the samples
            left, right = mixed[id(mix)], features.unflatten(0, (blocks, samples)).transpose(1, 2)
            if features.ndim == 3:
                # Features lie one after another for each sample, as the products read them.
                left, right = left.mT, right.contiguous().unsqueeze(2)
            elif constant:
                left, right = left.sum(3), right[0, :, 0]
            else:
                left, right = left.flatten(3), right.flatten(2, 3)
            np.matmul(left.numpy(), right.numpy(), out=found.numpy())

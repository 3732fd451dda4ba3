"""Batched arguments as flat arrays with strides, which is how compiled code reads them."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from torch import Tensor

Array = np.ndarray


@dataclass(frozen=True)
class Series:
    """A quantity over candidates and steps; a stride of zero repeats one value.

    Attributes:
        values: flat and contiguous.
        rows: number of candidates given, 1 where one serves all.
        row, step: strides in elements.
    """

    values: Array
    rows: int
    row: int
    step: int


def to_array(value: Any) -> Array:
    """A float64 array from NumPy, torch or numbers."""
    if isinstance(value, Tensor):
        value = value.detach().cpu().numpy()
    return np.asarray(value, dtype=np.float64)


def series(name: str, value: Any, steps: int, width: tuple[int, ...]) -> Series:
    """`value` of shape width, (steps, *width) or (candidate, steps, *width).

    Raises:
        ValueError: for any other shape.
    """
    array = to_array(value)
    full = (steps, *width)
    if array.shape == width:
        return Series(np.ascontiguousarray(array).reshape(-1), 1, 0, 0)
    if array.shape == full:
        array = array[None]
    if array.shape[1:] != full:
        shown = ", ".join(map(str, full))
        raise ValueError(f"`{name}` must be ({shown}) or (candidate, {shown}), got {array.shape}.")
    values = np.ascontiguousarray(array).reshape(-1)
    stride = int(np.prod(width, dtype=int))
    return Series(values, len(array), steps * stride if len(array) > 1 else 0, stride)


def states(name: str, value: Any, joints: int) -> Array:
    """`value` of shape (candidate, joint) as an array.

    Raises:
        ValueError: for any other shape.
    """
    array = to_array(value)
    if array.ndim != 2 or array.shape[1] != joints:
        raise ValueError(
            f"`{name}` must be (candidate, {joints}), got {array.shape}; a single candidate is "
            f"`{name}[None]`."
        )
    return array


def candidates(rows: Mapping[str, int]) -> int:
    """The one number of candidates that all arguments agree on; single rows serve all.

    Raises:
        ValueError: if they disagree.
    """
    counts = {count for count in rows.values() if count != 1} or {1}
    if len(counts) > 1:
        shown = ", ".join(f"`{name}` {count}" for name, count in rows.items() if count != 1)
        raise ValueError(f"the numbers of candidates must agree or be 1, got {shown}.")
    return counts.pop()


def repeated(array: Array, rows: int) -> Array:
    """`array` with its single row repeated `rows` times, flat and contiguous."""
    return np.ascontiguousarray(np.broadcast_to(array, (rows, *array.shape[1:]))).reshape(-1)


def parameter_rows(
    current: Mapping[str, Array], overrides: Mapping[str, Any]
) -> tuple[Array, dict[str, int]]:
    """Parameter vectors, one row a candidate (or one for all), and the rows that each name gave.

    Args:
        current: the modules' own values by name, in order.
        overrides: values by name, of the parameter's shape or (candidate, *shape).

    Raises:
        ValueError: for an unknown name or a shape that does not fit.
    """
    unknown = [name for name in overrides if name not in current]
    if unknown:
        raise ValueError(f"no parameter {unknown}; there are {list(current)}.")
    given = {name: to_array(value) for name, value in overrides.items()}
    for name, array in given.items():
        shape = current[name].shape
        if array.shape == shape:
            given[name] = array[None]
        elif array.shape[1:] != shape or not array.ndim:
            raise ValueError(
                f"parameter `{name}` must be {shape} or (candidate, *{shape}), got {array.shape}."
            )
    counts = {f"parameters[{name!r}]": len(array) for name, array in given.items()}
    rows = candidates(counts)
    columns: Iterable[Array] = (
        np.broadcast_to(given.get(name, own[None]), (rows, *own.shape)).reshape(rows, -1)
        for name, own in current.items()
    )
    return np.concatenate([np.empty((rows, 0)), *columns], axis=1), counts

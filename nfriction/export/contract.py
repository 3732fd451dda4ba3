"""What every artefact carries so that it can be used safely, and how one is proven equal."""

import copy
import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from nfriction.export.controller import AnyController, controller_of
from nfriction.export.errors import ContractError, first_line
from nfriction.export.filtered import FilteredController
from nfriction.export.parity import COEFFICIENT_SLACK, Parity, compare
from nfriction.export.points import draw, trials
from nfriction.export.unfiltered import NOT_FINITE, OUTSIDE, SATURATED, Controller, MemoryController
from nfriction.friction.models import FrictionModel
from nfriction.io import strict_json
from nfriction.io.model_info import ModelInfo, describe

__all__ = [
    "COEFFICIENT_SLACK",
    "NOT_FINITE",
    "OUTSIDE",
    "SATURATED",
    "AnyController",
    "Contract",
    "ContractError",
    "Controller",
    "FilteredController",
    "MemoryController",
    "Parity",
    "compare",
    "contract_of",
    "controller_of",
    "run_through",
    "verify",
]

FORMAT, SCHEMA = "nfriction controller", 1
# Largest torque error over full scale that a target in double, or in single precision, may show;
# in single precision it is more where the model itself is steep.
TOLERANCE = {"float64": 1e-12, "float32": 5e-7}
OUTPUTS = ("tau_f", "coefficients", "status")
MOST_VECTORS, MOST_STATES = 100_000, 1000

Runner = Callable[..., Sequence[Any]]


@dataclass(frozen=True, eq=False)
class Contract:
    """What an artefact says of itself.

    Attributes:
        description: model, joint names in order, units, sample time, input ranges, hashes of
            parameters and training data, versions; plain JSON.
        inputs: test vectors by name of the input, each (vector, joint). Where the controller has a
            state they are successive samples, the first one on `initial_state`.
        outputs: `tau_f`, `coefficients` and `status` that the model gives.
        tolerance: largest torque error over full scale that an artefact may show [-].
    """

    description: Mapping[str, Any]
    inputs: Mapping[str, Tensor]
    outputs: Mapping[str, Tensor]
    tolerance: float = TOLERANCE["float64"]

    @property
    def state_size(self) -> int:
        """Numbers a joint that the controller carries from sample to sample."""
        return int(self.description["state_size"])

    def to_dict(self) -> dict[str, Any]:
        """As plain JSON; NaN and infinities are the strings "nan", "inf" and "-inf"."""
        vectors = {
            side: {name: _plain(x) for name, x in values.items()}
            for side, values in (("inputs", self.inputs), ("outputs", self.outputs))
        }
        return {**self.description, "tolerance": self.tolerance, "vectors": vectors}

    def to_json(self) -> str:
        """The same as text, the same to the byte for the same model."""
        return json.dumps(self.to_dict(), allow_nan=False)

    @classmethod
    def from_json(cls, text: str | bytes) -> "Contract":
        """Read what `to_json` wrote.

        Raises:
            ContractError: if it is not of this form.
        """
        try:
            content = strict_json.parse(text)
        except (ValueError, RecursionError) as error:
            raise ContractError(f"the metadata are no JSON, or cut short ({error}).") from error
        if not isinstance(content, dict) or content.get("format") != FORMAT:
            raise ContractError("the metadata are not those of a controller of nfriction.")
        if content.get("schema") != SCHEMA:
            raise ContractError(
                f"the metadata's schema is {str(content.get('schema'))[:40]!r}, not {SCHEMA}; "
                "another version wrote it."
            )
        try:
            vectors = content.pop("vectors")
            tolerance = float(content.pop("tolerance"))
            inputs, outputs = (
                {str(name): _tensor(name, x) for name, x in vectors[side].items()}
                for side in ("inputs", "outputs")
            )
        except (
            KeyError, TypeError, AttributeError, ValueError, RuntimeError, OverflowError,
        ) as error:  # fmt: skip
            told = first_line(error)
            raise ContractError(f"the test vectors are missing or damaged ({told}).") from error
        _check_vectors(inputs, outputs, tolerance)
        _check_interface(content, list(inputs))
        outputs["status"] = outputs["status"].to(torch.int32)
        return cls(content, inputs, outputs, tolerance)


def contract_of(
    model: FrictionModel,
    controller: AnyController,
    info: ModelInfo | None = None,
    *,
    dtype: str = "float64",
) -> Contract:
    """The contract of a controller, with its test vectors.

    Args:
        model: the model that the controller was made of.
        controller: what is exported.
        info: what to say of the model besides its parameters.
        dtype: "float64" or "float32", in which the target computes.

    Raises:
        ValueError: for another dtype, or if the joints' names are not one a joint.
    """
    if dtype not in TOLERANCE:
        raise ValueError(f'`dtype` must be "float64" or "float32", got {dtype!r}.')
    names = ("q", "load") if isinstance(controller, FilteredController) else ("qd", "qdd", "load")
    inputs = trials(controller)
    if dtype == "float32":
        # What the target will be given; at the edges of the range a rounding decides the status.
        inputs = tuple(x.float().double() for x in inputs)
    outputs = run_through(controller, inputs)
    description = {
        **describe(model, info or ModelInfo()),
        "format": FORMAT,
        "schema": SCHEMA,
        "dtype": dtype,
        **_interface(controller, names),
    }
    # Once through JSON, so that tuples are lists here as they are for a reader.
    description = json.loads(json.dumps(description, allow_nan=False))
    return Contract(
        description,
        dict(zip(names, inputs, strict=True)),
        dict(zip(OUTPUTS, outputs, strict=True)),
        TOLERANCE[dtype] if dtype == "float64" else _single_tolerance(controller),
    )


def _single_tolerance(controller: AnyController) -> float:
    """What a target in single precision may err.

    A network that is steep in its inputs passes their roundings on: twice what torch errs in
    single precision over 20,000 samples is allowed where that is more.
    """
    inner = controller.inner if isinstance(controller, FilteredController) else controller
    inputs = tuple(x.float() for x in draw(inner, 20_000, seed=7))
    single = copy.deepcopy(inner).float()
    doubled = tuple(x.double() for x in inputs)
    if isinstance(inner, MemoryController) and isinstance(single, MemoryController):
        # Whatever memory: that of a first sample.
        state = inner.initial_state(*doubled[:2])
        expected, found = inner(*doubled, state)[:3], single(*inputs, state.float())[:3]
    else:
        expected, found = inner(*doubled), single(*inputs)
    parity = compare(expected, found, TOLERANCE["float32"])
    worst = max(parity.torque_error, parity.coefficient_error / COEFFICIENT_SLACK)
    return max(TOLERANCE["float32"], float(f"{2.0 * worst:.1e}"))


def _interface(controller: AnyController, inputs: Sequence[str]) -> dict[str, Any]:
    """What goes in and comes out, and what happens at the edges."""
    inner = controller.inner if isinstance(controller, FilteredController) else controller
    assert isinstance(inner, (Controller, MemoryController))
    beyond = "of clamped inputs" if inner.clamps else "as the model has them there"
    return {
        "inputs": list(inputs),
        "outputs": list(OUTPUTS),
        "state_size": 0 if isinstance(controller, Controller) else controller.state_size,
        "torque_limit": inner.torque_limit.tolist() if inner.limited else None,
        "filter": {
            "cutoff_hz": controller.cutoff_hz,
            "damping": controller.damping,
            "sample_time": controller.sample_time,
        }
        if isinstance(controller, FilteredController)
        else None,
        "status_bits": {"outside": OUTSIDE, "not_finite": NOT_FINITE, "saturated": SATURATED},
        "edges": {
            "outside_input_ranges": f"coefficients {beyond}; the law goes on",
            "not_finite": "NaN torque and coefficients of that joint; its state stays",
        },
    }


@torch.no_grad()
def run_through(controller: Callable[..., Any], inputs: Sequence[Tensor]) -> tuple[Tensor, ...]:
    """Torque, coefficients and status of samples in order, (sample, joint, ...).

    Args:
        controller: of `controller_of`, or a module with the same methods.
        inputs: (sample, joint) each.
    """
    if isinstance(controller, Controller):
        return controller(*inputs)
    assert isinstance(controller, (MemoryController, FilteredController))
    first = [x[0] for x in inputs]
    if isinstance(controller, MemoryController):
        state = controller.initial_state(first[0], first[1])
    else:
        state = controller.initial_state(first[0])
    found = []
    for sample in zip(*inputs, strict=True):
        *outputs, state = controller(*sample, state)
        found.append(outputs)
    return tuple(torch.stack(column) for column in zip(*found, strict=True))


def verify(run: Runner, contract: Contract) -> Parity:
    """Run an artefact over the contract's test vectors.

    Args:
        run: takes the inputs in their order, each a float64 tensor (vector, joint), and gives
            torque, coefficients and status for all of them; a target with a state goes through
            them in order, from its initial state at the first.
        contract: what the artefact promises.
    """
    found = run(*contract.inputs.values())
    return compare(tuple(contract.outputs.values()), found, contract.tolerance)


def _plain(x: Tensor) -> list[Any]:
    """Nested lists of numbers, with strings for those that JSON does not know."""

    def spelled(value: Any) -> Any:
        if isinstance(value, list):
            return [spelled(v) for v in value]
        return value if math.isfinite(value) else str(value)

    return spelled(x.tolist())


def _tensor(name: str, given: Any) -> Tensor:
    """A tensor of nested lists as `_plain` spells them."""

    def number(value: Any) -> Any:
        if isinstance(value, list):
            return [number(v) for v in value]
        if isinstance(value, bool) or (isinstance(value, str) and value not in _SPELLINGS):
            raise ValueError(f"`{name}` holds {str(value)[:40]!r}")
        return float(value)

    if not isinstance(given, list) or len(given) > MOST_VECTORS:
        raise ValueError(f"`{name}` is no list, or too long")
    return torch.tensor(number(given), dtype=torch.float64)


_SPELLINGS = ("nan", "inf", "-inf")


def _check_interface(content: Mapping[str, Any], names: list[str]) -> None:
    """Raise `ContractError` where what a host relies on is not there."""
    size, dtype = content.get("state_size"), content.get("dtype")
    if (
        not isinstance(size, int)
        or isinstance(size, bool)
        or not 0 <= size <= MOST_STATES
        or not isinstance(dtype, str)
        or dtype not in TOLERANCE
        or content.get("inputs") != names
    ):
        raise ContractError("the metadata lack inputs, type or size of the state, or are wrong.")


def _check_vectors(
    inputs: Mapping[str, Tensor], outputs: Mapping[str, Tensor], tolerance: float
) -> None:
    """Raise `ContractError` where test vectors do not fit each other."""
    shapes = {tuple(x.shape) for x in inputs.values()}
    sound = len(shapes) == 1 and tuple(outputs) == OUTPUTS and 0 < tolerance < 1
    if sound:
        shape = shapes.pop()
        given = [tuple(x.shape) for x in outputs.values()]
        sound = len(shape) == 2 and given[0] == given[2] == given[1][:2] == shape
        sound = sound and len(given[1]) == 3 and min(*shape, given[1][2]) > 0
        sound = sound and bool(((outputs["status"] >= 0) & (outputs["status"] < 8)).all())
    if not sound:
        raise ContractError("the test vectors do not fit each other.")

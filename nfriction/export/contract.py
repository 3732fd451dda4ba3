"""Contract of an artefact: description, test vectors and tolerance, and its verification.

Parity is that of torque, coefficients and status over many samples.
"""

import copy
import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from nfriction.export.controller import NOT_FINITE, OUTSIDE, SATURATED, Controller
from nfriction.export.test_vectors import draw_motion, trials
from nfriction.friction.models import FrictionModel
from nfriction.io.files import atomic_write, numbers, parse_json
from nfriction.io.model_file import ModelInfo, describe


class ExportError(RuntimeError):
    """An artefact could not be made, or does not equal its model."""


def first_line(error: Exception) -> str:
    """First line of an error's message that is not empty."""
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return lines[0][:200] if lines else type(error).__name__


class ContractError(ValueError):
    """Metadata of an artefact are absent, damaged or not ours."""


FORMAT, SCHEMA = "nfriction controller", 1
# Largest torque error over full scale that a target in double, or in single precision, may show.
TOLERANCE = {"float64": 1e-12, "float32": 5e-7}
# Coefficients come out of longer sums than the torque, some of them small differences.
COEFFICIENT_SLACK = 20.0
OUTPUTS = ("tau_f", "coefficients", "status")
MOST_VECTORS, MOST_STATES = 100_000, 1000

Runner = Callable[..., Sequence[Any]]


@dataclass(frozen=True)
class Parity:
    """Largest differences of an artefact from its model.

    Attributes:
        points: samples compared.
        torque_error: largest |difference| of the torque over the joint's full scale, which is the
            largest |torque| or that of `Contract.scales`.
        coefficient_error: the same of the coefficients, over the full scale of each.
        edges: samples whose status, or whose NaN, are not those of the model.
        tolerance: largest torque error allowed; the coefficients have 20 times that.
    """

    points: int
    torque_error: float
    coefficient_error: float
    edges: int
    tolerance: float

    @property
    def passed(self) -> bool:
        """True where all of it is within tolerance."""
        return (
            self.points > 0
            and self.torque_error <= self.tolerance
            and self.coefficient_error <= COEFFICIENT_SLACK * self.tolerance
            and not self.edges
        )

    def __str__(self) -> str:
        return (
            f"{self.points} points: torque {self.torque_error:.1e} and coefficients "
            f"{self.coefficient_error:.1e} of full scale, {self.edges} wrong at the edges "
            f"(tolerance {self.tolerance:.0e})"
        )


@dataclass(frozen=True, eq=False)
class Contract:
    """Description of an artefact, with test vectors.

    Attributes:
        description: model, joint names in order, units, sample time, input ranges, hashes of
            parameters and training data, versions; plain JSON.
        inputs: test vectors by name of the input, each (vector, joint). Where the controller has a
            state they are successive samples, the first one on `initial_state`.
        outputs: `tau_f`, `coefficients` and `status` that the model gives.
        scales: full scale of `tau_f`, (joint,), and of `coefficients`, (coefficient,): the largest
            value in the outputs or, where it is a small difference of large numbers, as much as
            its rounding errors call for.
        tolerance: largest torque error over full scale that an artefact may show [-].
    """

    description: Mapping[str, Any]
    inputs: Mapping[str, Tensor]
    outputs: Mapping[str, Tensor]
    scales: Mapping[str, Tensor]
    tolerance: float = TOLERANCE["float64"]

    @property
    def state_size(self) -> int:
        """Numbers a joint that the controller carries from sample to sample."""
        return int(self.description["state_size"])

    def to_dict(self) -> dict[str, Any]:
        """As plain JSON; NaN and infinities are the strings "nan", "inf" and "-inf"."""
        vectors = {
            side: {name: _plain(x.tolist()) for name, x in values.items()}
            for side, values in (("inputs", self.inputs), ("outputs", self.outputs))
        }
        scales = {name: x.tolist() for name, x in self.scales.items()}
        return {
            **self.description, "tolerance": self.tolerance, "scales": scales, "vectors": vectors,
        }  # fmt: skip

    def to_json(self) -> str:
        """As text; the same model gives the same bytes."""
        return json.dumps(self.to_dict(), allow_nan=False)

    @classmethod
    def from_json(cls, text: str | bytes) -> "Contract":
        """Read what `to_json` wrote.

        Raises:
            ContractError: if it is not of this form.
        """
        try:
            content = parse_json(text)
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
            tolerance = numbers("tolerance", content.pop("tolerance"))
            inputs, outputs, scales = (
                {str(name): _tensor(name, x) for name, x in side.items()}
                for side in (vectors["inputs"], vectors["outputs"], content.pop("scales"))
            )
        except (KeyError, TypeError, AttributeError, ValueError, RuntimeError) as error:
            reason = first_line(error)
            raise ContractError(f"the test vectors are missing or damaged ({reason}).") from error
        _check_vectors(inputs, outputs, scales, tolerance)
        _check_interface(content, list(inputs))
        outputs["status"] = outputs["status"].to(torch.int32)
        return cls(content, inputs, outputs, scales, tolerance)


def contract_of(
    model: FrictionModel,
    controller: Controller,
    info: ModelInfo | None = None,
    *,
    dtype: str = "float64",
) -> Contract:
    """Make the contract of a controller, with its test vectors.

    Args:
        model, info: that the controller was made of.
        controller: what is exported.
        dtype: "float64" or "float32", in which the target computes.

    Raises:
        ValueError: for another dtype, or if the joints' names are not one a joint.
    """
    if dtype not in TOLERANCE:
        raise ValueError(f'`dtype` must be "float64" or "float32", got {dtype!r}.')
    inputs = trials(controller)
    if dtype == "float32":
        # As the target will be given them: at the edges of the range a rounding decides the status.
        inputs = tuple(x.float().double() for x in inputs)
    outputs = controller.run(*inputs)
    beyond = "of clamped inputs" if controller.clamps else "as the model has them there"
    description = {
        **describe(model, info or ModelInfo()),
        "format": FORMAT,
        "schema": SCHEMA,
        "dtype": dtype,
        "inputs": controller.inputs,
        "outputs": OUTPUTS,
        "state_size": controller.state_size,
        "torque_limit": controller.torque_limit.tolist() if controller.limited else None,
        "filter": controller.filter_options,
        "status_bits": {"outside": OUTSIDE, "not_finite": NOT_FINITE, "saturated": SATURATED},
        "edges": {
            "outside_input_ranges": f"coefficients {beyond}; the law goes on",
            "not_finite": "NaN torque and coefficients of that joint; its state stays",
        },
    }
    # Once through JSON, so that tuples are lists here as they are for a reader.
    description = json.loads(json.dumps(description, allow_nan=False))
    return Contract(
        description,
        dict(zip(controller.inputs, inputs, strict=True)),
        dict(zip(OUTPUTS, outputs, strict=True)),
        _scales(controller, outputs),
        TOLERANCE[dtype],
    )


def _scales(controller: Controller, outputs: Sequence[Tensor]) -> dict[str, Tensor]:
    """Full scales of torque and coefficients; see `Contract`.

    A coefficient that training has driven to zero is a small difference of numbers that are not
    small, and a steep network passes the roundings of its inputs on. No artefact can then be exact
    to the last digits of the value. How much is lost shows in the model itself: scales are such
    that a target in single precision may err twice as much as torch does in single precision over
    20,000 samples. Roundings of double precision are smaller by a constant factor, so the same
    scale holds for them.
    """
    scales = {
        name: values.abs().nan_to_num(0.0).flatten(0, -2).amax(0)
        for name, values in zip(OUTPUTS[:2], outputs, strict=False)
    }
    model = controller.model
    single = copy.deepcopy(model).float()
    qd, qdd, load = (x.float().double() for x in draw_motion(controller, 20_000, seed=7))
    seen = controller.seen(qd, qdd)[:2]
    # The same memory for both: a rounding must not put a sample into another class.
    motion = (*seen, model.schedule.initial_state(*seen))
    exact = model.schedule.coefficients_from(*motion)
    try:
        rounded = single.schedule.coefficients_from(*(x.float() for x in motion))
        torque = single.torque(qd.float(), load.float(), rounded)
    except RuntimeError:  # a schedule of one's own that computes in double alone
        return scales
    pairs = ((torque, model.torque(qd, load, exact), 1.0), (rounded, exact, COEFFICIENT_SLACK))
    for (name, scale), (found, expected, slack) in zip(scales.items(), pairs, strict=True):
        error = (found - expected).abs().nan_to_num(0.0, 0.0).flatten(0, -2).amax(0)
        scales[name] = torch.maximum(scale, 2.0 * error / (slack * TOLERANCE["float32"]))
    return scales


def verify(run: Runner, contract: Contract) -> Parity:
    """Run an artefact over the contract's test vectors.

    Args:
        run: takes the inputs in their order, each a float64 tensor (vector, joint), and gives
            torque, coefficients and status for all of them; a target with a state goes through
            them in order, from its initial state at the first.
        contract: of the artefact.
    """
    found = run(*contract.inputs.values())
    return compare(tuple(contract.outputs.values()), found, contract.tolerance, contract.scales)


def compare(
    expected: Sequence[Any],
    found: Sequence[Any],
    tolerance: float,
    scales: Mapping[str, Tensor] | None = None,
) -> Parity:
    """Compare torque, coefficients and status with those of the model.

    Args:
        expected, found: torque (sample, joint), coefficients (sample, joint, coefficient) and
            status (sample, joint).
        tolerance: see `Parity`.
        scales: least full scales, see `Contract`; none where not given.

    Raises:
        ContractError: if the shapes differ.
    """
    model, artefact = ([_array(x) for x in side] for side in (expected, found))
    shapes = [[x.shape for x in side] for side in (model, artefact)]
    if shapes[0] != shapes[1]:
        raise ContractError(f"the artefact gives shapes {shapes[1]}, the model {shapes[0]}.")
    least = scales or {name: torch.zeros(()) for name in OUTPUTS}
    wrong = model[2] != artefact[2]
    wrong |= np.isnan(model[0]) != np.isnan(artefact[0])
    wrong |= (np.isnan(model[1]) != np.isnan(artefact[1])).any(-1)
    return Parity(
        points=len(model[0]),
        torque_error=_error(model[0], artefact[0], least["tau_f"]),
        coefficient_error=_error(model[1], artefact[1], least["coefficients"]),
        edges=int(wrong.sum()),
        tolerance=tolerance,
    )


def _error(expected: np.ndarray, found: np.ndarray, least: Tensor) -> float:
    """Largest difference over full scale by last axis; where either is NaN is not seen."""
    axes = tuple(range(expected.ndim - 1))
    difference = np.nan_to_num(np.abs(found - expected), nan=0.0, posinf=math.inf)
    scale = np.nan_to_num(np.abs(expected), nan=0.0).max(axes, initial=0.0)
    scale = np.maximum(np.maximum(scale, least.numpy()), 1e-300)
    return float((difference / scale).max(initial=0.0))


def _array(x: Any) -> np.ndarray:
    return np.asarray(x.detach().cpu() if isinstance(x, Tensor) else x, dtype=np.float64)


def write_verified(
    path: str | Path, content: bytes, opener: Callable[[Path], tuple[Contract, Runner]], kind: str
) -> Path:
    """Write an artefact, read it again and compare it with its model before it takes its place.

    Raises:
        ExportError: if the artefact differs from the model.
        OSError: if it cannot be written.
    """
    with atomic_write(path) as temporary:
        temporary.write_bytes(content)
        contract, run = opener(temporary)
        parity = verify(run, contract)
        if not parity.passed:
            raise ExportError(f"the {kind} differs from its model: {parity}.")
    return Path(path)


def _plain(values: Any) -> Any:
    """Nested lists of numbers, with strings for those that JSON does not know."""
    if isinstance(values, list):
        return [_plain(value) for value in values]
    return values if math.isfinite(values) else str(values)


def _tensor(name: str, given: Any) -> Tensor:
    """A tensor of nested lists as `_plain` spells them."""

    if not isinstance(given, list) or len(given) > MOST_VECTORS:
        raise ValueError(f"`{name}` is no list, or too long")
    values = numbers(name, given, words=("nan", "inf", "-inf"))
    return torch.tensor(values, dtype=torch.float64)


def _check_interface(content: Mapping[str, Any], names: list[str]) -> None:
    """Raise `ContractError` where what a host relies on is not there."""
    size, dtype = content.get("state_size"), content.get("dtype")
    sound = type(size) is int and 0 <= size <= MOST_STATES  # true is no size
    if not sound or str(dtype) not in TOLERANCE or content.get("inputs") != names:
        raise ContractError("the metadata lack inputs, type or size of the state, or are wrong.")


def _check_vectors(
    inputs: Mapping[str, Tensor],
    outputs: Mapping[str, Tensor],
    scales: Mapping[str, Tensor],
    tolerance: float,
) -> None:
    """Raise `ContractError` where test vectors do not fit each other."""
    shapes = {tuple(x.shape) for x in inputs.values()}
    sound = len(shapes) == 1 and tuple(outputs) == OUTPUTS
    sound = sound and isinstance(tolerance, float) and 0 < tolerance < 1
    if sound:
        shape = shapes.pop()
        given = [tuple(x.shape) for x in outputs.values()]
        sound = len(shape) == 2 and given[0] == given[2] == given[1][:2] == shape
        sound = sound and len(given[1]) == 3 and min(*shape, given[1][2]) > 0
        sound = sound and bool(((outputs["status"] >= 0) & (outputs["status"] < 8)).all())
        sizes = {"tau_f": shape[1:], "coefficients": given[1][2:]}
        sound = sound and {name: tuple(x.shape) for name, x in scales.items()} == sizes
        sound = sound and all(bool((x >= 0).all() and x.isfinite().all()) for x in scales.values())
    if not sound:
        raise ContractError("the test vectors do not fit each other.")

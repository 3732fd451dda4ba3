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

from nfriction.export.controller import NOT_FINITE, OUTSIDE, SATURATED, UNBOUNDED, Controller
from nfriction.friction.models import FrictionModel
from nfriction.io.files import atomic_write, numbers, parse_json
from nfriction.io.model_file import ModelInfo, describe

Series = tuple[Tensor, ...]

# Share of the trained range by which comparisons exceed it.
BEYOND = 0.1
# Range of a joint without a given one.
DEFAULT_RANGE = {"qd": 20.0, "qdd": 200.0}
LARGEST_LOAD = 3.0


def ranges(controller: Controller) -> dict[str, Tensor]:
    """Lowest and highest velocity and acceleration of every joint, (joint, 2)."""
    found = {}
    for name, default in DEFAULT_RANGE.items():
        edges = torch.stack(
            [controller.get_buffer(f"{name}_lower"), controller.get_buffer(f"{name}_upper")], -1
        )
        spread = torch.tensor([-default, default], dtype=edges.dtype)
        found[name] = torch.where(edges.abs() < UNBOUNDED, edges, spread)
    return found


def draw(controller: Controller, count: int, seed: int = 0) -> Series:
    """Finite inputs up to 10 % beyond the trained range, (sample, joint) each.

    Motions are drawn by `draw_motion`; positions are consecutive samples of a swing.
    """
    qd, qdd, load = draw_motion(controller, count, seed)
    return (_sweep(controller, count), load) if controller.filters else (qd, qdd, load)


def draw_motion(controller: Controller, count: int, seed: int = 0) -> Series:
    """Velocity, acceleration and load, drawn uniformly; a third of the velocities near rest."""
    generator = torch.Generator().manual_seed(seed)

    def even(low: Tensor, high: Tensor) -> Tensor:
        shape = (count, controller.joints)
        return low + (high - low) * torch.rand(shape, dtype=torch.float64, generator=generator)

    zero = torch.zeros(controller.joints, dtype=torch.float64)
    # A transmitted torque has a sign.
    load = even(zero - LARGEST_LOAD * controller.loaded, zero + LARGEST_LOAD)
    qd, qdd = (even(*_widened(edges)) for edges in ranges(controller).values())
    # Near rest the sign changes, and with it the acceleration along the motion.
    qd[::3] *= 10.0 ** even(zero - 5.0, zero)[::3]
    return qd, qdd, load


def trials(controller: Controller) -> Series:
    """The inputs of the test vectors: drawn ones, then edges, rest, and broken inputs.

    Non-finite inputs come last, one joint and one input at a time, each followed by a valid sample.
    """
    drawn = draw(controller, 200, seed=6)
    if not controller.filters:
        # All pairs of edges of the range, rest, and creeping.
        levels = []
        for edges in ranges(controller).values():
            low, high = edges.unbind(-1)
            zero, tiny = torch.zeros_like(low), 1e-4 * high.abs()
            levels.append(torch.stack([low, high, zero, -zero, tiny, -tiny]))
        qd = levels[0].repeat_interleave(len(levels[1]), 0)
        load = torch.ones_like(qd)
        load[::2] = 0.0
        special = qd, levels[1].repeat(len(levels[0]), 1), load
        drawn = tuple(torch.cat(pair) for pair in zip(drawn, special, strict=True))
    return _with_broken(drawn, controller.joints)


def _widened(edges: Tensor) -> tuple[Tensor, Tensor]:
    """Range of every joint, extended by a tenth on either side."""
    low, high = edges.unbind(-1)
    more = BEYOND * (high - low)
    return low - more, high + more


def _sweep(controller: Controller, count: int) -> Tensor:
    """Positions of a swing whose velocity grows slowly, to beyond its range."""
    assert controller.filter_options is not None
    cutoff_hz, sample_time = (controller.filter_options[k] for k in ("cutoff_hz", "sample_time"))
    _, fastest = _widened(ranges(controller)["qd"])
    time = sample_time * torch.arange(count, dtype=torch.float64)[:, None]
    # Below the cut-off, so that it passes the filter, and with at least two swings in all.
    rate = math.tau * min(0.2 * cutoff_hz, 8.0 / (count * sample_time))
    phase = torch.arange(controller.joints, dtype=torch.float64)
    growth = torch.linspace(0.0, 1.0, count, dtype=torch.float64)[:, None]
    return 1.2 * growth * fastest.abs() / rate * torch.sin(rate * time + phase)


def _with_broken(inputs: Series, joints: int) -> Series:
    """The inputs, followed by every kind of non-finite one, each between valid ones."""
    kinds = (math.nan, math.inf, -math.inf)
    rounds = 2 * max(joints, 2) * len(kinds) * len(inputs)
    rows = torch.arange(rounds) % len(inputs[0])
    tails = [x[rows].clone() for x in inputs]
    for row in range(0, rounds, 2):
        turn = row // 2
        which = turn % len(inputs)
        joint = turn // (len(inputs) * len(kinds)) % joints
        tails[which][row, joint] = kinds[turn // len(inputs) % len(kinds)]
    return tuple(torch.cat(pair) for pair in zip(inputs, tails, strict=True))


class ExportError(RuntimeError):
    """An artefact could not be made, or differs from its model."""


def first_line(error: Exception) -> str:
    """First line of an error's message that is not empty."""
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return lines[0][:200] if lines else type(error).__name__


class ContractError(ValueError):
    """Metadata of an artefact are missing, damaged or not from nfriction."""


FORMAT, SCHEMA = "nfriction controller", 1
# Largest torque error over full scale that a target in double, or in single precision, may show.
TOLERANCE = {"float64": 1e-12, "float32": 5e-7}
# Coefficients result from longer sums than the torque, some of them small differences.
COEFFICIENT_SLACK = 20.0
OUTPUTS = ("tau_f", "coefficients", "status")
MOST_VECTORS, MOST_STATES, LARGEST_FILE = 100_000, 1000, 256 * 2**20

Runner = Callable[..., Sequence[Any]]


@dataclass(frozen=True)
class Parity:
    """Largest differences of an artefact from its model."""

    points: int  # samples compared
    torque_error: float  # largest |difference| over the joint's full scale, see `Contract.scales`
    coefficient_error: float  # the same for the coefficients, over the full scale of each
    edges: int  # samples whose status or NaN differ from those of the model
    tolerance: float  # largest torque error allowed; 20 times that for the coefficients

    @property
    def passed(self) -> bool:
        """True if all differences are within tolerance."""
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
            state they are consecutive samples, the first one on `initial_state`.
        outputs: `tau_f`, `coefficients` and `status` from the model.
        scales: full scale of `tau_f`, (joint,), and of `coefficients`, (coefficient,): the largest
            value in the outputs, or more if that is a small difference of large numbers with
            large rounding errors.
        tolerance: largest torque error over full scale that an artefact may show [-].
    """

    description: Mapping[str, Any]
    inputs: Mapping[str, Tensor]
    outputs: Mapping[str, Tensor]
    scales: Mapping[str, Tensor]
    tolerance: float = TOLERANCE["float64"]

    @property
    def state_size(self) -> int:
        """Numbers per joint that the controller carries from sample to sample."""
        return int(self.description["state_size"])

    def require_dtype(self, dtype: str) -> None:
        """Raise ContractError unless the metadata state this type, which sets the tolerance."""
        if self.description["dtype"] != dtype:
            raise ContractError(
                f"the metadata state {self.description['dtype']}, but the program computes in "
                f"{dtype}."
            )

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
        """Read what `to_json` wrote; raises ContractError if it is not of this form."""
        try:
            content = parse_json(text)
        except (ValueError, RecursionError) as error:
            raise ContractError(f"the metadata are not JSON, or cut short ({error}).") from error
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
            if not _fit_each_other(inputs, outputs, scales) or not 0 < tolerance < 1:
                raise ValueError("they do not fit each other")
        except (KeyError, TypeError, AttributeError, ValueError, RuntimeError) as error:
            reason = first_line(error)
            raise ContractError(f"the test vectors are missing or damaged ({reason}).") from error
        size, dtype = content.get("state_size"), content.get("dtype")
        sound = type(size) is int and 0 <= size <= MOST_STATES  # True is not a size
        if not sound or str(dtype) not in TOLERANCE or content.get("inputs") != list(inputs):
            raise ContractError("the metadata lack inputs, type or size of the state.")
        outputs["status"] = outputs["status"].to(torch.int32)
        return cls(content, inputs, outputs, scales, tolerance)


def contract_of(
    model: FrictionModel,
    controller: Controller,
    info: ModelInfo | None = None,
    *,
    dtype: str = "float64",
) -> Contract:
    """Make the contract of a controller, with test vectors, for a target that computes in `dtype`.

    Raises ValueError if that is not "float64" or "float32", or there is not one name per joint.
    """
    if dtype not in TOLERANCE:
        raise ValueError(f'`dtype` must be "float64" or "float32", got {dtype!r}.')
    info = info or ModelInfo()
    inputs = trials(controller)
    if dtype == "float32":
        # As the target gets them, because rounding decides the status at the edges of the range.
        inputs = tuple(x.float().double() for x in inputs)
    outputs = controller.run(*inputs)
    beyond = "of clamped inputs" if controller.clamps else "as the model has them there"
    description = {
        **describe(model, info),
        # For a law with memory its state is also listed.
        "coefficients": describe(controller.model, info)["coefficients"],
        # A hidden state advances by it, also where nobody gave one.
        "sample_time": info.sample_time or getattr(model.schedule, "sample_time", None),
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
            "outside_input_ranges": f"coefficients {beyond}; the law continues",
            "not_finite": "NaN torque and coefficients of that joint; its state is unchanged"
            + "; the next sample, which has no difference yet, is NaN, too" * controller.filters,
        },
    }
    # Through JSON, so that tuples become lists, as for a reader.
    description = json.loads(json.dumps(description, allow_nan=False))
    return Contract(
        description,
        dict(zip(controller.inputs, inputs, strict=True)),
        dict(zip(OUTPUTS, outputs, strict=True)),
        _scales(controller, outputs),
        TOLERANCE[dtype],
    )


def _scales(controller: Controller, outputs: Sequence[Tensor]) -> dict[str, Tensor]:
    """Full scales of torque and coefficients; see `Contract`."""
    # A coefficient that training has driven to zero is a small difference of large numbers, and a
    # steep network passes on the roundings of its inputs; no artefact can be exact to the last
    # digits then. So a target in single precision may err twice as much as torch does over 20,000
    # samples; in double precision roundings are smaller by a constant factor.
    scales = {
        name: values.abs().nan_to_num(0.0).flatten(0, -2).amax(0)
        for name, values in zip(OUTPUTS[:2], outputs, strict=False)
    }
    model = controller.model
    single = copy.deepcopy(model).float()
    qd, qdd, load = (x.float().double() for x in draw_motion(controller, 20_000, seed=7))
    seen = controller.seen(qd, qdd)[:2]
    # The same memory for both, because rounding must not put a sample into another class.
    motion = (*seen, model.schedule.initial_state(*seen))
    exact = model.schedule.coefficients_from(*motion)
    try:
        rounded = single.schedule.coefficients_from(*(x.float() for x in motion))
        torque = single.torque(qd.float(), load.float(), rounded)
    except RuntimeError:  # a user's schedule that supports only double precision
        return scales
    pairs = ((torque, model.torque(qd, load, exact), 1.0), (rounded, exact, COEFFICIENT_SLACK))
    for (name, scale), (found, expected, slack) in zip(scales.items(), pairs, strict=True):
        error = (found - expected).abs().nan_to_num(0.0, 0.0).flatten(0, -2).amax(0)
        scales[name] = torch.maximum(scale, 2.0 * error / (slack * TOLERANCE["float32"]))
    return scales


def verify(run: Runner, contract: Contract) -> Parity:
    """Run an artefact on the contract's test vectors.

    `run` takes the inputs in their order, each a float64 tensor (vector, joint), and returns
    torque, coefficients and status of all, in order from the initial state if there is one.
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

    `scales` are least full scales, see `Contract`; a ContractError is raised if shapes differ.
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
    path: str | Path,
    content: bytes,
    contract: Contract,
    runner: Callable[[Path], Runner],
    kind: str,
) -> Path:
    """Write an artefact, run it and compare it with its model before it takes its place."""
    with atomic_write(path) as temporary:
        temporary.write_bytes(content)
        parity = verify(runner(temporary), contract)
        if not parity.passed:
            raise ExportError(f"the {kind} differs from its model: {parity}.")
    return Path(path)


def _plain(values: Any) -> Any:
    """Nested lists of numbers, with strings for those that JSON lacks."""
    if isinstance(values, list):
        return [_plain(value) for value in values]
    return values if math.isfinite(values) else str(values)


def _tensor(name: str, given: Any) -> Tensor:
    """A tensor from nested lists as written by `_plain`."""
    if not isinstance(given, list) or len(given) > MOST_VECTORS:
        raise ValueError(f"`{name}` is no list, or too long")
    values = numbers(name, given, words=("nan", "inf", "-inf"))
    return torch.tensor(values, dtype=torch.float64)


def _fit_each_other(
    inputs: Mapping[str, Tensor], outputs: Mapping[str, Tensor], scales: Mapping[str, Tensor]
) -> bool:
    """True for test vectors and scales of the shapes and values of a controller."""
    shapes = {x.shape for x in inputs.values()}
    if len(shapes) != 1 or tuple(outputs) != OUTPUTS:
        return False
    shape = shapes.pop()
    tau_f, coefficients, status = outputs.values()
    return (
        tau_f.shape == status.shape == coefficients.shape[:2] == shape
        and (len(shape), coefficients.ndim) == (2, 3)
        and coefficients.numel() > 0
        and {n: x.shape for n, x in scales.items()}
        == {"tau_f": shape[1:], "coefficients": coefficients.shape[2:]}
        and bool(((status >= 0) & (status < 8)).all())
        and all(bool((x >= 0).all() and x.isfinite().all()) for x in scales.values())
    )

"""C code of a controller: templates filled with a model's tables and its generated law."""

import math
import re
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import pad

from nfriction.codegen.graph import Program, trace
from nfriction.codegen.scalar import Node, UnsupportedOperation, evaluate, reachable
from nfriction.export.c_dialect import ControllerC, Real, comment, statements
from nfriction.export.contract import ExportError
from nfriction.export.controller import FILTER_STATE, UNBOUNDED, Controller, for_single_precision
from nfriction.friction.heat import Heated
from nfriction.friction.models import FrictionModel
from nfriction.friction.neurofuzzy import NeuroFuzzy
from nfriction.plant import Plant

# An exponential that compilers vectorise: `math.h` needs a call for every number, this one is a
# loop over an array without branches or tables. Minimax polynomial of (exp(r) - 1) / r for |r| <=
# ln(2) / 2: exp(r) to 4e-18 and 2e-9, plus round-off.
_POLYNOMIAL: dict[Real, tuple[float, ...]] = {
    "double": (1.0, 0.5000000000000012, 0.16666666666666222, 0.0416666666665181,
               0.008333333333548278, 0.0013888888946297076, 0.0001984126943904723,
               2.480149068146982e-05, 2.755762504761142e-06, 2.763102156119972e-07,
               2.4991890031105645e-08),
    "float": (1.0, 0.49999994, 0.16666432, 0.041667998, 0.008374143, 0.0013843952),
}  # fmt: skip

# ln 2 as a number with few bits, whose products with whole numbers are exact, and the remainder.
_LN2: dict[Real, tuple[float, float]] = {
    "double": (0.693145751953125, 1.4286068203094173e-06),
    "float": (0.693359375, -0.00021219444),
}

# Shift of a padding set, whose membership is zero.
_NOWHERE = 1e3


def source_of(
    controller: Controller,
    description: Mapping[str, Any],
    dialect: ControllerC,
    name: str,
    plant: Plant | None = None,
) -> tuple[str, str]:
    """Texts of a controller's `.c` and `.h`; the description is for the header's comment.

    With a plant and a law that reads the load, they contain a function for the plant's load.
    """
    if dialect.real == "float":
        controller = for_single_precision(controller)
    words: dict[str, Any] = {
        "joints": controller.joints,
        "coefficients": controller.coefficient_count,
        "state_size": controller.memory_size,
        "memory": "double" if isinstance(controller.model.schedule, Heated) else dialect.real,
        "filter_size": FILTER_STATE if controller.filters else 0,
        "filter": controller,
        "loaded": controller.loaded,
        "load": plant is not None
        and any(_depends(x, "load") for x in _traced_law(controller.model, 1).outputs[0].nodes),
        "bits": description["status_bits"],
        "drive_torques": [] if plant is None else plant.torque_offset.tolist(),
        "gear_losses": getattr(plant, "gear_loss", torch.zeros(0)).tolist(),
        # Names and units are untrusted text.
        "about": description,
        "safe": lambda text: comment(str(text)).rstrip(),
    }
    try:
        with torch.no_grad():
            words["load_of"] = _load(plant, dialect) if plant and words["load"] else ""
            body = dialect.text("controller.c", **words, **_words(controller, dialect))
    except (UnsupportedOperation, ValueError) as error:
        raise ExportError(f"the model has no C form: {error}") from error
    head = (
        f"/* Made by nfriction; do not edit. {name}.h says what it is. */\n"
        f'#include "{name}.h"\n\n#include <limits.h>\n#include <math.h>\n#include <string.h>\n'
    )
    texts = "\n".join([head, dialect.functions(body), body]), dialect.text("controller.h", **words)
    code, header = (re.sub(r"\n{3,}", "\n\n", text) for text in texts)
    return code, header


def _words(controller: Controller, dialect: ControllerC) -> dict[str, Any]:
    """Words of the controller's template in addition to its sizes."""
    model: FrictionModel = controller.model
    # A subclass computes as it likes: only the class that names its form itself has that form.
    form = vars(type(model.schedule)).get("form", "traced")
    network = form == "neurofuzzy"
    ends = [f"{name}_{end}" for name in ("qd", "qdd") for end in ("lower", "upper")]
    ranges = torch.stack([controller.get_buffer(end) for end in ends])
    values: dict[str, Any] = {"range": ranges, "torque_limit": controller.torque_limit}
    words: dict[str, Any] = {
        "form": form, "network": network,
        "by_class": form == "adaptive", "along_motion": False,
        "bounded": bool((ranges.abs() < UNBOUNDED).any()), "clamped": controller.clamps,
        "limited": controller.limited, "law_comment": comment(model.law.name),
        # Calls of an own exponential for many joints at once cost flash on a microcontroller.
        "array_tanh": network and (controller.joints > 1 or dialect.real == "double"),
        "table": lambda name, *sizes: dialect.table(name, values[name], *sizes),
        "sum": _sum,
    }  # fmt: skip
    words["clamped"] &= words["bounded"]
    signs: list[str] = []
    if form == "constant":
        values["constant"] = model.schedule(torch.zeros(()), torch.zeros(())).mT
    elif form == "traced":
        words["schedule"] = _schedule(controller, dialect)
    elif form == "adaptive":
        adaptive: Any = model.schedule
        borders = adaptive.thresholds.mT
        values |= {
            "middle": borders, "upper": borders * adaptive.band, "lower": borders / adaptive.band,
            "swing_rate": adaptive.swing_rate, "ceiling": adaptive.ceiling * borders[1],
            "by_class": adaptive.table().permute(1, 2, 0),
        }  # fmt: skip
        words["fading"] = dialect.literal(float(adaptive.fading))
    if network:
        _add_network(model.schedule, values, words, dialect)
        if words["along_motion"]:
            signs.append(dialect.own("NF_RATE[j] * v[j]"))
    words["c"] = dialect.own("NF_CONSTANT") if form == "constant" else "c"
    words["law"] = _law(model, dialect, words["c"], signs if network else None)
    words["array_tanh"] &= bool(signs)
    if network:
        tanhs = len(signs) if words["array_tanh"] else 0
        words["exponential"] = exponential(dialect, controller.joints, tanhs)
    return {**words, "signs": signs}


def _add_network(
    network: Any, values: dict[str, Any], words: dict[str, Any], dialect: ControllerC
) -> None:
    """Tables of the neuro-fuzzy network."""
    made = tables(network)
    joints, sets, units = network.joints, made["set_slope"].shape[1], made["weights"].shape[1]
    values |= {
        "gain": made["gain"].mT, "shift": made["shift"].mT, "rate": made["rate"],
        "set_slope": made["set_slope"].permute(1, 2, 0),
        "set_shift": made["set_shift"].permute(1, 2, 0),
        "plane": made["planes"].view(joints, -1, sets, sets).permute(3, 2, 1, 0),
        "unit_slope": made["unit_slope"].permute(2, 1, 0),
        "unit_shift": made["unit_shift"].permute(2, 1, 0),
        "unit_weight": made["weights"].permute(2, 1, 0),
        "reference": made["reference"].mT, "roundness": made["roundness"].mT,
    }  # fmt: skip
    runs: list[tuple[int, int, bool]] = []
    for k, positive in enumerate(network.positive.tolist()):
        start = runs.pop()[0] if runs and runs[-1][2] == positive else k
        runs.append((start, k + 1, positive))
    words |= {
        "sets": sets, "units": units, "seen": made["unit_slope"].shape[2],
        "along_motion": network.along_motion, "signs_of_coefficients": runs,
        "per_reach": dialect.literal(0.5 / network.reach),
        "least_exponent": dialect.literal(network.network.head.least_exponent),
        "deep": _deepest(made["set_slope"].mT, made["set_shift"].mT) >= _DEEP,
        "spare": lambda count: _spare(count, dialect),
    }  # fmt: skip


def tables(schedule: NeuroFuzzy) -> dict[str, Tensor]:
    """Scales folded into slopes, shifts and weights.

    Inputs are scaled to [-1, 1] by `gain x + shift`; sets and units refer to these, with exponents
    -(slope x + shift)^2. The head's bias is included in the consequents, and half the coefficients'
    scale in all weights and in the reference; the units of the head take its inputs in that scale.

    Returns:
        `rate` (joint,); `gain` and `shift` (joint, input); `set_slope` and `set_shift` (joint,
        set, input), with sets of no membership where one input has fewer; `planes` (joint,
        3 coefficient set, set), columns by set of velocity, then of acceleration; `unit_slope` and
        `unit_shift` (joint, unit, input and coefficient); `weights` (joint, unit, coefficient);
        `reference`, `roundness` (joint, coefficient); `positive` (coefficient,).
    """
    anfis, head, unvaried = schedule.network.anfis, schedule.network.head, schedule.unvaried
    joints, terms = schedule.joints, schedule.terms
    sets = max(terms)
    lower = torch.stack([torch.zeros_like(schedule.velocity_range), schedule.acceleration_lower], 1)
    upper = torch.stack([schedule.velocity_range, schedule.acceleration_upper], 1)
    half_range = 0.5 * (upper - lower)
    half = 0.5 * schedule.scale
    bias = pad(head.output_bias, (0, unvaried))

    # The network's own inputs are (x + 1) / 2.
    centres, widths = anfis.sets()
    slope = 0.5 / (math.sqrt(2.0) * widths)
    shift = (0.5 - centres) * 2.0 * slope
    set_slope, set_shift = (
        torch.stack(
            [pad(part, (0, sets - part.shape[1]), value=fill) for part in x.split(terms, 1)], 2
        )
        for x, fill in ((slope, 0.0), (shift, _NOWHERE))
    )

    consequents = pad(anfis.consequents, (0, 0, 0, 0, 0, unvaried))
    slopes = 0.5 * consequents[..., :2]
    constants = consequents[..., 2] + slopes.sum(-1) + bias.unsqueeze(2)
    columns = torch.cat([slopes, constants.unsqueeze(3)], 3) * half[:, :, None, None]
    # (joint, coefficient, set of velocity, set of acceleration, column) to columns by acceleration.
    planes = columns.unflatten(2, terms).permute(0, 4, 1, 2, 3)
    planes = pad(planes, (0, sets - terms[1], 0, sets - terms[0])).reshape(joints, -1, sets)

    unit_widths = math.sqrt(2.0) * torch.exp(pad(head.log_widths, (0, unvaried)))
    middle = torch.full_like(lower, 0.5)
    seen = torch.cat([middle, -bias], 1).unsqueeze(1)
    scale = torch.cat([middle, 1.0 / half], 1).unsqueeze(1)
    return {
        "rate": 1.0 / (schedule.velocity_range * schedule.turn),
        "gain": 1.0 / half_range,
        "shift": -0.5 * (lower + upper) / half_range,
        "reference": half * schedule.reference,
        "set_slope": set_slope,
        "set_shift": set_shift,
        "planes": planes,
        "unit_slope": scale / unit_widths,
        "unit_shift": (seen - pad(head.centres, (0, unvaried))) / unit_widths,
        "weights": (pad(head.output_weight, (0, 0, 0, unvaried)) * half.unsqueeze(2)).mT,
        "roundness": (schedule.scale * schedule.roundness).square(),
        "positive": schedule.positive,
    }


# Where some set is within this exponent of full membership, strengths are far from underflow.
_DEEP = 40.0


def _deepest(slope: Tensor, shift: Tensor) -> float:
    """Largest exponent (slope x + shift)^2 of the nearest set, over inputs of -1 to 1."""
    # It lies at an end of the range, or where two sets have equal membership.
    meetings = [
        (sign * shift[..., :, None] - shift[..., None, :])
        / (slope[..., None, :] - sign * slope[..., :, None])
        for sign in (1.0, -1.0)
    ]
    ends = torch.ones_like(shift[..., :1])
    points = torch.cat([-ends, ends, *(m.flatten(-2) for m in meetings)], -1)
    points = points.nan_to_num(0.0, 0.0, 0.0).clamp(-1.0, 1.0)
    z = slope.unsqueeze(-1) * points.unsqueeze(-2) + shift.unsqueeze(-1)
    return float(z.square().amin(-2).max())


def _sum(term: str, count: int, indent: int) -> str:
    """A sum of terms in which `@` is the number of each."""
    terms = [term.replace("@", str(i)) for i in range(count)]
    if sum(map(len, terms)) + indent < 90:
        return " + ".join(terms)
    return f"\n{indent * ' '}+ ".join(terms)


def _law(
    model: FrictionModel, dialect: ControllerC, coefficients: str, signs: list[str] | None
) -> str:
    """The law as C: of joint j in a loop, or of every joint where they differ.

    `signs` is filled with the arguments of hyperbolic tangents of the motion alone, which are then
    read from `sign`; where it is None such calls stay in place.
    """
    one, every = _traced_law(model, 1), _traced_law(model, model.joints)
    alike = _same_by_joint(one, every, model.joints)
    outputs = one.outputs[0].nodes if alike else every.outputs[0].nodes
    bound, joint = {}, "j"
    for node in reachable(outputs):
        if node.op == "input":
            name, index = node.value
            count = len(model.law.names)
            if not alike:
                joint, index = str(index // (count if name == "c" else 1)), index % count
            bound[node.number] = {"qd": f"v[{joint}]", "load": f"n[{joint}]"}.get(
                name, f"{coefficients}[{index}][{joint}]"
            )
    if not alike:
        targets = [f"torque[{j}]" for j in range(model.joints)]
        return f"    {_braces(_assignments(targets, outputs, bound, dialect), '    ')}"
    if signs is not None:
        for node in reachable(outputs):
            if node.op == "tanh" and not _depends(node, "c"):
                lines, (argument,) = statements(node.args, bound, dialect)
                if not lines:
                    bound[node.number] = f"sign[{len(signs)}][j]"
                    signs.append(argument)
    lines = _assignments(["torque[j]"], outputs, bound, dialect)
    return dialect.own("    for (j = 0; j < NF_JOINTS; ++j) ") + _braces(lines, "    ")


def _same_by_joint(one: Program, every: Program, joints: int) -> bool:
    """True if the law of all joints is that of one joint, repeated."""
    generator = np.random.default_rng(0)
    points = {p.name: generator.uniform(0.1, 2.0, (8, joints, len(p.nodes))) for p in one.inputs}
    alone = evaluate(one.outputs[0].nodes, points)[0]
    flat = {name: x.reshape(8, -1) for name, x in points.items()}
    together = np.stack(evaluate(every.outputs[0].nodes, flat), -1)
    return bool(np.array_equal(np.broadcast_to(alone, together.shape), together, equal_nan=True))


def _depends(node: Node, name: str) -> bool:
    return any(n.op == "input" and n.value[0] == name for n in reachable([node]))


def _traced_law(model: FrictionModel, joints: int) -> Program:
    given = {"qd": _example(joints), "load": _example(joints),
             "c": _example(joints, len(model.law.names))}  # fmt: skip
    return trace(lambda qd, load, c: model.torque(qd, load, c), given)


def _elements(program: Program) -> dict[int, str]:
    """Texts of a program's inputs, by node number."""
    return {
        node.number: f"{port.name}[{i}]"
        for port in program.inputs
        for i, node in enumerate(port.nodes)
    }


def _load(plant: Plant, dialect: ControllerC) -> str:
    """Statements that compute the load of each joint of a plant."""
    program = trace(plant.load, {"q": _example(plant.joints), "qd": _example(plant.joints)})
    targets = [f"load[{j}]" for j in range(plant.joints)]
    lines = _assignments(targets, program.outputs[0].nodes, _elements(program), dialect)
    return _braces([*lines, "(void)q;", "(void)qd;"], "")


def _schedule(controller: Controller, dialect: ControllerC) -> str:
    """Functions of the coefficients of any schedule, written out for all joints."""
    schedule, joints = controller.model.schedule, controller.joints
    motion = {"qd": _example(joints), "qdd": _example(joints)}

    def coefficients(qd: Tensor, qdd: Tensor) -> Tensor:
        return schedule(qd, qdd).expand(joints, -1)

    def advanced(qd: Tensor, qdd: Tensor, load: Tensor, last: Tensor) -> tuple[Tensor, Tensor]:
        following = schedule.advance_loaded(qd, qdd, load, last)
        found = schedule.coefficients_from(qd, qdd, following)
        return found.expand(joints, -1), following

    if not controller.remembers:
        return _function("nf_schedule", trace(coefficients, motion), ("c",), dialect)
    state = {**motion, "load": _example(joints), "last": _example(joints, controller.memory_size)}
    start = trace(schedule.initial_state, motion)
    return "\n".join([
        _function("nf_schedule_start", start, ("next",), dialect),
        _function("nf_schedule", trace(advanced, state), ("c", "next"), dialect),
    ])  # fmt: skip


def _function(name: str, program: Program, outputs: Sequence[str], dialect: ControllerC) -> str:
    targets, nodes, sums, elements = [], [], [], _elements(program)
    for output, port in zip(outputs, program.outputs, strict=True):
        columns = port.shape[-1]
        for i, node in enumerate(port.nodes):
            targets.append(f"c[{i % columns}][{i // columns}]" if output == "c" else f"next[{i}]")
            step = [x for x in node.args if elements.get(x.number) != f"last[{i}]"]
            if dialect.real == "float" and output == "next" and node.op == "add" and len(step) == 1:
                sums.append(f"next[{i}] += last[{i}];")  # in double where the state is
                node = step[0]
            nodes.append(node)
    if dialect.real == "float":
        elements = {k: x.replace("last", "(float)last") for k, x in elements.items()}
    arguments = [
        f"const nf_memory *{p.name}" if p.name == "last" else f"const REAL {p.name}[NF_JOINTS]"
        for p in program.inputs
    ]
    kinds = {"c": "REAL c[NF_COEFFICIENTS][NF_JOINTS]", "next": "nf_memory *next"}
    arguments += [kinds[output] for output in sorted(outputs, reverse=True)]
    head = dialect.own(f"static void {name}(\n    {', '.join(arguments)})")
    lines = _assignments(targets, nodes, elements, dialect) + sums
    lines += [f"(void){port.name};" for port in program.inputs]
    return f"{head}\n{_braces(lines, '')}\n"


def _assignments(
    targets: Sequence[str], nodes: Sequence[Node], bound: Mapping[int, str], dialect: ControllerC
) -> list[str]:
    """Statements that compute nodes, and store them."""
    lines, texts = statements(nodes, bound, dialect)
    return [*lines, *(f"{target} = {text};" for target, text in zip(targets, texts, strict=True))]


def _braces(lines: Sequence[str], indent: str) -> str:
    inside = "".join(f"{indent}    {line}\n" for line in lines)
    return f"{{\n{inside}{indent}}}"


def _example(*size: int) -> Tensor:
    # All different, so that nothing is equal by chance.
    return torch.linspace(0.5, 1.5, math.prod(size), dtype=torch.float64).reshape(size)


def exponential(dialect: ControllerC, joints: int, signs: int) -> str:
    """Write `nf_exp`, and `nf_tanh` if it is needed for `signs` numbers per joint."""
    return dialect.text(
        "exponential.c", joints=joints, signs=signs, ln2=_LN2[dialect.real],
        polynomial=_by_pairs(dialect), spare=lambda count: _spare(count, dialect),
    )  # fmt: skip


def _spare(count: int, dialect: ControllerC) -> str:
    """The padding of an array that lets exponentials vectorise by four.

    At -O2 gcc vectorises only if it knows that no numbers remain. Single precision is for
    microcontrollers, which have no vectors.
    """
    return f" + {-count % 4}" if dialect.real == "double" and count % 4 else ""


def _by_pairs(dialect: ControllerC) -> str:
    """The polynomial in r by pairs of terms in s = r^2: half as long a chain as Horner's."""
    texts = [dialect.literal(x) for x in _POLYNOMIAL[dialect.real]]
    pairs = [
        f"({texts[i]} + r * {texts[i + 1]})" if i + 1 < len(texts) else texts[i]
        for i in range(0, len(texts), 2)
    ]
    text = pairs[-1]
    for pair in reversed(pairs[:-1]):
        text = f"{pair} + s * ({text})" if " " in text else f"{pair} + s * {text}"
    return text

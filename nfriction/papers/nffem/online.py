"""Online learning: the papers' network follows friction that changes while the rig runs.

Its output layer is learnt by recursive least squares from the measured friction torque. With the
units' outputs phi, the law's derivative g_k by coefficient k and weights in units of the
coefficient's scale s_k, a joint's torque is f . w with f_ku = g_k s_k phi_u, and a sample updates

    w += P f e / (l r^2 + f'P f),    P = (P - P f f'P / (l r^2 + f'P f)) / l

given the torque error e, its standard deviation r and the forgetting factor l. The coefficients are
bounded by a margin around the trained ones, the covariance P by its initial trace, and the measured
torque by what coefficients within these bounds can give, so that an outlier moves little.
"""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from nfriction.codegen.graph import trace
from nfriction.export.c_dialect import ControllerC, is_identifier, statements
from nfriction.friction.models import FrictionModel
from nfriction.friction.parameters import positive_number
from nfriction.io.files import write_atomically
from nfriction.papers.nffem.rbf_coefficients import RBFCoefficients
from nfriction.version import __version__

TEMPLATES = ("nfriction.papers.nffem",)


@dataclass(frozen=True)
class OnlineOptions:
    """Settings of online learning.

    Attributes:
        noise: standard deviation of the measured friction torque [N m], inflated if errors of
            neighbouring samples are correlated.
        forgetting: time in which the weight of a sample falls to 1/e [s].
        sample_time: time between learnt samples [s].
        spread: initial standard deviation of the weights, relative to the coefficients.
        margin: factor by which the coefficients may leave their trained range.
        slowest: speed below which nothing is learnt [rad/s]: at rest friction balances any torque.

    Raises:
        ValueError: if one is not positive and finite, or the margin below 1.
    """

    noise: float
    forgetting: float = 10.0
    sample_time: float = 1e-3
    spread: float = 0.3
    margin: float = 3.0
    slowest: float = 0.05

    def __post_init__(self) -> None:
        for name in ("noise", "forgetting", "sample_time", "spread", "margin", "slowest"):
            positive_number(name, getattr(self, name))
        if self.margin < 1:
            raise ValueError(f"`margin` must be at least 1, got {self.margin}.")

    @property
    def forget(self) -> float:
        """Forgetting factor per sample."""
        return math.exp(-self.sample_time / self.forgetting)


class OnlineNetwork:
    """A model with the papers' network whose output layer learns, sample by sample.

    Args:
        model: with coefficients of `network="rbf"`; it is not changed.

    Attributes:
        weight: output layer and bias in units of `scale`, (joint, coefficient, unit + 1).
        covariance: of each joint's weights, (joint, parameter, parameter).
        scale: of the coefficients in SI, (joint, coefficient).
        least, most: bounds of the coefficients, (joint, coefficient).

    Raises:
        ValueError: if the coefficients are of another kind, or have jerk and snap as inputs.

    References:
        TLRIP paper, future work (online learning of the network).
        L. Ljung and T. Soderstrom, Theory and Practice of Recursive Identification (1983), 2.6.
    """

    def __init__(self, model: FrictionModel, options: OnlineOptions) -> None:
        schedule = model.schedule
        if not isinstance(schedule, RBFCoefficients) or schedule.remembers:
            raise ValueError(
                'online learning takes a model with `network="rbf"` of velocity and acceleration, '
                f"got {type(schedule).__name__}."
            )
        self.model, self.schedule, self.options = model, schedule, options
        # The trained range is that of the outputs at the units' centres, along the motion.
        found = schedule.network(schedule.network.centres.detach().transpose(0, 1)).detach()
        held = torch.minimum(torch.maximum(found, schedule.output_lower), schedule.output_upper)
        lower, upper = held.amin(0), held.amax(0)
        self.scale = torch.maximum(lower.abs(), upper.abs()).clamp_min(1e-12)
        margin = options.margin
        self.least = torch.where(lower > 0, lower / margin, lower * margin)
        self.most = torch.where(upper > 0, upper * margin, upper / margin)
        self.weight = schedule.network.readout().detach() / self.scale[..., None]
        parameters = self.weight[0].numel()
        first = torch.eye(parameters, dtype=self.weight.dtype)
        self.covariance = (options.spread**2 * first).repeat(model.joints, 1, 1)
        self.learnt = torch.tensor([c.linear for c in model.law.coefficients])

    @torch.no_grad()
    def __call__(self, qd: Tensor, qdd: Tensor, load: Tensor) -> tuple[Tensor, Tensor]:
        """Friction torque and coefficients at motions (*batch, joint), with the current weights."""
        coefficients = self._coefficients(self._regressors(qd, qdd))
        return self.model.torque(qd, load, coefficients), coefficients

    @torch.no_grad()
    def learn(self, qd: Tensor, qdd: Tensor, load: Tensor, measured: Tensor) -> None:
        """Update the weights with one sample of the measured friction torque, each (joint,)."""
        options = self.options
        known = qd.abs() + qdd.abs() + load.abs() + measured.abs() < math.inf
        known = known & (qd.abs() >= options.slowest)
        qd, qdd, load, measured = (
            torch.where(known, x, torch.zeros_like(x)) for x in (qd, qdd, load, measured)
        )
        phi = self._regressors(qd, qdd)
        coefficients = self._coefficients(phi)
        torque, slopes = law_slopes(self.model, qd, load, coefficients, self.learnt)
        # Friction of other coefficients, at most; the rest depends on none that learns.
        largest = (slopes.abs() * torch.maximum(self.least.abs(), self.most.abs())).sum(-1)
        largest = largest + (torque - (slopes * coefficients).sum(-1)).abs()
        measured = torch.minimum(torch.maximum(measured, -largest), largest)
        f = ((slopes * self.scale).unsqueeze(-1) * phi.unsqueeze(-2)).flatten(-2)
        pf = (self.covariance @ f.unsqueeze(-1)).squeeze(-1)
        spread = options.forget * options.noise**2 + (pf * f).sum(-1, keepdim=True)
        # An overflow of a huge input would never leave the weights.
        known = known & (spread.squeeze(-1) < math.inf)
        move = (pf / spread * (measured - torque).unsqueeze(-1)).view_as(self.weight)
        left = self.covariance - pf.unsqueeze(-1) * (pf / spread).unsqueeze(-2)
        trace = left.diagonal(dim1=-2, dim2=-1).sum(-1) / options.forget
        # Without this, the covariance would grow without bound in directions that are not excited.
        shrink = (f.shape[-1] * options.spread**2 / trace).clamp_max(1.0) / options.forget
        known = known[:, None, None]
        self.weight = torch.where(known, self.weight + move, self.weight)
        self.covariance = torch.where(known, left * shrink[:, None, None], self.covariance)

    def _regressors(self, qd: Tensor, qdd: Tensor) -> Tensor:
        schedule = self.schedule
        return schedule.network.regressors(
            schedule.inputs(qd, qdd, schedule.initial_state(qd, qdd))
        )

    def _coefficients(self, phi: Tensor) -> Tensor:
        free = self.scale * (self.weight * phi.unsqueeze(-2)).sum(-1)
        return torch.minimum(torch.maximum(free, self.least), self.most)


def law_slopes(
    model: FrictionModel, qd: Tensor, load: Tensor, coefficients: Tensor, learnt: Tensor
) -> tuple[Tensor, Tensor]:
    """Torque of a law, and its derivatives by the linear coefficients (zero for others)."""
    torque = model.torque(qd, load, coefficients)
    step = torch.eye(len(learnt), dtype=coefficients.dtype)
    moved = [model.torque(qd, load, coefficients + step[k]) - torque for k in range(len(learnt))]
    return torque, torch.where(learnt, torch.stack(moved, -1), 0.0)


def write_online(
    model: FrictionModel, folder: str | Path, options: OnlineOptions, *, name: str = "online"
) -> list[Path]:
    """Write a model that learns online as C code for controllers, `<name>.c` and `<name>.h`.

    C89 in double precision without memory allocation: `<name>_start`, `<name>_step` and
    `<name>_learn` do what `OnlineNetwork` does.

    Args:
        model, options: see `OnlineNetwork`.
        folder: where to write; created if missing.
        name: of the files, and prefix of all identifiers.

    Raises:
        ValueError: see `OnlineNetwork`, or if the name is not a valid C identifier.
    """
    if not is_identifier(name):
        raise ValueError(f"`name` must be an identifier of C of up to 31 letters, got {name!r}.")
    learner, dialect = OnlineNetwork(model, options), ControllerC(prefix=name, templates=TEMPLATES)
    schedule = learner.schedule
    network = schedule.network
    values = {
        "lower": schedule.input_lower, "upper": schedule.input_upper, "centre": network.centres,
        "per_width": torch.exp(-network.log_widths), "trained": learner.weight,
        "scale": learner.scale, "least": learner.least, "most": learner.most,
    }  # fmt: skip
    law, torque = _law(learner, dialect)
    words: dict[str, Any] = {
        "name": name, "model": type(model).__name__, "version": __version__,
        "joints": model.joints, "coefficients": len(model.law.names), "units": network.units,
        "along_motion": schedule.along_motion, "turn": schedule.turn, "law": law, "torque": torque,
        "variance": options.spread**2, "noise_variance": options.noise**2,
        "forget": options.forget, "slowest": options.slowest, "forgetting": options.forgetting,
        "sample_time": options.sample_time,
        "table": lambda key, *sizes: dialect.table(key, values[key].detach(), *sizes),
    }  # fmt: skip
    body = dialect.text("online.c.j2", **words, helpers="")
    texts = {
        f"{name}.c": dialect.text("online.c.j2", **words, helpers=dialect.functions(body)),
        f"{name}.h": dialect.text("online.h.j2", **words),
    }
    return [write_atomically(Path(folder) / key, text.encode()) for key, text in texts.items()]


def _law(learner: OnlineNetwork, dialect: ControllerC) -> tuple[list[str], str]:
    """C statements that fill `slope`, and the expression for the torque of any one joint."""
    count = len(learner.learnt)
    # All different, so that no two values are equal by chance.
    example = torch.linspace(0.5, 1.5, count + 2, dtype=torch.float64)
    program = trace(
        lambda qd, load, c: law_slopes(learner.model, qd, load, c, learner.learnt),
        {"qd": example[:1], "load": example[1:2], "c": example[None, 2:]},
    )
    bound = {
        node.number: f"c[{i}]" if port.name == "c" else port.name
        for port in program.inputs
        for i, node in enumerate(port.nodes)
    }
    torque, slopes = (port.nodes for port in program.outputs)
    lines, texts = statements([*torque, *slopes], bound, dialect)
    return [*lines, *(f"slope[{k}] = {text};" for k, text in enumerate(texts[1:]))], texts[0]

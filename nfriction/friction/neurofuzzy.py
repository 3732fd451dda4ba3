"""Neuro-fuzzy models: a network gives coefficients as functions of velocity and acceleration."""

import math
import reprlib
from collections.abc import Callable, Sequence
from pkgutil import resolve_name
from typing import Any, Final, Literal, SupportsIndex

import torch
from torch import Tensor, nn
from torch.nn.functional import pad

from nfriction.friction import laws
from nfriction.friction.coefficients import Constant, Schedule
from nfriction.friction.heat import Heated
from nfriction.friction.inputs import has_input, with_inputs
from nfriction.friction.laws import Law
from nfriction.friction.models import V_SMOOTH, FrictionModel, NamedModel
from nfriction.friction.parameters import Sensitivity, as_tensor, positive_number, require_options
from nfriction.fuzzy import AnfisRBF
from nfriction.fuzzy.membership import FuzzyRules
from nfriction.fuzzy.partition import FreePartition

# Smallest initial ratio of a coefficient to its scale: starting from zero it could not rise.
LEAST_RATIO = 1e-3
# With a third of this, the network is too stiff to follow large swings, and then wrong at smaller
# ones: 6.8 mrad instead of 3.0 on later swings of a real pendulum (its constant law: 5.3).
PRIOR_SD = 0.3
# SD of the logistic distribution, which is that of the logit of a uniformly distributed fraction.
LOGIT_SD = math.pi / math.sqrt(3.0)


def smooth_relu(u: Tensor, roundness: float) -> Tensor:
    """A positive number for every u, and u itself away from zero: `(u + sqrt(u^2 + 4 r^2)) / 2`."""
    return 0.5 * (u + torch.sqrt(u * u + 4.0 * roundness * roundness))


def smooth_relu_inverse(y: Tensor, roundness: float) -> Tensor:
    """The u for which `smooth_relu(u, roundness)` is y > 0."""
    return y - roundness * roundness / y


def taper(beyond: Tensor, reach: float) -> Tensor:
    """1 within a range, 0 beyond a distance `reach` from it, `(1 - |e|^2 / reach^2)^2` between.

    `beyond` is e, the distance of each input from its range, (..., input).
    """
    beyond = beyond / reach
    rest = (1.0 - (beyond * beyond).sum(-1)).clamp_min(0.0)
    return rest * rest


def taper_slope(beyond: Tensor, reach: float) -> Tensor:
    """Derivative of `taper` with respect to each input's distance from its range, (..., input)."""
    beyond = beyond / reach
    rest = (1.0 - (beyond * beyond).sum(-1, keepdim=True)).clamp_min(0.0)
    return -4.0 / reach * rest * beyond


class NeuroFuzzy(Schedule):
    """Coefficients from an ANFIS layer with a radial basis head.

    Inputs are |velocity| and acceleration, scaled to their trained range and clamped to it. The
    network's output is the deviation from a constant reference, in units of a scale; it starts at
    zero, so an untrained model *is* the constant law, and a zero-mean prior pulls toward it.
    Beyond the trained range the deviation tapers off to the constant law.

    Args:
        initial: reference coefficients in SI, (joint, coefficient) or (coefficient,).
        terms: numbers of fuzzy sets of velocity and of acceleration.
        head_units: number of units of the radial basis head.
        acceleration: `"along_motion"` uses qdd sgn(qd), so that friction is the same in both
            directions; `"signed"` uses qdd, like the papers.
        interpretable: keep the sets ordered, in range and overlapping, even when a fit moves them.
        prior_sd: standard deviation of the network's parameters around the start of a fit:
            consequents and weights in units of the coefficients' scale, widths as logarithms,
            centres in widths. A fit also tries a third of this for the weights, and determines
            that of the sets by evidence.

    Attributes:
        learn_sets: whether `parameter_vector` includes the sets and the head's units in addition to
            their weights; a fit decides by evidence whether they move.

    References:
        TLRIP paper, neuro-fuzzy friction estimation (5 x 5 sets, 25 rules, 10 radial basis units).
    """

    form = "neurofuzzy"

    # `Final` makes these constants for TorchScript.
    roundness: Final[float] = 0.005  # of `smooth_relu`, in units of a coefficient's scale
    reach: Final[float] = 0.5  # distance from the trained range at which `taper` is zero, in ranges
    turn: Final[float] = 3e-3  # width of the smooth sign in qdd sgn(qd), in ranges of the velocity

    fit_strategy = "nfriction.fitting.strategy.neurofuzzy:fit_neurofuzzy"
    handles_range = True
    learn_sets: bool = False

    reference: Tensor
    scale: Tensor
    velocity_range: Tensor
    acceleration_lower: Tensor
    acceleration_upper: Tensor

    def __init__(
        self,
        law: Law,
        joints: int,
        initial: Tensor | Sequence | None = None,
        *,
        terms: Sequence[int] = (5, 5),
        head_units: int = 10,
        acceleration: Literal["along_motion", "signed"] = "along_motion",
        interpretable: bool = False,
        prior_sd: float = PRIOR_SD,
    ) -> None:
        super().__init__(law, joints)
        self.fitted_mask = [c.fitted and not c.stores for c in law.coefficients]
        if acceleration not in ("along_motion", "signed"):
            raise ValueError(
                f'`acceleration` must be "along_motion" or "signed", got {acceleration!r}.'
            )
        if isinstance(head_units, bool) or not isinstance(head_units, SupportsIndex):
            raise ValueError(
                f"`head_units` must be a whole number of units, got {reprlib.repr(head_units)}."
            )
        listed = isinstance(terms, list | tuple)
        if not listed or not all(isinstance(count, SupportsIndex) for count in terms):
            raise ValueError(
                "`terms` must be two whole numbers, the fuzzy sets of velocity and of "
                f"acceleration, got {reprlib.repr(terms)}."
            )
        k = len(law.names)
        # No fit varies the last coefficients of some laws, such as those of heat.
        self.outputs = max((i + 1 for i in range(k) if self.fitted_mask[i]), default=1)
        self.unvaried = k - self.outputs
        self.terms, self.head_units = tuple(terms), head_units
        self.interpretable = bool(interpretable)
        self.along_motion = acceleration == "along_motion"
        self.prior_sd = positive_number("prior_sd", prior_sd)
        self.network = AnfisRBF(
            joints, 2, terms, self.outputs, units=head_units, interpretable=interpretable
        )
        self.network.init_grid(0.0, 1.0)
        for name in ("reference", "scale"):
            self.register_buffer(name, torch.ones(joints, k, dtype=torch.float64))
        for name in ("velocity_range", "acceleration_lower", "acceleration_upper"):
            self.register_buffer(name, torch.ones(joints, dtype=torch.float64))
        self.set_reference(Constant(law, joints, initial).values)
        # As wide as in the papers; a fit sets the range of its recordings.
        self.set_range(20.0, [-200.0, 200.0])

    def scaled(self, qd: Tensor, qdd: Tensor) -> Tensor:
        """Inputs scaled to [0, 1] over their trained range, shape (*batch, joint, 2)."""
        # Uses |velocity|, so that friction is odd in the velocity without any training.
        velocity = qd / self.velocity_range
        if self.along_motion:
            qdd = qdd * torch.tanh(velocity / self.turn)
        span = self.acceleration_upper - self.acceleration_lower
        return torch.stack([velocity.abs(), (qdd - self.acceleration_lower) / span], -1)

    def forward(self, qd: Tensor, qdd: Tensor) -> Tensor:
        x, weight = self._clamped_inputs(qd, qdd)
        return self.to_coefficients(self.reference + weight * self.deviation(x))

    def deviation(self, x: Tensor) -> Tensor:
        """Deviation from the reference at inputs within the range, (*batch, joint, coefficient)."""
        found = self.network(x)
        return pad(found, [0, self.unvaried]) if self.unvaried else found

    def _clamped_inputs(self, qd: Tensor, qdd: Tensor) -> tuple[Tensor, Tensor]:
        """Inputs of the network, and the weight of its output (*batch, joint, 1)."""
        scaled = self.scaled(qd, qdd)
        x = scaled.clamp(0.0, 1.0)
        return x, taper(scaled - x, self.reach).unsqueeze(-1)

    def to_coefficients(self, u: Tensor) -> Tensor:
        """Coefficients in SI from the network's own units."""
        return self.scale * torch.where(self.positive, smooth_relu(u, self.roundness), u)

    def reference_coefficients(self) -> Tensor:
        """Coefficients of the constant law from which the network deviates, in SI."""
        return self.to_coefficients(self.reference)

    def coefficient_sets(self) -> dict[str, Tensor]:
        reference = self.reference_coefficients().detach()
        if self.fuzzy_rules().constant:
            return {"always": reference}
        return super().coefficient_sets() | {"reference": reference}

    @torch.no_grad()
    def fuzzy_rules(self) -> FuzzyRules:
        lower = torch.stack([torch.zeros_like(self.velocity_range), self.acceleration_lower], -1)
        upper = torch.stack([self.velocity_range, self.acceleration_upper], -1)
        centres, widths = (x.split(self.terms, -1) for x in self.network.anfis.sets())
        # Every pair of centres is a sample, for all joints at once; acceleration varies fastest.
        v, a = (c.clamp(0.0, 1.0).T for c in centres)
        pairs = [v.repeat_interleave(self.terms[1], 0), a.repeat(self.terms[0], 1)]
        found = self.to_coefficients(self.reference + self.deviation(torch.stack(pairs, -1)))
        span = (upper - lower)[..., None]
        return FuzzyRules(
            lower,
            upper,
            tuple(lower[:, i, None] + span[:, i] * c for i, c in enumerate(centres)),
            tuple(span[:, i] * w for i, w in enumerate(widths)),
            found.transpose(0, 1),
            self.along_motion,
        )

    @torch.no_grad()
    def set_reference(
        self, values: Tensor, scale: Tensor | None = None, least: float = LEAST_RATIO
    ) -> None:
        """Set the constant law from which the network deviates.

        Args:
            values: coefficients in SI, (joint, coefficient).
            scale: unit of the deviation of a coefficient, (joint, coefficient); at least its value,
                which is also the default (1 if that is zero).
            least: smallest ratio of a positive coefficient to its scale; smaller ones are raised.
        """
        values = values.to(self.reference)
        size = values.abs()
        if scale is not None:
            size = torch.maximum(size, scale.to(size))
        # A coefficient of zero cannot be its own unit.
        self.scale.copy_(torch.where(size > 0, size, torch.ones_like(size)))
        ratio = values / self.scale
        lowest = torch.full_like(ratio, least)
        # One that no fit varies need not rise, such as the fall by heat of a joint without any.
        lowest[:, self.outputs :] = 1e-6
        lifted = smooth_relu_inverse(ratio.maximum(lowest), self.roundness)
        self.reference.copy_(torch.where(self.positive, lifted, ratio))

    @torch.no_grad()
    def set_range(
        self, velocity: Tensor | Sequence[float] | float, acceleration: Tensor | Sequence[float]
    ) -> None:
        """Set the trained range, beyond which the network's output tapers off.

        Args:
            velocity: largest |velocity| of each joint [rad/s], (joint,) or one for all joints.
            acceleration: smallest and largest acceleration [rad/s^2], (joint, 2) or (2,); along
                the motion if the schedule uses it in that form.

        Raises:
            ValueError: if a range is empty or not finite.
        """
        like = self.velocity_range
        fastest = torch.as_tensor(velocity, dtype=like.dtype, device=like.device)
        both = torch.as_tensor(acceleration, dtype=like.dtype, device=like.device)
        lower, upper = both.unbind(-1)
        finite = torch.isfinite(fastest).all() and torch.isfinite(both).all()
        if not (finite and (fastest > 0).all() and (upper > lower).all()):
            raise ValueError(
                "a range must be finite and not empty: velocity > 0 and lower < upper "
                f"acceleration, got {fastest.tolist()} and {both.tolist()}."
            )
        self.velocity_range.copy_(fastest)
        self.acceleration_lower.copy_(lower)
        self.acceleration_upper.copy_(upper)

    def within_range(self, qd: Tensor, qdd: Tensor) -> tuple[Tensor, Tensor]:
        qd = qd.clamp(-self.velocity_range, self.velocity_range)
        sign = torch.ones_like(qd)
        if self.along_motion:
            sign = torch.tanh(qd / self.velocity_range / self.turn)
        held = (sign * qdd).clamp(self.acceleration_lower, self.acceleration_upper)
        # At rest the network's input is zero for every acceleration.
        return qd, torch.where(sign == 0, qdd, held / sign)

    def trained(self) -> tuple[nn.Parameter, ...]:
        """The parameters that a trajectory fit varies, each (joint, ...).

        First the `weights`, then the parameters of the sets and the centres and widths of the
        head's units.
        """
        if not self.learn_sets:
            return self.weights()
        partition, head = self.network.anfis.partition, self.network.head
        return (*self.weights(), *partition.parameters(), head.centres, head.log_widths)

    def weights(self) -> tuple[nn.Parameter, nn.Parameter]:
        """Parameters that enter the coefficients almost linearly, (joint, coefficient, ...).

        The consequents of the rules and the weights of the head. The head's bias stays zero: it
        would be redundant with the rules' constants, and would halve the prior on them.
        """
        return self.network.anfis.consequents, self.network.head.output_weight

    def parameter_vector(self) -> Tensor:
        return torch.cat([p.detach().reshape(-1) for p in self.trained()])

    @torch.no_grad()
    def set_parameter_vector(self, vector: Tensor) -> None:
        trained = self.trained()
        for p, part in zip(trained, vector.split([p.numel() for p in trained]), strict=True):
            p.copy_(part.reshape(p.shape))

    def parameter_names(self, joint_names: Sequence[str]) -> list[str]:
        rules, weights = (p[0, 0].numel() for p in self.weights())
        columns = ("velocity slope", "acceleration slope", "constant")
        planes = [
            f"{columns[k % len(columns)]} of rule {k // len(columns) + 1}" for k in range(rules)
        ]
        head = [f"head weight {k + 1}" for k in range(weights)]
        names = [
            f"{name} of {joint}: {part}"
            for parts in (planes, head)
            for joint in joint_names
            for name in self.coefficient_names[: self.outputs]
            for part in parts
        ]
        for group, p in zip(self.group_names()[2:], self.trained()[2:], strict=True):
            parts = [f"{group} {k + 1}" for k in range(p[0].numel())]
            names += [f"network of {joint}: {part}" for joint in joint_names for part in parts]
        return names

    def group_names(self) -> tuple[str, ...]:
        """Names of the tensors in `trained`; the parameters of each share a prior."""
        sets = tuple(
            f"set {name.removeprefix('log_')}"
            for name, _ in self.network.anfis.partition.named_parameters()
        )
        names = ("consequents", "head weights", *sets, "head centres", "head widths")
        return names[: len(self.trained())]

    def groups(self) -> Tensor:
        """Index in `group_names` of each parameter's group, (parameter,)."""
        sizes = torch.tensor([p.numel() for p in self.trained()])
        return torch.arange(len(sizes)).repeat_interleave(sizes)

    def bounds(self) -> tuple[Tensor, Tensor]:
        vector = self.parameter_vector()
        # The network of a coefficient that is not fitted stays where it started.
        mask = torch.tensor(self.fitted_mask[: self.outputs], device=vector.device)[:, None]
        fitted = torch.ones_like(vector, dtype=torch.bool)
        linear = [mask.expand(self.joints, -1, p[0, 0].numel()).reshape(-1) for p in self.weights()]
        fitted[: sum(len(part) for part in linear)] = torch.cat(linear)
        free = torch.full_like(vector, torch.inf)
        return torch.where(fitted, -free, vector), torch.where(fitted, free, vector)

    def prior(self) -> tuple[Tensor, Tensor]:
        """Mean and standard deviation: mean zero for weights, the current values for sets."""
        partition, head = self.network.anfis.partition, self.network.head
        mean, units = self.parameter_vector(), {}
        mean[: sum(p.numel() for p in self.weights())] = 0.0
        # Centres are in units of widths, spacings are logits, and all others are relative already.
        units[head.centres] = head.log_widths.detach().exp()
        if isinstance(partition, FreePartition):
            units[partition.centres] = partition.log_widths.detach().exp()
        else:
            spacings = partition.spacings
            units[spacings] = torch.full_like(spacings, LOGIT_SD / self.prior_sd)
        sizes = [units.get(p, torch.ones_like(p)).reshape(-1) for p in self.trained()]
        return mean, self.prior_sd * torch.cat(sizes).detach()

    def belief(self) -> tuple[Tensor, Tensor]:
        """Mean, and a standard deviation of one unit: coefficients vary by about their own size."""
        mean, sd = self.prior()
        return mean, sd / self.prior_sd

    @torch.no_grad()
    def sensitivities(self, qd: Tensor, qdd: Tensor) -> Sensitivity:
        """Derivatives of the coefficients in closed form.

        With x the scaled inputs, u the reference plus w n, n the network's outputs at clamped x, w
        their weight, v = qd / v_max and t = tanh(v / turn) (1 where acceleration is signed):

            du/dx   = w dn/dx within the range, n dw/dx beyond it,
            dc/dqd  = dc/du (du/dx_1 sgn(v) / v_max + du/dx_2 qdd dt/dqd / span),
            dc/dqdd = dc/du du/dx_2 t / span.
        """
        anfis, head = self.network.anfis, self.network.head
        x, weight = self._clamped_inputs(qd, qdd)
        y, beyond = anfis(x), self.scaled(qd, qdd) - x
        both = torch.cat([x, y], -1)
        n = y + head(both)
        # The slope of s = smooth_relu(u) with roundness r is s^2 / (s^2 + r^2).
        s = self.to_coefficients(self.reference + weight * pad(n, [0, self.unvaried])) / self.scale
        rounded = s * s / (s * s + self.roundness**2)
        by_u = self.scale * torch.where(self.positive, rounded, 1.0)
        by_head = head.input_jacobian(both).permute(3, 0, 1, 2)
        # The outputs of the rules are also inputs of the head.
        by_input, by_y = by_head.tensor_split([x.shape[-1]], -1)
        columns = anfis.jacobian_columns(x)
        by_x = anfis.input_jacobian(x, columns).permute(3, 0, 1, 2)
        by_x = (by_x + by_input + by_y @ by_x) * weight[..., None]
        # A clamped input no longer affects the network itself, only the weight of its output.
        by_x = torch.where((beyond == 0.0).unsqueeze(-2), by_x, 0.0)
        by_x = by_x + n[..., None] * taper_slope(beyond, self.reach)[..., None, :]
        by_x = pad(by_x, [0, 0, 0, self.unvaried]) * by_u[..., None]
        by_speed, by_acceleration = by_x.unbind(-1)
        velocity, span = self.velocity_range, self.acceleration_upper - self.acceleration_lower
        by_qd = by_speed * (qd.sign() / velocity)[..., None]
        by_qdd = by_acceleration / span[:, None]
        if self.along_motion:
            turned = torch.tanh(qd / velocity / self.turn)
            turning = qdd * (1.0 - turned * turned) / (velocity * self.turn)
            by_qd, by_qdd = by_qd + by_qdd * turning[..., None], by_qdd * turned[..., None]

        @torch.no_grad()
        def factors() -> tuple[tuple[Tensor, Tensor], ...]:
            own = torch.eye(len(self.fitted_mask), self.outputs, dtype=y.dtype, device=y.device)
            through, direct = pad(by_y, [0, 0, 0, self.unvaried]), (by_u * weight)[..., None]
            by_rules, by_weights = direct * (own + through), direct * own
            shared = anfis.consequents[0, 0].numel()
            rules = by_rules, columns[:, :shared].movedim(-1, 0)
            if not self.learn_sets:
                return rules, (by_weights, head.activations(both))
            units = head.jacobian_columns(both)
            by_set = columns[:, shared:].unflatten(1, (y.shape[-1], -1))
            # Derivatives of a unit's output by its centre and log width, both over the squared
            # width.
            moved = units[:, head.units + 1 :].unflatten(1, (2, -1)).permute(3, 0, 1, 2)
            moved = moved * torch.exp(-2.0 * head.log_widths).flatten(1)[:, None]
            by_unit = head.output_weight.repeat_interleave(head.inputs, -1)
            return (
                rules,
                (by_weights, units[:, : head.units].movedim(-1, 0)),
                *(
                    (by_rules, (rows.mT.unsqueeze(1) @ by_set).permute(3, 0, 1, 2))
                    for rows in anfis.partition.jacobian().values()
                ),
                *((by_weights, by_unit * part.unsqueeze(2)) for part in moved.unbind(2)),
            )

        return Sensitivity(factors, by_qd, by_qdd)

    def options(self) -> dict[str, Any]:
        return {
            "terms": list(self.terms),
            "head_units": self.head_units,
            "acceleration": "along_motion" if self.along_motion else "signed",
            "interpretable": self.interpretable,
            "prior_sd": self.prior_sd,
        }

    def extra_repr(self) -> str:
        return ", ".join(f"{name}={value!r}" for name, value in self.options().items())


class HeatedNeuroFuzzy(Heated, NeuroFuzzy):
    """Neuro-fuzzy coefficients of a law with heat."""

    # In TorchScript, `Final` is not inherited.
    __constants__ = ("roundness", "reach", "turn")


# Networks for coefficients, by their names in model files. The papers' own one is resolved by name,
# because the core does not import the papers.
NETWORKS = {
    "anfis": "nfriction.friction.neurofuzzy:NeuroFuzzy",
    "rbf": "nfriction.papers.nffem.rbf_coefficients:RBFCoefficients",
}


class NeuroFuzzyModel(NamedModel):
    """A law with coefficients from an ANFIS layer with a radial basis head, `NeuroFuzzy`.

    Args:
        joints, initial, v_smooth: see `NamedModel`; training starts from the constants `initial`.
        network: `"anfis"`; `"rbf"`: the papers' network alone, see `RBFCoefficients`.
        inputs: quantities other than speed and acceleration on which friction depends:
            `"direction"` of rotation, `"load"` of the bearing or `"position"`, `"heat"` of joints,
            each with its own coefficient (`with_inputs`); with None, every fit selects the useful
            ones, and the model is `selected` (not after loading a file: its inputs are given).
        options: of the coefficients, e.g. `terms=(7, 5)`.
    """

    def __init__(
        self,
        joints: int,
        initial: Tensor | Sequence | None = None,
        *,
        v_smooth: float = V_SMOOTH,
        inputs: Sequence[str] | None = None,
        **options: Any,
    ) -> None:
        law, own = with_inputs(self.definition, inputs or ()), len(self.definition.names)
        if initial is not None:
            initial = as_tensor("coefficients", initial)
            if initial.shape[-1:] == (own,):  # of the law alone: further inputs start at zero
                initial = pad(initial, [0, len(law.names) - own])
        schedule = self.make_schedule(law, joints, initial, **options)
        FrictionModel.__init__(self, law, schedule, v_smooth)
        self.inputs = None if inputs is None else list(inputs)
        self.selected = False

    def see(self, inputs: Sequence[str] | None) -> None:
        """Replace the further inputs, with an untrained network; a constant law keeps its own."""
        own = self.schedule.coefficient_sets().get("always")
        own = None if own is None else own[:, : len(self.definition.names)]
        options = {**self.options(), "inputs": inputs}
        self.__init__(self.joints, own, v_smooth=self.v_smooth, **options)  # type: ignore[misc]

    def options(self) -> dict[str, Any]:
        return super().options() | ({} if self.inputs is None else {"inputs": self.inputs})

    @staticmethod
    def make_schedule(*args: Any, network: str = "anfis", **options: Any) -> Schedule:
        if network not in NETWORKS:
            raise ValueError(f"`network` must be one of {sorted(NETWORKS)}, got {network!r}.")
        made: Callable[..., Schedule] = resolve_name(NETWORKS[network])
        require_options(f"network {network!r}", made, options, ("network", "inputs"))
        for name in ("heat", "position"):
            if made is not NeuroFuzzy and has_input(args[0], name):
                raise ValueError(f'the input "{name}" needs `network="anfis"`, got {network!r}.')
        if has_input(args[0], "heat"):
            made = HeatedNeuroFuzzy
        return made(*args, **options)


class NFNCFM(NeuroFuzzyModel):
    """Viscous friction with a neuro-fuzzy coefficient (TLRIP paper)."""

    definition = laws.VISCOUS


class NFCFM(NeuroFuzzyModel):
    """Coulomb friction with a neuro-fuzzy F_c: any odd function of velocity."""

    definition = laws.COULOMB


class NFCVFM(NeuroFuzzyModel):
    """Coulomb plus viscous friction with neuro-fuzzy F_c and F_v."""

    definition = laws.COULOMB_VISCOUS


class NFLFM(NeuroFuzzyModel):
    """Viscous plus load-dependent Coulomb friction with neuro-fuzzy B and C (TLRIP paper)."""

    definition = laws.LINEAR


class NFNLFM(NeuroFuzzyModel):
    """Offset, Coulomb, viscous and arctangent friction, neuro-fuzzy coefficients (TLRIP paper)."""

    definition = laws.NONLINEAR


class NFStribeck(NeuroFuzzyModel):
    """Generalised Stribeck friction with neuro-fuzzy F_c, F_d, F_v and v_s, and constant delta."""

    definition = laws.STRIBECK

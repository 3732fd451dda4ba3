"""Coefficients as a neuro-fuzzy function of velocity and acceleration."""

from collections.abc import Sequence
from typing import Literal

import torch
from torch import Tensor, nn
from torch.func import functional_call, grad, vmap

from nfriction.friction.laws import Law
from nfriction.friction.schedules import Constant, Schedule, Sensitivity
from nfriction.fuzzy import AnfisRBF

# Roundness of the positive map, in units of the coefficient's scale: 0.05 leaves it linear for
# all but the last twentieth above zero.
ROUNDNESS = 0.05
# Velocity over which "along the motion" turns [rad/s]; only feeds held coefficients.
DIRECTION_SMOOTH = 3e-2
# Samples whose parameter derivatives are formed at once.
CHUNK = 4096


class NeuroFuzzy(Schedule):
    """An ANFIS layer and a radial basis head give the coefficients of a law.

    Inputs are |velocity| and acceleration, scaled to their trained range and clamped to it. The
    network's output is the deviation from a constant reference, in units of a scale; it starts at
    zero, so an untrained model *is* the constant law, and a prior around zero pulls toward it.

    Args:
        law: the law whose coefficients these are.
        joints: number of joints.
        initial: reference coefficients in SI, (joint, coefficient) or (coefficient,).
        terms: fuzzy sets of velocity and of acceleration.
        head_units: units of the radial basis head.
        acceleration: `"along_motion"` takes qdd sgn(qd), so that both directions of turning are
            alike; `"signed"` takes qdd as the papers do.
        interpretable: keep the sets ordered, in range and overlapping.
        prior_sd: standard deviation of the network's parameters around zero, in units of the
            coefficients' scale.

    References:
        TLRIP paper, neuro-fuzzy friction estimation (5 x 5 sets, 25 rules, 10 radial basis units).
    """

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
        prior_sd: float = 0.3,
    ) -> None:
        super().__init__(law, joints)
        if acceleration not in ("along_motion", "signed"):
            raise ValueError(
                f'`acceleration` must be "along_motion" or "signed", got {acceleration!r}.'
            )
        k = len(law.names)
        self.terms, self.head_units = tuple(terms), head_units
        self.interpretable = interpretable
        self.along_motion = acceleration == "along_motion"
        self.prior_sd = prior_sd
        self.network = AnfisRBF(joints, 2, terms, k, units=head_units, interpretable=interpretable)
        self.network.init_grid(torch.zeros(2), torch.ones(2))
        self.register_buffer("positive", torch.tensor(self.positive_mask), persistent=False)
        for name, shape in (
            ("reference", (joints, k)),
            ("scale", (joints, k)),
            ("velocity_range", (joints,)),
            ("acceleration_lower", (joints,)),
            ("acceleration_upper", (joints,)),
        ):
            self.register_buffer(name, torch.ones(shape, dtype=torch.float64))
        self.set_reference(Constant(law, joints, initial).values)
        self.set_range(torch.full((joints,), 20.0), torch.tensor([-200.0, 200.0]))

    def inputs(self, qd: Tensor, qdd: Tensor) -> Tensor:
        """Scaled inputs of the network in [0, 1], shape (*batch, joint, 2)."""
        if self.along_motion:
            qdd = qdd * torch.tanh(qd / 3e-2)
        span = self.acceleration_upper - self.acceleration_lower
        scaled = torch.stack(
            [qd.abs() / self.velocity_range, (qdd - self.acceleration_lower) / span], -1
        )
        return scaled.clamp(0.0, 1.0)

    def forward(self, qd: Tensor, qdd: Tensor) -> Tensor:
        raw = self.reference + self.network(self.inputs(qd, qdd))
        # (u + sqrt(u^2 + 4 r^2)) / 2: positive, and u itself away from zero.
        lifted = 0.5 * (raw + torch.sqrt(raw * raw + 0.01))
        return self.scale * torch.where(self.positive, lifted, raw)

    @torch.no_grad()
    def set_reference(self, values: Tensor, scale: Tensor | None = None) -> None:
        """Set the constant law from which the network deviates.

        Args:
            values: coefficients in SI, (joint, coefficient).
            scale: how far a coefficient may deviate, (joint, coefficient); default its value.
        """
        size = values.abs() if scale is None else torch.maximum(values.abs(), scale)
        self.scale.copy_(torch.where(size > 0, size, 1.0))
        ratio = values / self.scale
        # Below a hundredth of its scale a coefficient is as good as zero, and must be able to rise.
        above = ratio.clamp_min(0.01)
        raw = torch.where(self.positive, above - ROUNDNESS**2 / above, ratio)
        self.reference.copy_(raw)

    @torch.no_grad()
    def set_range(self, velocity: Tensor, acceleration: Tensor) -> None:
        """Set the trained range, outside which inputs are clamped.

        Args:
            velocity: largest |velocity| of each joint [rad/s], (joint,).
            acceleration: smallest and largest acceleration [rad/s^2], (joint, 2) or (2,).

        Raises:
            ValueError: if a range is empty or not finite.
        """
        velocity = torch.as_tensor(velocity, dtype=torch.float64)
        acceleration = torch.as_tensor(acceleration, dtype=torch.float64)
        lower, upper = acceleration.unbind(-1)
        finite = torch.isfinite(velocity).all() and torch.isfinite(acceleration).all()
        if not (finite and (velocity > 0).all() and (upper > lower).all()):
            raise ValueError(
                "a range must be finite and not empty: velocity > 0 and lower < upper "
                f"acceleration, got {velocity.tolist()} and {acceleration.tolist()}."
            )
        self.velocity_range.copy_(velocity)
        self.acceleration_lower.copy_(lower)
        self.acceleration_upper.copy_(upper)

    def trained(self) -> dict[str, nn.Parameter]:
        """The parameters that a trajectory fit varies: what enters the coefficients linearly."""
        return {
            name: p
            for name, p in self.named_parameters()
            if name.endswith(("consequents", "output_weight"))
        }

    def parameter_vector(self) -> Tensor:
        return torch.cat([p.detach().reshape(-1) for p in self.trained().values()])

    @torch.no_grad()
    def set_parameter_vector(self, vector: Tensor) -> None:
        trained = self.trained().values()
        for p, part in zip(trained, vector.split([p.numel() for p in trained]), strict=True):
            p.copy_(part.reshape(p.shape))

    def bounds(self) -> tuple[Tensor, Tensor]:
        free = torch.full_like(self.parameter_vector(), torch.inf)
        return -free, free

    def prior(self) -> tuple[Tensor, Tensor]:
        """Mean and standard deviation of the parameter vector."""
        vector = self.parameter_vector()
        return torch.zeros_like(vector), torch.full_like(vector, self.prior_sd)

    def sensitivities(self, qd: Tensor, qdd: Tensor) -> Sensitivity:
        trained = {name: p.detach() for name, p in self.trained().items()}
        rest = {
            n: t.detach() for n, t in self.state_dict(keep_vars=True).items() if n not in trained
        }

        def one(values: dict[str, Tensor], qd: Tensor, qdd: Tensor, k: int) -> Tensor:
            # Joints share no parameter, so the sum over joints has every joint's gradient in it.
            return functional_call(self, {**rest, **values}, (qd, qdd))[:, k].sum()

        count = len(self.coefficient_names)
        rows = []
        for k in range(count):
            per_sample = vmap(grad(lambda v, a, b, k=k: one(v, a, b, k)), (None, 0, 0),
                              chunk_size=CHUNK)(trained, qd, qdd)  # fmt: skip
            rows.append(torch.cat([g.reshape(qd.shape[0], -1) for g in per_sample.values()], -1))
        joint = torch.cat(
            [
                torch.arange(self.joints).repeat_interleave(p.numel() // self.joints)
                for p in trained.values()
            ]
        )
        ones, zeros = torch.ones_like(qd), torch.zeros_like(qd)
        by_qd = torch.func.jvp(self.forward, (qd, qdd), (ones, zeros))[1].detach()
        by_qdd = torch.func.jvp(self.forward, (qd, qdd), (zeros, ones))[1].detach()
        return Sensitivity(torch.stack(rows, 1), joint, by_qd, by_qdd)

"""Coefficients by class of acceleration, corrected by a neuro-fuzzy function of the motion."""

from collections.abc import Mapping, Sequence
from typing import Any, Final

import torch
from torch import Tensor

from nfriction.friction.coefficients import Schedule
from nfriction.friction.laws import Law
from nfriction.friction.neurofuzzy import LEAST_RATIO, NeuroFuzzy, smooth_relu_inverse
from nfriction.friction.parameters import Sensitivity, require_options
from nfriction.fuzzy.membership import HALF_WIDTH_OF_GAUSSIAN
from nfriction.fuzzy.partition import crossing_half_widths
from nfriction.papers.afem.adaptive import CLASSES, Adaptive

# Powers of an even spacing from zero by which sets of velocity and acceleration are placed.
VELOCITY_POWER, ACCELERATION_POWER = 3, 2


class AdaptiveNeuroFuzzy(Schedule):
    """An adaptive schedule from which a neuro-fuzzy one deviates.

    A network of the present velocity and acceleration cannot know how violent the motion has been
    lately, nor for how long it has lasted; the classes of an adaptive schedule do. Here they give
    the reference and the network its correction, so that an untrained one *is* the adaptive
    schedule, and a fit can only add to it.

    Args:
        law: the law whose coefficients these are.
        joints: number of joints.
        initial: coefficients at the start, as in `Adaptive`.
        memory: options of the classes, see `Adaptive`.
        network: options of the network, see `NeuroFuzzy`.

    Attributes:
        adaptive: the reference by class, with its memory.
        deviation: the network, its inputs' range and the coefficients' scale.

    References:
        TLRIP paper: its neuro-fuzzy models start from the adaptive ones (AFEM, then NFFEM).
    """

    state_size: int = 2
    handles_range = True
    form = "adaptive_neurofuzzy"
    fit_strategy = "nfriction.papers.nffem.correction:fit_class_correction"
    # Final makes it a constant for TorchScript.
    least_ratio: Final[float] = LEAST_RATIO

    def __init__(
        self,
        law: Law,
        joints: int,
        initial: Tensor | Sequence | None = None,
        *,
        memory: Mapping[str, float] | None = None,
        **network: Any,
    ) -> None:
        super().__init__(law, joints)
        require_options("network 'by_class'", NeuroFuzzy, network, ("memory",))
        self._law = law
        self.adaptive = Adaptive(law, joints, initial, **(memory or {}))
        # The mean over the classes: the network corrects all of them alike.
        self.deviation = NeuroFuzzy(law, joints, self.adaptive.values.mean(1), **network)

    @torch.no_grad()
    def set_adaptive(self, adaptive: Adaptive, scale: Tensor | None = None) -> None:
        """Take over an adaptive schedule with its classes, without any deviation.

        Args:
            adaptive: the new reference.
            scale: unit of the deviation of a coefficient, see `NeuroFuzzy.set_reference`.
        """
        self.adaptive = Adaptive(self._law, self.joints, adaptive.values, **adaptive.options())
        self.adaptive.set_classes(adaptive.thresholds, adaptive.swing_rate)
        # A coefficient that is small in one class may be large in another.
        largest = adaptive.values.abs().amax(1)
        self.deviation.set_reference(
            adaptive.values.mean(1), largest if scale is None else torch.maximum(largest, scale)
        )
        self.set_parameter_vector(torch.zeros_like(self.parameter_vector()))

    def set_sample_time(self, sample_time: float) -> None:
        """Set the time between samples [s], see `Adaptive.set_sample_time`."""
        self.adaptive.set_sample_time(sample_time)

    @torch.no_grad()
    def set_range(self, velocity: Tensor, acceleration: Tensor) -> None:
        """Set the network's trained range, its sets the denser the slower the motion.

        Friction changes most where a joint hardly moves, and there a swing spends most of its
        time; evenly spaced sets would see a single one in all of it.

        Args:
            velocity, acceleration: see `NeuroFuzzy.set_range`.
        """
        network = self.deviation
        network.set_range(velocity, acceleration)
        fast, lively = (torch.linspace(0.0, 1.0, n, dtype=velocity.dtype) for n in network.terms)
        centred = 2.0 * lively - 1.0
        share = centred.sign() * centred.abs() ** ACCELERATION_POWER
        low, high = (network.acceleration_lower[:, None], network.acceleration_upper[:, None])
        # In the network's inputs, where zero acceleration lies wherever its range leaves it.
        accelerations = (torch.where(share < 0, -share * low, share * high) - low) / (high - low)
        centres = [(fast**VELOCITY_POWER).expand(self.joints, -1), accelerations]
        # Neighbouring sets cross at one half, however unevenly they are spaced.
        half_widths = crossing_half_widths(centres, torch.ones(self.joints, 2).to(velocity))
        widths = [half / HALF_WIDTH_OF_GAUSSIAN for half in half_widths]
        network.network.anfis.init_from_sets(centres, widths, lower=0.0, upper=1.0)

    def forward(self, qd: Tensor, qdd: Tensor) -> Tensor:
        return self.coefficients_from(qd, qdd, self.initial_state(qd, qdd))

    def initial_state(self, qd: Tensor, qdd: Tensor) -> Tensor:
        return self.adaptive.initial_state(qd, qdd)

    def advance(self, qd: Tensor, qdd: Tensor, state: Tensor) -> Tensor:
        return self.adaptive.advance(qd, qdd, state)

    def coefficients_from(self, qd: Tensor, qdd: Tensor, state: Tensor) -> Tensor:
        base = self.adaptive.coefficients_from(qd, qdd, state)
        reference = self.lifted(base)
        # As a difference, so that a network of zeros leaves the adaptive schedule to the last bit.
        moved = self.deviation.residual_coefficients(reference, qd, qdd)
        corrected = base + (moved - self.deviation.to_coefficients(reference))
        return torch.where(self.positive, corrected.clamp_min(0.0), corrected)

    def lifted(self, base: Tensor) -> Tensor:
        """The class's coefficients in the network's units, those of zero free to rise."""
        ratio = base / self.deviation.scale
        least = torch.full_like(ratio, self.least_ratio)
        lifted = smooth_relu_inverse(torch.maximum(ratio, least), self.deviation.roundness)
        return torch.where(self.positive, lifted, ratio)

    def states(self, qd: Tensor, qdd: Tensor) -> Tensor:
        return self.adaptive.states(qd, qdd)

    def coefficient_sets(self) -> dict[str, Tensor]:
        return dict(zip(CLASSES, self.rest_coefficients().detach(), strict=True))

    def rest_coefficients(self) -> Tensor:
        # At rest the class is a matter of the past: each class has a set of its own.
        rest = torch.zeros_like(self.adaptive.swing_rate)
        rows = []
        for known in range(self.adaptive.raw.shape[1]):
            state = torch.stack([rest, torch.full_like(rest, float(known))], -1)
            rows.append(self.coefficients_from(rest, rest, state))
        return torch.stack(rows)

    def parameter_vector(self) -> Tensor:
        return self.deviation.parameter_vector()

    def set_parameter_vector(self, vector: Tensor) -> None:
        self.deviation.set_parameter_vector(vector)

    def parameter_names(self, joint_names: Sequence[str]) -> list[str]:
        return self.deviation.parameter_names(joint_names)

    def joint_of_parameters(self) -> Tensor:
        """The joint whose coefficients each entry of the parameter vector moves, (parameter,)."""
        joints = torch.arange(self.joints)
        trained = self.deviation.trained()
        return torch.cat([joints.repeat_interleave(p[0].numel()) for p in trained])

    def bounds(self) -> tuple[Tensor, Tensor]:
        return self.deviation.bounds()

    def prior(self) -> tuple[Tensor, Tensor]:
        """Parameters of the network: zero for the adaptive schedule alone."""
        return self.deviation.prior()

    def sensitivities(self, qd: Tensor, qdd: Tensor) -> Sensitivity:
        """Derivatives at motions (sample, joint), each sample taken for a first one."""
        return self.sensitivities_from(qd, qdd, self.initial_state(qd, qdd))

    def sensitivities_from(self, qd: Tensor, qdd: Tensor, state: Tensor) -> Sensitivity:
        reference = self.lifted(self.adaptive.coefficients_from(qd, qdd, state)).detach()
        return self.deviation.residual_sensitivities(reference, qd, qdd)

    def within_range(self, qd: Tensor, qdd: Tensor) -> tuple[Tensor, Tensor]:
        return self.deviation.within_range(qd, qdd)

    def options(self) -> dict[str, Any]:
        memory = {"memory": self.adaptive.options()}
        return {"network": "by_class", **self.deviation.options(), **memory}

"""Coefficients by class of acceleration (low, medium, high), and the models that have them."""

import math
from collections.abc import Sequence
from typing import Any, Final

import torch
from torch import Tensor

from nfriction.friction import laws
from nfriction.friction.coefficients import Tabulated
from nfriction.friction.models import NamedModel
from nfriction.friction.parameters import Sensitivity, positive_number
from nfriction.simulation.protocols import at_sample_time

CLASSES = ("low", "medium", "high")


def peak_envelope(size: Tensor, fading: Tensor | float) -> Tensor:
    """Causal envelope of a series: `e_k = max(size_k, fading e_(k-1))`, along the first axis."""
    # max of size_i f^(k-i) over i <= k, as a running maximum of logarithms.
    steps = torch.arange(len(size), dtype=size.dtype, device=size.device)
    fade = torch.log(torch.as_tensor(fading, dtype=size.dtype, device=size.device)) * steps
    fade = fade.reshape(-1, *(1,) * (size.ndim - 1))
    return torch.exp(torch.cummax(torch.log(size) - fade, 0).values + fade)


class Adaptive(Tabulated):
    """Constant coefficients for each class of acceleration and joint.

    The class follows the recent magnitude of the acceleration: the causal envelope of |qdd|, which
    rises to a peak at once and decays with a time constant. It changes when the envelope leaves a
    band around a threshold, so it cannot chatter there. The hidden state of a joint consists of
    the envelope and the class.

    Args:
        initial: start values in SI, (joint, class, coefficient), or one set for all classes,
            (joint, coefficient) or (coefficient,).
        hysteresis: a class is entered at `threshold * (1 + hysteresis)` on the way up and left at
            `threshold / (1 + hysteresis)` on the way down.
        time_constant: of the envelope's decay [s]. If shorter than half a swing, the envelope would
            fall between two peaks.
        sample_time: at which the hidden state advances [s]; a fit sets it to the recording's.

    Raises:
        ValueError: if an option is not positive and finite (the hysteresis may be zero).

    References:
        TLRIP paper, adaptive friction estimation (AFEM), Table 6.
    """

    state_size: int = 2
    fit_strategy = "nfriction.papers.afem.fit_adaptive:fit_by_class"
    handles_range = True
    form = "adaptive"

    # The envelope is limited to this multiple of the upper threshold, so that one outlier does not
    # hold the class for long. `Final`, so that it is a constant for TorchScript.
    ceiling: Final[float] = 4.0

    thresholds: Tensor
    swing_rate: Tensor
    fading: Tensor
    band: Tensor

    def __init__(
        self,
        law: laws.Law,
        joints: int,
        initial: Tensor | Sequence | None = None,
        *,
        hysteresis: float = 0.2,
        time_constant: float = 2.0,
        sample_time: float = 1e-3,
    ) -> None:
        super().__init__(law, joints, initial, (len(CLASSES),))
        if not 0 <= hysteresis < math.inf:
            raise ValueError(f"`hysteresis` must be 0 or more and finite, got {hysteresis}.")
        self.hysteresis = float(hysteresis)
        self.time_constant = positive_number("time_constant", time_constant, "s")
        borders = self.raw.detach().new_tensor([20.0, 100.0])
        self.register_buffer("thresholds", borders.repeat(joints, 1))
        self.register_buffer("swing_rate", torch.zeros_like(self.thresholds[:, 0]))
        # Values that follow from the options are not stored.
        self.register_buffer("fading", borders.new_zeros(()), persistent=False)
        band = borders.new_tensor(1.0 + self.hysteresis)
        self.register_buffer("band", band, persistent=False)
        self.set_sample_time(sample_time)

    @torch.no_grad()
    def set_sample_time(self, sample_time: float) -> None:
        """Set the sample time [s], on which the decay of the envelope depends.

        Raises:
            ValueError: if it is not positive and finite.
        """
        self.sample_time = positive_number("sample_time", sample_time, "s")
        self.fading.fill_(math.exp(-self.sample_time / self.time_constant))

    @torch.no_grad()
    def set_classes(
        self, thresholds: Tensor | Sequence, swing_rate: Tensor | Sequence | None = None
    ) -> None:
        """Set the boundaries between the classes of acceleration.

        Args:
            thresholds: between low and medium, medium and high [rad/s^2], (joint, 2) or (2,).
            swing_rate: ratio of acceleration to velocity amplitude of each joint [rad/s], (joint,).
                It gives the envelope of a motion that starts at full speed, where the
                acceleration is small. Unchanged if omitted (initially zero: not used).

        Raises:
            ValueError: if thresholds are not positive, finite and ascending, or rates negative.
        """
        like = self.thresholds
        given = torch.as_tensor(thresholds, dtype=like.dtype, device=like.device)
        if given.shape not in (like.shape, like.shape[1:]):
            raise ValueError(
                f"`thresholds` must be (joint, 2) = {tuple(like.shape)} or (2,), got "
                f"{tuple(given.shape)}."
            )
        given = given.expand(like.shape)
        ascending = (given[:, 0] > 0) & (given[:, 0] <= given[:, 1])
        if not (ascending & torch.isfinite(given).all(-1)).all():
            raise ValueError(
                f"`thresholds` must be positive, finite and ascending [rad/s^2], got "
                f"{given.tolist()}."
            )
        if swing_rate is not None:
            rate = torch.as_tensor(swing_rate, dtype=like.dtype, device=like.device)
            if not (torch.isfinite(rate) & (rate >= 0)).all():
                raise ValueError(f"`swing_rate` must be 0 or more, got {rate.tolist()}.")
            self.swing_rate.copy_(rate)
        self.thresholds.copy_(given)

    def initial_state(self, qd: Tensor, qdd: Tensor) -> Tensor:
        size = torch.sqrt(qdd * qdd + (self.swing_rate * qd) ** 2)
        envelope = self._envelope(size, torch.zeros_like(size))
        return torch.stack([envelope, self._count(envelope, self.thresholds)], -1)

    def advance(self, qd: Tensor, qdd: Tensor, state: Tensor) -> Tensor:
        envelope = self._envelope(qdd.abs(), self.fading * state.select(-1, 0))
        # Up at the upper edge of the band, down at its lower edge, otherwise unchanged.
        at_least = self._count(envelope, self.thresholds * self.band)
        at_most = self._count(envelope, self.thresholds / self.band)
        known = torch.minimum(torch.maximum(state.select(-1, 1), at_least), at_most)
        return torch.stack([envelope, known], -1)

    def _envelope(self, size: Tensor, faded: Tensor) -> Tensor:
        # A comparison with NaN is false, so one lost sample does not corrupt the hidden state.
        risen = torch.where(size > faded, size, faded)
        return torch.minimum(risen, self.ceiling * self.thresholds.select(-1, 1))

    def _count(self, envelope: Tensor, borders: Tensor) -> Tensor:
        """Number of borders that the envelope exceeds, which is the class."""
        first = (envelope > borders.select(-1, 0)).to(envelope.dtype)
        return first + (envelope > borders.select(-1, 1)).to(envelope.dtype)

    def coefficients_from(self, qd: Tensor, qdd: Tensor, state: Tensor) -> Tensor:
        known = state.select(-1, 1).unsqueeze(-1)
        table = self.table()
        low, medium, high = table.select(1, 0), table.select(1, 1), table.select(1, 2)
        return torch.where(known > 1.5, high, torch.where(known > 0.5, medium, low))

    def forward(self, qd: Tensor, qdd: Tensor) -> Tensor:
        return self.coefficients_from(qd, qdd, self.initial_state(qd, qdd))

    def parameter_names(self, joint_names: Sequence[str]) -> list[str]:
        return [
            f"{name} of {joint}, {known}"
            for joint in joint_names
            for known in CLASSES
            for name in self.coefficient_names
        ]

    def rest_coefficients(self) -> Tensor:
        return self.table().transpose(0, 1)

    @torch.no_grad()
    def coefficient_sets(self) -> dict[str, Tensor]:
        sets = self.rest_coefficients().detach()
        constant = bool((sets == sets[0]).all())
        return {"always": sets[0]} if constant else dict(zip(CLASSES, sets, strict=True))

    def states(self, qd: Tensor, qdd: Tensor, time: Tensor | None = None) -> Tensor:
        if time is not None and len(time) > 1:
            return at_sample_time(self, float(time.diff().median())).states(qd, qdd)
        # As in the base class, but without torch operations for every sample.
        first = torch.sqrt(qdd[:1] ** 2 + (self.swing_rate * qd[:1]) ** 2)
        size = torch.cat([first, qdd[1:].abs()]).nan_to_num(0.0)
        # As the envelope never exceeds its ceiling, its input need not either.
        size = torch.minimum(size, self.ceiling * self.thresholds[:, 1])
        envelope = peak_envelope(size, self.fading)
        at_least = self._count(envelope, self.thresholds * self.band).T.tolist()
        at_most = self._count(envelope, self.thresholds / self.band).T.tolist()
        start = self._count(envelope[0], self.thresholds).tolist()
        rows = []
        for known, lower, upper in zip(start, at_least, at_most, strict=True):
            row = [known]
            for least, most in zip(lower[1:], upper[1:], strict=True):
                known = min(max(known, least), most)
                row.append(known)
            rows.append(row)
        return torch.stack([envelope, torch.tensor(rows).T.to(envelope)], -1)

    def classes(self, qd: Tensor, qdd: Tensor) -> Tensor:
        """Class at every sample of a motion, as a controller would have known it then.

        Args:
            qd, qdd: the motion, (sample, joint).

        Returns:
            0 low, 1 medium, 2 high, int64 of shape (sample, joint).
        """
        return self.states(qd, qdd)[..., 1].to(torch.int64)

    def sensitivities(self, qd: Tensor, qdd: Tensor) -> Sensitivity:
        """Derivatives at motions (sample, joint), each sample treated as a first one."""
        _, cells, k = self.raw.shape
        known = self.initial_state(qd, qdd).select(-1, 1)
        options = torch.arange(cells, dtype=known.dtype, device=known.device)
        chosen = (known[..., None] == options).to(self.raw.dtype)  # (sample, joint, class)
        identity = torch.eye(k, dtype=self.raw.dtype, device=self.raw.device)
        by_cell = torch.einsum("sjc,kl->sjkcl", chosen, identity).flatten(3)
        return Sensitivity.of_constants(by_cell, qd)

    def options(self) -> dict[str, Any]:
        return {
            "hysteresis": self.hysteresis,
            "time_constant": self.time_constant,
            "sample_time": self.sample_time,
        }

    def extra_repr(self) -> str:
        sets = []
        for name, row in zip(CLASSES, self.values.mean(0), strict=True):
            mean = [f"{n}={v:.4g}" for n, v in zip(self.coefficient_names, row, strict=True)]
            sets.append(f"{name} {', '.join(mean)}")
        return f"joints={self.joints}, mean of {'; '.join(sets)}"


class AdaptiveModel(NamedModel):
    """A law with constant coefficients for each class of acceleration: low, medium, high.

    Args:
        joints, v_smooth: see `NamedModel`.
        initial: start values in SI, shape (joint, class, coefficient), (joint, coefficient) or
            (coefficient,).
        options: `hysteresis`, `time_constant` and `sample_time`, see `Adaptive`.
    """

    make_schedule = Adaptive


class ANCFM(AdaptiveModel):
    """Viscous friction, one constant for each class of acceleration (TLRIP paper)."""

    definition = laws.VISCOUS


class ACFM(AdaptiveModel):
    """Coulomb friction, F_c for each class of acceleration."""

    definition = laws.COULOMB


class ACVFM(AdaptiveModel):
    """Coulomb plus viscous friction, F_c and F_v for each class of acceleration."""

    definition = laws.COULOMB_VISCOUS


class ALFM(AdaptiveModel):
    """Viscous plus load-dependent Coulomb friction, B and C for each class (TLRIP paper)."""

    definition = laws.LINEAR


class ANLFM(AdaptiveModel):
    """Five constants f_o, f_c, f_v, f_a, f_b for each class of acceleration (TLRIP paper)."""

    definition = laws.NONLINEAR

"""One driven mass on a straight guide: positioning axes, carriages, cylinders."""

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from nfriction.plant.base import Plant, vector


class LinearAxis(Plant):
    """Equation of motion mass * qdd = tau + torque_offset - asymmetry |qd|, in m and N.

    Args:
        mass: moved mass, the drive's inertia included [kg].
        torque_offset: constant force added to tau [N].
        name, joint_names, position_quantum: see `Plant`.

    Attributes:
        mass: (1,) [kg].
        torque_offset: (1,) [N].
        asymmetry: difference in viscous resistance between the two directions, (1,) [N s/m]; zero
            unless `replace` sets it. With viscous friction B it is passive up to B.
    """

    kind = "axis"
    required = ("mass",)
    optional = ("torque_offset", "name", "joint_names", "position_quantum")

    mass: Tensor
    asymmetry: Tensor

    def __init__(
        self,
        mass: float,
        *,
        torque_offset: float = 0.0,
        name: str = "",
        joint_names: Sequence[str] | None = None,
        position_quantum: float | None = None,
    ) -> None:
        super().__init__(
            1, joint_names=joint_names, name=name, unit="m", position_quantum=position_quantum
        )
        self.links = 1
        self.register_buffer("mass", vector("mass", [mass], 1, positive=True))
        self.register_buffer("torque_offset", vector("torque_offset", [torque_offset], 1))
        self.register_buffer("asymmetry", torch.zeros(1, dtype=torch.float64))
        self._given = {"mass": float(mass), "torque_offset": float(torque_offset)}

    def mass_matrix(self, q: Tensor) -> Tensor:
        """The mass [kg], (*batch, 1, 1)."""
        self._check(q=q)
        return torch.broadcast_tensors(self.mass, q)[0].unsqueeze(-1)

    def bias(self, q: Tensor, qd: Tensor) -> Tensor:
        """Force that depends on the direction of motion [N], (*batch, 1)."""
        self._check(q=q, qd=qd)
        return self.asymmetry * qd.abs() + torch.zeros_like(q)

    def gravity(self, q: Tensor) -> Tensor:
        """Zero force [N], (*batch, 1)."""
        self._check(q=q)
        return torch.zeros_like(q)

    def forward_dynamics(self, q: Tensor, qd: Tensor, tau: Tensor) -> Tensor:
        """Acceleration [m/s^2], (*batch, 1), under a force with friction subtracted [N]."""
        self._check(q=q, qd=qd, tau=tau)
        qdd = (tau + self.torque_offset - self.asymmetry * qd.abs()) / self.mass
        return qdd.expand(np.broadcast_shapes(qdd.shape, q.shape, qd.shape))

    def inverse_dynamics(self, q: Tensor, qd: Tensor, qdd: Tensor) -> Tensor:
        """Force tau (friction subtracted) that gives the acceleration `qdd` [N], (*batch, 1)."""
        self._check(q=q, qd=qd, qdd=qdd)
        return self.mass * qdd + self.asymmetry * qd.abs() - self.torque_offset

    def energy(self, q: Tensor, qd: Tensor) -> tuple[Tensor, Tensor]:
        """Kinetic and (zero) potential energy [J], each (*batch)."""
        self._check(q=q, qd=qd)
        kinetic = (self.mass * qd * qd / 2).squeeze(-1)
        return kinetic, torch.zeros_like(kinetic)

    def load(self, q: Tensor, qd: Tensor) -> Tensor:
        """Normal load over the load at rest [-]: 1, the guide carries the weight at all times."""
        self._check(q=q, qd=qd)
        return torch.ones_like(q)

    @torch.no_grad()
    def decay_rate(self, damping: Tensor) -> Tensor:
        """Decay of the velocity under a friction slope [N s/m] of shape (*batch, 1), [1/s]."""
        return (damping.clamp(min=0.0).to(self.mass) / self.mass).amax(-1)

    def extra_repr(self) -> str:
        """Name, mass and offset."""
        offset = self.torque_offset.tolist()
        return f"{self.name or 'unnamed'}, mass={self.mass.tolist()} kg, offset={offset} N"

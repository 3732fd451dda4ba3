"""Small mechanisms and friction models in torch, and a plain torch rollout to compare with."""

import torch
from torch import Tensor, nn

F64 = torch.float64


class Pendulum(nn.Module):
    """Links in a plane in scalar style: absolute angles inside, relative outside."""

    def __init__(self, joints: int = 3) -> None:
        super().__init__()
        self.joints = joints
        k = torch.arange(joints, dtype=F64)
        self.register_buffer("moment", 0.4 - 0.12 * k)
        self.register_buffer("inertia", torch.diag(0.13 - 0.03 * k) + 0.02)
        self.register_buffer("gravity", torch.tensor(9.81, dtype=F64))

    def load(self, q: Tensor, qd: Tensor) -> Tensor:
        angle, rate = torch.cumsum(q, -1), torch.cumsum(qd, -1)
        return (0.01 * rate * rate - torch.cos(angle)).abs()

    def forward_dynamics(self, q: Tensor, qd: Tensor, tau: Tensor) -> Tensor:
        n = self.joints
        angle = torch.cumsum(q, -1).unbind(-1)
        rate = torch.cumsum(qd, -1).unbind(-1)
        force = tau.unbind(-1)
        b = self.moment.unbind(-1)
        coupling = [row.unbind(-1) for row in self.inertia.unbind(0)]
        mass = [list(row) for row in coupling]
        rhs = []
        for i in range(n):
            value = force[i] - force[i + 1] if i + 1 < n else force[i]
            rhs.append(value + self.gravity * b[i] * torch.sin(angle[i]))
        for i in range(n):
            for j in range(i + 1, n):
                between = angle[i] - angle[j]
                mass[i][j] = mass[j][i] = coupling[i][j] * torch.cos(between)
                turn = coupling[i][j] * torch.sin(between)
                rhs[i] = rhs[i] - turn * (rate[j] * rate[j])
                rhs[j] = rhs[j] + turn * (rate[i] * rate[i])
        for i in range(n):  # elimination; the mass matrix is positive definite
            for r in range(i + 1, n):
                factor = mass[i][r] / mass[i][i]
                for c in range(r, n):  # symmetric: the upper triangle is enough
                    mass[r][c] = mass[r][c] - factor * mass[i][c]
                rhs[r] = rhs[r] - factor * rhs[i]
        x = [torch.zeros_like(force[0])] * n
        for i in reversed(range(n)):
            rest = rhs[i]
            for c in range(i + 1, n):
                rest = rest - mass[i][c] * x[c]
            x[i] = rest / mass[i][i]
        absolute = torch.stack(x, -1)
        return torch.cat([absolute[..., :1], absolute[..., 1:] - absolute[..., :-1]], -1)


class Coulomb(nn.Module):
    """Viscous plus Coulomb friction with constant coefficients in log space."""

    def __init__(self, joints: int = 3) -> None:
        super().__init__()
        values = torch.tensor([5e-3, 8e-3], dtype=F64).expand(joints, 2)
        self.log = nn.Parameter(values.log().clone())

    def coefficients(self, qd: Tensor, qdd: Tensor) -> Tensor:
        return self.log.exp()

    def torque(self, qd: Tensor, load: Tensor, c: Tensor) -> Tensor:
        viscous, coulomb = c.unbind(-1)
        return viscous * qd + coulomb * load * torch.tanh(qd / 0.05)


class NeuroFuzzy(Coulomb):
    """Rules over speed and acceleration, refined by a radial-basis head; one set per joint."""

    def __init__(self, joints: int = 3, terms: int = 5, units: int = 10) -> None:
        super().__init__(joints)
        g = torch.Generator().manual_seed(7)

        def random(*shape: int, scale: float) -> nn.Parameter:
            return nn.Parameter(scale * torch.randn(*shape, generator=g, dtype=F64))

        centres = torch.linspace(-1, 1, terms, dtype=F64).expand(joints, 2, terms)
        self.centre = nn.Parameter(centres.clone())
        self.log_width = random(joints, 2, terms, scale=0.1)
        self.rule = random(joints, terms * terms, 2, 3, scale=0.2)
        self.unit_centre = random(joints, units, 4, scale=1.0)
        self.unit_log_width = random(joints, units, scale=0.1)
        self.unit_out = random(joints, units, 2, scale=0.2)
        self.register_buffer("scale", torch.tensor([0.5, 0.05], dtype=F64))

    def coefficients(self, qd: Tensor, qdd: Tensor) -> Tensor:
        x = torch.stack([qd.abs(), qdd], -1) * self.scale
        z = (x[..., None] - self.centre) * torch.exp(-self.log_width)
        log_membership = -0.5 * z * z
        log_rule = log_membership[..., 0, :, None] + log_membership[..., 1, None, :]
        strength = torch.softmax(log_rule.flatten(-2), -1)
        inputs = torch.cat([torch.ones_like(x[..., :1]), x], -1)
        answer = torch.einsum("...rki,...i->...rk", self.rule, inputs)
        fuzzy = torch.einsum("...r,...rk->...k", strength, answer)
        away = torch.cat([x, fuzzy], -1)[..., None, :] - self.unit_centre
        activity = torch.exp(-(away * away).sum(-1) * torch.exp(self.unit_log_width))
        out = fuzzy + torch.einsum("...u,...uk->...k", activity, self.unit_out)
        return 0.01 * torch.nn.functional.softplus(out)


def reference(plant, friction, q, qd, steps, h, tau=None, *, hold=True, drive=None):
    """Eager rollout of one candidate or a batch; returns q and qd, (steps + 1, *batch, joint)."""
    h = torch.as_tensor(h, dtype=F64).expand(steps)
    tau = torch.zeros(steps, q.shape[-1], dtype=F64) if tau is None else tau
    qs, qds = [q], [qd]
    with torch.no_grad():
        qdd_prev = plant.forward_dynamics(q, qd, tau[0])
        for k in range(steps):
            held = (qd, qdd_prev) if drive is None else (drive[0][k], drive[1][k])
            c = friction.coefficients(*held)

            def rate(q, qd, c=c, held=held, torque=tau[k]):
                now = c if hold else friction.coefficients(qd, held[1])
                tau_f = friction.torque(qd, plant.load(q, qd), now)
                return plant.forward_dynamics(q, qd, torque - tau_f)

            a1 = rate(q, qd)
            v2 = qd + h[k] / 2 * a1
            a2 = rate(q + h[k] / 2 * qd, v2)
            v3 = qd + h[k] / 2 * a2
            a3 = rate(q + h[k] / 2 * v2, v3)
            v4 = qd + h[k] * a3
            a4 = rate(q + h[k] * v3, v4)
            q = q + h[k] / 6 * (qd + 2 * v2 + 2 * v3 + v4)
            qd = qd + h[k] / 6 * (a1 + 2 * a2 + 2 * a3 + a4)
            qdd_prev = a1
            qs.append(q)
            qds.append(qd)
    return torch.stack(qs), torch.stack(qds)

"""Output error: friction and plant terms from the positions of simulated windows.

Each window starts from a state of its own (multiple shooting), because the motion of a light
mechanism forgets its start within seconds. Where one window begins as another ends, the two may
be made to agree. Parameters and window states are found together by Levenberg-Marquardt with
exact sensitivities.

References:
    H. G. Bock, in: Modelling of Chemical Reaction Systems, Springer (1981), 102-125.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from nfriction.fitting.anchors import Anchors
from nfriction.fitting.elimination import Layout, eliminated, score_covariance
from nfriction.fitting.normal_equations import Rows, add_jumps, normal_equations, scaled_rows
from nfriction.fitting.plant_parameters import adjusted_buffers
from nfriction.fitting.propagation import propagated
from nfriction.fitting.sensitivity import StepJacobian
from nfriction.fitting.verdict import Information, information, standard_deviations
from nfriction.fitting.windows import Windows
from nfriction.friction.neurofuzzy import NeuroFuzzy
from nfriction.plant import LinearAxis, PendulumChain
from nfriction.signals import Motion
from nfriction.simulation import Rollout, integrate
from nfriction.solve.least_squares import LeastSquaresResult, Quadratic, Step
from nfriction.solve.levenberg import LevenbergMarquardt

# Smoothed start states are off by far less; the prior only keeps a window from running away.
START_Q_SD, START_QD_SD = 0.01, 0.3
# Of a start at rest, about what an encoder rounds, and less than it sees. Left free, a velocity
# that nothing had would take over what friction did while the links broke loose.
REST_Q_SD, REST_QD_SD = 1e-4, 1e-3


@dataclass
class TrajectoryProblem:
    """Sum of squares of the position error over windows, and its quadratic model.

    The vector of unknowns is [friction parameters, plant parameters, q0 and qd0 of each window,
    zeros of each recording], where a zero is what its encoders fall short of the true angles.

    Args:
        jacobian: derivatives of a step, with the mechanism, the friction model whose schedule is
            varied in place, and the adjustable terms of the plant.
        windows: what was measured.
        noise_sd: standard deviation of a position residual [rad], scale of the priors.
        mixing: matrix (joint, joint) from joint coordinates to those in which the recording's
            positions were measured; errors are counted there.
        substeps: integration steps to a sample.
        plant_mean: where the prior of the plant's terms is centred; default the plant as given.
        stride: only every so many-th sample counts, for as many: errors of a model last far
            longer than a sample, and the sums over many parameters are what a step costs.
        zero_sd: what is expected of the zeros, (recording, joint) [rad or m]; without it none are
            sought.
        jump_sd: by how much position and velocity may jump from the end of a window to the start of
            the next [rad, rad/s; m, m/s]; without it by as much as they like.
        anchors: where a neuro-fuzzy schedule is held to its constant law.
        memory: of the coefficients at the start of each window, (window, joint, state_size), of a
            schedule that has one. It advances with every step of the integration.
    """

    jacobian: StepJacobian
    windows: Windows
    noise_sd: float
    mixing: Tensor
    substeps: int = 1
    plant_mean: Tensor | None = None
    stride: int = 1
    memory: Tensor | None = None
    zero_sd: Tensor | None = None
    jump_sd: tuple[float, float] | None = None
    anchors: Anchors | None = None

    def __post_init__(self) -> None:
        w = self.windows
        counted = torch.zeros_like(w.weight)
        counted[:, :: self.stride] = w.weight[:, :: self.stride] * self.stride**0.5
        self._scale = counted[..., None] / self.noise_sd
        self.plant, self.friction = self.jacobian.plant, self.jacobian.friction
        self.plant_terms = self.jacobian.parameters
        self.friction_count = self.friction.schedule.parameter_vector().numel()
        self.shared_count = self.friction_count + len(self.plant_terms)
        self.step = w.step.repeat_interleave(self.substeps, 1) / self.substeps
        self.tau = w.tau.repeat_interleave(self.substeps, 1)
        self._seams = w.seams() if self.jump_sd else []
        jump_sd = torch.tensor(self.jump_sd or (torch.inf, torch.inf), dtype=torch.float64)
        self._jump_sd = jump_sd.repeat_interleave(w.q0.shape[-1])
        recordings = 0 if self.zero_sd is None else len(self.zero_sd)
        self.zero_count = recordings * w.q0.shape[-1]
        # Which recording a window is of, (window, recording).
        self._of_recording = torch.zeros(len(w), recordings, dtype=torch.float64)
        if recordings:
            self._of_recording[torch.arange(len(w)), [place for place, *_ in w.spans]] = 1.0
        self._simulated: tuple[Tensor, Rollout] | None = None
        self._hessian = torch.zeros(0, 0, dtype=torch.float64)

    def start(self, plant_vector: Tensor | None = None, zeros: Tensor | None = None) -> Tensor:
        """Unknowns at the model's present parameters and the smoothed window states."""
        if plant_vector is None:
            plant_vector = torch.zeros(len(self.plant_terms), dtype=torch.float64)
        state = torch.cat([self.windows.q0, self.windows.qd0], -1).reshape(-1)
        if zeros is None:
            zeros = torch.zeros(self.zero_count, dtype=torch.float64)
        return torch.cat([self.friction.schedule.parameter_vector(), plant_vector, state, zeros])

    def bounds(self) -> tuple[Tensor, Tensor]:
        lower, upper = self.friction.schedule.bounds()
        own = 2 * self.windows.q0.numel() + self.zero_count
        free = torch.full((own,), torch.inf, dtype=torch.float64)
        terms = self.plant_terms
        low = torch.tensor([t.lower for t in terms], dtype=torch.float64)
        high = torch.tensor([t.upper for t in terms], dtype=torch.float64)
        return torch.cat([lower, low, -free]), torch.cat([upper, high, free])

    def split(self, x: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Friction parameters, plant parameters, window states (window, 2 joint)."""
        friction, plant, state, _ = x.split(
            [self.friction_count, len(self.plant_terms), 2 * self.windows.q0.numel(),
             self.zero_count]
        )  # fmt: skip
        return friction, plant, state.reshape(len(self.windows), -1)

    def zeros(self, x: Tensor) -> Tensor:
        """What is added to the measured angles of each window, (window, joint) [rad]."""
        return self._of_recording @ self.split_zeros(x).reshape(-1, self.windows.q0.shape[-1])

    def split_zeros(self, x: Tensor) -> Tensor:
        """Zeros of each recording, in one row."""
        return x[len(x) - self.zero_count :]

    def plant_at(self, vector: Tensor) -> PendulumChain | LinearAxis:
        """The plant with its adjustable terms at a parameter vector."""
        changed = adjusted_buffers(self.plant, self.plant_terms, vector)
        return self.plant.replace(**changed) if changed else self.plant

    def traced(self, x: Tensor, motions: Sequence[Motion]) -> tuple[Motion, ...]:
        """The motions with position and velocity from the windows simulated at `x`.

        Longer windows then start from states that a fit has found, not a smoother.
        """
        run, zeros = self._simulate(x), self.zeros(x)
        run = replace(run, q=run.q - zeros[:, None])
        states = [(m.q.copy(), m.qd.copy()) for m in motions]
        # A sample that two windows share is taken from the later one's fitted start.
        for w, (place, first, last) in enumerate(self.windows.spans):
            n = self.substeps * (last - first) + 1
            for kept, found in zip(states[place], (run.q, run.qd), strict=True):
                kept[first : last + 1] = found[w, : n : self.substeps].numpy()
        return tuple(replace(m, q=q, qd=qd) for m, (q, qd) in zip(motions, states, strict=True))

    def errors(self, x: Tensor) -> Tensor:
        """Position error at every sample of the windows [rad or m], (window, step + 1, joint)."""
        return self._deviation(x) * self.windows.weight[..., None]

    def residuals(self, x: Tensor) -> Tensor:
        """Error of the counted samples over the noise, (window, step + 1, joint)."""
        return self._deviation(x) * self._scale

    def _deviation(self, x: Tensor) -> Tensor:
        q = self._simulate(x).q[:, :: self.substeps] - self.zeros(x)[:, None]
        return (q - self.windows.q) @ self.mixing.T

    def cost(self, x: Tensor) -> Tensor:
        """Half the sum of squares of residuals, jumps, anchors and prior."""
        precision, mean = self.prior()
        rows = [self.residuals(x), self.jumps(x)]
        if self.anchors is not None:
            rows.append(self.anchors.residuals(self._network(x)))
        misfit = torch.stack([row.square().sum() for row in rows]).sum()
        return 0.5 * (misfit + (precision * (x - mean) ** 2).sum())

    def jumps(self, x: Tensor) -> Tensor:
        """From a window's end to the next one's start, over what is expected, (seam, 2 joint)."""
        run = self._simulate(x)
        before, after = ([pair[k] for pair in self._seams] for k in (0, 1))
        end = torch.cat([run.q[before, -1] - self.zeros(x)[before], run.qd[before, -1]], -1)
        return (end - self.split(x)[2][after]) / self._jump_sd

    def largest_jump(self, x: Tensor) -> float:
        """Over what is expected; 0 where windows have nothing to do with each other."""
        jumps = self.jumps(x).abs()
        return float(jumps.max()) if jumps.numel() else 0.0

    def _network(self, x: Tensor) -> NeuroFuzzy:
        schedule = self.friction.schedule
        assert isinstance(schedule, NeuroFuzzy)
        schedule.set_parameter_vector(self.split(x)[0])
        return schedule

    def quadratic(self, x: Tensor) -> Quadratic:
        """Gauss-Newton model of the cost at `x`."""
        r = self.residuals(x)
        precision, mean = self.prior()
        places = self._own_places()
        rows = self._rows(x, self._scale)
        gradient, hessian, ends = normal_equations(rows, r, places, len(x))
        if self._seams:
            add_jumps(gradient, hessian, self.jumps(x), ends, self._seams, places, self._jump_sd)
        if self.anchors is not None:
            slope, curvature = self.anchors.normal_equations(self._network(x))
            gradient[: len(slope)] += slope
            hessian[: len(slope), : len(slope)] += curvature
        hessian.diagonal().add_(precision)
        self._hessian = hessian
        # Neither seams nor zeros make states of windows depend on each other.
        alone = not self._seams and not self.zero_count
        blocks = (self.shared_count, 2 * self.windows.q0.shape[-1]) if alone else None
        return Quadratic(self.cost(x), gradient + precision * (x - mean), hessian, blocks)

    def spread(self) -> Tensor:
        """Standard deviation of every shared parameter by the last quadratic model."""
        precision, _ = self.prior()
        known = information(self._hessian, precision, self.shared_count)
        return standard_deviations(known)

    def _simulate(self, x: Tensor) -> Rollout:
        """Motion at `x`; the last one is kept, as a step's cost and model ask for the same."""
        if self._simulated is not None and torch.equal(self._simulated[0], x):
            return self._simulated[1]
        parameters, plant_vector, state = self.split(x)
        self.friction.schedule.set_parameter_vector(parameters)
        q0, qd0 = state.chunk(2, -1)
        motion = self._run(self.plant_at(plant_vector), q0 + self.zeros(x), qd0)
        self._simulated = (x.clone(), motion)
        return motion

    def _run(self, plant: PendulumChain | LinearAxis, q0: Tensor, qd0: Tensor) -> Rollout:
        """Motion of all windows from their first states, with the schedule as it is."""
        return integrate(plant, self.friction, q0, qd0, self.tau, self.step, memory=self.memory)

    @torch.no_grad()
    def _states(self, motion: Rollout) -> Tensor | None:
        """Memory at every step of a motion, (window, step + 1, joint, state_size)."""
        if self.memory is None:
            return None
        rows = [self.memory]
        for qd, qdd in zip(motion.qd.unbind(1)[1:], motion.qdd.unbind(1)[1:], strict=True):
            rows.append(self.friction.schedule.advance(qd, qdd, rows[-1]))
        return torch.stack(rows, 1)

    def prior(self) -> tuple[Tensor, Tensor]:
        """Prior precision and mean of every unknown."""
        n = self.friction_count
        w = self.windows
        mean = torch.zeros(self.shared_count, dtype=torch.float64)
        sd = torch.full_like(mean, torch.inf)
        mean[:n], sd[:n] = self.friction.schedule.prior()
        if self.plant_mean is not None:
            mean[n:] = self.plant_mean
        sd[n:] = torch.tensor([t.prior_sd for t in self.plant_terms], dtype=torch.float64)
        start = torch.cat([w.q0, w.qd0], -1)
        spread = torch.cat(
            [torch.full_like(w.q0, START_Q_SD), torch.full_like(w.qd0, START_QD_SD)], -1
        )
        resting = list(w.at_rest)
        spread[resting] = torch.cat(
            [torch.full_like(w.q0, REST_Q_SD), torch.full_like(w.qd0, REST_QD_SD)], -1
        )[resting]
        zero_sd = sd.new_zeros(0) if self.zero_sd is None else self.zero_sd.reshape(-1)
        sd = torch.cat([sd, spread.reshape(-1), zero_sd])
        zeros = torch.zeros_like(zero_sd)
        return sd.square().reciprocal(), torch.cat([mean, start.reshape(-1), zeros])

    def told(self, x: Tensor, sd: Tensor) -> Information:
        """What the data say of the shared parameters, where the errors have their own sizes.

        Args:
            x: unknowns.
            sd: of each error, enlarged for its correlation in time, (window, step + 1, joint).
        """
        places, state = self._own_places(), 2 * self.windows.q0.shape[-1]
        layout = Layout.of(places, state, len(x))
        precision, _ = self.prior()
        first = self.shared_count
        of_states = precision[first : len(x) - self.zero_count].reshape(-1, state)
        kept = torch.cat([precision[:first], self.split_zeros(precision)])
        joined = (self._seams, self._jump_sd) if self._seams else ((), None)
        known = eliminated(self._rows(x, self._scale), layout, of_states, *joined)
        rows = self._rows(x, self._scale * sd / self.noise_sd)
        spread = score_covariance(rows, layout, known, of_states)
        return information(known.data + torch.diag(kept), kept, first, spread)

    def _rows(self, x: Tensor, scale: Tensor) -> Iterator[Rows]:
        """Rows of the Jacobian, some samples at a time; errors count as `scale` says."""
        motion = self._simulate(x)
        pieces = propagated(
            self.jacobian, self.friction_count, motion, self.tau, self.step, self.split(x)[1],
            self.substeps, self.stride, self._states(motion),
        )  # fmt: skip
        return scaled_rows(pieces, scale, self.mixing, self._own_places())

    def _own_places(self) -> Tensor:
        """Where each window's state and the zeros of its recording stand, (window, ·)."""
        windows, joints = self.windows.q0.shape
        states = torch.arange(2 * windows * joints).reshape(windows, -1) + self.shared_count
        if not self.zero_count:
            return states
        first = self.shared_count + states.numel() + joints * self._of_recording.argmax(1)
        return torch.cat([states, first[:, None] + torch.arange(joints)], 1)


def solve_trajectory(
    problem: TrajectoryProblem,
    x0: Tensor,
    *,
    max_steps: int = 30,
    cost_tolerance: float = 1e-6,
    callback: Callable[[Tensor, Step], bool | None] | None = None,
) -> LeastSquaresResult:
    """Minimise a trajectory problem from `x0`, leaving the best parameters in its model."""
    lower, upper = problem.bounds()
    solver = LevenbergMarquardt(
        max_steps=max_steps,
        gradient_tolerance=1e-6,
        cost_tolerance=cost_tolerance,
        step_tolerance=1e-8,
    )
    result = solver.minimise(
        problem.quadratic, x0, cost=problem.cost, lower=lower, upper=upper, callback=callback
    )
    problem.friction.schedule.set_parameter_vector(problem.split(result.x)[0])
    return result

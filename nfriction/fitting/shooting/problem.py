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

from nfriction.fitting.data.windows import Windows
from nfriction.fitting.plant_parameters import adjusted_buffers
from nfriction.fitting.result.identifiability import Information, information, standard_deviations
from nfriction.fitting.shooting.marginalization import Layout, eliminated, score_covariance
from nfriction.fitting.shooting.normal_equations import (
    Rows,
    add_jumps,
    normal_equations,
    scaled_rows,
)
from nfriction.fitting.shooting.propagation import propagated
from nfriction.fitting.shooting.sensitivity import StepJacobian
from nfriction.fitting.shooting.variables import Unknowns
from nfriction.fitting.strategy.extrapolation_prior import Anchors
from nfriction.friction.neurofuzzy import NeuroFuzzy
from nfriction.optim.least_squares import LeastSquaresResult, Quadratic, Step
from nfriction.optim.levenberg_marquardt import LevenbergMarquardt
from nfriction.plant import Plant
from nfriction.signals import Motion
from nfriction.simulation.protocols import RolloutInputs
from nfriction.simulation.rollout import Rollout, integrate


@dataclass
class TrajectoryProblem:
    """Sum of squares of the position error over windows, and its quadratic model.

    It is over one vector of all unknowns, see `Unknowns`.

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
        self.unknowns = Unknowns(
            self.friction.schedule, self.jacobian.parameters, w, self.plant_mean, self.zero_sd
        )
        self.step = w.step.repeat_interleave(self.substeps, 1) / self.substeps
        self.tau = w.tau.repeat_interleave(self.substeps, 1)
        self._seams = w.seams() if self.jump_sd else []
        jump_sd = torch.tensor(self.jump_sd or (torch.inf, torch.inf), dtype=torch.float64)
        self._jump_sd = jump_sd.repeat_interleave(w.q0.shape[-1])
        self._simulated: tuple[Tensor, Rollout] | None = None
        self._hessian = torch.zeros(0, 0, dtype=torch.float64)

    def plant_at(self, vector: Tensor) -> Plant:
        """The plant with its adjustable terms at a parameter vector."""
        changed = adjusted_buffers(self.plant, self.jacobian.parameters, vector)
        return self.plant.replace(**changed) if changed else self.plant

    def traced(self, x: Tensor, motions: Sequence[Motion]) -> tuple[Motion, ...]:
        """The motions with position and velocity from the windows simulated at `x`.

        Longer windows then start from states that a fit has found, not a smoother.
        """
        run, zeros = self._simulate(x), self.unknowns.zeros(x)
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
        q = self._simulate(x).q[:, :: self.substeps] - self.unknowns.zeros(x)[:, None]
        return (q - self.windows.q) @ self.mixing.T

    def cost(self, x: Tensor) -> Tensor:
        """Half the sum of squares of residuals, jumps, anchors and prior."""
        precision, mean = self.unknowns.prior()
        rows = [self.residuals(x), self.jumps(x)]
        if self.anchors is not None:
            rows.append(self.anchors.residuals(self._network(x)))
        misfit = torch.stack([row.square().sum() for row in rows]).sum()
        return 0.5 * (misfit + (precision * (x - mean) ** 2).sum())

    def jumps(self, x: Tensor) -> Tensor:
        """From a window's end to the next one's start, over what is expected, (seam, 2 joint)."""
        run = self._simulate(x)
        before, after = ([pair[k] for pair in self._seams] for k in (0, 1))
        q = run.q[before, -1] - self.unknowns.zeros(x)[before]
        end = torch.cat([q, run.qd[before, -1]], -1)
        return (end - self.unknowns.split(x)[2][after]) / self._jump_sd

    def largest_jump(self, x: Tensor) -> float:
        """Over what is expected; 0 where windows have nothing to do with each other."""
        jumps = self.jumps(x).abs()
        return float(jumps.max()) if jumps.numel() else 0.0

    def _network(self, x: Tensor) -> NeuroFuzzy:
        schedule = self.friction.schedule
        assert isinstance(schedule, NeuroFuzzy)
        schedule.set_parameter_vector(self.unknowns.split(x)[0])
        return schedule

    def quadratic(self, x: Tensor) -> Quadratic:
        """Gauss-Newton model of the cost at `x`."""
        r = self.residuals(x)
        precision, mean = self.unknowns.prior()
        places = self.unknowns.places()
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
        alone = not self._seams and not self.unknowns.zero_count
        blocks = (self.unknowns.shared_count, self.unknowns.state_count) if alone else None
        return Quadratic(self.cost(x), gradient + precision * (x - mean), hessian, blocks)

    def spread(self) -> Tensor:
        """Standard deviation of every shared parameter by the last quadratic model."""
        precision, _ = self.unknowns.prior()
        known = information(self._hessian, precision, self.unknowns.shared_count)
        return standard_deviations(known)

    def _simulate(self, x: Tensor) -> Rollout:
        """Motion at `x`; the last one is kept, as a step's cost and model ask for the same."""
        if self._simulated is not None and torch.equal(self._simulated[0], x):
            return self._simulated[1]
        parameters, plant_vector, state = self.unknowns.split(x)
        self.friction.schedule.set_parameter_vector(parameters)
        q0, qd0 = state.chunk(2, -1)
        motion = self._run(self.plant_at(plant_vector), q0 + self.unknowns.zeros(x), qd0)
        self._simulated = (x.clone(), motion)
        return motion

    def _run(self, plant: Plant, q0: Tensor, qd0: Tensor) -> Rollout:
        """Motion of all windows from their first states, with the schedule as it is."""
        inputs = RolloutInputs(q0, qd0, self.tau, self.step, hidden_state=self.memory)
        return integrate(plant, self.friction, inputs)

    @torch.no_grad()
    def _states(self, motion: Rollout) -> Tensor | None:
        """Memory at every step of a motion, (window, step + 1, joint, state_size)."""
        if self.memory is None:
            return None
        rows = [self.memory]
        for qd, qdd in zip(motion.qd.unbind(1)[1:], motion.qdd.unbind(1)[1:], strict=True):
            rows.append(self.friction.schedule.advance(qd, qdd, rows[-1]))
        return torch.stack(rows, 1)

    def told(self, x: Tensor, sd: Tensor) -> Information:
        """What the data say of the shared parameters, where the errors have their own sizes.

        Args:
            x: unknowns.
            sd: of each error, enlarged for its correlation in time, (window, step + 1, joint).
        """
        places, state = self.unknowns.places(), self.unknowns.state_count
        layout = Layout.of(places, state, len(x))
        precision, _ = self.unknowns.prior()
        first = self.unknowns.shared_count
        of_states = precision[first : len(x) - self.unknowns.zero_count].reshape(-1, state)
        kept = torch.cat([precision[:first], self.unknowns.split_zeros(precision)])
        joined = (self._seams, self._jump_sd) if self._seams else ((), None)
        known = eliminated(self._rows(x, self._scale), layout, of_states, *joined)
        rows = self._rows(x, self._scale * sd / self.noise_sd)
        spread = score_covariance(rows, layout, known, of_states)
        return information(known.data + torch.diag(kept), kept, first, spread)

    def _rows(self, x: Tensor, scale: Tensor) -> Iterator[Rows]:
        """Rows of the Jacobian, some samples at a time; errors count as `scale` says."""
        motion = self._simulate(x)
        pieces = propagated(
            self.jacobian, self.unknowns.friction_count, motion, self.tau, self.step,
            self.unknowns.split(x)[1], self.substeps, self.stride, self._states(motion),
        )  # fmt: skip
        return scaled_rows(pieces, scale, self.mixing, self.unknowns.places())


def solve_trajectory(
    problem: TrajectoryProblem,
    x0: Tensor,
    *,
    max_steps: int = 30,
    cost_tolerance: float = 1e-6,
    callback: Callable[[Tensor, Step], bool | None] | None = None,
) -> LeastSquaresResult:
    """Minimise a trajectory problem from `x0`, leaving the best parameters in its model."""
    lower, upper = problem.unknowns.bounds()
    solver = LevenbergMarquardt(
        max_steps=max_steps,
        gradient_tolerance=1e-6,
        cost_tolerance=cost_tolerance,
        step_tolerance=1e-8,
    )
    result = solver.minimise(
        problem.quadratic, x0, cost=problem.cost, lower=lower, upper=upper, callback=callback
    )
    problem.friction.schedule.set_parameter_vector(problem.unknowns.split(result.x)[0])
    return result

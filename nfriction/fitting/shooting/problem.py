"""Output error by multiple shooting: a cost and its Gauss-Newton model.

A recording is cut into windows. Each is simulated from its own initial state, because within
seconds a light mechanism amplifies an error of that state beyond use; for a law with memory the
deflections are part of it. The decision variables x are the friction parameters, the plant terms,
each window's initial state and the encoders' offsets, and the cost is

    J(x) = 1/2 sum |C (q_sim(t; x) - q(t))|^2 / noise_sd^2      samples (or a robust loss)
         + 1/2 sum (x - mean)^2 / sd^2                          priors

and for networks a prior where nothing was recorded. C is the matrix from joint to recorded
coordinates. Plant and friction model stay unchanged. The next step is
`nfriction.optim.levenberg_marquardt`, which minimises J.

References:
    H. G. Bock, in: Modelling of Chemical Reaction Systems, Springer (1981), 102-125.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from torch import Tensor

from nfriction.fitting.adjusted_plant import adjusted_plant
from nfriction.fitting.data.windows import Windows
from nfriction.fitting.options import DEFAULTS, FitOptions
from nfriction.fitting.result.identifiability import observed_count
from nfriction.fitting.robust_loss import SQUARES, RobustLoss
from nfriction.fitting.shooting.normal_equations import Rows, normal_equations, scaled_rows
from nfriction.fitting.shooting.sensitivity import StepJacobian, Trajectory, propagate
from nfriction.fitting.shooting.variables import DecisionVariables, deflected, substepped
from nfriction.fitting.strategy.extrapolation_prior import ExtrapolationPrior
from nfriction.friction.models import FrictionModel
from nfriction.optim.least_squares import Quadratic
from nfriction.plant import Plant
from nfriction.signals import Motion
from nfriction.simulation.protocols import Rollout, RolloutInputs
from nfriction.simulation.rollout import integrate


@dataclass(frozen=True, eq=False)
class ShootingProblem:
    """Half the sum of squares of position errors and priors over windows.

    Args:
        jacobian: derivatives of a step; has the plant and its adjustable terms.
        friction: the friction model at the start, which a search leaves unchanged.
        noise_sd: standard deviation of a position error [rad; m], scale of the priors.
        measurement: matrix (joint, joint) from joint to recorded coordinates, where errors count.
        substeps: integration steps per sample.
        stride: decimation: one in `stride` samples counts, with that weight, because model errors
            last far longer than a sample and sums over many parameters dominate the time of a step.
        friction_prior, plant_prior, offset_sd: see `DecisionVariables`.
        extrapolation: prior of a neuro-fuzzy schedule where there are no data.
    """

    jacobian: StepJacobian
    friction: FrictionModel
    windows: Windows
    noise_sd: float
    measurement: Tensor
    substeps: int = 1
    stride: int = 1
    friction_prior: tuple[Tensor, Tensor] | None = None
    plant_prior: tuple[Tensor, Tensor] | None = None
    offset_sd: Tensor | None = None
    extrapolation: ExtrapolationPrior | None = None
    loss: RobustLoss = SQUARES
    options: FitOptions = DEFAULTS

    @cached_property
    def variables(self) -> DecisionVariables:
        """Order, bounds and priors of the decision variables."""
        return DecisionVariables(
            self.friction.schedule, self.jacobian.terms, self.windows, self.friction_prior,
            self.plant_prior, self.offset_sd, self.options,
        )  # fmt: skip

    def cost(self, x: Tensor) -> Tensor:
        """Half the sum of squares of errors and priors."""
        return self._cost(x, self.simulate(x))

    def linearise(self, x: Tensor, *, states: bool = False) -> Quadratic:
        """Cost, gradient and Gauss-Newton Hessian at `x` from one simulation.

        With `states`, without derivatives with respect to the shared variables.
        """
        held = self.variables.shared_count if states else 0
        run = self.simulate(x, with_hidden_states=True)
        errors = self.deviation(x, run)
        scale = self.scale * self.loss.weight(errors).sqrt()
        rows = self.rows(run, scale, states=states)
        gradient, hessian = normal_equations(
            rows, errors * scale, self.variables.indices(alone=states), len(x) - held
        )
        if self.extrapolation is not None and not states:
            slope, curvature = self.extrapolation.normal_equations(run.friction.schedule)
            gradient[: len(slope)] += slope
            hessian[: len(slope), : len(slope)] += curvature
        precision, mean = self.variables.prior()
        gradient += (precision * (x - mean))[held:]
        hessian.diagonal().add_(precision[held:])
        # Encoder offsets couple the states of different windows.
        alone = not self.variables.offset_count
        blocks = (self.variables.shared_count - held, self.variables.state_count) if alone else None
        return Quadratic(self._cost(x, run), gradient, hessian, blocks)

    def errors(self, x: Tensor) -> Tensor:
        """Position error at every sample [rad; m], (window, step + 1, joint)."""
        return self.deviation(x, self.simulate(x)) * self.windows.weight[..., None]

    def counted_errors(self, x: Tensor) -> Tensor:
        """Errors whose squares give the loss; equal to `errors` for least squares."""
        return self.loss.counted(self.errors(x))

    def rescaled(self, x: Tensor) -> "ShootingProblem":
        """The problem with the robust loss of `options`, its scale from the errors at `x`."""
        errors = self.errors(x)[self.windows.weight > 0]
        count = observed_count(self.windows.q @ self.measurement.T) or 0.0
        least = max(count / 12**0.5, self.options.min_noise)
        return replace(self, loss=RobustLoss.of_errors(self.options.loss, errors, least))

    def plant_at(self, vector: Tensor) -> Plant:
        """The plant with its adjustable terms at a parameter vector."""
        return adjusted_plant(self.jacobian.plant, self.jacobian.terms, vector)

    def simulated_motions(self, x: Tensor, motions: Sequence[Motion]) -> tuple[Motion, ...]:
        """The motions with position and velocity of the windows simulated at `x`.

        Longer windows then start from fitted states instead of a smoother's.
        """
        run, offsets = self.simulate(x).motion, self.variables.window_offsets(x)
        run = replace(run, q=run.q - offsets[:, None])
        states = [(m.q.copy(), m.qd.copy()) for m in motions]
        # A sample shared by two windows is taken from the fitted start of the later one.
        for w, (place, first, last) in enumerate(self.windows.spans):
            n = self.substeps * (last - first) + 1
            for kept, found in zip(states[place], (run.q, run.qd), strict=True):
                kept[first : last + 1] = found[w, : n : self.substeps].numpy()
        return tuple(replace(m, q=q, qd=qd) for m, (q, qd) in zip(motions, states, strict=True))

    @cached_property
    def scale(self) -> Tensor:
        """Weight of each sample over the noise, (window, step + 1, 1)."""
        counted = torch.zeros_like(self.windows.weight)
        counted[:, :: self.stride] = self.windows.weight[:, :: self.stride] * self.stride**0.5
        return counted[..., None] / self.noise_sd

    @cached_property
    def _moving(self) -> FrictionModel:
        """A copy of the friction model, which every simulation sets to its parameters."""
        return substepped(self.friction, self.substeps)

    def simulate(self, x: Tensor, *, with_hidden_states: bool = False) -> Trajectory:
        """The windows' motion at `x`, valid until the next call; derivatives need hidden states."""
        friction, plant, states, _ = self.variables.split(x)
        model, joints = self._moving, self.windows.q0.shape[-1]
        model.schedule.set_parameter_vector(friction)
        q0, qd0, shares = states.tensor_split([joints, 2 * joints], -1)
        law_state, law_slope = deflected(model, shares)
        held, linearised = (t.repeat_interleave(self.substeps, 1) for t in self._torques(plant))
        step = self.windows.step.repeat_interleave(self.substeps, 1) / self.substeps
        offsets = self.variables.window_offsets(x)
        inputs = RolloutInputs(
            q0 + offsets, qd0, held, step, law_state=law_state,
            hidden_state=self.windows.hidden_state,
        )  # fmt: skip
        motion = self._integrate(self.plant_at(plant), model, inputs)
        memory = self.windows.states_along(model, motion) if with_hidden_states else None
        return Trajectory(model, plant, motion, linearised, step, memory, law_slope)

    def _torques(self, plant: Tensor) -> tuple[Tensor, Tensor]:
        """Torque over each step, and in the form that `StepJacobian` takes."""
        k = self.jacobian.delay_index
        if k is None:
            return self.windows.tau, self.windows.tau
        tau, slope = self.windows.torque_at(float(plant[k]))
        return tau, torch.cat([tau - plant[k] * slope, slope], -1)

    def _integrate(self, plant: Plant, model: FrictionModel, inputs: RolloutInputs) -> Rollout:
        return integrate(plant, model, inputs)

    def deviation(self, x: Tensor, run: Trajectory) -> Tensor:
        """Simulated minus measured position in recorded coordinates, (window, step + 1, joint)."""
        q = run.motion.q[:, :: self.substeps] - self.variables.window_offsets(x)[:, None]
        return (q - self.windows.q) @ self.measurement.T

    def _cost(self, x: Tensor, run: Trajectory) -> Tensor:
        misfit = (self.loss.counted(self.deviation(x, run)) * self.scale).square().sum()
        if self.extrapolation is not None:
            misfit = misfit + self.extrapolation.residuals(run.friction.schedule).square().sum()
        precision, mean = self.variables.prior()
        return 0.5 * (misfit + (precision * (x - mean) ** 2).sum())

    def rows(self, run: Trajectory, scale: Tensor, *, states: bool = False) -> Iterator[Rows]:
        """Rows of the Jacobian, some samples at a time; `states`: see `linearise`."""
        pieces = propagate(self.jacobian, run, self.substeps, self.stride, states=states)
        return scaled_rows(pieces, scale, self.measurement, self.variables.indices(alone=states))

"""Fits by class: the class of every sample is given during the search, then the model's own.

During a search the classes are those of the measured motion, so the cost is smooth in the
coefficients. What the search finds is then taken as far as it also improves simulations in which
the class follows the simulated motion.
"""

import logging
from collections.abc import Mapping
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from nfriction.fitting.data.inputs import apply_encoder_offsets, integration_substeps
from nfriction.fitting.data.windows import Windows, cut_windows
from nfriction.fitting.equation_error import coefficient_scale
from nfriction.fitting.fit import FitTask
from nfriction.fitting.result.fit_result import FitResult
from nfriction.fitting.shooting.problem import ShootingProblem
from nfriction.friction.models import FrictionModel
from nfriction.papers.afem.adaptive import CLASSES, Adaptive
from nfriction.papers.afem.classes import AccelerationClasses, ClassOptions, find_classes
from nfriction.plant import Plant
from nfriction.signals import Motion
from nfriction.simulation.compiled import System, integrate_compiled
from nfriction.simulation.protocols import RolloutInputs
from nfriction.simulation.rollout import Rollout, integrate

logger = logging.getLogger(__name__)
# Shares of the classes' deviations from the constant law to try, largest first.
SHARES = (1.0, 0.5, 0.25)


class GivenClasses(Adaptive):
    """A table by class whose class takes the place of the acceleration.

    Args:
        model: the model whose law and joints are taken.
        reference: constant coefficients toward which every class is pulled, (joint, coefficient).
        sd: standard deviation around them, (joint, coefficient).
    """

    state_size = 0

    def __init__(self, model: FrictionModel, reference: Tensor, sd: Tensor) -> None:
        super().__init__(model.law, model.joints, reference)
        shape = self.raw.shape
        self._mean = reference[:, None].expand(shape).reshape(-1)
        self._sd = sd[:, None].expand(shape).reshape(-1)

    def initial_state(self, qd: Tensor, qdd: Tensor) -> Tensor:
        return torch.stack([qdd, qdd], -1)

    def prior(self) -> tuple[Tensor, Tensor]:
        return self._mean, self._sd


@dataclass(frozen=True, eq=False)
class GivenClassesProblem(ShootingProblem):
    """A shooting problem whose coefficients follow given classes.

    Args:
        classes: class of every sample, (window, step, joint).
    """

    classes: Tensor | None = None

    def _integrate(
        self, plant: Plant, model: FrictionModel, q0: Tensor, qd0: Tensor, tau: Tensor, step: Tensor
    ) -> Rollout:
        assert self.classes is not None
        classes = self.classes.repeat_interleave(self.substeps, 1)
        # The schedule reads the class in place of the acceleration; velocity does not enter.
        measured = torch.zeros_like(classes), classes
        inputs = RolloutInputs(q0, qd0, tau, step, measured=measured)
        motion = integrate(plant, model, inputs)
        # The derivatives of a step must be taken at the input that drove it.
        return replace(motion, qdd=torch.cat([classes, classes[:, -1:]], 1))


@dataclass(frozen=True, eq=False)
class PositionError:
    """Position error of simulated windows as a function of a schedule's parameter vector.

    Args:
        plant: the mechanism.
        friction: the friction model; its schedule is overwritten and restored.
        windows: what was measured, with the states from which simulations start.
        measurement: matrix (joint, joint) from joint coordinates to those of the recording.
        substeps: integration steps per sample.
        drive: class of every sample, (window, step, joint), that chooses the coefficients; None
            lets the simulated motion choose them.
        memory: of the coefficients at the start of each window, (window, joint, state_size).
        threads: candidates are divided among this many.
    """

    plant: Plant
    friction: FrictionModel
    windows: Windows
    measurement: Tensor
    substeps: int = 1
    drive: Tensor | None = None
    memory: Tensor | None = None
    threads: int = 1

    @property
    def values(self) -> int:
        """Number of position errors."""
        return int(self.windows.weight.sum()) * self.windows.q0.shape[1]

    def mean_square(self, vectors: Tensor) -> Tensor:
        """Mean square of the error [rad^2] of candidates (m, parameter), shape (m,)."""
        total = torch.zeros(len(vectors), dtype=torch.float64)
        own = self._parameters(vectors)
        for w in range(len(self.windows)):
            total += self._residuals(w, vectors, own).square().sum((1, 2))
        return total / self.values

    def residuals(self, vector: Tensor) -> Tensor:
        """Error of one candidate [rad], (window, step + 1, joint)."""
        own = self._parameters(vector[None])
        return torch.cat([self._residuals(w, vector[None], own) for w in range(len(self.windows))])

    def _residuals(self, w: int, vectors: Tensor, own: Mapping[str, Tensor]) -> Tensor:
        of = self.windows
        error = (self._positions(w, vectors, own) - of.q[w]) @ self.measurement.T
        return error * of.weight[w, :, None]

    def _positions(self, w: int, vectors: Tensor, own: Mapping[str, Tensor]) -> Tensor:
        """Positions of every candidate in one window, (m, step + 1, joint)."""
        of, m = self.windows, len(vectors)
        measured = None if self.drive is None else (torch.zeros_like(self.drive[w]), self.drive[w])
        memory = None if self.memory is None else self.memory[w]
        q0, qd0 = of.q0[w].expand(m, -1), of.qd0[w].expand(m, -1)
        inputs = RolloutInputs(q0, qd0, of.tau[w], of.step[w], self.substeps, measured, memory)
        # All candidates of a window in one call; without a compiler one after the other.
        system = System.of(self.plant, self.friction)
        states = integrate_compiled(system, inputs, "auto", self.threads, own)
        if states is not None:
            return states[0]
        schedule = self.friction.schedule
        before, rows = schedule.parameter_vector(), []
        for vector in vectors:
            schedule.set_parameter_vector(vector)
            inputs = RolloutInputs(
                of.q0[w], of.qd0[w], of.tau[w], of.step[w], self.substeps, measured, memory
            )
            rows.append(integrate(self.plant, self.friction, inputs).q)
        schedule.set_parameter_vector(before)
        return torch.stack(rows)

    def _parameters(self, vectors: Tensor) -> dict[str, Tensor]:
        """The friction model's parameters at each vector, by name, (m, *shape)."""
        schedule = self.friction.schedule
        before, rows = schedule.parameter_vector(), []
        for vector in vectors:
            schedule.set_parameter_vector(vector)
            rows.append({n: p.detach().clone() for n, p in self.friction.named_parameters()})
        schedule.set_parameter_vector(before)
        return {name: torch.stack([row[name] for row in rows]) for name in rows[0]}


@dataclass(frozen=True, eq=False)
class ClassFit:
    """An adaptive model to be fitted, with the classes of its recordings.

    Attributes:
        task: the fit, without the encoders' offsets.
        motions: of the recordings, as recorded.
        constant: fit of the constant law, from which every class starts.
        classes: of the recordings.
        schedule: of the model to be fitted, set to these classes.
        table: the coefficients that a fit with given classes varies.
        given: the model of that table.
        windows: of the recordings.
    """

    task: FitTask
    motions: tuple[Motion, ...]
    constant: FitResult
    classes: AccelerationClasses
    schedule: Adaptive
    table: GivenClasses
    given: FrictionModel
    windows: Windows

    @classmethod
    def of(
        cls,
        task: FitTask,
        schedule: Adaptive,
        constant: FitResult,
        length: float,
        options: ClassOptions,
    ) -> "ClassFit":
        """Find the classes, set the schedule of the task's model to them, and cut windows [s]."""
        model = task.model
        joint, motions = apply_encoder_offsets(
            constant.encoder_offsets, task.plant, task.recordings, task.motions
        )
        classes = find_classes(schedule, joint, motions, task.plant.joint_names, options)
        for note in classes.notes:
            logger.info("%s", note)
        values = constant.model.schedule.coefficient_sets()["always"]
        natural = coefficient_scale(model, constant.plant, joint, motions)
        sd = options.prior_sd * torch.maximum(values.abs(), natural)
        # Where neither gives a size, the coefficient is free.
        table = GivenClasses(model, values, torch.where(sd > 0, sd, torch.inf))
        given = FrictionModel(model.law, table, model.v_smooth).requires_grad_(False)
        # Windows are compared in joint coordinates, without what the encoders are off by.
        corrected = replace(task, recordings=joint, motions=motions)
        windows = cut_windows(joint, motions, length)
        return cls(corrected, task.motions, constant, classes, schedule, table, given, windows)

    @property
    def substeps(self) -> int:
        """Integration steps per sample."""
        longest = max(r.longest_step for r in self.task.recordings)
        return integration_substeps(self.task.plant, self.given, longest)

    def drive(self) -> Tensor:
        """Class that drives every step, a class with too few data as its neighbour."""
        stands_for = self.classes.stands_for
        joints = torch.arange(len(stands_for))
        driving = torch.zeros_like(self.windows.tau)
        for w, (place, first, last) in enumerate(self.windows.spans):
            known = stands_for[joints, self.classes.labels[place][first:last]]
            driving[w, : last - first] = known.to(driving.dtype)
        return driving

    def backtracked(self, found: FitResult, windows: Windows, baseline: float) -> FitResult:
        """The classes' coefficients as far as they also improve simulations of the model itself.

        Args:
            found: the fit of the given classes.
            windows: with the initial states that it found.
            baseline: root mean square error of the constant law [rad].
        """
        task, constant, model, schedule = self.task, self.constant, self.task.model, self.schedule
        flat = constant.model.schedule.coefficient_sets()["always"][:, None]
        # A class without data was never varied: its own entry is still the start.
        table = torch.take_along_dim(self.table.values, self.classes.stands_for[..., None], 1)
        model.requires_grad_(False)
        along = [
            schedule.states(torch.as_tensor(m.qd), torch.as_tensor(m.qdd)) for m in task.motions
        ]
        memory = torch.stack([along[place][first] for place, first, _ in windows.spans])
        error = PositionError(
            found.plant, model, windows, task.measurement, self.substeps, memory=memory
        )
        # As recorded: with the motions and the encoder offsets of the constant fit.
        found = replace(
            found, model=model, motions=self.motions, encoder_offsets=constant.encoder_offsets,
            skipped_horizons=constant.skipped_horizons,
        )  # fmt: skip
        # Given classes hide that a wrong class feeds back on the motion that chooses it.
        for share in SHARES:
            schedule.set_coefficients(flat + share * (table - flat))
            residuals = error.residuals(schedule.parameter_vector())
            rms = float((residuals.square().sum() / error.values).sqrt())
            if rms <= baseline:
                part = "" if share == 1.0 else f" {share:g} of the deviations by class is taken."
                status = found.status + part + "".join(f" {note}." for note in self.classes.notes)
                taken = replace(found, residual=rms, residuals=residuals, status=status)
                return taken.with_warnings(constant.data_warnings)
        # All classes equal: the adaptive model then is the constant one.
        schedule.set_coefficients(flat.expand(-1, len(CLASSES), -1))
        status = f"{constant.status} The classes simulate no better: the constant law is kept."
        return replace(constant, model=model, motions=self.motions, status=status)

"""A scikit-learn estimator: recordings in, a friction model out."""

import copy
import inspect
import math
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch
from numpy.typing import ArrayLike

from nfriction.evaluation.compare import score_fit
from nfriction.evaluation.lead_in import ZERO_IN, longest_window
from nfriction.fitting.data.inputs import release, require_drive
from nfriction.fitting.fit import fit
from nfriction.fitting.result.fit_result import FitResult
from nfriction.friction.memory import deflections, load_of
from nfriction.friction.models import FrictionModel
from nfriction.plant import Plant, rigs
from nfriction.recording import Array, Recording, RecordingLike
from nfriction.signals import kalman_smoother

try:
    from sklearn.base import BaseEstimator
except ImportError:

    class BaseEstimator:  # type: ignore[no-redef]
        """Names the missing package as soon as an estimator is created."""

        def __new__(cls, *_: object, **__: object) -> "BaseEstimator":
            raise ImportError(
                f"{cls.__name__} needs scikit-learn: `pip install nfriction[sklearn]`; "
                "`nfriction.fit` and `nfriction.select` do not."
            )


# Settings of `fit` that do not belong to a single call.
SETTINGS = {
    name: parameter
    for name, parameter in inspect.signature(fit).parameters.items()
    if parameter.kind is parameter.KEYWORD_ONLY and name not in ("start", "motions", "callback")
}


class FrictionEstimator(BaseEstimator):
    """Estimate the friction of a mechanism from recordings of its motion.

    A sample is a whole recording, so `X` is a list and cross-validation leaves out recordings.

    Args:
        plant: the mechanism, its name, or the path of a rig file.
        model: name of a friction model such as `"stribeck"`, or one to start from, which stays
            unchanged.
        horizon: length of the simulations in `score` [s].
        fit_settings: keyword arguments of `nfriction.fit`, such as `drag=False`; each is also a
            parameter of the estimator, for example in a grid search.

    Attributes:
        fit_: the `FitResult`; read `fit_.status` and `fit_.warnings`.
        model_: the fitted friction model, a torch module; for `nfriction.save` and exports.
        plant_: the plant with its adjusted terms.
        coef_: coefficients of a constant law, (joint, coefficient), SI.
        coef_names_: their names.
        n_joints_: number of joints.

    Examples:
        >>> search = GridSearchCV(FrictionEstimator(rig), {"model": ["NCFM", "LFM"]}, cv=3)
        >>> search.fit(recordings).best_params_
        {'model': 'LFM'}
    """

    def __init__(
        self,
        plant: Plant | str | Path | None = None,
        model: str | FrictionModel = "LFM",
        *,
        horizon: float = 5.0,
        **fit_settings: Any,
    ) -> None:
        # Kept as given and checked by `fit`, as scikit-learn requires.
        self.plant = plant
        self.model = model
        self.horizon = horizon
        unknown = set(fit_settings) - set(SETTINGS)
        if unknown:
            there, asked = ", ".join(SETTINGS), ", ".join(sorted(unknown))
            raise TypeError(f"`fit` has no setting {asked}; there are {there}.")
        for name, parameter in SETTINGS.items():
            setattr(self, name, fit_settings.get(name, parameter.default))

    fit_: FitResult

    def fit(
        self, X: RecordingLike | Sequence[RecordingLike], y: object = None
    ) -> "FrictionEstimator":
        """Estimate from recordings.

        Args:
            X: recordings, paths of files, or tables with columns time, q1, ... (see
                `Recording.of`).
            y: ignored; positions to be predicted are in the recordings.

        Returns:
            This estimator.

        Raises:
            ValueError: if there is no plant, no such model, or the recordings do not fit.
        """
        if self.plant is None:
            raise ValueError("`plant` is missing; give the mechanism, as rigs.read('rig.json').")
        plant = rigs.of(self.plant)
        # The given model is a parameter of the estimator and must stay unchanged.
        model = self.model if isinstance(self.model, str) else copy.deepcopy(self.model)
        settings = {name: getattr(self, name) for name in SETTINGS}
        self.fit_ = fit(model, plant, _recordings(X, plant), **settings)
        return self

    @property
    def model_(self) -> FrictionModel:
        return self._fitted.model

    @property
    def plant_(self) -> Plant:
        return self._fitted.plant

    @property
    def n_joints_(self) -> int:
        return self._fitted.plant.joints

    @property
    def coef_names_(self) -> list[str]:
        return list(self._fitted.model.schedule.coefficient_names)

    @property
    def coef_(self) -> Array:
        schedule = self._fitted.model.schedule
        if schedule.follows_motion:
            raise AttributeError(
                f"the coefficients of {type(self.model_).__name__} follow the motion; use "
                "`model_.coefficients(qd, qdd)`."
            )
        return schedule.coefficient_sets()["always"].numpy().copy()

    def predict(
        self,
        X: RecordingLike | ArrayLike,
        qdd: ArrayLike | None = None,
        load: ArrayLike | None = None,
    ) -> Array:
        """Friction torque along a motion.

        Args:
            X: velocity [rad/s], (sample, joint); or a recording, whose smoothed motion then
                gives all arguments.
            qdd: acceleration [rad/s^2], shape like the velocity; none by default.
            load: normal load over its value at rest [-], shape like the velocity; 1 by default.

        Returns:
            The torque of `M(q) qdd + bias(q, qd) + tau_f = tau` [N m; N of a sliding axis],
            (sample, joint). Coefficients with a state follow the samples in their order, and so
            does a law with memory, which starts undeflected.

        Raises:
            ValueError: if it is not fitted, shapes do not fit, or a law with memory gets no
                recording, whose time it needs.
        """
        model, plant = self._fitted.model, self._fitted.plant
        time: torch.Tensor | None = None
        with torch.no_grad():
            if isinstance(X, Recording | pd.DataFrame | str | os.PathLike):
                (recording,) = _recordings(X, plant)
                joint = recording.joint_coordinates(plant)
                require_drive(model.law, [joint])
                motion = kalman_smoother(joint.time, joint.q)
                q, velocity, acceleration = map(torch.tensor, (motion.q, motion.qd, motion.qdd))
                tau = torch.zeros_like(q) if joint.tau is None else torch.tensor(joint.tau)
                loads = load_of(model.law, plant, q, velocity, tau)
                time = torch.tensor(joint.time)
                if model.law.memory:
                    states, held = deflections(model, time, velocity, acceleration, loads)
                    return model.law.memory.torque(states, velocity, loads, held).numpy()
            else:
                velocity = self._rows(X, "X")
                acceleration, loads = (
                    torch.full_like(velocity, default)
                    if given is None
                    else self._rows(given, name, len(velocity))
                    for given, name, default in ((qdd, "qdd", 0.0), (load, "load", 1.0))
                )
            if model.state_size:
                states = model.schedule.states(velocity, acceleration, time)
                held = model.coefficients_from(velocity, acceleration, states)
                return model.torque(velocity, loads, held).numpy()
            return model(velocity, acceleration, loads).numpy()

    def simulate(self, recording: RecordingLike) -> pd.DataFrame:
        """The motion that the model predicts from a recording's lead-in and torques.

        Returns:
            Table with columns time [s], q1, ... in the recording's convention and unit, one row
            per sample, NaN after the simulation diverged; `Recording.to_pandas` of the recording
            has the same columns.
        """
        (read,) = _recordings(recording, self.plant_)
        run = score_fit(self._fitted, read, horizons=(), limit=False)
        table = read.to_pandas()[["time", *(f"q{k + 1}" for k in range(read.joints))]]
        table.iloc[:, 1:] = run.simulated
        return table

    def score(self, X: RecordingLike | Sequence[RecordingLike], y: object = None) -> float:
        """Minus the root mean square position error of simulations [rad; m of a sliding axis].

        Simulations last `horizon` seconds (or as long as a shorter recording) and are restarted
        from the measured motion, see `nfriction.score`. Higher is better, 0 is perfect, a diverged
        simulation gives -inf.
        """
        errors = []
        for given in _recordings(X, self.plant_):
            recording = given[release(given) :]
            zeroed, room = bool(self._fitted.encoder_offsets), longest_window(recording)
            # A short recording is scored from the end of its lead-in.
            horizon = min(self.horizon, max(room - ZERO_IN, room / 2) if zeroed else room)
            found = score_fit(self._fitted, recording, horizons=(horizon,), limit=False)
            errors.append(found.windows[f"{horizon:g}"].all)
        return -math.sqrt(sum(e * e for e in errors) / len(errors))

    def __sklearn_is_fitted__(self) -> bool:
        return hasattr(self, "fit_")

    @property
    def _fitted(self) -> FitResult:
        if not hasattr(self, "fit_"):
            raise ValueError("this FrictionEstimator is not fitted yet; call `fit(recordings)`.")
        return self.fit_

    def _rows(self, given: ArrayLike, name: str, samples: int | None = None) -> torch.Tensor:
        """Values as a tensor (sample, joint)."""
        values = torch.tensor(np.asarray(given, dtype=np.float64))
        count = len(values) if samples is None and values.ndim else samples
        if values.shape != (count, self.n_joints_):
            raise ValueError(
                f"`{name}` must have shape ({samples or 'sample'}, {self.n_joints_}), got "
                f"{tuple(values.shape)}."
            )
        return values


# scikit-learn reads an estimator's parameters from its constructor.
_own = list(inspect.signature(FrictionEstimator.__init__).parameters.values())[:-1]
FrictionEstimator.__init__.__signature__ = inspect.Signature([*_own, *SETTINGS.values()])  # type: ignore[attr-defined]


def _recordings(X: RecordingLike | Sequence[RecordingLike], plant: Plant) -> list[Recording]:
    """Recordings of any accepted form; a table without a unit is in the plant's."""
    if not (found := Recording.many(X, plant=plant)):
        raise ValueError(f"a recording or a list of recordings is needed, got {X!r}.")
    return found

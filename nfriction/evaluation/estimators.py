"""An estimator as scikit-learn's users expect one: recordings in, a friction model learnt."""

import copy
import inspect
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd
import torch
from numpy.typing import ArrayLike, NDArray

from nfriction.evaluation.score import score
from nfriction.fitting.fit import fit
from nfriction.fitting.options import (
    Continuity,
    Eccentricity,
    EncoderReference,
    FitOptions,
    Method,
)
from nfriction.fitting.result.fit_result import FitResult
from nfriction.friction.coefficients import Constant
from nfriction.friction.models import FrictionModel
from nfriction.friction.registry import model_by_name
from nfriction.plant import Plant
from nfriction.recording import Recording, Unit
from nfriction.signals import kalman_smoother

Array = NDArray[np.float64]
# One recording, or its table with columns time, q1, ... as `Recording.from_pandas` takes it.
Sample = Recording | pd.DataFrame


class FrictionEstimator:
    """Learn the friction of a mechanism from recordings of its motion.

    A sample is a whole recording, so cross-validation leaves out recordings: `X` is a list of
    them. It needs nothing of scikit-learn and works with its `clone`, `cross_val_score`,
    `GridSearchCV` and pipelines' last steps.

    Args:
        plant: the mechanism.
        model: name of a friction model, or one to start from, which stays as it is.
        method, windows, fit_plant, drag, eccentricity, encoder_reference, continuity, max_steps:
            see `nfriction.fit`.
        horizon: length of the simulations by which `score` judges [s].

    Attributes:
        fit_: the `FitResult` with its verdict; read `fit_.status` and `fit_.warnings`.
        model_: the fitted friction model, a torch module; for `nfriction.save` and exports.
        plant_: the plant with its adjusted terms.
        coef_: coefficients of a constant law, (joint, coefficient), SI.
        coef_names_: what they are called.
        n_joints_: number of joints.

    Examples:
        >>> search = GridSearchCV(FrictionEstimator(rig), {"model": ["NCFM", "LFM"]}, cv=3)
        >>> search.fit(recordings).best_params_
        {'model': 'LFM'}
    """

    def __init__(
        self,
        plant: Plant | None = None,
        model: str | FrictionModel = "LFM",
        *,
        method: Method = "output_error",
        windows: Sequence[float] = FitOptions.windows,
        fit_plant: bool = True,
        drag: bool | None = None,
        eccentricity: Eccentricity = "off",
        encoder_reference: EncoderReference = "auto",
        continuity: Continuity = "none",
        max_steps: int = 30,
        horizon: float = 5.0,
    ) -> None:
        # As scikit-learn asks: kept as given, looked at by `fit`.
        self.plant = plant
        self.model = model
        self.method = method
        self.windows = windows
        self.fit_plant = fit_plant
        self.drag = drag
        self.eccentricity = eccentricity
        self.encoder_reference = encoder_reference
        self.continuity = continuity
        self.max_steps = max_steps
        self.horizon = horizon

    fit_: FitResult

    def fit(self, X: Sample | Sequence[Sample], y: object = None) -> "FrictionEstimator":
        """Learn from recordings.

        Args:
            X: recordings, or tables with columns time, q1, ... (see `Recording.from_pandas`).
            y: ignored; what is to be predicted is in the recordings.

        Returns:
            This estimator.

        Raises:
            ValueError: if there is no plant, no such model, or the recordings do not fit.
        """
        if self.plant is None:
            raise ValueError("`plant` is missing; give the mechanism, as of rigs.read('rig.json').")
        if isinstance(self.model, str):
            model: FrictionModel = model_by_name(self.model)(self.plant.joints)
        else:
            model = copy.deepcopy(self.model)
        settings = self.get_params()
        for own in ("plant", "model", "horizon"):
            del settings[own]
        self.fit_ = fit(model, self.plant, _recordings(X, self.plant), **settings)
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
        if not isinstance(schedule, Constant):
            raise AttributeError(
                f"the coefficients of {type(self.model_).__name__} follow the motion; ask "
                "`model_.coefficients(qd, qdd)`."
            )
        return schedule.values.detach().numpy().copy()

    def predict(
        self,
        X: Sample | ArrayLike,
        qdd: ArrayLike | None = None,
        load: ArrayLike | None = None,
    ) -> Array:
        """Friction torque along a motion.

        Args:
            X: velocity [rad/s], (sample, joint); or a recording, whose smoothed motion then
                gives everything.
            qdd: acceleration [rad/s^2], shape like the velocity; none by default.
            load: normal load over its value at rest [-], shape like the velocity; 1 by default.

        Returns:
            The torque of `M(q) qdd + bias(q, qd) + tau_f = tau` [N m; N of a sliding axis],
            (sample, joint). Coefficients with a memory follow the samples in their order.

        Raises:
            ValueError: if it is not fitted, or shapes do not fit.
        """
        model, plant = self._fitted.model, self._fitted.plant
        with torch.no_grad():
            if isinstance(X, Recording | pd.DataFrame):
                (recording,) = _recordings(X, plant)
                joint = recording.joint_coordinates(plant)
                motion = kalman_smoother(joint.time, joint.q)
                q, velocity, acceleration = map(torch.tensor, (motion.q, motion.qd, motion.qdd))
                loads = plant.load(q, velocity)
            else:
                velocity = self._rows(X, "X")
                acceleration, loads = (
                    velocity.new_full(velocity.shape, value)
                    if given is None
                    else self._rows(given, name, len(velocity))
                    for given, name, value in ((qdd, "qdd", 0.0), (load, "load", 1.0))
                )
            if model.state_size:
                states = model.schedule.states(velocity, acceleration)
                held = model.coefficients_from(velocity, acceleration, states)
                return model.torque(velocity, loads, held).numpy()
            return model(velocity, acceleration, loads).numpy()

    def simulate(self, recording: Sample) -> pd.DataFrame:
        """The motion that the model predicts from a recording's start and torques.

        Args:
            recording: what was measured.

        Returns:
            Table with columns time [s], q1, ... in the recording's convention and unit, a row a
            sample, NaN from where the simulation diverged: `Recording.to_pandas` of what was
            measured has the same columns.
        """
        (given,) = _recordings(recording, self.plant_)
        run = score(self.plant_, self.model_, given, horizons=())
        table = given.to_pandas()[["time", *(f"q{k + 1}" for k in range(given.joints))]]
        table.iloc[:, 1:] = run.simulated
        return table

    def score(self, X: Sample | Sequence[Sample], y: object = None) -> float:
        """Minus the root mean square position error of simulations [rad; m of a sliding axis].

        Simulations last `horizon` seconds (a recording where that is shorter) and are restarted
        from the measured motion. Higher is better, 0 is perfect, a diverged one gives -inf.

        Args:
            X: recordings to judge by.
            y: ignored.
        """
        errors = []
        for recording in _recordings(X, self.plant_):
            horizon = min(self.horizon, recording.duration)
            found = score(self.plant_, self.model_, recording, horizons=(horizon,))
            errors.append(found.windows[f"{horizon:g}"].all)
        return -math.sqrt(sum(e * e for e in errors) / len(errors))

    def get_params(self, deep: bool = True) -> dict[str, Any]:
        """Constructor arguments by name."""
        return {name: getattr(self, name) for name in _parameters()}

    def set_params(self, **params: Any) -> "FrictionEstimator":
        """Change constructor arguments.

        Raises:
            ValueError: for a name that is none.
        """
        known = list(_parameters())
        unknown = sorted(set(params) - set(known))
        if unknown:
            raise ValueError(
                f"no parameter is called {', '.join(unknown)}; there are {', '.join(known)}."
            )
        for name, value in params.items():
            setattr(self, name, value)
        return self

    def __repr__(self) -> str:
        plant = getattr(self.plant, "name", "") or type(self.plant).__name__
        model = self.model if isinstance(self.model, str) else type(self.model).__name__
        changed = [
            f"{name}={value!r}"
            for name, value in self.get_params().items()
            if name not in ("plant", "model") and repr(value) != repr(_parameters()[name])
        ]
        fitted = f"  # {self.fit_.status}" if hasattr(self, "fit_") else ""
        return f"FrictionEstimator({', '.join([f'<{plant}>', repr(model), *changed])}){fitted}"

    def __sklearn_is_fitted__(self) -> bool:
        return hasattr(self, "fit_")

    def __sklearn_tags__(self) -> Any:
        # Only scikit-learn asks, so it is there.
        from sklearn.utils import InputTags, Tags, TargetTags

        return Tags(
            estimator_type=None,
            target_tags=TargetTags(required=False),
            input_tags=InputTags(two_d_array=False),
            non_deterministic=False,
        )

    @property
    def _fitted(self) -> FitResult:
        if not hasattr(self, "fit_"):
            raise ValueError("this FrictionEstimator is not fitted yet; call `fit(recordings)`.")
        return self.fit_

    def _rows(self, given: ArrayLike, name: str, samples: int | None = None) -> torch.Tensor:
        values = torch.tensor(np.asarray(given, dtype=np.float64))
        count = len(values) if samples is None and values.ndim else samples
        if values.shape != (count, self.n_joints_):
            raise ValueError(
                f"`{name}` must have shape ({samples or 'sample'}, {self.n_joints_}), got "
                f"{tuple(values.shape)}."
            )
        return values


def _parameters() -> dict[str, Any]:
    """Constructor arguments and their defaults."""
    signature = inspect.signature(FrictionEstimator.__init__)
    return {name: p.default for name, p in signature.parameters.items() if name != "self"}


def _recordings(X: object, plant: Plant) -> list[Recording]:
    """Recordings of what a user gives for them; a table that says no unit is in the plant's."""
    many = [X] if isinstance(X, Recording | pd.DataFrame) else X
    if not isinstance(many, Sequence | np.ndarray) or not len(many):
        raise ValueError(f"recordings are needed, one or a list of them, got {X!r}.")
    found = []
    for k, given in enumerate(many):
        if isinstance(given, pd.DataFrame):
            known: Unit = "m" if plant.unit == "m" else "rad"
            unit = None if "unit" in given.attrs else known
            given = Recording.from_pandas(given, unit=unit, name=f"table {k + 1}")
        if not isinstance(given, Recording):
            raise ValueError(
                f"a sample is a Recording, or a table with columns time, q1, ..., got "
                f"{type(given).__name__}; `Recording(time, q)` makes one of arrays."
            )
        found.append(given)
    return found

"""Compare friction models: fit each on training recordings, score it on those held out."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pandas as pd

from nfriction.evaluation.fit_many import Data, fit_models
from nfriction.evaluation.score import HORIZONS, Score, improvement_table, rmse_table, score
from nfriction.fitting.data.inputs import warn_of_undriven
from nfriction.fitting.result.fit_result import FitResult
from nfriction.friction.models import FrictionModel
from nfriction.plant import Plant
from nfriction.recording import Recording
from nfriction.signals import Motion, kalman_smoother

NO_FRICTION = "no friction"
JUDGED_BY = "free-run RMSE over all joints and held-out recordings"
# Errors that agree to three digits do not tell two models apart.
TIE = 1e-3
InitialStates = Mapping[str, tuple[np.ndarray, np.ndarray]]


@dataclass(frozen=True, repr=False)
class Comparison:
    """Fits and scores of several models on the same recordings.

    Attributes:
        fits: by model name.
        train, held_out: scores by model name, then recording, `"no friction"` among them.
        unit: of the errors, `"rad"` or `"m"`.
        joint_names: columns of the tables.
        horizons_asked: window lengths that were to be scored [s].
        failed: why a model was not fitted, by its name.
    """

    fits: dict[str, FitResult]
    train: dict[str, list[Score]]
    held_out: dict[str, list[Score]]
    unit: str
    joint_names: tuple[str, ...]
    horizons_asked: tuple[float, ...] = ()
    failed: dict[str, str] = field(default_factory=dict)

    def __repr__(self) -> str:
        """Which model predicts best, and the free-run errors by model and joint."""
        held_out = bool(self.held_out)
        kind = "held-out" if held_out else "training"
        table = 1e3 * self.table(held_out=held_out)
        table.index.name = f"[m{self.unit}]"
        lines = [f"Comparison by free-run RMSE over {kind} recordings, best: {self.best()}"]
        lines += table.to_string(float_format=lambda x: f"{x:.4g}").splitlines()
        lines += [f"not fitted: {name}: {why}" for name, why in self.failed.items()]
        return "\n".join(lines)

    def scores(self, *, held_out: bool = True) -> dict[str, list[Score]]:
        """Scores of a kind by model name.

        Raises:
            ValueError: if no recording of the kind was scored.
        """
        scores = self.held_out if held_out else self.train
        if not scores:
            raise ValueError("no recording of this kind was scored; see `held_out`.")
        return scores

    def table(self, horizon: str | None = None, *, held_out: bool = True) -> pd.DataFrame:
        """Position error by model and joint, over all recordings of a kind (as Table 10)."""
        scores = self.scores(held_out=held_out)
        columns = [*self.joint_names, "all"]
        rmse = rmse_table(scores, horizon)
        return pd.DataFrame(rmse, index=pd.Index(list(scores), name="model"), columns=columns)

    def improvement(self, horizon: str | None = None, *, held_out: bool = True) -> pd.DataFrame:
        """Error saved against no friction, in percent (as Table 11)."""
        table = self.table(horizon, held_out=held_out)
        return pd.DataFrame(
            improvement_table(table.to_numpy()), index=table.index, columns=table.columns
        )

    def horizons(self, *, held_out: bool | None = None) -> list[str]:
        """Window lengths that every recording has; of a kind, or by default of both."""
        kinds = (self.train, self.held_out)
        of = kinds if held_out is None else (kinds[held_out],)
        scores = [s for kind in of for many in kind.values() for s in many]
        return [h for h in scores[0].windows if all(h in s.windows for s in scores)]

    def too_short(self, *, held_out: bool = True) -> dict[str, dict[str, float]]:
        """Recordings too short for a window length: duration [s] by length and recording."""
        scores = next(iter(self.scores(held_out=held_out).values()))
        found = {
            f"{h:g}": {
                s.recording: float(s.time[-1] - s.time[0])
                for s in scores
                if f"{h:g}" not in s.windows
            }
            for h in self.horizons_asked
        }
        return {horizon: short for horizon, short in found.items() if short}

    def to_frame(self) -> pd.DataFrame:
        """Every error as one row: model, recording, kind, horizon, joint, rmse with its unit."""
        rows = [
            (model, s.recording, kind, horizon, joint, value)
            for kind, scores in (("train", self.train), ("held out", self.held_out))
            for model, of_model in scores.items()
            for s in of_model
            for horizon, rmse in (("free run", s.free_run), *s.windows.items())
            for joint, value in zip(
                (*self.joint_names, "all"), (*rmse.joints, rmse.all), strict=True
            )
        ]
        keys = ["model", "recording", "kind", "horizon", "joint"]
        return pd.DataFrame(rows, columns=[*keys, f"rmse [{self.unit}]"])

    def best(self) -> str | None:
        """What predicts the held-out recordings best, `"no friction"` included.

        Judged by the free run over all joints and recordings; of those that are equal within a
        thousandth, the one with the fewest parameters. None where nothing was held out, or every
        free run diverged.
        """
        if not self.held_out:
            return None
        rmse = self.table()["all"]
        if not np.isfinite(rmse.min()):
            return None
        return min(rmse.index[rmse <= (1 + TIE) * rmse.min()], key=self._parameters)

    def floor(self, column: str = "all", *, held_out: bool = True) -> float | None:
        """What one encoder count at the start makes of the free run: less tells no models apart.

        Args:
            column: joint of the tables, or `"all"`.
            held_out: over which recordings.

        Returns:
            Root mean square over them [rad or m], of the model with the least error; None where
            the count is not known or a simulation diverged.
        """
        scores, free_run = self.scores(held_out=held_out), self.table(held_out=held_out)[column]
        named = free_run.drop(NO_FRICTION, errors="ignore")
        floors = [s.floor for s in scores[str((free_run if named.empty else named).idxmin())]]
        place = [*self.joint_names, "all"].index(column)
        values = [np.nan if f is None else [*f.joints, f.all][place] for f in floors]
        floor = float(np.sqrt(np.mean(np.square(values))))
        return floor if np.isfinite(floor) else None

    def alike(self) -> tuple[str, ...]:
        """The best and all within the floor of it, `"no friction"` among them, simplest first.

        The best alone where there is no floor; empty where there is no best.
        """
        best = self.best()
        if best is None:
            return ()
        rmse, floor = self.table()["all"], self.floor()
        near = () if floor is None else rmse.index[rmse <= rmse.min() + floor]
        return tuple(sorted({best, *near}, key=lambda name: (self._parameters(name), rmse[name])))

    def _parameters(self, name: str) -> int:
        found = self.fits.get(name)
        return sum(p.numel() for p in found.model.parameters()) if found else 0

    def to_dict(self) -> dict[str, Any]:
        """Plain JSON: coefficients, scores, how each fit ended, and which model is best."""
        models: dict[str, Any] = {}
        for name in self.held_out or self.train:
            models[name] = {
                "held_out": {s.recording: s.to_dict() for s in self.held_out.get(name, [])},
                "train": {s.recording: s.to_dict() for s in self.train.get(name, [])},
            }
            if name in self.fits:
                found = self.fits[name]
                models[name] |= {
                    "coefficients": coefficient_summary(found.model),
                    "fit": found.to_dict(),
                }
        best, judged = self.best(), None
        if best is not None:
            alike = list(self.alike())
            judged = {"model": best, "by": JUDGED_BY, "floor": self.floor(), "alike": alike}
        failed = {"failed": dict(self.failed)} if self.failed else {}
        return {
            "models": models,
            **failed,
            "best": judged,
            "units": self.unit,
            "joints": list(self.joint_names),
        }


def compare(
    plant: Plant,
    models: str | Sequence[str],
    train: Recording | Sequence[Recording],
    held_out: Recording | Sequence[Recording] = (),
    *,
    initial_states: InitialStates | None = None,
    horizons: Sequence[float] = HORIZONS,
    on_stage: Callable[[str], None] | None = None,
    on_step: Callable[[str], None] | None = None,
    jobs: int = 1,
    **fit_settings: Any,
) -> Comparison:
    """Fit models and score each on every recording.

    No friction is scored on the plant as given, so it does not depend on any model's fit; each
    model is scored on the plant that was fitted with it.

    Args:
        plant: the mechanism as given.
        models: names of models, the simplest first: constant laws start from its plant terms,
            an adaptive or neuro-fuzzy model from the constant fit of its law.
        train: recordings to fit, or one.
        held_out: recordings to judge by, or one; never seen by a fit.
        initial_states: q0 and qd0 by recording name, in the recording's convention.
        horizons: window lengths of the scores [s].
        on_stage, on_step: told what is being done, for a progress display; steps only of
            searches in this process.
        jobs: fits at the same time, each in a process of its own; -1 for one to each core. The
            result does not depend on it. Above 1 it takes joblib, whose `parallel_config`
            chooses another backend, such as a Dask cluster.
        fit_settings: see `fit`.

    Raises:
        ValueError: if a recording is both trained on and held out, or names are not unique.
        ImportError: if `jobs` needs joblib and it is not installed.
        ValueError, ArithmeticError, RuntimeError: if no model could be fitted; where only some
            could not, `failed` tells why.
    """
    models = [models] if isinstance(models, str) else models
    train, held_out = (
        [given] if isinstance(given, Recording) else list(given) for given in (train, held_out)
    )
    if not models or not train:
        raise ValueError("at least one model and one training recording are needed.")
    check_recordings(train, held_out)
    warn_of_undriven([*train, *held_out])
    # Smoothed once, for all fits and scores.
    moved = [[_motion(plant, r) for r in kind] for kind in (train, held_out)]
    fits, failed = fit_models(
        plant, models, {"fit": Data(train, moved[0])}, jobs=jobs, on_stage=on_stage,
        on_step=on_step, **fit_settings,
    )["fit"]  # fmt: skip
    say = on_stage or (lambda _: None)
    scored: tuple[dict[str, list[Score]], dict[str, list[Score]]] = ({}, {})
    states = initial_states or {}
    for name in (NO_FRICTION, *fits):
        found = fits.get(name)
        say(f"score {name}")
        for scores, recordings, motions in zip(scored, (train, held_out), moved, strict=True):
            if recordings:
                scores[name] = [
                    score(
                        found.plant if found else plant,
                        found.model if found else None,
                        recording,
                        motion=motion,
                        initial_state=states.get(recording.name),
                        horizons=horizons,
                    )
                    for recording, motion in zip(recordings, motions, strict=True)
                ]
    return Comparison(
        fits, *scored, unit=plant.unit, joint_names=tuple(plant.joint_names),
        horizons_asked=tuple(horizons), failed=failed,
    )  # fmt: skip


def check_recordings(train: Sequence[Recording], held_out: Sequence[Recording]) -> None:
    """Whether recordings can be told apart, and those to judge by are none that a fit sees.

    Raises:
        ValueError: names that repeat, or a recording both trained on and held out, whatever its
            names.
    """
    trained = {recording.digest() for recording in train}
    seen = [r.name or "a recording" for r in held_out if r.digest() in trained]
    if seen:
        raise ValueError(
            f"{', '.join(seen)}: trained on and held out; a model is judged by recordings it has "
            f"not seen."
        )
    names = [r.name for r in (*train, *held_out)]
    repeated = sorted({n for n in names if names.count(n) > 1})
    if repeated:
        told = ", ".join(n or "the empty one" for n in repeated)
        raise ValueError(
            f"recordings must have different names, {told} repeats; rename one, in Python by the "
            f"`name` of `Recording`."
        )


def coefficient_summary(model: FrictionModel) -> dict[str, Any]:
    """Coefficients by name, a value a joint; by set first where a model has several."""
    names = model.schedule.coefficient_names
    summary = {
        label: {name: values[:, k].tolist() for k, name in enumerate(names)}
        for label, values in model.schedule.coefficient_sets().items()
    }
    return summary.get("always", summary)


def _motion(plant: Plant, recording: Recording) -> Motion:
    joint = recording.joint_coordinates(plant)
    return kalman_smoother(joint.time, joint.q)

"""Compare friction models: fit each to training recordings, score it on test recordings."""

import math
import warnings
from collections.abc import Container, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import pandas as pd
import torch

from nfriction.evaluation.parallel import Data, FitsInterrupted, Progress, fit_models
from nfriction.evaluation.score import HORIZONS, RMSE, Score, score
from nfriction.fitting.data.inputs import (
    as_model,
    finer_counts,
    released,
    require_drive,
    warn_of_undriven,
)
from nfriction.fitting.diagnosis.mistakes import likely_mistakes, mistake_warning, unlike_training
from nfriction.fitting.options import DEFAULTS, checked_lengths
from nfriction.fitting.result.fit_result import UNIFORM_TURN, FitResult
from nfriction.fitting.strategy.inputs import known_phases, phase_bins
from nfriction.friction import both_names, model_name
from nfriction.friction.heat import HEAT
from nfriction.friction.models import FrictionModel
from nfriction.plant import Plant, rigs
from nfriction.recording import Recording, RecordingLike
from nfriction.signals import Motion, kalman_smoother

if TYPE_CHECKING:
    from matplotlib.figure import Figure

NO_FRICTION = "no friction"
LIMIT = "limit of these data"
JUDGED_BY = "{} RMSE over all joints and test recordings"
SCHEMA = 4
"""Of `results.json`; the third had no `zero`, the second a `floor` from one encoder count in place
of the `limit`, the first no number and `held_out` in place of `test`."""
# Models whose errors agree to three digits are tied.
TIE = 1e-3
# Share of a test recording's samples that may be faster or farther than all training samples.
FASTER = 0.01
# An error this many times that of a model no larger cannot be chance in a few test recordings.
FAR_WORSE = 2.0
InitialStates = Mapping[str, tuple[np.ndarray, np.ndarray]]
Part = Literal["train", "test"]
PART_NAMES: dict[Part, str] = {"test": "test recordings", "train": "training recordings"}


class Fits(dict[str, FitResult]):
    """Fits by the model's name, which may be the plain one: `fits["coulomb-viscous"]`."""

    def __missing__(self, name: str) -> FitResult:
        with suppress(ValueError):  # the text names no model
            known = model_name(name)
            if known in self:
                return self[known]
        raise KeyError(f"{name}; there are {', '.join(map(both_names, self))}")


@dataclass(frozen=True, repr=False)
class Comparison:
    """Fits and scores of several models on the same recordings.

    Attributes:
        fits: by model name, see `Fits`.
        train, test: scores by model name, then recording, including `"no friction"`.
        unit: of the errors, `"rad"` or `"m"`.
        joint_names: columns of the tables.
        horizons_asked: requested window lengths of the scores [s].
        failed: reason why a model was not fitted, by its name.
        test_warnings: of the test recordings, a sentence each.
    """

    fits: dict[str, FitResult]
    train: dict[str, list[Score]]
    test: dict[str, list[Score]]
    unit: str
    joint_names: tuple[str, ...]
    horizons_asked: tuple[float, ...] = ()
    failed: dict[str, str] = field(default_factory=dict)
    test_warnings: tuple[str, ...] = ()

    def __repr__(self) -> str:
        """The best model, and the free-run errors by model and joint."""
        part: Part = "test" if self.test else "train"
        table = 1e3 * self.table(part=part)
        table.index.name = f"[m{self.unit}]"
        lines = [f"Comparison by free-run RMSE over {PART_NAMES[part]}, best: {self.best()}"]
        lines += table.to_string(float_format=lambda x: f"{x:.4g}").splitlines()
        lines += [f"not fitted: {name}: {why}" for name, why in self.failed.items()]
        return "\n".join(lines)

    def _repr_html_(self) -> str:
        """The same for a notebook."""
        head, _, _ = repr(self).partition("\n")
        table = 1e3 * self.table(part="test" if self.test else "train").rename(index=both_names)
        table.index.name = f"[m{self.unit}]"
        return f"<p>{head}</p>{table.to_html(float_format=lambda x: f'{x:.4g}')}"

    @property
    def parts(self) -> tuple[Part, ...]:
        """`"test"` and `"train"`, if recordings of that part were scored."""
        return tuple(part for part in PART_NAMES if getattr(self, part))

    def scores(self, part: Part = "test") -> dict[str, list[Score]]:
        """Scores on the recordings of a part by model name.

        Raises:
            ValueError: if no recording of the part was scored.
        """
        if part not in self.parts:
            raise ValueError(f"no {part} recording was scored; give some as `{part}`.")
        scores: dict[str, list[Score]] = getattr(self, part)
        return scores

    def table(self, horizon: str | None = None, *, part: Part = "test") -> pd.DataFrame:
        """Position error by model and joint: root mean square over the recordings of a part.

        Args:
            horizon: window length as in `Score.windows`; None for the free run.
            part: `"test"` or `"train"`.

        References:
            TLRIP paper, Table 10.
        """
        scores, columns = self.scores(part), [*self.joint_names, "all"]
        rows = {}
        for model, of_model in scores.items():
            errors = [s.free_run if horizon is None else s.windows[horizon] for s in of_model]
            square = np.mean(np.square([[*e.joints, e.all] for e in errors]), axis=0)
            rows[model] = np.sqrt(square)
        return pd.DataFrame.from_dict(rows, orient="index", columns=columns).rename_axis("model")

    def improvement(self, horizon: str | None = None, *, part: Part = "test") -> pd.DataFrame:
        """Error reduction relative to the first model, no friction [%]; NaN where both diverged.

        References:
            TLRIP paper, Table 11.
        """
        table = self.table(horizon, part=part)
        with np.errstate(divide="ignore", invalid="ignore"):
            return 100.0 * (1.0 - table / table.iloc[0])

    def horizons(self, part: Part | None = None) -> list[str]:
        """Window lengths scored on every recording of a part, by default of both parts."""
        parts = tuple(PART_NAMES) if part is None else (part,)
        scores = [s for p in parts for of_model in getattr(self, p).values() for s in of_model]
        return [h for h in scores[0].windows if all(h in s.windows for s in scores)]

    def too_short(self, part: Part = "test") -> dict[str, dict[str, float]]:
        """Recordings too short for a window length: duration [s] by length and recording."""
        found: dict[str, dict[str, float]] = {}
        for scored in next(iter(self.scores(part).values())):
            for horizon in (f"{h:g}" for h in self.horizons_asked):
                if horizon not in scored.windows:
                    duration = float(scored.time[-1] - scored.time[0])
                    found.setdefault(horizon, {})[scored.recording] = duration
        return found

    def to_frame(self) -> pd.DataFrame:
        """Every error as one row: model, recording, part, horizon, joint, rmse with its unit.

        The limit of these data, in simulations of the best model of each part, comes last.
        """
        scores = [
            (model, s, part)
            for part in reversed(PART_NAMES)
            for model, of_model in getattr(self, part).items()
            for s in of_model
        ]
        limits = [
            (LIMIT, replace(s, free_run=s.limit.free_run, windows=s.limit.windows), part)
            for part in reversed(self.parts)
            for s in self.scores(part)[self.nearest(part)]
            if s.limit is not None
        ]
        columns = (*self.joint_names, "all")
        rows = [
            (model, s.recording, part, horizon, joint, value)
            for model, s, part in (*scores, *limits)
            for horizon, rmse in (("free run", s.free_run), *s.windows.items())
            for joint, value in zip(columns, (*rmse.joints, rmse.all), strict=True)
        ]
        keys = ["model", "recording", "part", "horizon", "joint"]
        return pd.DataFrame(rows, columns=[*keys, f"rmse [{self.unit}]"])

    def best(self) -> str | None:
        """The model that predicts the test recordings best, `"no friction"` included.

        Judged by the error over all joints and recordings (`judged_over`); among models that are
        equal within a thousandth, the one with the fewest parameters; if fits within the limit of
        it are good, one of these. None if there is no test recording, or every run diverged.
        """
        if not self.test:
            return None
        over = self.judged_over()
        rmse = self.table(over)["all"]
        if not np.isfinite(rmse.min()):
            return None
        tied = rmse.min() + (self.limit(over) or 0.0)
        good = [n for n, fit in self.fits.items() if fit.usability[0] == "good" and rmse[n] <= tied]
        if good and rmse.idxmin() != NO_FRICTION:
            rmse = rmse[good]
        return min(rmse.index[rmse <= (1 + TIE) * rmse.min()], key=self._parameters)

    def judged_over(self) -> str | None:
        """Length of the windows that decide which model is best; None for the free run.

        If noise alone leaves an angle unknown at the end of a chaotic free run, models are judged
        over the longest windows that can be predicted.
        """
        if self.unit != "rad" or (self.limit() or 0.0) < UNIFORM_TURN:
            return None
        lengths = sorted(self.horizons("test"), key=float, reverse=True)
        return next((h for h in lengths if (self.limit(h) or math.inf) < UNIFORM_TURN), None)

    def limit(
        self,
        horizon: str | None = None,
        column: str = "all",
        *,
        part: Part = "test",
        model: str | None = None,
    ) -> float | None:
        """Error that noise and integration can cause in simulations of a model.

        Smaller differences between models are not meaningful.

        Args:
            horizon: window length as in `Score.windows`; None for the free run.
            column: joint of the tables, or `"all"`.
            part: `"test"` or `"train"`.
            model: the model; None for the best of the part.

        Returns:
            Root mean square over its recordings [rad or m]; None if the limit was not requested or
            a simulation diverged.
        """
        place = [*self.joint_names, "all"].index(column)
        squares = []
        for of in (s.limit for s in self.scores(part)[model or self.nearest(part)]):
            error = of and (of.free_run if horizon is None else of.windows.get(horizon))
            if not isinstance(error, RMSE):
                return None
            squares.append([*error.joints, error.all][place] ** 2)
        limit = float(np.sqrt(np.mean(squares)))
        return limit if np.isfinite(limit) else None

    def nearest(self, part: Part) -> str:
        """The model with the smallest free-run error; no friction if there is no other."""
        free_run = self.table(part=part)["all"]
        models = free_run.drop(NO_FRICTION, errors="ignore")
        return str((free_run if models.empty else models).idxmin())

    def indistinguishable(self) -> tuple[str, ...]:
        """The best model and all within the limit of it, including `"no friction"`.

        Simplest first. Only the best if there is no limit; empty if there is no best.
        """
        best = self.best()
        if best is None:
            return ()
        over = self.judged_over()
        rmse, limit = self.table(over)["all"], self.limit(over)
        near = () if limit is None else rmse.index[rmse <= rmse.min() + limit]
        return tuple(sorted({best, *near}, key=lambda name: (self._parameters(name), rmse[name])))

    def unfit(self) -> dict[str, str]:
        """Models not to be used, with the reason: one no larger predicts the test far better.

        A model extrapolates wrongly if no friction, or with half its error a model with no more
        parameters, is better by more than the limit of these data. Any larger error is unfit, too.
        An error within the model's own limit is no evidence, unless that limit reaches the error
        without friction: near sticking, the law of the rig itself may err by far.
        """
        if not self.test:
            return {}
        over = self.judged_over()
        rmse, limit = self.table(over)["all"], self.limit(over) or 0.0
        found, excused = {}, [NO_FRICTION]
        largest = rmse.get(NO_FRICTION, 0.0)
        for name, error in rmse.items():
            smaller = rmse[[self._parameters(n) <= self._parameters(str(name)) for n in rmse.index]]
            least = smaller.min()
            if error <= (self.limit(over, model=str(name)) or 0.0) < largest:
                excused.append(str(name))
            # Where all of these diverge, none is known to be better.
            elif np.isfinite(least) and error >= FAR_WORSE * least and error > least + limit:
                best = f"{smaller.idxmin()}, with no more parameters, errs by {1e3 * least:.3g}"
                own = f"by {1e3 * error:.3g} m{self.unit}" if np.isfinite(error) else "diverges"
                found[str(name)] = f"{best} m{self.unit}, this model {own}"
            elif NO_FRICTION in rmse and error > rmse[NO_FRICTION] + limit:
                found[str(name)] = "no friction predicts better"
        least_unfit = min(found, key=rmse.__getitem__, default="")
        for name in rmse.index[rmse >= rmse[[*found]].min()].drop(excused, errors="ignore"):
            found.setdefault(str(name), f"it predicts no better than {least_unfit}, not to be used")
        return found

    def rating(self, name: str) -> tuple[str, str]:
        """Usability of a fit and the reason; the test may forbid its use."""
        unfit = self.unfit().get(name)
        return ("do not use", f"in the test, {unfit}") if unfit else self.fits[name].usability

    def _parameters(self, name: str) -> int:
        found = self.fits.get(name)
        return sum(p.numel() for p in found.model.parameters()) if found else 0

    def plot(self) -> "Figure":
        """Position error over the length of the simulation, by model; see `plots.horizon_curve`."""
        from nfriction import plots  # matplotlib is slow to import

        return plots.horizon_curve(self)

    def animate(self, recording: Recording, path: str | Path) -> Path:
        """Write a recording and its simulation by the best model as a GIF; see `plots.animate`.

        Raises:
            ValueError: if the recording was not compared, or nothing was fitted.
        """
        from nfriction import plots

        best = self.best() or NO_FRICTION
        found = self.fits.get(best) or next(iter(self.fits.values()), None)
        scored = [s for part in self.parts for s in self.scores(part)[best]]
        scores = [score for score in scored if score.recording == recording.name]
        if found is None or not scores:
            raise ValueError(
                f"{recording.name!r} was not scored; give one of the compared recordings."
                if found
                else "no model was fitted, so there is nothing to animate."
            )
        plant, motions = found.plant, {"measured": recording.q, best: scores[0].simulated}
        if plant.unit == "rad":
            to_joint = recording.resolve_convention(plant).position_to_joint
            motions = {name: to_joint(q, plant.first_link) for name, q in motions.items()}
        return plots.animate(plant, recording.time, motions, path)

    def to_dict(self) -> dict[str, Any]:
        """Plain JSON: coefficients, scores, how each fit ended, and which model is best."""
        models: dict[str, Any] = {}
        for name in self.test or self.train:
            models[name] = {
                part: {s.recording: s.to_dict() for s in getattr(self, part).get(name, [])}
                for part in PART_NAMES
            }
            if fit := self.fits.get(name):
                models[name]["coefficients"] = coefficient_summary(fit.model, fit.motions)
                models[name]["fit"] = fit.to_dict() | {"usability": list(self.rating(name))}
        best, judged = self.best(), None
        if best is not None:
            over = self.judged_over()
            by = JUDGED_BY.format(f"{over} s window" if over else "free-run")
            judged = {
                "model": best, "by": by, "limit": self.limit(over),
                "indistinguishable": list(self.indistinguishable()),
            }  # fmt: skip
        return {
            "schema": SCHEMA,
            "models": models,
            **({"failed": dict(self.failed)} if self.failed else {}),
            **({"test_warnings": list(self.test_warnings)} if self.test_warnings else {}),
            "best": judged,
            **({"unfit": unfit} if (unfit := self.unfit()) else {}),
            "units": self.unit,
            "joints": list(self.joint_names),
        }


def compare(
    plant: Plant | str | Path,
    models: str | Sequence[str],
    train: RecordingLike | Sequence[RecordingLike],
    test: RecordingLike | Sequence[RecordingLike] = (),
    *,
    initial_states: InitialStates | None = None,
    horizons: Sequence[float] = HORIZONS,
    progress: Progress | None = None,
    jobs: int = 1,
    **fit_settings: Any,
) -> Comparison:
    """Fit models and score each on every recording.

    The case without friction is scored on the plant as given, so that it does not depend on any
    fit; each model is scored on the plant that was fitted with it.

    Args:
        plant: the mechanism as given, its name, or the path of a rig file.
        models: names of models such as `"coulomb-viscous"` or `"CVFM"`, the simplest first: other
            constant laws start from its plant terms, an adaptive or neuro-fuzzy model from the
            constant fit of its law.
        train: recordings to fit, or one; also paths of files and tables, see `Recording.of`.
        test: recordings for testing, or one; never seen by a fit.
        initial_states: q0 and qd0 by recording name, in the recording's convention; free runs of
            other recordings start from a lead-in, see `score`.
        horizons: window lengths of the scores [s].
        progress: receives the current stage, and the steps of searches in this process.
        jobs: number of parallel fits, each in its own process; -1 for one per core. The result
            does not depend on it. Above 1 it needs joblib, whose `parallel_config` selects
            another backend, such as a Dask cluster.
        fit_settings: see `fit`.

    Raises:
        ValueError: if a recording is in both parts, or lacks a torque that a law reads, or names
            are not unique.
        ImportError: if `jobs` needs joblib and it is not installed.
        ValueError, ArithmeticError, RuntimeError: if no model could be fitted; if only some could
            not, `failed` has the reasons.
        KeyboardInterrupt: if interrupted before the first fit is finished; later, the models
            finished by then are scored, and `failed` has the others.
    """
    models = [models] if isinstance(models, str) else models
    horizons = checked_lengths("horizons", horizons, 0)
    plant = rigs.of(plant)
    train = Recording.many(train, plant=plant, name="train")
    test = Recording.many(test, plant=plant, name="test")
    if not models or not train:
        raise ValueError(
            "compare needs at least one model and one training recording, got "
            f"{len(models)} and {len(train)}."
        )
    check_recordings(train, test)
    for name in models:
        require_drive(as_model(name, plant.joints).law, [*train, *test])
    warn_of_undriven([*train, *test])
    progress = progress or Progress()
    progress.expect(1 + len(set(map(model_name, models))))  # scores, besides fits
    # Smoothed once for all fits.
    data, tested = (
        Data(part, [kalman_smoother(r.time, r.joint_coordinates(plant).q) for r in part])
        for part in (released(train), released(test))
    )
    warned = _warned(_faster(plant, data, tested))
    try:
        fits, failed = fit_models(
            plant, models, {"fit": data}, jobs=jobs, progress=progress, **fit_settings
        )["fit"]
    except FitsInterrupted as interrupt:
        fits, failed = interrupt.fits["fit"]
        if not fits:
            raise
        progress.resume()
    # Fits without heat come first: their friction depends on the current motion alone.
    named = min(fits, key=lambda name: (fits[name].model.state_size, fits[name].residual))
    warned += _warned(_farther(fits, tested))
    warned += _warned(_mistakes(plant, fits[named], data, tested, faster=bool(warned)))
    scores: dict[str, dict[str, list[Score]]] = {"train": {}, "test": {}}
    states = initial_states or {}
    zeroed = any(found.encoder_offsets for found in fits.values())
    for name in (NO_FRICTION, *fits):
        progress.stage(f"score {name}")
        found, how = fits.get(name), {"horizons": horizons, "zeroed": zeroed}
        scored = partial(score_fit, found) if found else partial(score, plant, None)
        for part, recordings in (("train", train), ("test", test)):
            if recordings:
                scores[part][name] = [
                    scored(r, initial_state=states.get(r.name), **how) for r in recordings
                ]
        progress.done()
    of_best = [scores[part].get(named, []) for part in ("train", "test")]
    known = {text.partition(":")[0] for text in warned}
    warned += _warned(_worse_than_training(*of_best, known=known, unit=plant.unit))
    return Comparison(
        Fits(fits), **scores, unit=plant.unit, joint_names=tuple(plant.joint_names),
        horizons_asked=tuple(horizons), failed=failed, test_warnings=warned,
    )  # fmt: skip


def score_fit(fit: FitResult, recording: RecordingLike, **settings: Any) -> Score:
    """Score a fit: `score` with its torque delay, and with encoder zeros if it estimated them.

    `settings` are keyword arguments of `score`.
    """
    settings = {"zeroed": bool(fit.encoder_offsets), **settings}
    given = fit.aligned(Recording.of(recording, plant=fit.plant))
    return score(fit.plant, fit.model, given, **settings)


def _warned(texts: Iterable[str]) -> tuple[str, ...]:
    found = tuple(texts)
    for text in found:
        warnings.warn(text, stacklevel=1)
    return found


def _mistakes(
    plant: Plant, fit: FitResult, train: Data, test: Data, *, faster: bool
) -> Iterator[str]:
    """Likely mistakes in test recordings, unless the fit names some in its own.

    `faster` is true if friction is extrapolated to their speeds.
    """
    known, both = {*finer_counts(plant, train.recordings)}, [*train.recordings, *test.recordings]
    yield from (text for text in finer_counts(plant, both) if text not in known)
    if fit.mistakes:
        return
    trained, tested = (
        [(fit.aligned(r.joint_coordinates(plant)), m) for r, m in zip(*part, strict=True)]
        for part in (train, test)
    )
    unlike = {}
    # Friction at other speeds, or with a state, may differ although nothing has changed.
    if not (faster or fit.model.state_size or fit.model.law_state_size):
        unlike = dict(unlike_training(fit.plant, fit.model, trained, tested))
    for recording, (joint, moved) in zip(test.recordings, tested, strict=True):
        stated, mistakes = likely_mistakes(
            fit.plant, [joint], [moved], recording.resolve_convention(plant)
        )
        said, change = mistake_warning(stated, mistakes), unlike.get(joint.name)
        # A changed torque may look like a wrong rig, which the training recordings contradict.
        least = min((m.unexplained for m in mistakes), default=math.inf)
        if change and change.unexplained < DEFAULTS.diagnosis_tie * least:
            said = (change.text,)
        yield from (f"{recording.name or 'test'}: {text}" for text in said)


def _worse_than_training(
    train: Sequence[Score], test: Sequence[Score], *, known: Container[str], unit: str
) -> Iterator[str]:
    """Tests that a fit does not follow, although it follows its training to the limit of the data.

    Over the shortest windows, where errors of the fitted parameters hardly add up.
    """

    def missed(of: Score) -> tuple[float, float, str]:
        over, error = next(iter(of.windows.items()), ("", of.free_run))
        limit = of.limit and (of.limit.windows[over] if over else of.limit.free_run)
        ratio = error.all / limit.all if limit and limit.all > 0 else math.nan
        return ratio, error.all, f"over {over} s" if over else "in the free run"

    usual, most = max((missed(of)[0] for of in train), default=math.nan), DEFAULTS.model_error_ratio
    for of in test if usual <= most else ():
        ratio, error, over = missed(of)
        if of.recording not in known and ratio > most * max(usual, 1.0):
            yield (
                f"{of.recording or 'test'}: the best fit errs by {1e3 * error:.3g} m{unit} {over}, "
                f"{ratio:.2g} times the limit of these data; in training by at most {usual:.2g} "
                "times the limit: the motion is of another kind (speed, range, load), or rig, "
                "friction or sensors have changed."
            )


def _faster(plant: Plant, train: Data, test: Data) -> Iterator[str]:
    """A sentence if tests are faster than all training, or move in a direction without training."""
    fastest, found = np.max([np.abs(m.qd).max(0) for m in train.motions], axis=0), []
    for sign in (1, -1):
        trained = np.max([_usual_speed(m, sign) for m in train.motions], axis=0) > 0
        for recording, moved in zip(*test, strict=True):
            of = f"of {recording.name or 'a recording'}"
            speeds = _usual_speed(moved, sign)
            known = np.where(trained, fastest, 0.0)
            found += [
                f"{name} {of} ({sign * speed:.3g} against {sign * most + 0.0:.3g} {plant.unit}/s)"
                for name, speed, most in zip(plant.joint_names, speeds, known, strict=True)
                if speed > most
            ]
    if found:
        yield (
            "friction is extrapolated to speeds that no training recording reaches: "
            f"{', '.join(found)}; train on motions as fast as those to be simulated, in both "
            "directions."
        )


def _farther(fits: Mapping[str, FitResult], test: Data) -> Iterator[str]:
    """A sentence for each fit whose friction by position is extrapolated in tests."""
    for model, fit in fits.items():
        if fit.encoder_offsets:
            continue  # those of the tests are not known yet
        known, found = known_phases(fit.plant, fit.motions), []
        trained = np.concatenate([m.q for m in fit.motions])
        for recording, moved in zip(*test, strict=True):
            new = ~np.take_along_axis(known.T, phase_bins(fit.plant, moved.q), axis=0)
            found += [
                f"{fit.plant.joint_names[j]} of {recording.name or 'a recording'} "
                f"({moved.q[:, j].min():.3g} to {moved.q[:, j].max():.3g} against "
                f"{trained[:, j].min():.3g} to {trained[:, j].max():.3g} {fit.plant.unit})"
                for j in np.flatnonzero(new.mean(axis=0) > FASTER)
            ]
        if found:
            yield (
                f"{model}: its friction by position is extrapolated to positions that no training "
                f"recording visits: {', '.join(found)}; train on the whole range."
            )


def _usual_speed(motion: Motion, sign: int) -> np.ndarray:
    """Speed in a direction that all but 1 % of the samples stay below, (joint,) [rad/s; m/s]."""
    # Pure noise exceeds other pure noise in half of all cases.
    noise = 0.0 if motion.std is None else 2.0 * motion.std.qd
    return np.quantile(sign * motion.qd - noise, 1.0 - FASTER, axis=0)


def check_recordings(train: Sequence[Recording], test: Sequence[Recording]) -> None:
    """Require distinct names, and test recordings that no fit sees.

    Raises:
        ValueError: repeated names, or a recording or a piece of it in both parts.
    """
    seen = [r.name or "a recording" for r in test if any(_contains(t, r) for t in train)]
    if seen:
        raise ValueError(
            f"{', '.join(seen)}: used for training and testing; test a model on recordings that it "
            f"has not seen."
        )
    names = [r.name for r in (*train, *test)]
    repeated = sorted({n or "the empty one" for n in names if names.count(n) > 1})
    if repeated:
        raise ValueError(
            f"recordings must have different names, {', '.join(repeated)} repeats; rename one, in "
            f"Python with the `name` of `Recording`."
        )


def _contains(whole: Recording, part: Recording) -> bool:
    """True if a recording is another one, or a piece of it, whatever their names and times."""
    count = len(part)
    last = len(whole) - count
    if last < 0 or whole.joints != part.joints or (whole.tau is None) != (part.tau is None):
        return False
    of, data = (
        r.q if r.tau is None else np.concatenate([r.q, r.tau], axis=1) for r in (whole, part)
    )
    starts = np.ones(last + 1, dtype=bool)
    # Some rows first, because a joint may rest at the same place for long.
    for row in np.linspace(0, count - 1, 20).astype(int):
        starts &= (of[row : row + last + 1] == data[row]).all(axis=1)
    return any(np.array_equal(of[k : k + count], data) for k in np.flatnonzero(starts))


def coefficients_by_set(model: FrictionModel) -> dict[str, dict[str, list[float]]]:
    """Coefficients by range of validity and by name, one value per joint."""
    # Without the coefficient of heat, because a motion starts cold.
    shown = [(k, c.name) for k, c in enumerate(model.law.coefficients) if c != HEAT]
    return {
        label: {name: values[:, k].tolist() for k, name in shown}
        for label, values in model.schedule.coefficient_sets().items()
    }


def coefficient_summary(model: FrictionModel, motions: Sequence[Motion] = ()) -> dict[str, Any]:
    """Coefficients by name, one value per joint; first by set if a model has several.

    Of a network also the smallest and largest ones along the motions of its training.
    """
    sets = coefficients_by_set(model)
    if motions and "at_rest" in sets:
        qd, qdd = (np.concatenate([getattr(m, k) for m in motions]) for k in ("qd", "qdd"))
        ends = model.coefficients(*map(torch.as_tensor, (qd, qdd))).detach().aminmax(dim=0)
        for label, values in zip(("lowest_in_training", "highest_in_training"), ends, strict=True):
            # The coefficient of heat is last, and not in the sets.
            sets[label] = dict(zip(sets["at_rest"], values.T.tolist(), strict=False))
    return sets.get("always", sets)

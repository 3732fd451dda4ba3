"""Compare friction models: fit each on training recordings, score it on those held out."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd

from nfriction.fitting import Fit, fit
from nfriction.friction import Constant, FrictionModel, NeuroFuzzy, model_by_name
from nfriction.plant import LinearAxis, PendulumChain
from nfriction.recording import Recording
from nfriction.scoring import HORIZONS, Score, improvement_table, rmse_table, score

NO_FRICTION = "no friction"
InitialStates = Mapping[str, tuple[np.ndarray, np.ndarray]]


@dataclass(frozen=True)
class Comparison:
    """Fits and scores of several models on the same recordings.

    Attributes:
        fits: by model name.
        train, held_out: scores by model name, then recording, `"no friction"` among them.
        unit: of the errors, `"rad"` or `"m"`.
        joint_names: columns of the tables.
    """

    fits: dict[str, Fit]
    train: dict[str, list[Score]]
    held_out: dict[str, list[Score]]
    unit: str
    joint_names: tuple[str, ...]

    def table(self, horizon: str | None = None, *, held_out: bool = True) -> pd.DataFrame:
        """Position error by model and joint, over all recordings of a kind (as Table 10)."""
        scores = self.held_out if held_out else self.train
        if not scores:
            raise ValueError("no recording of this kind was scored; see `held_out`.")
        columns = [*self.joint_names, "all"]
        rmse = rmse_table(scores, horizon)
        return pd.DataFrame(rmse, index=pd.Index(list(scores), name="model"), columns=columns)

    def improvement(self, horizon: str | None = None, *, held_out: bool = True) -> pd.DataFrame:
        """Error saved against no friction, in percent (as Table 11)."""
        table = self.table(horizon, held_out=held_out)
        return pd.DataFrame(
            improvement_table(table.to_numpy()), index=table.index, columns=table.columns
        )

    def horizons(self) -> list[str]:
        """Window lengths that every recording has."""
        scores = [s for of in (self.train, self.held_out) for many in of.values() for s in many]
        return [h for h in scores[0].windows if all(h in s.windows for s in scores)]

    def to_dict(self) -> dict[str, Any]:
        """Plain JSON: coefficients, scores and how each fit ended."""
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
        return {"models": models, "units": self.unit, "joints": list(self.joint_names)}


def compare(
    plant: PendulumChain | LinearAxis,
    models: Sequence[str],
    train: Sequence[Recording],
    held_out: Sequence[Recording] = (),
    *,
    initial_states: InitialStates | None = None,
    horizons: Sequence[float] = HORIZONS,
    on_stage: Callable[[str], None] | None = None,
    on_step: Callable[[str], None] | None = None,
    **fit_settings: Any,
) -> Comparison:
    """Fit models one after the other and score each on every recording.

    Args:
        plant: the mechanism as given.
        models: names of models, simple ones first: a later model starts from the plant terms of
            the one before, a neuro-fuzzy one from the constant fit of its law.
        train: recordings to fit.
        held_out: recordings to judge by; never seen by a fit.
        initial_states: q0 and qd0 by recording name, in the recording's convention.
        horizons: window lengths of the scores [s].
        on_stage, on_step: told what is being done, for a progress display.
        fit_settings: see `fit`.

    Raises:
        ValueError: if a recording is both trained on and held out, or names are not unique.
    """
    names = [r.name for r in (*train, *held_out)]
    if not models or not train:
        raise ValueError("at least one model and one training recording are needed.")
    repeated = sorted({n for n in names if names.count(n) > 1})
    if repeated:
        raise ValueError(f"recordings must have different names, {', '.join(repeated)} repeats.")
    say = on_stage or (lambda _: None)
    fits: dict[str, Fit] = {}
    for name in dict.fromkeys(models):
        model = model_by_name(name)(plant.joints)
        start = _nearest(fits, model)
        say(f"fit {name}")
        fits[name] = fit(
            model, plant, list(train), start=start,
            motions=None if start is None else start.motions,
            callback=None if on_step is None else lambda stage, _: on_step(stage),
            **fit_settings,
        )  # fmt: skip
    first = next(iter(fits.values()))
    scored: tuple[dict[str, list[Score]], dict[str, list[Score]]] = ({}, {})
    states = initial_states or {}
    for name in (NO_FRICTION, *fits):
        found = fits.get(name)
        say(f"score {name}")
        for scores, recordings in zip(scored, (train, held_out), strict=True):
            if recordings:
                scores[name] = [
                    score(
                        (found or first).plant,
                        found.model if found else None,
                        r,
                        initial_state=states.get(r.name),
                        horizons=horizons,
                    )
                    for r in recordings
                ]
    return Comparison(fits, *scored, unit=plant.unit, joint_names=tuple(plant.joint_names))


def coefficient_summary(model: FrictionModel) -> dict[str, Any]:
    """Coefficients by name: a value a joint, or what a schedule deviates from."""
    schedule = model.schedule
    names = schedule.coefficient_names
    if isinstance(schedule, Constant):
        return {n: schedule.values[:, k].tolist() for k, n in enumerate(names)}
    assert isinstance(schedule, NeuroFuzzy)
    reference = schedule.reference_coefficients().detach()
    return {"reference": {n: reference[:, k].tolist() for k, n in enumerate(names)}}


def _nearest(fits: Mapping[str, Fit], model: FrictionModel) -> Fit | None:
    """The fit to start from: the constant one of the same law, else the last."""
    for found in fits.values():
        if found.model.law == model.law and isinstance(found.model.schedule, Constant):
            return found
    return list(fits.values())[-1] if fits else None

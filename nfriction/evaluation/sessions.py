"""Friction over many sessions or units of one machine: the mean, and the spread between them.

Every session is fitted separately, so a thousand recordings need the memory of one per process. A
random-effects model then combines the estimates: each session has its own friction, drawn from a
normal distribution whose mean and spread are estimated (Paule and Mandel 1982, J. Res. NBS 87,
p. 377), and the interval for the next session accounts for both (Higgins, Thompson and
Spiegelhalter 2009, J. R. Stat. Soc. A 172, p. 137).
"""

import copy
import math
import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias

import numpy as np
import torch

from nfriction.evaluation.parallel import INTERRUPTED, Progress, as_completed, check_jobs
from nfriction.fitting.data.inputs import as_model, refuse_repeated
from nfriction.fitting.fit import fit
from nfriction.fitting.result.fit_result import Usability
from nfriction.friction.models import FrictionModel
from nfriction.plant import Plant, rigs
from nfriction.recording import Array, Recording, RecordingLike

if TYPE_CHECKING:
    import pandas as pd

Session: TypeAlias = RecordingLike | Sequence[RecordingLike]


class SessionFit(NamedTuple):
    """Estimates of one session.

    `values` and standard deviations of the coefficients and plant terms are by name, the latter
    infinite where the session does not determine them; the `residual` is the root mean square
    position error of its windows [rad; m]; the rating is that of `FitResult.usability`.
    """

    values: dict[str, float]
    sd: dict[str, float]
    residual: float
    status: str
    usability: tuple[Usability, str]
    warnings: tuple[str, ...]
    v_smooth: float  # width of the smoothed sign of the velocity [rad/s; m/s]


@dataclass(frozen=True)
class Spread:
    """A parameter over all sessions."""

    name: str
    mean: float
    between: float  # standard deviation between sessions, beyond what their own errors explain
    low: float  # ends of the 95 % confidence interval of the mean
    high: float
    next_low: float  # ends of the 95 % prediction interval of the next session's value
    next_high: float
    sessions: int  # number of sessions that determine it


@dataclass(frozen=True, eq=False)
class SessionsResult:
    """Friction of a machine over its sessions.

    Attributes:
        spreads: mean, spread and intervals of each parameter, over the sessions that have it.
        failed: reason by session that could not be fitted, or whose fit is not to be used; its
            values do not count.
    """

    model: FrictionModel
    spreads: tuple[Spread, ...]
    fits: Mapping[str, SessionFit]
    failed: Mapping[str, str]

    def to_pandas(self) -> "pd.DataFrame":
        """Table with one row per parameter."""
        import pandas as pd  # slow to import

        return pd.DataFrame([vars(s) for s in self.spreads]).set_index("name")


def fit_sessions(
    model: FrictionModel | str,
    plant: Plant | str | Path,
    sessions: Mapping[str, Session],
    *,
    jobs: int = 1,
    progress: Progress | None = None,
    **fit_settings: Any,
) -> SessionsResult:
    """Fit a constant model to every session, and its spread between sessions.

    Args:
        model: with constant coefficients, which stays as it is; or its name.
        plant: the mechanism as given, its name, or the path of a rig file; the same for all.
        sessions: recordings, or paths of recordings, by session: a day, a temperature, a unit. A
            path is read to refuse repeated recordings, and again in the process that fits it, so
            memory does not grow with their number.
        jobs: processes, -1 for one per core; with `joblib.parallel_config(backend="dask")`
            those of a cluster.
        progress: receives the labels.
        **fit_settings: as for `fit`.

    Returns:
        Means, spreads and intervals. Sessions that cannot be fitted, or whose fit is rated "do not
        use", are listed, not fatal; so are those that a Ctrl-C leaves out after three fits.

    Raises:
        TypeError: if model, plant or recordings have another type.
        ValueError: for fewer than 3 sessions, a recording given twice, coefficients that follow the
            motion, or if fewer than 3 sessions could be fitted.
        ImportError: if `jobs` needs joblib and it is not installed.
    """
    check_jobs(jobs)
    plant = rigs.of(plant)
    mean = copy.deepcopy(as_model(model, plant.joints))
    if mean.schedule.follows_motion:
        raise ValueError("a spread between sessions is estimated for constant coefficients only.")
    if len(sessions) < 3:
        raise ValueError(
            f"a spread needs at least 3 sessions, got {len(sessions)}; `fit` takes recordings of "
            "one session together."
        )
    refuse_repeated(_read(plant, sessions))
    fits: dict[str, SessionFit] = {}
    failed: dict[str, str] = {}
    tasks = {label: (model, plant, session, fit_settings) for label, session in sessions.items()}
    progress = progress or Progress()
    try:
        for label, found in as_completed(_fit_session, tasks, jobs=jobs, progress=progress):
            if isinstance(found, str):
                failed[label] = found
            else:
                fits[label] = found
    except KeyboardInterrupt:
        if len(fits) < 3:
            raise
        progress.resume()
        failed |= {label: INTERRUPTED for label in sessions if label not in {**fits, **failed}}
    if len(fits) < 3:
        first = next(iter(failed.items()))
        raise ValueError(
            f"{len(failed)} of {len(sessions)} sessions could not be fitted, and a spread needs 3; "
            f"{first[0]}: {first[1]}"
        )
    # In the order given, whichever ended first.
    fits = {label: fits[label] for label in sessions if label in fits}
    names = dict.fromkeys(name for f in fits.values() for name in f.values)
    having = {name: [f for f in fits.values() if name in f.values] for name in names}
    spreads = tuple(
        random_effects(
            name, np.array([f.values[name] for f in of]), np.array([f.sd[name] for f in of])
        )
        for name, of in having.items()
    )
    # Coefficients that are not fitted stay as they are.
    means = {s.name: s.mean for s in spreads}
    own = mean.schedule.parameter_vector().tolist()
    labels = mean.schedule.parameter_names(plant.joint_names)
    vector = [means.get(name, x) for name, x in zip(labels, own, strict=True)]
    mean.schedule.set_parameter_vector(torch.tensor(vector, dtype=torch.float64).nan_to_num(0.0))
    mean.v_smooth = min(f.v_smooth for f in fits.values())
    return SessionsResult(mean.requires_grad_(False), spreads, fits, failed)


def _read(plant: Plant, sessions: Mapping[str, Session]) -> Iterator[Recording]:
    """Recordings of the sessions that can be read, those of one in memory at a time."""
    for label, session in sessions.items():
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # the fit repeats them
            try:
                recordings = Recording.many(session, plant=plant)
            except (ValueError, OSError):
                continue
        # Repeats within a session are a matter of its fit.
        for recording in {r.digest(): r for r in recordings}.values():
            name = f"{recording.name or 'a recording'} of session {label}"
            yield recording._replace(name=name)


def _fit_session(
    model: FrictionModel | str, plant: Plant, session: Session, settings: dict[str, Any]
) -> SessionFit | str:
    """Estimates from a session, or the reason why there are none."""
    try:
        found = fit(copy.deepcopy(model), plant, session, **settings)
    except (ValueError, OSError, ArithmeticError, RuntimeError) as error:
        return str(error)
    rating, reason = found.usability
    if rating == "do not use":
        return f"{rating}: {reason}"
    # Motions and residuals are not returned: a thousand of them would fill the memory.
    unknown = set(" with ".join(found.unidentifiable).split(" with "))
    return SessionFit(
        {i.name: i.value for i in found.intervals},
        {i.name: math.inf if i.name in unknown else i.sd for i in found.intervals},
        found.residual,
        found.status,
        (rating, reason),
        found.warnings,
        found.model.v_smooth,
    )


def random_effects(name: str, values: Array, sd: Array) -> Spread:
    """Mean and spread of estimates, one per session, with known errors; infinite ones do not count.

    The spread is the one at which the weighted squares of the deviations sum to their expectation,
    the number of estimates less one.
    """
    from scipy.optimize import brentq  # slow to import
    from scipy.stats import t as student

    known = np.isfinite(sd)
    values, variance = values[known], sd[known] ** 2
    count = len(values)
    if count < 3:
        nan, inf = math.nan, math.inf
        return Spread(name, nan, nan, -inf, inf, -inf, inf, count)
    # Estimates without an error, at a bound, would get all the weight.
    variance = np.maximum(variance, 1e-12 * max(float(variance.max()), np.finfo(float).tiny))

    def excess(between: float) -> float:
        weight = 1 / (variance + between)
        mean = weight @ values / weight.sum()
        return float(weight @ (values - mean) ** 2) - (count - 1)

    largest = float(values.var(ddof=1)) + float(variance.max())
    between = 0.0 if excess(0.0) <= 0 else brentq(excess, 0.0, 10 * largest)
    weight = 1 / (variance + between)
    mean = float(weight @ values / weight.sum())
    error = 1 / float(weight.sum())
    reach = float(student.ppf(0.975, count - 1)) * math.sqrt(error)
    # One degree of freedom less, as the spread is estimated.
    ahead = float(student.ppf(0.975, count - 2)) * math.sqrt(between + error)
    limits = mean - reach, mean + reach, mean - ahead, mean + ahead
    return Spread(name, mean, math.sqrt(between), *limits, count)

"""Printed tables and verdicts of fits and comparisons."""

import math
from collections.abc import Sequence

from nfriction.cli.console import one_line
from nfriction.evaluation import tables
from nfriction.evaluation.compare import NO_FRICTION, Comparison, coefficients_by_set
from nfriction.evaluation.cross_validation import Selection
from nfriction.evaluation.lead_in import DRAWS, LEAD_IN, ZERO_IN
from nfriction.fitting.options import DEFAULTS
from nfriction.fitting.result.fit_result import FitResult
from nfriction.friction.models import FrictionModel

LEGEND = (
    "free run: one simulation over the whole recording; windows: simulations restarted every 1, 2 "
    "or 5 s,\nover all joints; each starts from the state that its model estimates from the "
    f"{LEAD_IN:g} s before it,\nor from a given one; error reduction: of the "
    "free run, relative to no friction on the rig\nas given; limit of these data: largest error of "
    f"{DRAWS} simulations with noise in start and torque, plus the\nerror of the integration; "
    "=: differs from the smallest error by less than that limit"
)


def error_tables(comparison: Comparison) -> str:
    """Errors of every model, in thousandths of the unit, and their reduction in percent."""
    parts = []
    for part in comparison.parts:
        lines = [str(tables.error_table(comparison, part))]
        names = (s.recording for s in next(iter(comparison.scores(part).values())))
        # The names of the recordings belong to the caption, the first line.
        lines[0] = lines[0].replace("\n", f": {', '.join(names)}\n", 1)
        for horizon, short in comparison.too_short(part).items():
            lasts = ", ".join(f"{name} lasts {duration:.3g} s" for name, duration in short.items())
            lines.append(f"windows of {horizon} s: none, {lasts}")
        nearest = comparison.nearest(part)
        for scored in comparison.scores(part)[nearest]:
            if scored.zero is not None:
                zero = ", ".join(f"{1e3 * x:.3g}" for x in scored.zero)
                lines.append(
                    f"{scored.recording}: zero of the encoders at {zero} m{comparison.unit} by "
                    f"{nearest}, estimated from the first {ZERO_IN:g} s, which is not scored"
                )
        parts.append("\n".join(lines))
    return "\n\n".join([*parts, LEGEND])


def fit_lines(name: str, fit: FitResult, rating: tuple[str, str]) -> str:
    """Rating, status and warnings of a fit."""
    verdict, reason = rating
    note = f"; at a bound: {', '.join(fit.at_bounds)}" if fit.at_bounds else ""
    head = f"{verdict} ({reason})" if reason else verdict
    beside = [warning for warning in fit.warnings if warning not in fit.status]
    lines = [f"{name}: {head}. {fit.status.rstrip('.')}{note}", *beside]
    return "\n  - ".join(map(one_line, lines))


def interval_table(fit: FitResult) -> str:
    """Values and 95 % intervals of constant coefficients and the plant's terms; empty of others."""
    names = fit.names_with_si()
    rows = [(names.get(i.name, i.name), i.value, i.low, i.high) for i in fit.intervals]
    name, plant = type(fit.model).__name__, bool(fit.plant_terms)
    table = tables.interval_table(name, rows, plant, fit.warnings)
    return str(table) if rows else ""


def choice(selection: Selection) -> str:
    """The model that training data alone would choose, why, and the error of each."""
    return (
        f"training data alone would choose {selection.chosen}: {selection.reason}\n"
        f"{tables.selection_table(selection)}"
    )


def verdict(comparison: Comparison) -> str:
    """The model that predicts best, in a sentence or two."""
    best = comparison.best()
    if not comparison.test:
        return "no verdict: there was no test recording; give some with --test"
    if best is None:
        return "no verdict: every free run over the test recordings diverged"
    over = comparison.judged_over()
    error = 1e3 * comparison.table(over)["all"][best]
    run = f"windows of {over} s, as the free run is chaotic," if over else "free run"
    end = "; no model is better" if best == NO_FRICTION else ""
    tied, limit = comparison.indistinguishable(), comparison.limit(over)
    times = 1e-3 * error / (limit or math.inf)
    above = ""
    if times > DEFAULTS.model_error_ratio:
        above = f", {times:.0f} times the limit of these data"
    found = (
        f"best on test recordings: {best} ({run} over all joints: {error:.3g} "
        f"m{comparison.unit}{above}){end}"
    )
    # Without a limit no difference can be called insignificant.
    if len(tied) > 1 and limit is not None:
        rated = {n: f" ({comparison.rating(n)[0]})" for n in comparison.fits}
        others = ", ".join(f"{name}{rated.get(name, '')}" for name in tied if name != best)
        found += (
            f"\nstatistically tied with {others} (differences below the limit of these data, "
            f"{1e3 * limit:.3g} m{comparison.unit}, are not meaningful); the simplest of them is "
            f"{tied[0]}"
        )
    unfit = comparison.unfit().items()
    return found + "".join(f"\nnot fit for use: {name}: {why}" for name, why in unfit)


def coefficient_table(model: FrictionModel, joint_names: Sequence[str], unit: str) -> str:
    """Coefficients by joint with their units, and by range of validity if they have several."""
    joints = list(joint_names) or [f"joint{k + 1}" for k in range(model.joints)]
    sets, units = coefficients_by_set(model), tables.coefficient_units(model, unit)
    return str(tables.coefficient_table(type(model).__name__, joints, sets, units))

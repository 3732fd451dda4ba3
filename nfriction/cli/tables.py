"""What commands print of fits and comparisons, as text."""

from collections.abc import Sequence

import numpy as np
import pandas as pd

from nfriction.evaluation.compare import NO_FRICTION, Comparison
from nfriction.evaluation.cross_validation import Selection
from nfriction.fitting.result.fit_result import FitResult
from nfriction.friction.models import FrictionModel
from nfriction.io.model_info import ModelInfo, describe

LEGEND = (
    "free run: one simulation over the whole recording; windows: simulations restarted so often "
    "from the\nmeasured motion, over all joints; saved: how much less the free-run error is than "
    "with no friction,\nwhich is simulated on the rig as given"
)


def error_tables(comparison: Comparison) -> str:
    """Errors of every model, in thousandths of the unit, and what was saved in percent."""
    kinds = [kind for kind in (True, False) if (comparison.train, comparison.held_out)[kind]]
    return "\n\n".join([*(_error_table(comparison, kind) for kind in kinds), LEGEND])


def _error_table(comparison: Comparison, held_out: bool) -> str:
    scores = next(iter(comparison.scores(held_out=held_out).values()))
    free_run = 1e3 * comparison.table(held_out=held_out)
    if len(comparison.joint_names) == 1:
        free_run = free_run[["all"]]
    columns = {("free run", name): free_run[name] for name in free_run}
    columns |= {
        ("windows", f"{h} s"): 1e3 * comparison.table(h, held_out=held_out)["all"]
        for h in comparison.horizons(held_out=held_out)
    }
    columns["saved", "%"] = comparison.improvement(held_out=held_out)["all"]
    table = pd.DataFrame(columns)
    table.index.name = None
    kind = "held out" if held_out else "trained on"
    lines = [
        f"position RMSE [m{comparison.unit}], {kind}: {', '.join(s.recording for s in scores)}",
        table.to_string(float_format=lambda x: f"{x:.4g}" if np.isfinite(x) else "diverged"),
    ]
    floor = comparison.floor(held_out=held_out)
    if floor is not None:
        lines.append(
            f"floor of the free run: {1e3 * floor:.4g}, which one encoder count at the start makes"
        )
    for horizon, short in comparison.too_short(held_out=held_out).items():
        lasts = ", ".join(f"{name} lasts {duration:.3g} s" for name, duration in short.items())
        lines.append(f"windows of {horizon} s: none, {lasts}")
    return "\n".join(lines)


def fit_lines(name: str, fit: FitResult) -> str:
    """How a fit ended and what to be wary of: bounds, lost directions, errors of the model."""
    note = f"; at a bound: {', '.join(fit.at_bounds)}" if fit.at_bounds else ""
    return "\n  - ".join([f"{name}: {fit.status.rstrip('.')}{note}", *fit.warnings])


def interval_table(fit: FitResult) -> str:
    """Values and 95 % intervals of constant coefficients and of the plant's terms; may be empty.

    Terms of the plant are deviations: ratios from 1, offsets in SI.
    """
    if not fit.intervals:
        return ""
    rows = {i.name: (i.value, i.low, i.high) for i in fit.intervals}
    columns = ["value", "low", "high"]
    table = pd.DataFrame.from_dict(rows, orient="index", columns=columns)
    text = table.to_string(float_format=lambda x: f"{x:.4g}" if np.isfinite(x) else "unknown")
    return f"95 % intervals (plant terms: ratios less 1, offsets in SI)\n{text}"


def choice(selection: Selection) -> str:
    """Which model training data alone would choose, why, and the error of each."""
    rows = {
        c.name: (1e3 * c.error, c.parameters, "yes" if c.converged else "no")
        for c in selection.candidates
    }
    columns = [f"error [m{selection.unit}]", "parameters", "converged"]
    table = pd.DataFrame.from_dict(rows, orient="index", columns=columns)
    text = table.to_string(float_format=lambda x: f"{x:.4g}" if np.isfinite(x) else "diverged")
    return (
        f"training data alone would choose {selection.chosen}: {selection.reason}\n"
        f"position RMSE of {selection.horizon:.3g} s simulations over blocks left out\n{text}"
    )


def verdict(comparison: Comparison) -> str:
    """Which model predicts best, in a sentence."""
    best = comparison.best()
    if not comparison.held_out:
        return "no verdict: nothing was held out; give --held-out recordings to judge by"
    if best is None:
        return "no verdict: every free run over the held-out recordings diverged"
    error = 1e3 * comparison.table()["all"][best]
    what = f"{best} (free run over all joints: {error:.3g} m{comparison.unit})"
    end = "; no model earns its place" if best == NO_FRICTION else ""
    told = f"best on held-out recordings: {what}{end}"
    alike, floor = comparison.alike(), comparison.floor()
    if len(alike) < 2 or floor is None:
        return told
    others = ", ".join(name for name in alike if name != best)
    return (
        f"{told}\nwithin the floor, {1e3 * floor:.3g} m{comparison.unit}, it cannot be told from "
        f"{others}; the simplest of them is {alike[0]}"
    )


def coefficient_table(model: FrictionModel, joint_names: Sequence[str], unit: str) -> str:
    """Coefficients by joint with their units, and by what they hold for where that differs."""
    described = describe(model, ModelInfo(unit=unit))["coefficients"]
    joints = list(joint_names) or [f"joint{k + 1}" for k in range(model.joints)]
    sets = model.schedule.coefficient_sets()
    rows = {
        joint if label == "always" else f"{joint}, {label.replace('_', ' ')}": values[k].tolist()
        for k, joint in enumerate(joints)
        for label, values in sets.items()
    }
    columns = [f"{c['name']} [{c['unit']}]" for c in described]
    table = pd.DataFrame.from_dict(rows, orient="index", columns=columns)
    note = "" if "always" in sets else " (they follow the motion)"
    text = table.to_string(float_format=lambda x: f"{x:.4g}")
    return f"coefficients of {type(model).__name__}{note}\n{text}"

"""Draw a run as one self-contained HTML page.

The wording and layout of the page are in `templates/page.html.j2`; here are the tables and other
values that it shows.
"""

import base64
import hashlib
import math
import re
import shlex
from collections.abc import Iterator, Sequence
from importlib import resources
from typing import Any

import jinja2
from markupsafe import Markup

from nfriction.evaluation.compare import LIMIT, NO_FRICTION, PART_NAMES
from nfriction.evaluation.tables import (
    Table,
    Value,
    coefficient_table,
    coefficient_units,
    error_table,
    interval_table,
    selection_table,
)
from nfriction.io.model_info import ModelInfo
from nfriction.report.figures import with_dark_twins
from nfriction.report.rules import JointRules, rules_in_words
from nfriction.report.run import Run
from nfriction.version import __version__

_TEMPLATES = resources.files("nfriction.report") / "templates"
_JINJA = jinja2.Environment(
    loader=jinja2.FunctionLoader(lambda name: (_TEMPLATES / name).read_text(encoding="utf-8")),
    autoescape=True,
    undefined=jinja2.StrictUndefined,
    trim_blocks=True,
    lstrip_blocks=True,
)
_JINJA.filters["four"] = lambda value: f"{value:.4g}"
# JavaScript reads Infinity where Python writes inf.
_JINJA.filters["sortable"] = lambda value: (
    "Infinity" if math.isnan(value) else str(value).replace("inf", "Infinity")
)


def to_html(run: Run) -> str:
    """A run as one HTML document without any reference to the outside.

    Everything from the folder is escaped, and the page's own policy lets only its own script and
    style run.
    """
    style, script = (
        (_TEMPLATES / name).read_text(encoding="utf-8") for name in ("page.css", "page.js")
    )
    comparison = run.comparison
    error = {}
    if run.best is not None:
        error = (1e3 * comparison.table(part=comparison.parts[0])["all"]).to_dict()
    info = next((info for _, info in run.models.values()), None)
    page: str = _JINJA.get_template("page.html.j2").render(
        run=run,
        title=f"Friction models: {run.folder.resolve().name}",
        style=Markup(style),
        script=Markup(script),
        policy=_policy(style, script),
        version=__version__,
        no_friction=NO_FRICTION,
        error=error,
        info=info,
        tables={
            "errors": [error_table(comparison, part) for part in comparison.parts],
            "recordings": _recording_table(run),
            "selection": run.selection and selection_table(run.selection),
            "data": _data_table(run),
            "ranges": info and _range_table(info, comparison.joint_names, comparison.unit),
        },
        figures=list(with_dark_twins(run.figures)),
        fit_articles=[_fit(run, name) for name in run.fits],
        fuzzy_models=list(_fuzzy_models(run)),
        commands=_commands(run),
    )
    return page.lstrip() + "\n"


def _policy(style: str, script: str) -> str:
    """Only this style and this script, and pictures that are in the page."""
    # Hashes, as "unsafe-inline" would let injected code run.
    of_style, of_script = (
        base64.b64encode(hashlib.sha256(t.encode()).digest()).decode() for t in (style, script)
    )
    return (
        f"default-src 'none'; img-src data:; style-src 'sha256-{of_style}'; "
        f"script-src 'sha256-{of_script}'; base-uri 'none'; form-action 'none'"
    )


def _fit(run: Run, name: str) -> dict[str, Any]:
    """The record of a fit, its warnings and its tables."""
    fit, joints = run.fits[name], run.comparison.joint_names
    warnings = [*fit.warnings]
    for what, names in (("At a bound", fit.at_bounds), ("Not identifiable", fit.unidentifiable)):
        # Most fits warn of them, and say more.
        silent = [name for name in names if not any(name in warning for warning in fit.warnings)]
        if silent:
            warnings.append(f"{what}: {'; '.join(silent)}.")
    tables = []
    sets = run.coefficients.get(name, {})
    if sets:
        tables.append(coefficient_table(name, joints, sets, _units(run, name)))
    known = fit.plant | {
        f"{coefficient} of {joint}": value
        for coefficient, values in sets.get("always", {}).items()
        for joint, value in zip(joints, values, strict=True)
    }
    intervals = [
        # An open end is infinite, whichever it is.
        (what, known.get(what, math.nan), low if math.isfinite(low) else -math.inf, high)
        for what, (low, high) in fit.intervals.items()
    ]
    if intervals:
        tables.append(interval_table(name, intervals, bool(fit.plant)))
    return {
        "name": name,
        "record": fit,
        # The page shows convergence by a badge; the status would repeat it.
        "reason": re.sub(r"^(not )?converged\W*", "", fit.status, flags=re.IGNORECASE),
        # Several fits of a chain may pass on the same warning.
        "warnings": list(dict.fromkeys(warnings)),
        "tables": tables,
    }


def _units(run: Run, model: str) -> dict[str, str]:
    """Unit of each coefficient, where the model's file is there."""
    if model not in run.models:
        return {}
    return coefficient_units(run.models[model][0], run.comparison.unit)


def _fuzzy_models(run: Run) -> Iterator[dict[str, Any]]:
    """Models with rules; the tables of each joint read as sentences."""
    unit = run.comparison.unit
    for name, (model, _) in run.models.items():
        fuzzy = model.schedule.fuzzy_rules()
        if fuzzy is None:
            continue
        heads = [f"{coefficient} = [{u}]" for coefficient, u in _units(run, name).items()]
        joints = []
        for of in rules_in_words(model, run.comparison.joint_names):
            rows: list[tuple[Value, ...]] = [
                (f"{rule.condition} THEN", *rule.values) for rule in of.rules
            ]
            caption = f"{name}, {of.joint}: {len(rows)} rules"
            rules = Table(caption, ("rule", *heads), tuple(rows))
            joints.append({"rules": rules, "terms": _term_table(of, name, unit)})
        yield {"name": name, "along_motion": fuzzy.along_motion, "joints": joints}


def _term_table(of: JointRules, model: str, unit: str) -> Table:
    rows = tuple(
        (f"{quantity}: {term.name}", term.centre, term.width, u)
        for quantity, terms, u in (
            ("velocity", of.velocity, f"{unit}/s"), ("acceleration", of.acceleration, f"{unit}/s²")
        )
        for term in terms
    )  # fmt: skip
    caption = f"{model}, {of.joint}: meaning of the words"
    return Table(caption, ("word", "middle", "standard deviation", "unit"), rows)


def _recording_table(run: Run) -> Table:
    """The free-run error of every model on every recording, beside the limit of these data."""
    rows: list[tuple[Value, ...]] = []
    for part in run.comparison.parts:
        for model, scores in run.comparison.scores(part).items():
            for s in scores:
                limit = math.nan if s.limit is None else 1e3 * s.limit.free_run.all
                at = "no" if math.isinf(s.diverged_at) else f"at {s.diverged_at:.3g} s"
                rows.append((s.recording, model, part, 1e3 * s.free_run.all, limit, at))
    unit = run.comparison.unit
    return Table(
        "Every recording: free run over all joints",
        ("recording", "model", "part", f"RMSE [m{unit}]", f"{LIMIT} [m{unit}]",
         "diverged"),
        tuple(rows), "diverged",
    )  # fmt: skip


def _data_table(run: Run) -> Table:
    rows = tuple(
        (name, PART_NAMES[part].removesuffix("s"), digest[:16])
        for part in reversed(PART_NAMES)
        for name, digest in run.recordings[part].items()
    )
    return Table("Recordings", ("recording", "part", "SHA-256 of its samples, in part"), rows)


def _range_table(info: ModelInfo, joints: Sequence[str], unit: str) -> Table | None:
    """Trained range of velocity and acceleration; None where the file has none of that form."""
    columns: list[str] = []
    ends: list[list[float]] = []
    for key, quantity, u in (("qd", "velocity", "s"), ("qdd", "acceleration", "s²")):
        pairs: Any = info.input_ranges.get(key)
        if _are_pairs(pairs, len(joints)):
            columns += [f"{quantity} {end} [{unit}/{u}]" for end in ("from", "to")]
            ends += [[float(pair[k]) for pair in pairs] for k in range(2)]
    if not ends:
        return None
    rows = tuple(zip(joints, *ends, strict=True))
    return Table("Motion that the models were trained on", ("joint", *columns), rows)


def _are_pairs(value: Any, joints: int) -> bool:
    return (
        isinstance(value, list)
        and len(value) == joints
        and all(isinstance(pair, list) and len(pair) == 2 for pair in value)
        and all(isinstance(x, (int, float)) for pair in value for x in pair)
    )


def _commands(run: Run) -> list[str]:
    lines = [shlex.join(["nfriction", "report", str(run.folder)])]
    # Without a readable model file there is nothing to export.
    if run.best in run.models:
        file = str(run.folder / "models" / f"{run.best}.json")
        lines.append(shlex.join(["nfriction", "info", file]))
        lines.append(shlex.join(["nfriction", "export", file, "--format", "c"]))
    return lines

"""Draw a run as one self-contained HTML page, with the rules of neuro-fuzzy models in words.

The wording and layout of the page are in `templates/page.html.j2`; here are the tables and other
values that it shows.
"""

import base64
import hashlib
import math
import shlex
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any

import jinja2
import numpy as np
from markupsafe import Markup

from nfriction.evaluation import tables
from nfriction.evaluation.compare import LIMIT, NO_FRICTION, PART_NAMES
from nfriction.evaluation.lead_in import DRAWS, LEAD_IN
from nfriction.friction import both_names
from nfriction.friction.heat import FALL, HEAT
from nfriction.friction.models import FrictionModel
from nfriction.io.files import write_atomically
from nfriction.io.model_file import ModelInfo
from nfriction.report.run import Figure, Run, read_run
from nfriction.version import __version__

_SPEEDS = {
    1: ("any",),
    2: ("slow", "fast"),
    3: ("slow", "medium", "fast"),
    4: ("very slow", "slow", "fast", "very fast"),
    5: ("very slow", "slow", "medium", "fast", "very fast"),
}
_SIZES = ("", "strongly ", "very strongly ")


@dataclass(frozen=True)
class Term:
    """A fuzzy set of an input in SI: name, centre held in the trained range, standard deviation."""

    name: str
    centre: float
    width: float


@dataclass(frozen=True)
class Rule:
    """One rule: the names of its terms, and the coefficients at their centres in SI units.

    The values are those of the whole model, including neighbouring rules and radial basis head.
    """

    velocity: str
    acceleration: str
    values: tuple[float, ...]

    def sentence(self, coefficients: Sequence[tuple[str, str]]) -> str:
        """The rule in words; `coefficients` are names and units, those of heat unused."""
        then = " AND ".join(
            f"{name} = {value:.4g} {unit}".rstrip()
            for (name, unit), value in zip(coefficients, self.values, strict=False)
        )
        return f"{self.condition} THEN {then}"

    @property
    def condition(self) -> str:
        """The rule's premise in words."""
        return f"IF velocity is {self.velocity} AND acceleration is {self.acceleration}"


@dataclass(frozen=True)
class JointRules:
    """Sets and rules of one joint; in the list of rules the acceleration varies faster."""

    joint: str
    velocity: tuple[Term, ...]
    acceleration: tuple[Term, ...]
    rules: tuple[Rule, ...]


def rules_in_words(model: FrictionModel, joint_names: Sequence[str] = ()) -> list[JointRules]:
    """The rules of a neuro-fuzzy model, joint by joint; none for a model without rules.

    Sets are named by their order and the position of zero. Acceleration is that along the motion
    (braking, speeding up) unless the model takes it signed.

    Args:
        joint_names: default joint1, joint2, ...

    Raises:
        ValueError: if there is not one name per joint.
    """
    fuzzy = model.schedule.fuzzy_rules()
    if fuzzy is None:
        return []
    names = tables.joint_labels(joint_names or None, model.joints)
    varied = sum(c not in (FALL, HEAT) for c in model.law.coefficients)  # heat is last
    described = []
    for j, joint in enumerate(names):
        (speeds, speed_widths), (accelerations, widths) = (
            (c[j].tolist(), w[j].tolist()) for c, w in zip(fuzzy.centres, fuzzy.widths, strict=True)
        )
        # There are no words for more than five.
        numbered = [f"speed {k + 1}" for k in range(len(speeds))]
        names_v = _in_order(speeds, _SPEEDS.get(len(speeds), numbered))
        names_a = _acceleration_names(sorted(accelerations), fuzzy.along_motion)
        names_a = _in_order(accelerations, names_a)
        ends = zip(fuzzy.centres, fuzzy.lower[j], fuzzy.upper[j], strict=True)
        held_v, held_a = (c[j].clamp(low, high).tolist() for c, low, high in ends)
        v = tuple(map(Term, names_v, held_v, speed_widths))
        a = tuple(map(Term, names_a, held_a, widths))
        # In the order of the rule table the acceleration varies faster.
        pairs = [(x.name, y.name) for x in v for y in a]
        values = fuzzy.coefficients[j, :, :varied].tolist()
        rules = [Rule(*pair, tuple(of)) for pair, of in zip(pairs, values, strict=True)]
        described.append(JointRules(joint, v, a, tuple(rules)))
    return described


def _acceleration_names(ordered: Sequence[float], along_motion: bool) -> list[str]:
    below, above = ("braking", "speeding up") if along_motion else ("negative", "positive")
    # The set nearest to zero, because after training none may lie exactly there.
    zero = min(range(len(ordered)), key=lambda k: abs(ordered[k]))
    return [
        *(_size(zero - k) + below for k in range(zero)),
        "about zero",
        *(_size(k - zero) + above for k in range(zero + 1, len(ordered))),
    ]


def _size(rank: int) -> str:
    return _SIZES[rank - 1] if rank <= len(_SIZES) else f"{rank} times "


def _in_order(centres: Sequence[float], names: Sequence[str]) -> list[str]:
    """Names from the lowest centre to the highest, in the order of the centres."""
    # Training may move sets past each other.
    order = sorted(range(len(centres)), key=lambda k: centres[k])
    named = dict(zip(order, names, strict=True))
    return [named[k] for k in range(len(centres))]


# In the order of the page: friction and errors first, then motions, then details of the models.
_CAPTIONS = {
    "torque_over_velocity": "Friction torque over velocity: the models' laws with their 95 % bands "
    "at the median load, over the torque that the recorded motion implies, averaged over 30 ms, "
    "and its medians",
    "rmse_test": "Position error by model and joint, test recordings",
    "horizons_test": "Position error over the length of the simulation, test recordings; the band "
    "is the limit of these data, the effect of noise in start and torque and of the integration",
    "rmse_train": "Position error by model and joint, training recordings",
    "horizons_train": "Position error over the length of the simulation, training recordings",
    "mechanism": "The mechanism as the rig file describes it",
    "motion_": "Measured (grey) and simulated motion of the best model, test recording ",
    "positions_test_": "Measured and simulated position with the error below, test: ",
    "positions_train_": "Measured and simulated position with the error below, training: ",
    "friction": "Friction torque over velocity: rows, their medians with quartiles in bins of "
    "velocity, the laws, and the 95 % band of the law chosen",
    "over_time_": "Coefficients along the first training recording, models of the law: ",
    "coefficients_": "Coefficients over velocity and acceleration (hatched: no data; faded: "
    "uncertain; lines enclose 50 % and 90 % of the samples) of ",
    "sections_": "Coefficients over velocity at three accelerations, with 95 % intervals (faint: "
    "no data) of ",
    "memberships_": "Fuzzy sets of velocity and acceleration of ",
}

_TEMPLATES = resources.files("nfriction.report") / "templates"
_JINJA = jinja2.Environment(
    loader=jinja2.FunctionLoader(lambda name: (_TEMPLATES / name).read_text(encoding="utf-8")),
    autoescape=True,
    undefined=jinja2.StrictUndefined,
    trim_blocks=True,
    lstrip_blocks=True,
)
_JINJA.filters["four"] = lambda value: f"{value:.0f}" if 1e3 <= value < 1e7 else f"{value:.4g}"
_JINJA.filters["both"] = both_names
# JavaScript reads Infinity where Python writes inf.
_JINJA.filters["sortable"] = lambda value: (
    "Infinity" if math.isnan(value) else str(value).replace("inf", "Infinity")
)


def to_html(run: Run) -> str:
    """A run as one HTML document without external references.

    Everything from the folder is escaped, and the page's content policy allows only its own script
    and style.
    """
    comparison = run.comparison
    error = {}
    if run.best is not None:
        part = comparison.parts[0]
        over = comparison.judged_over() if part == "test" else None
        error = (1e3 * comparison.table(over, part=part)["all"]).to_dict()
    info = next((info for _, info in run.models.values()), None)
    return document(
        "page.html.j2",
        f"Friction models: {run.folder.resolve().name}",
        run=run,
        run_id=run.id,
        no_friction=NO_FRICTION,
        lead_in=LEAD_IN,
        draws=DRAWS,
        error=error,
        info=info,
        tables={
            "errors": [tables.error_table(comparison, part) for part in comparison.parts],
            "recordings": _recording_table(run),
            "selection": run.selection and tables.selection_table(run.selection),
            "data": _data_table(run),
            "ranges": info and _range_table(info, comparison.joint_names, comparison.unit),
        },
        figures=pictures(run.figures),
        fit_articles=[_fit(run, name) for name in run.fits],
        fuzzy_models=list(_fuzzy_models(run)),
        commands=_commands(run),
        cards=_cards(run),
    )


def document(template: str, title: str, **values: Any) -> str:
    """A page from a template of this folder, with its style, script and policy."""
    style, script = (
        (_TEMPLATES / name).read_text(encoding="utf-8") for name in ("page.css", "page.js")
    )
    page: str = _JINJA.get_template(template).render(
        {"run_id": ""} | values,
        title=title,
        style=Markup(style),
        script=Markup(script),
        policy=_policy(style, script),
        version=__version__,
    )
    return page.lstrip() + "\n"


def write_report(folder: str | Path, path: str | Path) -> Run:
    """Write the page of a comparison's folder to a file; returns the run, as `read_run` does."""
    run = read_run(folder)
    # A recording's name may come from a file name that is not valid UTF-8.
    write_atomically(path, to_html(run).encode(errors="backslashreplace"))
    return run


def pictures(figures: Sequence[Figure]) -> list[dict[str, Any]]:
    """Figures as URLs, in the order of the page."""
    found = []
    for figure in figures:
        name = figure.name
        rank, caption = len(_CAPTIONS), name.replace("_", " ")
        for k, (prefix, words) in enumerate(_CAPTIONS.items()):
            if name == prefix or (prefix.endswith("_") and name.startswith(prefix)):
                rank, caption = k, words + name.removeprefix(prefix)
        # The first bytes name the format: \x89PNG or GIF89a.
        kind = "gif" if figure.data.startswith(b"GIF") else "png"
        url = f"data:image/{kind};base64,{base64.b64encode(figure.data).decode()}"
        size = {"width": figure.width, "height": figure.height}
        found.append((rank, {"caption": caption, "url": url, **size}))
    return [picture for _, picture in sorted(found, key=lambda pair: pair[0])]


def _policy(style: str, script: str) -> str:
    """Content policy: only this style, this script, and pictures that are in the page."""
    # Hashes, because "unsafe-inline" would let injected code run.
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
        # The warnings of most fits already name them, with more detail.
        silent = [name for name in names if not any(name in warning for warning in fit.warnings)]
        if silent:
            warnings.append(f"{what}: {'; '.join(silent)}.")
    shown = []
    sets = run.coefficients.get(name, {})
    if sets:
        shown.append(tables.coefficient_table(name, joints, sets, _units(run, name)))
    known = fit.plant | {
        f"{coefficient} of {joint}": value
        for of in sets.values()
        for coefficient, values in of.items()
        for joint, value in zip(joints, values, strict=True)
    }
    intervals = [
        (fit.names_with_si.get(what, what), known.get(what, math.nan), low, high)
        for what, (low, high) in fit.intervals.items()
    ]
    if intervals:
        shown.append(tables.interval_table(name, intervals, bool(fit.plant), fit.warnings))
    verdict, why = fit.usability
    return {
        "name": name,
        "record": fit,
        "verdict": verdict,
        "why": why,
        # Fits that start from each other may pass on the same warning.
        "warnings": list(dict.fromkeys(warnings)),
        "tables": shown,
    }


def _cards(run: Run) -> list[dict[str, Any]]:
    """The best model's coefficients of each joint, in words, with their 95 % intervals."""
    best = run.best
    if best is None or best not in run.fits:
        return []
    sets, units = run.coefficients.get(best, {}), _units(run, best)
    cards = []
    # Of a network those along the recordings, if they are known.
    ranges = [of for label, of in sets.items() if "_in_training" in label] or [*sets.values()]
    for j, joint in enumerate(run.comparison.joint_names):
        lines = []
        for name in next(iter(ranges), {}):
            values = [of[name][j] for of in ranges if name in of]
            # A unit stays on the same line as its number.
            unit = f" {units[name]}".replace(" ", "\N{NO-BREAK SPACE}") if name in units else ""
            low, high = run.fits[best].intervals.get(f"{name} of {joint}", (math.nan, math.nan))
            note = ""
            if min(values) < max(values):
                ends = map(tables.four_digits, (min(values), max(values)))
                value = " to ".join(ends) + unit
                note = "follows the motion"
            else:
                value = f"{tables.four_digits(values[0])}{unit}"
                if math.isfinite(low) and math.isfinite(high):
                    note = f"{tables.four_digits(low)} to {tables.four_digits(high)}"
                elif not math.isnan(low):
                    note = "not identifiable"
            lines.append({"name": name, "value": value, "note": note})
        cards.append({"joint": joint, "lines": lines})
    return cards


def _units(run: Run, model: str) -> dict[str, str]:
    """Unit of each coefficient, if the model's file exists."""
    if model not in run.models:
        return {}
    return tables.coefficient_units(run.models[model][0], run.comparison.unit)


def _fuzzy_models(run: Run) -> Iterator[dict[str, Any]]:
    """Models with rules; the tables of each joint read as sentences."""
    unit = run.comparison.unit
    for name, (model, _) in run.models.items():
        fuzzy = model.schedule.fuzzy_rules()
        if fuzzy is None:
            continue
        heads = [f"{coefficient} = [{u}]" for coefficient, u in _units(run, name).items()]
        found = {"name": name, "constant": fuzzy.constant, "along_motion": fuzzy.along_motion}
        if fuzzy.constant:
            yield found
            continue
        joints = []
        in_words = rules_in_words(model, run.comparison.joint_names)
        heads = heads[: len(in_words[0].rules[0].values)]
        fired = run.fits[name].rule_seconds
        for j, of in enumerate(in_words):
            seconds = fired[j] if len(fired) == len(in_words) else ()
            rows: tuple[tuple[tables.Value, ...], ...] = tuple(
                (f"{rule.condition} THEN", *rule.values, *seconds[k : k + 1])
                for k, rule in enumerate(of.rules)
            )
            terms: tuple[tuple[tables.Value, ...], ...] = tuple(
                (f"{quantity}: {term.name}", term.centre, term.width, u)
                for quantity, terms, u in (
                    ("velocity", of.velocity, f"{unit}/s"),
                    ("acceleration", of.acceleration, f"{unit}/s²"),
                )
                for term in terms
            )
            head, columns = f"{name}, {of.joint}", ("word", "centre", "standard deviation", "unit")
            joints.append({
                "rules": tables.Table(
                    f"{head}: {len(rows)} rules",
                    ("rule", *heads, *(["recorded [s]"] if seconds else [])), rows,
                ),
                "terms": tables.Table(f"{head}: meaning of the words", columns, terms),
            })  # fmt: skip
        yield found | {"joints": joints}


def _recording_table(run: Run) -> tables.Table:
    """The free-run error of every model on every recording, with the limit of these data."""
    rows: list[tuple[tables.Value, ...]] = []
    for part in run.comparison.parts:
        for model, scores in run.comparison.scores(part).items():
            for s in scores:
                limit = math.nan if s.limit is None else 1e3 * s.limit.free_run.all
                at = "no" if math.isinf(s.diverged_at) else f"at {s.diverged_at:.3g} s"
                zero = ", ".join(f"{1e3 * x:.3g}" for x in s.zero or ()) or "as recorded"
                rows.append((s.recording, model, part, 1e3 * s.free_run.all, limit, at, zero))
    unit = run.comparison.unit
    return tables.Table(
        "Free runs over all joints, by recording",
        ("recording", "model", "part", f"RMSE [m{unit}]", f"{LIMIT} [m{unit}]",
         "diverged", f"zero of the encoders [m{unit}]"),
        tuple(rows), "diverged",
    )  # fmt: skip


def _data_table(run: Run) -> tables.Table:
    rows = tuple(
        (name, PART_NAMES[part].removesuffix("s"), digest[:16])
        for part in reversed(PART_NAMES)
        for name, digest in run.recordings[part].items()
    )
    return tables.Table("Recordings", ("recording", "part", "digest of its samples"), rows)


def _range_table(info: ModelInfo, joints: Sequence[str], unit: str) -> tables.Table | None:
    """Trained range of velocity and acceleration; None if the file has none in this form."""
    columns: list[str] = []
    ends: list[list[float]] = []
    for key, quantity, u in (("qd", "velocity", "s"), ("qdd", "acceleration", "s²")):
        try:
            pairs = np.array(info.input_ranges.get(key), dtype=np.float64)
        except (ValueError, TypeError, OverflowError):
            continue
        if pairs.shape == (len(joints), 2):
            columns += [f"{quantity} {end} [{unit}/{u}]" for end in ("from", "to")]
            ends += pairs.T.tolist()
    if not ends:
        return None
    rows = tuple(zip(joints, *ends, strict=True))
    return tables.Table("Motion that the models were trained on", ("joint", *columns), rows)


def _commands(run: Run) -> list[str]:
    lines = [shlex.join(["nfriction", "report", str(run.folder)])]
    # Without a readable model file there is nothing to export.
    if run.best in run.models:
        file = str(run.folder / "models" / f"{run.best}.json")
        lines.append(shlex.join(["nfriction", "info", file]))
        lines.append(shlex.join(["nfriction", "export", file, "--format", "c"]))
    return lines

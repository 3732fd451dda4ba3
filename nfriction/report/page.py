"""The report's page: sections of a run, put into one HTML document that needs nothing else."""

import base64
import hashlib
import shlex
from collections.abc import Iterator
from importlib import resources

from nfriction.evaluation.compare import NO_FRICTION
from nfriction.report import tables
from nfriction.report.figures import enlarged, shown
from nfriction.report.markup import Markup, element, joined
from nfriction.report.rules import rules_in_words
from nfriction.report.run import Run
from nfriction.report.tables import Cell, Table
from nfriction.version import __version__


def to_html(run: Run) -> str:
    """A run as one HTML document without any reference to the outside.

    Everything that came from the folder is escaped, and the page's own policy lets only its own
    script and style run.
    """
    title = f"Friction models: {run.folder.resolve().name}"
    style, script = (
        (resources.files("nfriction.report") / "assets" / name).read_text(encoding="utf-8")
        for name in ("page.css", "page.js")
    )
    sections = [s for s in _sections(run) if s is not None]
    contents = element(
        "nav",
        element("ul", *(
            element("li", element("a", heading, href=f"#{anchor}"))
            for anchor, heading, _ in sections
        )),
        aria_label="Contents",
    )  # fmt: skip
    body = [
        element("header", element("h1", title), element("p", *_verdict(run), class_="verdict")),
        contents,
        element("main", *(
            element("section", element("h2", heading, id=anchor), content)
            for anchor, heading, content in sections
        )),
        element("footer", element("p", f"Written by nfriction {__version__}.")),
        enlarged(),
        element("script", Markup(script)),
    ]  # fmt: skip
    head = element(
        "head",
        element("meta", charset="utf-8"),
        element("meta", http_equiv="Content-Security-Policy", content=_policy(style, script)),
        element("meta", name_="viewport", content="width=device-width, initial-scale=1"),
        element("meta", name_="color-scheme", content="light dark"),
        element("title", title),
        element("style", Markup(style)),
    )
    return "<!DOCTYPE html>\n" + element("html", head, element("body", *body), lang="en") + "\n"


def _policy(style: str, script: str) -> str:
    """Only this style and this script, and pictures that are in the page."""
    known = (
        base64.b64encode(hashlib.sha256(t.encode()).digest()).decode() for t in (style, script)
    )
    of_style, of_script = known
    return (
        f"default-src 'none'; img-src data:; style-src 'sha256-{of_style}'; "
        f"script-src 'sha256-{of_script}'; base-uri 'none'; form-action 'none'"
    )


def _verdict(run: Run) -> Iterator[str]:
    """Which model predicts best and how much better than none."""
    if run.best is None:
        if run.comparison.held_out:
            yield "No verdict: every free run over the held-out recordings diverged."
        else:
            yield "No verdict: nothing was held out."
        return
    yield element("strong", run.best)
    table = run.comparison.table(held_out=bool(run.comparison.held_out))["all"]
    yield (
        f" predicts the recordings best that no fit has seen: {1e3 * table[run.best]:.4g} "
        f"m{run.comparison.unit}"
    )
    if run.best == NO_FRICTION:
        yield "; no model earns its place."
    elif NO_FRICTION in table.index:
        yield f", where no friction leaves {1e3 * table[NO_FRICTION]:.4g}."
    else:
        yield "."
    if run.judged_by:
        yield f" Judged by {run.judged_by}."
    others = ", ".join(name for name in run.alike if name != run.best)
    if others:
        yield (
            " Differences below the floor, which one encoder count at the start makes, mean "
            f"nothing: it cannot be told from {others}. The simplest of them is {run.alike[0]}."
        )
    fit = run.fits.get(run.best)
    if fit is not None and not fit.converged:
        yield " Its fit did not converge; read its warnings below."


def _sections(run: Run) -> Iterator[tuple[str, str, Markup]]:
    """Anchor, heading and content of every section that has something to say."""
    comparison = run.comparison
    errors = [
        _table(tables.error_table(run, kind)) for kind in tables.KINDS if getattr(comparison, kind)
    ]
    legend = element(
        "p",
        "Free run: one simulation over the whole recording. Windows: simulations restarted so "
        "often from the measured motion, over all joints. Saved: how much less the free-run error "
        "is than with no friction. The least error of each column is marked.",
    )
    yield "errors", "Errors", joined(legend, *errors, _folded(tables.recording_table(run)))
    if run.selection is not None:
        told = element(
            "p", "From the training recordings alone one would take ",
            element("strong", run.selection.chosen), f": {run.selection.reason}",
        )  # fmt: skip
        table = _table(tables.selection_table(run.selection))
        yield "choice", "Choice by training data alone", joined(told, table)
    if run.figures:
        yield "figures", "Figures", element("div", *shown(run.figures), class_="figures")
    yield "data", "What was fitted on which file", joined(*_data(run))
    failed = [_failure(name, why) for name, why in run.comparison.failed.items()]
    if run.fits or failed:
        yield "fits", "Fits", joined(*(_fit(run, name) for name in run.fits), *failed)
    rules = [piece for name in run.models for piece in _rules(run, name)]
    if rules:
        yield "rules", "Rules in words", joined(*rules)
    yield "repeat", "Repeat it", joined(*_commands(run))
    if run.notes:
        notes = element("ul", *(element("li", note) for note in run.notes))
        yield "notes", "What could not be read", notes


def _data(run: Run) -> Iterator[Markup]:
    info = next((info for _, info in run.models.values()), None)
    if info is not None and info.rig is not None:
        yield element("p", f"Rig: {info.rig.get('name', 'unnamed')}.")
    if info is not None and info.sample_time is not None:
        yield element("p", f"Sample time: {1e3 * info.sample_time:.4g} ms.")
    yield _table(tables.data_table(run))
    if info is not None:
        ranges = tables.range_table(info, run.comparison.joint_names, run.comparison.unit)
        if ranges is not None:
            yield _table(ranges)


def _fit(run: Run, name: str) -> Markup:
    """How a fit ended, what to be wary of, what it found."""
    fit = run.fits[name]
    said = [
        element("strong", "Converged. " if fit.converged else "Not converged. "),
        fit.status.split(": ", 1)[-1].rstrip(".") + ".",
    ]
    if fit.residual == fit.residual:
        said.append(f" Left over: {1e3 * fit.residual:.4g} m{fit.residual_unit}.")
    wary = [*fit.warnings]
    for what, of in (("At a bound", fit.at_bounds), ("Not identifiable", fit.lost)):
        # Most fits say so themselves, and say more.
        if of and not any(warning.startswith(what) for warning in wary):
            wary.append(f"{what}: {'; '.join(of)}.")
    parts = [
        element("h3", name),
        element("p", *said, class_="good" if fit.converged else "bad"),
    ]
    if wary:
        items = (element("li", w) for w in dict.fromkeys(wary))
        parts.append(element("ul", *items, class_="warnings"))
    if name in run.coefficients:
        parts.append(_table(tables.coefficient_table(run, name)))
    intervals = tables.interval_table(run, name)
    if intervals is not None:
        parts.append(_table(intervals))
    return element("article", *parts)


def _failure(name: str, why: str) -> Markup:
    """A model that was asked for and could not be fitted."""
    said = element("p", element("strong", "Not fitted. "), why, class_="bad")
    return element("article", element("h3", name), said)


def _rules(run: Run, name: str) -> Iterator[Markup]:
    """Rules of a model and what their words mean, a fold for each joint."""
    model = run.models[name][0]
    found = rules_in_words(model, run.comparison.joint_names)
    if not found:
        return
    unit = run.comparison.unit
    units = tables.coefficient_units(run, name)
    along = " along the motion (braking, speeding up)" if _along_motion(model) else ""
    yield element("h3", name)
    yield element(
        "p",
        f"Velocity counts without its sign, acceleration{along or ' with its sign'}. The "
        "coefficients are those that the whole model gives where both words hold fully; between "
        "these points it blends. Where the recordings never came, a rule is a guess from its "
        "neighbours: see the figure of the coefficients.",
    )
    for of in found:
        inner = (
            _table(tables.rule_table(of, name, units)),
            _table(tables.term_table(of, name, unit)),
        )
        yield element(
            "details", element("summary", f"{name}, {of.joint}: {len(of.rules)} rules"), *inner,
            open=of is found[0],
        )  # fmt: skip


def _along_motion(model: object) -> bool:
    return bool(getattr(getattr(model, "schedule", None), "along_motion", False))


def _commands(run: Run) -> Iterator[Markup]:
    if run.command:
        yield element("p", "These results came from:")
        yield element("pre", element("code", run.command), tabindex="0")
    folder = run.folder
    lines = [shlex.join(["nfriction", "report", str(folder)])]
    if run.best in run.models:
        file = str(folder / "models" / f"{run.best}.json")
        lines.append(shlex.join(["nfriction", "info", file]))
        lines.append(shlex.join(["nfriction", "export", file, "--to", "c"]))
    yield element(
        "p", "This page again; what the best model's file says; the same for a controller:"
    )
    yield element("pre", element("code", "\n".join(lines)), tabindex="0")


def _table(table: Table) -> Markup:
    """A table whose headings sort it, in a frame that scrolls where it is too wide."""
    numbers = [
        all(row[k].value is not None for row in table.rows) for k in range(len(table.columns))
    ]
    heads = (
        element(
            "th", element("button", c, type="button"), scope="col", aria_sort="none",
            class_="number" if number and k else None,
        )
        for k, (c, number) in enumerate(zip(table.columns, numbers, strict=True))
    )  # fmt: skip
    rows = (
        element("tr", element("th", *_shown(row[0]), scope="row", data_value=_value(row[0])),
                *(element("td", *_shown(cell), data_value=_value(cell),
                          class_="best" if cell.best else None) for cell in row[1:]))
        for row in table.rows
    )  # fmt: skip
    whole = element(
        "table", element("caption", element("span", table.caption)),
        element("thead", element("tr", *heads)), element("tbody", *rows),
    )  # fmt: skip
    return element("div", whole, class_="frame", tabindex="0", role="region",
                   aria_label=table.caption)  # fmt: skip


def _shown(cell: Cell) -> Iterator[str]:
    yield cell.text
    if cell.best:
        yield element("span", " (least)", class_="unseen")


def _value(cell: Cell) -> str | None:
    # JavaScript reads Infinity where Python writes inf.
    return None if cell.value is None else str(cell.value).replace("inf", "Infinity")


def _folded(table: Table) -> Markup:
    return element("details", element("summary", table.caption), _table(table))

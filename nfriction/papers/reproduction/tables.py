"""The papers' tables: our numbers together with the printed ones.

The papers' recordings were never published, so the printed numbers, which are from a different
machine, cannot be reproduced exactly. Units of the position errors are not printed; radians are
assumed.
"""

import json
from collections.abc import Mapping, Sequence
from functools import cache
from importlib import resources
from typing import Any, Literal, NamedTuple

import numpy as np
import pandas as pd

from nfriction.papers.reproduction.agreement import agreement
from nfriction.papers.reproduction.stages import (
    ADAPTIVE,
    BY_PATTERN,
    CONSTANT,
    LAWS,
    NEURO_FUZZY,
    PAPERS_WAY,
    SECOND_PAPER,
)
from nfriction.papers.reproduction.workspace import Array, Workspace
from nfriction.plant import rigs

Drive = Literal["free_run", "measured_drive"]
JOINTS = ("joint 2", "joint 3", "joint 4")

_FILE = resources.files("nfriction.papers.reproduction") / "data" / "printed.json"
_PRINTED = json.loads(_FILE.read_text(encoding="utf-8"))
TABLE_6: dict[str, list[tuple[str, float, float]]] = _PRINTED["tlrip_table_6"]
"""TLRIP paper, Table 6: class of acceleration, from and to [s], by joint."""
TABLE_10: dict[str, list[float]] = _PRINTED["tlrip_table_10"]
"""TLRIP paper, Table 10: position RMSE by model and joint."""
SECOND_COEFFICIENTS: dict[str, dict[str, list[float]]] = _PRINTED["rtip_tables_1_to_3"]
"""RTIP paper, Tables I to III: coefficients by model and joint."""
SECOND_TABLE_4: dict[str, list[float]] = _PRINTED["rtip_table_4"]
"""RTIP paper, Table IV: position RMSE by model and joint."""

NINE = (*LAWS, *ADAPTIVE, *NEURO_FUZZY)
"""Three laws, each constant, adaptive and neuro-fuzzy."""
TLRIP = (*CONSTANT, *ADAPTIVE, *BY_PATTERN, *NEURO_FUZZY, *PAPERS_WAY)
# The paper's rows are also compared with rows from our run of its own procedure.
_PRINTED_10 = TABLE_10 | {n: TABLE_10[n.partition("-")[0]] for n in (*BY_PATTERN, *PAPERS_WAY)}


class Order(NamedTuple):
    """Verdict on neuro-fuzzy <= adaptive <= constant for each law on every joint.

    Judged by the median error over fresh releases.
    """

    holds: bool
    broken: list[str]  # exceptions, in words
    best: dict[str, str]  # of the nine by joint; ties in the printed digits are joined by "="

    def __str__(self) -> str:
        best = ", ".join(f"{joint} {model}" for joint, model in self.best.items())
        holds = "yes" if self.holds else f"no ({'; '.join(self.broken)})"
        return (
            "neuro-fuzzy <= adaptive <= constant on every joint, median of ten fresh releases: "
            f"{holds}\nbest of the nine: {best}"
        )


def rmse(
    workspace: Workspace, models: Sequence[str], *, split: str = "test", drive: Drive = "free_run"
) -> pd.DataFrame:
    """Position RMSE over all recordings of a split, by model (row) and joint (column) [rad]."""
    rows = {}
    for name in models:
        scores = workspace.found(name)["scores"].values()
        joints = [s[drive]["joints"] for s in scores if s["split"] == split]
        # A diverged simulation has no error value; count it as infinite.
        errors = [[np.inf if e is None else e for e in row] for row in joints]
        rows[name] = np.sqrt(np.mean(np.square(errors), axis=0))
    return _table(rows)


def fresh(workspace: Workspace, models: Sequence[str] = TLRIP) -> pd.DataFrame:
    """Median position RMSE of free runs over fresh releases, one row per model [rad]."""
    found = fresh_runs(workspace, models)
    return _table({name: np.median(errors, axis=0) for name, errors in found.items()})


def fresh_runs(workspace: Workspace, models: Sequence[str]) -> dict[str, Array]:
    """Position RMSE of each free run from a fresh release, by model [rad], (release, joint)."""
    found = {n: np.array(workspace.found(n)["fresh"], dtype=float) for n in models}
    # A diverged simulation has no error value; count it as infinite.
    return {n: np.nan_to_num(e, nan=np.inf) for n, e in found.items()}


def table_10(workspace: Workspace, drive: Drive = "free_run") -> pd.DataFrame:
    """Position RMSE of every model on test releases, beside Table 10 of the TLRIP paper."""
    return _beside(rmse(workspace, TLRIP, drive=drive), _table(_PRINTED_10))


@cache
def agreement_table() -> pd.DataFrame:
    """Agreement of independent simulations from the TLRIP paper's check pose, Figs. 3 and 4."""
    # 20.56° is measured from hanging.
    start = np.deg2rad([200.56, 32.21, 45.0])
    return pd.concat({"ours": agreement(rigs.tlrip(), start, np.zeros(3))}, axis=1)


def table_6(workspace: Workspace) -> pd.DataFrame:
    """Classes of acceleration, their start and end [s], beside Table 6 of the TLRIP paper."""
    found = workspace.found(ADAPTIVE[-1])["intervals"]

    def rows(by_joint: Mapping[str, Sequence[Sequence[Any]]]) -> pd.DataFrame:
        numbered = {
            f"{joint}, {k}": interval
            for joint, intervals in by_joint.items()
            for k, interval in enumerate(intervals, 1)
        }
        columns = ["class", "start [s]", "end [s]"]
        return pd.DataFrame.from_dict(numbered, orient="index", columns=columns)

    sides = {"ours": rows(dict(zip(JOINTS, found, strict=True))), "printed": rows(TABLE_6)}
    table = pd.concat(sides, axis=1)
    order = [f"{joint}, {k}" for joint in JOINTS for k in range(1, len(table) + 1)]
    return table.reindex([row for row in order if row in table.index])


def adaptive_coefficients(workspace: Workspace, law: str) -> pd.DataFrame:
    """Adaptive coefficients by class, by both methods; the TLRIP paper's Tables 7 to 9 are lost."""

    def by(stage: str) -> pd.DataFrame:
        classes = workspace.found(stage)["classes"].items()
        return _table(
            {f"{name}, {known}": row for known, of in classes for name, row in of.items()}
        )

    sides = {"pattern search": by(f"A{law}-pattern"), "Gauss-Newton": by(f"A{law}")}
    return pd.concat(sides, axis=1)


def table_11(workspace: Workspace) -> pd.DataFrame:
    """Error reduction of NFNLFM relative to each other model [%] (TLRIP paper, Table 11).

    The printed values, 11.57 to 94.55, follow from the printed Table 10, which has no constant
    models.
    """
    best, others = NEURO_FUZZY[-1], (*ADAPTIVE, *NEURO_FUZZY[:-1], *CONSTANT)
    return _saved(workspace, {other: (best, other) for other in others})


def steps_saved(workspace: Workspace) -> pd.DataFrame:
    """Error reduction by adaptive and neuro-fuzzy coefficients relative to simpler ones [%]."""
    pairs = [
        pair
        for law, by_class, network in zip(LAWS, ADAPTIVE, NEURO_FUZZY, strict=True)
        for pair in (
            (by_class, law),
            (network, law),
            (network, by_class),
            (f"{network}-papers", by_class),
        )
    ]
    return _saved(
        workspace, {f"{better} against {worse}": (better, worse) for better, worse in pairs}
    )


def _saved(workspace: Workspace, pairs: Mapping[str, tuple[str, str]]) -> pd.DataFrame:
    """Error reduction of the first model of each pair relative to the second, from medians [%]."""

    def saved(table: pd.DataFrame) -> pd.DataFrame:
        rows = {
            name: 100.0 * (1.0 - table.loc[better] / table.loc[worse])
            for name, (better, worse) in pairs.items()
            # The paper's table does not include constant models.
            if {better, worse} <= set(table.index)
        }
        return pd.DataFrame(rows).T

    return _beside(saved(fresh(workspace)), saved(_table(_PRINTED_10)))


def second_coefficients(workspace: Workspace, law: str) -> pd.DataFrame:
    """Coefficients of a model on the second rig, beside the RTIP paper's Tables I to III."""
    found = workspace.found(f"rtip-{law}")["coefficients"]
    return _beside(_table(found), _table(SECOND_COEFFICIENTS[law]))


def second_table_4(workspace: Workspace) -> pd.DataFrame:
    """Position RMSE on the RTIP paper's rig, beside its Table IV."""
    # Stages of this rig have a prefix that the table does not need.
    ours = rmse(workspace, SECOND_PAPER).set_axis(list(LAWS))
    return _beside(ours, _table(SECOND_TABLE_4))


def control_table(workspace: Workspace, task: str) -> pd.DataFrame:
    """Performance of the balanced rig with each model's compensation (TLRIP paper, future work)."""
    rows = workspace.found("control")["tables"][task]
    table = pd.DataFrame.from_dict(rows, orient="index", dtype=float).fillna(np.inf)
    return pd.concat({"ours": table}, axis=1)


def _table(rows: Mapping[str, Any]) -> pd.DataFrame:
    return pd.DataFrame.from_dict(dict(rows), orient="index", columns=list(JOINTS))


def _beside(ours: pd.DataFrame, theirs: pd.DataFrame) -> pd.DataFrame:
    """Two tables side by side; rows missing in the paper are empty."""
    # Rows follow ours, since the paper has fewer.
    return pd.concat({"ours": ours, "printed": theirs.reindex(ours.index)}, axis=1)


def order(workspace: Workspace) -> Order:
    """Verdict on the papers' order of models on fresh releases, joint by joint."""
    # To the printed digits, because a rejected network equals its law only up to round-off.
    table = (1e3 * fresh(workspace, NINE)).map(lambda e: float(f"{e:.4g}"))
    error = {str(model): np.asarray(table.loc[model], dtype=float) for model in table.index}
    broken = [
        f"{better} {e:.4g} > {worse} {limit:.4g} mrad on {joint}"
        for law in LAWS
        for better, worse in ((f"A{law}", law), (f"NF{law}", f"A{law}"))
        for joint, e, limit in zip(JOINTS, error[better], error[worse], strict=True)
        # A diverged simulation always violates the order.
        if not e <= limit or np.isinf(e)
    ]
    # Models tie if one retained the other's coefficients.
    best = {
        joint: " = ".join(m for m, e in error.items() if e[k] == min(x[k] for x in error.values()))
        for k, joint in enumerate(JOINTS)
    }
    return Order(not broken, broken, best)


def fit_ends(workspace: Workspace) -> str:
    """The status of every fit, and the fits that did not converge."""
    fits = {name: workspace.found(name)["fit"] for name in (*TLRIP, *SECOND_PAPER)}
    lines = [f"{name:13} {fit['status']}" for name, fit in fits.items()]
    open_ended = _unconverged(workspace)
    summary = "every fit converged"
    if open_ended:
        summary = (
            f"{len(open_ended)} of {len(fits)} fits did not converge ({', '.join(open_ended)}): "
            "their numbers are those of an unfinished search, and their order may change with more "
            "steps"
        )
    return "\n".join([*lines, "", summary])


def _unconverged(workspace: Workspace) -> list[str]:
    names = (*TLRIP, *SECOND_PAPER)
    return [name for name in names if not workspace.found(name)["fit"]["converged"]]


def conclusion(workspace: Workspace) -> str:
    """Text for readers who do not know the papers: which claims were reproduced, and why."""
    error = pd.concat([fresh(workspace), rmse(workspace, SECOND_PAPER)]).mean(axis=1)

    def said(names: Sequence[str]) -> str:
        return ", ".join(f"{1e3 * error[name]:.3g}" for name in names)

    def claim(text: str, ours: Sequence[str], theirs: Sequence[str]) -> str:
        held = sum(error[a] < error[b] for a, b in zip(ours, theirs, strict=True))
        verdict = {0: "NOT reproduced", len(ours): "reproduced"}.get(
            held, f"reproduced for {held} of {len(ours)}"
        )
        return f"{verdict}: {text}"

    constant = tuple(LAWS)
    *simple, five = SECOND_PAPER
    missed = workspace.found("twin-tlrip")["missed_torque"]
    lines = [
        "The papers' claims on simulated recordings, because theirs were never published; errors "
        "of the simulated position in mrad (median of ten fresh releases for the first rig) with "
        "viscous, load-dependent and five-coefficient friction:",
        claim(
            f"coefficients by class of acceleration, {said(ADAPTIVE)} (by the papers' pattern "
            f"search {said(BY_PATTERN)}), have smaller errors than constant ones, {said(constant)}",
            ADAPTIVE, constant,
        ),
        claim(
            f"networks fitted to trajectories have still smaller errors, {said(NEURO_FUZZY)}",
            NEURO_FUZZY, ADAPTIVE,
        ),
        str(order(workspace)),
        claim(
            "networks trained on a fuzzy controller, the papers' method, have smaller errors than "
            f"coefficients by class, {said(PAPERS_WAY)}",
            PAPERS_WAY, ADAPTIVE,
        ),
        claim(
            f"on the RTIP paper's rig five coefficients are best, {said(SECOND_PAPER)}",
            (five,) * len(simple), simple,
        ),
        f"Why: a curve over speed fails to explain {missed['speed']:.1%} of the true friction "
        "torque, a surface over speed and acceleration (the inputs of the papers' networks) "
        f"{missed['speed and acceleration']:.1%}; {len(_unconverged(workspace))} of "
        f"{len(TLRIP) + len(SECOND_PAPER)} fits did not converge.",
    ]  # fmt: skip
    return "\n".join(lines)


def long_table(workspace: Workspace) -> pd.DataFrame:
    """Every error as one row."""
    rows: list[dict[str, Any]] = []
    for rig, models in (("tlrip", TLRIP), ("rtip", SECOND_PAPER)):
        for model in models:
            for recording, entry in workspace.found(model)["scores"].items():
                errors = {"free run": entry["free_run"], "measured drive": entry["measured_drive"]}
                errors |= {f"{h} s windows": e for h, e in entry["windows"].items()}
                about = {
                    "rig": rig, "model": model.removeprefix("rtip-"), "recording": recording,
                    "split": entry["split"],
                }  # fmt: skip
                for kind, error in errors.items():
                    joints = zip(JOINTS, error["joints"], strict=True)
                    for joint, value in (*joints, ("all", error["all"])):
                        # JSON has no infinity; null means diverged.
                        value = np.inf if value is None else value
                        rows.append(about | {"kind": kind, "joint": joint, "rmse [rad]": value})
    return pd.DataFrame(rows)

"""The papers' tables from what the stages found, beside the printed ones."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import pandas as pd

from nfriction.papers.reproduction import printed
from nfriction.papers.reproduction.stages import (
    ADAPTIVE,
    CONSTANT,
    LAWS,
    NEURO_FUZZY,
    PAPERS_WAY,
    SECOND_PAPER,
)
from nfriction.papers.reproduction.workspace import Workspace

Drive = Literal["free_run", "measured_drive"]

NINE = (*LAWS, *ADAPTIVE, *NEURO_FUZZY)
"""Three laws, constant, adaptive and neuro-fuzzy."""


@dataclass(frozen=True)
class Order:
    """Whether neuro-fuzzy <= adaptive <= constant for each law on every joint.

    Attributes:
        broken: where not, in words.
        best: the best of the nine by joint, those that tie joined by an equals sign.
    """

    broken: tuple[str, ...]
    best: dict[str, str]

    @property
    def holds(self) -> bool:
        """Everywhere."""
        return not self.broken

    def __str__(self) -> str:
        best = ", ".join(f"{joint} {model}" for joint, model in self.best.items())
        holds = "yes" if self.holds else f"no ({'; '.join(self.broken)})"
        return (
            f"neuro-fuzzy <= adaptive <= constant on every joint: {holds}\nbest of the nine: {best}"
        )


def rmse(
    workspace: Workspace,
    models: Sequence[str],
    *,
    split: str = "test",
    drive: Drive = "free_run",
) -> pd.DataFrame:
    """Position RMSE over all recordings of a split, a row a model, a column a joint [rad]."""
    rows = {}
    for name in models:
        scores = workspace.found(name)["scores"].values()
        errors = [_numbers(s[drive]["joints"]) for s in scores if s["split"] == split]
        rows[name] = np.sqrt(np.mean(np.square(errors), axis=0))
    return pd.DataFrame.from_dict(rows, orient="index", columns=list(printed.JOINTS))


def table_10(workspace: Workspace, drive: Drive = "free_run") -> pd.DataFrame:
    """Position RMSE of every model on test releases, beside the paper's.

    References:
        TLRIP paper, Table 10.
    """
    ours = rmse(workspace, [*CONSTANT, *ADAPTIVE, *NEURO_FUZZY, *PAPERS_WAY], drive=drive)
    return _beside(ours, {**printed.TABLE_10, **_papers_rows(printed.TABLE_10)})


def table_11(workspace: Workspace) -> pd.DataFrame:
    """What adaptive and neuro-fuzzy coefficients save against simpler ones of the law [%].

    The print of the paper's Table 11 is not at hand; its side follows from its Table 10, which has
    no constant models.

    References:
        TLRIP paper, Table 11.
    """
    ours = rmse(workspace, [*CONSTANT, *ADAPTIVE, *NEURO_FUZZY, *PAPERS_WAY])
    theirs = pd.DataFrame.from_dict(
        {**printed.TABLE_10, **_papers_rows(printed.TABLE_10)},
        orient="index",
        columns=list(printed.JOINTS),
    )
    pairs = [
        pair
        for law in LAWS
        for pair in (
            (f"A{law}", law),
            (f"NF{law}", law),
            (f"NF{law}", f"A{law}"),
            (f"NF{law}-papers", f"A{law}"),
        )
    ]

    def saved(table: pd.DataFrame) -> pd.DataFrame:
        rows = {
            f"{better} against {worse}": 100.0 * (1.0 - table.loc[better] / table.loc[worse])
            for better, worse in pairs
            if {better, worse} <= set(table.index)
        }
        return pd.DataFrame(rows).T

    return _beside(saved(ours), {str(k): list(v) for k, v in saved(theirs).iterrows()})


def second_coefficients(workspace: Workspace, law: str) -> pd.DataFrame:
    """Coefficients of a model on the second paper's rig, beside the paper's.

    References:
        RTIP paper, Tables I to III.
    """
    found = workspace.found(f"rtip-{law}")["coefficients"]
    ours = pd.DataFrame.from_dict(found, orient="index", columns=list(printed.JOINTS))
    return _beside(ours, printed.SECOND_COEFFICIENTS[law])


def second_table_4(workspace: Workspace, split: str = "test") -> pd.DataFrame:
    """Position RMSE on the second paper's rig, beside the paper's.

    References:
        RTIP paper, Table IV.
    """
    ours = rmse(workspace, SECOND_PAPER, split=split)
    ours.index = pd.Index(list(LAWS))
    return _beside(ours, printed.SECOND_TABLE_4)


def order(workspace: Workspace) -> Order:
    """Whether the papers' order of models holds on test releases, joint by joint."""
    return order_of(rmse(workspace, NINE))


def order_of(table: pd.DataFrame) -> Order:
    """The same for a table of errors with a row for each of the nine models."""
    error = {str(model): np.asarray(table.loc[model], dtype=float) for model in table.index}
    joints = [str(joint) for joint in table.columns]
    broken = [
        f"{better} {1e3 * e:.4g} > {worse} {1e3 * limit:.4g} mrad on {joint}"
        for law in LAWS
        for better, worse in ((f"A{law}", law), (f"NF{law}", f"A{law}"))
        for joint, e, limit in zip(joints, error[better], error[worse], strict=True)
        # What diverged is no number, and not in order.
        if not e <= limit or np.isinf(e)
    ]
    # Models that share the least error, as one that was left at the other's coefficients, tie.
    best = {
        joint: " = ".join(m for m, e in error.items() if e[k] == min(x[k] for x in error.values()))
        for k, joint in enumerate(joints)
    }
    return Order(tuple(broken), best)


def long_table(workspace: Workspace) -> pd.DataFrame:
    """Every error as one row."""
    rows: list[dict[str, Any]] = []
    for rig, models in (
        ("tlrip", [*CONSTANT, *ADAPTIVE, *NEURO_FUZZY, *PAPERS_WAY]),
        ("rtip", list(SECOND_PAPER)),
    ):
        for model in models:
            for recording, entry in workspace.found(model)["scores"].items():
                errors = {"free run": entry["free_run"], "measured drive": entry["measured_drive"]}
                errors |= {f"{h} s windows": e for h, e in entry["windows"].items()}
                for kind, error in errors.items():
                    joints = zip(printed.JOINTS, error["joints"], strict=True)
                    for joint, value in (*joints, ("all", error["all"])):
                        rows.append(
                            {
                                "rig": rig,
                                "model": model.removeprefix("rtip-"),
                                "recording": recording,
                                "split": entry["split"],
                                "kind": kind,
                                "joint": joint,
                                "rmse [rad]": np.inf if value is None else value,
                            }
                        )
    return pd.DataFrame(rows)


def _numbers(values: Sequence[float | None]) -> list[float]:
    """A diverged simulation has no number: its error is infinite."""
    return [np.inf if v is None else v for v in values]


def _papers_rows(table: dict[str, Any]) -> dict[str, Any]:
    """The paper's neuro-fuzzy rows also stand beside those made its own way."""
    return {f"{name}-papers": table[name] for name in NEURO_FUZZY}


def _beside(ours: pd.DataFrame, theirs: dict[str, Any]) -> pd.DataFrame:
    """Two tables side by side; rows that the paper has not stay empty there."""
    other = pd.DataFrame.from_dict(theirs, orient="index", columns=ours.columns)
    return pd.concat({"ours": ours, "printed": other.reindex(ours.index)}, axis=1)

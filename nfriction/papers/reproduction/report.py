"""What a reproduction leaves: tables as CSV, everything as JSON, and a text to read."""

import json
from pathlib import Path

import pandas as pd

from nfriction.io.atomic import write_atomically
from nfriction.papers.reproduction import tables
from nfriction.papers.reproduction.stages import LAWS, stages
from nfriction.papers.reproduction.workspace import Workspace


def all_tables(workspace: Workspace) -> dict[str, pd.DataFrame]:
    """The papers' tables by the name of their file."""
    found = {
        "table_10": tables.table_10(workspace),
        "table_10_measured_drive": tables.table_10(workspace, "measured_drive"),
        "table_11": tables.table_11(workspace),
    }
    for number, law in zip(("i", "ii", "iii"), LAWS, strict=True):
        found[f"second_table_{number}"] = tables.second_coefficients(workspace, law)
    found["second_table_iv"] = tables.second_table_4(workspace)
    return found


def write_tables(workspace: Workspace, *, command: str = "") -> list[Path]:
    """Write `tables/*.csv`, `rmse.csv` with every error, and `results.json`."""
    written = []
    for name, table in all_tables(workspace).items():
        flat = table.set_axis([f"{column[1]}, {column[0]}" for column in table.columns], axis=1)
        content = flat.to_csv(index_label="row").encode()
        written.append(write_atomically(workspace.folder / "tables" / f"{name}.csv", content))
    content = tables.long_table(workspace).to_csv(index=False).encode()
    written.append(write_atomically(workspace.folder / "rmse.csv", content))
    order = tables.order(workspace)
    results = {
        "command": command,
        "settings": workspace.settings.to_dict(),
        "order": {"holds": order.holds, "broken": list(order.broken), "best": order.best},
        "stages": {name: workspace.found(name) for name in stages()},
    }
    text = json.dumps(results, indent=1, allow_nan=False)
    written.append(write_atomically(workspace.folder / "results.json", text.encode()))
    return written


def text(workspace: Workspace) -> str:
    """All tables beside the printed ones, and whether the papers' order of models holds."""
    settings = workspace.settings
    titles = {
        "table_10": "Table 10: position RMSE [mrad] on test releases, free runs of "
        f"{settings.tlrip_seconds:g} s, coefficients driven by the simulated motion",
        "table_10_measured_drive": "Table 10 again, coefficients driven by the measured motion as "
        "in the paper [mrad]",
        "table_11": "Table 11: error saved [%]",
        "second_table_i": "second paper, Table I: NCFM by sequential quadratic programming",
        "second_table_ii": "second paper, Table II: LFM by pattern search",
        "second_table_iii": "second paper, Table III: NLFM by pattern search",
        "second_table_iv": "second paper, Table IV: position RMSE [mrad] on test releases, "
        f"free runs of {settings.rtip_seconds:g} s",
    }
    parts = []
    for name, table in all_tables(workspace).items():
        shown = 1e3 * table if "[mrad]" in titles[name] else table
        written = shown.to_string(float_format=lambda x: f"{x:.4g}", na_rep="")
        parts.append(f"{titles[name]}\n{written}")
    parts.append(
        "printed: the papers' numbers, from recordings that were never published and another "
        "machine's friction;\nours: simulated twins. -papers: made by the papers' own procedure "
        "(fuzzy controller, 2-10-2 network)."
    )
    parts.append(str(tables.order(workspace)))
    return "\n\n".join(parts)

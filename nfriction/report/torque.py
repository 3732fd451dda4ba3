"""Write fits to a table of friction torque: tables, models, figure, and one HTML page."""

import json
import shlex
from pathlib import Path
from typing import Any

from nfriction.evaluation.results import REPORT, RESULTS, TABLE, replacing
from nfriction.evaluation.tables import Table, Value
from nfriction.evaluation.torque_tables import TorqueFits
from nfriction.friction import plain_name
from nfriction.io.files import write_atomically
from nfriction.io.model_file import save
from nfriction.plots.comparison import DPI
from nfriction.report.page import document, pictures
from nfriction.report.run import Figure

FIGURE = "friction"


def error_table(fits: TorqueFits) -> Table:
    """NRMSE on hold-out blocks, by joint and model."""
    frame = fits.to_frame()
    heads = tuple(plain_name(str(name)) for name in frame)
    rows: tuple[tuple[Value, ...], ...] = tuple(
        (str(joint), *map(float, of)) for joint, of in frame.iterrows()
    )
    return Table("NRMSE on hold-out blocks", ("joint", *heads), rows, "diverged")


def choice_table(fits: TorqueFits) -> Table:
    """Model to use at each joint, its errors, and the reason."""
    rows: list[tuple[Value, ...]] = []
    for k, joint in enumerate(fits.table.joints):
        name, why = fits.choices[joint.name]
        left_out = next(c.error for c in fits.candidates[joint.name] if c.name == name)
        rows.append((joint.name, plain_name(name), left_out, fits.fits[name][k].residual, why))
    heads = ("joint", "model", f"left out [{fits.unit}]", f"all rows [{fits.unit}]", "reason")
    return Table("Model to use at each joint, root mean square errors", heads, tuple(rows))


def coefficient_tables(fits: TorqueFits) -> list[Table]:
    """Coefficients with 95 % intervals, of every model."""
    found = []
    for name in fits.fits:
        frame = fits.intervals(name)
        rows = tuple(
            (str(label), float(row["value"]), float(row["low"]), float(row["high"]), row["note"])
            for label, row in frame.iterrows()
        )
        heads = ("parameter", "value", "from", "to", "note")
        found.append(Table(f"Coefficients of {plain_name(name)}", heads, rows))
    return found


def write_torque_fits(
    fits: TorqueFits, folder: str | Path, *, command: str = "", figures: bool = True
) -> list[Path]:
    """Write `table.csv`, `results.json`, the models, a figure and `report.html` into a folder.

    As with `write_results`, they replace those of an earlier run, and the user's own files stay;
    `command` is the command line that reproduces the results.

    Raises:
        OSError: another process is writing a run into the folder, or it cannot be written.
    """
    folder = Path(folder)
    written, drawn = [TABLE], []
    with replacing(folder) as new:
        text = fits.to_frame().rename(columns=plain_name).to_csv()
        write_atomically(new / TABLE, text.encode())
        for name in fits.fits:
            written.append(f"models/{name}.json")
            save(fits.model(name), new / written[-1], fits.info(name))
        if figures:
            figure = fits.plot()
            width, height = (round(DPI * x) for x in figure.get_size_inches())
            written.append(f"figures/{FIGURE}.png")
            path = new / written[-1]
            path.parent.mkdir()
            figure.savefig(path, dpi=DPI)
            drawn.append(Figure(FIGURE, path.read_bytes(), width, height))
        page = to_html(fits, folder, drawn, command)
        write_atomically(new / REPORT, page.encode(errors="backslashreplace"))
        results = fits.to_dict() | {"command": command, "files": sorted(written)}
        text = json.dumps(results, indent=1, allow_nan=False)
        write_atomically(new / RESULTS, text.encode())
    return [folder / name for name in (*written, REPORT, RESULTS)]


def to_html(fits: TorqueFits, folder: Path, figures: list[Figure], command: str) -> str:
    """The page of fits to a table as one HTML document without external references."""
    table, name = fits.table, next(iter(fits.chosen.values()))
    rows = tuple(
        (j.name, float(len(j)), "yes" if j.time is not None else "no", float(j.qd.min()),
         float(j.qd.max()), float(j.tau.min()), float(j.tau.max()))
        for j in table.joints
    )  # fmt: skip
    heads = (
        "joint", "rows", "in order of time",
        f"velocity from [{table.unit}/s]", f"velocity to [{table.unit}/s]",
        f"torque from [{fits.unit}]", f"torque to [{fits.unit}]",
    )  # fmt: skip
    file = str(folder / "models" / f"{name}.json")
    commands = [*([command] if command else []), shlex.join(["nfriction", "info", file])]
    commands.append(shlex.join(["nfriction", "export", file, "--format", "c"]))
    tables: dict[str, Any] = {
        "errors": error_table(fits),
        "choices": choice_table(fits),
        "coefficients": coefficient_tables(fits),
        "data": Table(f"Rows of {table.name or 'the table'}", heads, rows),
    }
    return document(
        "torque.html.j2", f"Friction torque: {table.name or 'table'}",
        tables=tables, figures=pictures(figures), commands=commands, remarks=table.remarks,
        failed={plain_name(name): why for name, why in fits.failed.items()},
        chosen={joint: plain_name(name) for joint, name in fits.chosen.items()},
    )  # fmt: skip

"""Every table and figure of both papers, in their order: as files, as text, and on one page."""

import base64
import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from importlib import resources
from pathlib import Path
from typing import Any

import jinja2
import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from tqdm import tqdm

from nfriction.io.files import atomic_write, write_atomically
from nfriction.papers.control.study import SAMPLE_TIME, SHARED, THINNED, balance_figure
from nfriction.papers.controller.mamdani import controller_surface, paper_controller
from nfriction.papers.reproduction import figures, tables
from nfriction.papers.reproduction.stages import ADAPTIVE, LAWS, NEURO_FUZZY, SECOND_PAPER, stages
from nfriction.papers.reproduction.workspace import Workspace
from nfriction.plant import rigs
from nfriction.plots import animate, rmse_bars
from nfriction.version import __version__

PAGE = "reproduction.html"
DPI = 150
_STYLE = resources.files("nfriction.report") / "templates" / "page.css"
_TEMPLATE = resources.files("nfriction.papers.reproduction") / "data" / "page.html.j2"

Table = Callable[[Workspace], pd.DataFrame]
Drawing = Callable[[Workspace], Figure]


@dataclass(frozen=True)
class Item:
    """A table or figure of a paper.

    Tables and figures are by file name.
    """

    title: str  # its number and caption
    differs: str = ""  # difference between ours and the paper's, if there is one
    tables: Mapping[str, tuple[str, Table]] = field(default_factory=dict)  # caption and content
    figures: Mapping[str, Drawing] = field(default_factory=dict)
    models: tuple[str, ...] = ()  # models whose fit status is listed on the page


FIRST = (
    Item("Fig. 2: swing from 0°, 20°, 30°, 40° for three cases of inertia",
         "No full tensor is printed; ours has Izz across and a tenth of it along each link.",
         figures={"fig_02_inertia": lambda _: figures.inertia_cases()}),
    Item("Fig. 4: model without friction, an independent simulation and the measured motion",
         "MuJoCo replaces SimMechanics, and the twin replaces the measured motion.",
         {"fig_4_agreement": (
             "Fig. 4: difference from our frictionless simulation, released at 20.56°, 32.21°, 45°",
             lambda _: tables.agreement_table())},
         {"fig_04_without_friction": figures.without_friction}),
    Item("Table 6 and the experiment: classes of acceleration over time",
         "The experiment is a release from upright, the reading of 180° that agrees with Table 4.",
         {"table_6": ("Table 6: classes of acceleration in the experiment", tables.table_6)},
         {"experiment_classes": figures.experiment}),
    Item("Tables 7, 8, 9: adaptive coefficients by class",
         "The printed ones are illegible in the scan. The paper uses pattern search; the papers' "
         "networks start from the coefficients found by Gauss-Newton.",
         {f"table_{number}": (
             f"Table {number}: coefficients of A{law} by class of acceleration (the print is lost)",
             partial(tables.adaptive_coefficients, law=law))
          for number, law in zip((7, 8, 9), LAWS, strict=True)}),
    Item("Fig. 7 and Table 4: fuzzy sets of joint 2",
         figures={"fig_07_memberships": lambda _: figures.controller_memberships()}),
    Item("Fig. 8 and Table 5: coefficients from the fuzzy controllers",
         "Rules (b) and (c) are lost; rules (a) are used for all joints.",
         figures={f"fig_08_surfaces_joint_{joint}":
                  lambda _, joint=joint: controller_surface(paper_controller(joint))  # type: ignore[misc]
                  for joint in (2, 3, 4)}),
    Item("Networks 2-10-2 after their training on the controllers' outputs",
         "Not shown in the paper. The controllers span the twin's coefficients by class.",
         figures={"networks_NFLFM": figures.network_surfaces}, models=("NFLFM-papers",)),
    Item("Figs. 11, 12, 13: coefficients of the neuro-fuzzy models in the experiment",
         "The law replaces a network that failed on hold-out windows; -papers: as in the paper.",
         figures={f"fig_{number}_coefficients_{name}": partial(figures.coefficients, name=name)
                  for names in (NEURO_FUZZY, tables.PAPERS_WAY)
                  for number, name in zip((11, 12, 13), names, strict=True)},
         models=(*NEURO_FUZZY, *tables.PAPERS_WAY)),
    Item("Fig. 14: measured and simulated position",
         "On a recording to which no model was fitted.",
         figures={f"fig_14_positions_{NEURO_FUZZY[-1]}":
                  partial(figures.group_positions, models=(NEURO_FUZZY[-1], tables.PAPERS_WAY[-1]),
                          among=(NEURO_FUZZY[-1], tables.PAPERS_WAY[-1]))}),
    Item("Table 10: position error of every model",
         "The printed numbers cannot be reproduced, since the friction is from a different rig. "
         "-pattern: by the papers' pattern search; -papers: by their fuzzy controller and network. "
         "The figure shows ten fresh releases: median, middle half and all.",
         {"table_10": (
             "Table 10: position RMSE [mrad] on test releases, free runs, coefficients driven by "
             "the simulated motion", tables.table_10),
          "table_10_fresh": (
             "Position RMSE [mrad], median of ten fresh releases of 10 s, free runs",
             lambda workspace: pd.concat({"ours": tables.fresh(workspace)}, axis=1)),
          "table_10_measured_drive": (
             "Table 10 again, coefficients driven by the measured motion as in the paper [mrad]",
             partial(tables.table_10, drive="measured_drive"))},
         {"rmse": figures.fresh_errors}),
    Item("Table 11: error reduction by NFNLFM relative to each other model",
         tables={
             "table_11": ("Table 11: error reduction by NFNLFM relative to each other model [%], "
                          "median of ten fresh releases", tables.table_11),
             "error_saved": ("error reduction by coefficients by class and by networks for each "
                             "law [%], median of ten fresh releases", tables.steps_saved)}),
)  # fmt: skip
SECOND = (
    Item("Fig. 3: four joints from 0°, 20°, 30°, 40°",
         "Measured from hanging, as in that paper.",
         figures={"second_fig_3_free_arm": lambda _: figures.second_swing()}),
    Item("Tables I, II, III: coefficients", "Coefficients of the twin.",
         {f"second_table_{roman.lower()}": (f"RTIP paper, Table {roman}: {law} by {method}",
                                            partial(tables.second_coefficients, law=law))
          for roman, law, method in zip(
              ("I", "II", "III"), LAWS,
              ("sequential quadratic programming", "pattern search", "pattern search"),
              strict=True)}),
    Item("Figs. 5, 6, 7: measured and simulated position, first 10 s, common error scale",
         "From 20°, 30°, 40°, to which no model was fitted; the paper shows its own fit from 45°.",
         figures={f"second_fig_{number}_{law}": partial(figures.second_positions, law=law)
                  for number, law in zip((5, 6, 7), LAWS, strict=True)}),
    Item("Fig. 8: friction torque over velocity",
         "Dots: the torque that the smoothed motion implies.",
         figures={"second_fig_8_torque": figures.second_torque}),
    Item("Table IV: position error", "",
         {"second_table_iv": ("RTIP paper, Table IV: position RMSE [mrad] on test releases, free "
                              "runs", tables.second_table_4)},
         {"second_rmse": lambda workspace: rmse_bars(
             tables.rmse(workspace, SECOND_PAPER).set_axis(list(LAWS)), "rad")}),
)  # fmt: skip
TASKS = {
    "still": "a link balanced upright with the arm held still",
    "follow": "a link balanced upright while the arm follows a slow sine",
    "swing-up": "three links swung up in 5 s and balanced, planned with the same friction",
    "three links": "three links balanced upright while the arm follows a slow sine",
}
FUTURE = (
    Item("Control of the rig with the friction models", "In simulation.",
         {f"control_{task.replace(' ', '_').replace('-', '_')}": (
             f"future work, control: {what}, by the model whose friction torque is compensated "
             "(inf: fallen)", partial(tables.control_table, task=task))
          for task, what in TASKS.items()},
         {"control_balance": lambda workspace: balance_figure(workspace.arrays("control"))}),
)  # fmt: skip
OTHERS = (
    Item("Positions by kind of model", "Errors on one scale.",
         figures={f"positions_{kind}": partial(figures.group_positions, models=models)
                  for kind, models in (("constant", tuple(LAWS)), ("adaptive", ADAPTIVE),
                                       ("neuro_fuzzy", NEURO_FUZZY))}),
)  # fmt: skip
PARTS = (
    ("Neuro-fuzzy friction models for a triple link rotary inverted pendulum (TLRIP)", FIRST),
    ("Comparison of friction estimation models (RTIP)", SECOND),
    ("Future work of the papers", FUTURE),
    ("Not in the papers", OTHERS),
)
ITEMS = tuple(item for _, items in PARTS for item in items)
SWING_UP = "control_swing_up"
"""Table and animation of the swing-up."""


def all_tables(workspace: Workspace) -> dict[str, tuple[str, pd.DataFrame]]:
    """Caption and content of every table, by file name."""
    return {
        name: (caption, make(workspace))
        for item in ITEMS
        for name, (caption, make) in item.tables.items()
    }


def write_tables(workspace: Workspace, *, command: str = "") -> list[Path]:
    """Write `tables/*.csv`, `rmse.csv` with every error, and `results.json`."""
    results = {
        "command": command,
        "settings": workspace.settings.to_dict(),
        "order": tables.order(workspace)._asdict(),
        "stages": {name: workspace.found(name) for name in stages()},
    }
    content = {
        "rmse.csv": tables.long_table(workspace).to_csv(index=False),
        "results.json": json.dumps(results, indent=1, allow_nan=False),
    }
    for name, (_, table) in all_tables(workspace).items():
        content[f"tables/{name}.csv"] = _flat(table).to_csv(index_label="row")
    return [write_atomically(workspace.folder / n, t.encode()) for n, t in content.items()]


def text(workspace: Workspace) -> str:
    """All tables with the printed values, and the status of the fits."""
    parts = [
        f"{caption}\n"
        + _shown(caption, table).to_string(float_format=lambda x: f"{x:.4g}", na_rep="")
        for caption, table in all_tables(workspace).values()
    ]
    parts.append(
        "printed: the papers' numbers, from recordings that were never published, with the "
        "friction of another\nrig; ours: from simulated twins. -papers: by the papers' own "
        "procedure (fuzzy controller, 2-10-2 network),\n-pattern: by their pattern search."
    )
    return "\n\n".join([*parts, f"how the fits ended\n{tables.fit_ends(workspace)}"])


def draw_all(workspace: Workspace, *, progress: bool = False) -> list[Path]:
    """Draw every figure of both papers as PNG in `figures/`; returns the files written."""
    folder, written = workspace.folder / "figures", []
    drawings = {name: draw for item in ITEMS for name, draw in item.figures.items()}
    for name, draw in tqdm(drawings.items(), unit="figure", disable=not progress, leave=False):
        figure, path = draw(workspace), folder / f"{name}.png"
        # An interrupt must not leave an incomplete picture under the final name.
        with atomic_write(path) as temporary:
            figure.savefig(temporary, dpi=DPI, format="png")
        figure.clear()
        written.append(path)
    lifted = workspace.arrays("control")[f"swing-up, {SHARED}"]
    time = THINNED * SAMPLE_TIME * np.arange(len(lifted), dtype=np.float64)
    motion = {f"swing-up, {SHARED} compensated": lifted}
    plant, gif = rigs.rtip("free"), folder / f"{SWING_UP}.gif"
    return [*written, animate(plant, time, motion, gif, seconds=8.0)]


def write_page(workspace: Workspace) -> Path:
    """Write `reproduction.html` with the tables and the figures that were drawn."""
    made = all_tables(workspace)
    parts = [
        (title, [_rendered(workspace, made, item) for item in items]) for title, items in PARTS
    ]
    template = jinja2.Environment(autoescape=True).from_string(_TEMPLATE.read_text("utf-8"))
    page = template.render(
        parts=parts, style=_STYLE.read_text(encoding="utf-8"), version=__version__,
        conclusion=tables.conclusion(workspace).splitlines(),
        fits=tables.fit_ends(workspace), settings=workspace.settings.to_dict(),
    )  # fmt: skip
    return write_atomically(workspace.folder / PAGE, page.encode())


def _rendered(
    workspace: Workspace, made: Mapping[str, tuple[str, pd.DataFrame]], item: Item
) -> dict[str, Any]:
    """An item's tables with cells as text, and its pictures as URLs."""
    ends = [f"{name}: {workspace.found(name)['fit']['status']}" for name in item.models]
    shown = [made[name] for name in item.tables]
    pictures = {
        path.name: f"data:image/{path.suffix[1:]};base64,"
        + base64.b64encode(path.read_bytes()).decode()
        for name in (*item.figures, *item.tables)
        for path in (workspace.folder / "figures").glob(f"{name}.*")
    }
    return {
        "title": item.title,
        "differs": " ".join([item.differs, *ends]),
        "tables": [(caption, _flat(_shown(caption, t)).map(_cell)) for caption, t in shown],
        "pictures": pictures.items(),
    }


def _shown(caption: str, table: pd.DataFrame) -> pd.DataFrame:
    # Coefficients stay in SI; errors are shown in thousandths.
    return 1e3 * table if "[mrad]" in caption else table


def _flat(table: pd.DataFrame) -> pd.DataFrame:
    # One header row, so that any CSV reader can read it.
    return table.set_axis([f"{column[1]}, {column[0]}" for column in table.columns], axis=1)


def _cell(value: Any) -> str:
    if isinstance(value, str):
        return value
    return "" if pd.isna(value) else f"{value:.4g}"

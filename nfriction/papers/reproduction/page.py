"""One page with every table and figure of both papers, in their order, beside what they print."""

import base64
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any

import jinja2
import pandas as pd

from nfriction.io.files import write_atomically
from nfriction.papers.reproduction.stages import NEURO_FUZZY
from nfriction.papers.reproduction.tables import all_tables, conclusion, fit_ends, order
from nfriction.papers.reproduction.workspace import Workspace
from nfriction.version import __version__

PAGE = "reproduction.html"
_STYLE = resources.files("nfriction.report") / "templates" / "page.css"
_TEMPLATE = resources.files("nfriction.papers.reproduction") / "data" / "page.html.j2"


@dataclass(frozen=True)
class Item:
    """A table or figure of a paper on the page.

    Attributes:
        title: its number and caption's content.
        files: names of tables and figures here, without ending.
        differs: how ours differs from the paper's, if it does.
        models: whose fits ended as the page then says.
    """

    title: str
    files: tuple[str, ...]
    differs: str = ""
    models: tuple[str, ...] = ()


FIRST = (
    Item("Fig. 2: swing from 0°, 20°, 30°, 40° for three cases of inertia", ("fig_02_inertia",),
         "No full tensor is printed; ours is Izz across and a tenth of it along each link."),
    Item("Fig. 4: model without friction, an independent simulation and the measured motion",
         ("fig_04_without_friction", "fig_4_agreement"),
         "MuJoCo takes the place of SimMechanics, the twin that of the measured motion."),
    Item("Table 6 and the experiment: classes of acceleration over time",
         ("table_6", "experiment_classes"),
         "The experiment is a release from upright, the reading of 180° that fits Table 4."),
    Item("Tables 7, 8, 9: adaptive coefficients by class", ("table_7", "table_8", "table_9"),
         "The printed ones are lost in the scan. The paper searches by pattern; Gauss-Newton's are "
         "those from which the neuro-fuzzy models start."),
    Item("Fig. 7 and Table 4: fuzzy sets of joint 2", ("fig_07_memberships",)),
    Item("Fig. 8 and Table 5: coefficients that the fuzzy controllers give",
         tuple(f"fig_08_surfaces_joint_{joint}" for joint in (2, 3, 4)),
         "Rules (b) and (c) are lost; all joints have rules (a)."),
    Item("Networks 2-10-2 after their training on the controllers' outputs", ("networks_NFLFM",),
         "The paper shows none. Controllers here span the coefficients by class of the twin.",
         ("NFLFM-papers",)),
    Item("Figs. 11, 12, 13: coefficients of the neuro-fuzzy models in the experiment",
         ("fig_11_coefficients_NFNCFM", "fig_12_coefficients_NFLFM",
          "fig_13_coefficients_NFNLFM"),
         "Where the network's correction did not pass its hold-out windows, a joint has the steps "
         "of the classes alone.", NEURO_FUZZY),
    Item("Fig. 14: measured and simulated position", ("fig_14_positions_NFNLFM",),
         "On a recording that no model was fitted to."),
    Item("Table 10: position error of every model",
         ("table_10", "table_10_measured_drive", "rmse"),
         "Another machine's friction: the printed numbers cannot come out. -pattern: by the "
         "papers' pattern search; -papers: by their fuzzy controller and network."),
    Item("Table 11: error of NFNLFM below that of each other model", ("table_11", "error_saved")),
)  # fmt: skip
SECOND = (
    Item("Fig. 3: four joints from 0°, 20°, 30°, 40°", ("second_fig_3_free_arm",),
         "Counted from hanging, as that paper does."),
    Item("Tables I, II, III: coefficients",
         ("second_table_i", "second_table_ii", "second_table_iii"),
         "Coefficients of the twin."),
    Item("Figs. 5, 6, 7: measured and simulated position, first 10 s, one scale of error",
         ("second_fig_5_NCFM", "second_fig_6_LFM", "second_fig_7_NLFM"),
         "From 20°, 30°, 40°, which no model was fitted to; the paper shows its own fit from 45°."),
    Item("Fig. 8: friction torque over velocity", ("second_fig_8_torque",),
         "Dots: the torque that the smoothed motion implies."),
    Item("Table IV: position error", ("second_table_iv", "second_rmse")),
)  # fmt: skip
FUTURE = (
    Item("Control of the rig with the friction models",
         ("control_still", "control_follow", "control_balance", "control_swing_up",
          "control_three_links"),
         "In simulation."),
)  # fmt: skip
OTHERS = (
    Item("Positions by kind of model", tuple(f"positions_joint_{joint}" for joint in (2, 3, 4))),
)
PARTS = (
    ("Neuro-fuzzy friction models for a triple link rotary inverted pendulum (TLRIP)", FIRST),
    ("Comparison of friction estimation models (RTIP)", SECOND),
    ("Future work of the papers", FUTURE),
    ("Not in the papers", OTHERS),
)


def write_page(workspace: Workspace) -> Path:
    """Write `reproduction.html` with the tables, and the figures that were drawn."""
    tables = all_tables(workspace)
    parts = [(title, [_shown(workspace, tables, item) for item in items]) for title, items in PARTS]
    made = jinja2.Environment(autoescape=True).from_string(_TEMPLATE.read_text(encoding="utf-8"))
    text = made.render(
        parts=parts, style=_STYLE.read_text(encoding="utf-8"), version=__version__,
        conclusion=conclusion(workspace).splitlines(), order=str(order(workspace)),
        fits=fit_ends(workspace), settings=workspace.settings.to_dict(),
    )  # fmt: skip
    return write_atomically(workspace.folder / PAGE, text.encode())


def _shown(
    workspace: Workspace, tables: dict[str, tuple[str, pd.DataFrame]], item: Item
) -> dict[str, Any]:
    """An item's tables as headings and rows of text, and its pictures as URLs."""
    ends = [f"{name}: {workspace.found(name)['fit']['status']}" for name in item.models]
    differs = " ".join([item.differs, *ends]).strip()
    shown: dict[str, Any] = {"item": item, "differs": differs, "tables": [], "pictures": []}
    for name in item.files:
        if name in tables:
            caption, table = tables[name]
            # Coefficients stay in SI; errors are read in thousandths.
            table = 1e3 * table if "[mrad]" in caption else table
            columns = [f"{column[1]}, {column[0]}" for column in table.columns]
            rows = [(str(n), [_text(v) for v in row]) for n, row in
                    zip(table.index, table.to_numpy(), strict=True)]  # fmt: skip
            shown["tables"].append((caption, columns, rows))
        for suffix, kind in ((".png", "png"), (".gif", "gif")):
            path = workspace.folder / "figures" / f"{name}{suffix}"
            if path.exists():
                data = base64.b64encode(path.read_bytes()).decode()
                shown["pictures"].append((path.name, f"data:image/{kind};base64,{data}"))
    return shown


def _text(value: Any) -> str:
    if isinstance(value, str):
        return value
    return "" if pd.isna(value) else f"{value:.4g}"

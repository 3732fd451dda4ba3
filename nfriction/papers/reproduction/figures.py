"""The papers' figures from what the stages found."""

from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
import torch
from matplotlib.figure import Figure
from tqdm import tqdm

from nfriction.evaluation.score import RMSE, Score
from nfriction.io.atomic import replacing
from nfriction.io.model_file import load
from nfriction.papers.afem.adaptive import Adaptive
from nfriction.papers.controller.mamdani import paper_controller
from nfriction.papers.reproduction import drawing as papers
from nfriction.papers.reproduction import printed, tables
from nfriction.papers.reproduction.stages import ADAPTIVE, LAWS, NEURO_FUZZY, SECOND_PAPER
from nfriction.papers.reproduction.workspace import Array, Workspace
from nfriction.plant import rigs
from nfriction.plots import controller_surface, positions, rmse_bars
from nfriction.recording import Recording
from nfriction.simulation.rollout import rollout

DPI = 150
SHOWN, SECOND_SHOWN = "test_hanging", "test_bent"
"""Held-out recordings that the figures show: the poses of the papers' own model checks."""
INERTIA_SECONDS = 5.0
"""Beyond this a frictionless swing from upright tells rounding rather than inertia."""


def draw_all(workspace: Workspace, *, progress: bool = False) -> list[Path]:
    """Draw every figure of both papers as PNG in `figures/`.

    Returns:
        The files written.
    """
    written = []
    drawers = figures(workspace)
    for name, draw in tqdm(drawers.items(), unit="figure", disable=not progress, leave=False):
        figure = draw()
        path = workspace.folder / "figures" / f"{name}.png"
        with replacing(path) as temporary:
            figure.savefig(temporary, dpi=DPI, format="png")
        figure.clear()
        written.append(path)
    return written


def figures(workspace: Workspace) -> dict[str, Callable[[], Figure]]:
    """What draws each figure, by the name of its file."""
    found: dict[str, Callable[[], Figure]] = {
        "fig_02_inertia": inertia_cases,
        "fig_04_experiment": lambda: experiment(workspace),
        "fig_07_memberships": lambda: papers.controller_memberships(paper_controller(2)),
        "fig_08_surfaces": lambda: controller_surface(paper_controller(2)),
    }
    for joint in range(3):
        found[f"fig_{11 + joint}_joint_{joint + 2}"] = lambda j=joint: model_groups(workspace, j)  # type: ignore[misc]
    found["fig_14_rmse"] = lambda: error_bars(workspace)
    found["second_fig_3_motion"] = lambda: papers.recorded_motion(workspace.bench("rtip").train)
    for number, law in zip((5, 6, 7), LAWS, strict=True):
        found[f"second_fig_{number}_{law}"] = lambda n=law: second_positions(workspace, n)  # type: ignore[misc]
    found["second_fig_8_rmse"] = lambda: rmse_bars(
        tables.rmse(workspace, SECOND_PAPER).rename(lambda name: name.removeprefix("rtip-")), "rad"
    )
    return found


def inertia_cases() -> Figure:
    """A frictionless swing of the TLRIP rig by what its inertia is taken to be.

    Links as point masses, as slender rods with the printed Izz, and with a full tensor. With the
    arm fixed the motion stays in a plane and only Izz enters, so the last two coincide.

    References:
        TLRIP paper, Fig. 2.
    """
    izz = (0.04, 0.05, 0.05)
    full = [[0.1 * i, i, i, 0.0, 0.0, 0.0] for i in izz]
    cases = {
        "inertia neglected": rigs.tlrip(inertia="none"),
        "Izz only": rigs.tlrip(inertia="izz"),
        "full tensor": rigs.tlrip(inertia=full),
    }
    q0 = torch.deg2rad(torch.tensor([20.0, 30.0, 40.0], dtype=torch.float64))
    steps = round(INERTIA_SECONDS * 1000)
    runs = {
        name: rollout(plant, None, q0, torch.zeros_like(q0), sample_time=1e-3, steps=steps)
        for name, plant in cases.items()
    }
    time = next(iter(runs.values())).time.numpy()
    motions = {name: run.q.numpy() for name, run in runs.items()}
    return papers.free_swings(time, motions, printed.JOINTS)


def experiment(workspace: Workspace) -> Figure:
    """The friction experiment, smoothed, with the classes of acceleration found in it.

    References:
        TLRIP paper, Fig. 4 and Table 6.
    """
    bench = workspace.bench("tlrip")
    recording = next(r for r in bench.train if r.name == "train_hanging")
    schedule = load(workspace.model(ADAPTIVE[-1])).schedule
    assert isinstance(schedule, Adaptive)
    smooth = bench.motions[recording.name]
    classes = schedule.classes(torch.tensor(smooth.qd), torch.tensor(smooth.qdd)).numpy()
    return papers.motion_with_classes(
        smooth, classes, printed.JOINTS,
        printed=printed.TABLE_6,
    )  # fmt: skip


def model_groups(workspace: Workspace, joint: int) -> Figure:
    """Measured and simulated position of one joint by kind of model.

    References:
        TLRIP paper, Figs. 11 to 13.
    """
    bench = workspace.bench("tlrip")
    recording = next(r for r in bench.test if r.name == SHOWN)
    kinds: Mapping[str, tuple[str, ...]] = {
        "constant": tuple(LAWS),
        "adaptive": ADAPTIVE,
        "neuro-fuzzy": NEURO_FUZZY,
    }
    groups = {
        kind: {name: workspace.arrays(name)[SHOWN] for name in names}
        for kind, names in kinds.items()
    }
    return papers.positions_by_group(recording, joint, groups)


def error_bars(workspace: Workspace) -> Figure:
    """Position error of every model by joint.

    References:
        TLRIP paper, Fig. 14.
    """
    models = [*LAWS, *ADAPTIVE, *NEURO_FUZZY]
    return rmse_bars(tables.rmse(workspace, models), "rad")


def second_positions(workspace: Workspace, law: str) -> Figure:
    """Measured and simulated positions on the second paper's rig.

    References:
        RTIP paper, Figs. 5 to 7.
    """
    bench = workspace.bench("rtip")
    recording = next(r for r in bench.test if r.name == SECOND_SHOWN)
    simulated = workspace.arrays(f"rtip-{law}")[SECOND_SHOWN]
    return positions(recording, {law: _score(recording, simulated)})


def _score(recording: Recording, simulated: Array) -> Score:
    """What a figure needs of a score, from simulated positions."""
    lost = ~np.isfinite(simulated).all(-1)
    return Score(
        recording=recording.name,
        free_run=RMSE.of(simulated - recording.q),
        windows={},
        floor=None,
        time=recording.time,
        simulated=simulated,
        diverged_at=float(recording.time[lost.argmax()]) if lost.any() else np.inf,
    )

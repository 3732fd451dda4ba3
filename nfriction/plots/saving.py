"""Write the figures that a comparison yields."""

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from nfriction.evaluation.compare import Comparison
from nfriction.evaluation.score import Score
from nfriction.friction.coefficients import Constant
from nfriction.friction.models import FrictionModel
from nfriction.friction.neurofuzzy import NeuroFuzzy
from nfriction.plots.coefficients import coefficients_over_time
from nfriction.plots.dark import GROUND, for_dark_screen
from nfriction.plots.errors import horizon_curve, positions, rmse_bars
from nfriction.plots.fits import torque_over_velocity
from nfriction.plots.fuzzy import memberships
from nfriction.plots.surfaces import coefficient_sections, coefficient_surfaces
from nfriction.recording import Recording
from nfriction.signals import Motion

DPI = 150


def save_all(
    comparison: Comparison, recordings: Sequence[Recording], folder: str | Path
) -> list[Path]:
    """Write every figure of a comparison as PNG, and as `NAME.dark.png` for a dark screen.

    `rmse_*` and `horizons_*` for training and held-out recordings, `positions_*` for each
    recording given, `torque_over_velocity`, `over_time_*` for each law of which a model follows the
    motion, and for each neuro-fuzzy model `coefficients_*`, `sections_*` and `memberships_*`.

    Args:
        comparison: fits and scores.
        recordings: those compared, or some of them.
        folder: made where it does not exist; files of the same name are replaced.

    Returns:
        The files written.

    Raises:
        ValueError: if a recording is not among those compared.
    """
    scored = {s.recording for of in _kinds(comparison).values() for s in next(iter(of.values()))}
    for recording in recordings:
        if recording.name not in scored:
            raise ValueError(
                f"recording {recording.name!r} is not in the comparison, which has "
                f"{', '.join(sorted(scored))}."
            )
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    written: list[Path] = []
    for name, figure in _figures(comparison, recordings):
        stem = re.sub(r"[^\w-]+", "_", name)
        path = folder / f"{stem}.png"
        for count in range(2, 2 + len(written)):
            if path not in written:
                break
            path = folder / f"{stem}_{count}.png"
        figure.savefig(path, dpi=DPI)
        shade = path.with_suffix(".dark.png")
        for_dark_screen(figure, ground=GROUND).savefig(shade, dpi=DPI)
        figure.clear()
        written += [path, shade]
    return written


def _kinds(comparison: Comparison) -> dict[str, dict[str, list[Score]]]:
    kinds = {"train": comparison.train, "held_out": comparison.held_out}
    return {kind: scores for kind, scores in kinds.items() if scores}


def _figures(
    comparison: Comparison, recordings: Sequence[Recording]
) -> Iterator[tuple[str, Figure]]:
    """Name and figure, one after the other, so that only one is in memory."""
    for kind, scores in _kinds(comparison).items():
        held_out = kind == "held_out"
        yield f"rmse_{kind}", rmse_bars(comparison.table(held_out=held_out), comparison.unit)
        yield f"horizons_{kind}", horizon_curve(comparison, held_out=held_out)
        for recording in recordings:
            of = {m: s for m, many in scores.items() for s in many if s.recording == recording.name}
            if of:
                yield f"positions_{kind}_{recording.name}", positions(recording, of)
    if not comparison.fits:
        return
    last = list(comparison.fits.values())[-1]
    order = [s.recording for s in next(iter(comparison.train.values()))]
    moved = last.motions
    if last.encoder_offsets:
        moved = tuple(
            replace(m, q=m.q + z) for m, z in zip(moved, last.encoder_offsets, strict=True)
        )
    trained = dict(zip(order, moved, strict=True))
    given = [r for r in recordings if r.name in trained]
    joints = comparison.joint_names
    models = {name: found.model for name, found in comparison.fits.items()}
    if given:
        motions = [trained[r.name] for r in given]
        yield "torque_over_velocity", torque_over_velocity(last.plant, models, given, motions)
    yield from _over_time(models, last.motions[0], joints, comparison.unit)
    for name, found in comparison.fits.items():
        if isinstance(found.model.schedule, NeuroFuzzy):
            labels: dict[str, Any] = {"joint_names": joints, "unit": comparison.unit}
            known = labels | {"motions": last.motions, "uncertainty": found.uncertainty}
            yield f"coefficients_{name}", coefficient_surfaces(found.model, **known)
            yield f"sections_{name}", coefficient_sections(found.model, **known)
            yield f"memberships_{name}", memberships(found.model, **labels)


def _over_time(
    models: Mapping[str, FrictionModel], motion: Motion, joints: Sequence[str], unit: str
) -> Iterator[tuple[str, Figure]]:
    """Coefficients of each law of which a model follows the motion, beside its constant ones."""
    by_law: dict[str, dict[str, FrictionModel]] = {}
    for name, model in models.items():
        by_law.setdefault(model.law.name, {})[name] = model
    for law, of in by_law.items():
        if not all(isinstance(model.schedule, Constant) for model in of.values()):
            yield (
                f"over_time_{law}",
                coefficients_over_time(of, motion, joint_names=joints, unit=unit),
            )

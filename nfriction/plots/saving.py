"""Write the figures that a comparison yields."""

import re
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from matplotlib.figure import Figure

from nfriction.evaluation.compare import Comparison
from nfriction.friction.models import FrictionModel
from nfriction.plots.comparison import horizon_curve, positions, rmse_bars
from nfriction.plots.drawing import mechanism
from nfriction.plots.friction_torque import torque_over_velocity
from nfriction.plots.neurofuzzy import (
    coefficient_sections,
    coefficient_surfaces,
    coefficients_over_time,
    memberships,
)
from nfriction.recording import Recording

DPI = 150
RUN_KEY = "nfriction run"
"""Of the text in a PNG file that names its run."""


def save_all(
    comparison: Comparison,
    recordings: Sequence[Recording],
    folder: str | Path,
    *,
    run: str = "",
    formats: Sequence[str] = (),
) -> list[Path]:
    """Write every figure of a comparison as PNG.

    `mechanism`, `rmse_*` and `horizons_*` for test and training recordings, `positions_*` for each
    recording given, `torque_over_velocity`, `over_time_*` for each law of which a model follows the
    motion, and for each neuro-fuzzy model `coefficients_*`, `sections_*` and `memberships_*`. A
    network that was rejected has constant coefficients and none of these.

    Args:
        comparison: fits and scores.
        recordings: those compared, or some of them.
        folder: made where it does not exist; files of the same name are replaced.
        run: id of the run, kept in each PNG file.
        formats: further ones: `"svg"` or `"pdf"` for papers, `"gif"` for animations of the test
            recordings, `motion_1.gif` and so on.

    Returns:
        The files written.

    Raises:
        ValueError: if a recording is not among those compared.
    """
    scored = {
        s.recording for p in comparison.parts for s in next(iter(comparison.scores(p).values()))
    }
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
        # Names come from recordings, which may hold any character.
        stem = re.sub(r"[^\w-]+", "_", name)
        path = folder / f"{stem}.png"
        # Two names may differ only in characters that were replaced.
        for count in range(2, 2 + len(written)):
            if path not in written:
                break
            path = folder / f"{stem}_{count}.png"
        kept = {RUN_KEY: run} if run else {}
        figure.savefig(path, dpi=DPI, metadata=kept)
        for ending in set(formats) - {"gif"}:
            figure.savefig(path.with_suffix(f".{ending}"))
            written.append(path.with_suffix(f".{ending}"))
        figure.clear()
        written.append(path)
    if "gif" in formats and comparison.fits:
        tested = {s.recording for of in comparison.test.values() for s in of}
        for k, recording in enumerate(r for r in recordings if r.name in tested):
            written.append(comparison.animate(recording, folder / f"motion_{k + 1}.gif"))
    return written


def _figures(
    comparison: Comparison, recordings: Sequence[Recording]
) -> Iterator[tuple[str, Figure]]:
    """Name and figure, one after the other, so that only one is in memory."""
    for part in comparison.parts:
        scores = comparison.scores(part)
        table = comparison.table(part=part)
        if len(comparison.joint_names) == 1:
            table = table.drop(columns="all")  # it would repeat the joint's bars
        yield f"rmse_{part}", rmse_bars(table, comparison.unit)
        yield f"horizons_{part}", horizon_curve(comparison, part=part)
        for recording in recordings:
            of = {m: s for m, many in scores.items() for s in many if s.recording == recording.name}
            if of:
                yield f"positions_{part}_{recording.name}", positions(recording, of)
    # A comparison that was read from a file has scores only.
    if not comparison.fits:
        return
    last = list(comparison.fits.values())[-1]
    yield "mechanism", mechanism(last.plant)
    moved = last.motions
    if last.encoder_offsets:
        # Motions are kept as recorded; the plant expects corrected angles.
        pairs = zip(moved, last.encoder_offsets, strict=True)
        moved = tuple(replace(m, q=m.q + offset) for m, offset in pairs)
    order = [s.recording for s in next(iter(comparison.train.values()))]
    trained = dict(zip(order, moved, strict=True))
    given = [r for r in recordings if r.name in trained]
    models = {name: found.model for name, found in comparison.fits.items()}
    if given:
        motions = [trained[r.name] for r in given]
        bands = {
            name: found.uncertainty
            for name, found in comparison.fits.items()
            if found.uncertainty is not None
        }
        figure = torque_over_velocity(last.plant, models, given, motions, uncertainty=bands)
        yield "torque_over_velocity", figure
    labels: dict[str, Any] = {"joint_names": comparison.joint_names, "unit": comparison.unit}
    for law in dict.fromkeys(model.law.name for model in models.values()):
        of_law = {name: model for name, model in models.items() if model.law.name == law}
        # Constants along the motion are worth a figure beside coefficients that follow it.
        if any(_follows_motion(model) for model in of_law.values()):
            yield f"over_time_{law}", coefficients_over_time(of_law, last.motions[0], **labels)
    for name, found in comparison.fits.items():
        if found.model.schedule.fuzzy_rules() is not None and _follows_motion(found.model):
            known = labels | {"motions": last.motions, "uncertainty": found.uncertainty}
            yield f"coefficients_{name}", coefficient_surfaces(found.model, **known)
            yield f"sections_{name}", coefficient_sections(found.model, **known)
            yield f"memberships_{name}", memberships(found.model, **labels)


def _follows_motion(model: FrictionModel) -> bool:
    """True unless the coefficients are constants, as also those of a rejected network."""
    rules = model.schedule.fuzzy_rules()
    if rules is None:
        return model.schedule.follows_motion
    first = rules.coefficients[:, :1].expand_as(rules.coefficients)
    # A network's sums round.
    return not torch.allclose(rules.coefficients, first, rtol=1e-9, atol=0.0)

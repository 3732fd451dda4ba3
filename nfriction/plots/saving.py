"""Write the figures that a comparison yields."""

import re
from collections.abc import Iterator, Sequence
from pathlib import Path

from matplotlib.figure import Figure

from nfriction.comparison import Comparison
from nfriction.friction import NeuroFuzzy
from nfriction.plots.errors import horizon_curve, positions, rmse_bars
from nfriction.plots.fits import torque_over_velocity
from nfriction.plots.fuzzy import coefficient_surfaces, memberships
from nfriction.recording import Recording
from nfriction.scoring import Score

DPI = 150


def save_all(
    comparison: Comparison, recordings: Sequence[Recording], folder: str | Path
) -> list[Path]:
    """Write every figure of a comparison as PNG.

    `rmse_*` and `horizons_*` for training and held-out recordings, `positions_*` for each
    recording given, `torque_over_velocity`, and for each neuro-fuzzy model `coefficients_*` and
    `memberships_*`.

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
        stem = re.sub(r"[^\w.-]+", "_", name)
        path = folder / f"{stem}.png"
        for count in range(2, 2 + len(written)):
            if path not in written:
                break
            path = folder / f"{stem}_{count}.png"
        figure.savefig(path, dpi=DPI)
        figure.clear()
        written.append(path)
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
    trained = dict(zip(order, last.motions, strict=True))
    given = [r for r in recordings if r.name in trained]
    joints = comparison.joint_names
    models = {name: found.model for name, found in comparison.fits.items()}
    if given:
        motions = [trained[r.name] for r in given]
        yield "torque_over_velocity", torque_over_velocity(last.plant, models, given, motions)
    for name, model in models.items():
        if isinstance(model.schedule, NeuroFuzzy):
            yield (
                f"coefficients_{name}",
                coefficient_surfaces(model, last.motions, joint_names=joints, unit=comparison.unit),
            )
            yield (
                f"memberships_{name}",
                memberships(model, joint_names=joints, unit=comparison.unit),
            )

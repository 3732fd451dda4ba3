"""Write a comparison's folder: tables, results, models, artefacts and figures."""

import json
import logging
import re
import tempfile
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

from nfriction.evaluation.compare import Comparison
from nfriction.evaluation.cross_validation import Selection
from nfriction.export import ExportError, torchscript
from nfriction.fitting.result.fit_result import FitResult
from nfriction.io.atomic import write_atomically
from nfriction.io.model_file import save
from nfriction.io.model_info import ModelInfo
from nfriction.recording import Recording

logger = logging.getLogger(__name__)

RESULTS, TABLE = "results.json", "table.csv"
# Largest ratio of sample times that differ by the clocks of hosts, and not by what was set.
CLOCKS = 1.05
# Files that a run may have written and a later one removes: in its own folders, no way out of them.
OURS = re.compile(r"table\.csv|models/\w+\.(json|pt)|figures/\w[\w.-]*\.png")


def digests(recordings: Sequence[Recording]) -> dict[str, str]:
    """Digest of every recording by its name, and by its place too where that is not its own."""
    names = [recording.name for recording in recordings]
    return {
        name if name and names.count(name) == 1 else f"{name or 'recording'} ({place})": r.digest()
        for place, (name, r) in enumerate(zip(names, recordings, strict=True), 1)
    }


def model_info(fit: FitResult, recordings: Sequence[Recording]) -> ModelInfo:
    """Entries of a model file that describe a fit to these recordings."""
    qd = np.concatenate([m.qd for m in fit.motions])
    qdd = np.concatenate([m.qdd for m in fit.motions])
    times = sorted(r.sample_time for r in recordings)
    return ModelInfo(
        joint_names=tuple(fit.plant.joint_names),
        unit=fit.plant.unit,
        # Of several sample times, a controller's is not known.
        sample_time=times[len(times) // 2] if times[-1] <= CLOCKS * times[0] else None,
        input_ranges={
            "qd": np.stack([qd.min(0), qd.max(0)], -1).tolist(),
            "qdd": np.stack([qdd.min(0), qdd.max(0)], -1).tolist(),
        },
        training_data=digests(recordings),
        rig=fit.plant.to_dict(),
        fit=fit.to_dict(),
    )


def write_results(
    comparison: Comparison,
    train: Sequence[Recording],
    test: Sequence[Recording],
    folder: str | Path,
    *,
    selection: Selection | None = None,
    command: str = "",
    figures: bool = True,
) -> list[Path]:
    """Write `table.csv`, `results.json`, the models with their TorchScript, and figures.

    `results.json` lists the files. Those that an earlier run listed there are removed, so that
    the folder afterwards holds files of this run, and the user's own.

    Args:
        comparison: fits and scores.
        train, test: their recordings.
        folder: made where it does not exist.
        selection: the choice on the training recordings alone, if there is one.
        command: reproduces the results.
        figures: draw them.
    """
    folder = Path(folder)
    results = comparison.to_dict() | {
        "selection": None if selection is None else selection.to_dict(),
        "command": command,
        "recordings": {"train": digests(train), "test": digests(test)},
    }

    def write_index(files: Iterable[Path]) -> Path:
        own = {"files": sorted({path.relative_to(folder).as_posix() for path in files})}
        text = json.dumps(results | own, indent=1, allow_nan=False)
        return write_atomically(folder / RESULTS, text.encode())

    earlier = files_of(folder)
    models = {name: folder / "models" / f"{name}.json" for name in comparison.fits}
    table = write_atomically(folder / TABLE, comparison.to_frame().to_csv(index=False).encode())
    # Listed before they exist: if this run is interrupted, the next one knows its files.
    write_index(
        [*earlier, table, *models.values(), *(m.with_suffix(".pt") for m in models.values())]
    )
    written = [table]
    for name, path in models.items():
        written += _write_model(comparison.fits[name], path, train)
    for path in set(earlier) - set(written):
        path.unlink(missing_ok=True)
    index = write_index(written)
    if figures:
        from nfriction import plots  # matplotlib takes half a second that other commands save

        (folder / "figures").mkdir(exist_ok=True)
        with tempfile.TemporaryDirectory(dir=folder, prefix=".") as unfinished:
            drawn = plots.save_all(comparison, [*train, *test], unfinished)
            places = [folder / "figures" / path.name for path in drawn]
            write_index([*written, *places])
            written += [path.replace(to) for path, to in zip(drawn, places, strict=True)]
    return [index, *written]


def files_of(folder: Path) -> list[Path]:
    """Files that an earlier run listed in its `results.json`.

    Only names that a run writes count, because the file may be anybody's.
    """
    try:
        content = json.loads((folder / RESULTS).read_text(encoding="utf-8"))
    except (FileNotFoundError, NotADirectoryError, ValueError, RecursionError):
        return []
    listed = content.get("files") if isinstance(content, dict) else None
    names = listed if isinstance(listed, list) else []
    return [folder / name for name in names if isinstance(name, str) and OURS.fullmatch(name)]


def _write_model(fit: FitResult, path: Path, recordings: Sequence[Recording]) -> list[Path]:
    """The model file and its TorchScript, where it has one."""
    info = model_info(fit, recordings)
    written = [save(fit.model, path, info)]
    try:
        written.append(torchscript(fit.model, path.with_suffix(".pt"), info))
    except ExportError as error:
        logger.warning("%s was not exported: %s", path.stem, " ".join(str(error).split()))
    return written

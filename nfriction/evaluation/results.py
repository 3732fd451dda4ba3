"""Write a comparison's folder: tables, results, models, artefacts and figures, all of one run."""

import errno
import hashlib
import json
import logging
import re
import shutil
import unicodedata
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
from filelock import FileLock, Timeout

from nfriction.evaluation.compare import Comparison
from nfriction.evaluation.cross_validation import Selection
from nfriction.evaluation.score import Score
from nfriction.export import ExportError, torchscript
from nfriction.fitting.result.fit_result import FitResult
from nfriction.io.files import checked_json, write_atomically
from nfriction.io.model_file import ModelInfo, parameter_hash, save
from nfriction.recording import Recording, RecordingLike

logger = logging.getLogger(__name__)

RESULTS, TABLE, REPORT = "results.json", "table.csv", "report.html"
# Files that a run writes and a later run may remove: only in its own folders, never outside them.
OURS = re.compile(r"table\.csv|models/[\w-]+\.(json|pt)|figures/\w[\w.-]*\.(png|svg|pdf|gif)")
REPORT_MARK = b'<meta name="generator" content="nfriction'
"""Near the top of every report; a `report.html` without it is the user's own."""
# In the folder while it is written: the lock, incomplete files, complete files.
LOCK, UNFINISHED, COMPLETE = ".nfriction.lock", ".nfriction-unfinished", ".nfriction-complete"
EARLIER = "earlier.json"
# Largest ratio of sample times attributed to differing host clocks rather than to settings.
CLOCKS = 1.05


def digests(recordings: Sequence[Recording]) -> dict[str, str]:
    """Digest of every recording by its name, and also by its place if the name is not unique."""
    names = [recording.name for recording in recordings]
    return {
        name if name and names.count(name) == 1 else f"{name or 'recording'} ({place})": r.digest()
        for place, (name, r) in enumerate(zip(names, recordings, strict=True), 1)
    }


def model_info(
    fit: FitResult, recordings: RecordingLike | Iterable[RecordingLike], run: str = ""
) -> ModelInfo:
    """Description of a fit for `save` and exports: rig, ranges of the training data, rating.

    Args:
        fit: the result; ranges are those of its smoothed motions [rad/s, rad/s²; m/s, m/s²].
        recordings: to which it was fitted, or their paths; their digests and sample time [s] are
            included.
        run: id of the run that made it.
    """
    recordings = Recording.many(recordings, plant=fit.plant, name="recordings")
    qd = np.concatenate([m.qd for m in fit.motions])
    qdd = np.concatenate([m.qdd for m in fit.motions])
    times = sorted(r.sample_time for r in recordings)
    return ModelInfo(
        joint_names=tuple(fit.plant.joint_names),
        unit=fit.plant.unit,
        # With several sample times, that of a controller is unknown.
        sample_time=times[len(times) // 2] if times[-1] <= CLOCKS * times[0] else None,
        input_ranges={
            "qd": np.stack([qd.min(0), qd.max(0)], -1).tolist(),
            "qdd": np.stack([qdd.min(0), qdd.max(0)], -1).tolist(),
        },
        training_data=digests(recordings),
        rig=fit.plant.to_dict(),
        fit=fit.to_dict() | ({"run": run} if run else {}),
    )


@contextmanager
def exclusive(folder: str | Path) -> Iterator[None]:
    """Keep other processes from writing a run into this folder, which is made if necessary.

    First cleans up after a killed process: complete files are put in place, others are removed.
    Raises OSError if another process is writing it, or it cannot be written.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    # One object for all uses of a path in a process, so that `write_results` may run within.
    lock = FileLock(folder.resolve() / LOCK, timeout=0, is_singleton=True)
    outermost = not lock.is_locked
    try:
        lock.acquire()
    except Timeout:
        raise OSError(
            errno.EBUSY,
            "another process is writing a run there; wait until it ends, or give another folder",
            str(folder),
        ) from None
    try:
        if outermost:
            _put_in_place(folder)
            shutil.rmtree(folder / UNFINISHED, ignore_errors=True)
        yield
    finally:
        if outermost:
            with suppress(OSError):
                _put_in_place(folder)  # of a run that Ctrl-C ended here
            # Windows removes the file by itself, and cannot while it is open.
            with suppress(OSError):
                (folder / LOCK).unlink()
        lock.release()


@contextmanager
def replacing(folder: Path) -> Iterator[Path]:
    """A folder for the files of a run, which replace those of an earlier run after the block.

    Among them must be a `results.json` that lists them as `files`. After an error nothing changes.
    """
    unfinished = folder / UNFINISHED
    with exclusive(folder):
        try:
            yield unfinished
            unfinished.rename(folder / COMPLETE)
            _put_in_place(folder)
        finally:
            shutil.rmtree(unfinished, ignore_errors=True)


def write_results(
    comparison: Comparison,
    train: Sequence[Recording],
    test: Sequence[Recording],
    folder: str | Path,
    *,
    selection: Selection | None = None,
    command: str = "",
    figures: bool = True,
    formats: Sequence[str] = (),
) -> list[Path]:
    """Write `table.csv`, `results.json`, the models with their TorchScript, and figures.

    Every file contains the id of the run, and the folder never contains files of two runs: those of
    an earlier run, which its `results.json` lists, and its `report.html` are removed before the
    first file of this run appears; `results.json` comes last. The user's own files stay.

    Args:
        selection: the choice on the training recordings alone, if there is one.
        command: command line that reproduces the results.
        formats: of figures besides PNG, see `plots.save_all`.

    Raises:
        OSError: another process is writing a run into the folder, or it cannot be written.
    """
    folder = Path(folder)
    results = comparison.to_dict() | {
        "selection": None if selection is None else selection.to_dict(),
        "recordings": {"train": digests(train), "test": digests(test)},
    }
    # Runs with equal results and parameters write equal files.
    parameters = {n: parameter_hash(f.model.state_dict()) for n, f in comparison.fits.items()}
    content = json.dumps([results, parameters], sort_keys=True)
    run = hashlib.sha256(content.encode()).hexdigest()[:16]
    results |= {"run": run, "command": command}

    def write_index(place: Path, files: Sequence[str]) -> None:
        text = json.dumps(checked_json(results | {"files": sorted(files)}), indent=1)
        write_atomically(place / RESULTS, text.encode())

    with exclusive(folder):
        with replacing(folder) as unfinished:
            write_atomically(unfinished / TABLE, _table(comparison, run).encode())
            written = [TABLE]
            for name, fit in comparison.fits.items():
                info = model_info(fit, train, run)
                info = replace(info, fit={**info.fit, "usability": comparison.rating(name)})
                paths = [save(fit.model, unfinished / "models" / f"{name}.json", info)]
                try:
                    paths.append(torchscript(fit.model, paths[0].with_suffix(".pt"), info))
                # ValueError: a memory that no controller can follow, or not at this sample time.
                except (ExportError, ValueError) as error:
                    logger.warning("%s was not exported: %s", name, " ".join(str(error).split()))
                written += [f"models/{path.name}" for path in paths]
            write_index(unfinished, written)
        # Drawn after the fits are saved, because drawing takes long and may be interrupted.
        if figures:
            from nfriction import plots  # matplotlib takes half a second that others save

            try:
                drawn = plots.save_all(
                    comparison, [*train, *test], unfinished, run=run, formats=formats
                )
                (folder / "figures").mkdir(exist_ok=True)
                # Listed before they are put in place, so that a later run knows them in any case.
                written += [f"figures/{path.name}" for path in drawn]
                write_index(folder, written)
                for path in drawn:
                    path.replace(folder / "figures" / path.name)
            finally:
                shutil.rmtree(unfinished, ignore_errors=True)
    return [folder / RESULTS, *(folder / name for name in written)]


def files_of(index: Path) -> list[str]:
    """Files that an earlier run listed in its `results.json`, relative to its folder.

    Only names that a run can write count, because the file may be foreign.
    """
    try:
        content = json.loads(index.read_text(encoding="utf-8"))
    except (FileNotFoundError, NotADirectoryError, ValueError, RecursionError):
        return []
    listed = content.get("files") if isinstance(content, dict) else None
    names = listed if isinstance(listed, list) else []
    return [name for name in names if isinstance(name, str) and OURS.fullmatch(name)]


def report_of(folder: Path) -> Path | None:
    """The folder's `report.html` if nfriction wrote it."""
    path = folder / REPORT
    if not path.is_file():
        return None
    with path.open("rb") as file:
        return path if REPORT_MARK in file.read(1000) else None


def _put_in_place(folder: Path) -> None:
    """Replace the earlier run's files by the complete ones.

    If this is killed at any point, another call completes it: the earlier index is moved first and
    lists the files to remove, the new index comes last.
    """
    complete, index = folder / COMPLETE, folder / RESULTS
    earlier = complete / EARLIER
    if (complete / RESULTS).is_file():
        if index.is_file():
            index.replace(earlier)
        if earlier.is_file():
            for name in files_of(earlier):
                (folder / name).unlink(missing_ok=True)
            if report := report_of(folder):
                report.unlink()
            earlier.unlink()
        for path in sorted(complete.rglob("*.*")):
            if path.is_file() and path != complete / RESULTS:
                place = folder / path.relative_to(complete)
                place.parent.mkdir(exist_ok=True)
                path.replace(place)
        (complete / RESULTS).replace(index)
    shutil.rmtree(complete, ignore_errors=True)


def _table(comparison: Comparison, run: str) -> str:
    """Every error as a line of CSV."""

    def renamed(scores: dict[str, list[Score]]) -> dict[str, list[Score]]:
        return {
            model: [replace(score, recording=_plain_cell(score.recording)) for score in of_model]
            for model, of_model in scores.items()
        }

    joints = tuple(map(_plain_cell, comparison.joint_names))
    train, test = renamed(comparison.train), renamed(comparison.test)
    table = replace(comparison, train=train, test=test, joint_names=joints).to_frame()
    table.insert(0, "run", run)
    text: str = table.to_csv(index=False)
    return text


def _plain_cell(name: str) -> str:
    """A name in valid Unicode that no spreadsheet evaluates as a formula."""
    # File names may contain bytes that are not UTF-8.
    text = name.encode(errors="backslashreplace").decode()
    # Spreadsheets also accept full-width signs, and skip white space before them.
    start = unicodedata.normalize("NFKC", text.lstrip())[:1]
    return f"'{text}" if start in tuple("=+-@") else text

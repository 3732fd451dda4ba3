"""Shared code of the scripts in `trainers/`: options, recordings, and the end of a run."""

import argparse
import hashlib
import json
import shutil
import signal
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np
import torch
from matplotlib.ticker import MaxNLocator

from nfriction.cli import console
from nfriction.cli.inputs import add_reading_options, count, positive, read_recordings
from nfriction.evaluation.results import model_info
from nfriction.evaluation.score import score
from nfriction.export import torchscript
from nfriction.fitting.result.fit_result import FitResult
from nfriction.friction.models import FrictionModel
from nfriction.io.model_file import ModelInfo, save
from nfriction.papers import twin
from nfriction.papers.reproduction.workspace import Bench, Settings, Workspace, smoothed
from nfriction.plant import Plant, rigs
from nfriction.plots import style

# Options that do not change the result.
_IRRELEVANT = ("out", "resume")
# In the folder of the checkpoints: what they depend on, and the mark of a finished run.
OPTIONS, FINISHED = Path("stages", "options.json"), Path("finished")
# Exit status that shells expect of a program ended by Ctrl-C.
INTERRUPTED = 130


def natural(text: str) -> int:
    """A whole number from 1, for argparse."""
    if not text.isdecimal() or not int(text):
        raise argparse.ArgumentTypeError(f"must be a whole number from 1, got {text!r}")
    return int(text)


def parser(description: str) -> argparse.ArgumentParser:
    """A parser with the options that all trainers have."""
    made = argparse.ArgumentParser(description=description)
    made.add_argument("recordings", nargs="*", type=Path, metavar="RECORDING",
                      help="files with time, q1, q2, ...; omit for a simulated twin")  # fmt: skip
    made.add_argument("--twin", choices=twin.names(), default="tlrip",
                      help="the twin to use if no recording is given")  # fmt: skip
    made.add_argument("--seconds", type=positive, help="length of the twin's recordings [s]")
    made.add_argument("--rig", help=f"a rig file, or one of {', '.join(rigs.names())}")
    add_reading_options(made)
    made.add_argument("--plant", choices=("fit", "given"), default="given",
                      help="fit: adjust inertia and gravity terms within bounds")  # fmt: skip
    made.add_argument("--windows", type=positive, nargs="+", default=[0.5, 2.0], metavar="SECONDS",
                      help="lengths of the fitted windows")  # fmt: skip
    made.add_argument(
        "--max-steps",
        type=natural,
        default=30,
        help="limit on steps of the fit at each window length",
    )
    made.add_argument("--seed", type=count, default=0)
    made.add_argument("--out", type=Path, default=Path("runs/train"), help="folder to write")
    made.add_argument("--resume", action="store_true",
                      help="continue from the checkpoints in the folder; without it, those of "
                           "a finished run are deleted, and others refused")  # fmt: skip
    return made


def start(given: argparse.Namespace, bench: Bench, **settings: object) -> Workspace:
    """Checkpoints from which `--resume` continues, or none; from here on, Ctrl-C names them.

    Args:
        given: parsed options of a `parser()`, all checked: checkpoints of a finished run go now.
        bench: from `read`.
        settings: `Settings` in addition to those common to all trainers.

    Raises:
        ValueError: if the checkpoints to resume from were made with other options or data, or those
            of an unfinished run would be lost.
    """
    folder = given.out / "checkpoints"
    options = {k: v for k, v in vars(given).items() if k not in _IRRELEVANT}
    origin = {"options": options, "digests": _digests(given, bench)}
    made = Settings(
        seed=given.seed, windows=tuple(given.windows), max_steps=given.max_steps,
        fit_plant=given.plant == "fit",
        origin=json.dumps(origin, default=str, sort_keys=True), **settings,  # type: ignore[arg-type]
    )  # fmt: skip
    workspace = Workspace(folder, made, progress=sys.stderr.isatty())
    if not given.resume:
        if _unfinished(folder):
            raise ValueError(
                f"{folder} has the progress of a run that did not finish; continue it with "
                "--resume, or delete this folder to discard it."
            )
        shutil.rmtree(folder, ignore_errors=True)
    elif workspace.begun("options") and workspace.result("options") is None:
        changed = ", ".join(_changed(folder, origin["digests"]))
        raise ValueError(
            f"{folder}: made "
            + (f"with other contents of {changed}; restore them" if changed else
               "with other options or by another version; use the same")
            + ", or delete this folder and start again without --resume."
        )  # fmt: skip
    workspace.finish("options", made.to_dict())
    signal.signal(
        signal.SIGINT,
        lambda *_: _end(f"interrupted; progress is saved in {given.out}, resume with --resume"),
    )
    return workspace


def _digests(given: argparse.Namespace, bench: Bench) -> dict[str, str]:
    """Digest of the content of each given file, as contents may change under the same name."""
    if not given.recordings:
        return {}
    rig = json.dumps(bench.plant.to_dict(), sort_keys=True)
    found = {str(given.rig): hashlib.sha256(rig.encode()).hexdigest()}
    pairs = zip(given.recordings, bench.train, strict=True)
    return found | {str(path): recording.digest() for path, recording in pairs}


def _changed(folder: Path, digests: Mapping[str, str]) -> list[str]:
    """Files that had another digest when the checkpoints in this folder were begun."""
    try:
        kept = json.loads((folder / OPTIONS).read_text(encoding="utf-8"))
        before = json.loads(kept["result"]["origin"])["digests"]
    except (ValueError, KeyError, TypeError):  # damaged, or of an earlier version
        return []
    return [name for name, digest in digests.items() if before.get(name, digest) != digest]


def _unfinished(folder: Path) -> bool:
    """True for checkpoints with results of a run that did not write its last file."""
    results = {path for path in folder.rglob("*") if path.is_file()} - {folder / OPTIONS}
    return bool(results) and folder / FINISHED not in results


def finished(given: argparse.Namespace) -> None:
    """Mark the checkpoints as those of a finished run, which a new one may delete."""
    (given.out / "checkpoints" / FINISHED).touch()


def read(given: argparse.Namespace) -> Bench:
    """The given recordings, all used for training, or those of the twin."""
    if not given.recordings:
        made = twin.make(
            given.twin, seed=given.seed, duration=given.seconds, progress=sys.stderr.isatty()
        )
        train, test = made.part("train"), made.part("test")
        motions = smoothed(made.plant, [*train, *test])
        return Bench(made.plant, train, test, motions, made.initial_states)
    if given.rig is None:
        raise ValueError("recordings need --rig, a rig file or the name of one.")
    plant = rigs.of(given.rig)
    train = read_recordings(given.recordings, plant, given)
    return Bench(plant, train, [], smoothed(plant, train), {})


def finish(given: argparse.Namespace, bench: Bench, found: FitResult) -> str:
    """Write a fitted model, see `write`."""
    return write(given, bench, found.model, model_info(found, bench.train), found.plant)


def write(
    given: argparse.Namespace, bench: Bench, model: FrictionModel, info: ModelInfo, plant: Plant
) -> str:
    """Write a model, its TorchScript and a figure of the loss by step, and report its errors."""
    name = type(model).__name__
    kept = json.loads((given.out / "checkpoints" / "stages" / f"{name}-losses.json").read_text())
    draw_losses(kept["result"], given.out / f"{name}-loss.png")
    path = save(model, given.out / f"{name}.json", info)
    torchscript(model, path.with_suffix(".pt"), info)
    lines = [f"{name}: {info.fit.get('status', 'made')}"]
    for split, recording in bench.parts():
        state = bench.states.get(recording.name)
        found = score(plant, model, recording, initial_state=state, limit=False)
        joints = ", ".join(f"{1e3 * e:.4g}" for e in found.free_run.joints)
        lines.append(
            f"{recording.name}, {split}: position RMSE of the free run by joint {joints} "
            f"m{plant.unit}"
        )
    finished(given)
    return "\n".join([*lines, f"wrote {path}, {path.with_suffix('.pt')} and {name}-loss.png"])


def draw_losses(losses: Mapping[str, Sequence[float]], path: Path) -> None:
    """Draw the loss over the steps of a training, one line for each part.

    Parts sum over different terms, so each is shown relative to its first loss. A line may rise if
    the evidence changes the weight of the data between steps.
    """
    figure, axes = style.panels(1, 1, style.PAGE, 2.4)
    looks, ax = style.looks(losses), axes[0, 0]
    for part, values in losses.items():
        steps = np.arange(1, len(values) + 1)
        ax.plot(steps, np.array(values) / values[0], **looks[part].line | {"marker": "."})
    ratios = np.concatenate([np.array(values) / values[0] for values in losses.values()])
    if ratios.min() < 0.1:
        style.log_axis(ax, 0.9 * float(ratios.min()), 1.1 * float(ratios.max()))
    ax.xaxis.set_major_locator(MaxNLocator(integer=True))
    rises = any((np.diff(values) > 0).any() for values in losses.values())
    note = " (a line rises where the evidence weighs the data anew)" if rises else ""
    ax.set_xlabel(f"step{note}")
    ax.set_ylabel("loss over the first [-]")
    style.legend(figure, [looks[part].handle for part in losses], list(losses))
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=150)


def _end(message: str) -> None:
    # On KeyboardInterrupt solvers keep their best point, which would look like a finished stage.
    sys.stderr.write(f"\n{message}\n")
    sys.exit(INTERRUPTED)


def run(train: Callable[[Sequence[str] | None], str], argv: Sequence[str] | None = None) -> None:
    """Run a trainer on one thread and print its report.

    Errors and Ctrl-C are reported in one line. A reader that closes the output is no error.
    """
    # Multithreading makes operations on small tensors up to 100 times slower.
    torch.set_num_threads(1)
    signal.signal(signal.SIGINT, lambda *_: _end("interrupted"))
    try:
        try:
            print(train(argv))
        finally:
            sys.stdout.flush()  # otherwise a closed pipe fails too late to be caught
    except BrokenPipeError:
        sys.exit(console.drop_output())
    except (ValueError, OSError, console.UsageError) as error:
        sys.exit(f"error: {error}")

"""Command line: fit, compare and export friction models."""

import argparse
import logging
import math
import shlex
import signal
import sys
import tempfile
import threading
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Any, Literal, NoReturn

import numpy as np
import pandas as pd
import torch
from tqdm import tqdm

from nfriction import twin
from nfriction.angles import AngleConvention
from nfriction.codegen import CodegenError
from nfriction.comparison import Comparison, InitialStates, compare
from nfriction.export import ExportError, torchscript
from nfriction.fitting import fit
from nfriction.friction import MODELS, model_by_name
from nfriction.modelfile import ModelFileError, info_of, load, save
from nfriction.plant import LinearAxis, PendulumChain, rigs
from nfriction.recording import Recording, read_initial_states
from nfriction.results import model_info, write_results
from nfriction.version import __version__

DEFAULT_MODELS = "NCFM,LFM,NLFM,NFLFM"


class UsageError(Exception):
    """What the user asked for cannot be done; the message says why and what to do."""


class _Parser(argparse.ArgumentParser):
    """A parser whose errors are one line, as all others are."""

    def error(self, message: str) -> NoReturn:
        raise UsageError(f"{message}; see {self.prog} --help.")


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command.

    Errors are one line on standard error and exit status 2, an interrupt gives status 130.
    """
    words = list(sys.argv[1:] if argv is None else argv)
    parser = _parser()
    arguments = argparse.Namespace(debug="--debug" in words)
    try:
        parser.parse_args(words, arguments)
        if "run" not in arguments:
            parser.print_help(sys.stderr)
            return 2
        logging.basicConfig(format="nfriction: %(levelname)s: %(message)s", level=logging.WARNING)
        # Several threads make small tensors up to 100 times slower.
        torch.set_num_threads(1)
        arguments.command_line = shlex.join(["nfriction", *words])
        with _interruptible(), _one_line_warnings():
            return arguments.run(arguments)
    except KeyboardInterrupt as interrupt:
        print(f"nfriction: interrupted {interrupt}".rstrip(), file=sys.stderr)
        return 130
    except (UsageError, ModelFileError, ExportError, CodegenError, ValueError, OSError,
            ImportError) as error:  # fmt: skip
        if arguments.debug:
            raise
        print(f"nfriction: error: {_message(error)}", file=sys.stderr)
        return 2


def _message(error: Exception) -> str:
    """An error in one line."""
    if isinstance(error, OSError) and error.filename is not None:
        return f"{error.filename}: {error.strerror}"
    return " ".join(str(error).split())


@contextmanager
def _one_line_warnings() -> Iterator[None]:
    def show(message: Warning | str, *_: Any, **__: Any) -> None:
        _warn(" ".join(str(message).split()))

    with warnings.catch_warnings():
        warnings.showwarning = show
        yield


def _warn(message: str) -> None:
    print(f"nfriction: warning: {message}", file=sys.stderr)


_interrupted = threading.Event()


@contextmanager
def _interruptible() -> Iterator[None]:
    """Remember a Ctrl-C: solvers keep their best point, but a user wants an end.

    The run ends where it next reports its progress.
    """

    def interrupt(_signal: int, _frame: FrameType | None) -> None:
        _interrupted.set()
        raise KeyboardInterrupt

    _interrupted.clear()
    if threading.current_thread() is not threading.main_thread():
        yield  # signals reach the main thread only
        return
    before = signal.signal(signal.SIGINT, interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(
        prog="nfriction",
        description="Learn joint friction from encoder recordings, prove it by simulation.",
    )
    parser.add_argument("--version", action="version", version=f"nfriction {__version__}")
    commands = parser.add_subparsers(metavar="COMMAND")
    common = _Parser(add_help=False)
    common.add_argument("--debug", action="store_true", help="show the traceback of an error")
    estimation = _Parser(add_help=False)
    _add_estimation(estimation)

    one = commands.add_parser("fit", parents=[common, estimation], help="fit one model")
    one.add_argument("recordings", nargs="+", type=Path, metavar="RECORDING")
    one.add_argument("--model", default="NFLFM", help=f"one of {', '.join(MODELS)}")
    one.add_argument("--out", type=Path, default=Path("model.json"), help="model file to write")
    one.set_defaults(run=_fit)

    many = commands.add_parser(
        "compare", parents=[common, estimation], help="fit models and score them"
    )
    many.add_argument("train", nargs="+", type=Path, metavar="TRAIN")
    many.add_argument("--held-out", nargs="+", type=Path, default=[], metavar="TEST")
    many.add_argument("--models", default=DEFAULT_MODELS, help=f"of {', '.join(MODELS)}")
    _add_output(many)
    many.set_defaults(run=_compare)

    demo = commands.add_parser(
        "demo", parents=[common], help="simulate a rig with hidden friction, then compare models"
    )
    demo.add_argument("--models", default=DEFAULT_MODELS)
    demo.add_argument("--seed", type=_count, default=0, help="of encoder errors and jitter")
    demo.add_argument("--seconds", type=_seconds, default=twin.QUICK_DURATION,
                      help="length of each recording")  # fmt: skip
    _add_output(demo)
    demo.set_defaults(run=_demo, out=Path("runs/demo"))

    exporter = commands.add_parser("export", parents=[common], help="write a controller artefact")
    exporter.add_argument("model", type=Path, help="model file")
    exporter.add_argument("--to", default="torchscript", help="torchscript")
    exporter.add_argument("--out", type=Path, default=Path(), help="folder to write to")
    exporter.set_defaults(run=_export)
    return parser


def _add_estimation(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--rig", required=True,
                        help=f"a rig file, or one of {', '.join(rigs.names())}")  # fmt: skip
    parser.add_argument("--angles", help="how the files write angles, e.g. absolute,hanging; "
                        "default the rig's convention")  # fmt: skip
    parser.add_argument("--degrees", action="store_true", help="the files are in degrees")
    parser.add_argument("--windows", default="0.5,2", help="window lengths of the fit [s]")
    parser.add_argument("--plant", choices=("fit", "given"), default="fit",
                        help="adjust inertia and gravity terms within bounds, or not")  # fmt: skip
    parser.add_argument("--drag", action="store_true", help="fit air drag on the links too")
    parser.add_argument("--max-steps", type=_count, default=30,
                        help="steps to each window length")  # fmt: skip


def _add_output(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--out", type=Path, default=Path("runs/compare"), help="folder to write")
    parser.add_argument("--initial-states", type=Path,
                        help="recordings.csv with columns id, q0_1, qd0_1, ...")  # fmt: skip
    parser.add_argument("--no-figures", action="store_true")


def _count(text: str) -> int:
    """A whole number from 0, for argparse."""
    if not text.isdecimal():
        raise argparse.ArgumentTypeError(f"must be a whole number from 0, got {text!r}")
    return int(text)


def _seconds(text: str) -> float:
    """A positive duration, for argparse."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0 < value < math.inf:
        raise argparse.ArgumentTypeError(f"must be positive seconds, got {text!r}")
    return value


def _fit(arguments: argparse.Namespace) -> int:
    settings = _settings(arguments)
    plant = _rig(arguments.rig)
    model = model_by_name(arguments.model)(plant.joints)
    recordings = _read(arguments.recordings, plant, arguments)
    if arguments.out.is_dir():
        raise UsageError(f"--out of fit is a file, and {arguments.out} is a folder.")
    _check_writable(arguments.out.parent)
    with _Progress() as progress:
        progress.stage(f"fit {arguments.model}")
        found = fit(model, plant, recordings, callback=lambda s, _: progress.step(s), **settings)
        progress.stage("write the model")
    save(model, arguments.out, model_info(found, recordings))
    print(f"{arguments.model}: {found.status}")
    print(f"position error over training windows: {1e3 * found.residual:.3g} m{plant.unit}")
    print(f"wrote {arguments.out}")
    return 0


def _compare(arguments: argparse.Namespace) -> int:
    settings = _settings(arguments)
    _models(arguments)
    plant = _rig(arguments.rig)
    train = _read(arguments.train, plant, arguments)
    held_out = _read(arguments.held_out, plant, arguments)
    trained = {recording.digest() for recording in train}
    seen = [r.name for r in held_out if r.digest() in trained]
    if seen:
        raise UsageError(f"{', '.join(seen)}: trained on and held out; a model is judged by "
                         "recordings it has not seen.")  # fmt: skip
    return _run_comparison(plant, train, held_out, arguments, settings)


def _demo(arguments: argparse.Namespace) -> int:
    _models(arguments)
    simulated = twin.make(
        "tlrip",
        seed=arguments.seed,
        duration=arguments.seconds,
        progress=sys.stderr.isatty(),
    )
    plant, train, held_out = simulated.plant, simulated.part("train"), simulated.part("held_out")
    print(
        f"simulated the papers' rig with friction unknown to every model: {len(train)} recordings "
        f"of {arguments.seconds:g} s to train on, {len(held_out)} held out"
    )
    return _run_comparison(plant, train, held_out, arguments, {"fit_plant": False})


def _run_comparison(
    plant: PendulumChain | LinearAxis,
    train: list[Recording],
    held_out: list[Recording],
    arguments: argparse.Namespace,
    settings: dict[str, Any],
) -> int:
    names = _models(arguments)
    states = _initial_states(arguments.initial_states, plant, [*train, *held_out])
    _check_writable(arguments.out)
    with _Progress(len(names)) as progress:
        comparison = compare(
            plant, names, train, held_out, initial_states=states,
            on_stage=progress.stage, on_step=progress.step, **settings,
        )  # fmt: skip
        progress.stage("write results and figures")
        write_results(
            comparison, train, held_out, arguments.out,
            command=arguments.command_line, figures=not arguments.no_figures,
        )  # fmt: skip
    _print_tables(comparison)
    print(f"\nresults, models and figures are in {arguments.out}")
    return 0


def _models(arguments: argparse.Namespace) -> list[str]:
    names = [name.strip() for name in arguments.models.split(",") if name.strip()]
    if not names:
        raise UsageError(f"--models takes names of {', '.join(MODELS)}, got none.")
    for name in names:
        model_by_name(name)
    return names


def _initial_states(
    path: Path | None, plant: PendulumChain | LinearAxis, recordings: Sequence[Recording]
) -> InitialStates | None:
    """States of these recordings; says which have none and so start from their smoothed motion."""
    if path is None:
        return None
    states = read_initial_states(path)
    names = [recording.name for recording in recordings]
    for name in names:
        if name in states and len(states[name][0]) != plant.joints:
            raise UsageError(f"{path}: the state of {name} has {len(states[name][0])} joints, "
                             f"the rig {plant.joints}.")  # fmt: skip
    without = [name for name in names if name not in states]
    if without:
        _warn(f"{path} has no state of {', '.join(without)}; estimated from the recording instead.")
    return states


def _export(arguments: argparse.Namespace) -> int:
    writers: dict[str, tuple[str, Callable[..., Path]]] = {"torchscript": (".pt", torchscript)}
    model, info = load(arguments.model), info_of(arguments.model)
    for target in arguments.to.split(","):
        if target not in writers:
            raise UsageError(f"cannot export to {target!r}; there are {', '.join(writers)}.")
        suffix, writer = writers[target]
        path = writer(model, arguments.out / f"{arguments.model.stem}{suffix}", info)
        print(f"wrote {path}")
    return 0


def _print_tables(comparison: Comparison) -> None:
    """Free run and windows in thousandths of the unit, and what was saved in percent."""
    for held_out, kind in ((True, "held out"), (False, "trained on")):
        if not (comparison.held_out if held_out else comparison.train):
            continue
        scores = comparison.held_out if held_out else comparison.train
        files = ", ".join(s.recording for s in next(iter(scores.values())))
        table = 1e3 * comparison.table(held_out=held_out)
        columns = {f"{h} s": 1e3 * comparison.table(h, held_out=held_out)["all"]
                   for h in comparison.horizons()}  # fmt: skip
        saved = comparison.improvement(held_out=held_out)["all"].rename("saved %")
        whole = pd.concat([table, pd.DataFrame(columns), saved], axis=1)
        print(f"\nPosition RMSE, {kind} ({files}), m{comparison.unit}: free run by joint, "
              "restarted windows, free-run error saved against no friction")  # fmt: skip
        print(whole.to_string(float_format=lambda x: f"{x:.4g}" if np.isfinite(x) else "diverged"))
    for name, found in comparison.fits.items():
        note = f"; at a bound: {', '.join(found.at_bounds)}" if found.at_bounds else ""
        print(f"{name}: {found.status}{note}")


def _rig(name: str) -> PendulumChain | LinearAxis:
    if name in rigs.names():
        return rigs.by_name(name)
    if Path(name).suffix.lower() in (".json", ".toml"):
        return rigs.read(name)
    raise UsageError(f"no rig is called {name!r}; give a .json file or one of "
                     f"{', '.join(rigs.names())}.")  # fmt: skip


def _read(
    paths: Sequence[Path], plant: PendulumChain | LinearAxis, arguments: argparse.Namespace
) -> list[Recording]:
    text = arguments.angles or ",".join(plant.convention)
    convention = AngleConvention.parse(text)
    unit: Literal["rad", "m"] = "m" if plant.unit == "m" else "rad"
    recordings = []
    for path in paths:
        recording = Recording.read(
            path, degrees=arguments.degrees, convention=convention, unit=unit
        )  # fmt: skip
        if recording.joints != plant.joints:
            raise UsageError(f"{path} has {recording.joints} joints, the rig has {plant.joints}.")
        recordings.append(recording)
    return recordings


def _settings(arguments: argparse.Namespace) -> dict[str, Any]:
    try:
        windows = tuple(_seconds(w) for w in arguments.windows.split(","))
    except argparse.ArgumentTypeError:
        raise UsageError(
            f"--windows takes positive seconds like 0.5,2, got {arguments.windows!r}."
        ) from None
    return {
        "windows": windows,
        "fit_plant": arguments.plant == "fit",
        "drag": arguments.drag,
        "max_steps": arguments.max_steps,
    }


def _check_writable(folder: Path) -> None:
    """Refuse an unwritable folder before the work rather than after it."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except (FileExistsError, NotADirectoryError):
        raise UsageError(f"cannot make the folder {folder}: there is a file in its way.") from None
    with tempfile.TemporaryFile(dir=folder):
        pass


class _Progress:
    """One bar for a whole run: what is being done, and steps taken."""

    def __init__(self, models: int = 1) -> None:
        self._what = "start"
        self._bar = tqdm(unit=" steps", disable=not sys.stderr.isatty(), leave=False)

    def __enter__(self) -> "_Progress":
        return self

    def __exit__(self, _type: object, error: BaseException | None, _trace: object) -> None:
        self._bar.close()
        if isinstance(error, KeyboardInterrupt):
            error.args = (f"({self._what}); no file was left half-written",)

    def stage(self, what: str) -> None:
        self._check()
        self._what = what
        self._bar.set_description(what)

    def step(self, stage: str) -> None:
        self._check()
        self._bar.set_description(f"{self._what}, {stage}")
        self._bar.update()

    def _check(self) -> None:
        if _interrupted.is_set():
            raise KeyboardInterrupt


if __name__ == "__main__":
    sys.exit(main())

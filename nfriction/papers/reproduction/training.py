"""What the scripts in `trainers/` share: options, data, stages with checkpoints, progress."""

import argparse
import json
import shutil
import signal
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import Any, Literal

import torch
from tqdm import tqdm

from nfriction.evaluation.score import Score, score
from nfriction.export import torchscript
from nfriction.fitting.result.fit_result import FitResult
from nfriction.friction.model import FrictionModel
from nfriction.io.atomic import write_atomically
from nfriction.io.model_file import save
from nfriction.io.model_info import ModelInfo
from nfriction.papers import twin
from nfriction.papers.afem.search import SearchState
from nfriction.papers.reproduction.fitfile import load_fit, save_fit
from nfriction.plant import Plant, rigs
from nfriction.recording import Recording
from nfriction.recording.angles import AngleConvention
from nfriction.signals import Motion, kalman_smoother

# What does not change the result.
_IRRELEVANT = ("out", "resume")
# What shells expect of a program that a Ctrl-C ended.
INTERRUPTED = 130
Tell = Callable[..., None]


def parser(description: str) -> argparse.ArgumentParser:
    """A parser with the options that all trainers have."""
    made = argparse.ArgumentParser(description=description)
    made.add_argument("recordings", nargs="*", type=Path, metavar="RECORDING",
                      help="files with time, q1, q2, ...; none for a simulated twin")  # fmt: skip
    made.add_argument("--twin", choices=twin.names(), default="tlrip",
                      help="the twin, where no recording is given")  # fmt: skip
    made.add_argument("--seconds", type=float, help="length of the twin's recordings [s]")
    made.add_argument("--rig", help=f"a rig file, or one of {', '.join(rigs.names())}")
    made.add_argument("--angles", help="how the files write angles, e.g. absolute,hanging")
    made.add_argument("--degrees", action="store_true", help="the files are in degrees")
    made.add_argument("--plant", choices=("fit", "given"), default="given",
                      help="adjust inertia and gravity terms within bounds, or not")  # fmt: skip
    made.add_argument("--windows", type=float, nargs="+", default=[0.5, 2.0], metavar="SECONDS",
                      help="lengths of the fitted windows")  # fmt: skip
    made.add_argument("--max-steps", type=int, default=30, help="of the fit, at each length")
    made.add_argument("--seed", type=int, default=0)
    made.add_argument("--out", type=Path, default=Path("runs/train"), help="folder to write")
    made.add_argument("--resume", action="store_true",
                      help="go on from the checkpoints in the folder")  # fmt: skip
    return made


@dataclass(frozen=True, eq=False)
class Data:
    """What a training works on.

    Attributes:
        plant: the mechanism.
        train, test: recordings; files given are all trained on.
        motions: smoothed motions of `train`.
        states: exact q0 and qd0 of a twin's recordings.
    """

    plant: Plant
    train: list[Recording]
    test: list[Recording]
    motions: list[Motion]
    states: dict[str, Any]


class Training:
    """One run of a trainer in a folder: stages that are kept as soon as they are done.

    A stage that was ended in its middle, by Ctrl-C or by force, is done again by `--resume`; one
    that was finished is read. A pattern search goes on where it stood. Either way the result is
    that of a run that nobody ended.

    Args:
        arguments: of a `parser()`.

    Raises:
        ValueError: if the checkpoints to resume from were made with other options.
    """

    def __init__(self, arguments: argparse.Namespace) -> None:
        self.arguments = arguments
        self.folder: Path = arguments.out
        self._checkpoints = self.folder / "checkpoints"
        options = {k: v for k, v in vars(arguments).items() if k not in _IRRELEVANT}
        text = json.dumps(options, default=str, indent=1, sort_keys=True)
        mark = self._checkpoints / "options.json"
        if not arguments.resume:
            shutil.rmtree(self._checkpoints, ignore_errors=True)
        elif mark.exists() and mark.read_text(encoding="utf-8") != text:
            raise ValueError(
                f"{mark}: made with other options; repeat them, or start anew without --resume."
            )
        write_atomically(mark, text.encode())
        _end_when_interrupted(self.folder)

    def data(self) -> Data:
        """The recordings given, or the twin's."""
        given = self.arguments
        if not given.recordings:
            made = twin.make(
                given.twin, seed=given.seed, duration=given.seconds, progress=sys.stderr.isatty()
            )
            plant: Plant = made.plant
            train, test = made.part("train"), made.part("test")
            states: dict[str, Any] = dict(made.initial_states)
        else:
            if given.rig is None:
                raise ValueError("recordings need --rig, a rig file or the name of one.")
            plant = rigs.by_name(given.rig) if given.rig in rigs.names() else rigs.read(given.rig)
            convention = AngleConvention.parse(given.angles or ",".join(plant.convention))
            unit: Literal["rad", "m"] = "m" if plant.unit == "m" else "rad"
            train, test, states = [], [], {}
            for path in given.recordings:
                train.append(
                    Recording.read(path, degrees=given.degrees, convention=convention, unit=unit)
                )
        joint = [r.joint_coordinates(plant) for r in train]
        motions = [kalman_smoother(r.time, r.q) for r in joint]
        return Data(plant, train, test, motions, states)

    def stage(self, name: str, data: Data, make: Callable[[Tell], FitResult]) -> FitResult:
        """The fit of a stage: read where it is finished, made and kept where not.

        Args:
            name: of the checkpoint.
            data: what it is fitted to.
            make: does it; given what to call after every step.
        """
        path = self._checkpoints / f"{name}.json"
        if path.exists():
            return load_fit(path, data.motions)
        with tqdm(desc=name, unit=" steps", disable=not sys.stderr.isatty()) as bar:

            def tell(*about: object) -> None:
                if about and isinstance(about[0], str):
                    bar.set_description(f"{name}, {about[0]}")
                bar.update()

            found = make(tell)
        save_fit(found, path, data.train)
        return found

    def search_state(self) -> SearchState | None:
        """Where an unfinished pattern search stands; None at its start."""
        path = self._checkpoints / "search-state.json"
        if not path.exists():
            return None
        return SearchState.from_dict(json.loads(path.read_text(encoding="utf-8")))

    def keep_search(self, tell: Tell) -> Callable[[SearchState], None]:
        """A callback that keeps every state of a pattern search."""

        def keep(state: SearchState) -> None:
            tell()
            if state.pattern is not None:
                content = json.dumps(state.to_dict()).encode()
                write_atomically(self._checkpoints / "search-state.json", content)

        return keep

    def finish(
        self,
        data: Data,
        model: FrictionModel,
        info: ModelInfo,
        plant: Plant | None = None,
    ) -> str:
        """Write the model and its TorchScript, score it, and say so in words."""
        name = type(model).__name__
        path = save(model, self.folder / f"{name}.json", info)
        torchscript(model, path.with_suffix(".pt"), info)
        lines = [f"{name}: {info.fit.get('status', 'made')}"]
        motions = dict(zip((r.name for r in data.train), data.motions, strict=True))
        for kind, recordings in (("train", data.train), ("test", data.test)):
            for recording in recordings:
                found = score(
                    plant or data.plant, model, recording,
                    motion=motions.get(recording.name),
                    initial_state=data.states.get(recording.name),
                )  # fmt: skip
                lines.append(f"{recording.name}, {kind}: {_errors(found, data.plant.unit)}")
        return "\n".join([*lines, f"wrote {path} and {path.with_suffix('.pt')}"])


def _errors(found: Score, unit: str) -> str:
    joints = ", ".join(f"{1e3 * e:.4g}" for e in found.free_run.joints)
    return f"position RMSE of the free run by joint {joints} m{unit}"


def _end_when_interrupted(folder: Path) -> None:
    # Solvers keep their best point on a KeyboardInterrupt, which would pass for a finished stage.
    def end(_signal: int, _frame: FrameType | None) -> None:
        sys.stderr.write(f"\ninterrupted; what was reached is in {folder}, go on with --resume\n")
        sys.exit(INTERRUPTED)

    signal.signal(signal.SIGINT, end)


def run(train: Callable[[Sequence[str] | None], str], argv: Sequence[str] | None = None) -> str:
    """What a trainer's body says, run with one thread; its errors end the script in one line."""
    # Several threads make small tensors up to 100 times slower.
    torch.set_num_threads(1)
    try:
        return train(argv)
    except KeyboardInterrupt:  # before there is a folder
        sys.exit(INTERRUPTED)
    except (ValueError, OSError) as error:
        sys.exit(f"error: {error}")

"""Options of the commands that read a user's recordings and fit models to them."""

from __future__ import annotations

import argparse
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from nfriction.cli import names
from nfriction.cli.console import UsageError, count, one_line, seconds, warn

if TYPE_CHECKING:
    from nfriction.plant import LinearAxis, PendulumChain
    from nfriction.recording import Recording


def add_options(parser: argparse.ArgumentParser) -> None:
    """Options of `fit` and `compare`."""
    parser.add_argument("--rig", required=True, type=names.rig,
                        help=f"a rig file (.json), or one of {', '.join(names.RIGS)}")  # fmt: skip
    parser.add_argument("--angles", metavar="HOW,ZERO",
                        help="how the files write angles, relative or absolute and from upright or "
                        "hanging, e.g. absolute,hanging (default: as file or rig say)")  # fmt: skip
    parser.add_argument("--degrees", action="store_true", help="the files are in degrees")
    parser.add_argument("--columns", type=_columns, metavar="OURS=THEIRS,...",
                        help="the files' names of time, q1, ..., tau1, ... where they differ, "
                        "e.g. time=t,q1=enc_1,q2=enc_2")  # fmt: skip
    parser.add_argument("--windows", type=_windows, default="0.5,2", metavar="SECONDS",
                        help="lengths of the fitted windows, one after the other [s]")  # fmt: skip
    parser.add_argument("--plant", choices=("fit", "given"), default="fit",
                        help="adjust inertia and gravity terms within bounds, or keep those of "
                        "the rig")  # fmt: skip
    parser.add_argument("--drag", action="store_true", help="fit air drag on the links too")
    parser.add_argument("--max-steps", type=count, default=30, metavar="N",
                        help="most steps of the search at each window length")  # fmt: skip


def fit_settings(arguments: argparse.Namespace) -> dict[str, Any]:
    """What `nfriction.fit` takes of these options."""
    return {
        "windows": arguments.windows,
        "fit_plant": arguments.plant == "fit",
        "drag": arguments.drag,
        "max_steps": arguments.max_steps,
    }


def read_rig(name: str) -> PendulumChain | LinearAxis:
    """The rig that `--rig` names."""
    from nfriction.plant import rigs

    return rigs.by_name(name) if name in names.RIGS else rigs.read(name)


def read_recordings(
    paths: Sequence[Path], plant: PendulumChain | LinearAxis, arguments: argparse.Namespace
) -> list[Recording]:
    """The recordings in files, in the angles and units that the options tell."""
    from nfriction.recording import Recording, RecordingWarning

    unit: Literal["rad", "m"] = "m" if plant.unit == "m" else "rad"
    recordings, in_degrees = [], []
    for path in paths:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            recording = Recording.read(
                path, columns=arguments.columns, degrees=arguments.degrees,
                convention=arguments.angles, unit=unit,
            )  # fmt: skip
        if recording.joints != plant.joints:
            raise UsageError(f"{path} has {recording.joints} joints, the rig has {plant.joints}.")
        recordings.append(recording)
        messages = [str(warning.message) for warning in caught]
        in_degrees += [recording.name for m in messages if "degrees=True" in m]
        for message in messages:
            if "degrees=True" not in message:
                warn(one_line(message))
    # Told once: every change of coordinates would say it again.
    warnings.simplefilter("ignore", RecordingWarning)
    if in_degrees:
        # Who forgets the option for one file forgets it for all.
        warn(f"{', '.join(in_degrees)}: positions look like degrees; if they are, add --degrees.")
    return recordings


def _columns(text: str) -> dict[str, str]:
    pairs = [part.split("=", 1) for part in text.split(",")]
    if any(len(pair) < 2 or not all(map(str.strip, pair)) for pair in pairs):
        raise argparse.ArgumentTypeError(f"takes pairs like time=t,q1=enc_1, got {text!r}")
    return {ours.strip(): theirs.strip() for ours, theirs in pairs}


def _windows(text: str) -> tuple[float, ...]:
    try:
        return tuple(seconds(part) for part in text.split(","))
    except argparse.ArgumentTypeError:
        raise argparse.ArgumentTypeError(
            f"takes positive seconds like 0.5,2, got {text!r}"
        ) from None

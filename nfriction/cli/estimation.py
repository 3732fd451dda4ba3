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
    from nfriction.plant import Plant
    from nfriction.recording import Recording


def add_options(parser: argparse.ArgumentParser) -> None:
    """Options of `fit` and `compare`."""
    parser.add_argument("--rig", required=True, type=names.rig,
                        help="a rig file (.json, .toml), a robot description (.urdf, MuJoCo's "
                        f".xml), or one of {', '.join(names.RIGS)}")  # fmt: skip
    parser.add_argument("--angles", metavar="HOW,ZERO",
                        help="how the files write angles, relative or absolute and from upright or "
                        "hanging, e.g. absolute,hanging (default: as file or rig say)")  # fmt: skip
    parser.add_argument("--degrees", action="store_true", help="the files are in degrees")
    parser.add_argument("--columns", type=_columns, metavar="OURS=THEIRS,...",
                        help="the files' names of time, q1, ..., tau1, ... where they differ, "
                        "e.g. time=t,q1=enc_1,q2=enc_2")  # fmt: skip
    parser.add_argument("--windows", type=_windows, metavar="SECONDS",
                        help="lengths of the fitted windows, one after the other [s] "
                        "(default: 0.5,2,5)")  # fmt: skip
    parser.add_argument("--plant", choices=("fit", "given"), default="fit",
                        help="adjust inertia and gravity terms within bounds, or keep those of "
                        "the rig")  # fmt: skip
    parser.add_argument("--drag", action=argparse.BooleanOptionalAction,
                        help="fit air drag on the links, or none (default: where nothing drives "
                        "the rig)")  # fmt: skip
    parser.add_argument("--eccentricity", choices=("none", "fit", "evidence"), default="none",
                        help="how far encoders sit off their shafts: none, fitted, or fitted "
                        "where the evidence asks for it")  # fmt: skip
    parser.add_argument("--zeroed", choices=("auto", "once", "each"), default="auto",
                        help="when incremental encoders were set to zero: once, or at the start of "
                        "each recording, wherever dry friction held the links (default: each, "
                        "where all recordings of a driven rig begin at rest at zero)")  # fmt: skip
    parser.add_argument("--continuity", choices=("free", "soft", "hard"), default="free",
                        help="windows of a recording: each with a start of its own, or one "
                        "motion but for jumps of 0.3 mrad, or for none")  # fmt: skip
    parser.add_argument("--max-steps", type=count, default=30, metavar="N",
                        help="most steps of the search at each window length")  # fmt: skip


def fit_settings(arguments: argparse.Namespace) -> dict[str, Any]:
    """What `nfriction.fit` takes of these options; its own default where one is not given."""
    windows = {} if arguments.windows is None else {"windows": arguments.windows}
    return {
        **windows,
        "fit_plant": arguments.plant == "fit",
        "drag": arguments.drag,
        "eccentricity": {"none": False, "fit": True, "evidence": None}[arguments.eccentricity],
        "zeroed": arguments.zeroed,
        "continuity": arguments.continuity,
        "max_steps": arguments.max_steps,
    }


def read_rig(name: str) -> Plant:
    """The rig that `--rig` names."""
    from nfriction.plant import rigs

    return rigs.by_name(name) if name in names.RIGS else rigs.read(name)


def read_recordings(
    paths: Sequence[Path], plant: Plant, arguments: argparse.Namespace
) -> list[Recording]:
    """The recordings in files, in the angles and units that the options tell."""
    from nfriction.recording import Recording, RecordingWarning

    unit: Literal["rad", "m"] = "m" if plant.unit == "m" else "rad"
    recordings: list[Recording] = []
    said: dict[str, list[str]] = {}
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
        for warning in caught:
            message = str(warning.message).removeprefix(f"recording '{recording.name}': ")
            said.setdefault(message, []).append(recording.name)
    in_degrees = [name for told, of in said.items() if "degrees=True" in told for name in of]
    for told, of in said.items():
        if "degrees=True" not in told:
            warn(f"{', '.join(of)}: {one_line(told)}")
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

"""Options of the commands that read a user's recordings and fit models to them."""

from __future__ import annotations

import argparse
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from nfriction.cli import names
from nfriction.cli.console import UsageError, count, one_line, seconds, warn
from nfriction.fitting.options import CHOICES

if TYPE_CHECKING:
    from nfriction.plant import Plant
    from nfriction.recording import Recording


def add_options(parser: argparse.ArgumentParser) -> None:
    """Options of `fit` and `compare`."""
    parser.add_argument("--rig", required=True, type=names.rig,
                        help="a rig file (.json, .toml), a robot description (.urdf, MuJoCo's "
                        f".xml), or one of {', '.join(names.RIGS)}")  # fmt: skip
    parser.add_argument("--angles", metavar="HOW,ZERO",
                        help="angle convention of the files: relative or absolute, from upright or "
                        "hanging, e.g. absolute,hanging (default: of the file or the rig)"
                        )  # fmt: skip
    parser.add_argument("--degrees", action="store_true", help="the files are in degrees")
    parser.add_argument("--columns", type=_columns, metavar="OURS=THEIRS,...",
                        help="the files' names of time, q1, ..., tau1, ... where they differ, "
                        "e.g. time=t,q1=enc_1,q2=enc_2")  # fmt: skip
    parser.add_argument("--windows", type=_windows, metavar="SECONDS",
                        help="lengths of the shooting windows, in the order of their use [s] "
                        "(default: 0.5,2,5)")  # fmt: skip
    parser.add_argument("--fit-plant", action=argparse.BooleanOptionalAction, default=True,
                        help="adjust the rig's inertia and gravity terms within bounds "
                        "(default: yes)")  # fmt: skip
    parser.add_argument(
        "--drag",
        action=argparse.BooleanOptionalAction,
        help="fit air drag on the links (default: if nothing drives the rig)",
    )
    parser.add_argument("--eccentricity", choices=CHOICES["eccentricity"], default="off",
                        help="fit the eccentricity of the encoders; auto: if the evidence favours "
                        "it (default: off)")  # fmt: skip
    parser.add_argument("--encoder-reference", choices=CHOICES["encoder_reference"],
                        default="auto", help="when incremental encoders were set to zero: before "
                        "all recordings (shared), or at the start of each in a pose held by "
                        "stiction (default: per_recording if all recordings of a driven rig begin "
                        "at rest at zero)")  # fmt: skip
    parser.add_argument("--continuity", choices=CHOICES["continuity"], default="none",
                        help="continuity between shooting windows: none, penalised, or enforced "
                        "(default: none)")  # fmt: skip
    parser.add_argument(
        "--max-steps",
        type=count,
        default=30,
        metavar="N",
        help="limit of search steps at each window length (default: 30)",
    )


def fit_settings(arguments: argparse.Namespace) -> dict[str, Any]:
    """Arguments of `nfriction.fit` among these options; its own default where one is not given."""
    windows = {} if arguments.windows is None else {"windows": arguments.windows}
    own = (
        "fit_plant", "drag", "eccentricity", "encoder_reference", "continuity", "max_steps",
    )  # fmt: skip
    return windows | {name: getattr(arguments, name) for name in own}


def read_rig(name: str) -> Plant:
    """The rig that `--rig` names."""
    from nfriction.plant import rigs

    return rigs.by_name(name) if name in names.RIGS else rigs.read(name)


def read_recordings(
    paths: Sequence[Path], plant: Plant, arguments: argparse.Namespace
) -> list[Recording]:
    """The recordings in files, in the angles and units of the options."""
    from nfriction.recording import Recording, RecordingWarning

    unit: Literal["rad", "m"] = "m" if plant.unit == "m" else "rad"
    recordings: list[Recording] = []
    said_of: dict[str, list[str]] = {}
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
            said_of.setdefault(message, []).append(recording.name)
    in_degrees = [name for text, of in said_of.items() if "degrees=True" in text for name in of]
    for text, of in said_of.items():
        if "degrees=True" not in text:
            warn(f"{', '.join(of)}: {one_line(text)}")
    # Every change of coordinates would repeat the warning.
    warnings.simplefilter("ignore", RecordingWarning)
    if in_degrees:
        # If the option is missing for one file, it is missing for all.
        warn(
            f"{', '.join(in_degrees)}: positions look like degrees or encoder counts; if so, add "
            "--degrees, or state the counts of a turn, as in --columns q1=q1:counts/8192."
        )
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

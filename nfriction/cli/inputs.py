"""Parsers for the values of options, and the options of fits.

Importing this module does not import torch; a test keeps `RIGS` equal to `rigs.names()`.
"""

from __future__ import annotations

import argparse
import difflib
import importlib.machinery
import math
import re
import types
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from nfriction.cli.console import UsageError, one_line, warn
from nfriction.fitting.options import CHOICES
from nfriction.friction import model_list, model_name

if TYPE_CHECKING:
    from nfriction.plant import Plant
    from nfriction.recording import Recording

RIGS = (
    "tlrip", "rtip", "multiarm-single", "multiarm-double", "multiarm-triple",
    "dfki-A0", "dfki-C0", "dfki-C1", "emps", "xl330",
)  # fmt: skip
MODELS = model_list()
FORMATS = (
    "CSV, TSV or TXT, Parquet, NumPy .npz, MATLAB .mat, HDF5 .h5, or MDF4 .mf4 from ASAM loggers"
)
RIG_FILES = (".json", ".toml", ".urdf", ".xml", ".mjcf")
DEFAULT_MODELS = "viscous,load-coulomb,arctan,stribeck,neuro-fuzzy:load-coulomb"
# Options of `nfriction.fit`, whose defaults apply where an option is not given.
_FIT_OPTIONS = (
    "windows", "fit_plant", "drag", "eccentricity", "encoder_reference", "max_steps",
    "loss", "fit_delay",
)  # fmt: skip


# `my.py:LAW`, alone or after the kind of its coefficients.
_OWN_LAW = re.compile(r"(?P<kind>neuro-fuzzy:|adaptive:|)(?P<file>.+\.py):(?P<law>\w+)")
# FILE.py:LAW by the name of the law.
_SOURCES: dict[str, str] = {}


def model(text: str) -> str:
    """The name of a friction model, plain or abbreviated, or FILE.py:LAW, for argparse."""
    own = _OWN_LAW.fullmatch(text.strip())
    try:
        return model_name(text if own is None else own["kind"] + law(f"{own['file']}:{own['law']}"))
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error).rstrip(".")) from None


def models(text: str) -> list[str]:
    """Comma-separated names of friction models, for argparse."""
    names = [model(name) for name in text.split(",") if name.strip()]
    if not names:
        raise argparse.ArgumentTypeError(f"needs names of models, got none; there are {MODELS}")
    return names


def law(text: str) -> str:
    """The name of a law in FILE.py:LAW, which it registers, for argparse."""
    own = _OWN_LAW.fullmatch(text.strip())
    if own is None or own["kind"]:
        raise argparse.ArgumentTypeError(f"must be a law as my.py:LAW, got {text!r}")
    from nfriction.friction import add_law
    from nfriction.friction.laws import Law

    path = file(own["file"])
    loader = importlib.machinery.SourceFileLoader(path.stem, str(path))
    module = types.ModuleType(path.stem)
    module.__file__ = str(path)
    try:
        loader.exec_module(module)
    except (SyntaxError, ImportError, NameError, TypeError, ValueError, LookupError) as error:
        raise argparse.ArgumentTypeError(
            f"{path} cannot be run: {type(error).__name__}: {error}"
        ) from error
    found = getattr(module, own["law"], None)
    if not isinstance(found, Law):
        laws = ", ".join(k for k, v in vars(module).items() if isinstance(v, Law))
        raise argparse.ArgumentTypeError(
            f"{path} has no law {own['law']}; its laws: {laws or 'none'}"
        )
    try:
        name = add_law(found)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error).rstrip(".")) from None
    _SOURCES[found.name] = text.strip()
    return name


def law_words(name: str) -> list[str]:
    """Words of a command line that name the file of a law; none for a law of this package."""
    # Inputs add to the name of a law.
    own = [text for law, text in _SOURCES.items() if name == law or name.startswith(f"{law}_by_")]
    return ["--law", own[0]] if own else []


def rig(text: str) -> str:
    """A named rig or a rig file, for argparse."""
    if text in RIGS:
        return text
    if Path(text).suffix.lower() not in RIG_FILES:
        by_lower = {name.lower(): name for name in RIGS}
        near = difflib.get_close_matches(text.lower(), by_lower, 1)
        meant = f" (did you mean {by_lower[near[0]]}?)" if near else ""
        raise argparse.ArgumentTypeError(
            f"no rig is called {text!r}{meant}; give a file "
            f"({', '.join(RIG_FILES)}) or one of {', '.join(RIGS)}"
        )
    return str(file(text))


def file(text: str) -> Path:
    """An existing file, for argparse."""
    path = Path(text)
    if not path.is_file():
        what = "is not a file" if path.exists() else "does not exist"
        raise argparse.ArgumentTypeError(f"{text} {what}; check the path")
    return path


def count(text: str) -> int:
    """A whole number from 0, for argparse."""
    if not text.isdecimal():
        raise argparse.ArgumentTypeError(f"must be a whole number from 0, got {text!r}")
    return int(text)


def jobs(text: str) -> int:
    """A number of processes from 1, or -1, for argparse."""
    if text != "-1" and not (text.isdecimal() and int(text)):
        raise argparse.ArgumentTypeError(
            f"must be a whole number from 1, or -1 for one per core, got {text!r}"
        )
    return int(text)


def positive(text: str) -> float:
    """A positive number, for argparse."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0 < value < math.inf:
        raise argparse.ArgumentTypeError(f"must be one number above 0, got {text!r}")
    return value


def positives(text: str) -> tuple[float, ...]:
    """Comma-separated positive numbers, for argparse."""
    try:
        return tuple(map(positive, text.split(",")))
    except argparse.ArgumentTypeError:
        raise argparse.ArgumentTypeError(
            f"must be positive numbers like 0.5,2, got {text!r}"
        ) from None


def columns(text: str) -> dict[str, str]:
    """Names of columns, ours and the file's, for argparse."""
    pairs = [part.split("=", 1) for part in text.split(",")]
    if any(len(pair) < 2 or not all(map(str.strip, pair)) for pair in pairs):
        raise argparse.ArgumentTypeError(f"must be pairs like time=t,q1=enc_1, got {text!r}")
    return {ours.strip(): theirs.strip() for ours, theirs in pairs}


def add_law_option(parser: argparse.ArgumentParser) -> None:
    """The option of commands that read a model file."""
    parser.add_argument("--law", type=law, action="append", metavar="FILE.py:LAW",
                        help="law of your own that the model file needs")  # fmt: skip


def add_fit_options(parser: argparse.ArgumentParser) -> None:
    """Options of `fit` and `compare`."""
    add = parser.add_argument
    add("--rig", required=True, type=rig,
        help="a rig file (.json, .toml), a model file for its fitted rig, a robot description "
        f"(.urdf; MuJoCo's .xml or .mjcf), or one of {', '.join(RIGS)}")  # fmt: skip
    add_reading_options(parser)
    add("--windows", type=positives, metavar="SECONDS",
        help="lengths of the shooting windows, in the order of their use [s] (default: 0.5,2,5)"
        )  # fmt: skip
    add("--fit-plant", action=argparse.BooleanOptionalAction, default=True,
        help="adjust the rig within bounds: inertia, gravity, lengths, encoder zeros, gear losses, "
        "torque constants and offsets, air drag (default: yes)")  # fmt: skip
    add("--drag", action=argparse.BooleanOptionalAction,
        help="fit air drag on the links (default: if nothing drives the rig)")  # fmt: skip
    add("--eccentricity", choices=CHOICES["eccentricity"], default="off",
        help="fit the eccentricity of the encoders; auto: if the evidence favours it (default: off)"
        )  # fmt: skip
    add("--encoder-reference", choices=CHOICES["encoder_reference"], default="auto",
        help="when incremental encoders were set to zero: before all recordings (shared), or at "
        "the start of each in a pose held by stiction (per_recording); auto: per_recording if "
        "several recordings of a driven chain begin at rest at zero (default: auto)")  # fmt: skip
    add("--max-steps", type=count, default=30, metavar="N",
        help="limit of search steps at each window length (default: 30)")  # fmt: skip
    add("--loss", choices=CHOICES["loss"], default="linear",
        help="loss function: linear for least squares; the others give sensor spikes less weight "
        "and name them (default: linear)")  # fmt: skip
    add("--fit-delay", action="store_true",
        help="estimate the delay of recorded torques relative to positions")  # fmt: skip


def add_reading_options(parser: argparse._ActionsContainer) -> None:
    """Options that describe how recordings are written."""
    add = parser.add_argument
    add("--angles", metavar="HOW,ZERO",
        help="angle convention of the recordings: relative or absolute, from upright or hanging, "
        "e.g. absolute,hanging (default: that of the file or the rig)")  # fmt: skip
    add("--degrees", action="store_true", help="the recordings are in degrees")
    add("--columns", type=columns, metavar="OURS=THEIRS,...",
        help="the files' column names for time, q1, ..., tau1, ... (of motors: motor1, current1), "
        "optionally with a unit, e.g. time=t:ms,q1=enc_1:deg,q2=enc_2:counts/8192"
        )  # fmt: skip


def fit_settings(arguments: argparse.Namespace) -> dict[str, Any]:
    """Arguments of `nfriction.fit` among these options; its own windows where none are given."""
    settings = {name: getattr(arguments, name) for name in _FIT_OPTIONS}
    if settings["windows"] is None:
        del settings["windows"]
    return settings


def read_rig(name: str) -> Plant:
    """The rig that `--rig` names."""
    from nfriction.plant import rigs

    return rigs.of(name)


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
                convention=arguments.angles, unit=unit, plant=plant,
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
        pairs = {"q1": "q1"} | (arguments.columns or {})
        ours = "motor1" if "motor1" in pairs else "q1"
        theirs, _, _ = pairs[ours].partition(":")
        warn(
            f"{', '.join(in_degrees)}: positions look like degrees or encoder counts; if so, add "
            f"--degrees, or state the counts per turn, as in --columns {ours}={theirs}"
            ":counts/8192."
        )
    return recordings

"""Names that options take; importing them needs no torch.

A test holds `RIGS` equal to `rigs.names()`.
"""

import argparse
from pathlib import Path

from nfriction.friction import model_names

MODELS = model_names()
RIGS = (
    "tlrip", "rtip", "multiarm-single", "multiarm-double", "multiarm-triple",
    "dfki-A0", "dfki-C0", "dfki-C1", "emps", "xl330",
)  # fmt: skip
FORMATS = "CSV, TSV, TXT, Parquet, NPZ, MAT, HDF5 or MDF4"
RIG_FILES = (".json", ".toml", ".urdf", ".xml", ".mjcf")
DEFAULT_MODELS = "NCFM,LFM,NLFM,NFLFM"


def model(text: str) -> str:
    """The name of a friction model, for argparse."""
    if text not in MODELS:
        raise argparse.ArgumentTypeError(
            f"no friction model is called {text!r}; there are {', '.join(MODELS)}"
        )
    return text


def models(text: str) -> list[str]:
    """Names of friction models with commas between them, for argparse."""
    names = [model(name.strip()) for name in text.split(",") if name.strip()]
    if not names:
        raise argparse.ArgumentTypeError(f"takes names of {', '.join(MODELS)}, got none")
    return names


def rig(text: str) -> str:
    """A named rig or a rig file, for argparse."""
    if text in RIGS:
        return text
    if Path(text).suffix.lower() not in RIG_FILES:
        raise argparse.ArgumentTypeError(
            f"no rig is called {text!r}; give a file ({', '.join(RIG_FILES)}) or one of "
            f"{', '.join(RIGS)}"
        )
    return str(file(text))


def file(text: str) -> Path:
    """A file that is there, for argparse."""
    path = Path(text)
    if not path.is_file():
        what = "is no file" if path.exists() else "is not there"
        raise argparse.ArgumentTypeError(f"{text} {what}; check the path")
    return path

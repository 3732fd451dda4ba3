"""The command line that the builders in `datasets/` share."""

import argparse
from collections.abc import Sequence
from pathlib import Path

from nfriction.papers.twin.dataset import QUICK_DURATION, build


def main(name: str, argv: Sequence[str] | None = None) -> int:
    """Build a twin as the command line asks and print what was written."""
    parser = argparse.ArgumentParser(description=f"Build the recordings of the {name} twin.")
    parser.add_argument("--out", type=Path, default=Path(f"runs/{name}_twin"), help="folder")
    parser.add_argument("--seed", type=int, default=0, help="of encoder errors and jitter")
    parser.add_argument(
        "--quick", action="store_true", help=f"recordings of {QUICK_DURATION:g} s only"
    )
    arguments = parser.parse_args(argv)
    duration = QUICK_DURATION if arguments.quick else None
    twin = build(name, arguments.out, seed=arguments.seed, duration=duration, progress=True)
    for label, recording in twin.recordings.items():
        print(f"{label:16} {twin.splits[label]:9} {len(recording)} samples")
    print(f"written to {arguments.out}")
    return 0

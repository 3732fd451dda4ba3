"""Build the samples of the papers' fuzzy controllers; the card beside this file describes them."""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from nfriction.papers.controller.samples import build_samples, checksums
from nfriction.papers.twin import QUICK_DURATION


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("runs/tlrip_controller"), help="folder")
    parser.add_argument("--seed", type=int, default=0, help="of encoder errors and jitter")
    parser.add_argument("--quick", action="store_true", help=f"{QUICK_DURATION:g} s of motion only")
    arguments = parser.parse_args(argv)
    duration = QUICK_DURATION if arguments.quick else None
    samples = build_samples(arguments.out, seed=arguments.seed, duration=duration)
    for joint, checksum in checksums(samples).items():
        print(f"{joint}  {len(samples)} samples  {checksum}")
    print(f"written to {arguments.out}")
    return 0


if __name__ == "__main__":
    sys.exit(main())

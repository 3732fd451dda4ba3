"""Build a data set of simulated rigs in a folder; the cards in this folder describe them.

python datasets/build.py tlrip_twin --out runs/tlrip_twin
"""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from nfriction.datasets import CONTROLLER
from nfriction.papers import twin
from nfriction.papers.controller.samples import build_samples, checksums

NAMES = [*(f"{name}_twin" for name in twin.names()), CONTROLLER]


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("name", choices=NAMES)
    parser.add_argument("--out", type=Path, help="folder to write (default: runs/NAME)")
    parser.add_argument("--seed", type=int, default=0, help="of encoder errors and jitter")
    parser.add_argument("--quick", action="store_true", help=f"{twin.QUICK_DURATION:g} s only")
    given = parser.parse_args(argv)
    out, duration = given.out or Path("runs") / given.name, twin.QUICK_DURATION
    options = {"seed": given.seed, "duration": duration if given.quick else None}
    if given.name == CONTROLLER:
        samples = build_samples(out, **options)
        lines = [f"{joint}  {len(samples)} samples  {c}" for joint, c in checksums(samples).items()]
    else:
        made = twin.build(given.name.removesuffix("_twin"), out, progress=True, **options)
        lines = [f"{n:16} {made.splits[n]:9} {len(r)} samples" for n, r in made.recordings.items()]
    print("\n".join([*lines, f"written to {out}"]))
    return 0


if __name__ == "__main__":
    sys.exit(main())

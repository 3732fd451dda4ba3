"""Build a data set of simulated rigs in a folder; the cards in this folder describe them.

python datasets/build.py tlrip_twin --out runs/tlrip_twin
"""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from nfriction.cli import console
from nfriction.cli.inputs import count
from nfriction.datasets import CONTROLLER
from nfriction.papers import twin
from nfriction.papers.controller.samples import build_samples, checksums
from nfriction.papers.twin.dataset import specification

NAMES = [*(f"{name}_twin" for name in twin.names()), CONTROLLER]


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("name", choices=NAMES)
    parser.add_argument("--out", type=Path, help="folder to write (default: runs/NAME)")
    parser.add_argument("--seed", type=count, default=0, help="of encoder errors and jitter")
    parser.add_argument("--quick", action="store_true", help=f"{twin.QUICK_DURATION:g} s only")
    given = parser.parse_args(argv)
    out, duration = given.out or Path("runs") / given.name, twin.QUICK_DURATION
    if fault := _fault(given.name, out):
        parser.error(f"--out must be a new folder or one of this data set, got {out}, {fault}.")
    options = {"seed": given.seed, "duration": duration if given.quick else None}
    if given.name == CONTROLLER:
        samples = build_samples(out, **options)
        lines = [f"{joint}  {len(samples)} samples  {c}" for joint, c in checksums(samples).items()]
    else:
        made = twin.build(given.name.removesuffix("_twin"), out, progress=True, **options)
        lines = [f"{n:16} {made.splits[n]:9} {len(r)} samples" for n, r in made.recordings.items()]
    try:
        print("\n".join([*lines, f"written to {out}"]), flush=True)
    except BrokenPipeError:
        return console.drop_output()
    return 0


def _fault(name: str, out: Path) -> str:
    """Reason why a data set cannot be built in a folder, empty if it can."""
    for path in (out, *out.parents):
        if path.exists() and not path.is_dir():
            return f"but {path} is a file; choose another folder"
    # Files of the same names are replaced; others would be taken for a part of this data set.
    if name == CONTROLLER:
        own = set(specification("experiment").rig().joint_names)
    else:
        own = {release.label for release in specification(name.removesuffix("_twin")).releases}
    others = sorted({p.name for p in out.glob("*.csv.gz")} - {f"{one}.csv.gz" for one in own})
    return f"with {others[0]} of another; choose another folder or empty it" if others else ""


if __name__ == "__main__":
    sys.exit(main())

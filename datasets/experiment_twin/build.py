"""Build the recording of the TLRIP paper's friction experiment; the card here describes it."""

import sys
from collections.abc import Sequence

from nfriction.papers.twin.dataset import main as build_twin


def main(argv: Sequence[str] | None = None) -> int:
    return build_twin("experiment", argv)


if __name__ == "__main__":
    sys.exit(main())

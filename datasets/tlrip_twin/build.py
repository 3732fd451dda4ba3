"""Build the recordings of the TLRIP twin; the card beside this file describes them."""

import sys
from collections.abc import Sequence

from nfriction.papers.twin.dataset import main as build_twin


def main(argv: Sequence[str] | None = None) -> int:
    return build_twin("tlrip", argv)


if __name__ == "__main__":
    sys.exit(main())

"""How large a recording may be, asked before it takes memory."""

# An hour of ten joints at 1 kHz with torque and velocity, as numbers.
LARGEST = 2**30
# Every column is looked at by itself.
MOST_COLUMNS = 2000
# Files of measurements pack to a tenth, perhaps; to this share only what holds next to nothing.
UNSUSPECTED, LARGEST_RATIO = 2**26, 200


def most_unpacked(packed: int) -> int:
    """Bytes that a file of this size may unpack to."""
    return min(LARGEST, max(UNSUSPECTED, LARGEST_RATIO * packed))


def refuse_bomb(unpacked: int, packed: int) -> None:
    """Refuse what unpacks to far more than its file: it holds no measurements.

    Args:
        unpacked, packed: sizes [bytes].
    Raises:
        ValueError: more than the limits.
    """
    refuse_size(unpacked, "unpacked bytes")
    if unpacked > most_unpacked(packed):
        raise ValueError(
            f"it unpacks to {unpacked} bytes or more, {unpacked // max(packed, 1)} times its size, "
            f"as no recording does; if it is one, write it without packing"
        )


def refuse_size(count: int, what: str = "bytes") -> None:
    """Refuse what would not fit: a file that unpacks to far more than it seems, or a wrong one.

    Raises:
        ValueError: more than the limit.
    """
    if count > LARGEST:
        raise ValueError(
            f"it holds {count} {what}, more than {LARGEST} are read; cut it into parts"
        )

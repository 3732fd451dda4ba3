"""How large a recording may be, asked before it takes memory."""

# An hour of ten joints at 1 kHz with torque and velocity, as numbers.
LARGEST = 2**30


def refuse_size(count: int, what: str = "bytes") -> None:
    """Refuse what would not fit: a file that unpacks to far more than it seems, or a wrong one.

    Raises:
        ValueError: more than the limit.
    """
    if count > LARGEST:
        raise ValueError(
            f"it holds {count} {what}, more than {LARGEST} are read; cut it into parts"
        )

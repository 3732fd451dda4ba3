"""Recordings of a mechanism: validated arrays in SI units, from files and tables and back."""

from nfriction.recording.record import (
    Recording,
    RecordingLike,
    RecordingWarning,
    Unit,
    read_initial_states,
)
from nfriction.recording.validation import MINIMUM_SAMPLES, Array, is_uniform

__all__ = [
    "MINIMUM_SAMPLES",
    "Array",
    "Recording",
    "RecordingLike",
    "RecordingWarning",
    "Unit",
    "is_uniform",
    "read_initial_states",
]

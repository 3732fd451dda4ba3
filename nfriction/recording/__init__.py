"""Recordings of a mechanism: validated arrays in SI units, from files and tables and back."""

from nfriction.recording.record import Recording, RecordingWarning, Unit, read_initial_states
from nfriction.recording.validation import MINIMUM_SAMPLES, is_uniform

__all__ = [
    "MINIMUM_SAMPLES",
    "Recording",
    "RecordingWarning",
    "Unit",
    "is_uniform",
    "read_initial_states",
]

"""Numbers printed in the two papers, to stand beside ours.

The papers' recordings were never published, so these cannot be reproduced to the digit: they come
from another machine. Units of the position errors are not printed; radians are presumed.
"""

JOINTS = ("joint 2", "joint 3", "joint 4")

TABLE_10: dict[str, tuple[float, float, float]] = {
    "ANCFM": (0.1397, 1.8105, 0.6995),
    "ALFM": (0.1127, 1.8032, 0.6743),
    "ANLFM": (0.0983, 0.1115, 0.6248),
    "NFNCFM": (0.1259, 0.8105, 0.5480),
    "NFLFM": (0.0987, 0.1794, 0.4372),
    "NFNLFM": (0.0829, 0.0986, 0.3304),
}
"""TLRIP paper, Table 10: position RMSE by model and joint."""

TABLE_6: dict[str, tuple[tuple[str, float, float], ...]] = {
    "joint 2": (("high", 0.0, 7.0), ("medium", 7.0, 14.0), ("low", 14.0, 40.0)),
    "joint 3": (("high", 0.0, 6.0), ("medium", 6.0, 16.0), ("low", 16.0, 40.0)),
    "joint 4": (
        ("low", 0.0, 1.3),
        ("high", 1.3, 4.5),
        ("medium", 4.5, 13.0),
        ("low", 13.0, 30.0),
    ),
}
"""TLRIP paper, Table 6: class of acceleration, from and to [s]."""

SECOND_COEFFICIENTS: dict[str, dict[str, tuple[float, float, float]]] = {
    "NCFM": {"C_p": (5.6178e-4, 2.9319e-10, 9.0673e-4)},
    "LFM": {
        "B": (6.1865e-4, 3.1009e-7, 2.2292e-4),
        "C": (2.7550e-5, 4.9864e-9, 0.0168),
    },
    "NLFM": {
        "f_o": (0.0038, 1.5280e-6, 0.001),
        "f_c": (9.5940e-4, 8.8846e-4, 0.0165),
        "f_v": (0.0011, 0.0315, 0.0577),
        "f_a": (0.0869, 0.1876, 7.2715e-4),
        "f_b": (0.0159, 0.1876, 0.0456),
    },
}
"""RTIP paper, Tables I to III: coefficients by model and joint."""

SECOND_TABLE_4: dict[str, tuple[float, float, float]] = {
    "NCFM": (0.0052, 0.0071, 0.0085),
    "LFM": (0.0049, 0.0065, 0.0079),
    "NLFM": (0.0025, 0.0047, 0.0035),
}
"""RTIP paper, Table IV: position RMSE by model and joint."""

"""How thorough a reproduction is; whatever it depends on is in one place, so it can be resumed."""

import hashlib
import json
from dataclasses import asdict, dataclass
from typing import Any

from nfriction.version import __version__


@dataclass(frozen=True)
class Settings:
    """All that the results of a reproduction depend on.

    Attributes:
        seed: of the encoders' errors, the controllers' samples and the searches.
        tlrip_seconds, rtip_seconds: length of each twin's recordings; the papers took 40 and 80.
        windows: lengths of the fits' windows [s].
        max_steps: of the fits, at each length.
        network_steps: of the neuro-fuzzy models' fits.
        terms, head_units: of the neuro-fuzzy models.
        controller_samples: a joint, on which the papers' network learns.
        search_horizon: length of the windows that a search simulates [s].
        search_evaluations: most simulations of a search on the position error.
        torchscript: export every model.
    """

    seed: int = 0
    tlrip_seconds: float = 40.0
    rtip_seconds: float = 80.0
    windows: tuple[float, ...] = (0.5, 2.0)
    max_steps: int = 30
    network_steps: int = 8
    terms: tuple[int, int] = (5, 5)
    head_units: int = 10
    controller_samples: int = 40_000
    search_horizon: float = 5.0
    search_evaluations: int = 1500
    torchscript: bool = True

    def to_dict(self) -> dict[str, Any]:
        """Plain JSON."""
        return asdict(self) | {"windows": list(self.windows), "terms": list(self.terms)}

    def digest(self) -> str:
        """What marks a result as made with these very settings by this very version."""
        content = json.dumps(self.to_dict() | {"version": __version__}, sort_keys=True)
        return hashlib.sha256(content.encode()).hexdigest()[:16]


FULL = Settings()
"""As the papers: recordings of 40 and 80 s."""

QUICK = Settings(
    tlrip_seconds=10.0,
    rtip_seconds=10.0,
    max_steps=5,
    network_steps=2,
    terms=(3, 3),
    head_units=5,
    controller_samples=2000,
    search_evaluations=200,
)
"""A look at everything within two minutes; the figures are then not the papers'."""

"""nfriction: joint friction models from encoder recordings.

Names load what they need when they are first used, so `import nfriction` itself is quick.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from nfriction.version import __version__

if TYPE_CHECKING:
    from nfriction import export, plots
    from nfriction.comparison import Comparison, compare
    from nfriction.fitting import Fit, fit
    from nfriction.friction import (
        LFM,
        NCFM,
        NFLFM,
        NFNCFM,
        NFNLFM,
        NLFM,
        FrictionModel,
        Stribeck,
    )
    from nfriction.modelfile import ModelInfo, load, save
    from nfriction.plant import LinearAxis, PendulumChain, rigs
    from nfriction.recording import Recording
    from nfriction.scoring import Score, score
    from nfriction.simulation import Rollout, rollout

_HOME = {
    "comparison": ("Comparison", "compare"),
    "fitting": ("Fit", "fit"),
    "friction": (
        "LFM",
        "NCFM",
        "NFLFM",
        "NFNCFM",
        "NFNLFM",
        "NLFM",
        "FrictionModel",
        "Stribeck",
    ),
    "modelfile": ("ModelInfo", "load", "save"),
    "plant": ("LinearAxis", "PendulumChain", "rigs"),
    "recording": ("Recording",),
    "scoring": ("Score", "score"),
    "simulation": ("Rollout", "rollout"),
}
_MODULE = {name: module for module, names in _HOME.items() for name in names}

__all__ = [
    "LFM",
    "NCFM",
    "NFLFM",
    "NFNCFM",
    "NFNLFM",
    "NLFM",
    "Comparison",
    "Fit",
    "FrictionModel",
    "LinearAxis",
    "ModelInfo",
    "PendulumChain",
    "Recording",
    "Rollout",
    "Score",
    "Stribeck",
    "__version__",
    "compare",
    "export",
    "fit",
    "load",
    "plots",
    "rigs",
    "rollout",
    "save",
    "score",
]


def __getattr__(name: str) -> Any:
    if name in ("export", "plots"):
        return import_module(f"nfriction.{name}")
    if name not in _MODULE:
        raise AttributeError(f"module 'nfriction' has no attribute {name!r}")
    value = getattr(import_module(f"nfriction.{_MODULE[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(__all__)

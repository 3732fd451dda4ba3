"""nfriction: joint friction models from encoder recordings.

Names load what they need when they are first used, so `import nfriction` itself is quick.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from nfriction.version import __version__

if TYPE_CHECKING:
    from nfriction import export, plots
    from nfriction.angles import AngleConvention
    from nfriction.comparison import Comparison, compare
    from nfriction.estimators import FrictionEstimator
    from nfriction.fitting import Fit, fit, fit_adaptive, fit_by_search
    from nfriction.friction import (
        ACFM,
        ACVFM,
        ALFM,
        ANCFM,
        ANLFM,
        CFM,
        CVFM,
        LFM,
        NCFM,
        NFCFM,
        NFCVFM,
        NFLFM,
        NFNCFM,
        NFNLFM,
        NLFM,
        FrictionModel,
        NFStribeck,
        Stribeck,
    )
    from nfriction.modelfile import ModelInfo, info_of, load, plant_of, save
    from nfriction.plant import LinearAxis, PendulumChain, Plant, rigs
    from nfriction.recording import Recording
    from nfriction.scoring import Score, score
    from nfriction.selection import Selection, select
    from nfriction.simulation import Rollout, rollout

_HOME = {
    "angles": ("AngleConvention",),
    "comparison": ("Comparison", "compare"),
    "estimators": ("FrictionEstimator",),
    "fitting": ("Fit", "fit", "fit_adaptive", "fit_by_search"),
    "friction": (
        "ACFM",
        "ACVFM",
        "ALFM",
        "ANCFM",
        "ANLFM",
        "CFM",
        "CVFM",
        "LFM",
        "NCFM",
        "NFCFM",
        "NFCVFM",
        "NFLFM",
        "NFNCFM",
        "NFNLFM",
        "NFStribeck",
        "NLFM",
        "FrictionModel",
        "Stribeck",
    ),
    "modelfile": ("ModelInfo", "info_of", "load", "plant_of", "save"),
    "plant": ("LinearAxis", "PendulumChain", "Plant", "rigs"),
    "recording": ("Recording",),
    "scoring": ("Score", "score"),
    "selection": ("Selection", "select"),
    "simulation": ("Rollout", "rollout"),
}
_MODULE = {name: module for module, names in _HOME.items() for name in names}

__all__ = [
    "ACFM",
    "ACVFM",
    "ALFM",
    "ANCFM",
    "ANLFM",
    "CFM",
    "CVFM",
    "LFM",
    "NCFM",
    "NFCFM",
    "NFCVFM",
    "NFLFM",
    "NFNCFM",
    "NFNLFM",
    "NLFM",
    "AngleConvention",
    "Comparison",
    "Fit",
    "FrictionEstimator",
    "FrictionModel",
    "LinearAxis",
    "ModelInfo",
    "NFStribeck",
    "PendulumChain",
    "Plant",
    "Recording",
    "Rollout",
    "Score",
    "Selection",
    "Stribeck",
    "__version__",
    "compare",
    "export",
    "fit",
    "fit_adaptive",
    "fit_by_search",
    "info_of",
    "load",
    "plant_of",
    "plots",
    "rigs",
    "rollout",
    "save",
    "score",
    "select",
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

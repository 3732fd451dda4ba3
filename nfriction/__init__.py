"""nfriction: joint friction models from encoder recordings."""

from nfriction import export
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
from nfriction.version import __version__

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
    "rigs",
    "rollout",
    "save",
    "score",
]

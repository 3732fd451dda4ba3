"""Friction models: laws times schedules."""

from nfriction.friction.adaptive import CLASSES, Adaptive
from nfriction.friction.adaptive_neurofuzzy import AdaptiveNeuroFuzzy
from nfriction.friction.constant import Constant
from nfriction.friction.controller_schedule import RadialBasis
from nfriction.friction.laws import Coefficient, Law
from nfriction.friction.model import FrictionModel
from nfriction.friction.models import (
    ACVFM,
    ALFM,
    ANCFM,
    ANLFM,
    CVFM,
    LFM,
    MODELS,
    NCFM,
    NFCVFM,
    NFLFM,
    NFNCFM,
    NFNLFM,
    NLFM,
    NFStribeck,
    Stribeck,
    model_by_name,
)
from nfriction.friction.neurofuzzy import NeuroFuzzy
from nfriction.friction.schedules import Schedule

__all__ = [
    "ACVFM",
    "ALFM",
    "ANCFM",
    "ANLFM",
    "CLASSES",
    "CVFM",
    "LFM",
    "MODELS",
    "NCFM",
    "NFCVFM",
    "NFLFM",
    "NFNCFM",
    "NFNLFM",
    "NLFM",
    "Adaptive",
    "AdaptiveNeuroFuzzy",
    "Coefficient",
    "Constant",
    "FrictionModel",
    "Law",
    "NFStribeck",
    "NeuroFuzzy",
    "RadialBasis",
    "Schedule",
    "Stribeck",
    "model_by_name",
]

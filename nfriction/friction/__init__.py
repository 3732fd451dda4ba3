"""Friction models: laws times schedules."""

from nfriction.friction.adaptive import CLASSES, Adaptive
from nfriction.friction.adaptive_neurofuzzy import AdaptiveNeuroFuzzy
from nfriction.friction.controller_schedule import RadialBasis
from nfriction.friction.laws import Coefficient, Law
from nfriction.friction.models import (
    ALFM,
    ANCFM,
    ANLFM,
    LFM,
    MODELS,
    NCFM,
    NFLFM,
    NFNCFM,
    NFNLFM,
    NLFM,
    FrictionModel,
    Stribeck,
    model_by_name,
)
from nfriction.friction.neurofuzzy import NeuroFuzzy
from nfriction.friction.schedules import Constant, Schedule

__all__ = [
    "ALFM",
    "ANCFM",
    "ANLFM",
    "CLASSES",
    "LFM",
    "MODELS",
    "NCFM",
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
    "NeuroFuzzy",
    "RadialBasis",
    "Schedule",
    "Stribeck",
    "model_by_name",
]

"""Friction models: laws times schedules."""

from nfriction.friction.adaptive import CLASSES, Adaptive
from nfriction.friction.adaptive_neurofuzzy import AdaptiveNeuroFuzzy
from nfriction.friction.constant import Constant
from nfriction.friction.controller_schedule import RadialBasis
from nfriction.friction.laws import Coefficient, Law
from nfriction.friction.model import FrictionModel
from nfriction.friction.models import (
    ACFM,
    ACVFM,
    ALFM,
    ANCFM,
    ANLFM,
    CFM,
    CVFM,
    LFM,
    MODELS,
    NCFM,
    NFCFM,
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
    "ACFM",
    "ACVFM",
    "ALFM",
    "ANCFM",
    "ANLFM",
    "CFM",
    "CLASSES",
    "CVFM",
    "LFM",
    "MODELS",
    "NCFM",
    "NFCFM",
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

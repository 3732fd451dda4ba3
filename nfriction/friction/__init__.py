"""Friction models: laws times schedules."""

from nfriction.friction.laws import Coefficient, Law
from nfriction.friction.models import (
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
    "LFM",
    "MODELS",
    "NCFM",
    "NFLFM",
    "NFNCFM",
    "NFNLFM",
    "NLFM",
    "Coefficient",
    "Constant",
    "FrictionModel",
    "Law",
    "NeuroFuzzy",
    "Schedule",
    "Stribeck",
    "model_by_name",
]

"""Friction models: laws times coefficients, by name. Importing the names needs no torch."""

import difflib
from pkgutil import resolve_name
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from nfriction.friction.models import NamedModel

# Classes are resolved only when asked for: a command line then starts quickly, and the core does
# not import the papers' own models.
_MODULES = {
    "nfriction.friction.models": ("NCFM", "LFM", "NLFM", "CFM", "CVFM", "Stribeck"),
    "nfriction.papers.afem.adaptive": ("ANCFM", "ALFM", "ANLFM", "ACFM", "ACVFM"),
    "nfriction.friction.neurofuzzy": (
        *("NFNCFM", "NFLFM", "NFNLFM", "NFCFM", "NFCVFM", "NFStribeck"),
    ),
}
_HOMES = {name: module for module, names in _MODULES.items() for name in names}


def model_names() -> tuple[str, ...]:
    """Names of all models."""
    return tuple(_HOMES)


def model_by_name(name: str) -> "type[NamedModel]":
    """The named model's class.

    Raises:
        ValueError: if no model has that name; the message lists the names.
    """
    if name not in _HOMES:
        near = difflib.get_close_matches(str(name), _HOMES, 1)
        hint = f"; did you mean {near[0]}?" if near else "."
        raise ValueError(
            f"no friction model is called {name!r}; there are {', '.join(_HOMES)}{hint}"
        )
    found: type[NamedModel] = resolve_name(f"{_HOMES[name]}:{name}")
    return found

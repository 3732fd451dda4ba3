"""Names of the friction models; importing them needs no torch, so a command line starts quickly."""

from pkgutil import resolve_name
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from nfriction.friction.models import NamedModel

# Module of each model. The papers' models are resolved by name: the core does not import them.
_MODULES = {
    **dict.fromkeys(
        ("NCFM", "LFM", "NLFM", "CFM", "CVFM", "Stribeck"), "nfriction.friction.models"
    ),
    **dict.fromkeys(("ANCFM", "ALFM", "ANLFM", "ACFM", "ACVFM"), "nfriction.papers.afem.adaptive"),
    **dict.fromkeys(
        ("NFNCFM", "NFLFM", "NFNLFM", "NFCFM", "NFCVFM", "NFStribeck"), "nfriction.friction.models"
    ),
}


def model_names() -> tuple[str, ...]:
    """Names of all models."""
    return tuple(_MODULES)


def model_by_name(name: str) -> "type[NamedModel]":
    """The named model's class.

    Raises:
        ValueError: if no model has that name; the message lists the names.
    """
    if name not in _MODULES:
        raise ValueError(f"no friction model is called {name!r}; there are {', '.join(_MODULES)}.")
    found: type[NamedModel] = resolve_name(f"{_MODULES[name]}:{name}")
    return found

"""Friction models: laws times coefficients, by name. Importing the names needs no torch."""

import difflib
from pkgutil import resolve_name
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from nfriction.friction.models import NamedModel


class _Kind(NamedTuple):
    prefix: str
    """Before a law's plain name."""
    letters: str
    """Before its abbreviation."""
    module: str


# Laws by their plain names, with the abbreviations of the papers.
_LAWS = {
    "viscous": "NCFM",
    "load-coulomb": "LFM",
    "arctan": "NLFM",
    "coulomb": "CFM",
    "coulomb-viscous": "CVFM",
    "stribeck": "Stribeck",
}
# Laws with memory, which have no other kinds yet.
_MEMORY = {
    "dahl": "Dahl",
    "lugre": "LuGre",
    "elasto-plastic": "ElastoPlastic",
    "maxwell-slip": "MaxwellSlip",
}
# Slip elements beside terms of the velocity, for tables of torque.
_HYSTERESIS = {"slip": "Slip", "load-slip": "LoadSlip"}
# Classes are resolved only when asked for: a command line then starts quickly, and the core does
# not import the papers' own models.
_KINDS = (
    _Kind("", "", "nfriction.friction.models"),
    _Kind("adaptive:", "A", "nfriction.papers.afem.adaptive"),
    _Kind("neuro-fuzzy:", "NF", "nfriction.friction.neurofuzzy"),
)
# The one pair that has no class.
_MISSING = ("adaptive:", "stribeck")
_MODELS = {
    kind.letters + short: (kind, law)
    for kind in _KINDS
    for law, short in _LAWS.items()
    if (kind.prefix, law) != _MISSING
}
_KIND_OF_MEMORY = _Kind("", "", "nfriction.friction.memory")
_KIND_OF_HYSTERESIS = _Kind("", "", "nfriction.friction.hysteresis")
_ALL = (
    _MODELS
    | {name: (_KIND_OF_MEMORY, law) for law, name in _MEMORY.items()}
    | {name: (_KIND_OF_HYSTERESIS, law) for law, name in _HYSTERESIS.items()}
)
_BY_TEXT = {
    text.lower(): name for name, (kind, law) in _ALL.items() for text in (name, kind.prefix + law)
}


def model_names() -> tuple[str, ...]:
    """Names of the models without memory, as tables and files show them, and of their classes."""
    return tuple(_MODELS)


def memory_names() -> tuple[str, ...]:
    """Names of the models of laws with memory."""
    return (*_MEMORY.values(), *_HYSTERESIS.values())


def plain_name(name: str) -> str:
    """The plain name of a named model, such as `neuro-fuzzy:stribeck` of `NFStribeck`."""
    kind, law = _ALL[model_name(name)]
    return kind.prefix + law


def model_name(text: str) -> str:
    """The name of the model that is meant by it or by its plain name, in any case of letters.

    Raises:
        ValueError: if no model has that name; the message lists the names.

    Examples:
        >>> model_name("neuro-fuzzy:stribeck"), model_name("lfm")
        ('NFStribeck', 'LFM')
    """
    asked = str(text).strip().lower().replace("_", "-")
    if asked not in _BY_TEXT:
        near = difflib.get_close_matches(asked, _BY_TEXT, 1)
        hint = f" (did you mean {_both_names(_BY_TEXT[near[0]])}?)" if near else ""
        raise ValueError(f"no friction model is called {text!r}{hint}; there are {model_list()}.")
    return _BY_TEXT[asked]


def model_list() -> str:
    """All models in a phrase: the laws by both names, and what may precede them."""
    plain, *others = _KINDS
    laws = ", ".join(_both_names(plain.letters + short) for short in _LAWS.values())
    first = next(iter(_LAWS.values()))
    before = " or ".join(f"{kind.prefix} ({kind.letters}{first}, ...)" for kind in others)
    return (
        f"{laws}; also with {before} before them, except {''.join(_MISSING)}; "
        f"with memory {', '.join((*_MEMORY, *_HYSTERESIS))}"
    )


def _both_names(name: str) -> str:
    """The plain name, and the abbreviation where it is another word."""
    plain = plain_name(name)
    return plain if plain == name.lower() else f"{plain} ({name})"


def model_by_name(name: str) -> "type[NamedModel]":
    """The class of the model of that name, see `model_name`.

    Raises:
        ValueError: if no model has that name; the message lists the names.
    """
    found = model_name(name)
    kind: type[NamedModel] = resolve_name(f"{_ALL[found][0].module}:{found}")
    return kind

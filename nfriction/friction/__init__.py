"""Friction models: laws times coefficients, by name. Importing the names needs no torch."""

import difflib
from pkgutil import resolve_name
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from nfriction.friction.laws import Law
    from nfriction.friction.models import NamedModel


class _Kind(NamedTuple):
    prefix: str
    """Before a law's plain name."""
    letters: str
    """Before its abbreviation."""
    module: str
    base: str = ""
    """Class there of which every model of the kind is one."""


# Laws by their plain names, with the abbreviations of the papers.
_LAWS = {
    "viscous": "NCFM",
    "load-coulomb": "LFM",
    "arctan": "NLFM",
    "coulomb": "CFM",
    "coulomb-viscous": "CVFM",
    "stribeck": "Stribeck",
}
# Laws with memory: of bristles, whose Coulomb and Stribeck friction a network may correct, and of
# elements that slip.
_BRISTLES = {"dahl": "Dahl", "lugre": "LuGre", "elasto-plastic": "ElastoPlastic"}
_MEMORY = _BRISTLES | {"gear": "Gear", "maxwell-slip": "MaxwellSlip"}
# Slip elements beside terms of the velocity, for tables of torque.
_HYSTERESIS = {"slip": "Slip", "load-slip": "LoadSlip"}
# Classes are resolved only when asked for: a command line then starts quickly, and the core does
# not import the papers' own models.
_KINDS = (
    _Kind("", "", "nfriction.friction.models", "ConstantModel"),
    _Kind("adaptive:", "A", "nfriction.papers.afem.adaptive", "AdaptiveModel"),
    _Kind("neuro-fuzzy:", "NF", "nfriction.friction.neurofuzzy", "NeuroFuzzyModel"),
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
_KIND_OF_BRISTLES = _Kind("neuro-fuzzy:", "NF", "nfriction.friction.memory")
_KIND_OF_HYSTERESIS = _Kind("", "", "nfriction.friction.hysteresis")
_KIND_OF_RECORDED = _Kind("neuro-fuzzy:", "NF", "nfriction.friction.hysteresis")
_ALL = (
    _MODELS
    | {name: (_KIND_OF_MEMORY, law) for law, name in _MEMORY.items()}
    | {"NF" + name: (_KIND_OF_BRISTLES, law) for law, name in _BRISTLES.items()}
    | {name: (_KIND_OF_HYSTERESIS, law) for law, name in _HYSTERESIS.items()}
    | {"NFSlip": (_KIND_OF_RECORDED, "slip")}
)
_BY_TEXT = {
    text.lower(): name
    for name, (kind, law) in _ALL.items()
    for text in (name, kind.prefix + law, kind.prefix + _LAWS.get(law, law))
}

# Models of laws of one's own, see `add_law`.
_OWN: "dict[str, type[NamedModel]]" = {}


def add_law(law: "Law") -> str:
    """Make a law of one's own known by its name, also with `neuro-fuzzy:` before it.

    Commands, comparisons and model files then know its models as they know those of the library.
    Returns the name of its constant model; raises ValueError if the name is no identifier or taken.
    """
    name, plain = law.name, law.name.lower().replace("_", "-")
    made = {kind.letters + name: kind for kind in _KINDS if kind.prefix != _MISSING[0]}
    taken = [full for full in made if full.lower() in _BY_TEXT and full not in _OWN]
    if taken or not name.isidentifier() or not name.isascii():
        raise ValueError(
            f"law {name!r} needs a name of letters, digits and _ that no other model has"
            + (f"; {taken[0]} is one of the library." if taken else ".")
        )
    _LAWS[plain] = name
    for full, kind in made.items():
        base: type[NamedModel] = resolve_name(f"{kind.module}:{kind.base}")
        _OWN[full] = type(full, (base,), {"definition": law, "__doc__": f"Law {name!r}."})
        _MODELS[full] = _ALL[full] = kind, plain
        _BY_TEXT[kind.letters.lower() + plain] = _BY_TEXT[kind.prefix + plain] = full
    return name


def model_names() -> tuple[str, ...]:
    """Names of the models without memory, as tables and files show them, and of their classes."""
    return tuple(_MODELS)


def memory_names() -> tuple[str, ...]:
    """Names of the models of laws with memory."""
    return tuple(name for name in _ALL if name not in _MODELS)


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
        hint = f" (did you mean {both_names(_BY_TEXT[near[0]])}?)" if near else ""
        raise ValueError(f"no friction model is called {text!r}{hint}; there are {model_list()}.")
    return _BY_TEXT[asked]


def model_list(*, of_tables: bool = False) -> str:
    """Models for recordings, or for tables of torque: laws by both names, and their prefixes."""
    plain, adaptive, network = _KINDS
    laws = ", ".join(both_names(plain.letters + short) for short in _LAWS.values())
    first, bristles = next(iter(_LAWS.values())), ", ".join(_BRISTLES)
    kinds = (network,) if of_tables else (adaptive, network)
    before = " or ".join(f"{kind.prefix} ({kind.letters}{first}, ...)" for kind in kinds)
    besides = "" if of_tables else f", except {''.join(_MISSING)}"
    memory = f"{bristles}, gear, " + ("slip, load-slip" if of_tables else "maxwell-slip")
    also = "slip" if of_tables else bristles
    return (
        f"{laws}; also with {before} before them{besides}; with memory {memory}; neuro-fuzzy: may "
        f"precede {also}, too"
    )


def both_names(name: str) -> str:
    """The plain name and, where it is another word, the abbreviation; a text of no model as it is.

    Examples:
        >>> both_names("CVFM"), both_names("Stribeck"), both_names("no friction")
        ('coulomb-viscous (CVFM)', 'stribeck', 'no friction')
    """
    if name not in _ALL:
        return name
    plain = plain_name(name)
    return plain if plain == name.lower() else f"{plain} ({name})"


def model_by_name(name: str) -> "type[NamedModel]":
    """The class of the model of that name, see `model_name`.

    Raises:
        ValueError: if no model has that name; the message lists the names.
    """
    found = model_name(name)
    if found in _OWN:
        return _OWN[found]
    kind: type[NamedModel] = resolve_name(f"{_ALL[found][0].module}:{found}")
    return kind

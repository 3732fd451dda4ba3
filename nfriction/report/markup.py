"""HTML that is escaped unless it was made here."""

from html import escape


class Markup(str):
    """Text that is HTML already; any other text is escaped where it enters an element."""

    __slots__ = ()


VOID = frozenset({"meta", "img", "br", "source"})


def element(name: str, *content: str, **attributes: str | bool | None) -> Markup:
    """An element with its content; strings are escaped, markup is taken as it is.

    Args:
        name: of the tag.
        content: text or markup.
        attributes: names as in HTML, `_` for `-`, a trailing `_` dropped (`class_`); None and
            False leave an attribute out, True gives it no value.
    """
    said = "".join(_attribute(key, value) for key, value in attributes.items())
    if name in VOID:
        return Markup(f"<{name}{said}>")
    return Markup(f"<{name}{said}>{joined(*content)}</{name}>")


def joined(*content: str) -> Markup:
    """Pieces one after the other, escaped where they are no markup."""
    return Markup("".join(c if isinstance(c, Markup) else escape(c) for c in content))


def _attribute(key: str, value: str | bool | None) -> str:
    if value is None or value is False:
        return ""
    name = key.removesuffix("_").replace("_", "-")
    return f" {name}" if value is True else f' {name}="{escape(str(value))}"'

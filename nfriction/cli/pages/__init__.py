"""Commands that write pages; apart from `cli.report`, which prints tables."""

from nfriction.cli.pages import report

__all__ = ["report"]

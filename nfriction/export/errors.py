"""Errors of artefacts."""


class ExportError(RuntimeError):
    """An artefact could not be made, or does not equal its model."""


def first_line(error: Exception) -> str:
    """First line of an error's message that is not empty."""
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return lines[0][:200] if lines else type(error).__name__


class ContractError(ValueError):
    """Metadata of an artefact are absent, damaged or not ours."""

"""What can go wrong with an artefact."""


class ExportError(RuntimeError):
    """An artefact could not be made, or does not equal its model."""


def first_line(error: Exception) -> str:
    """The first line that says something, of an error that has many."""
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return lines[0][:200] if lines else type(error).__name__


class ContractError(ValueError):
    """Metadata of an artefact are absent, damaged or not ours."""

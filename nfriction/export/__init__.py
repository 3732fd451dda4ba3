"""Artefacts for controllers, each proven equal to the model that was scored."""

from nfriction.export.script import ExportError, torchscript

__all__ = ["ExportError", "torchscript"]

"""Model files: one JSON file with the parameters and what is needed to use them safely."""

from nfriction.modelfile.content import ModelFileError, read_model_file
from nfriction.modelfile.description import ModelInfo, describe, parameter_hash
from nfriction.modelfile.store import info_of, load, plant_of, save

__all__ = [
    "ModelFileError",
    "ModelInfo",
    "describe",
    "info_of",
    "load",
    "parameter_hash",
    "plant_of",
    "read_model_file",
    "save",
]

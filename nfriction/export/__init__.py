"""Artefacts for controllers, each proven equal to the model that was scored."""

from nfriction.export.c_code.export import c
from nfriction.export.contract import (
    Contract,
    ContractError,
    ExportError,
    Parity,
    contract_of,
    verify,
)
from nfriction.export.controller import controller_of
from nfriction.export.onnx_file import onnx
from nfriction.export.pt2_file import pt2
from nfriction.export.simulators import DampingFit, fit_damping_frictionloss, mjcf, urdf
from nfriction.export.torchscript_file import torchscript
from nfriction.export.verification import Verdict, verify_artefact

__all__ = [
    "Contract",
    "ContractError",
    "DampingFit",
    "ExportError",
    "Parity",
    "Verdict",
    "c",
    "contract_of",
    "controller_of",
    "fit_damping_frictionloss",
    "mjcf",
    "onnx",
    "pt2",
    "torchscript",
    "urdf",
    "verify",
    "verify_artefact",
]

"""Artefacts for controllers, each proven equal to the model that was scored."""

from nfriction.export.c_code.export import c
from nfriction.export.contract import Contract, Parity, contract_of, verify
from nfriction.export.controller import controller_of
from nfriction.export.errors import ContractError, ExportError
from nfriction.export.onnx_file import onnx
from nfriction.export.simulators import DampingFit, fit_damping_frictionloss, mjcf, urdf
from nfriction.export.torch_code.pt2 import pt2
from nfriction.export.torch_code.torchscript import torchscript
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

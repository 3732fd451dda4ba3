"""Artefacts for controllers, each proven equal to the model that was scored."""

from nfriction.export.c_export import c
from nfriction.export.contract import Contract, ContractError, Parity, contract_of, verify
from nfriction.export.controller import controller_of
from nfriction.export.errors import ExportError
from nfriction.export.onnx_file import onnx
from nfriction.export.program import pt2
from nfriction.export.script import torchscript
from nfriction.export.simulators import Collapse, collapse, mjcf, urdf
from nfriction.export.verification import Verdict, verify_artefact

__all__ = [
    "Collapse",
    "Contract",
    "ContractError",
    "ExportError",
    "Parity",
    "Verdict",
    "c",
    "collapse",
    "contract_of",
    "controller_of",
    "mjcf",
    "onnx",
    "pt2",
    "torchscript",
    "urdf",
    "verify",
    "verify_artefact",
]

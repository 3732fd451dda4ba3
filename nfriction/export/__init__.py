"""Artefacts for controllers, each checked against the model that was scored."""

from nfriction.export.c_file import c
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
from nfriction.export.simulators import DampingFit, fit_damping_frictionloss, mjcf, urdf
from nfriction.export.torch_files import pt2, torchscript
from nfriction.export.verification import Verdict, verify_artefact

__all__ = [
    "Contract", "ContractError", "DampingFit", "ExportError", "Parity", "Verdict", "c",
    "contract_of", "controller_of", "fit_damping_frictionloss", "mjcf", "onnx", "pt2",
    "torchscript", "urdf", "verify", "verify_artefact",
]  # fmt: skip

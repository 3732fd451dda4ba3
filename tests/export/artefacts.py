"""Models, ranges and schedules for export tests, and a runner for our own artefacts."""

from pathlib import Path

import torch
from torch import Tensor

from nfriction.export import onnx_file, torch_files
from nfriction.export.contract import Runner
from nfriction.export.controller import Controller
from nfriction.friction.coefficients import Constant
from nfriction.friction.laws import LINEAR, Law
from nfriction.friction.models import FrictionModel
from nfriction.io.model_file import ModelInfo
from tests.friction.samples import randomise

INFO = ModelInfo(
    sample_time=1e-3,
    input_ranges={
        "qd": [[-15.0, 15.0], [-10.0, 12.0], [-20.0, 20.0]],
        "qdd": [[-150.0, 150.0]] * 3,
    },
)


class Rising(Constant):
    """Coefficients that grow without bound with speed and acceleration, and have no range."""

    handles_range = False

    def forward(self, qd: Tensor, qdd: Tensor) -> Tensor:
        growth = 1.0 + 0.1 * qd.abs() + 0.01 * qdd.abs()
        return torch.exp(self.raw) * growth.unsqueeze(-1)


def rising(joints: int = 3, law: Law = LINEAR) -> FrictionModel:
    """A model with a user-defined schedule, which must be clamped from outside."""
    model = FrictionModel(law, Rising(law, joints, [1e-3, 2e-3]))
    randomise(model, 0.3)
    return model


def runner_of(path: Path, controller: Controller, dtype: str = "float64") -> Runner:
    """Run one of our own artefacts without comparing its program with a new one."""
    if path.suffix == ".onnx":
        return onnx_file._runner(onnx_file._read(path), controller, dtype, path)
    with torch_files.silent():
        if path.suffix == ".pt":
            return torch_files._script_runner(torch.jit.load(str(path)), controller)
        program = torch.export.load(path).module()
        return lambda *x: torch_files.run_from_nan(program, x, controller.state_size)

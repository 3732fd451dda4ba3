"""Folder of a comparison, made quickly and with hostile names."""

import json
from pathlib import Path
from typing import Any

import torch
from matplotlib.figure import Figure

from nfriction import LFM, NFLFM, ModelInfo, save
from nfriction.io.files import checked_json

EVIL = "<script>document.title='broken'</script>&\"'"
JOINTS = ["a<b>", "second"]


def errors(scale: float | None) -> dict[str, Any]:
    """An error of two joints in the format of `RMSE.to_dict`; None for diverged."""
    return {"joints": [scale, scale], "all": scale}


def score(scale: float | None) -> dict[str, Any]:
    return {
        "free_run": errors(scale),
        "windows": {"1": errors(None if scale is None else scale / 10)},
        "limit": {"free_run": errors(1e-4), "windows": {"1": errors(1e-4)}},
        "diverged_at": 0.5 if scale is None else None,
        "zero": None if scale is None else [0.01, -0.02],
    }


def fit(**changes: Any) -> dict[str, Any]:
    found = {
        "status": "converged: A full step can lower the cost no more.", "converged": True,
        "residual": 1e-3, "residual_unit": "rad", "at_bounds": [], "plant": {"inertia 1": 0.02},
        "names_with_si": {"inertia 1": f"inertia 1 (0.05 -> 0.051 kg m^2) {EVIL}"},
        "intervals": {"B of second": [1e-3, None], "inertia 1": [0.01, 0.03]},
        "unidentifiable": [], "warnings": [], "usability": ["good", ""],
    }  # fmt: skip
    return found | changes


def results() -> dict[str, Any]:
    """Content of a `results.json`: LFM is best, NLFM diverged, all texts are hostile."""
    scales = {"no friction": 2.0, "LFM": 0.1, "NLFM": None, "NFLFM": 0.2}
    recordings = [EVIL, "calm"]
    models: dict[str, Any] = {
        name: {
            "test": {recordings[0]: score(scale)},
            "train": {recordings[1]: score(scale)},
        }
        for name, scale in scales.items()
    }
    models["LFM"] |= {"fit": fit(), "coefficients": {"B": [2e-3, 3e-3], "C": [1e-3, 1e-2]}}
    models["NLFM"] |= {
        "fit": fit(
            status=f"not converged: {EVIL}", converged=False, warnings=[EVIL],
            usability=["doubtful", ""], unidentifiable=["f_a with f_v"], at_bounds=["f_b"],
        )
    }  # fmt: skip
    sets = {label: {"B": [1e-3, 2e-3], "C": [1e-3, 1e-2]} for label in ("at_rest", "reference")}
    models["NFLFM"] |= {"fit": fit(intervals={}), "coefficients": sets}
    return {
        "schema": 4,
        "models": models,
        "best": {
            "model": "LFM",
            "by": "free-run RMSE",
            "indistinguishable": [EVIL, "LFM"],
            "limit": 1e-3,
        },
        "units": "rad",
        "joints": JOINTS,
        "command": f"nfriction compare {EVIL}",
        "recordings": {"train": {"calm": "ab" * 32}, "test": {EVIL: "cd" * 32}},
    }


def neuro_fuzzy() -> NFLFM:
    """A model whose rules differ and whose joints have different ranges."""
    model = NFLFM(2, [2e-3, 1e-2])
    model.schedule.set_range(torch.tensor([10.0, 5.0]), torch.tensor([[-60.0, 20.0], [-30, 30]]))
    start = model.schedule.parameter_vector()
    noise = torch.randn(len(start), generator=torch.Generator().manual_seed(2), dtype=start.dtype)
    model.schedule.set_parameter_vector(start + 0.05 * noise)
    return model


def write(folder: Path, content: dict[str, Any] | None = None) -> Path:
    """Folder of a run with two model files and two figures."""
    folder.mkdir(parents=True, exist_ok=True)
    content = checked_json(results() if content is None else content)
    (folder / "results.json").write_text(json.dumps(content))
    ranges = {"qd": [[-10.0, 10.0], [-5, 5]], "qdd": [[-60.0, 60], [-30, 30]]}
    info = ModelInfo(joint_names=tuple(JOINTS), input_ranges=ranges, sample_time=1e-3)
    save(LFM(2, [2e-3, 1e-2]), folder / "models" / "LFM.json", info)
    save(neuro_fuzzy(), folder / "models" / "NFLFM.json", info)
    (folder / "figures").mkdir(exist_ok=True)
    for name, size in (("rmse_test", (4, 2)), ("positions_train_calm", (8, 2))):
        figure = Figure(figsize=size)
        figure.subplots().plot([0, 1])
        figure.savefig(folder / "figures" / f"{name}.png")
    return folder

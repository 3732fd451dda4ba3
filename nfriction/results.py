"""What a comparison leaves in its folder: tables, results, models, artefacts and figures."""

import json
import logging
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from nfriction.atomic import write_atomically
from nfriction.comparison import Comparison
from nfriction.export import ExportError, torchscript
from nfriction.fitting import Fit
from nfriction.modelfile import ModelInfo, save
from nfriction.recording import Recording

logger = logging.getLogger(__name__)


def digests(recordings: Sequence[Recording]) -> dict[str, str]:
    """Digest of every recording by its name, and by its place too where that is not its own."""
    names = [recording.name for recording in recordings]
    return {
        name if name and names.count(name) == 1 else f"{name or 'recording'} ({place})": r.digest()
        for place, (name, r) in enumerate(zip(names, recordings, strict=True), 1)
    }


def model_info(fit: Fit, recordings: Sequence[Recording]) -> ModelInfo:
    """What a model file should say of a fit to these recordings."""
    qd = np.concatenate([m.qd for m in fit.motions])
    qdd = np.concatenate([m.qdd for m in fit.motions])
    return ModelInfo(
        joint_names=tuple(fit.plant.joint_names),
        unit=fit.plant.unit,
        sample_time=float(recordings[0].sample_time),
        input_ranges={
            "qd": np.stack([qd.min(0), qd.max(0)], -1).tolist(),
            "qdd": np.stack([qdd.min(0), qdd.max(0)], -1).tolist(),
        },
        training_data=digests(recordings),
        rig=fit.plant.to_dict(),
        fit=fit.to_dict(),
    )


def write_results(
    comparison: Comparison,
    train: Sequence[Recording],
    held_out: Sequence[Recording],
    folder: str | Path,
    *,
    command: str = "",
    figures: bool = True,
) -> list[Path]:
    """Write `table.csv`, `results.json`, the models with their TorchScript, and figures.

    Args:
        comparison: fits and scores.
        train, held_out: the recordings behind them.
        folder: made where it is not there; files of an earlier run are replaced.
        command: what would make the same results again.
        figures: draw them.

    Returns:
        What was written.
    """
    folder = Path(folder)
    written = [
        write_atomically(folder / "table.csv", long_table(comparison).to_csv(index=False).encode())
    ]
    results = comparison.to_dict() | {
        "command": command,
        "recordings": {
            "train": digests(train),
            "held_out": digests(held_out),
        },
    }
    text = json.dumps(results, indent=1, allow_nan=False)
    written.append(write_atomically(folder / "results.json", text.encode()))
    for name, fit in comparison.fits.items():
        info = model_info(fit, train)
        written.append(save(fit.model, folder / "models" / f"{name}.json", info))
        script = folder / "models" / f"{name}.pt"
        try:
            written.append(torchscript(fit.model, script, info))
        except ExportError as error:
            script.unlink(missing_ok=True)  # an earlier run's would pass for this one's
            logger.warning("%s was not exported: %s", name, " ".join(str(error).split()))
    if figures:
        from nfriction import plots  # matplotlib takes half a second that other commands save

        (folder / "figures").mkdir(exist_ok=True)
        with tempfile.TemporaryDirectory(dir=folder, prefix=".") as unfinished:
            for drawn in plots.save_all(comparison, [*train, *held_out], unfinished):
                written.append(drawn.replace(folder / "figures" / drawn.name))
    return written


def long_table(comparison: Comparison) -> pd.DataFrame:
    """Every error as one row: model, recording, kind, horizon, joint, rmse."""
    rows: list[dict[str, Any]] = []
    for kind, scores in (("train", comparison.train), ("held out", comparison.held_out)):
        for model, of_model in scores.items():
            for s in of_model:
                for horizon, rmse in (("free run", s.free_run), *s.windows.items()):
                    joints = zip(comparison.joint_names, rmse.joints, strict=True)
                    for joint, value in (*joints, ("all", rmse.all)):
                        rows.append(
                            {
                                "model": model,
                                "recording": s.recording,
                                "kind": kind,
                                "horizon": horizon,
                                "joint": joint,
                                f"rmse [{comparison.unit}]": value,
                            }
                        )
    return pd.DataFrame(rows)

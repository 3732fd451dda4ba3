"""The folder of a reproduction: what is finished in it, written whole or not at all."""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from nfriction.io.atomic import replacing, write_atomically
from nfriction.papers.reproduction.settings import Settings
from nfriction.plant import PendulumChain, rigs
from nfriction.recording import Recording, read_initial_states
from nfriction.signals import Motion

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Bench:
    """A twin as its files tell it.

    Attributes:
        plant: the rig without friction.
        train, test: recordings to fit on and to judge by.
        states: q0 and qd0 at the release by recording, exact.
        motions: smoothed motion by recording, in joint coordinates.
    """

    plant: PendulumChain
    train: list[Recording]
    test: list[Recording]
    states: dict[str, tuple[Array, Array]]
    motions: dict[str, Motion]

    @property
    def train_motions(self) -> list[Motion]:
        """In the order of `train`."""
        return [self.motions[r.name] for r in self.train]


@dataclass(frozen=True)
class Workspace:
    """Where a reproduction keeps its files, and the settings that they were made with.

    A stage is finished where its file bears these very settings; that file is the last that the
    stage writes, so one that was killed has simply not begun.
    """

    folder: Path
    settings: Settings

    def result(self, stage: str) -> dict[str, Any] | None:
        """What a finished stage found; None where it is not finished with these settings."""
        try:
            content = json.loads(self._file(stage, "json").read_text(encoding="utf-8"))
        except (FileNotFoundError, json.JSONDecodeError, UnicodeDecodeError):
            return None
        if not isinstance(content, dict) or content.get("settings") != self.settings.digest():
            return None
        result: dict[str, Any] = content["result"]
        return result

    def found(self, stage: str) -> dict[str, Any]:
        """What a stage found.

        Raises:
            ValueError: if it is not finished.
        """
        result = self.result(stage)
        if result is None:
            raise ValueError(f"{self.folder}: the stage {stage!r} is not finished; run it first.")
        return result

    def finish(self, stage: str, result: Mapping[str, Any]) -> None:
        """Mark a stage as finished with what it found, plain JSON."""
        content = {"stage": stage, "settings": self.settings.digest(), "result": result}
        text = json.dumps(content, indent=1, allow_nan=False)
        write_atomically(self._file(stage, "json"), text.encode())

    def write_arrays(self, stage: str, arrays: Mapping[str, Array]) -> None:
        """Keep arrays beside a stage's result; to be called before `finish`."""
        with replacing(self._file(stage, "npz")) as temporary, temporary.open("wb") as file:
            np.savez_compressed(file, allow_pickle=False, **arrays)

    def arrays(self, stage: str) -> dict[str, Array]:
        """The arrays of a finished stage."""
        with np.load(self._file(stage, "npz")) as kept:
            return {name: kept[name] for name in kept.files}

    def model(self, stage: str) -> Path:
        """Model file of a stage."""
        return self.folder / "models" / f"{stage}.json"

    def bench(self, twin: str) -> Bench:
        """A finished twin."""
        folder = self.folder / "twin" / twin
        plant = rigs.read(folder / "rig.json")
        assert isinstance(plant, PendulumChain)
        convention = ",".join(plant.convention)
        recordings: dict[str, Recording] = {}
        parts: dict[str, list[Recording]] = {"train": [], "test": []}
        for row in pd.read_csv(folder / "recordings.csv", dtype=str).to_dict("records"):
            recording = Recording.read(folder / row["file"], convention=convention)
            recordings[row["id"]] = recording
            parts[row["split"]].append(recording)
        kept = self.arrays(f"twin-{twin}")
        motions = {
            name: Motion(r.time, kept[f"{name}_q"], kept[f"{name}_qd"], kept[f"{name}_qdd"])
            for name, r in recordings.items()
        }
        states = read_initial_states(folder / "recordings.csv")
        return Bench(plant, parts["train"], parts["test"], states, motions)

    def _file(self, stage: str, suffix: str) -> Path:
        return self.folder / "stages" / f"{stage}.{suffix}"

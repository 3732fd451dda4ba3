"""The folder of a run: its settings, its recordings and its finished stages."""

import hashlib
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, astuple, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from tqdm import tqdm

from nfriction.evaluation.results import model_info
from nfriction.fitting.result.fit_result import FitResult, InputGain
from nfriction.fitting.result.identifiability import Interval
from nfriction.fitting.robust_loss import Outliers
from nfriction.io.files import atomic_write, write_atomically
from nfriction.io.model_file import load, load_plant, save
from nfriction.papers.afem.fit_by_search import SearchState
from nfriction.papers.control import study
from nfriction.papers.twin.dataset import Split, read
from nfriction.plant import Plant
from nfriction.recording import Array, Recording
from nfriction.signals import Motion, kalman_smoother
from nfriction.version import __version__

Callback = Callable[..., None]


@dataclass(frozen=True)
class Settings:
    """Everything that the results of a run depend on."""

    seed: int = 0  # for the encoders' errors and the searches
    tlrip_seconds: float = 40.0  # duration of each twin's recordings; 40 and 80 in the papers
    rtip_seconds: float = 80.0
    windows: tuple[float, ...] = (0.5, 2.0)  # lengths of the fits' windows [s]
    max_steps: int = 30  # of the fits, at each window length
    terms: tuple[int, int] = (5, 5)  # of the neuro-fuzzy models, like the units of their head
    head_units: int = 10
    network_units: int = 10  # of the papers' network
    controller_samples: int = 40_000  # per joint, for training the papers' network
    search_horizon: float = 80.0  # length of the windows that a search simulates [s]
    search_evaluations: int = 20_000  # limit on simulations of a search on the position error
    control_models: tuple[str, ...] = study.MODELS  # fitted to the driven rig; compensate friction
    control_seconds: float = 16.0  # duration of each balanced motion [s]
    fit_plant: bool = False  # also adjust inertia and gravity terms
    origin: str = ""  # of the recordings, and further options of a run on data other than twins

    def to_dict(self) -> dict[str, Any]:
        """Plain JSON."""
        # JSON has no tuples, so settings read back would differ.
        return {k: list(v) if isinstance(v, tuple) else v for k, v in asdict(self).items()}

    def digest(self) -> str:
        """Digest that identifies results from these settings and this version."""
        # Another version may compute other numbers, so its results are not reused.
        content = json.dumps(self.to_dict() | {"version": __version__}, sort_keys=True)
        return hashlib.sha256(content.encode()).hexdigest()[:16]


FULL = Settings()
"""As in the papers: recordings of 40 and 80 s, searched in one run."""

QUICK = Settings(
    tlrip_seconds=10.0,
    rtip_seconds=10.0,
    terms=(3, 3),
    head_units=5,
    controller_samples=2000,
    search_horizon=5.0,
    search_evaluations=200,
    control_models=("NCFM", "LFM", "NLFM"),
    control_seconds=4.0,
)
"""A quick run of everything within minutes; numbers differ from those of whole recordings."""


@dataclass(frozen=True, eq=False)
class Bench:
    """A rig without friction and its recordings."""

    plant: Plant
    train: list[Recording]  # for fitting
    test: list[Recording]  # for testing
    motions: list[Motion]  # smoothed motion of each, training first, in joint coordinates
    states: Mapping[str, tuple[Array, Array]]  # exact q0 and qd0 by recording, if known

    @property
    def train_motions(self) -> list[Motion]:
        """Motions of the recordings in `train`."""
        return self.motions[: len(self.train)]

    def parts(self) -> list[tuple[Split, Recording]]:
        """Every recording with its split."""
        return [*(("train", r) for r in self.train), *(("test", r) for r in self.test)]


def smoothed(plant: Plant, recordings: Sequence[Recording]) -> list[Motion]:
    """Smoothed motions in joint coordinates."""
    return [kalman_smoother(r.time, r.joint_coordinates(plant).q) for r in recordings]


@dataclass(frozen=True)
class Workspace:
    """The files of a run and the settings that produced them.

    A stage is finished if its file has these settings; that file is the last one that the stage
    writes, so a stage that was killed counts as not started. `progress` shows a bar for each fit.
    """

    folder: Path
    settings: Settings
    progress: bool = False

    def result(self, stage: str) -> Any:
        """Result of a finished stage; None if it is not finished with these settings."""
        try:
            content = json.loads(self._file(stage, "json").read_text(encoding="utf-8"))
        # A damaged file is created again like a missing one.
        except (FileNotFoundError, json.JSONDecodeError, UnicodeDecodeError):
            return None
        if not isinstance(content, dict) or content.get("settings") != self.settings.digest():
            return None
        return content["result"]

    def begun(self, stage: str) -> bool:
        """True if a stage has a result, possibly from other settings."""
        return self._file(stage, "json").exists()

    def found(self, stage: str) -> dict[str, Any]:
        """Result of a stage; raises `ValueError` if it is not finished."""
        result: dict[str, Any] | None = self.result(stage)
        if result is None:
            raise ValueError(f"{self.folder}: the stage {stage!r} is not finished; run it first.")
        return result

    def finish(self, stage: str, result: Mapping[str, Any], *, strict: bool = True) -> None:
        """Mark a stage as finished with a plain JSON result; only finite numbers if strict."""
        content = {"stage": stage, "settings": self.settings.digest(), "result": result}
        text = json.dumps(content, indent=1, allow_nan=not strict, default=astuple)
        write_atomically(self._file(stage, "json"), text.encode())

    def write_arrays(self, stage: str, arrays: Mapping[str, NDArray[Any]]) -> None:
        """Store arrays in addition to a stage's result; to be called before `finish`."""
        # A result from other settings would otherwise be mistaken for that of these arrays.
        self._file(stage, "json").unlink(missing_ok=True)
        with atomic_write(self._file(stage, "npz")) as temporary, temporary.open("wb") as file:
            np.savez_compressed(file, allow_pickle=False, **arrays)

    def arrays(self, stage: str) -> dict[str, NDArray[Any]]:
        """The arrays of a finished stage."""
        with np.load(self._file(stage, "npz")) as kept:
            return {name: kept[name] for name in kept.files}

    def model(self, stage: str) -> Path:
        """Model file of a stage."""
        return self.folder / "models" / f"{stage}.json"

    def fit(self, stage: str, bench: Bench, make: Callable[[Callback], FitResult]) -> FitResult:
        """The fit of a stage: read if finished, otherwise made by `make(callback)` and stored.

        Its loss after every step is the result of `<stage>-losses`, by part of the fit.
        """
        name, path = f"{stage}-fit", self.model(stage)
        if (kept := self.result(name)) is not None:
            plain = {field: _tuples(value) for field, value in kept.items()}
            for field, kind in _ROWS.items():
                plain[field] = tuple(kind(*row) for row in plain[field])
            return FitResult(
                model=load(path), plant=load_plant(path), motions=tuple(bench.train_motions),
                residuals=torch.as_tensor(self.arrays(name)["residuals"]), **plain,
            )  # fmt: skip
        losses: dict[str, list[float]] = {}
        with tqdm(desc=stage, unit=" steps", disable=not self.progress) as bar:

            def step(about: Any, *at: Any) -> None:
                # Fits report the name of their stage and a step; searches report their state.
                part, loss = (about, at[0].cost) if at else (about.method, about.value)
                # JSON has no infinity.
                if np.isfinite(loss):
                    losses.setdefault(part, []).append(float(loss))
                bar.set_description(f"{stage}, {part}")
                bar.update()

            found = make(step)
        self.finish(f"{stage}-losses", losses)
        # The JSON file comes last: it marks the stage as finished.
        self.write_arrays(name, {"residuals": found.residuals.numpy()})
        save(found.model, path, model_info(found, bench.train))
        plain = {f.name: getattr(found, f.name) for f in fields(found) if f.name not in _APART}
        # Bounds and intervals may be infinite.
        self.finish(name, plain, strict=False)
        return found

    def search_state(self, stage: str) -> SearchState | None:
        """The state of an unfinished search of a stage; None at its start."""
        state = self.result(f"{stage}-search")
        return None if state is None else SearchState(**state)

    def keep_search(self, stage: str, step: Callback) -> Callable[[SearchState], None]:
        """A callback that keeps every state of a pattern search."""

        def keep(state: SearchState) -> None:
            step(state)
            # SQP has no state from which it resumes exactly, and JSON has no infinity.
            if state.method == "pattern" and np.isfinite(state.value):
                self.finish(f"{stage}-search", asdict(state))

        return keep

    def bench(self, twin: str) -> Bench:
        """A finished twin."""
        made, kept = read(twin, self.folder / "twin" / twin), self.arrays(f"twin-{twin}")
        train, test = made.part("train"), made.part("test")
        motions = [
            Motion(r.time, kept[f"{r.name}_q"], kept[f"{r.name}_qd"], kept[f"{r.name}_qdd"])
            for r in (*train, *test)
        ]
        return Bench(made.plant, train, test, motions, made.initial_states)

    def _file(self, stage: str, suffix: str) -> Path:
        return self.folder / "stages" / f"{stage}.{suffix}"


# Fields of a fit that JSON stores as rows, and the class of a row.
_ROWS = {"intervals": Interval, "outliers": Outliers, "inputs": InputGain}
# Fields that are stored separately, with the twin, or not at all; others are plain JSON.
_APART = ("model", "plant", "motions", "uncertainty", "residuals")


def _tuples(value: Any) -> Any:
    return tuple(map(_tuples, value)) if isinstance(value, list) else value

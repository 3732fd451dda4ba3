"""A user's test bench: a rig file, recordings, and command-line runs on them."""

import json
from pathlib import Path

import numpy as np
import torch

from nfriction import LFM, PendulumChain, Recording, cli, rollout

# One second in 0.5 s windows cannot separate air drag from dry friction.
QUICK = ["--windows", "0.5", "--max-steps", "3", "--no-drag"]


def pendulum(**changes: object) -> PendulumChain:
    """A bench whose files measure angles from hanging."""
    return PendulumChain(
        mass=[0.15], com=[0.15], length=[0.3], inertia=[1e-4], name="bench",
        convention=("absolute", "hanging"), position_quantum=1e-4, **changes,
    )  # fmt: skip


def swing(name: str, start: float) -> Recording:
    """A released pendulum with known friction, sampled by an encoder over 1 s and a lead-in."""
    q0 = torch.tensor([start + np.pi], dtype=torch.float64)
    friction = LFM(1, [[2e-4, 1e-3]])
    with torch.no_grad():
        run = rollout(
            pendulum(), friction, q0, torch.zeros_like(q0), sample_time=2e-3, steps=600
        )  # fmt: skip
    q = np.round((run.q.numpy() - np.pi) / 1e-4) * 1e-4
    time = 2e-3 * np.arange(len(q))
    return Recording(time=time, q=q, convention="absolute,hanging", name=name)


def compare(bench: Path, out: Path, *more: str, models: str = "NCFM") -> int:
    """`nfriction compare` of the bench's recordings with quick settings."""
    files = [str(bench / "a.csv.gz"), "--test", str(bench / "b.csv")]
    rig = ["--rig", str(bench / "bench.json"), "--models", models, "--out", str(out)]
    return cli.main(["compare", *files, *rig, *QUICK, *more])


def results(out: Path) -> dict:
    """Content of the `results.json` of a comparison, which must be strict JSON."""

    def refuse(word: str) -> None:
        raise AssertionError(f"{word} is no JSON")

    return json.loads((out / "results.json").read_text(), parse_constant=refuse)

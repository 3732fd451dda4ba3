"""Samples of fuzzy controllers along a measured motion, as used to train the papers' network."""

import hashlib
import json
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
import torch
from numpy.typing import NDArray
from torch import Tensor

from nfriction.io.files import parse_json, write_atomically
from nfriction.io.formats import write_table
from nfriction.papers.controller.mamdani import MamdaniController, paper_controller
from nfriction.papers.twin.dataset import COUNTS, make
from nfriction.signals import Motion, causal_motion

INPUTS = ("speed", "acceleration")
DIGITS = 9
"""Digits of the numbers in the files, as the last bits of a float differ between machines."""
CHECKSUMS = "checksums.json"


@dataclass(frozen=True, eq=False)
class ControllerSamples:
    """Inputs and outputs of a fuzzy controller for every joint."""

    joint_names: tuple[str, ...]  # in the order of the arrays
    output_names: tuple[str, ...]  # names of the coefficients
    time: NDArray[np.float64]  # [s], shape (sample,)
    x: Tensor  # |velocity| [rad/s] and acceleration [rad/s^2], shape (sample, joint, 2)
    y: Tensor  # coefficients in SI, shape (sample, joint, output)

    def __len__(self) -> int:
        return len(self.time)

    def to_pandas(self, joint: int) -> pd.DataFrame:
        """Table of one joint (counted from 0): time, speed, acceleration and the outputs."""
        columns = torch.cat([self.x[:, joint], self.y[:, joint]], -1).numpy()
        table = pd.DataFrame(columns, columns=[*INPUTS, *self.output_names])
        table.insert(0, "time", self.time)
        return table


def sampled(
    controllers: Sequence[MamdaniController],
    motion: Motion,
    *,
    joint_names: Sequence[str],
    every: int = 1,
) -> ControllerSamples:
    """Outputs of a controller for each joint along a motion.

    Args:
        controllers: of |velocity| and acceleration, one per joint.
        motion: velocity and acceleration as available to a controller, (sample, joint).
        every: use one of this many samples.

    Raises:
        ValueError: if there is not one controller per joint, all with the same outputs.
    """
    qd, qdd = torch.as_tensor(motion.qd[::every]), torch.as_tensor(motion.qdd[::every])
    names = {tuple(v.name for v in c.rule_base.outputs) for c in controllers}
    if len(controllers) != qd.shape[1] or len(names) != 1 or len(joint_names) != qd.shape[1]:
        raise ValueError(
            f"a motion of {qd.shape[1]} joints needs as many controllers and joint names, all "
            f"controllers with the same outputs; got {len(controllers)} with {sorted(names)} and "
            f"{len(joint_names)} names."
        )
    x = torch.stack([qd.abs(), qdd], -1)
    y = torch.stack([c(x[:, j, 0], x[:, j, 1]) for j, c in enumerate(controllers)], 1)
    return ControllerSamples(tuple(joint_names), names.pop(), motion.time[::every].copy(), x, y)


def build_samples(
    out: str | os.PathLike[str], *, seed: int = 0, duration: float | None = None
) -> ControllerSamples:
    """Sample the papers' controllers along the measured friction experiment of the TLRIP twin.

    40 s at 1 kHz give 40,000 samples per joint. Velocity and acceleration are computed from the
    encoders by the causal filters of a real-time controller.

    Args:
        out: folder to which `<joint>.csv.gz` for every joint and `checksums.json` are written.
        duration: of the experiment [s]; by default 40.

    Returns:
        The samples as stored in the files, with nine digits.

    References:
        TLRIP paper, Tables 4 and 5, and the training of the 2-10-2 networks.
    """
    twin = make("experiment", seed=seed, duration=duration)
    (recording,) = twin.recordings.values()
    recorded = recording.joint_coordinates(twin.plant)
    motion = causal_motion(recorded.time, recorded.q, COUNTS)
    controllers = [paper_controller(number) for number in (2, 3, 4)]
    made = sampled(controllers, motion, joint_names=twin.plant.joint_names)
    folder = Path(out)
    folder.mkdir(parents=True, exist_ok=True)
    (folder / CHECKSUMS).unlink(missing_ok=True)  # of an earlier build
    for joint, name in enumerate(made.joint_names):
        table = made.to_pandas(joint).map(lambda value: float(f"{value:.{DIGITS}g}"))
        write_table(table, folder / f"{name}.csv.gz")
    # Written last: a folder without it is incomplete.
    found = read_samples(folder, made.joint_names)
    write_atomically(folder / CHECKSUMS, json.dumps(checksums(found), indent=1).encode())
    return found


def read_samples(
    folder: str | os.PathLike[str], joint_names: Sequence[str] = ("joint2", "joint3", "joint4")
) -> ControllerSamples:
    """Samples from the folder to which `build_samples` wrote them.

    Raises:
        ValueError: if they were changed since, or tables of one's own lack columns, differ in time,
            are not in its order, or contain cells that are not finite numbers or negative speeds.
    """
    folder = Path(folder)
    tables = [pd.read_csv(folder / f"{name}.csv.gz") for name in joint_names]
    outputs = tuple(name for name in map(str, tables[0]) if name not in ("time", *INPUTS))
    found: list[NDArray[np.float64]] = []
    for name, table in zip(joint_names, tables, strict=True):
        where, wanted = f"{folder / name}.csv.gz", ["time", *INPUTS, *outputs]
        if {*table} != {*wanted} or not outputs:
            columns = ", ".join(map(str, table))
            raise ValueError(f"{where} needs the columns {', '.join(wanted)}, got {columns}.")
        # Columns of true and false would count as 1 and 0.
        numbers = table.select_dtypes(exclude="bool").apply(pd.to_numeric, errors="coerce")
        cells = numbers.reindex(columns=wanted).to_numpy(dtype=np.float64)
        wrong = [f"{table[wanted[column]][row]} for {wanted[column]} in row {row + 1}"
                 for row, column in np.argwhere(~np.isfinite(cells))[:1]]  # fmt: skip
        if wrong or not len(cells):
            raise ValueError(
                f"{where} needs rows of finite numbers only, got {', '.join(wrong) or 'no row'}; "
                "correct or drop such rows."
            )
        if found and not np.array_equal(cells[:, 0], found[0][:, 0]):
            raise ValueError(f"{where} needs the times of {joint_names[0]}.")
        if len(late := np.flatnonzero(np.diff(cells[:, 0]) < 0)):
            before, after = cells[late[0] : late[0] + 2, 0]
            raise ValueError(
                f"{where} needs rows in order of time, got {after:g} after {before:g} s "
                f"in row {late[0] + 2}; sort them."
            )
        if cells[:, 1].min() < 0:
            raise ValueError(
                f"{where} needs speed = |velocity|, at least 0, got {cells[:, 1].min():g}; "
                "take the absolute value."
            )
        found.append(cells)
    whole = np.stack(found, 1)
    x, y = torch.tensor(whole[..., 1:3]), torch.tensor(whole[..., 3:])
    samples = ControllerSamples(tuple(joint_names), outputs, whole[:, 0, 0].copy(), x, y)
    path = folder / CHECKSUMS
    if path.exists() and parse_json(path.read_bytes()) != checksums(samples):
        raise ValueError(f"{folder}: files differ from {CHECKSUMS}; build them again.")
    return samples


def checksums(samples: ControllerSamples) -> dict[str, str]:
    """SHA-256 of the numbers of each joint, rounded as in the files."""
    found = {}
    for joint, name in enumerate(samples.joint_names):
        rows = samples.to_pandas(joint).to_numpy()
        text = "\n".join(" ".join(f"{value:.{DIGITS}g}" for value in row) for row in rows)
        found[name] = hashlib.sha256(text.encode()).hexdigest()
    return found

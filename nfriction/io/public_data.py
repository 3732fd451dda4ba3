"""Public recordings of real mechanisms: fetch the originals, convert them to tables in SI units.

The commit in a web address fixes the content of an original. The SHA-256 of a converted table is
that of the table from which the documentation's results were computed.
"""

import gzip
import hashlib
import http.client
import json
import urllib.parse
import urllib.request
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from importlib import resources
from pathlib import Path

import numpy as np
import pandas as pd
from scipy.io import loadmat
from scipy.io.matlab import MatReadError
from scipy.signal import savgol_filter

from nfriction.io.files import write_atomically

# Errors of the readers for a wrong or incomplete original.
_NOT_IT = (
    *(AttributeError, EOFError, LookupError, OSError, RuntimeError, TypeError, ValueError),
    *(MatReadError, zlib.error),
)


@dataclass(frozen=True)
class PublicSet:
    """A set of recordings in a public repository."""

    about: str  # mechanism, sensors, authors
    licence: str  # of the originals
    repository: str  # owner and name on GitHub
    commit: str  # fixes the content
    folder: str  # of the originals in the repository
    source: str  # kind of originals, one of `_CONVERT`
    digits: Mapping[str, str]  # printf format of columns, by the first letters of their names
    recordings: Mapping[str, tuple[str, str]]  # original and SHA-256 of the table, by recording

    def address(self, original: str) -> str:
        """Web address of an original."""
        path = f"{self.repository}/{self.commit}/{self.folder}/{original}"
        return f"https://raw.githubusercontent.com/{urllib.parse.quote(path)}"


@dataclass(frozen=True)
class Fetched:
    """A set's tables, and the recordings whose tables differ from those of the documentation."""

    tables: tuple[Path, ...]
    differing: tuple[str, ...]


def public_sets() -> dict[str, PublicSet]:
    """All sets by name."""
    text = resources.files(__package__).joinpath("public_sets.json").read_text()
    return {name: PublicSet(**fields) for name, fields in json.loads(text).items()}


def fetch(name: str, folder: Path) -> Fetched:
    """Fetch the originals of a set that are not in its folder yet, convert and write them.

    Args:
        name: of one of `public_sets()`.
        folder: of the set; gets `originals`, a table of each recording, and `recordings.csv`, with
            initial states if the set has them.
    """
    sets = public_sets()
    if name not in sets:
        raise ValueError(f"no public set {name!r}; there are {', '.join(sets)}.")
    chosen = sets[name]
    tables, rows, differing = [], [], []
    for recording, (original, digest) in chosen.recordings.items():
        path, address = folder / "originals" / original, chosen.address(original)
        if not path.exists():
            try:
                with urllib.request.urlopen(address, timeout=60) as answer:
                    content = answer.read()
            except (OSError, http.client.HTTPException) as error:
                raise OSError(
                    f"cannot fetch {address} ({error}); fetch it where there is a network, save it "
                    f"as '{path}' and repeat the command."
                ) from error
            write_atomically(path, content)
        try:
            table, state = _CONVERT[chosen.source](path, recording)
        except _NOT_IT as error:
            raise ValueError(
                f"'{path}' is not what {address} contains ({type(error).__name__}: {error}); "
                "delete it and fetch it again."
            ) from error
        columns = {}
        for column, values in table.items():
            # By the longest matching prefix of the column's name.
            known = (key for key in chosen.digits if str(column).startswith(key))
            form = chosen.digits[max(known, key=len)]
            columns[column] = [form % value for value in values]
        text = pd.DataFrame(columns).to_csv(index=False, lineterminator="\n").encode()
        if hashlib.sha256(text).hexdigest() != digest:
            differing.append(recording)
        tables.append(folder / f"{recording}.csv.gz")
        write_atomically(tables[-1], gzip.compress(text, mtime=0))
        rows.append({"id": recording, "file": tables[-1].name, "source": address, **state})
    states = pd.DataFrame(rows).to_csv(index=False, lineterminator="\n")
    write_atomically(folder / "recordings.csv", states.encode())
    return Fetched(tuple(tables), tuple(differing))


def _multiarm(path: Path, recording: str) -> tuple[pd.DataFrame, dict[str, float]]:
    """A block of a free swing; its initial state comes from a Savitzky-Golay filter.

    The authors cut a recording into consecutive pieces of angles and velocities (2 joint, time),
    first those for fitting, then those for validation.
    """
    cells = loadmat(path)
    pieces = [piece for key in ("Y_id", "Y_vad") for piece in cells[key].ravel()]
    q, qd = np.split(np.concatenate(pieces, axis=1), 2)
    q = q - np.pi  # from hanging
    length = {1: 9160, 2: 9990, 3: 9980}[len(q)]
    first = 20 + int(recording[-1]) * length
    block = slice(first, first + length)
    columns, state = {"time": 1e-3 * np.arange(length)}, {}
    for key, values in (("q", q), ("qd", qd)):
        columns |= {f"{key}{joint}": row[block] for joint, row in enumerate(values, 1)}
    for joint, row in enumerate(q, 1):
        for key, order in (("q0", 0), ("qd0", 1)):
            smooth = savgol_filter(row, 31, 3, deriv=order, delta=1e-3)
            state[f"{key}_{joint}"] = round(float(smooth[first]), 7 - order)
    return pd.DataFrame(columns), state


def _dfki(path: Path, _: str) -> tuple[pd.DataFrame, dict[str, float]]:
    """A driven run from rest: measurements of the drives, and the commanded torques."""
    table = pd.read_csv(path)
    names = {"time": "time"}
    for ours, theirs in (
        ("q", "pos_meas"), ("qd", "vel_meas"), ("tau", "tau_meas"), ("tau_cmd", "tau_con"),
    ):  # fmt: skip
        names |= {f"{theirs}{joint}": f"{ours}{joint}" for joint in (1, 2)}
    table = table[list(names)].rename(columns=names)
    start = {f"q0_{joint}": float(table[f"q{joint}"].iloc[0]) for joint in (1, 2)}
    return table, start | {"qd0_1": 0.0, "qd0_2": 0.0}


def _emps(path: Path, _: str) -> tuple[pd.DataFrame, dict[str, float]]:
    """The first half of the axis's run; force is voltage times the drive's gain."""
    values = loadmat(path)
    q, reference, u = (np.ravel(values[key])[10:12420] for key in ("qm", "qg", "vir"))
    columns = {"time": 1e-3 * np.arange(12410), "q1": q, "q_ref1": reference}
    return pd.DataFrame(columns | {"tau1": float(values["gtau"].item()) * u, "u1": u}), {}


def _xl330(path: Path, recording: str) -> tuple[pd.DataFrame, dict[str, float]]:
    """A log of the servo, or the part of it after the torque was released."""
    log = pd.DataFrame(json.loads(path.read_text())["entries"])
    if recording.startswith("drop"):
        log = log[~log["torque_enable"].astype(bool)]
    time = log["timestamp"] - log["timestamp"].iloc[0]
    table = pd.DataFrame({"time": time, "q1": log["position"]})
    if recording.startswith("drop"):
        return table.assign(tau1=0), {}
    # The register is a signed 16-bit number in units of 1/885 of the full voltage.
    duty = log["load"].to_numpy(np.uint16).view(np.int16) / 885
    return table.assign(
        qd1_reg=log["speed"], duty1=duty, volt=log["input_volts"], q_goal1=log["goal_position"],
        torque_on=log["torque_enable"],
    ), {}  # fmt: skip


def _tribometer(path: Path, _: str) -> tuple[pd.DataFrame, dict[str, float]]:
    """The first half of the strokes; friction gets the sign of the velocity."""
    table = pd.read_csv(path, sep="\t").iloc[:21289]
    return pd.DataFrame({
        "time": table["Time [s]"],
        "position": (1e-3 * table["Position [mm]"]).round(7),
        "normal_force": (1e-6 * table["Normal [uN]"]).round(7),
        "friction": (-1e-6 * table["Friction [uN]"]).round(7),
    }), {}  # fmt: skip


_CONVERT = {
    "multiarm": _multiarm, "dfki": _dfki, "emps": _emps, "xl330": _xl330, "tribometer": _tribometer,
}  # fmt: skip

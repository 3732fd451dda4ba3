"""Golden numbers: what the library computes, held against what it computed before.

    python benchmarks/golden.py                          # quick cases, under a minute
    python benchmarks/golden.py --slow --data DATA       # all of them, some ten minutes
    python benchmarks/golden.py --only fits triple       # some, slow or not
    python benchmarks/golden.py --list
    python benchmarks/golden.py --write --only CASE ...  # records; say in the commit why

Run from the repository's root. `golden.json` beside this file holds the recorded numbers, the
folder `golden/` model files and results of version 0.1, which must stay readable. A number has
moved when it differs by more than half a unit of its last printed digit; the exit status is then
1. DATA (or the environment variable NFRICTION_DATA) holds a folder to each set of recordings, for
the cases marked "data".

The library's public names that may change are used in the first section alone, where possible.
"""

import argparse
import hashlib
import json
import math
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd
import torch
from torch import Tensor

# --- Public names of the library and its command line -------------------------------------------
from nfriction import (
    ALFM,
    LFM,
    NFLFM,
    FrictionModel,
    Plant,
    Recording,
    Stribeck,
    export,
    fit,
    load,
    rigs,
    rollout,
)
from nfriction.papers import twin as twins

PROGRAM = (sys.executable, "-m", "nfriction")
TEST_RECORDINGS, INITIAL_STATES = "--test", "--initial-states"
TEST_PART, FREE_RUN = "test", "free run"  # as `table.csv` says
EQUATION_ERROR = {"method": "equation_error"}


def coverage_command(data: Path) -> list[str]:
    """Arguments of the benchmark that prints set, model, pieces, values, percent and |z|."""
    return ["benchmarks/identification.py", "intervals", str(data),
            "--only", *INTERVAL_SETS, "--models", "CFM"]  # fmt: skip


# ------------------------------------------------------------------------------------------------

HERE = Path(__file__).resolve().parent
RECORDED, FIXTURES = HERE / "golden.json", HERE / "golden"
INTERVAL_SETS = ("triple", "double", "C1", "C0", "single")
QUANTUM = math.tau / 8192

Value = float | str | list[float]


class Row(NamedTuple):
    """A number of a case: as many digits of it count, or it has only to stay below a limit."""

    name: str
    value: Value
    digits: int = 3
    at_most: float | None = None


class Case(NamedTuple):
    """A function that gives rows, and where it gets its recordings."""

    run: Callable[[Path], Iterator[Row]]
    what: str
    slow: bool = False
    data: bool = False


# --- Quick cases --------------------------------------------------------------------------------


def torques(_: Path) -> Iterator[Row]:
    """Friction torque of stored model files of every schedule at fixed motions."""
    t = torch.linspace(0.0, 5.0, 5, dtype=torch.float64)[:, None]
    joint = torch.arange(1.0, 4.0, dtype=torch.float64)
    qd = 9.0 * torch.sin(t * joint + joint)
    qdd, load = 90.0 * torch.cos(t + 2 * joint), 1.0 + torch.cos(3 * t + joint).abs()
    for name, model in stored_models():
        with torch.no_grad():
            yield Row(name, flat(model(qd, qdd, load)), 12)


def rollouts(_: Path) -> Iterator[Row]:
    """End states of the papers' rig after 2 s: three links, and a few further mechanisms."""
    tlrip = rigs.tlrip(arm="fixed")
    yield Row("no friction", end_state(tlrip, None, steps=500), 11)
    for name, model in stored_models():
        yield Row(name, end_state(tlrip, model), 11)
    given = dict(stored_models())
    yield Row("LFM, dry friction stops", end_state(tlrip, given["LFM"], scheme="time_stepping"), 11)
    yield Row("LFM, eager torch", end_state(tlrip, given["LFM"], steps=200, backend="torch"), 11)
    torque = 0.2 * torch.sin(torch.arange(6000.0, dtype=torch.float64)).reshape(2000, 3)
    yield Row("LFM, driven", end_state(tlrip, given["LFM"], tau=torque), 11)
    yield Row("LFM, rtip", end_state(rigs.rtip(), LFM(joints=rigs.rtip().joints)), 11)
    for name in ("LFM", "NFLFM"):
        q0, qd0 = (x.requires_grad_() for x in release(3))
        out = rollout(tlrip, given[name], q0, qd0, steps=300, gradients=True)
        (out.q[-1] + 0.1 * out.qd[-1]).sum().backward()
        yield Row(f"{name}, gradient", flat(torch.stack([q0.grad, qd0.grad])), 8)


def fits(_: Path) -> Iterator[Row]:
    """Fits of simulated recordings: constant, equation error, by class, neuro-fuzzy."""
    plant = rigs.tlrip(arm="fixed")
    recording = simulated(plant, LFM(3, [[0.010, 0.05], [0.006, 0.03], [0.004, 0.02]]))
    yield from fitted("LFM", LFM(3), plant, recording, windows=(0.5, 1.0))
    yield from fitted("LFM, plant given", LFM(3), plant, recording, windows=(0.5,),
                      fit_plant=False)  # fmt: skip
    yield from fitted("LFM, equation error", LFM(3), plant, recording, **EQUATION_ERROR)
    plant = rigs.multiarm_single()
    recording = simulated(plant, Stribeck(1, [3e-3, 8e-3, 8e-4, 0.5, 2.0]))
    for name, model in (("ALFM", ALFM(1)), ("NFLFM", NFLFM(1, terms=(3, 2), head_units=3))):
        yield from fitted(f"{name}, one link", model, plant, recording, windows=(0.5,))


def demo(_: Path) -> Iterator[Row]:
    """The command line on a short simulated rig: fit, score, write [mrad]."""
    yield from compared("demo", "--seconds", "2", "--models", "NCFM,ALFM")


def report(_: Path) -> Iterator[Row]:
    """A stored comparison (results.json and its models) still makes a report."""
    with tempfile.TemporaryDirectory() as folder:
        run = Path(folder) / "run"
        shutil.copytree(FIXTURES / "run", run)
        told = command(*PROGRAM, "report", str(run))
        page = (run / "report.html").read_text(encoding="utf-8")
    for number in ("38.31", "43.72", "41.81"):  # errors of NCFM and ALFM [mrad]
        yield Row(f"page shows {number}", "yes" if number in page else "no")
    yield Row("without a warning", "no" if "warning" in told.stderr else "yes")


def parity(_: Path) -> Iterator[Row]:
    """Exports against their model: largest error of the torque over its full scale."""
    for name in ("LFM", "ALFM", "NFLFM"):
        model = load(FIXTURES / "models" / f"{name}.json")
        with tempfile.TemporaryDirectory() as folder:
            made = {"TorchScript": (export.torchscript(model, Path(folder) / "model.pt"), 1e-12)}
            for dtype, limit in (("float64", 1e-12), ("float32", 5e-7)):
                files = export.c(model, Path(folder) / dtype, dtype=dtype)
                made[f"C {dtype}"] = next(f for f in files if f.name == "nfriction.c"), limit
            for kind, (path, limit) in made.items():
                verdict = export.verify_artefact(path, model)
                found = max(verdict.vectors.torque_error, verdict.points.torque_error)
                yield Row(f"{name}, {kind}", found, at_most=limit)
                yield Row(f"{name}, {kind} passes", "yes" if verdict.passed else "no")


def twin_digests(_: Path) -> Iterator[Row]:
    """Digests of the first half second of the simulated papers' rigs."""
    return digests(duration=0.5)


# --- Slow cases ---------------------------------------------------------------------------------


def full_twin_digests(_: Path) -> Iterator[Row]:
    """Digests of the whole simulated data sets."""
    return digests(duration=None)


TRIPLE = "NCFM,CFM,CVFM,LFM,NLFM,Stribeck,NFCFM,NFCVFM,NFLFM,NFStribeck"


def triple(data: Path) -> Iterator[Row]:
    """README's table: triple pendulum, b0 -> b2 [mrad]."""
    return multiarm(data, "triple", ["b0"], ["b2"], TRIPLE)


def triple_without_drag(data: Path) -> Iterator[Row]:
    """The last row of README's table [mrad]."""
    return multiarm(data, "triple", ["b0"], ["b2"], "LFM", "--no-drag")


def double(data: Path) -> Iterator[Row]:
    """README's double pendulum, b0, b4 -> b2, b6 [mrad]."""
    return multiarm(data, "double", ["b0", "b4"], ["b2", "b6"], "LFM,NLFM,NFLFM")


def driven(data: Path) -> Iterator[Row]:
    """README's driven double pendulum C1 [mrad]."""
    folder = data / "dfki_double_pendulum"
    *train, test = (str(folder / f"C1_{t}.csv.gz") for t in (143339, 143601, 143747, 144003))
    states = str(folder / "recordings.csv")
    for row in compared("compare", *train, TEST_RECORDINGS, test, "--rig", "dfki-C1",
                        "--models", "CFM,CVFM", INITIAL_STATES, states):  # fmt: skip
        # Dry friction makes this search a rough one: rounding in another back end moves the errors
        # of CVFM by 0.2 mrad.
        yield row if row.name.startswith("no friction") else row._replace(digits=2)


def tour(_: Path) -> Iterator[Row]:
    """The comparison of docs/tour.md [mrad]."""
    return compared("demo", "--seconds", "5", "--models", "NCFM,LFM,NFCVFM", digits=4)


def intervals(data: Path) -> Iterator[Row]:
    """Share of pieces of real recordings that agree within their 95 % intervals [%]."""
    told = command(sys.executable, *coverage_command(data)).stdout
    rows = {line.split()[0]: line.split() for line in told.splitlines()[1:]}
    for name in INTERVAL_SETS:
        yield Row(name, float(rows[name][4]), 2)
        yield Row(f"{name}, median |z|", float(rows[name][5]), 2)


CASES = {
    "torques": Case(torques, "torques of stored model files"),
    "rollouts": Case(rollouts, "end states and gradients of rollouts"),
    "fits": Case(fits, "fits of simulated recordings"),
    "demo": Case(demo, "`demo` on 2 s, free run and windows [mrad]"),
    "report": Case(report, "a stored results.json makes a report"),
    "parity": Case(parity, "exports against their model"),
    "twins": Case(twin_digests, "digests of half a second of the twins"),
    "twins-full": Case(full_twin_digests, "digests of the whole twins", slow=True),
    "tour": Case(tour, "docs/tour.md [mrad]", slow=True),
    "triple": Case(triple, "README's table [mrad]", slow=True, data=True),
    "triple-no-drag": Case(triple_without_drag, "its last row [mrad]", slow=True, data=True),
    "double": Case(double, "double pendulum [mrad]", slow=True, data=True),
    "driven": Case(driven, "driven double pendulum C1 [mrad]", slow=True, data=True),
    "intervals": Case(intervals, "coverage of 95 % intervals [%]", slow=True, data=True),
}


# --- Parts of cases -----------------------------------------------------------------------------


def stored_models() -> Iterator[tuple[str, FrictionModel]]:
    for path in sorted((FIXTURES / "models").glob("*.json")):
        yield path.stem, load(path)


def release(joints: int) -> tuple[Tensor, Tensor]:
    """Displaced from hanging, at rest."""
    q0 = torch.tensor([math.pi + 0.8, 0.4, -0.3], dtype=torch.float64)[:joints]
    return q0, torch.zeros_like(q0)


def end_state(
    plant: Plant, model: FrictionModel | None, steps: int = 2000, **settings
) -> list[float]:
    q0, qd0 = release(plant.joints)
    out = rollout(plant, model, q0, qd0, steps=steps, gradients=False, **settings)
    return flat(torch.stack([out.q[-1], out.qd[-1]]))


def simulated(plant: Plant, model: FrictionModel, steps: int = 3000) -> Recording:
    """A free swing as encoders of 8192 counts would read it at 1 kHz."""
    out = rollout(plant, model, *release(plant.joints), steps=steps, gradients=False)
    counts = (out.q / QUANTUM).round()
    return Recording(out.time.numpy(), (QUANTUM * counts).numpy(), convention="relative,upright")


def fitted(
    name: str, model: FrictionModel, plant: Plant, recording: Recording, **settings
) -> Iterator[Row]:
    found = fit(model, plant, recording, **settings)
    t = torch.linspace(0.0, 1.0, 5, dtype=torch.float64)[:, None].expand(-1, plant.joints)
    with torch.no_grad():
        yield Row(f"{name}: coefficients", flat(found.model.coefficients(4 * t, 60 * t)), 4)
    yield Row(f"{name}: residual", found.residual, 4)
    yield Row(f"{name}: converged", "yes" if found.converged else "no")
    if found.intervals:  # of many sizes, so their logarithms
        known = [i.sd for i in found.intervals if math.isfinite(i.sd) and i.sd > 0]
        yield Row(f"{name}: log of intervals", np.log(known).tolist(), 4)


def compared(*arguments: str, digits: int = 3) -> Iterator[Row]:
    """Errors on test recordings over all joints: free run and windows, from `table.csv` [mrad]."""
    with tempfile.TemporaryDirectory() as folder:
        command(*PROGRAM, *arguments, "--no-figures", "--out", folder)
        table = pd.read_csv(Path(folder) / "table.csv")
    table = table[(table.part == TEST_PART) & (table.joint == "all")]
    for (model, horizon), part in table.groupby(["model", "horizon"], sort=False):
        over_recordings = 1e3 * math.sqrt(np.mean(np.square(part.iloc[:, -1])))
        label = FREE_RUN if horizon == FREE_RUN else f"{float(horizon):g} s"
        yield Row(f"{model}, {label}", over_recordings, digits)


def multiarm(
    data: Path, arm: str, train: Sequence[str], test: Sequence[str], models: str, *options: str
) -> Iterator[Row]:
    folder = data / "multiarm_pendulum"
    train, test = ([str(folder / f"{arm}_{b}.csv.gz") for b in blocks] for blocks in (train, test))
    return compared("compare", *train, TEST_RECORDINGS, *test, "--rig", f"multiarm-{arm}",
                    "--models", models, INITIAL_STATES, str(folder / "recordings.csv"),
                    *options)  # fmt: skip


def digests(duration: float | None) -> Iterator[Row]:
    for name in ("tlrip", "rtip"):
        made = twins.make(name, duration=duration)
        for label, recording in made.recordings.items():
            truth = made.truth[label]
            digest = hashlib.sha256()
            for array in (recording.time, recording.q, truth.q, truth.qd, truth.tau_f):
                digest.update(np.ascontiguousarray(array, dtype="<f8").tobytes())
            yield Row(f"{name}, {label}", digest.hexdigest()[:16])


def command(*arguments: str) -> subprocess.CompletedProcess:
    """Run a program on one thread, with this checkout's package."""
    environment = os.environ | {
        "OMP_NUM_THREADS": "1",
        "PYTHONPATH": os.pathsep.join([str(HERE.parent), os.environ.get("PYTHONPATH", "")]),
    }
    done = subprocess.run(arguments, capture_output=True, text=True, env=environment,
                          cwd=HERE.parent, check=False)  # fmt: skip
    if done.returncode:
        raise SystemExit(f"{' '.join(arguments)} ended with {done.returncode}:\n{done.stderr}")
    return done


def flat(values: Tensor) -> list[float]:
    return values.detach().reshape(-1).tolist()


# --- Comparison ---------------------------------------------------------------------------------


def unit(golden: float | list[float], digits: int) -> float:
    """One of the last printed digit of a number, or of the largest of several."""
    largest = float(np.max(np.abs(golden)))
    return 10.0 ** (math.floor(math.log10(largest)) - digits + 1) if largest else 1e-12


def judged(row: Row, golden: Value | None) -> tuple[str, str, str, str]:
    """Columns of a row: golden, now, difference, and `ok`, `moved` or `new`."""
    if row.at_most is not None:
        good = row.value <= row.at_most
        return f"<= {row.at_most:.0e}", f"{row.value:.0e}", "", "ok" if good else "moved"
    if golden is None:
        return "", shown(row.value, row.digits), "", "new"
    columns = shown(golden, row.digits), shown(row.value, row.digits)
    if isinstance(golden, str) or np.shape(golden) != np.shape(row.value):
        return *columns, "", "ok" if golden == row.value else "moved"
    difference = float(np.max(np.abs(np.subtract(row.value, golden))))
    good = difference <= 0.5 * unit(golden, row.digits)  # false of NaN
    return *columns, f"{difference:.0e}", "ok" if good else "moved"


def shown(value: Value, digits: int) -> str:
    if isinstance(value, list):
        return f"{len(value)} values"
    return value if isinstance(value, str) else f"{value:#.{digits}g}".rstrip(".")


def read() -> dict[str, dict[str, Value]]:
    return json.loads(RECORDED.read_text(encoding="utf-8")) if RECORDED.exists() else {}


def write(recorded: dict[str, dict[str, Value]]) -> None:
    """One line a row, so that a change shows what moved."""
    cases = [
        f" {json.dumps(case)}: {{\n"
        + ",\n".join(f"  {json.dumps(k)}: {json.dumps(v)}" for k, v in recorded[case].items())
        + "\n }"
        for case in CASES
        if case in recorded
    ]
    RECORDED.write_text("{\n" + ",\n".join(cases) + "\n}\n", encoding="utf-8")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--only", nargs="+", choices=list(CASES), metavar="CASE")
    parser.add_argument("--slow", action="store_true", help="the slow cases as well")
    parser.add_argument("--data", type=Path, default=os.environ.get("NFRICTION_DATA"))
    parser.add_argument("--write", action="store_true", help="record what is found")
    parser.add_argument("--list", action="store_true", help="name the cases")
    arguments = parser.parse_args()
    if arguments.list:
        for name, case in CASES.items():
            marks = ", ".join(m for m in ("slow", "data") if getattr(case, m))
            print(f"{name:15} {case.what}{marks and f' ({marks})'}")
        return 0
    torch.set_num_threads(1)
    chosen = arguments.only or [n for n, c in CASES.items() if arguments.slow or not c.slow]
    if any(CASES[name].data for name in chosen) and not arguments.data:
        parser.error("these cases need recordings: --data or NFRICTION_DATA names their folder")
    moved = 0
    for name in chosen:
        start = time.perf_counter()
        rows = list(CASES[name].run(Path(arguments.data or ".")))
        before = read().get(name, {})
        print(f"\n{name}: {CASES[name].what}, {time.perf_counter() - start:.0f} s")
        print(f"  {'':34} {'golden':>18} {'now':>18} {'difference':>11}")
        for row in rows:
            golden, now, difference, said = judged(row, before.get(row.name))
            moved += said != "ok"
            print(f"  {row.name:34} {golden:>18} {now:>18} {difference:>11}  {said}", flush=True)
        for gone in before.keys() - {row.name for row in rows}:
            moved += 1
            print(f"  {gone:34} is no longer there: moved")
        if arguments.write:
            kept = {r.name: r.value if r.at_most is None else r.at_most for r in rows}
            write(read() | {name: kept})  # another run may have recorded meanwhile
    print(f"\n{'recorded' if arguments.write else f'{moved} moved'}")
    return int(moved > 0 and not arguments.write)


if __name__ == "__main__":
    sys.exit(main())

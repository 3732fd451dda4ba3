"""`nfriction info`, `report` and `data`: model files, folders of comparisons, public recordings."""

import argparse
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from nfriction.cli import inputs
from nfriction.cli.console import Commands, UsageError, warn
from nfriction.friction import memory_names, model_names, plain_name

if TYPE_CHECKING:
    from nfriction.friction.models import FrictionModel
    from nfriction.io.model_file import ModelInfo


def add_report(commands: Commands) -> None:
    """Register `report`."""
    parser = commands.add(
        "report", run_report, "write an HTML page of a comparison's folder",
        description="Write the folder of compare or demo as one self-contained HTML file: sortable "
        "tables, figures that zoom, fuzzy rules, verdicts.",
        example="nfriction report runs/mine --out mine.html",
    )  # fmt: skip
    parser.add_argument("folder", type=Path, metavar="RUN", help="folder of compare or demo")
    parser.add_argument("--out", type=Path, metavar="FILE",
                        help="file to write (default: report.html in the folder)")  # fmt: skip
    inputs.add_law_option(parser)


def run_report(arguments: argparse.Namespace) -> int:
    """Read, write."""
    from nfriction.report import write_report

    if not arguments.folder.is_dir():
        raise UsageError(f"{arguments.folder} is no folder; give one that compare or demo wrote.")
    out = arguments.out or arguments.folder / "report.html"
    if out.is_dir():
        raise UsageError(f"--out must be a file, but {out} is a folder.")
    for note in write_report(arguments.folder, out).notes:
        warn(note)
    print(f"wrote {out}")
    return 0


def add_info(commands: Commands) -> None:
    """Register `info`."""
    parser = commands.add(
        "info", run_info, "describe a model file",
        description="Describe a model file: model, joints, coefficients, trained ranges, status of "
        "the fit, rig.",
        example="nfriction info runs/mine/models/LFM.json",
    )  # fmt: skip
    parser.add_argument("model", type=inputs.file, metavar="MODEL", help="model file")
    inputs.add_law_option(parser)


def run_info(arguments: argparse.Namespace) -> int:
    """Load and print."""
    from nfriction.cli.tables import coefficient_table
    from nfriction.io.model_file import load, load_info

    model, info = load(arguments.model), load_info(arguments.model)
    for what, said in _facts(model, info):
        print(f"{what + ':':14} {said}")
    print(coefficient_table(model, info.joint_names, info.unit))
    return 0


def _facts(model: "FrictionModel", info: "ModelInfo") -> Iterator[tuple[str, str]]:
    from nfriction.friction.hysteresis import Recorded

    name = type(model).__name__
    known = name in (*model_names(), *memory_names())
    yield "model", f"{name}, {plain_name(name) if known else f'law {model.law.name}'}"
    joints = info.joint_names or [f"joint{k + 1}" for k in range(model.joints)]
    yield "joints", ", ".join(info.joint_names) or str(model.joints)
    if isinstance(model.schedule, Recorded):
        for k, joint in enumerate(joints):
            yield f"{joint} follows", model.schedule.described(k, info.unit) or "nothing recorded"
    if info.rig is not None:
        yield "rig", str(info.rig.get("name") or "unnamed")
    if info.sample_time is not None:
        yield "sample time", f"{info.sample_time:.4g} s"
    yield "sign turns", f"over {model.v_smooth:g} {info.unit}/s"
    for key, unit in (("qd", f"{info.unit}/s"), ("qdd", f"{info.unit}/s^2")):
        if key in info.input_ranges:
            ranges = (f"{low:.3g} to {high:.3g}" for low, high in info.input_ranges[key])
            yield f"trained {key}", f"{', '.join(ranges)} {unit}"
    if info.training_data:
        yield "trained on", ", ".join(info.training_data)
    if "status" in info.fit:
        said = str(info.fit["status"]).rstrip(".")
        residual, bounds = info.fit.get("residual"), info.fit.get("at_bounds")
        if isinstance(residual, float):
            said += f", {1e3 * residual:.3g} m{info.unit} over the training windows"
        if isinstance(bounds, list) and bounds:
            said += f"; at a bound: {', '.join(map(str, bounds))}"
        yield "fit", said
    if info.rating:
        yield "rating", info.rating


def add_data(commands: Commands) -> None:
    """Register `data`."""
    parser = commands.add(
        "data", run_data, "list or fetch public recordings",
        description="List public recordings of real mechanisms, or fetch their originals from "
        "GitHub and convert them to tables in SI units. Originals that are already in the folder "
        "are not fetched again.",
        example="nfriction data get multiarm-triple",
    )  # fmt: skip
    parser.add_argument("action", choices=("list", "get"), help="list the sets, or get some")
    parser.add_argument("names", nargs="*", metavar="NAME", help="sets to get")
    parser.add_argument("--out", type=Path, default=Path("data"), help="folder to write")


def run_data(arguments: argparse.Namespace) -> int:
    """List or fetch; the status is 1 if a table differs from that of the documentation."""
    from nfriction.io.public_data import fetch, public_sets

    sets = public_sets()
    if arguments.action == "list":
        width = max(map(len, sets))
        for name, chosen in sets.items():
            print(f"{name:<{width}}  {chosen.about}")
            print(f"{'':<{width}}  {chosen.repository}, licence: {chosen.licence}")
        return 0
    if not arguments.names:
        raise UsageError(f"name sets to get: {', '.join(sets)}.")
    status = 0
    for name in arguments.names:
        folder = arguments.out / name
        fetched = fetch(name, folder)
        if fetched.differing:
            status = 1
            warn(f"{', '.join(fetched.differing)}: differs from the table that the documentation "
                 "used (by SHA-256); results may also differ")  # fmt: skip
        print(f"{name}: {len(fetched.tables)} recordings and recordings.csv are in {folder} "
              f"({sets[name].repository}, licence: {sets[name].licence})")  # fmt: skip
    return status

"""`nfriction export` and `nfriction verify`: artefacts for controllers and simulators."""

import argparse
import warnings
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

from nfriction.cli import inputs
from nfriction.cli.console import Commands, UsageError, check_writable

if TYPE_CHECKING:
    from nfriction.friction.models import FrictionModel
    from nfriction.io.model_file import ModelInfo

# File suffix of each target; C is a folder of files.
CONTROLLERS = {"torchscript": ".pt", "c": ".c", "pt2": ".pt2", "onnx": ".onnx"}
SIMULATORS = {"mjcf": ".xml", "urdf": ".urdf"}
TARGETS = (*CONTROLLERS, *SIMULATORS)
# Targets that can compute in single precision; the others always use double.
IN_SINGLE = ("c", "onnx")


def add_export(commands: Commands) -> None:
    """Register `export`."""
    parser = commands.add(
        "export", run_export, "write artefacts for controllers and simulators",
        description="Write a fitted model as artefacts for controllers, each verified against the "
        "model, or as the closest joint parameters of a simulator.",
        example="nfriction export model.json --format torchscript,c --out artefacts",
    )  # fmt: skip
    parser.add_argument("model", type=inputs.file, metavar="MODEL", help="model file")
    parser.add_argument("--format", type=_targets, default="torchscript", metavar="FORMATS",
                        help=f"comma-separated: {', '.join(TARGETS)}")  # fmt: skip
    parser.add_argument("--out", type=Path, default=Path(), help="folder to write to")
    parser.add_argument("--name", type=_identifier, metavar="NAME",
                        help="name of the files, and prefix of all C functions (default: that of "
                        "the model file, in C its first 24 letters)")  # fmt: skip
    parser.add_argument("--dtype", choices=("float64", "float32"), default="float64",
                        help=f"precision of {' and '.join(IN_SINGLE)}; onnx has its filter only in "
                        "float64")  # fmt: skip
    parser.add_argument("--torque-limit", type=inputs.positives, metavar="LIMIT,...",
                        help="limit of the output torque, one number or one per joint")  # fmt: skip
    parser.add_argument("--sample-time", type=inputs.positive, metavar="SECONDS",
                        help="time between the controller's samples [s], on which filters and "
                        "states depend (default: that of the recordings)")  # fmt: skip
    parser.add_argument("--with-filter", action="store_true",
                        help="let the artefact take raw positions and filter them")  # fmt: skip
    parser.add_argument("--cutoff", type=inputs.positive, metavar="HZ",
                        help="cut-off of that filter [Hz] (default: 20)")  # fmt: skip
    parser.add_argument("--online", type=inputs.positive, metavar="NOISE",
                        help="C of a model with the papers' network that keeps learning while it "
                        "runs, from friction torque measured with this noise [N m]")  # fmt: skip
    group = parser.add_argument_group("mjcf and urdf")
    group.add_argument("--recording", type=inputs.file, action="append", default=[],
                       help="motion along which the closest parameters are fitted; can be "
                       "repeated")  # fmt: skip
    group.add_argument("--rig", type=inputs.rig,
                       help="rig file or name (default: the one in the model file)")  # fmt: skip
    group.add_argument("--patch", type=inputs.file, metavar="ROBOT",
                       help="robot description to copy with these parameters")  # fmt: skip
    inputs.add_reading_options(group)
    inputs.add_law_option(parser)


def add_verify(commands: Commands) -> None:
    """Register `verify`."""
    parser = commands.add(
        "verify", run_verify, "check that an artefact matches its model",
        description="Compare an artefact (.pt, .pt2, .onnx, or .c with its .contract.json in the "
        "same folder) with the model on its test vectors and at many random points. Exit status 1 "
        "if they differ. C is compiled and run as it is: verify only files that you trust.",
        example="nfriction verify artefacts/model.pt model.json",
    )  # fmt: skip
    parser.add_argument("artefact", type=Path, metavar="ARTEFACT", help="file that export wrote")
    parser.add_argument("model", type=inputs.file, metavar="MODEL", help="model file")
    parser.add_argument("--points", type=inputs.count, default=5000, metavar="N",
                        help="random points, up to 10 %% beyond the trained range")  # fmt: skip
    inputs.add_law_option(parser)


def run_export(arguments: argparse.Namespace) -> int:
    """Load, then write each artefact."""
    from nfriction.io.model_file import load, load_info

    wanted = [target for target in arguments.format if target in SIMULATORS]
    if wanted and not arguments.recording:
        raise UsageError(f"{wanted[0]} needs a motion: give --recording FILE.")
    if arguments.patch and len(wanted) != 1:
        raise UsageError("--patch needs exactly one of mjcf and urdf in --format.")
    if arguments.cutoff and not arguments.with_filter:
        raise UsageError("--cutoff is that of the filter: add --with-filter.")
    if arguments.online and "c" not in arguments.format:
        raise UsageError("--online needs c in --format.")
    model, info = load(arguments.model), load_info(arguments.model)
    info = replace(info, sample_time=arguments.sample_time or info.sample_time)
    limits, cutoff = len(arguments.torque_limit or [0]), arguments.cutoff or 20.0
    if limits not in (1, model.joints):
        raise UsageError(f"--torque-limit needs one number or one per joint, got {limits}.")
    step = info.sample_time or 0.0
    if arguments.with_filter and cutoff * step >= 0.5:
        raise UsageError(
            f"--cutoff must be below half the sampling frequency, {0.5 / step:g} Hz, got "
            f"{cutoff:g}: lower it, or give the controller's --sample-time."
        )
    if info.rating and not info.rating.startswith("good"):
        warnings.warn(f"{arguments.model.name} has the rating {info.rating!r}.", stacklevel=1)
    check_writable(arguments.out)
    # In a folder aside: what was there before stays unless all targets succeed.
    out = arguments.out
    with TemporaryDirectory(dir=out) as folder:
        arguments.out = Path(folder)
        for target in arguments.format:
            write = _write_simulator if target in SIMULATORS else _write_controller
            write(target, model, info, arguments)
        for path in sorted(arguments.out.iterdir()):
            print(f"wrote {path.replace(out / path.name)}")
    return 0


def _write_controller(
    target: str, model: "FrictionModel", info: "ModelInfo", arguments: argparse.Namespace
) -> None:
    """Write an artefact."""
    from nfriction import export
    from nfriction.export.c_dialect import is_identifier

    limit = arguments.torque_limit
    options: dict[str, Any] = {
        # A single number applies to all joints.
        "torque_limit": limit[0] if limit and len(limit) == 1 else limit,
        "with_filter": arguments.with_filter,
        "cutoff_hz": arguments.cutoff or 20.0,
    }
    if target in IN_SINGLE:
        options["dtype"] = arguments.dtype
    stem = arguments.name or arguments.model.stem
    if target != "c":
        file = f"{stem}{CONTROLLERS[target]}"
        getattr(export, target)(model, arguments.out / file, info, **options)
        return
    name = "".join(x if x.isascii() and x.isalnum() else "_" for x in stem)[:24]
    name = arguments.name or (name if is_identifier(name) else f"nf_{name[:21]}")
    source = export.c(model, arguments.out, info, name=name, **options)[0]
    # The other targets are compared when they are written.
    try:
        verdict = export.verify_artefact(source, model, info, points=1000)
    except export.ExportError as error:
        # There may be no compiler, or CC may be one for another machine.
        print(f"{source.name} was not run here; run its self-test on the target ({error})")
    else:
        if not verdict.passed:
            raise export.ExportError(
                f"{source.name} differs from its model and was not written: {verdict.points}."
            )
    if arguments.online:
        from nfriction.papers.nffem.online import OnlineOptions, write_online

        learning = OnlineOptions(arguments.online, sample_time=info.sample_time or 1e-3)
        write_online(model, arguments.out, learning, name=f"{name}_online")


def _write_simulator(
    target: str, model: "FrictionModel", info: "ModelInfo", arguments: argparse.Namespace
) -> None:
    """Write joint parameters, and print their errors."""
    from nfriction import export
    from nfriction.plant import rigs
    from nfriction.signals import kalman_smoother

    if arguments.rig:
        plant = inputs.read_rig(arguments.rig)
    elif info.rig is not None:
        plant = rigs.from_dict(info.rig)
    else:
        raise UsageError("the model file has no rig; give --rig, because friction needs its loads.")
    model.check_loads(plant)
    recordings = inputs.read_recordings(arguments.recording, plant, arguments)
    motions = [kalman_smoother(r.time, r.joint_coordinates(plant).q) for r in recordings]
    path = arguments.out / f"{arguments.model.stem}{SIMULATORS[target]}"
    write = getattr(export, target)
    print(write(model, path, motions, info, load=plant.load, patch=arguments.patch))


def run_verify(arguments: argparse.Namespace) -> int:
    """Compare, print a table and return the verdict as exit status."""
    from nfriction.export import verify_artefact
    from nfriction.io.model_file import load, load_info

    if not arguments.points:
        raise UsageError("--points must be at least 1.")
    model, info = load(arguments.model), load_info(arguments.model)
    verdict = verify_artefact(arguments.artefact, model, info, points=arguments.points)
    head = ("compared at", "points", "torque error", "tolerance", "coefficients", "edges")
    print("{:<14}{:>8}{:>14}{:>11}{:>14}{:>7}  verdict".format(*head))
    for name, parity in (("its vectors", verdict.vectors), ("drawn points", verdict.points)):
        print(
            f"{name:<14}{parity.points:>8}{parity.torque_error:>14.1e}{parity.tolerance:>11.0e}"
            f"{parity.coefficient_error:>14.1e}{parity.edges:>7}  "
            f"{'equal' if parity.passed else 'DIFFERENT'}"
        )
    for difference in verdict.differences:
        print(difference)
    where, verb = arguments.artefact.name, "is" if verdict.passed else "IS NOT"
    print(f"{where} {verb} {arguments.model.name} (errors relative to full scale)")
    return 0 if verdict.passed else 1


def _targets(text: str) -> list[str]:
    """Comma-separated names of targets, for argparse."""
    targets = [name.strip() for name in text.split(",") if name.strip()]
    for target in targets:
        if target not in TARGETS:
            raise argparse.ArgumentTypeError(
                f"cannot export to {target!r}; there are {', '.join(TARGETS)}"
            )
    if not targets:
        raise argparse.ArgumentTypeError(f"needs some of {', '.join(TARGETS)}, got none")
    return targets


def _identifier(text: str) -> str:
    """A valid C identifier, for argparse."""
    from nfriction.export.c_dialect import is_identifier

    if not is_identifier(text):
        raise argparse.ArgumentTypeError(
            "must be at most 31 letters, digits and _, begin with a letter and be no C keyword, "
            f"got {text!r}"
        )
    return text

"""`nfriction export` and `nfriction verify`: artefacts for controllers and simulators."""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from nfriction.cli import inputs
from nfriction.cli.console import Commands, UsageError, check_writable

if TYPE_CHECKING:
    from nfriction.friction.models import FrictionModel
    from nfriction.io.model_file import ModelInfo

# Ending of the file that each target is written to; C is a folder of files.
CONTROLLERS = {"torchscript": ".pt", "c": ".c", "pt2": ".pt2", "onnx": ".onnx"}
SIMULATORS = {"mjcf": ".xml", "urdf": ".urdf"}
TARGETS = (*CONTROLLERS, *SIMULATORS)
# What computes in single precision where asked to; the others are in double at any rate.
IN_SINGLE = ("c", "onnx")


def add_export(commands: Commands) -> None:
    """Register `export`."""
    parser = commands.add(
        "export", run_export, "write artefacts for controllers and simulators",
        description="Write a fitted model as artefacts for controllers, proven equal to it, or as "
        "the nearest joint parameters of a simulator.",
        example="nfriction export model.json --format torchscript,c --out artefacts",
    )  # fmt: skip
    parser.add_argument("model", type=inputs.file, metavar="MODEL", help="model file")
    parser.add_argument("--format", type=_targets, default="torchscript", metavar="FORMATS",
                        help=f"with commas between them: {', '.join(TARGETS)}")  # fmt: skip
    parser.add_argument("--out", type=Path, default=Path(), help="folder to write to")
    parser.add_argument("--name", type=_identifier, metavar="NAME",
                        help="of the files, and in C prefix of all functions (default: that of "
                        "the model file)")  # fmt: skip
    parser.add_argument("--dtype", choices=("float64", "float32"), default="float64",
                        help=f"precision of {' and '.join(IN_SINGLE)}")  # fmt: skip
    parser.add_argument("--torque-limit", type=inputs.positives, metavar="LIMIT,...",
                        help="largest torque given out, one number or one a joint")  # fmt: skip
    parser.add_argument("--with-filter", action="store_true",
                        help="take raw positions, with the causal filter inside")  # fmt: skip
    parser.add_argument("--cutoff", type=inputs.positive, default=20.0, metavar="HZ",
                        help="cut-off of that filter [Hz]")  # fmt: skip
    parser.add_argument("--online", type=inputs.positive, metavar="NOISE",
                        help="C of a model with the papers' network that also learns while it "
                        "runs, from a friction torque measured to this [N m]")  # fmt: skip
    group = parser.add_argument_group("mjcf and urdf")
    group.add_argument("--recording", type=inputs.file, action="append", default=[],
                       help="motion along which the nearest parameters are sought; can be given "
                       "several times")  # fmt: skip
    group.add_argument("--rig", type=inputs.rig,
                       help="rig file or name (default: the one in the model file)")  # fmt: skip
    group.add_argument("--patch", type=inputs.file, metavar="ROBOT",
                       help="robot description whose joints of these names get them")  # fmt: skip
    inputs.add_reading_options(group)
    inputs.add_law_option(parser)


def add_verify(commands: Commands) -> None:
    """Register `verify`."""
    parser = commands.add(
        "verify", run_verify, "prove that an artefact is its model",
        description="Run an artefact (.pt, .pt2, .onnx, or .c with its .contract.json beside it) "
        "over its test vectors and over many points beside the model. Exit status 1 if they "
        "differ. C is compiled and run as it is: verify only files that you trust.",
        example="nfriction verify artefacts/model.pt model.json",
    )  # fmt: skip
    parser.add_argument("artefact", type=Path, metavar="ARTEFACT", help="what export wrote")
    parser.add_argument("model", type=inputs.file, metavar="MODEL", help="model file")
    parser.add_argument("--points", type=inputs.count, default=5000, metavar="N",
                        help="points to draw, to 10 %% beyond the range")  # fmt: skip
    inputs.add_law_option(parser)


def run_export(arguments: argparse.Namespace) -> int:
    """Load, then write each artefact."""
    from nfriction.io.model_file import load, load_info

    wanted = [target for target in arguments.format if target in SIMULATORS]
    if wanted and not arguments.recording:
        raise UsageError(f"{wanted[0]} needs a motion: give --recording FILE.")
    if arguments.patch and len(wanted) != 1:
        raise UsageError("--patch takes one of mjcf and urdf in --format.")
    if arguments.online and "c" not in arguments.format:
        raise UsageError("--online needs c in --format.")
    model, info = load(arguments.model), load_info(arguments.model)
    check_writable(arguments.out)
    for target in arguments.format:
        if target in SIMULATORS:
            _write_simulator(target, model, info, arguments)
        else:
            for path in _write_controller(target, model, info, arguments):
                print(f"wrote {path}")
    return 0


def _write_controller(
    target: str, model: "FrictionModel", info: "ModelInfo", arguments: argparse.Namespace
) -> list[Path]:
    """Write an artefact; returns its files."""
    from nfriction import export
    from nfriction.export.c_dialect import is_identifier

    limit = arguments.torque_limit
    options: dict[str, Any] = {
        # One number is for all joints.
        "torque_limit": limit[0] if limit and len(limit) == 1 else limit,
        "with_filter": arguments.with_filter,
        "cutoff_hz": arguments.cutoff,
    }
    if target in IN_SINGLE:
        options["dtype"] = arguments.dtype
    stem = arguments.name or arguments.model.stem
    if target == "c":
        name = "".join(x if x.isascii() and x.isalnum() else "_" for x in stem)[:24]
        name = name if is_identifier(name) else f"nf_{name}"
        paths = export.c(model, arguments.out, info, name=name, **options)
        _prove(paths[0], model, info)
        if arguments.online:
            from nfriction.papers.nffem.online import OnlineOptions, write_online

            learning = OnlineOptions(arguments.online, sample_time=info.sample_time or 1e-3)
            paths += write_online(model, arguments.out, learning, name=f"{name}_online")
        return paths
    writer = getattr(export, target)
    return [writer(model, arguments.out / f"{stem}{CONTROLLERS[target]}", info, **options)]


def _prove(source: Path, model: "FrictionModel", info: "ModelInfo") -> None:
    """Run exported C on this machine and compare it with the model; where that cannot be, say so.

    The other targets are compared as they are written.
    """
    from nfriction import export

    try:
        verdict = export.verify_artefact(source, model, info, points=1000)
    except export.ExportError as error:
        # There may be no compiler, or CC may be one for another machine.
        print(f"{source} was not run here; run its self-test on the target ({error})")
    else:
        if not verdict.passed:
            raise export.ExportError(f"{source} differs from its model: {verdict.points}.")


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
        raise UsageError("the model file has no rig; give --rig, whose loads friction needs.")
    model.check_loads(plant)
    recordings = inputs.read_recordings(arguments.recording, plant, arguments)
    moved = (recording.joint_coordinates(plant) for recording in recordings)
    motions = [kalman_smoother(recording.time, recording.q) for recording in moved]
    path = arguments.out / f"{arguments.model.stem}{SIMULATORS[target]}"
    writer = getattr(export, target)
    print(writer(model, path, motions, info, load=plant.load, patch=arguments.patch))
    print(f"wrote {path}")


def run_verify(arguments: argparse.Namespace) -> int:
    """Compare, print a table, tell the verdict by the exit status."""
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
    where = Path(arguments.artefact).name
    verb = "is" if verdict.passed else "IS NOT"
    print(f"{where} {verb} {Path(arguments.model).name} (errors relative to full scale)")
    return 0 if verdict.passed else 1


def _targets(text: str) -> list[str]:
    """Names of targets with commas between them, for argparse."""
    targets = [name.strip() for name in text.split(",") if name.strip()]
    for target in targets:
        if target not in TARGETS:
            raise argparse.ArgumentTypeError(
                f"cannot export to {target!r}; there are {', '.join(TARGETS)}"
            )
    if not targets:
        raise argparse.ArgumentTypeError(f"takes some of {', '.join(TARGETS)}, got none")
    return targets


def _identifier(text: str) -> str:
    """A name that C takes, for argparse."""
    from nfriction.export.c_dialect import is_identifier

    if not is_identifier(text):
        raise argparse.ArgumentTypeError(
            f"must be letters, digits and _ with a letter first and no word of C, got {text!r}"
        )
    return text

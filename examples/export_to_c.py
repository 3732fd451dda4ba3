"""Write a friction model as C code for a controller, compile it, and run its self-test."""

import argparse
import shutil
import subprocess
from collections.abc import Sequence
from pathlib import Path

from nfriction import NFLFM, ModelInfo, export


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="single precision only")
    parser.add_argument("--out", type=Path, default=Path("runs/export_to_c"))
    arguments = parser.parse_args(argv)

    # In practice `nfriction.load("model.json")`; an untrained model equals its constant law.
    model = NFLFM(3, [2e-3, 5e-3])
    info = ModelInfo(
        joint_names=("joint2", "joint3", "joint4"), sample_time=1e-3,
        input_ranges={"qd": [[-20.0, 20.0]] * 3, "qdd": [[-200.0, 200.0]] * 3},
    )  # fmt: skip
    compiler = shutil.which("cc")
    for dtype in ("float32",) if arguments.quick else ("float32", "float64"):
        folder = arguments.out / dtype
        written = export.c(model, folder, info, dtype=dtype, torque_limit=1.0)
        print(f"{dtype}:", *(path.name for path in written))
        if compiler is None:
            print("no C compiler here; the self-test was not run")
            continue
        program = folder.resolve() / "selftest"
        sources = ["nfriction.c", "nfriction_selftest.c"]
        subprocess.run(
            [compiler, "-O2", *sources, "-o", str(program), "-lm"], cwd=folder, check=True
        )
        passed = subprocess.run([str(program)], check=False).returncode == 0
        print("self-test:", "passed" if passed else "FAILED")
        if not passed:
            return 1
    return 0


if __name__ == "__main__":
    raise SystemExit(main())

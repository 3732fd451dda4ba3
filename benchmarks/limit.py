"""The hand-written C of `limit.c`, compiled with the flags that emitted code gets."""

import ctypes
import subprocess
from collections.abc import Callable
from pathlib import Path

import numpy as np
from cases import DT, STEPS, Numbers

from nfriction.export.c_file import find_compiler


def hand_written(
    numbers: Numbers, folder: str, *flags: str
) -> Callable[[np.ndarray, np.ndarray], np.ndarray]:
    """A function (q0, qd0) -> final state; like ours it records the whole motion."""
    compiler = find_compiler()
    if compiler is None:
        raise SystemExit("no C compiler found")
    library = Path(folder) / f"limit{abs(hash(flags))}.so"
    source = Path(__file__).with_name("limit.c")
    options = [
        "-O3",
        "-fno-math-errno",
        "-fno-trapping-math",
        "-ffp-contract=fast",
        "-march=native",
        "-shared",
        "-fPIC",
        *flags,
    ]
    subprocess.run([*compiler, *options, "-o", str(library), str(source), "-lm"], check=True)
    function = ctypes.CDLL(str(library)).limit_rollout
    body = np.concatenate(
        [x.ravel() for x in (numbers.coupling, numbers.gravity, numbers.lever)]
        + [[1.0 / numbers.v_smooth]]
    )
    constant = np.ascontiguousarray(numbers.constant)
    networks = None if numbers.network is None else _packed(numbers.network)

    def run(q0: np.ndarray, qd0: np.ndarray) -> np.ndarray:
        out = [np.empty((STEPS + 1, 3)) for _ in range(3)]
        given = (body, constant, networks, q0, qd0, *out)
        pointers = [ctypes.c_void_p(None if a is None else a.ctypes.data) for a in given]
        function(ctypes.c_long(STEPS), ctypes.c_double(DT), *pointers)
        return np.concatenate([out[0][-1], out[1][-1]])

    return run


def _packed(n: dict[str, np.ndarray]) -> np.ndarray:
    """The networks of all joints in the order of `struct network`."""
    joints = []
    for j in range(3):
        plane = n["plane"][j].transpose(1, 0, 2)  # (rule, output, column)
        fields = [
            *(1.0 / n["velocity_range"][j], 1.0 / n["turn"], n["lower"][j], 1.0 / n["span"][j]),
            *(n["centre"][j], 1.0 / n["width"][j], plane, n["unit_centre"][j]),
            *(n["unit_precision"][j], n["unit_out"][j].T, n["bias"][j], n["reference"][j]),
            *(0.5 * n["scale"][j], 4.0 * n["roundness"] ** 2, 1.0 / n["reach"]),
        ]
        joints += [np.asarray(field).ravel() for field in fields]
    return np.concatenate(joints)

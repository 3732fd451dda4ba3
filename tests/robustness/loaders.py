"""All loaders of foreign files: valid samples, ways to damage them, required properties.

`load` reads a file and checks the result: finite, of consistent shape, and equal after a round
trip through our own writer. A loader may raise only its documented errors.
"""

from __future__ import annotations

import contextlib
import gzip
import hashlib
import io
import json
import struct
import tempfile
import zipfile
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, partial
from importlib.util import find_spec
from pathlib import Path
from random import Random
from typing import Any

import numpy as np
import torch

from nfriction import LFM, NFLFM, NLFM, ModelInfo, save
from nfriction.export import onnx, pt2, torchscript
from nfriction.export.contract import (
    Contract,
    ContractError,
    ExportError,
    contract_of,
    verify,
)
from nfriction.export.controller import controller_of
from nfriction.export.onnx_file import contract_of_onnx, onnx_runner
from nfriction.export.torch_files import contract_of_archive, own_program
from nfriction.io.files import checked_json
from nfriction.io.formats import measurements
from nfriction.io.model_file import ModelFileError, load, load_info, load_plant, parameter_hash
from nfriction.papers.controller.fis import load_fis
from nfriction.papers.controller.mamdani import MamdaniController
from nfriction.papers.controller.rules import load_rules
from nfriction.plant import rigs
from nfriction.recording import Recording, read_initial_states
from nfriction.recording.angles import AngleConvention
from nfriction.report.page import to_html
from nfriction.report.run import read_run
from tests.report.runs import results
from tests.report.runs import write as write_run
from tests.robustness.mutations import (
    Mutation,
    damage_bytes,
    damage_json,
    damage_npy,
    damage_text,
    damage_zip,
    repacked,
)

Refusals = tuple[type[Exception], ...]


@dataclass(frozen=True)
class Loader:
    """A loader under test.

    Attributes:
        suffix: suffix of its files.
        samples: writer of valid files into a folder.
        load: reader that checks its result.
        damage: way in which samples are changed.
        refusals: documented errors.
        names_file: whether every error names the file.
        needs: package that it requires.
        apart: whether the library runs it in a separate process; its end or hang is a refusal.
    """

    name: str
    suffix: str
    samples: Callable[[Path], list[bytes]]
    load: Callable[[Path], None]
    damage: Mutation
    refusals: Refusals = (ValueError, OSError)
    names_file: bool = True
    needs: str | None = None
    apart: bool = False

    @property
    def available(self) -> bool:
        return self.needs is None or find_spec(self.needs) is not None


# Recordings.

_TIME = np.arange(40) / 1000
_Q = np.random.default_rng(0).normal(size=(40, 2)) / 7


def _recording() -> Recording:
    written = AngleConvention("absolute", "hanging")
    return Recording(_TIME, _Q, tau=_Q / 3, qd=_Q / 7, convention=written, name="run")


def _written(suffix: str) -> Callable[[Path], list[bytes]]:
    def samples(folder: Path) -> list[bytes]:
        path = folder / f"sample{suffix}"
        _recording().write(path)
        return [path.read_bytes()]

    return samples


_CSV = (
    b"# convention: absolute,hanging\n# unit: rad\n"
    + "\n".join(["time,q1,q2", *(f"{k / 100},{k / 7},{k / 9}" for k in range(12))]).encode()
)
_GERMAN = "\n".join(
    ["Zeit [ms];q1;q2", "ms;°;°", *(f"{10 * k};{k / 7:.4f};{k / 9:.4f}".replace(".", ",")
                                    for k in range(12))]
).encode()  # fmt: skip
_BLANKS = "\n".join(["time q1", *(f"{k / 100} {k / 7}" for k in range(12))]).encode()
_COLUMNS = {"time": "Zeit [ms]:ms"}


def _texts(_: Path) -> list[bytes]:
    return [_CSV, _GERMAN.replace(b"Zeit [ms]", b"time [ms]"), _BLANKS]


def _read_recording(path: Path) -> None:
    _check_recording(Recording.read(path))


def _read_other_names(path: Path) -> None:
    _check_recording(Recording.read(path, columns={"time": "t:ms", "q1": "log.enc[0]:deg"}))


def _check_recording(found: Recording) -> None:
    assert np.isfinite(found.q).all()
    assert (np.diff(found.time) > 0).all()
    again = Recording.from_pandas(found.to_pandas(), name=found.name)
    assert again.digest() == found.digest()
    assert again.convention == found.convention


def _damage_gz(rng: Random, content: bytes) -> bytes:
    if rng.random() < 0.3:
        return damage_bytes(rng, content)
    parts = [gzip.compress(damage_text(rng, gzip.decompress(content)), 1)]
    if rng.random() < 0.1:
        parts *= 2
    return b"".join(parts)


def _matlab_samples(_: Path) -> list[bytes]:
    from scipy.io import savemat

    files = []
    entries = np.zeros(2, dtype=[("Name", "O"), ("Data", "O")])
    for k in range(2):
        entries[k] = (f"q{k + 1}", _Q[:, k])
    dspace = {"X": {"Data": _TIME}, "Y": entries, "Description": "x"}
    contents: list[tuple[dict[str, Any], bool]] = [
        ({"time": _TIME, "q": _Q, "note": "text"}, False), ({"rec": dspace}, False),
        ({"time": _TIME, "q1": _Q[:, 0]}, True), ({"rec": dspace}, True),
    ]  # fmt: skip
    for content, packed in contents:
        buffer = io.BytesIO()
        savemat(buffer, content, do_compression=packed)  # type: ignore[arg-type]
        files.append(buffer.getvalue())
    return files


def _damage_matlab(rng: Random, content: bytes) -> bytes:
    """The content of packed variables, packed again; else the bytes behind the header."""
    kind, size = struct.unpack_from("<II", content, 128)
    if kind != 15 or rng.random() < 0.2:
        return content[:128] + damage_bytes(rng, content[128:])
    plain = zlib.decompress(content[136 : 136 + size])
    packed = repacked(damage_bytes(rng, plain))
    return content[:128] + struct.pack("<II", 15, len(packed)) + packed


def _hdf5_samples(folder: Path) -> list[bytes]:
    import h5py

    files = []
    for packed in (None, "gzip"):
        path = folder / "sample.h5"
        with h5py.File(path, "w") as file:
            for name, values in (("time", _TIME), ("q", _Q), ("tau1", _Q[:, 0])):
                file.create_dataset(name, data=values, compression=packed)
        files.append(path.read_bytes())
    return [*files, _matlab_7_3(folder / "sample.mat")]


def _matlab_7_3(path: Path) -> bytes:
    import h5py

    with h5py.File(path, "w", userblock_size=512) as file:
        file.create_dataset("data/X/Data", data=_TIME[:, None])
        refs: dict[str, list[Any]] = {"Name": [], "Data": []}
        for k in range(2):
            text = np.array([[ord(c)] for c in f"q{k + 1}"], "u2")
            name = file.create_dataset(f"#refs#/n{k}", data=text)
            name.attrs["MATLAB_class"] = np.bytes_("char")
            refs["Name"].append(name.ref)
            refs["Data"].append(file.create_dataset(f"#refs#/d{k}", data=_Q[:, k, None]).ref)
        for field, references in refs.items():
            file.create_dataset(f"data/Y/{field}", data=references, dtype=h5py.ref_dtype)
    return path.read_bytes()


def _damage_hdf5(rng: Random, content: bytes) -> bytes:
    """Damage the bytes, or add another object written by the file's own library."""
    if rng.random() < 0.7:
        return damage_bytes(rng, content)
    import h5py

    buffer = io.BytesIO(content)
    with h5py.File(buffer, "r+") as file:
        name = rng.choice(["time", "q", "q3", "data/Y/Odd", "a/b/c", "x" * 3000, "#x"])
        if name in file:
            del file[name]
        match rng.randrange(9):
            case 0:
                file[name] = h5py.SoftLink(rng.choice(["/", "/q", "/nowhere", name]))
            case 1:
                file[name] = h5py.ExternalLink("/etc/hostname", "/q")
            case 2:
                file[name] = file["/"]
            case 3:
                shape = rng.choice([(2**40,), (2**20, 2**20), (0,), (), (1,) * 32, (40, 10_000)])
                chunks = tuple(min(n, 4) or 1 for n in shape) or None
                file.create_dataset(name, shape, rng.choice(["f8", "i1", "f2"]), chunks=chunks,
                                    maxshape=tuple(None for _ in shape) or None)  # fmt: skip
            case 4:
                kind = rng.choice([h5py.string_dtype(), np.dtype("c16"), np.dtype("V7"), "S3",
                                   h5py.vlen_dtype(np.dtype("f8")), np.dtype([("a", "f8")]),
                                   h5py.regionref_dtype, h5py.ref_dtype, ">f8", "?",
                                   h5py.enum_dtype({"a": 1})])  # fmt: skip
                file.create_dataset(name, (40,), kind)
            case 5:
                item = file[rng.choice([n for n in file if hasattr(file[n], "attrs")])]
                value = rng.choice([b"char", "char", np.bytes_("cell"), 1, [1, 2], b"\xff"])
                item.attrs[rng.choice(["MATLAB_class", "MATLAB_empty"])] = value
            case 6:
                values = rng.choice([_TIME[:3], np.full(40, np.nan), np.full(40, 2**63, "u8"),
                                     np.full((40, 1100), 1.0), -_TIME])  # fmt: skip
                file[name] = values
            case 7:
                layout = h5py.VirtualLayout((40,), "f8")
                layout[:] = h5py.VirtualSource("/etc/hostname", "q", (40,))
                file.create_virtual_dataset(name, layout)
            case _:
                deep = "/".join(["d"] * rng.choice([20, 40, 400]))
                file[f"{deep}/q1"] = _TIME
    return buffer.getvalue()


def _damage_parquet(rng: Random, content: bytes) -> bytes:
    """Damage the bytes, or write another table with unusual types and pandas metadata."""
    if rng.random() < 0.7:
        return damage_bytes(rng, content)
    import pyarrow as pa
    from pyarrow import parquet

    table = parquet.read_table(io.BytesIO(content), use_threads=False)
    n = table.num_rows
    odd = rng.choice([
        pa.array(["x"] * n), pa.array([None] * n), pa.array([[1.0]] * n), pa.array([{"a": 1}] * n),
        pa.array(["1.5"] * n).dictionary_encode(), pa.array([b"\xff"] * n), pa.array([True] * n),
        pa.array([2**63] * n, pa.uint64()), pa.array([0] * n, pa.timestamp("ns", "UTC")),
        pa.array([10**20] * n, pa.decimal128(38)), pa.array([0] * n, pa.duration("s")),
        pa.array([1.5] * n, pa.float16()), pa.array([0] * n, pa.time64("ns")),
    ])  # fmt: skip
    name = rng.choice([*table.column_names, "q3", "q9999", "", "time", "id"])
    table = table.append_column(name, odd)
    if rng.random() < 0.5:
        metadata = dict(table.schema.metadata or {})
        key = rng.choice(sorted(metadata) or [b"pandas"])
        metadata[key] = damage_json(rng, metadata.get(key, b"{}"))
        table = table.replace_schema_metadata(metadata)
    buffer = io.BytesIO()
    parquet.write_table(table, buffer)
    return buffer.getvalue()


def _mdf_samples(folder: Path) -> list[bytes]:
    import asammdf

    path = folder / "sample.mf4"
    with asammdf.MDF(version="4.10") as file:
        signals = [asammdf.Signal(_Q[:, k], _TIME, name=f"q{k + 1}", unit="rad") for k in range(2)]
        file.append(signals)
        file.save(path, overwrite=True)
    return [path.read_bytes()]


def _as_a_worker(library: str) -> Callable[[Path], None]:
    """Read a file as a worker process does; any error of the library ends that process."""

    def load(path: Path) -> None:
        folder = path.parent / "read"
        folder.mkdir(exist_ok=True)
        try:
            measurements.save_signals(measurements.SIGNALS_OF[library](path, []), folder)
            found = Recording.from_pandas(measurements.load_signals(folder).table())
        except Exception as error:
            raise ValueError(f"{path}: {str(error)[:1000]}") from error
        _check_recording(found)

    return load


# Rigs, rules, states.

_RIGS: list[dict[str, Any]] = [
    {"kind": "chain", "name": "bench", "mass": [0.26, 0.12], "length": [0.17, 0.23],
     "com": [0.16, 0.18], "inertia": [1e-4, 1.7e-4], "convention": ["absolute", "hanging"],
     "position_quantum": 1.571e-4, "buffers": {"drag_quadratic": [0.01, 0.01]}},
    {"kind": "axis", "mass": 3.0, "torque_offset": 0.1, "joint_names": ["x"]},
    {"mass": [0.2], "length": [0.3], "arm": {"inertia": 0.01, "length": 0.2}, "gravity": 9.81,
     "armature": [0.0, 1e-4], "inertia": [[1e-4, 1e-4, 1e-4, 0, 0, 0]]},
]  # fmt: skip
_TOML = b"""kind = "chain"
mass = [0.26, 0.12]
length = [0.17, 0.23]
convention = ["absolute", "hanging"]
[buffers]
drag_quadratic = [0.01, 0.01]
"""
_URDF = b"""<robot name="bench"><link name="ground"/>
<joint name="j1" type="continuous"><parent link="ground"/><child link="a"/>
<origin xyz="0 0 1" rpy="0 0.1 0"/><axis xyz="0 1 0"/></joint>
<link name="a"><inertial><origin xyz="0 0 -0.1"/><mass value="0.26"/>
<inertia ixx="1e-3" iyy="1e-3" izz="1e-4" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="j2" type="revolute"><parent link="a"/><child link="b"/><origin xyz="0 0 -0.2"/>
<axis xyz="0 1 0"/><limit lower="-3" upper="3" effort="1" velocity="9"/></joint>
<link name="b"><inertial><origin xyz="0 0 -0.15"/><mass value="0.12"/>
<inertia ixx="1e-3" iyy="1e-3" izz="1e-4" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="grip" type="fixed"><parent link="b"/><child link="c"/><origin xyz="0 0 -0.3"/></joint>
<link name="c"><inertial><mass value="0.02"/>
<inertia ixx="1e-6" iyy="1e-6" izz="1e-6" ixy="0" ixz="0" iyz="0"/></inertial></link></robot>"""
_MJCF = b"""<mujoco model="bench"><option gravity="0 0 -9.7"/><compiler angle="degree"/>
<default><joint type="hinge" armature="0.002" damping="0.1"/><geom density="2700"/></default>
<worldbody><body name="a" pos="0 0 1"><joint name="j1" axis="0 1 0"/>
<geom type="capsule" size="0.01" fromto="0 0 0 0 0 -0.2"/>
<body name="b" pos="0 0 -0.2" euler="0 5 0"><joint name="j2" axis="0 1 0" ref="20"/>
<geom type="box" size="0.01 0.01 0.1" pos="0 0 -0.1"/></body></body></worldbody></mujoco>"""


def _read_rig(path: Path) -> None:
    plant = rigs.read(path)
    entries = plant.to_dict()
    assert rigs.from_dict(entries).to_dict() == entries
    q = torch.zeros(plant.joints, dtype=torch.float64)
    assert plant.mass_matrix(q).shape == (plant.joints, plant.joints)
    assert all(bool(b.isfinite().all()) for b in plant.buffers())


def _rule_samples(_: Path) -> list[bytes]:
    import nfriction.papers.controller

    folder = Path(nfriction.papers.controller.__file__).parent / "data"
    table = (folder / "joint2.json").read_bytes()
    listed = json.loads(table)
    names = [list(v["sets"]) for v in listed["inputs"].values()]
    outputs = [next(iter(v["sets"])) for v in listed["outputs"].values()]
    del listed["table"]
    listed["rules"] = [{"if": [a, "*"], "then": outputs, "weight": 0.5} for a in names[0]]
    listed["rules"] += [{"if": ["*", b], "then": outputs} for b in names[1]]
    return [table, json.dumps(listed).encode()]


def _check_rules(rules: Any) -> None:
    controller = MamdaniController(rules)
    inputs = torch.zeros(1, len(rules.inputs), dtype=torch.float64)
    assert bool(torch.isfinite(controller.infer(inputs)).all())


_FIS = b"""[System]
Name='joint'
Type='mamdani'
NumInputs=2
NumOutputs=1
NumRules=2
AndMethod='min'
OrMethod='max'
DefuzzMethod='centroid'

[Input1]
Name='velocity'
Range=[0 10]
NumMFs=2
MF1='fast':'trapmf',[5 8 10 10]
MF2='slow':'gaussmf',[2 0]

[Input2]
Name='acceleration'
Range=[-5 5]
NumMFs=2
MF1='braking':'gbellmf',[2 3 -5]
MF2='driving':'gauss2mf',[1 2 0.5 4]

[Output1]
Name='B'
Range=[0 1]
NumMFs=2
MF1='low':'trimf',[-0.4 0 0.4]
MF2='high':'gaussmf',[0.2 1]

[Rules]
2 1, 1 (1) : 1
1 2, 2 (0.5) : 2
"""
_STATES = b"id,q0_1,q0_2,qd0_1,qd0_2,split\nrun1,3.1,0.2,0,0,train\nrun2,1.5,,0.5,,test\n"


def _read_states(path: Path) -> None:
    for q0, qd0 in read_initial_states(path).values():
        assert q0.shape == qd0.shape
        assert np.isfinite([*q0, *qd0]).all()


# Models and artefacts.


def _models() -> list[tuple[Any, ModelInfo]]:
    info = ModelInfo(
        joint_names=["shoulder", "elbow"], sample_time=1e-3,
        input_ranges={"qd": [[-9.0, 9.0]] * 2, "qdd": [[-90.0, 90.0]] * 2},
        training_data={"swing": "sha256:0"}, rig=_RIGS[0],
        fit={"converged": True, "status": "converged"},
    )  # fmt: skip
    return [(LFM(2), info), (NLFM(2), ModelInfo()), (NFLFM(2, head_units=2), info)]


def _model_samples(folder: Path) -> list[bytes]:
    return [save(m, folder / "sample.json", info).read_bytes() for m, info in _models()]


def _damage_model(rng: Random, content: bytes) -> bytes:
    """Mostly with a valid checksum, as a forger would write it."""
    damaged = damage_json(rng, content)
    try:
        document = json.loads(damaged)
        del document["checksum"]
        canonical = json.dumps(document, sort_keys=True, separators=(",", ":"))
    except (ValueError, KeyError, TypeError, RecursionError):
        return damaged
    document["checksum"] = hashlib.sha256(canonical.encode()).hexdigest()
    return json.dumps(document).encode() if rng.random() < 0.95 else damaged


def _read_model(path: Path) -> None:
    model, info = load(path), load_info(path)
    again = save(model, path.with_name("again.json"), info)
    assert parameter_hash(load(again).state_dict()) == parameter_hash(model.state_dict())
    zero = torch.zeros(model.joints, dtype=torch.float64)
    assert bool(model(zero, zero, zero + 1).isfinite().all())
    if info.rig is not None:
        assert load_plant(path).joints == model.joints


def _contract_samples(_: Path) -> list[bytes]:
    model, info = _models()[0]
    found = contract_of(model, controller_of(model, info), info).to_dict()
    # A few vectors test the same as many, and faster.
    for side in found["vectors"].values():
        for name in side:
            side[name] = side[name][:4]
    return [json.dumps(found).encode()]


def _read_contract(path: Path) -> None:
    found = Contract.from_json(path.read_bytes())
    assert Contract.from_json(found.to_json()).to_json() == found.to_json()
    assert found.state_size >= 0


@cache
def _artefact(write: Callable[..., Path]) -> bytes:
    model, info = _models()[0]
    with tempfile.TemporaryDirectory() as folder:
        return write(model, Path(folder) / "sample", info).read_bytes()


def _damage_artefact(rng: Random, content: bytes) -> bytes:
    return damage_zip(rng, content, _damage_part)


def _damage_part(rng: Random, content: bytes) -> bytes:
    """Damage one file of an archive, mostly so that JSON remains JSON."""
    if content[:1] == b"{" and rng.random() < 0.8:
        with contextlib.suppress(ValueError, RecursionError):  # damaged before
            return damage_json(rng, content)
    return damage_bytes(rng, content)


def _read_archive(write: Callable[..., Path], path: Path) -> None:
    """Read as `verify_artefact` does before torch runs anything."""
    contract = contract_of_archive(path)
    assert contract.state_size >= 0
    with zipfile.ZipFile(own_program(path, _artefact(write))) as archive:
        assert archive.testzip() is None


def _read_onnx(path: Path) -> None:
    model, info = _models()[0]
    contract = contract_of_onnx(path)
    verify(onnx_runner(path, controller_of(model, info)), contract)


# Folders of results.


def _run_samples(folder: Path) -> list[bytes]:
    write_run(folder / "run")
    return [(folder / "run" / "results.json").read_bytes()]


def _read_results(path: Path) -> None:
    """Read a run with damaged results; its models are separate files, see "model"."""
    folder = path.with_suffix("")
    folder.mkdir(exist_ok=True)
    content = path.read_bytes()
    (folder / "results.json").write_bytes(content)
    run = read_run(folder)
    # Writing a page takes ten times as long as reading.
    if zlib.crc32(content) % 10 == 0:
        page = to_html(run)
        assert "<script>document" not in page
        page.encode()


def _read_figure(path: Path) -> None:
    folder = path.with_suffix("")
    if not folder.exists():
        (folder / "figures").mkdir(parents=True)
        (folder / "results.json").write_text(json.dumps(checked_json(results())))
    (folder / "figures" / "damaged.png").write_bytes(path.read_bytes())
    run = read_run(folder)
    assert len(run.figures) + len(run.notes) > 0


def _figure_samples(folder: Path) -> list[bytes]:
    write_run(folder / "run")
    return [next((folder / "run" / "figures").glob("*.png")).read_bytes()]


def _json_samples(*documents: Any) -> Callable[[Path], list[bytes]]:
    return lambda _: [json.dumps(document).encode() for document in documents]


def _damage_npz(rng: Random, content: bytes) -> bytes:
    return damage_zip(rng, content, damage_npy)


_ARTEFACT = (ExportError, ContractError, OSError)
LOADERS: dict[str, Loader] = {
    loader.name: loader
    for loader in (
        Loader("csv", ".csv", _texts, _read_recording, damage_text),
        Loader("csv_gz", ".csv.gz", _written(".csv.gz"), _read_recording, _damage_gz),
        Loader("npz", ".npz", _written(".npz"), _read_recording, _damage_npz),
        Loader("parquet", ".parquet", _written(".parquet"), _read_recording, _damage_parquet,
               needs="pyarrow"),
        Loader("mat", ".mat", _matlab_samples, _as_a_worker("SciPy"), _damage_matlab, apart=True),
        Loader("hdf5", ".h5", _hdf5_samples, _read_recording, _damage_hdf5, needs="h5py"),
        Loader("mdf", ".mf4", _mdf_samples, _as_a_worker("asammdf"), damage_bytes, needs="asammdf",
               apart=True),
        Loader("initial_states", ".csv", lambda _: [_STATES], _read_states, damage_text),
        Loader("rig_json", ".json", _json_samples(*_RIGS), _read_rig, damage_json),
        Loader("rig_toml", ".toml", lambda _: [_TOML], _read_rig, damage_text, needs="tomllib"),
        Loader("urdf", ".urdf", lambda _: [_URDF], _read_rig, damage_text),
        Loader("mjcf", ".xml", lambda _: [_MJCF], _read_rig, damage_text, needs="mujoco"),
        Loader("rules", ".json", _rule_samples, lambda p: _check_rules(load_rules(p)),
               damage_json),
        Loader("fis", ".fis", lambda _: [_FIS], lambda p: _check_rules(load_fis(p)), damage_text),
        Loader("model", ".json", _model_samples, _read_model, _damage_model, (ModelFileError,)),
        Loader("contract", ".json", _contract_samples, _read_contract, damage_json,
               (ContractError,), names_file=False),
        Loader("results", ".json", _run_samples, _read_results, damage_json,
               names_file=False),
        Loader("figure", ".png", _figure_samples, _read_figure, damage_bytes, names_file=False),
        Loader("pt2", ".pt2", lambda _: [_artefact(pt2)], partial(_read_archive, pt2),
               _damage_artefact, _ARTEFACT, names_file=False),
        Loader("onnx", ".onnx", lambda _: [_artefact(onnx)], _read_onnx, damage_bytes, _ARTEFACT,
               names_file=False, needs="onnx"),
        Loader("torchscript", ".pt", lambda _: [_artefact(torchscript)],
               partial(_read_archive, torchscript), _damage_artefact, _ARTEFACT, names_file=False),
    )
}  # fmt: skip

"""Model files: loading restores what was saved, and damaged files are refused."""

import hashlib
import json
import os
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch

from nfriction import LinearAxis, PendulumChain, __version__, rigs, rollout, score
from nfriction.friction import model_by_name
from nfriction.friction.coefficients import Constant
from nfriction.friction.laws import Coefficient, Law
from nfriction.friction.models import LFM, NCFM, NLFM, FrictionModel
from nfriction.friction.neurofuzzy import NFLFM, NFNLFM, NeuroFuzzy
from nfriction.io.model_file import (
    ModelFileError,
    ModelInfo,
    describe,
    load,
    load_info,
    load_plant,
    parameter_hash,
    read_model_file,
    save,
)
from tests.fitting.recordings import pendulum, swing
from tests.friction.samples import QUADRATIC, motion, named_models, quadratic, randomise

INFO = ModelInfo(
    joint_names=["shoulder", "elbow"],
    unit="rad",
    sample_time=1e-3,
    input_ranges={"qd": [[-1.0, 1.0]], "qdd": [[-2.0, 3.0]]},
    training_data={"swing": "sha256:0"},
    rig={"kind": "chain", "mass": [0.1, 0.2]},
    fit={"converged": True, "status": "converged"},
)


def small(path: Path) -> tuple[LFM, Path]:
    model = LFM(2, [[1e-3, 0.1], [0.3, 1 / 3]])
    return model, save(model, path / "small.json", INFO)


def resigned(content: dict[str, Any]) -> bytes:
    """A file with a valid checksum, as a forger would write it."""
    content = {k: v for k, v in content.items() if k != "checksum"}
    canonical = json.dumps(content, sort_keys=True, separators=(",", ":"))
    return json.dumps(
        content | {"checksum": hashlib.sha256(canonical.encode()).hexdigest()}
    ).encode()


@pytest.mark.parametrize("name", named_models())
def test_model_round_trip_is_exact(name: str, tmp_path: Path) -> None:
    model = named_models()[name]
    loaded = load(save(model, tmp_path / "model.json"))
    assert type(loaded) is type(model)
    assert loaded.v_smooth == model.v_smooth
    assert loaded.schedule.options() == model.schedule.options()
    expected, found = model.state_dict(), loaded.state_dict()
    assert expected.keys() == found.keys()
    assert all(torch.equal(found[key], value) for key, value in expected.items())
    inputs = motion(50, 3)
    assert torch.equal(loaded(*inputs), model(*inputs))


def test_other_files_are_named_with_the_place_of_the_model(tmp_path: Path) -> None:
    with pytest.raises(TypeError, match=r"got LinearAxis; that of a fit is `result.model`"):
        save(LinearAxis(2.0), tmp_path / "m.json")  # type: ignore[arg-type]
    assert not list(tmp_path.iterdir())


def test_every_constructor_argument_of_named_models_is_stored(tmp_path: Path) -> None:
    for options in (
        {"terms": [2, 7]},
        {"head_units": 3},
        {"acceleration": "signed"},
        {"interpretable": True},
        {"prior_sd": 0.7},
        {"v_smooth": 0.1},
    ):
        model = NFNLFM(1, **options)
        randomise(model, 0.3)
        loaded = load(save(model, tmp_path / "model.json"))
        inputs = motion(20, 1)
        assert torch.equal(loaded(*inputs), model(*inputs)), options
        assert torch.equal(loaded.schedule.prior()[1], model.schedule.prior()[1]), options


def test_extreme_values_are_restored_exactly(tmp_path: Path) -> None:
    model = NLFM(1)
    extremes = [-0.0, 5e-324, -1.7976931348623157e308, 1 / 3, 2**-0.5]
    with torch.no_grad():
        model.schedule.raw.copy_(torch.tensor([extremes], dtype=torch.float64))
    raw = load(save(model, tmp_path / "model.json")).schedule.raw.detach().numpy()
    assert raw.tobytes() == model.schedule.raw.detach().numpy().tobytes()


def test_model_info_round_trip_is_exact(tmp_path: Path) -> None:
    model, path = small(tmp_path)
    assert load_info(path) == INFO
    content = read_model_file(path)
    assert content["version"] == __version__
    assert content["coefficients"][1] == {"name": "C", "unit": "N m", "positive": True}
    assert content["units"]["tau_f"] == "N m"
    assert content["parameter_hash"] == parameter_hash(model.state_dict())
    assert load_info(save(model, path)) == ModelInfo(joint_names=[])


def test_a_model_is_scored_from_its_file_alone(tmp_path: Path) -> None:
    """The fitted mechanism is restored bit for bit, hence every simulated sample, too."""
    given = pendulum(convention=("absolute", "hanging"), position_quantum=1e-4)
    plant = given.replace(gravity_moment=1.03 * given.gravity_moment)
    model = LFM(2, [[1.5e-3, 2.5e-3], [8e-4, 1.2e-3]], v_smooth=0.05)
    path = save(model, tmp_path / "model.json", ModelInfo(rig=plant.to_dict()))
    recording = swing(plant, model, seconds=0.5, convention="absolute,hanging")
    there = score(load_plant(path), load(path), recording, horizons=())
    here = score(plant, model, recording, horizons=())
    assert there.free_run == here.free_run
    assert (there.simulated == here.simulated).all()


def test_loaded_model_is_compiled_by_default_and_trainable_on_demand(tmp_path: Path) -> None:
    path = save(LFM(2, [1e-3, 1e-3], v_smooth=0.05), tmp_path / "model.json")
    model, plant = load(path), pendulum()
    q0 = torch.tensor([0.1, 0.2], dtype=torch.float64)
    assert not rollout(plant, model, q0, 0 * q0, steps=3).q.requires_grad
    rollout(plant, model.requires_grad_(True), q0, 0 * q0, steps=3).q.sum().backward()
    assert model.schedule.raw.grad is not None
    own = LFM(2, v_smooth=0.05)
    assert load(path, into=own) is own
    assert own.schedule.raw.requires_grad


@pytest.mark.parametrize(
    ("rig", "message"),
    [
        (None, "does not describe the mechanism"),
        ({}, "no mechanism .*missing keys"),
        ({"kind": ["chain"]}, "no mechanism"),
        ({"kind": "chain", "mass": [1.0, -1.0], "length": [1.0, 1.0]}, "`mass` must be positive"),
        ({"kind": "chain", "mass": "heavy", "length": 3}, "no mechanism"),
        ({"mass": [1.0, 1.0], "length": [1.0, 1.0], "buffers": [1]}, "no mechanism"),
        ({"mass": [1.0, 1.0], "length": [1.0, 1.0], "buffers": {"length": "a"}}, "no mechanism"),
        ({"mass": [1.0, 1.0], "length": [1.0, 1.0], "arm": {"mass": {}}}, "no mechanism"),
        ({"mass": [1.0, 1.0], "length": [1.0, 1.0], "convention": 7}, "no mechanism"),
    ],
)
def test_file_without_a_valid_plant_has_none(
    rig: dict | None, message: str, tmp_path: Path
) -> None:
    path = save(LFM(2), tmp_path / "model.json", ModelInfo(rig=rig))
    assert isinstance(load(path), LFM)
    with pytest.raises(ModelFileError, match=message) as raised:
        load_plant(path)
    assert str(path) in str(raised.value)
    assert isinstance(load_plant(save(LFM(2), path, ModelInfo(rig=pendulum().to_dict()))),
                      PendulumChain)  # fmt: skip


def test_units_of_a_sliding_axis_are_those_of_forces() -> None:
    description = describe(NFLFM(1), ModelInfo(unit="m"))
    assert [c["unit"] for c in description["coefficients"]] == ["N s/m", "N"]
    assert description["units"] == {"qd": "m/s", "qdd": "m/s^2", "load": "-", "tau_f": "N"}


def test_hash_depends_only_on_the_parameters() -> None:
    one, other = NFLFM(2), NFLFM(2)
    assert parameter_hash(one.state_dict()) == parameter_hash(other.state_dict())
    with torch.no_grad():
        # The smallest possible change.
        one.schedule.scale.copy_(torch.nextafter(one.schedule.scale, torch.full((), 9.9).double()))
    assert parameter_hash(one.state_dict()) != parameter_hash(other.state_dict())


def test_user_defined_model_is_loaded_into_one_of_the_same_kind(tmp_path: Path) -> None:
    model = FrictionModel(QUADRATIC, NeuroFuzzy(QUADRATIC, 2, terms=(3, 3)))
    randomise(model, 0.3)
    path = save(model, tmp_path / "own.json")
    fresh = FrictionModel(QUADRATIC, NeuroFuzzy(QUADRATIC, 2, terms=(3, 3)))
    assert load(path, into=fresh) is fresh
    inputs = motion(20, 2)
    assert torch.equal(fresh(*inputs), model(*inputs))
    with pytest.raises(ModelFileError, match="create the model yourself and pass it as `into`"):
        load(path)


RENAMED = Law("quadratic", (Coefficient("D_1", "N m"), Coefficient("D_3", "N m")), quadratic)


@pytest.mark.parametrize(
    ("other", "key"),
    [
        (lambda: NFLFM(2, terms=(3, 3)), "law"),
        (lambda: FrictionModel(RENAMED, NeuroFuzzy(RENAMED, 2, terms=(3, 3))), "coefficients"),
        (lambda: FrictionModel(QUADRATIC, NeuroFuzzy(QUADRATIC, 3, terms=(3, 3))), "joints"),
        (lambda: FrictionModel(QUADRATIC, NeuroFuzzy(QUADRATIC, 2, terms=(3, 3)), 0.1), "v_smooth"),
        (lambda: FrictionModel(QUADRATIC, NeuroFuzzy(QUADRATIC, 2, terms=(3, 4))), "options"),
        (lambda: FrictionModel(QUADRATIC, Constant(QUADRATIC, 2)), "options"),
    ],
)
def test_model_of_another_kind_is_not_loaded(
    other: Callable[[], FrictionModel], key: str, tmp_path: Path
) -> None:
    model = FrictionModel(QUADRATIC, NeuroFuzzy(QUADRATIC, 2, terms=(3, 3)))
    randomise(model)
    path = save(model, tmp_path / "own.json")
    into = other()
    before = {name: value.clone() for name, value in into.state_dict().items()}
    with pytest.raises(ModelFileError, match=f"`{key}` is .* in the file"):
        load(path, into=into)
    assert all(torch.equal(value, before[name]) for name, value in into.state_dict().items())


def test_file_is_json_without_pickle(tmp_path: Path) -> None:
    _, path = small(tmp_path)
    json.loads(path.read_bytes())
    assert not path.read_bytes().startswith((b"PK", b"\x80"))


# Damage


def test_file_truncated_anywhere_is_refused(tmp_path: Path) -> None:
    _, path = small(tmp_path)
    whole = path.read_bytes()
    for length in range(0, len(whole), 10):
        path.write_bytes(whole[:length])
        with pytest.raises(ModelFileError, match=re.escape(str(path))):
            load(path)


def test_changed_byte_is_refused_or_has_no_effect(tmp_path: Path) -> None:
    model, path = small(tmp_path)
    whole = path.read_bytes()
    refused = 0
    for at in range(0, len(whole), 7):
        path.write_bytes(whole[:at] + bytes([whole[at] ^ 0x01]) + whole[at + 1 :])
        try:
            loaded = load(path)
        except ModelFileError:
            refused += 1
        else:  # white space, or "version" and the like under another key
            assert torch.equal(loaded.schedule.raw, model.schedule.raw)
            assert load_info(path) == INFO
    assert refused > 0.5 * len(range(0, len(whole), 7))


def numbers(content: dict[str, Any], key: str) -> list:
    return content["state"][key]


@pytest.mark.parametrize(
    "edit",
    [
        lambda c: numbers(c, "schedule.raw")[0].__setitem__(0, -7.0),
        lambda c: c.update(v_smooth=0.5),
        lambda c: c.update(unit="m"),
        lambda c: c["rig"].update(mass=[9.0]),
        lambda c: c.update(checksum="0" * 64),
    ],
)
def test_an_edited_file_is_refused(edit: Callable[[dict], None], tmp_path: Path) -> None:
    _, path = small(tmp_path)
    content = json.loads(path.read_bytes())
    edit(content)
    path.write_text(json.dumps(content))
    with pytest.raises(ModelFileError, match="checksum does not match; damaged or edited"):
        load(path)


def test_layout_of_the_json_does_not_matter(tmp_path: Path) -> None:
    model, path = small(tmp_path)
    path.write_text(json.dumps(json.loads(path.read_bytes()), sort_keys=True))
    assert torch.equal(load(path).schedule.raw, model.schedule.raw)


@pytest.mark.parametrize(
    ("written", "message"),
    [
        (b"", "not a model file, or cut short"),
        (b"\x80\x04\x95", "cut short .it is binary, as an artefact is"),
        (b"\xff\xfe\x00", "not a model file, or cut short"),
        (b"[]", "not a model file of nfriction"),
        (b'{"format": "other"}', "not a model file of nfriction"),
        (b'{"format": "nfriction model", "schema": 99}', "its schema is 99, not 1"),
        (b'{"format": "nfriction model", "schema": 1}', "`model` is missing"),
        (
            b'{"format": "nfriction model", "schema": 1, "model": NaN}',
            "numbers must be finite, got NaN",
        ),
        (b"[" * 100_000 + b"]" * 100_000, "nested too deeply"),
        (b"1" * 10_000, "not a model file"),
    ],
)
def test_files_that_are_no_model_files_are_refused(
    written: bytes, message: str, tmp_path: Path
) -> None:
    path = tmp_path / "model.json"
    path.write_bytes(written)
    with pytest.raises(ModelFileError, match=message) as raised:
        load(path)
    assert str(path) in str(raised.value)
    assert len(str(raised.value)) < 1000


def test_missing_files_folders_and_huge_files_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ModelFileError, match="no such file"):
        load(tmp_path / "absent.json")
    with pytest.raises(ModelFileError, match="not a file"):
        load(tmp_path)
    giant = tmp_path / "giant.json"
    with giant.open("wb") as file:
        file.truncate(2**40)
    with pytest.raises(ModelFileError, match="too large for a model file"):
        load(giant)


FORGED: dict[str, tuple[Callable[[dict], Any], str]] = {
    "wrong type": (lambda c: c.update(joints="2"), "`joints` is missing or of the wrong type"),
    "true for one": (lambda c: c.update(joints=True), "`joints` is missing or of the wrong type"),
    "no state": (lambda c: c.pop("state"), "`state` is missing"),
    "no info": (lambda c: c.pop("rig"), "`rig` is missing"),
    "unknown model": (lambda c: c.update(model="LFN"), "'LFN' is not one of the named models"),
    "unknown option": (lambda c: c["options"].update(depth=3), "depth"),
    "many joints": (lambda c: c.update(joints=10**9), "sizes .* is refused"),
    "no joints": (lambda c: c.update(joints=0), "sizes .* is refused"),
    "terms no list": (
        lambda c: c["options"].update(terms=5),
        "LFM has no option terms",
    ),
    "smoothing": (lambda c: c.update(v_smooth=-1.0), "`v_smooth` must be positive"),
    "infinite smoothing": (lambda c: c.update(v_smooth=float("inf")), "numbers must be finite"),
    "wrong shape": (lambda c: c["state"].update({"schedule.raw": [[1.0, 2.0]]}), r"got shape \(1"),
    "infinite": (
        lambda c: c["state"].update({"schedule.raw": [[1.0, float("inf")], [1.0, 1.0]]}),
        "numbers must be finite",
    ),
    "ragged": (lambda c: c["state"].update({"schedule.raw": [[1.0], [1.0, 2.0]]}), "not an array"),
    "text": (lambda c: c["state"].update({"schedule.raw": "abc"}), "not an array of numbers"),
    "null": (lambda c: c["state"].update({"schedule.raw": None}), "not an array of numbers"),
    "object": (lambda c: c["state"].update({"schedule.raw": {"a": 1}}), "not an array of numbers"),
    "huge integer": (
        lambda c: c["state"].update({"schedule.raw": [[10**400, 1], [1, 1]]}),
        "numbers must be finite, got 1000",
    ),
    "true for a number": (
        lambda c: c["state"].update({"schedule.raw": [[True, 1.0], [1.0, 1.0]]}),
        "not an array of numbers",
    ),
    "no sample time": (lambda c: c.update(sample_time=0), "`sample_time` must be positive"),
    "true for a sample time": (lambda c: c.update(sample_time=True), "of the wrong type"),
    "true for a range": (
        lambda c: c["input_ranges"].update(qd=[[False, True]]),
        "`input_ranges.*must be numbers",
    ),
    "range upside down": (
        lambda c: c["input_ranges"].update(qd=[[1.0, -1.0]]),
        "lowest, highest",
    ),
    "range of something else": (
        lambda c: c["input_ranges"].update(velocity=[[0.0, 1.0]]),
        '`input_ranges` must be of "qd" and "qdd", got \'velocity\'',
    ),
    "no range": (lambda c: c["input_ranges"].update(qd=None), "must be numbers"),
    "names no texts": (lambda c: c.update(joint_names=["a", 2]), "must be texts"),
    "too few names": (lambda c: c.update(joint_names=["a"]), "must name 2 joints"),
    "rig of another": (
        lambda c: c.update(rig={"mass": [1.0] * 100, "length": [1.0] * 100}),
        "`rig` has 100 joints, the model 2: give that of its fit",
    ),
    "rating no text": (lambda c: c["fit"].update(usability=1), "`usability` must be two texts"),
    "digest no text": (lambda c: c["training_data"].update(run=1), "map names to digests"),
    "deep": (lambda c: c["state"].update({"schedule.raw": nested(500)}), "not an array|got shape"),
    "extra": (
        lambda c: c["state"].update(other=[1.0]),
        "missing or do not belong to the model: .*other",
    ),
    "absent": (
        lambda c: c["state"].pop("schedule.raw"),
        "missing or do not belong to the model: .*raw",
    ),
    "law": (lambda c: c.update(law="viscous"), "`law` is 'viscous' in the file, 'linear' in"),
    "coefficients": (lambda c: c.update(coefficients=[1, 2]), "`coefficients` is"),
}


def nested(depth: int) -> list:
    value: list = [1.0]
    for _ in range(depth):
        value = [value]
    return value


@pytest.mark.parametrize("name", FORGED)
def test_a_forged_file_is_refused(name: str, tmp_path: Path) -> None:
    forge, message = FORGED[name]
    _, path = small(tmp_path)
    content = json.loads(path.read_bytes())
    forge(content)
    path.write_bytes(resigned(content).replace(b"Infinity", b"1e999"))
    with pytest.raises(ModelFileError, match=message) as raised:
        load(path)
    assert str(path) in str(raised.value)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"terms": [10**6, 10**6]}, "is refused"),
        ({"terms": [300, 300]}, "is refused"),  # 90,000 rules from a file without their numbers
        ({"head_units": 10**9}, "is refused"),
        ({"terms": [5, 5.0]}, "is refused"),
        ({"terms": "55"}, "is refused"),
        ({"terms": [5]}, "2 inputs"),
        ({"interpretable": "yes"}, "`options` is"),
        ({"acceleration": "papers"}, "`acceleration` must be"),
        ({"acceleration": ["signed"]}, "`acceleration` must be"),
        ({"prior_sd": "wide"}, "`prior_sd` must be positive"),
        ({"prior_sd": 0.5, "initial": [1.0, 1.0]}, "`options` is"),
    ],
)
def test_impossible_network_is_refused(options: dict, message: str, tmp_path: Path) -> None:
    path = save(NFLFM(1), tmp_path / "model.json")
    content = json.loads(path.read_bytes())
    content["options"] |= options
    path.write_bytes(resigned(content))
    with pytest.raises(ModelFileError, match=message):
        load(path)


@pytest.mark.parametrize("option", ["time_constant", "sample_time", "hysteresis"])
@pytest.mark.parametrize(("value", "message"), [(10**400, "finite"), (True, "`options` is")])
def test_schedule_values_must_be_numbers(
    option: str, value: Any, message: str, tmp_path: Path
) -> None:
    path = save(model_by_name("ALFM")(1), tmp_path / "model.json")
    content = json.loads(path.read_bytes())
    assert option in content["options"]
    content["options"][option] = value
    path.write_bytes(resigned(content))
    with pytest.raises(ModelFileError, match=message):
        load(path)


def test_a_wrong_unit_is_refused(tmp_path: Path) -> None:
    _, path = small(tmp_path)
    path.write_bytes(resigned(json.loads(path.read_bytes()) | {"unit": "deg"}))
    with pytest.raises(ModelFileError, match='"rad" or "m", got \'deg\''):
        load_info(path)


# Writing


def test_models_that_json_cannot_represent_are_not_saved(tmp_path: Path) -> None:
    path = tmp_path / "model.json"
    model = LFM(2)
    with pytest.raises(ValueError, match="plain JSON"):
        save(model, path, ModelInfo(fit={"residual": float("nan")}))
    with pytest.raises(ValueError, match="plain JSON"):
        save(model, path, ModelInfo(fit={"residual": torch.ones(())}))
    with pytest.raises(ValueError, match="name 2 joints, got \\['one'\\]"):
        save(model, path, ModelInfo(joint_names=["one"]))
    with pytest.raises(ValueError, match="name 2 joints, got ab"):
        save(model, path, ModelInfo(joint_names="ab"))
    with pytest.raises(ValueError, match="`rig` has 3 joints, the model 2: give that of its fit"):
        save(model, path, ModelInfo(rig=rigs.tlrip().to_dict()))
    with torch.no_grad():
        model.schedule.raw[0, 0] = torch.nan
    with pytest.raises(ValueError, match=r"`schedule\.raw` is not finite"):
        save(model, path)
    assert not list(tmp_path.iterdir())


def test_file_is_replaced_atomically(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    _, path = small(tmp_path)
    before = path.read_bytes()

    def full(_: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match=r"No space left on device.*small\.json"):
        save(NCFM(1), path)
    assert path.read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == ["small.json"]
    monkeypatch.undo()
    save(NCFM(1), path)
    assert isinstance(load(path), NCFM)
    assert [p.name for p in tmp_path.iterdir()] == ["small.json"]


def test_missing_folders_are_created_and_impossible_ones_named(tmp_path: Path) -> None:
    path = tmp_path / "a" / "b" / "model.json"
    assert save(LFM(1), path) == path
    beneath_a_file = path / "model.json"
    with pytest.raises(OSError, match=f"cannot write the file .*{re.escape(str(beneath_a_file))}"):
        save(LFM(1), beneath_a_file)


@pytest.mark.skipif(os.name != "posix" or os.geteuid() == 0, reason="root may write anywhere")
def test_a_folder_without_permission_is_named(tmp_path: Path) -> None:
    folder = tmp_path / "locked"
    folder.mkdir(mode=0o500)
    with pytest.raises(PermissionError, match=r"cannot write the file .*model\.json"):
        save(LFM(1), folder / "model.json")

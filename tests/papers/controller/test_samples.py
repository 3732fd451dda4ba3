"""The supervised data set, and the loader of all simulated ones."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch

from nfriction import datasets
from nfriction.papers import twin
from nfriction.papers.controller.mamdani import paper_controller
from nfriction.papers.controller.samples import (
    ControllerSamples,
    checksums,
    read_samples,
    sampled,
)
from nfriction.signals import Motion

CARDS = Path(__file__).resolve().parents[3] / "datasets"


def controller_samples(**options: object) -> ControllerSamples:
    found = datasets.load("tlrip_controller", **options)  # type: ignore[arg-type]
    assert isinstance(found, ControllerSamples)
    return found


def test_targets_are_the_controllers_outputs_for_the_measured_motion(tmp_path: Path) -> None:
    samples = controller_samples(duration=1.0, cache=tmp_path)
    assert samples.x.shape == samples.y.shape == (1000, 3, 2)
    assert samples.output_names == ("B", "C")
    assert (samples.x[..., 0] >= 0).all()
    for joint, number in enumerate((2, 3, 4)):
        expected = paper_controller(number)(samples.x[:, joint, 0], samples.x[:, joint, 1])
        # The files have nine digits.
        torch.testing.assert_close(expected, samples.y[:, joint], rtol=1e-7, atol=0.0)


def test_built_set_is_reread_and_changes_are_detected(tmp_path: Path) -> None:
    first = controller_samples(duration=0.2, cache=tmp_path)
    (folder,) = (p for p in tmp_path.iterdir() if p.is_dir())
    assert checksums(controller_samples(duration=0.2, cache=tmp_path)) == checksums(first)
    table = first.to_pandas(1)
    table.loc[3, "B"] *= 1.5
    table.to_csv(folder / "joint3.csv.gz", index=False)
    with pytest.raises(ValueError, match="differ from checksums"):
        controller_samples(duration=0.2, cache=tmp_path)


def test_user_tables_are_read_by_column_names(tmp_path: Path) -> None:
    first = controller_samples(duration=0.2, cache=tmp_path / "cache")
    tables = {name: first.to_pandas(j) for j, name in enumerate(first.joint_names)}

    def read(**changed: pd.DataFrame) -> ControllerSamples:
        for name, table in (tables | changed).items():
            table.to_csv(tmp_path / f"{name}.csv.gz", index=False)
        return read_samples(tmp_path)

    turned = {name: table[["time", "B", "C", "acceleration", "speed"]]
              for name, table in tables.items()}  # fmt: skip
    torch.testing.assert_close(read(**turned).y, first.y)
    table = tables["joint3"]
    for wrong, fault in (
        (table.rename(columns={"speed": "velocity"}), "the columns time, speed, acceleration, B"),
        (table.assign(B=np.nan), "rows of finite numbers only, got nan for B in row 1"),
        (table.assign(B="x"), "rows of finite numbers only, got x for B in row 1"),
        (table.assign(B=True), "rows of finite numbers only, got True for B in row 1"),
        (table[:0], "rows of finite numbers only, got no row"),
        (table.assign(speed=-table["speed"] - 1), r"speed = \|velocity\|, at least 0, got -\d"),
        (table[:-1], "the times of joint2"),
        (table.assign(time=2 * table["time"]), "the times of joint2"),
    ):
        with pytest.raises(ValueError, match=f"joint3.csv.gz needs {fault}"):
            read(joint3=wrong)
    # Joints with equal times, in a wrong order.
    turned = {name: table[::-1] for name, table in tables.items()}
    with pytest.raises(
        ValueError, match=r"order of time, got 0.198 after 0.199 s in row 2; sort them"
    ):
        read(**turned)


@pytest.mark.parametrize("name", [n for n in datasets.names() if n.endswith("_twin")])
def test_loaded_twin_equals_the_generated_one(name: str, tmp_path: Path) -> None:
    made = twin.make(name.removesuffix("_twin"), duration=0.2, seed=3)
    for _ in ("built", "read"):
        found = datasets.load(name, seed=3, duration=0.2, cache=tmp_path)
        assert isinstance(found, twin.Twin)
        assert found.splits == made.splits
        assert found.plant.to_dict() == made.plant.to_dict()
        for label, recording in made.recordings.items():
            assert found.recordings[label].digest() == recording.digest()
            np.testing.assert_array_equal(found.truth[label].qdd, made.truth[label].qdd)
            np.testing.assert_array_equal(found.initial_states[label], made.initial_states[label])
    assert len([p for p in tmp_path.iterdir() if p.is_dir()]) == 1


def test_bad_names_are_refused_before_anything_is_written(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="tlrip_controller"):
        datasets.load("cartpole", cache=tmp_path)
    with pytest.raises(ValueError, match="load"):
        datasets.load("twin_family", truth="../../x", cache=tmp_path)
    with pytest.raises(ValueError, match="duration"):
        datasets.load("rtip_twin", duration=0.001, cache=tmp_path)
    assert not [p for p in tmp_path.iterdir() if p.is_dir()]


def test_motion_needs_one_controller_per_joint() -> None:
    still = Motion(np.arange(3.0), *(np.zeros((3, 2)) for _ in range(3)))
    with pytest.raises(ValueError, match="2 joints"):
        sampled([paper_controller(2)], still, joint_names=("a", "b"))


@pytest.mark.slow
def test_full_set_matches_its_data_card(tmp_path: Path) -> None:
    card = (CARDS / "tlrip_controller" / "README.md").read_text(encoding="utf-8")
    samples = controller_samples(cache=tmp_path)
    assert len(samples) == 40_000
    assert all(checksum in card for checksum in checksums(samples).values())

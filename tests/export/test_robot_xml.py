"""Patching robot descriptions: joints by name; values that no robot can use are refused."""

from pathlib import Path
from xml.etree import ElementTree

import pytest

from nfriction.export.simulators import DampingFit, patched

URDF = """<robot name="r"><link name="l"/>
  <joint name="a" type="revolute"><limit effort="1"/></joint>
  <joint name="b" type="revolute"><dynamics damping="1" friction="2"/></joint></robot>"""


def patch(tmp_path: Path, text: str | bytes, root: str = "robot", names: list[str] | None = None):
    path = tmp_path / "robot.xml"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    found = DampingFit(tuple(names or "ba"), (0.25, 0.5), (0.125, 1e-7), (), ())
    return patched(path, root, found)


def test_joints_are_found_by_name_and_all_else_is_unchanged(tmp_path: Path) -> None:
    tree = ElementTree.fromstring(patch(tmp_path, URDF))
    found = {joint.get("name"): joint.find("dynamics") for joint in tree.iter("joint")}
    assert {name: x.attrib for name, x in found.items() if x is not None} == {
        "a": {"damping": "0.5", "friction": "1e-07"},
        "b": {"damping": "0.25", "friction": "0.125"},
    }
    assert tree.find("joint/limit") is not None
    assert tree.find("link") is not None
    # Patching is idempotent.
    once = patch(tmp_path, URDF)
    assert patch(tmp_path, once) == once


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "not XML"),
        (URDF[:-20], "cut short"),
        ("<mujoco/>", "not <robot>"),
        ('<!DOCTYPE r [<!ENTITY x "y">]><robot>&x;</robot>', "which is refused"),
        (URDF.encode("utf-16"), "must be UTF-8"),
        ("<robot/>", "joint called 'b', found 0; its joints are none"),
        (URDF.replace('"a"', '"b"'), "found 2"),
    ],
)
def test_files_that_describe_no_robot_are_refused(
    text: str | bytes, message: str, tmp_path: Path
) -> None:
    with pytest.raises(ValueError, match=message):
        patch(tmp_path, text)


def test_huge_files_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "robot.xml"
    with path.open("wb") as file:
        file.truncate(2**28)  # sparse
    with pytest.raises(ValueError, match="too large"):
        patched(path, "robot", DampingFit(("a",), (1.0,), (1.0,), (), ()))

"""Joint friction in robot descriptions: MuJoCo's MJCF and ROS's URDF."""

from collections.abc import Sequence
from pathlib import Path
from xml.etree import ElementTree
from xml.sax.saxutils import quoteattr

from nfriction.plant.robot_file import parse_xml


def mjcf_snippet(
    names: Sequence[str], damping: Sequence[float], frictionloss: Sequence[float], note: str
) -> bytes:
    """An MJCF of default classes, one a joint, each named as the joint."""
    rows = [
        f"    <default class={quoteattr(name)}>\n"
        f"      <joint damping={_number(d)} frictionloss={_number(f)}/>\n"
        "    </default>"
        for name, d, f in zip(names, damping, frictionloss, strict=True)
    ]
    parts = ["<mujoco>", _comment(note), "  <default>", *rows, "  </default>", "</mujoco>", ""]
    return "\n".join(parts).encode()


def urdf_snippet(
    names: Sequence[str], damping: Sequence[float], frictionloss: Sequence[float], note: str
) -> bytes:
    """The `dynamics` of every joint, to be copied into a URDF."""
    rows = [
        f"  <joint name={quoteattr(name)}>\n"
        f"    <dynamics damping={_number(d)} friction={_number(f)}/>\n"
        "  </joint>"
        for name, d, f in zip(names, damping, frictionloss, strict=True)
    ]
    parts = ['<robot name="friction">', _comment(note), *rows, "</robot>", ""]
    return "\n".join(parts).encode()


def patched(
    path: str | Path,
    root: str,
    names: Sequence[str],
    damping: Sequence[float],
    frictionloss: Sequence[float],
) -> bytes:
    """A robot description with the friction of the named joints replaced.

    Args:
        path: an MJCF or URDF file, in UTF-8.
        root: name of its root element, "mujoco" or "robot".
        names, damping, frictionloss: of the joints.

    Raises:
        ValueError: if the file is of another kind, declares entities, or a joint is missing or
            there twice.
        OSError: if it cannot be read.
    """
    try:
        tree = parse_xml(Path(path), comments=True)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error
    if tree.tag != root:
        raise ValueError(f"{path}: the root element is <{tree.tag[:40]}>, not <{root}>.")
    # In MJCF other things refer to joints by elements of that name too.
    bodies = tree.findall("worldbody") if root == "mujoco" else [tree]
    joints = [joint for body in bodies for joint in body.iter("joint")]
    for name, d, f in zip(names, damping, frictionloss, strict=True):
        matches = [joint for joint in joints if joint.get("name") == name]
        if len(matches) != 1:
            known = ", ".join(str(joint.get("name")) for joint in joints)[:200]
            raise ValueError(
                f"{path}: there must be one joint called {name!r}, found {len(matches)}; its "
                f"joints are {known or 'none'}. Name the model's joints in `joint_names`."
            )
        target = matches[0]
        if root == "mujoco":
            target.set("damping", repr(d))
            target.set("frictionloss", repr(f))
        else:
            dynamics = target.find("dynamics")
            if dynamics is None:
                dynamics = ElementTree.SubElement(target, "dynamics")
            dynamics.set("damping", repr(d))
            dynamics.set("friction", repr(f))
    text = ElementTree.tostring(tree, encoding="unicode")
    return f'<?xml version="1.0" encoding="utf-8"?>\n{text}\n'.encode()


def _number(value: float) -> str:
    return f'"{value!r}"'


def _comment(note: str) -> str:
    """A note as an XML comment, which must not hold two hyphens."""
    lines = note.replace("--", "- -").splitlines()
    return "\n".join(["  <!-- The nearest to the model along a recorded motion:", *(
        f"       {line}" for line in lines), "  -->"])  # fmt: skip

"""A mechanism from a robot description: URDF, or MuJoCo's MJCF."""

from pathlib import Path
from xml.etree import ElementTree

from nfriction.plant.chain import PendulumChain
from nfriction.plant.mjcf import mjcf_links
from nfriction.plant.reduction import pendulum_chain
from nfriction.plant.urdf import GRAVITY, urdf_links

ENDINGS = (".urdf", ".xml", ".mjcf")
LARGEST_FILE = 64 * 2**20


def read_robot(path: str | Path) -> PendulumChain:
    """The chain of a URDF or MJCF, with joint names and coordinates as the file has them.

    Serial chains of hinges with parallel, horizontal axes are read, alone or on an arm that turns
    about the vertical. What is fixed to a link counts as part of it. Rotor inertias are MJCF's
    `armature`; friction, limits, contacts and actuators are left out.

    Args:
        path: of the file; its root element tells which of the two it is.

    Raises:
        ValueError: for another mechanism, naming the joint and the rule, or no such file.
        OSError: if it cannot be read.
        ImportError: for an MJCF where MuJoCo is not installed.
    """
    path = Path(path)
    root = parse_xml(path)
    if any("xacro" in element.tag for element in root.iter()):
        raise ValueError("holds macros; write it out first: xacro robot.xacro > robot.urdf")
    if root.tag == "robot":
        return pendulum_chain(urdf_links(root), GRAVITY, root.get("name", ""))
    if root.tag == "mujoco":
        return pendulum_chain(*mjcf_links(path, root))
    raise ValueError(f"the root element is <{root.tag[:40]}>, neither <robot> nor <mujoco>.")


def parse_xml(path: Path, *, comments: bool = False) -> ElementTree.Element:
    """The root of an XML file that declares nothing of its own.

    Args:
        path: of the file.
        comments: keep them as elements.

    Raises:
        ValueError: if it is too large, not UTF-8, no XML, or declares a document type.
    """
    size = path.stat().st_size
    if size > LARGEST_FILE:
        raise ValueError(f"{size} bytes are too large for a robot description.")
    try:
        text = path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as error:
        raise ValueError(f"must be UTF-8 ({error.reason}).") from error
    # Entities can be made to grow without bound, or to read other files; no robot needs them.
    if "<!DOCTYPE" in text or "<!ENTITY" in text:
        raise ValueError("declares a document type or entities, which is refused.")
    builder = ElementTree.TreeBuilder(insert_comments=comments)
    try:
        return ElementTree.fromstring(text, ElementTree.XMLParser(target=builder))
    except ElementTree.ParseError as error:
        raise ValueError(f"no XML, or cut short ({error}).") from error

"""What a URDF must say before MuJoCo reads it.

MuJoCo drops limits that are missing or empty with a warning at most, and names a mesh
that it cannot read without saying what to do.
"""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from handeye_tri.errors import InputError

_MESHES = (".stl", ".obj", ".msh")
# Joints with limits, and their units.
_LIMITED = {"revolute": "rad", "prismatic": "m"}


def check_urdf(path: Path, flange: str) -> None:
    """Check the joints below a link, and the meshes that can collide.

    Files of another kind pass: MuJoCo says what is wrong with those.

    Args:
        path: The model's file.
        flange: The link; joints that do not carry it may lack anything.

    Raises:
        InputError: a joint of the arm is neither revolute, continuous, prismatic nor
            fixed, or lacks limits; or a mesh cannot be read.
    """
    try:
        root = ElementTree.parse(path).getroot()
    except (ElementTree.ParseError, OSError):
        return
    if root.tag != "robot":
        return
    for joint in _below(root, flange):
        _check_joint(path, joint)
    # With settings of its own, MuJoCo may look for meshes elsewhere.
    if root.find("mujoco") is None:
        for mesh in root.iterfind("link/collision/geometry/mesh"):
            _check_mesh(path, mesh.get("filename", ""))


def _below(root: ElementTree.Element, link: str) -> list[ElementTree.Element]:
    """Joints from a link down to the root."""
    by_child: dict[str, ElementTree.Element] = {}
    for joint in root.findall("joint"):
        child = joint.find("child")
        if child is not None:
            by_child[child.get("link", "")] = joint
    found = []
    # A link that carries itself is MuJoCo's to name.
    while link in by_child:
        joint = by_child.pop(link)
        found.append(joint)
        parent = joint.find("parent")
        link = "" if parent is None else parent.get("link", "")
    return found


def _check_joint(path: Path, joint: ElementTree.Element) -> None:
    name, kind = joint.get("name", ""), joint.get("type", "")
    if kind in ("continuous", "fixed"):
        return
    if kind not in _LIMITED:
        raise InputError(
            f"{path}: joint {name!r} is {kind}; between base and flange only revolute, "
            "continuous, prismatic and fixed joints are supported"
        )
    limit = joint.find("limit")
    stated = {} if limit is None else limit.attrib
    unit = _LIMITED[kind]
    remedy = f'write <limit lower="..." upper="..."/> in {unit}'
    if kind == "revolute":
        remedy += ", or make it continuous if it has none"
    missing = [key for key in ("lower", "upper") if key not in stated]
    if missing:
        raise InputError(
            f"{path}: joint {name!r} is {kind} and states no "
            f"{' and no '.join(missing)} limit; {remedy}"
        )
    try:
        lower, upper = float(stated["lower"]), float(stated["upper"])
    except ValueError:
        lower = upper = np.nan
    if not -np.inf < lower < upper < np.inf:
        raise InputError(
            f"{path}: joint {name!r}: lower limit {stated['lower']!r} must be a number "
            f"below the upper limit {stated['upper']!r}; {remedy}"
        )


def _check_mesh(path: Path, name: str) -> None:
    if "://" in name:
        raise InputError(
            f"{path}: collision mesh {name!r}: packages are not searched; write its "
            "path from the folder of this file"
        )
    if Path(name).suffix.lower() not in _MESHES:
        raise InputError(
            f"{path}: collision mesh {name!r} is of a kind that is not read; convert "
            f"it to one of {', '.join(_MESHES)}"
        )
    if not (path.parent / name).is_file():
        raise InputError(
            f"{path}: collision mesh {name!r} is not at {path.parent / name}; put it "
            "there, or a box or cylinder in its place"
        )

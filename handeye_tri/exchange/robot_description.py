"""A compiled cell as URDF: for viewers, and for readers that know no MJCF."""

from __future__ import annotations

from xml.sax.saxutils import quoteattr

import numpy as np

from handeye_tri.exchange.results import number
from handeye_tri.exchange.urdf import fixed_joint, origin
from handeye_tri.mechanism import Geometry, Joint, Mechanism
from handeye_tri.se3 import SE3


def link_names(mechanism: Mechanism, base: str, flange: str) -> tuple[str, ...]:
    """A name for every body that no other frame has.

    The body that poses refer to is called ``base``; ``flange`` is kept free for the
    frame that the robot reports.
    """
    taken = {base, flange}
    names = []
    for index, body in enumerate(mechanism.bodies):
        if index == mechanism.base_body:
            names.append(base)
            continue
        name = "".join(c if c.isalnum() or c in "_-." else "_" for c in body.name)
        name = name or f"body_{index}"
        while name in taken:
            name += "_link"
        taken.add(name)
        names.append(name)
    return tuple(names)


def robot_urdf(mechanism: Mechanism, names: tuple[str, ...]) -> str:
    """The cell's bodies, joints and plain solids.

    Every body is a link whose frame is the body's; a joint that does not turn about
    the body's origin has a link of its own before it. Joints outside the chain from
    base to flange stay at their references. Meshes, planes and ellipsoids are left
    out; a capsule is a cylinder with two spheres.

    Args:
        mechanism: The compiled cell.
        names: A name for every body.
    """
    moving = set(mechanism.arm_joints)
    text = (
        '<?xml version="1.0"?>\n'
        "<!-- Metres and radians. Efforts are not known and stand as 0. -->\n"
        '<robot name="cell">\n'
    )
    for index, body in enumerate(mechanism.bodies):
        solids = "".join(_visual(g) for g in mechanism.geometries if g.body == index)
        text += f"  <link name={quoteattr(names[index])}>\n{solids}  </link>\n"
        if index == 0:
            continue
        parent, pose = names[body.parent], body.parent_from_body
        for number_, joint in enumerate(mechanism.joints):
            if joint.body != index or number_ not in moving:
                continue
            carrier = f"{names[index]}_of_{joint.name}"
            at_anchor = SE3.from_parts(np.eye(3), joint.anchor)
            text += f"  <link name={quoteattr(carrier)}/>\n"
            text += _joint(joint, parent, carrier, pose @ at_anchor @ _at_zero(joint))
            parent, pose = carrier, at_anchor.inverse()
        text += fixed_joint(f"{names[index]}_fixed", parent, names[index], pose)
    return text + "</robot>\n"


def _at_zero(joint: Joint) -> SE3:
    """From the joint at its reference value to value 0."""
    along = -joint.reference * joint.axis
    slide = joint.kind == "slide"
    return SE3.exp(
        np.append(along, np.zeros(3)) if slide else np.append([0] * 3, along)
    )


def _joint(joint: Joint, parent: str, child: str, motion: SE3) -> str:
    bounded = np.isfinite([joint.lower, joint.upper]).all()
    kind = "prismatic" if joint.kind == "slide" else "revolute"
    lower, upper = joint.lower, joint.upper
    if not bounded:
        kind = "continuous" if kind == "revolute" else kind
        lower, upper = -1e6, 1e6
    speed = joint.speed if np.isfinite(joint.speed) else 1e6
    axis = " ".join(map(number, joint.axis))
    return (
        f'  <joint name={quoteattr(joint.name)} type="{kind}">\n'
        f"    <parent link={quoteattr(parent)}/>\n"
        f"    <child link={quoteattr(child)}/>\n"
        f"    {origin(motion)}\n"
        f'    <axis xyz="{axis}"/>\n'
        f'    <limit lower="{number(lower)}" upper="{number(upper)}" effort="0.0" '
        f'velocity="{number(speed)}"/>\n'
        "  </joint>\n"
    )


def _visual(geometry: Geometry) -> str:
    size = geometry.size
    shapes: list[tuple[str, float]] = []
    if geometry.shape == "box":
        shapes = [(f'<box size="{" ".join(number(2 * s) for s in size)}"/>', 0.0)]
    elif geometry.shape == "sphere":
        shapes = [(f'<sphere radius="{number(size[0])}"/>', 0.0)]
    elif geometry.shape in ("cylinder", "capsule"):
        r, half = number(size[0]), float(size[1])
        shapes = [(f'<cylinder radius="{r}" length="{number(2 * half)}"/>', 0.0)]
        if geometry.shape == "capsule":
            shapes += [(f'<sphere radius="{r}"/>', end) for end in (-half, half)]
    colour = " ".join(map(number, geometry.rgba))
    text = ""
    for shape, along in shapes:
        pose = geometry.body_from_geometry @ SE3.from_parts(np.eye(3), [0, 0, along])
        text += (
            f"    <visual>\n      {origin(pose)}\n"
            f"      <geometry>{shape}</geometry>\n"
            f'      <material name=""><color rgba="{colour}"/></material>\n'
            "    </visual>\n"
        )
    return text

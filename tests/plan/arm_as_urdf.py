"""The arm of a compiled cell as URDF, for arms whose joints turn at body origins."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from handeye_tri.exchange.urdf import roll_pitch_yaw
from handeye_tri.mechanism import Geometry, Mechanism
from handeye_tri.se3 import SE3


def origin(pose: SE3) -> str:
    xyz = " ".join(map(repr, pose.translation.tolist()))
    rpy = " ".join(map(repr, np.asarray(roll_pitch_yaw(pose.rotation)).tolist()))
    return f'<origin xyz="{xyz}" rpy="{rpy}"/>'


def collision(solid: Geometry) -> str:
    """URDF knows no capsule: a cylinder and two balls."""
    radius, half = (float(size) for size in solid.size)
    assert solid.shape in ("cylinder", "capsule")
    shapes = [(f'<cylinder radius="{radius}" length="{2 * half}"/>', 0.0)]
    if solid.shape == "capsule":
        shapes += [(f'<sphere radius="{radius}"/>', end) for end in (-half, half)]
    return "".join(
        "<collision>"
        + origin(solid.body_from_geometry @ SE3.from_parts(np.eye(3), [0, 0, along]))
        + f"<geometry>{shape}</geometry></collision>"
        for shape, along in shapes
    )


def write_urdf(mechanism: Mechanism, path: Path) -> None:
    """Links, joints with limits and speeds, solids, and the flange as a fixed link."""
    arm = mechanism.chain(mechanism.flange_body)
    arm = arm[arm.index(mechanism.base_body) :]
    names = [body.name for body in mechanism.bodies]
    parts = [
        f'<link name="{names[k]}">'
        + "".join(collision(g) for g in mechanism.geometries if g.body == k)
        + "</link>"
        for k in arm
    ]
    for k, body in enumerate(mechanism.bodies):
        parent, pose = names[body.parent], body.parent_from_body
        joints = [joint for joint in mechanism.joints if joint.body == k]
        for joint in joints:
            assert not joint.anchor.any()
            # All joints of a body but the last carry a link of their own.
            child = body.name if joint is joints[-1] else f"of_{joint.name}"
            if child != body.name:
                parts.append(f'<link name="{child}"/>')
            speed = f' velocity="{joint.speed}"' if np.isfinite(joint.speed) else ""
            axis = " ".join(map(repr, joint.axis.tolist()))
            parts.append(
                f'<joint name="{joint.name}" type="revolute">'
                f'<parent link="{parent}"/><child link="{child}"/>'
                f'{origin(pose)}<axis xyz="{axis}"/>'
                f'<limit lower="{joint.lower}" upper="{joint.upper}" effort="1"'
                f"{speed}/></joint>"
            )
            parent, pose = child, SE3.identity()
    parts += [
        f'<link name="{mechanism.flange}"/><joint name="mount" type="fixed">'
        f'<parent link="{names[mechanism.flange_body]}"/>'
        f'<child link="{mechanism.flange}"/>{origin(mechanism.body_from_flange)}'
        "</joint>"
    ]
    path.write_text(f'<robot name="arm">{"".join(parts)}</robot>')

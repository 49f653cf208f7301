from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest

from handeye_tri.arm import Arm
from handeye_tri.errors import InputError
from handeye_tri.mechanism import Body, Geometry, Joint, Mechanism
from handeye_tri.se3 import SE3, se3_exp, se3_inverse, so3_exp

NOTHING = np.zeros((0, 3))
NO_FACES = np.zeros((0, 3), dtype=np.int64)
IDENTITY = SE3.identity()


def at(x, y, z, turn=(0.0, 0.0, 0.0)):
    return SE3.from_parts(so3_exp(turn), (x, y, z))


def solid(name, body, shape, size, pose=IDENTITY, collides=True, vertices=NOTHING):
    faces = NO_FACES
    if len(vertices):
        faces = np.array([[0, 1, 2], [0, 3, 1], [0, 2, 3], [1, 3, 2]])
    return Geometry(
        name, body, shape, np.array(size, dtype=float), pose, vertices, faces,
        np.ones(4), collides,
    )  # fmt: skip


def hinge(name, body, axis, reference=0.0, anchor=(0, 0, 0), limit=2.9, kind="hinge"):
    axis = np.array(axis, dtype=float)
    return Joint(
        name, body, kind, np.array(anchor, dtype=float), axis / np.linalg.norm(axis),
        -limit, limit, reference, 3.0,
    )  # fmt: skip


def mechanism(joint_list, bodies, geometries, flange_body, markers=None, **more):
    arguments = {
        "base": "base", "flange": "flange", "base_body": 1,
        "flange_body": flange_body, "body_from_flange": at(0, 0, 0.05),
        "marker_body": flange_body, "touching": frozenset(),
    }  # fmt: skip
    arguments |= more
    markers = np.zeros((3, 3)) if markers is None else markers
    return Mechanism(
        tuple(bodies), tuple(joint_list), tuple(geometries), markers=markers,
        **arguments,
    )  # fmt: skip


def odd_arm():
    """Seven joints that try the conventions: anchors, references, a slide, tilted
    axes, two joints on one body, a jointless body, a side branch, a base that
    stands tilted, and a joint below the base that stays at its reference.
    """
    bodies = [
        Body("world", 0, IDENTITY),
        Body("base", 0, at(0.4, -0.2, 0.1, (0.1, 0.2, 0.9))),
        Body("one", 1, at(0, 0, 0.2)),
        Body("two", 2, at(0.05, 0, 0.1, (0.3, 0, 0))),
        Body("bracket", 3, at(0, 0.02, 0.1, (0, 0.4, 0))),
        Body("three", 4, at(0, 0, 0.15)),
        Body("side", 3, at(0.1, 0, 0)),
        Body("four", 5, at(0.02, 0, 0.1)),
        Body("five", 7, at(0, 0, 0.1, (0, 0, 0.5))),
        Body("tool", 8, at(0, 0.01, 0.03, (0.2, 0, 0))),
    ]
    joints = [
        hinge("side joint", 6, (0, 1, 0)),
        hinge("j1", 2, (0, 0, 1), reference=0.3),
        hinge("j2", 3, (0, 1, 0.2), anchor=(0.01, 0.02, 0.03)),
        hinge("j3", 3, (1, 0, 0), reference=-0.4, anchor=(0, 0, 0.05)),
        hinge("j4", 5, (0, 0, 1), limit=0.3, reference=0.1, kind="slide"),
        hinge("j5", 7, (1, 1, 0)),
        hinge("j6", 8, (0, -1, 0), anchor=(0, 0, -0.02)),
        hinge("j7", 8, (0, 0, 1)),
    ]
    markers = np.array([[0.05, 0, 0.04], [-0.05, 0.03, 0.04], [0, -0.06, 0.04]])
    return mechanism(joints, bodies, [], 9, markers)


def reference_pose(mech, body, q):
    """World pose of a body by the definition of the arrays, one factor at a time."""
    values = {m: v for m, v in zip(mech.arm_joints, q, strict=True)}
    pose = np.eye(4)
    for b in mech.chain(body):
        pose = pose @ mech.bodies[b].parent_from_body.matrix
        for index, joint in enumerate(mech.joints):
            if joint.body == b:
                moved = values.get(index, joint.reference) - joint.reference
                if joint.kind == "slide":
                    motion = se3_exp(np.append(moved * joint.axis, np.zeros(3)))
                else:
                    motion = se3_exp(np.append(np.zeros(3), moved * joint.axis))
                to_anchor = np.eye(4)
                to_anchor[:3, 3] = joint.anchor
                pose = pose @ to_anchor @ motion @ se3_inverse(to_anchor)
    return pose


@pytest.fixture(scope="module")
def odd():
    return Arm(odd_arm())


def draw(arm, n, seed=0):
    return np.random.default_rng(seed).uniform(arm.lower, arm.upper, (n, len(arm.home)))


def test_bodies_flange_and_markers_follow_the_arrays(odd):
    mech = odd.mechanism
    for q in draw(odd, 20):
        for body in range(len(mech.bodies)):
            np.testing.assert_allclose(
                odd.body_poses(q)[body], reference_pose(mech, body, q), atol=1e-13
            )
        base = se3_inverse(reference_pose(mech, 1, q))
        flange = reference_pose(mech, 9, q) @ mech.body_from_flange.matrix
        np.testing.assert_allclose(odd.forward(q), base @ flange, atol=1e-13)
        tool = base @ reference_pose(mech, 9, q)
        np.testing.assert_allclose(
            odd.marker_positions(q), mech.markers @ tool[:3, :3].T + tool[:3, 3],
            atol=1e-13,
        )  # fmt: skip


def test_batched_kinematics_agree_with_pinocchio(odd):
    q = draw(odd, 200)
    data = odd.model.createData()
    poses, flange = odd.body_poses(q), odd.forward(q)
    base = odd.base_from_world.matrix
    for k in range(len(q)):
        pin.framesForwardKinematics(odd.model, data, q[k])
        frames = [data.oMf[f + 1].homogeneous for f in range(odd.model.nframes - 1)]
        np.testing.assert_allclose(poses[k], frames[:-1], atol=1e-12)
        np.testing.assert_allclose(flange[k], base @ frames[-1], atol=1e-12)


def test_jacobian_is_pinocchios_in_the_flange_frame(odd):
    flange = odd.model.getFrameId("reported flange")
    data = odd.model.createData()
    for q in draw(odd, 20):
        expected = pin.computeFrameJacobian(
            odd.model, data, q, flange, pin.ReferenceFrame.LOCAL
        )
        np.testing.assert_allclose(odd.jacobian(q), expected, atol=1e-12)


def test_inverse_and_perturbed_work_in_the_base(odd):
    q = draw(odd, 200)
    target = odd.forward(q)
    found = odd.inverse(target, np.random.default_rng(1)).joints
    assert np.mean([len(joints) > 0 for joints in found]) >= 0.995
    for joints, pose in zip(found, target, strict=True):
        np.testing.assert_allclose(
            odd.forward(joints), np.broadcast_to(pose, (len(joints), 4, 4)), atol=1e-9
        )
    tangent = np.full(6, 1e-4)
    np.testing.assert_allclose(
        odd.forward(odd.perturbed(q[0], tangent)), target[0] @ se3_exp(tangent),
        atol=1e-10,
    )  # fmt: skip


def test_names_limits_and_home_are_in_chain_order(odd):
    assert odd.joint_names == ("j1", "j2", "j3", "j4", "j5", "j6", "j7")
    assert odd.upper[3] == 0.3
    assert odd.home[:4] == pytest.approx([0.3, 0, -0.4, 0.1])


def planar(geometries, touching=frozenset(), **more):
    """Two 0.5 m links in the horizontal plane, then a spinning tool at their end."""
    bodies = [
        Body("world", 0, IDENTITY),
        Body("base", 0, IDENTITY),
        Body("upper", 1, at(0, 0, 0.3)),
        Body("lower", 2, at(0.5, 0, 0)),
        Body("spin", 3, at(0.5, 0, 0)),
    ]
    joints = [
        hinge("a", 2, (0, 0, 1)),
        hinge("b", 3, (0, 0, 1), limit=3.1),
        hinge("c", 4, (1, 0, 0), limit=6.0),
    ]
    return mechanism(joints, bodies, geometries, 4, touching=touching, **more)


POST = solid("post", 1, "cylinder", (0.05, 0.15), at(0, 0, 0.15))
UPPER = solid(
    "upper link", 2, "capsule", (0.03, 0.2), at(0.25, 0, 0, (0, np.pi / 2, 0))
)
LOWER = solid(
    "lower link", 3, "capsule", (0.03, 0.2), at(0.25, 0, 0, (0, np.pi / 2, 0))
)
TOOL = solid("tool", 4, "sphere", (0.05,))


@pytest.mark.parametrize(
    ("shape", "size"),
    [
        ("box", (0.05, 0.05, 0.05)),
        ("sphere", (0.05,)),
        ("cylinder", (0.05, 0.05)),
        ("capsule", (0.05, 0.05)),
        ("ellipsoid", (0.05, 0.08, 0.05)),
        ("mesh", ()),
    ],
)
def test_collision_begins_where_the_shapes_meet(shape, size):
    """An obstacle whose near side is 50 mm from its centre, met along x."""
    corners = 0.05 * np.array([[-1, 0, 0], [1, 1, 1], [1, -1, 1], [1, 0, -1]])
    corners = corners if shape == "mesh" else NOTHING
    for gap, hit in ((1e-3, False), (-1e-3, True)):
        obstacle = solid(
            "obstacle", 0, shape, size, at(1.1 + gap, 0, 0.3), vertices=corners
        )
        arm = Arm(planar([TOOL, obstacle]), clearance=0.0)
        expected = ("tool", "obstacle") if hit else None
        assert arm.collision([0, 0, 0]) == expected
        assert arm.collision([1.0, 0, 0]) is None


def test_a_plane_is_solid_below():
    floor = solid("floor", 0, "plane", ())
    assert Arm(planar([TOOL, floor])).collision([0, 0, 0]) is None
    high = solid("floor", 0, "plane", (), at(0, 0, 0.26))
    # Flat arm: it touches the floor at every angle, which is then not checked.
    arm = Arm(planar([TOOL, high]))
    assert arm.always_touching == (("tool", "floor"),)
    assert arm.collision([0, 0, 0]) is None


def test_clearance_counts_as_collision():
    wall = solid("wall", 0, "box", (0.1, 1, 1), at(1.154, 0, 0.3))
    mech = planar([TOOL, wall])
    assert Arm(mech, clearance=0.003).collision([0, 0, 0]) is None
    assert Arm(mech, clearance=0.005).collision([0, 0, 0]) == ("tool", "wall")


def test_neighbours_do_not_collide_but_others_do():
    """Folded back by 178 degrees, the lower link lies along the upper one."""
    folded = [0, 3.1, 0]
    assert Arm(planar([UPPER, LOWER])).collision(folded) is None
    assert Arm(planar([POST, LOWER])).collision(folded) == ("post", "lower link")
    assert Arm(planar([POST, LOWER])).collision([0, 0, 0]) is None
    excluded = planar([POST, LOWER], touching=frozenset({(1, 3)}))
    assert Arm(excluded).collision(folded) is None


def test_the_first_link_meets_the_table_though_both_hang_on_the_world():
    table = solid("box", 0, "box", (0.1, 0.1, 0.5), at(0, 0.4, 0))
    arm = Arm(planar([POST, UPPER, table]))
    assert arm.collision([0, 0, 0]) is None
    assert arm.collision([np.pi / 2, 0, 0]) == ("upper link", "box")


def test_what_does_not_collide_is_not_checked():
    ghost = solid("ghost", 0, "box", (1, 1, 1), collides=False)
    assert Arm(planar([TOOL, ghost])).collision([0, 0, 0]) is None


def test_paths_meet_what_lies_between_free_ends():
    """A thin bar between two free ends, met anywhere along the sweep."""
    for angle in np.radians([20.0, 43.0, 61.7]):
        bar = solid(
            "bar", 0, "cylinder", (0.002, 0.5),
            at(0.9 * np.cos(angle), 0.9 * np.sin(angle), 0.3),
        )  # fmt: skip
        arm = Arm(planar([UPPER, LOWER, bar]), clearance=0.002)
        start, end = [0.0, 0.0, 0.0], [1.5, 0.0, 0.0]
        assert arm.collision(start) is None
        assert arm.collision(end) is None
        assert arm.path_collision(start, end) == ("lower link", "bar")
        assert arm.path_collision(end, [1.5, 0.0, 3.0]) is None


RADIUS = 0.01
CAMERA = np.array([2.0, 0.0, 0.3])
MARKERS = np.array([[0.1, 0, 0], [0, 0.1, 0], [0, -0.1, 0]])


def watched(*more, rods=()):
    """Markers of 10 mm on the tool; marker A is at x = 1.1 m, 0.9 m from CAMERA."""
    balls = [
        solid(f"marker {n}", 4, "sphere", (RADIUS,), at(*p))
        for n, p in zip("ABC", MARKERS, strict=True)
    ]
    return Arm(planar([*balls, *rods, *more], markers=MARKERS))


def blocker(arm, q=(0, 0, 0), marker=0, radius=RADIUS):
    return arm.sight_blocked(q, CAMERA, marker, radius)


def test_a_free_marker_is_seen():
    arm = watched()
    assert [blocker(arm, marker=k) for k in range(3)] == [None] * 3


def test_the_cone_ends_where_the_tangents_do():
    """A ball beside the line of sight: distance of its centre from the cone's side.

    The cone from the camera (d = 0.9 m, r = 10 mm) opens by asin(r / d). A ball of
    radius b whose centre has distance h from the cone's surface touches at h = b.
    """
    half = np.arcsin(RADIUS / 0.9)
    for depth in (0.1, 0.4, 0.8):
        for over, hidden in ((1e-4, False), (-1e-4, True)):
            lateral = (depth * np.sin(half) + 0.02 + over) / np.cos(half)
            ball = solid("ball", 0, "sphere", (0.02,), at(2.0 - depth, lateral, 0.3))
            assert blocker(watched(ball)) == ("ball" if hidden else None)


def test_what_is_behind_the_camera_or_the_marker_hides_nothing():
    housing = solid("housing", 0, "box", (0.03, 0.03, 0.03), at(2.03, 0, 0.3))
    wall = solid("wall", 0, "box", (0.01, 1, 1), at(1.08, 0, 0.3), collides=False)
    assert blocker(watched(housing)) is None
    assert blocker(watched(wall)) is None
    ahead = solid("wall", 0, "box", (0.01, 1, 1), at(1.13, 0, 0.3), collides=False)
    assert blocker(watched(ahead)) == "wall"


def test_another_marker_hides():
    arm = watched()
    camera = np.array([1.0, 2.0, 0.3])
    assert arm.sight_blocked((0, 0, 0), camera, 2, RADIUS) == "marker B"
    assert arm.sight_blocked((0, 0, 0), camera, 1, RADIUS) is None


def test_a_holder_may_come_from_behind_and_not_from_the_front():
    along = (0, np.pi / 2, 0)
    for end, hides in ((-0.02, None), (0.02, "rod")):
        rod = solid("rod", 4, "capsule", (0.003, 0.02), at(0.1 + end, 0, 0, along))
        assert blocker(watched(rods=[rod])) == hides


def test_a_holder_from_the_side_hides_when_it_leans_to_the_camera():
    """A 2 mm rod through the ball's centre, leaning by an angle from sideways."""
    for degrees, hides in ((-15.0, None), (15.0, "rod")):
        lean = np.radians(degrees)
        # The rod's axis is its z: first along y, then tilted towards +x by lean.
        turn = so3_exp([0, 0, -lean]) @ so3_exp([-np.pi / 2, 0, 0])
        middle = np.array([0.1, 0, 0]) + 0.03 * turn[:, 2]
        rod = solid("rod", 4, "capsule", (0.002, 0.03), SE3.from_parts(turn, middle))
        assert blocker(watched(rods=[rod])) == hides


def test_sight_follows_the_arm():
    post = solid("post", 0, "cylinder", (0.02, 1.0), at(1.5, 0, 0))
    arm = watched(post)
    assert blocker(arm) == "post"
    assert blocker(arm, q=(0.3, 0, 0)) is None


def test_a_camera_in_the_marker_is_refused():
    with pytest.raises(InputError, match="move the camera away"):
        watched().sight_blocked((0, 0, 0), (1.1, 0, 0.3), 0, RADIUS)

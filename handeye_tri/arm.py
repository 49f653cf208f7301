"""The arm in its cell: kinematics, collisions and lines of sight.

The only module that talks to Pinocchio. Its model is built from the arrays of a
:class:`~handeye_tri.mechanism.Mechanism`, so that it agrees with the simulator for
any robot. Batched kinematics run in numpy on the placements of that model
(kinematics); shapes and cones of sight are coal's (solids.py).
"""

from __future__ import annotations

from itertools import combinations
from typing import Any

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike, NDArray

from handeye_tri.kinematics import InverseKinematics, InverseSolutions, SerialChain
from handeye_tri.mechanism import Geometry, Mechanism
from handeye_tri.se3 import SE3
from handeye_tri.solids import (
    SightCone,
    bounding_radius,
    coal_shape,
    frame_along,
    touch,
    transform,
)

Floats = NDArray[np.float64]

# Configurations that decide whether two solids touch at every angle.
_OVERLAP_SAMPLES = 64
# Speed of a joint whose model gives none, rad/s or m/s: slow for any arm.
UNKNOWN_SPEED = 1.0


class Arm:
    """A serial arm with all that surrounds it.

    Attributes:
        mechanism: The compiled cell.
        joint_names: Names of the arm's q joints, from the base outward.
        lower: Lower limits, shape (q,), rad or m; -inf where there is none.
        upper: Upper limits, shape (q,), rad or m; inf where there is none.
        home: The model's reference configuration, within the limits, shape (q,).
        slides: Which joints slide (else they turn), shape (q,).
        speed: Speed limits, shape (q,), rad/s or m/s; 1 where the model has none.
        without_speed: Names of the joints whose model has none.
        base_from_world: The base that poses refer to.
        clearance: Solids nearer than this to each other count as colliding, m.
        on_flange: Names of the solids that ride with the flange.
        always_touching: Pairs of solids that are not checked against each other
            since they touch at every one of many random configurations.
        model: The Pinocchio model, one frame for every body and the flange.
    """

    def __init__(self, mechanism: Mechanism, clearance: float = 0.005) -> None:
        """Build the engines' models.

        Args:
            mechanism: The compiled cell; joints outside the chain from base to
                flange stay at their references.
            clearance: Distance below which two solids count as colliding, metres.

        Raises:
            InputError: no joint lies between base and flange.
        """
        self.mechanism = mechanism
        self.clearance = clearance
        indices = mechanism.arm_joints
        joints = [mechanism.joints[i] for i in indices]
        self.joint_names = tuple(joint.name for joint in joints)
        self.lower = np.array([joint.lower for joint in joints])
        self.upper = np.array([joint.upper for joint in joints])
        self.home = np.clip([j.reference for j in joints], self.lower, self.upper)
        self.slides = np.array([joint.kind == "slide" for joint in joints])
        speed = np.array([joint.speed for joint in joints])
        self.speed = np.where(np.isfinite(speed), speed, UNKNOWN_SPEED)
        self.without_speed = tuple(j.name for j in joints if not np.isfinite(j.speed))
        # Per body: the Pinocchio joint that carries it, and its pose there.
        self._carrier: list[int] = []
        self._carried: list[SE3] = []
        self.model = self._build_model(set(indices))
        self._data = self.model.createData()
        base = mechanism.base_body
        self.base_from_world = self._carried[base].inverse()
        placements = np.array([m.homogeneous for m in self.model.jointPlacements][1:])
        self._chain = SerialChain(
            placements,
            self.slides,
            (self._carried[mechanism.flange_body] @ mechanism.body_from_flange).matrix,
            self.lower,
            self.upper,
        )
        self._inverse = InverseKinematics(self._chain)
        self._solids = self._build_solids()
        self._solid_data = self._solids.createData()
        self._place_solids(self.home)
        self._bounds = np.array([bounding_radius(g) for g in mechanism.geometries])
        self.on_flange = frozenset(
            g.name
            for g in mechanism.geometries
            if self._carrier[g.body] == self._carrier[mechanism.flange_body]
        )
        self._levers = self._longest_levers()
        self._marker_solid, self._holders = self._find_markers()
        self.always_touching = self._pair_up()
        self._collision_data = self._solids.createData()
        for request in self._collision_data.collisionRequests:
            request.security_margin = clearance

    # -- the model -----------------------------------------------------------

    def _build_model(self, moving: set[int]) -> pin.Model:
        """One z joint per arm joint; every body and the flange as frames."""
        mechanism, model = self.mechanism, pin.Model()
        for index, body in enumerate(mechanism.bodies):
            if index == 0:
                carrier, pose = 0, SE3.identity()
            else:
                carrier = self._carrier[body.parent]
                pose = self._carried[body.parent] @ body.parent_from_body
            for number, joint in enumerate(mechanism.joints):
                if joint.body != index or number not in moving:
                    continue
                body_from_joint = SE3.from_parts(frame_along(joint.axis), joint.anchor)
                slide = joint.kind == "slide"
                shift = np.array([0.0, 0.0, -joint.reference, 0.0, 0.0, 0.0])
                at_zero = SE3.exp(shift if slide else np.roll(shift, 3))
                placement = pose @ body_from_joint @ at_zero
                carrier = model.addJoint(
                    carrier,
                    pin.JointModelPZ() if slide else pin.JointModelRZ(),
                    pin.SE3(placement.matrix),
                    joint.name,
                    np.array([np.inf]),
                    np.array([joint.speed]),
                    np.array([joint.lower]),
                    np.array([joint.upper]),
                )
                pose = body_from_joint.inverse()
            self._carrier.append(carrier)
            self._carried.append(pose)
            self._add_frame(model, body.name or f"body {index}", carrier, pose)
        flange = mechanism.flange_body
        self._add_frame(
            model,
            "reported flange",
            self._carrier[flange],
            self._carried[flange] @ mechanism.body_from_flange,
        )
        return model

    @staticmethod
    def _add_frame(model: pin.Model, name: str, joint: int, pose: SE3) -> None:
        model.addFrame(
            pin.Frame(name, joint, 0, pin.SE3(pose.matrix), pin.FrameType.OP_FRAME)
        )

    # -- kinematics ----------------------------------------------------------

    def forward(self, q: ArrayLike) -> Floats:
        """``base_from_flange``, shape (..., 4, 4), of joints (..., q)."""
        return np.asarray(self.base_from_world.matrix @ self._chain.forward(q))

    def body_poses(self, q: ArrayLike) -> Floats:
        """``world_from_body`` of every body, shape (..., bodies, 4, 4)."""
        rotations, origins = self._chain.joint_frames(q)
        batch = rotations.shape[:-3]
        frames = np.zeros((*batch, len(self.joint_names) + 1, 4, 4))
        frames[..., 0, :, :] = np.eye(4)
        frames[..., 1:, :3, :3] = rotations
        frames[..., 1:, :3, 3] = origins
        frames[..., 1:, 3, 3] = 1.0
        carried = np.array([pose.matrix for pose in self._carried])
        return np.asarray(frames[..., self._carrier, :, :] @ carried)

    def marker_positions(self, q: ArrayLike) -> Floats:
        """A, B, C in the base, shape (..., 3, 3), metres, of joints (..., q)."""
        body = self.mechanism.marker_body
        poses = self.base_from_world.matrix @ self.body_poses(q)[..., body, :, :]
        turned = self.mechanism.markers @ np.swapaxes(poses[..., :3, :3], -1, -2)
        return np.asarray(turned + poses[..., None, :3, 3])

    def jacobian(self, q: ArrayLike) -> Floats:
        """Derivative of the flange's right perturbation by the joints.

        ``forward(q + dq) ~ forward(q) @ exp(jacobian @ dq)``.

        Args:
            q: Shape (..., q), rad or m.

        Returns:
            Shape (..., 6, q): rows translation (m) and rotation (rad).
        """
        return self._chain.jacobian(q)

    def inverse(
        self,
        base_from_flange: ArrayLike,
        rng: np.random.Generator,
        *,
        starts: int = 48,
        first: bool = False,
    ) -> InverseSolutions:
        """Joints that reach flange poses, (n, 4, 4); see InverseKinematics."""
        targets = np.asarray(base_from_flange, dtype=float).reshape(-1, 4, 4)
        world = self.base_from_world.inverse().matrix @ targets
        return self._inverse.solve(world, rng, starts=starts, first=first)

    def perturbed(self, q: ArrayLike, tangent: ArrayLike) -> Floats:
        """Joints with ``forward(result) == forward(q) @ exp(tangent)``.

        Args:
            q: Shape (..., q), rad or m.
            tangent: Shape (..., 6), metres and radians; small.

        Raises:
            ConvergenceError: the displaced pose is out of reach.
        """
        return self._chain.perturbed(q, tangent)

    # -- solids --------------------------------------------------------------

    def _build_solids(self) -> pin.GeometryModel:
        """All solids of the cell, in the order of the mechanism; no pairs yet."""
        solids = pin.GeometryModel()
        for index, geometry in enumerate(self.mechanism.geometries):
            pose = self._carried[geometry.body] @ geometry.body_from_geometry
            solids.addGeometryObject(
                pin.GeometryObject(
                    f"{index} {geometry.name}",
                    self._carrier[geometry.body],
                    pin.SE3(pose.matrix),
                    coal_shape(geometry),
                )
            )
        return solids

    def _place_solids(self, q: Floats) -> Floats:
        """Move the solids to a configuration; returns their centres, (g, 3)."""
        pin.updateGeometryPlacements(
            self.model, self._data, self._solids, self._solid_data, q
        )
        return np.array([m.translation for m in self._solid_data.oMg]).reshape(-1, 3)

    def _find_markers(self) -> tuple[list[int | None], list[set[int]]]:
        """The solid of each marker, and the solids that hold it (touch it)."""
        mechanism = self.mechanism
        mine = [
            (index, g.body_from_geometry.translation)
            for index, g in enumerate(mechanism.geometries)
            if g.shape == "sphere" and g.body == mechanism.marker_body
        ]
        solids: list[int | None] = []
        holders: list[set[int]] = []
        for marker in mechanism.markers:
            here = [i for i, centre in mine if np.linalg.norm(centre - marker) < 1e-6]
            solids.append(here[0] if here else None)
            carrier = self._carrier[mechanism.marker_body]
            holders.append(
                {
                    other
                    for other, g in enumerate(mechanism.geometries)
                    if here
                    and other not in here
                    and self._carrier[g.body] == carrier
                    and touch(*self._solid(here[0]), *self._solid(other))
                }
            )
        return solids, holders

    def _solid(self, index: int) -> tuple[Any, Any]:
        """A solid's coal shape and where it was last placed."""
        pose = self._solid_data.oMg[index]
        shape = self._solids.geometryObjects[index].geometry
        return shape, transform(pose.rotation, pose.translation)

    def _pair_up(self) -> tuple[tuple[str, str], ...]:
        """Choose the pairs to check; returns those that touch at every angle."""
        geometries = self.mechanism.geometries
        for first, second in combinations(range(len(geometries)), 2):
            if self._may_collide(geometries[first], geometries[second]):
                self._solids.addCollisionPair(pin.CollisionPair(first, second))
        pairs = list(self._solids.collisionPairs)
        data = self._solids.createData()
        for request in data.collisionRequests:
            request.security_margin = self.clearance
        apart = np.zeros(len(pairs), dtype=bool)
        samples = self._chain.random(np.random.default_rng(0), _OVERLAP_SAMPLES)
        for q in samples:
            pin.computeCollisions(self.model, self._data, self._solids, data, q, False)
            apart |= ~np.array(
                [result.isCollision() for result in data.collisionResults], dtype=bool
            )
        touching = []
        for pair, free in zip(pairs, apart, strict=True):
            if not free:
                touching.append(self._names(pair))
                self._solids.removeCollisionPair(pair)
        return tuple(touching)

    def _may_collide(self, first: Geometry, second: Geometry) -> bool:
        """Whether two solids move against each other and are not neighbours."""
        if not (first.collides and second.collides):
            return False
        bodies = sorted((first.body, second.body))
        carriers = sorted(self._carrier[body] for body in bodies)
        if carriers[0] == carriers[1]:
            return False
        touching = self.mechanism.touching
        if (bodies[0], bodies[1]) in touching or (bodies[1], bodies[0]) in touching:
            return False
        if self.model.parents[carriers[1]] != carriers[0]:
            return True
        if carriers[0] != 0:
            return False
        # What stands still and carries the first joint is its neighbour; the
        # table and whatever else stands in the cell is not.
        still, moving = bodies if self._carrier[bodies[0]] == 0 else bodies[::-1]
        return still not in self.mechanism.chain(moving)

    def _names(self, pair: pin.CollisionPair) -> tuple[str, str]:
        geometries = self.mechanism.geometries
        return geometries[pair.first].name, geometries[pair.second].name

    def collision(self, q: ArrayLike) -> tuple[str, str] | None:
        """Names of two solids nearer than the clearance, or None.

        Args:
            q: Shape (q,), rad or m.
        """
        data = self._collision_data
        values = np.asarray(q, dtype=float)
        if not pin.computeCollisions(
            self.model, self._data, self._solids, data, values, True
        ):
            return None
        for pair, result in zip(
            self._solids.collisionPairs, data.collisionResults, strict=True
        ):
            if result.isCollision():
                return self._names(pair)
        raise AssertionError("Pinocchio reports a collision without a pair")

    def path_collision(
        self, start: ArrayLike, end: ArrayLike
    ) -> tuple[str, str] | None:
        """Collision on the straight joint path, or None where it is free.

        Samples so densely that between two of them no point of the arm moves
        farther than twice the clearance: what is free at the samples, with
        clearance, is free in between.

        Args:
            start: Shape (q,), rad or m.
            end: Shape (q,), rad or m.
        """
        first, last = np.asarray(start, dtype=float), np.asarray(end, dtype=float)
        travel = float(np.abs(last - first) @ self._levers)
        steps = max(1, int(np.ceil(travel / (2 * max(self.clearance, 1e-3)))))
        # Ends first, then coarse to fine: obstacles are met early.
        for fraction in _halving(steps):
            hit = self.collision(first + fraction * (last - first))
            if hit is not None:
                return hit
        return None

    def _longest_levers(self) -> Floats:
        """Farthest that a point of the arm moves per radian (or metre), (q,)."""
        geometries, placements = self.mechanism.geometries, self._chain.placements
        bounds = self._bounds + [
            np.linalg.norm((self._carried[g.body] @ g.body_from_geometry).translation)
            for g in geometries
        ]
        carriers = np.array([self._carrier[g.body] for g in geometries])
        travel = np.maximum(np.abs(self.lower), np.abs(self.upper))
        travel = np.where(self._chain.slides & np.isfinite(travel), travel, 0.0)
        levers = np.zeros(len(travel))
        beyond = 0.0
        for i in reversed(range(len(levers))):
            levers[i] = max(beyond, *bounds[carriers == i + 1], 0.0)
            beyond = levers[i] + np.linalg.norm(placements[i, :3, 3]) + travel[i]
        return np.where(self._chain.slides, 1.0, levers)

    # -- lines of sight ------------------------------------------------------

    def sight_blocked(
        self, q: ArrayLike, camera_position: ArrayLike, marker: int, radius: float
    ) -> str | None:
        """What hides a marker from a camera.

        The sight cone has its apex at the camera and the marker's outline, the
        circle where the tangents touch the sphere, as its base. Other markers
        block. What holds the marker (touches it) may enter its sphere, and is
        tested against the part of the cone before the sphere and the cone's side.

        Args:
            q: Shape (q,), rad or m.
            camera_position: Optical centre in the world, shape (3,), metres.
            marker: 0, 1 or 2 for A, B, C.
            radius: Radius of the sphere to see whole, metres; larger than the
                marker's own where its surroundings shall stay clear, too.

        Returns:
            Name of a solid that enters the cone, or None.

        Raises:
            InputError: the camera is within the sphere.
        """
        values = np.asarray(q, dtype=float)
        centres = self._place_solids(values)
        apex = np.asarray(camera_position, dtype=float)
        body = self.mechanism.marker_body
        carried = self._carried[body].matrix @ np.append(
            self.mechanism.markers[marker], 1.0
        )
        centre = self._data.oMi[self._carrier[body]].act(carried[:3])
        cone = SightCone(apex, centre, radius)
        for index in cone.near(centres, self._bounds):
            if index == self._marker_solid[marker]:
                continue
            holder = index in self._holders[marker]
            enters = cone.entered_by_holder if holder else cone.entered_by
            if enters(*self._solid(int(index))):
                return self.mechanism.geometries[int(index)].name
        return None


def _halving(steps: int) -> Floats:
    """Fractions k / steps, k = 0 .. steps: ends, middle, quarters, ..."""
    inner = sorted(range(1, steps), key=lambda k: -(k & -k))
    return np.array([0, steps, *inner]) / steps

"""Candidates for stations: poses that pass every check, one by one."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from handeye_tri.arm import Arm
from handeye_tri.plan.poses import HALF_TURN, View

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]

# Poses drawn at once, and at most, until enough pass.
_BATCH = 400
_MOST_POSES = 12000
# A cell in which none of this many poses passes has no plan.
_HOPELESS = 1200
# Inverse solutions of a pose that are tried, nearest to those before first.
_SOLUTIONS = 4
_STARTS = 9
# The sphere to see whole is larger than the marker by this factor: blur and the
# detector's window reach beyond the outline.
SIGHT_MARGIN = 1.15
_BY_RIG = "occlusion by the rig"
# Two flange poses are one if they differ by less (m and rad).
_SAME_POSE = 1e-9


@dataclass(frozen=True, slots=True, eq=False)
class Prospect:
    """A place that the cameras see and the arm reaches; solids are not looked at.

    Attributes:
        base_from_flange: Shape (s, 4, 4), metres: s = 2 before and after a
            half-turn, else 1.
        seen: Which cameras have all markers well in their images, shape (m,).
        before: Joints by solution, shape (k, q), rad or m.
        after: For each of them those after the half-turn, shapes (t, q); empty
            for a single station.
    """

    base_from_flange: Floats
    seen: Flags
    before: Floats
    after: tuple[Floats, ...]


@dataclass(frozen=True, slots=True, eq=False)
class Candidate:
    """A place for one station, or for the two of a half-turn, free of solids.

    Attributes:
        joints: Shape (s, q), rad or m: s = 2 before and after a half-turn, else 1.
        base_from_flange: Shape (s, 4, 4), metres.
        normal: Unit normal of the triangle in the world, shape (3,).
        seen: Which cameras see all markers, nothing between, shape (m,).
    """

    joints: Floats
    base_from_flange: Floats
    normal: Floats
    seen: Flags

    def turned_round(self) -> Candidate:
        """The same driven the other way."""
        return Candidate(
            self.joints[::-1], self.base_from_flange[::-1], self.normal, self.seen
        )


class CandidateSearch:
    """Draws poses and keeps those that pass; counts the others by check.

    Attributes:
        rejected: Rejected poses by the check that rejected them.
        drawn: Poses drawn.
    """

    def __init__(
        self,
        view: View,
        arm: Arm,
        rng: np.random.Generator,
        rejected: Counter[str] | None = None,
    ) -> None:
        """Start a search.

        Args:
            view: Cameras and rig.
            arm: The robot in its cell.
            rng: What poses are drawn from.
            rejected: Counts on from there.
        """
        self._view = view
        self._arm = arm
        self._rng = rng
        self._anchor = arm.home
        self.rejected: Counter[str] = Counter() if rejected is None else rejected
        self.drawn = 0

    def find(self, wanted: int, *, turns: bool) -> list[Candidate]:
        """Search until enough candidates are found or hope is lost.

        Args:
            wanted: How many.
            turns: Whether a candidate is a half-turn (else one station).

        Returns:
            Up to ``wanted`` candidates, in the order drawn.
        """
        found: list[Candidate] = []
        while len(found) < wanted and self.drawn < _MOST_POSES:
            if not found and self.drawn >= _HOPELESS:
                break
            for prospect in self._solved(turns):
                candidate = self.first_free(prospect)
                if candidate is not None:
                    found.append(candidate)
                if len(found) == wanted:
                    break
        return found

    def prospects(
        self, wanted: int, progress: Callable[[int], None] | None = None
    ) -> list[Prospect]:
        """Half-turns that the cameras see and the arm reaches.

        Args:
            wanted: How many.
            progress: Told how many there are, after each batch.

        Returns:
            Up to ``wanted``, in the order drawn.
        """
        found: list[Prospect] = []
        while len(found) < wanted and self.drawn < _MOST_POSES:
            if not found and self.drawn >= _HOPELESS:
                break
            found += self._solved(turns=True)
            if progress is not None:
                progress(min(len(found), wanted))
        return found[:wanted]

    def _solved(self, turns: bool) -> list[Prospect]:
        """Those of a batch of poses that pass the checks without solids."""
        view, arm = self._view, self._arm
        poses = view.draw(self._rng, _BATCH)
        self.drawn += len(poses)
        seen = np.ones((len(poses), len(view.cameras)), dtype=bool)
        for name, check in (("tilt", view.tilt_allowed), ("image", view.in_image)):
            seen &= check(poses)
            if turns:
                seen &= check(poses @ HALF_TURN)
            passed = seen.sum(axis=1) >= view.required
            self.rejected[name] += int((~passed).sum())
            poses, seen = poses[passed], seen[passed]
        if len(poses) == 0:
            return []
        targets = arm.base_from_world.matrix @ poses
        before = arm.inverse(targets, self._rng, starts=_STARTS)
        solved = np.array([len(joints) > 0 for joints in before.joints], dtype=bool)
        beyond = int((~solved & before.beyond_limits).sum())
        self.rejected["limits"] += beyond
        self.rejected["reach"] += int((~solved).sum()) - beyond
        places = np.flatnonzero(solved)
        joints = [before.joints[k] for k in places]
        if not turns:
            return [
                Prospect(targets[k][None], seen[k], q, ())
                for k, q in zip(places, joints, strict=True)
            ]
        possible = [
            Prospect(
                np.stack([targets[k], targets[k] @ HALF_TURN]), seen[k], q, tuple(after)
            )
            for k, q, after in zip(places, joints, self._turned(joints), strict=True)
            if any(len(ends) for ends in after)
        ]
        self.rejected["half_turn"] += len(places) - len(possible)
        return possible

    def _turned(self, poses: list[Floats]) -> list[list[Floats]]:
        """Joints after the half-turn, for each solution (s, q) of each pose.

        The last joint turns where its axis is the flange's and its limits allow;
        otherwise inverse kinematics, and the solution nearest to the one before.
        """
        arm = self._arm
        result = [self._by_last_joint(joints) for joints in poses]
        missing = [k for k, after in enumerate(result) if not any(map(len, after))]
        if missing:
            targets = np.array([arm.forward(poses[k][0]) @ HALF_TURN for k in missing])
            found = arm.inverse(targets, self._rng, starts=_STARTS).joints
            for k, others in zip(missing, found, strict=True):
                result[k] = [
                    others[np.argsort(np.linalg.norm(others - q, axis=1))[:1]]
                    for q in poses[k]
                ]
        return result

    def _by_last_joint(self, joints: Floats) -> list[Floats]:
        """The last joint turned by pi either way, where that is a half-turn."""
        arm = self._arm
        tries = np.repeat(joints[:, None], 2, axis=1)
        tries[..., -1] += (-np.pi, np.pi)
        target = arm.forward(joints)[:, None] @ HALF_TURN
        off = np.abs(arm.forward(tries) - target).max(axis=(-1, -2))
        inside = ((tries >= arm.lower) & (tries <= arm.upper)).all(axis=-1)
        usable = (off < _SAME_POSE) & inside
        return [
            turned[keep][np.argsort(np.abs(turned[keep][:, -1]), kind="stable")]
            for turned, keep in zip(tries, usable, strict=True)
        ]

    def first_free(self, prospect: Prospect) -> Candidate | None:
        """The first solution that no solid forbids; else count what forbade it.

        Solutions nearest to the last free one come first.
        """
        before = prospect.before
        order = np.argsort(np.linalg.norm(before - self._anchor, axis=1))
        reasons: list[str] = []
        for k in order[:_SOLUTIONS]:
            for joints in _joints(prospect, k):
                seen, reason = self._judged(joints, prospect.seen)
                if reason is None:
                    self._anchor = joints[-1]
                    return self._candidate(prospect, joints, seen)
                reasons.append(reason)
                if reason == _BY_RIG:
                    # The rig hides its own marker: so it does in every solution.
                    self.rejected["occlusion"] += 1
                    return None
        # The solution that came farthest speaks for the pose.
        checks = ("half_turn", "occlusion", "collision", "turn_path")
        self.rejected[max(reasons, key=checks.index, default="half_turn")] += 1
        return None

    def all_free(self, prospect: Prospect) -> list[Candidate]:
        """Every solution that no solid forbids."""
        found = []
        for k in range(len(prospect.before)):
            for joints in _joints(prospect, k):
                seen, reason = self._judged(joints, prospect.seen)
                if reason is None:
                    found.append(self._candidate(prospect, joints, seen))
        return found

    def _candidate(self, prospect: Prospect, joints: Floats, seen: Flags) -> Candidate:
        world = self._arm.base_from_world.inverse().matrix
        normal = self._view.normals(world @ prospect.base_from_flange[:1])[0]
        return Candidate(joints, self._arm.forward(joints), normal, seen)

    def _judged(self, joints: Floats, seen: Flags) -> tuple[Flags, str | None]:
        """Cameras left with a free sight, and the check that joints (s, q) fail."""
        arm, view = self._arm, self._view
        free, reason = seen.copy(), "occlusion"
        for i in np.flatnonzero(seen):
            blocker = self._blocker(joints, view.world_from_camera[i, :3, 3])
            if blocker is not None:
                free[i] = False
                reason = _BY_RIG if blocker in arm.on_flange else "occlusion"
            if free.sum() < view.required:
                return free, reason
        if any(arm.collision(q) is not None for q in joints):
            return free, "collision"
        if len(joints) == 2 and arm.path_collision(*joints) is not None:
            return free, "turn_path"
        return free, None

    def _blocker(self, joints: Floats, camera: Floats) -> str | None:
        """Name of a solid that hides a marker from a camera, or None."""
        for q in joints:
            for marker, radius in enumerate(SIGHT_MARGIN * self._view.radii):
                blocker = self._arm.sight_blocked(q, camera, marker, radius)
                if blocker is not None:
                    return blocker
        return None


def _joints(prospect: Prospect, solution: int) -> list[Floats]:
    """Joints (s, q) of a solution: one for each way to turn."""
    start = prospect.before[solution]
    if not prospect.after:
        return [start[None]]
    return [np.stack([start, end]) for end in prospect.after[solution]]

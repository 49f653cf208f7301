"""Candidates for stations: poses that pass every check, one by one."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace

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
# Starts of inverse kinematics: to learn whether a pose is reached, and by what.
_STARTS = 9
_MORE_STARTS = 48
# Solutions closer than this in every joint are one, rad or m.
_SAME_JOINTS = 1e-4
# The sphere to see whole is larger than the marker by this factor: blur and the
# detector's window reach beyond the outline.
SIGHT_MARGIN = 1.15
# Two flange poses are one if they differ by less (m and rad).
_SAME_POSE = 1e-9


@dataclass(frozen=True, slots=True, eq=False)
class Prospect:
    """A place that the cameras see and the arm reaches; solids are not looked at.

    Attributes:
        base_from_flange: Shape (s, 4, 4), metres: s = 2 before and after a
            half-turn, else 1.
        seen: Which cameras have all markers well in their images, shape (m,).
        joints: Joints at the stations by solution, shape (k, s, q), rad or m.
        mount: Which mount holds the triangle there.
    """

    base_from_flange: Floats
    seen: Flags
    joints: Floats
    mount: int = 0


@dataclass(frozen=True, slots=True, eq=False)
class Candidate:
    """A place for one station, or for the two of a half-turn, free of solids.

    Attributes:
        joints: Shape (s, q), rad or m: s = 2 before and after a half-turn, else 1.
        base_from_flange: Shape (s, 4, 4), metres.
        normal: Unit normal of the triangle in the world, shape (3,).
        seen: Which cameras see all markers, nothing between, shape (m,).
        mount: Which mount holds the triangle there.
    """

    joints: Floats
    base_from_flange: Floats
    normal: Floats
    seen: Flags
    mount: int = 0


@dataclass(frozen=True, slots=True)
class _Forbidden:
    """Why solids forbid joints.

    Attributes:
        check: Its name.
        what: What solids do, in words.
        by_rig: Whether the rig does it by itself.
    """

    check: str
    what: str
    by_rig: bool = False


class CandidateSearch:
    """Draws poses and keeps those that pass; counts the others by check.

    Attributes:
        rejected: Rejected poses by the check that rejected them.
        solids: What solids did that rejected one, in words; how often.
        drawn: Poses drawn.
    """

    def __init__(
        self,
        view: View,
        arm: Arm,
        rng: np.random.Generator,
        rejected: Counter[str] | None = None,
        solids: Counter[str] | None = None,
        mount: int = 0,
    ) -> None:
        """Start a search.

        Args:
            view: Cameras and rig.
            arm: The robot in its cell.
            rng: What poses are drawn from.
            rejected: Counts on from there.
            solids: Likewise.
            mount: Which mount view and arm are of.
        """
        self._mount = mount
        self._view = view
        self._arm = arm
        self._rng = rng
        self._anchor = arm.home
        self.rejected: Counter[str] = Counter() if rejected is None else rejected
        self.solids: Counter[str] = Counter() if solids is None else solids
        self.drawn = 0

    def find(
        self, wanted: int, *, turns: bool, solutions: int = 1
    ) -> list[list[Candidate]]:
        """Search until enough places are found or hope is lost.

        Args:
            wanted: How many.
            turns: Whether a place is that of a half-turn (else of one station).
            solutions: How many free solutions of each to look for; with more than
                one, inverse kinematics searches longer.

        Returns:
            Free solutions of up to ``wanted`` places, in the order drawn.
        """
        found: list[list[Candidate]] = []
        while len(found) < wanted and self.drawn < _MOST_POSES:
            if not found and self.drawn >= _HOPELESS:
                break
            for prospect in self._solved(turns):
                wide = self.widened(prospect) if solutions > 1 else prospect
                free = self.free(wide, solutions)
                if free:
                    found.append(free)
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

    def widened(self, prospect: Prospect) -> Prospect:
        """The same place with the solutions that a longer search adds to its own."""
        arm, known = self._arm, prospect.joints
        (found,) = arm.inverse(
            prospect.base_from_flange[:1], self._rng, starts=_MORE_STARTS
        ).joints
        gaps = np.abs(found[:, None] - known[None, :, 0]).max(axis=-1)
        new = found[(gaps > _SAME_JOINTS).all(axis=1)]
        if len(new) == 0:
            return prospect
        added = new[:, None] if known.shape[1] == 1 else self._turned([new])[0]
        return replace(prospect, joints=np.concatenate([known, added]))

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
                Prospect(targets[k][None], seen[k], q[:, None], self._mount)
                for k, q in zip(places, joints, strict=True)
            ]
        possible = [
            Prospect(
                np.stack([targets[k], targets[k] @ HALF_TURN]),
                seen[k],
                both,
                self._mount,
            )
            for k, both in zip(places, self._turned(joints), strict=True)
            if len(both)
        ]
        self.rejected["half_turn"] += len(places) - len(possible)
        return possible

    def _turned(self, poses: list[Floats]) -> list[Floats]:
        """Joints before and after the half-turn, (t, 2, q), of each pose's (s, q).

        The last joint turns where its axis is the flange's and its limits allow;
        otherwise inverse kinematics, and the solution nearest to the one before.
        """
        arm = self._arm
        result = [self._by_last_joint(joints) for joints in poses]
        missing = [k for k, both in enumerate(result) if not len(both)]
        if missing:
            targets = np.array([arm.forward(poses[k][0]) @ HALF_TURN for k in missing])
            found = arm.inverse(targets, self._rng, starts=_STARTS).joints
            for k, others in zip(missing, found, strict=True):
                if len(others):
                    gap = np.linalg.norm(poses[k][:, None] - others, axis=-1)
                    nearest = others[gap.argmin(axis=1)]
                    result[k] = np.stack([poses[k], nearest], axis=1)
        return result

    def _by_last_joint(self, joints: Floats) -> Floats:
        """Those whose last joint turned by pi makes the half-turn, (t, 2, q)."""
        arm = self._arm
        tries = np.repeat(joints[:, None], 2, axis=1)
        tries[..., -1] += (-np.pi, np.pi)
        target = arm.forward(joints)[:, None] @ HALF_TURN
        off = np.abs(arm.forward(tries) - target).max(axis=(-1, -2))
        inside = ((tries >= arm.lower) & (tries <= arm.upper)).all(axis=-1)
        usable = (off < _SAME_POSE) & inside
        after = tries[np.arange(len(tries)), usable.argmax(axis=1)]
        both = np.stack([joints, after], axis=1)
        return np.asarray(both[usable.any(axis=1)])

    def free(self, prospect: Prospect, most: int) -> list[Candidate]:
        """Solutions that no solid forbids; if none, count what forbade them.

        Those nearest to the last free one come first.

        Args:
            prospect: Where.
            most: How many solutions to look for.
        """
        gaps = np.linalg.norm(prospect.joints[:, 0] - self._anchor, axis=1)
        found: list[Candidate] = []
        why: list[_Forbidden] = []
        for k in np.argsort(gaps, kind="stable"):
            joints = prospect.joints[k]
            judged = self._judged(joints, prospect.seen)
            if isinstance(judged, _Forbidden):
                why.append(judged)
                if judged.by_rig:
                    # The rig hides its own marker: so it does in every solution.
                    break
            else:
                found.append(self._candidate(prospect, joints, judged))
                if len(found) == most:
                    break
        if found:
            self._anchor = found[0].joints[-1]
        else:
            # The solution that came farthest speaks for the pose.
            last = max(why, key=lambda one: one.check == "occlusion")
            self.rejected[last.check] += 1
            self.solids[last.what] += 1
        return found

    def _candidate(self, prospect: Prospect, joints: Floats, seen: Flags) -> Candidate:
        world = self._arm.base_from_world.inverse().matrix
        normal = self._view.normals(world @ prospect.base_from_flange[:1])[0]
        return Candidate(
            joints, self._arm.forward(joints), normal, seen, prospect.mount
        )

    def _judged(self, joints: Floats, seen: Flags) -> Flags | _Forbidden:
        """Cameras left with a free sight, or what forbids joints (s, q)."""
        arm, view = self._arm, self._view
        for q in joints:
            hit = arm.collision(q)
            if hit is not None:
                return _Forbidden("collision", f"{hit[0]} touches {hit[1]}")
        free = seen.copy()
        for i in np.flatnonzero(seen):
            blocker = self._blocker(joints, view.world_from_camera[i, :3, 3])
            if blocker is None:
                continue
            free[i] = False
            if free.sum() < view.required:
                name = view.cell.cameras[i].name
                what = f"{blocker} hides a marker from camera {name}"
                return _Forbidden("occlusion", what, blocker in arm.on_flange)
        return free

    def _blocker(self, joints: Floats, camera: Floats) -> str | None:
        """Name of a solid that hides a marker from a camera, or None."""
        for q in joints:
            for marker, radius in enumerate(SIGHT_MARGIN * self._view.radii):
                blocker = self._arm.sight_blocked(q, camera, marker, radius)
                if blocker is not None:
                    return blocker
        return None

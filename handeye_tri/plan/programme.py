"""A robot programme: informative half-turns in an order that the arm can drive."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from handeye_tri.arm import Arm
from handeye_tri.config import Cell
from handeye_tri.errors import InputError, NoPlanError
from handeye_tri.plan.candidates import Candidate, CandidateSearch
from handeye_tri.plan.information import StationInformation, choose
from handeye_tri.plan.poses import View, plane_angles
from handeye_tri.records import HalfTurn, Plan, Station
from handeye_tri.se3 import SE3, so3_log

Floats = NDArray[np.float64]
Progress = Callable[[int, int], None]

# Detection's standard deviation per axis that predictions assume, pixels.
EXPECTED_SIGMA_PX = 0.03
# Half-turns to choose from, per half-turn wanted.
_POOL = 8
# Orders and selections that are tried before a cell is given up.
_PATHS = 150
_SELECTIONS = 6
# Least spread of the rotation axes between stations over 3-D: the smallest over the
# largest singular value of all axes.
_MIN_AXIS_SPREAD = 0.1

_REMEDY = {
    "tilt": "raise plan.max_tilt_deg or bring the cameras closer together",
    "image": "turn the cameras to the workspace box, or move plan.workspace_min_m "
    "and workspace_max_m to where all cameras see the rig",
    "reach": "move the workspace box or the cameras nearer to the robot",
    "limits": "move the workspace box to where the joint limits leave room",
    "half_turn": "the wrist cannot turn by 180 degrees there: use an arm or an edge "
    "rig whose last joint can",
    "collision": "give the arm room: move what stands in the cell or the workspace box",
    "occlusion": "uncover the markers: move the cameras, what stands between, or the "
    "rig farther ahead of the flange",
    "turn_path": "give the turning rig room: move what stands in the cell",
    "plane_spread": "lower plan.min_plane_spread_deg or raise plan.max_tilt_deg",
    "path": "give the arm room between stations: move what stands in the cell",
    "axis_spread": "raise plan.max_tilt_deg: the stations hardly turn against another",
}


def plan_motions(
    cell: Cell,
    arm: Arm,
    seed: int,
    half_turns: int | None = None,
    progress: Progress | None = None,
) -> Plan:
    """Plan half-turns joined by general motions, then evaluation stations.

    Every station is within the joint limits, free of collision with clearance, and
    shows all markers' outlines unhidden and with margin in every camera's image, at
    an allowed tilt; the two stations of a half-turn differ by 180 degrees about the
    flange's z axis; successive half-turns' planes enclose at least
    ``plan.min_plane_spread_deg`` (Zhao, Liu and Zhang 2008, Proposition 1,
    doi:10.1109/TIP.2008.2005562); straight joint paths from station to station are
    free. Among what passes, half-turns are chosen by predicted track error.

    The certificate holds

    * ``plane_spread_deg``: smallest angle between successive planes,
    * ``axis_spread``: smallest over largest singular value of the rotation axes
      between stations (1: all directions alike, 0: in a plane),
    * ``sigma_px``: the detection error that the predictions assume,
    * ``sigma.<camera>.fx_px`` (``fy_px skew_px cx_px cy_px``, lens by name),
      ``sigma.base_from_<camera>.translation_mm`` and ``.rotation_deg``: predicted
      standard deviations (for motions: of the three axes together),
    * ``track_calibration_rms_mm``: the calibration's part of the predicted distance
      between reported and observed markers, over the evaluation stations,
    * ``candidates``: half-turns that were chosen from.

    Args:
        cell: The cell.
        arm: The robot in it.
        seed: Same seed, same plan.
        half_turns: Number of half-turns; the cell's own where None.
        progress: Called with (done, total) as the search goes on.

    Raises:
        InputError: fewer than two half-turns are asked for.
        NoPlanError: no plan was found; says which check rejected how many.
    """
    wanted = cell.plan.half_turns if half_turns is None else half_turns
    if wanted < 2:
        raise InputError(
            f"half_turns must be at least 2, got {wanted}: one plane leaves the "
            "cameras undetermined"
        )
    return _Planner(cell, arm, seed, wanted, progress).plan()


class _Planner:
    def __init__(
        self,
        cell: Cell,
        arm: Arm,
        seed: int,
        wanted: int,
        progress: Progress | None,
    ) -> None:
        self.cell = cell
        self.arm = arm
        self.seed = seed
        self.wanted = wanted
        self.view = View(cell)
        self.pool_size = _POOL * wanted
        self.total = self.pool_size + wanted + cell.plan.evaluation_stations
        self.progress = progress
        self.rejected: Counter[str] = Counter()

    def _done(self, done: int) -> None:
        if self.progress is not None:
            self.progress(done, self.total)

    def plan(self) -> Plan:
        """Search, choose, order, and add the evaluation stations."""
        search = CandidateSearch(
            self.view, self.arm, np.random.default_rng([self.seed, 0])
        )
        pool = search.find(self.pool_size, turns=True, progress=self._done)
        self.rejected += search.rejected
        if len(pool) < self.wanted:
            raise self._no_plan(
                search.drawn, f"{len(pool)} of {self.wanted} half-turns found"
            )
        chosen = self._choose_and_order(pool)
        self._done(self.pool_size + self.wanted)
        evaluation = self._evaluation(chosen[-1].joints[-1])
        self._done(self.total)
        return self._record(chosen, evaluation, len(pool))

    def _information(self) -> StationInformation:
        return StationInformation(
            self.view,
            self.arm.base_from_world.matrix,
            self.cell.repeatability,
            EXPECTED_SIGMA_PX,
        )

    def _choose_and_order(self, pool: list[Candidate]) -> list[Candidate]:
        model = self._information()
        poses = np.array([c.base_from_flange for c in pool])
        information = model.of_stations(poses.reshape(-1, 4, 4))
        size = len(model.labels)
        information = information.reshape(len(pool), 2, size, size).sum(axis=1)
        track = model.track_derivatives(poses[:, 0]).reshape(-1, size)
        cost = track.T @ track / (len(track) / 3)
        usable = list(range(len(pool)))
        for _ in range(_SELECTIONS):
            if len(usable) < self.wanted:
                break
            picked = choose(information[usable], model.prior, cost, self.wanted)
            selection = [usable[k] for k in picked]
            order, stuck = self._order([pool[k] for k in selection])
            if order is not None:
                return order
            usable.remove(selection[stuck])
        most = "path" if self.rejected["path"] else "plane_spread"
        raise self._no_plan(
            len(pool),
            "no order of half-turns drives free from one to the next",
            most,
        )

    def _order(self, selection: list[Candidate]) -> tuple[list[Candidate] | None, int]:
        """Order the half-turns, each in one of its two senses.

        Depth first, nearest first; planes of successive half-turns spread enough
        and the straight path between them free.

        Returns:
            The half-turns in order, turned round where that helped, or None; and
            the index of the one with the fewest successors.
        """
        n = len(selection)
        least = np.radians(self.cell.plan.min_plane_spread_deg)
        normals = np.array([c.normal for c in selection])
        spread = plane_angles(normals[:, None], normals[None]) >= least
        ends = np.array([c.joints[::step] for c in selection for step in (1, -1)])
        nodes = range(2 * n)
        distance = np.linalg.norm(ends[:, None, 1] - ends[None, :, 0], axis=-1)
        free: dict[tuple[int, int], bool] = {}

        def passable(a: int, b: int) -> bool:
            if (a, b) not in free:
                free[a, b] = self.arm.path_collision(ends[a, 1], ends[b, 0]) is None
                self.rejected["path"] += not free[a, b]
            return free[a, b]

        def extend(path: list[int]) -> list[int] | None:
            if len(path) == n:
                return path
            used = {node // 2 for node in path}
            last = path[-1]
            following = [
                b for b in nodes if b // 2 not in used and spread[last // 2, b // 2]
            ]
            # Fewest successors first, so that none is left over; then the nearest.
            rest = [b // 2 for b in following]
            following.sort(
                key=lambda b: (int(spread[b // 2][rest].sum()) // 2, distance[last, b])
            )
            for b in following:
                if len(free) >= _PATHS:
                    return None
                if passable(last, b):
                    result = extend([*path, b])
                    if result is not None:
                        return result
            if not following:
                self.rejected["plane_spread"] += 1
            return None

        scarce = int(np.argmin(spread.sum(axis=1)))
        for start in (2 * scarce, 2 * scarce + 1):
            path = extend([start])
            if path is not None:
                return [self._turned_round(selection[k // 2], k % 2) for k in path], 0
        return None, scarce

    @staticmethod
    def _turned_round(candidate: Candidate, backward: int) -> Candidate:
        if not backward:
            return candidate
        return Candidate(
            candidate.joints[::-1], candidate.base_from_flange[::-1], candidate.normal
        )

    def _evaluation(self, start: Floats) -> list[Candidate]:
        """Stations anywhere in the workspace, each reached on a free path."""
        wanted = self.cell.plan.evaluation_stations
        search = CandidateSearch(
            self.view, self.arm, np.random.default_rng([self.seed, 1])
        )
        chosen: list[Candidate] = []
        last = start
        # Some candidates more than wanted: a path may be blocked.
        for candidate in search.find(3 * wanted, turns=False):
            if self.arm.path_collision(last, candidate.joints[0]) is not None:
                search.rejected["path"] += 1
                continue
            chosen.append(candidate)
            last = candidate.joints[0]
            if len(chosen) == wanted:
                break
        self.rejected += search.rejected
        if len(chosen) < wanted:
            raise self._no_plan(
                search.drawn, f"{len(chosen)} of {wanted} evaluation stations found"
            )
        return chosen

    def _record(
        self, chosen: list[Candidate], evaluation: list[Candidate], pool: int
    ) -> Plan:
        calibration = [
            Station(2 * k + step, "calibration", c.joints[step], SE3(pose))
            for k, c in enumerate(chosen)
            for step, pose in enumerate(c.base_from_flange)
        ]
        held_out = [
            Station(k, "evaluation", c.joints[0], SE3(c.base_from_flange[0]))
            for k, c in enumerate(evaluation, len(calibration))
        ]
        turns = tuple(
            HalfTurn(2 * k, 2 * k + 1, self.cell.rig.axis) for k in range(len(chosen))
        )
        certificate = self._certificate(chosen, evaluation)
        certificate["candidates"] = float(pool)
        if certificate["axis_spread"] < _MIN_AXIS_SPREAD:
            self.rejected["axis_spread"] += 1
            raise self._no_plan(1, "the rotations do not span 3-D", "axis_spread")
        return Plan(
            (*calibration, *held_out),
            turns,
            dict(self.rejected),
            certificate,
            self.seed,
        )

    def _certificate(
        self, chosen: list[Candidate], evaluation: list[Candidate]
    ) -> dict[str, float]:
        normals = np.array([c.normal for c in chosen])
        poses = np.concatenate([c.base_from_flange for c in chosen])
        certificate = {
            "plane_spread_deg": float(
                np.degrees(plane_angles(normals[:-1], normals[1:]).min())
            ),
            "axis_spread": _axis_spread(poses[:, :3, :3]),
            "sigma_px": EXPECTED_SIGMA_PX,
        }
        model = self._information()
        covariance = model.covariance(model.of_stations(poses).sum(axis=0))
        for label in covariance.labels:
            owner, quantity = label.rsplit(".", 1)
            if "_from_" not in owner:
                unit = "_px" if quantity in ("fx", "fy", "skew", "cx", "cy") else ""
                certificate[f"sigma.{label}{unit}"] = covariance.std(label)
        for camera in self.cell.cameras:
            name = f"base_from_{camera.name}"
            sigma = np.array([covariance.std(f"{name}.{q}") for q in "xyz"])
            turn = np.array([covariance.std(f"{name}.r{q}") for q in "xyz"])
            certificate[f"sigma.{name}.translation_mm"] = float(
                1e3 * np.linalg.norm(sigma)
            )
            certificate[f"sigma.{name}.rotation_deg"] = float(
                np.degrees(np.linalg.norm(turn))
            )
        places = np.concatenate([c.base_from_flange for c in evaluation or chosen])
        track = model.track_derivatives(places)
        errors = np.einsum("nkap,pq,nkaq->nk", track, covariance.matrix, track)
        certificate["track_calibration_rms_mm"] = float(1e3 * np.sqrt(errors.mean()))
        return certificate

    def _no_plan(self, drawn: int, what: str, check: str | None = None) -> NoPlanError:
        counts = {name: n for name, n in self.rejected.most_common() if n}
        most = check or next(iter(counts), "reach")
        listed = ", ".join(f"{name} {n}" for name, n in counts.items()) or "none"
        return NoPlanError(
            f"no plan for cell {self.cell.name!r}: {what} among {drawn} candidates; "
            f"rejected by check: {listed}. Do: {_REMEDY[most]}",
            counts,
        )


def _axis_spread(rotations: Floats) -> float:
    """Smallest over largest singular value of the axes between all stations."""
    first, second = np.triu_indices(len(rotations), 1)
    turns = so3_log(rotations[first].swapaxes(-1, -2) @ rotations[second])
    angle = np.linalg.norm(turns, axis=1, keepdims=True)
    moving = angle[:, 0] > 1e-3
    singular = np.linalg.svd(turns[moving] / angle[moving], compute_uv=False)
    return float(singular[-1] / singular[0])

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from handeye_tri.config import RigConfig
from handeye_tri.errors import InputError
from handeye_tri.simulate.rods import rig_board, rig_rods
from handeye_tri.storage.cells import read_cell

SCENES = Path(__file__).resolve().parents[2] / "scenes"
RODS = {"normal": 7, "edge": 6}


def rig_of(name: str, **changes: object) -> RigConfig:
    rig = read_cell(SCENES / f"{name}.yaml").rig
    return RigConfig.model_validate({**rig.model_dump(), **changes})


def distance(point: np.ndarray, start: np.ndarray, end: np.ndarray) -> float:
    """From a point to a segment."""
    along = end - start
    t = np.clip((point - start) @ along / (along @ along), 0, 1)
    return float(np.linalg.norm(point - start - t * along))


@pytest.mark.parametrize(
    ("cell", "axis"),
    [
        ("hp3_stereo", "normal"),
        ("hp3_stereo_mono", "normal"),
        ("hp3_stereo_edge", "AB"),
        ("hp3_stereo_edge", "BC"),
        ("hp3_stereo_edge", "CA"),
    ],
)
def test_every_marker_is_held_by_one_rod_from_the_flange_side(
    cell: str, axis: str
) -> None:
    rig = rig_of(cell, axis=axis)
    markers = rig.flange_from_triangle.apply(rig.triangle.points)
    rods = rig_rods(rig)
    assert len(rods) == RODS["normal" if axis == "normal" else "edge"]
    for marker, radius_mm in zip(markers, rig.marker_radii_mm, strict=True):
        holders = [rod for rod in rods if distance(marker, rod.start, rod.end) < 1e-9]
        assert len(holders) == 1
        assert holders[0].start[2] < marker[2] - 5e-3
        # All others leave the ball's outline free, seen along their own normal.
        for rod in rods:
            if rod is not holders[0]:
                gap = distance(marker, rod.start, rod.end) - rod.radius
                assert gap > 1e-3 * radius_mm + 2e-3


def test_all_rods_hang_together() -> None:
    for name in ("hp3_stereo", "hp3_stereo_edge"):
        rods = list(rig_rods(rig_of(name)))
        assert not rods[0].start.any(), "the hub begins at the flange"
        joined = [rods.pop(0)]
        while rods:
            touching = [
                rod
                for rod in rods
                if any(
                    min(
                        distance(rod.start, other.start, other.end),
                        distance(other.end, rod.start, rod.end),
                    )
                    < 1e-9
                    for other in joined
                )
            ]
            assert touching
            joined += touching
            rods = [rod for rod in rods if not any(rod is t for t in touching)]


def test_a_normal_rig_keeps_its_arms_behind_the_markers() -> None:
    rig = rig_of("hp3_stereo")
    for rod in rig_rods(rig):
        if not rod.name.startswith("standoff"):
            assert max(rod.start[2], rod.end[2]) < 0.09 - 0.03


@pytest.mark.parametrize("turn", [0.0, 40.0])
def test_a_fork_is_flat_in_the_triangles_plane(turn: float) -> None:
    rig = rig_of("hp3_stereo_edge", turn_deg=turn)
    normal = rig.flange_from_triangle.rotation[:, 2]
    ends = np.array([(rod.start, rod.end) for rod in rig_rods(rig)])
    assert np.abs(ends @ normal).max() < 1e-12


def test_a_clocks_balls_sit_on_its_hands() -> None:
    rig = rig_of("clock_dial")
    markers = rig.flange_from_triangle.apply(rig.triangle.points)
    shaft, *hands = rig_rods(rig)
    assert len(hands) == 3
    for marker, hand in zip(markers, hands, strict=True):
        assert (hand.start == shaft.end).all()
        gap = distance(marker, hand.start, hand.end) - hand.radius - 8e-3
        assert -0.3e-3 < gap < 0
        # Below the ball: whoever looks at the dial's face sees its whole outline.
        assert max(hand.start[2], hand.end[2]) + hand.radius < marker[2] - 7e-3
    # B and C are the two ends of one hand, through the shaft, A is on the other.
    a, b, c = (markers - shaft.end)[:, :2]
    cosines = [
        p @ q / np.linalg.norm(p) / np.linalg.norm(q) for p, q in ((b, c), (a, b))
    ]
    assert cosines[0] < -0.999999
    assert abs(cosines[1]) < 0.5


def test_a_board_leaves_the_outlines_free() -> None:
    rig = rig_of("triangle_board")
    corners = rig_board(rig)
    assert corners is not None
    assert corners.shape == (12, 3)
    markers = rig.flange_from_triangle.apply(rig.triangle.points)
    normal = rig.flange_from_triangle.rotation[:, 2]
    assert np.abs((corners - markers[0]) @ normal) == pytest.approx(1.5e-3)
    # The least distance that hides nothing at 55 degrees, and the corner's cut.
    for marker in markers:
        near = np.sort(np.linalg.norm(corners - marker, axis=1))[:4]
        middle = near[0] * np.cos(np.radians(35))
        assert middle > 9e-3 / np.cos(np.radians(55))
    assert rig_board(rig_of("hp3_stereo_edge")) is None


def test_the_board_hangs_on_the_fork() -> None:
    *fork, spar = rig_rods(rig_of("triangle_board"))
    assert spar.name == "spar"
    bar = next(rod for rod in fork if rod.name == "bar")
    assert distance(spar.start, bar.start, bar.end) < 1e-9


def test_a_marker_behind_the_fork_is_refused() -> None:
    # At an obtuse angle the third marker falls behind the edge's near end.
    rig = rig_of("hp3_stereo_edge", axis="AB", angle_deg=150.0, side_ac_mm=130.0)
    with pytest.raises(InputError, match=r"rig\.ahead_mm: marker C.*behind the fork"):
        rig_rods(rig)

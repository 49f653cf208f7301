"""Cells without a plan, as a user meets them on the command line."""

from __future__ import annotations

import time
from collections import Counter

import planning_scene as scene
import pytest

from handeye_tri import cli
from handeye_tri.arm import Arm
from handeye_tri.errors import NoPlanError
from handeye_tri.plan import plan_motions
from handeye_tri.plan.refusal import no_plan

WALL = """surroundings:
  - name: wall
    size_mm: [10, 1000, 1000]
    position_m: [0.9, 0.0, 0.5]
"""
FAR = [
    ("workspace_min_m: [0.35", "workspace_min_m: [1.35"),
    ("workspace_max_m: [0.60", "workspace_max_m: [1.60"),
    ("position_m: [1.35, 0.125", "position_m: [2.35, 0.125"),
    ("position_m: [1.35, -0.125", "position_m: [2.35, -0.125"),
    *[("look_at_m: [0.45, 0.0", "look_at_m: [1.45, 0.0")] * 2,
]
# Neither the last joint turns, nor the wrist over, nor does the arm reach backwards.
STIFF = [
    ('name="t" axis="1 0 0" range="-360 360"', 'name="t" axis="1 0 0" range="-80 80"'),
    ('name="b" axis="0 -1 0" range="-125 125"', 'name="b" axis="0 -1 0" range="5 120"'),
    ('name="r" axis="1 0 0" range="-180 180"', 'name="r" axis="1 0 0" range="-60 60"'),
    ('name="s" axis="0 0 1" range="-170 170"', 'name="s" axis="0 0 1" range="-60 60"'),
]


def with_changes(text, changes):
    for old, new in changes:
        assert old in text, old
        text = text.replace(old, new, 1)
    return text


@pytest.mark.parametrize(
    ("cell", "model", "parts"),
    [
        (
            [("surroundings:\n", WALL)],
            [],
            ["0 of 60 half-turns are free", "cell/wall hides a marker from camera"]
            + ["hidden from a camera 5", "Do: uncover the markers"],
        ),
        (
            FAR,
            [],
            ["out of reach", "Most in the way is reach", "nearer to the robot"],
        ),
        (
            [("model: hp3_like.xml", "model: stiff.xml")],
            STIFF,
            ["without a turn by 180 degrees", "Most in the way is half_turn"]
            + ["Do: the wrist cannot turn by 180 degrees: widen the limits"],
        ),
    ],
    ids=["camera faces a wall", "target out of reach", "wrist cannot turn"],
)
def test_an_impossible_cell_ends_soon_with_the_reason(
    tmp_path, capsys, cell, model, parts
):
    source = (scene.REPO / "scenes" / "hp3_stereo.yaml").read_text()
    (tmp_path / "cell.yaml").write_text(with_changes(source, cell))
    (tmp_path / "stiff.xml").write_text(with_changes(scene.MODEL.read_text(), model))
    start = time.process_time()
    with pytest.raises(SystemExit) as left:
        cli.main(["plan", str(tmp_path / "out"), "--cell", str(tmp_path / "cell.yaml")])
    assert time.process_time() - start < 20
    assert left.value.code == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith("error: no plan for cell 'hp3_stereo': ")
    for part in parts:
        assert part in err
    assert "Traceback" not in err
    assert not (tmp_path / "out" / "plan.json").exists()


def test_an_arm_that_starts_in_a_solid_is_told_so():
    box = {"name": "crate", "size_mm": (300, 300, 300)}
    arm = scene.arm_of("hp3_stereo")
    place = tuple(arm.body_poses(arm.home)[arm.mechanism.flange_body, :3, 3])
    cell = scene.changed("hp3_stereo", surroundings=[{**box, "position_m": place}])
    with pytest.raises(NoPlanError, match=r"cannot leave where it stands.*crate"):
        plan_motions(cell, Arm(scene.compiled(cell)), 1)


def test_the_check_that_lets_the_smallest_part_pass_is_blamed():
    """Most candidates fail in the image, as always; none of 40 turns."""
    rejected = Counter(image=700, tilt=200, limits=60, half_turn=40)
    error = no_plan("c", rejected, 1000, "0 of 11 half-turns found")
    assert "Most in the way is half_turn" in str(error)
    assert "without a turn by 180 degrees 40" in str(error)
    assert error.rejected == dict(rejected)


def test_nothing_drawn_is_no_reason_to_fail():
    assert "rejected: none" in str(no_plan("c", Counter(), 0, "nothing"))

"""The fault lab: its description, and that a fault moves what it says by its size."""

import numpy as np
import pytest
from two_mount_cell import geometry, observed

from handeye_tri import simulate, storage
from handeye_tri.arm import Arm
from handeye_tri.diagnose.explanations import EXPLANATIONS
from handeye_tri.errors import InputError
from handeye_tri.experiments.fault_lab import judged, read_faults
from handeye_tri.experiments.faulty_cell import INJECTIONS
from handeye_tri.experiments.rendered_cell import RenderedCell
from handeye_tri.plan import plan_motions
from handeye_tri.records import Plan, ToolChange
from handeye_tri.simulate import compile_mechanism

FAULTS = storage.shipped("scenes") / "faults" / "faults.yaml"


@pytest.fixture(scope="module")
def healthy():
    """Five half-turns and the held-out stations."""
    path = storage.find_cell("hp3_stereo")
    cell = storage.read_cell(path)
    model = storage.find_model(cell, path)
    arm = Arm(compile_mechanism(cell, model))
    plan = plan_motions(cell, arm, 3, half_turns=5)
    joints = simulate.execute(arm, plan, cell.repeatability, 3)
    rendered = RenderedCell(cell, model, arm, plan, joints, 3)
    rendered.photograph()
    return rendered


def injected(healthy, name, ranges):
    return INJECTIONS[name](healthy, ranges, np.random.default_rng(5))


def test_every_fault_is_described_and_its_code_explained():
    cell, faults = read_faults(FAULTS)
    assert storage.find_cell(cell).is_file()
    assert {one.name for one in faults} == set(INJECTIONS)
    assert {one.code for one in faults} <= set(EXPLANATIONS)


def test_a_fault_that_there_is_not(tmp_path):
    path = tmp_path / "faults.yaml"
    path.write_text(FAULTS.read_text().replace("rig_slipped", "rig_lost"))
    with pytest.raises(InputError, match="no fault 'rig_lost'; there are camera_moved"):
        read_faults(path)
    path.write_text("schema: handeye_tri.cell/1\n")
    with pytest.raises(InputError, match="schema must be"):
        read_faults(path)


@pytest.mark.parametrize(
    ("name", "ranges"),
    [
        ("camera_moved", {"moved_mm": 0.0, "turned_deg": 0.0, "from_share": 0.5}),
        ("rig_slipped", {"moved_mm": 0.0, "turned_deg": 0.0, "from_share": 0.5}),
        ("turn_not_180", {"half_turns": 2.0, "angle_deg": 180.0}),
    ],
)
def test_a_fault_of_no_size_changes_nothing(healthy, name, ranges):
    found = injected(healthy, name, {key: (end, end) for key, end in ranges.items()})
    whole = healthy.observed().session
    apart = np.abs(found.session.pixels - whole.pixels)
    # A camera's place goes through eight digits of a description at least.
    assert np.nanmax(apart) < 1e-3
    assert len(whole.half_turns) == 5


@pytest.mark.parametrize("seed", range(6))
def test_a_misstated_tool_change_is_all_that_changes(seed):
    true = geometry(1)
    session = observed(true, 1)
    change = ToolChange(15, np.zeros(6), np.zeros((0, 6)))
    plan = Plan(
        *(true.stations, true.half_turns, {}, {}, 1, "PASS", ()), tool_change=change
    )
    path = storage.find_cell("hp3_stereo_both")
    cell = storage.read_cell(path)
    model = storage.find_model(cell, path)
    arm = Arm(compile_mechanism(cell.mounted[0], model))
    edges = np.full((*session.pixels.shape[:3], 3), np.nan)
    found = session.pixels, session.pixel_covariance, edges
    rendered = RenderedCell(cell, model, arm, plan, np.zeros((30, 6)), 1, {}, found)
    wrong = INJECTIONS["tool_change_misstated"](
        rendered, {"stations": (3, 4)}, np.random.default_rng(seed)
    ).session
    np.testing.assert_array_equal(wrong.pixels, session.pixels)
    (stated,) = np.flatnonzero(np.diff(wrong.mounts)) + 1
    assert stated in (12, 18)
    # Stations 17 and 18 make a half-turn; it is lost where it would be parted.
    assert len(wrong.half_turns) == {12: 12, 18: 11}[stated]
    for turn in wrong.half_turns:
        assert turn.axis == ("BC" if turn.before >= stated else "normal")


def test_faults_say_with_how_many_mounts_a_cell_can_have_them():
    mounts = {one.name: one.mounts for one in read_faults(FAULTS)[1]}
    assert mounts.pop("tool_change_misstated") == (2,)
    assert mounts.pop("motion_insufficient") == (1,)
    assert set(mounts.values()) == {(1, 2)}


def test_a_moved_camera_sees_the_markers_where_it_should(healthy):
    sizes = {"moved_mm": (2.0, 2.0), "turned_deg": (0.0, 0.0), "from_share": (0.5, 0.5)}
    found = injected(healthy, "camera_moved", sizes)
    apart = np.linalg.norm(
        found.session.pixels - healthy.observed().session.pixels, axis=-1
    )
    (moved,) = np.flatnonzero(apart.max(axis=(1, 2)) > 1.0)
    assert apart[1 - moved].max() == 0.0
    assert apart[moved, :5].max() == 0.0
    # 2 mm across at 0.9 m are 3.8 px at f = 1720 px; along the view, less.
    assert 0.1 < apart[moved, 5:].min() < apart[moved, 5:].max() < 6.0


@pytest.mark.parametrize("name", ["motion_blur", "labels_exchanged", "detection_poor"])
def test_what_only_images_show_is_named(healthy, name):
    _, faults = read_faults(FAULTS)
    (fault,) = (one for one in faults if one.name == name)
    result = judged(healthy, injected(healthy, name, fault.ranges))
    assert result["codes"][0] == fault.code, result
    assert judged(healthy, healthy.observed())["codes"] == []

"""Images in folders with poses in files: the same session by every way."""

from __future__ import annotations

import json
import shutil

import numpy as np
import pytest
from drawn_session import drawn_session, few_replicates
from exported import call
from ruamel.yaml import YAML

from handeye_tri.exchange.pose_tables import PoseFormat
from handeye_tri.pipeline import NullProgress, Run
from handeye_tri.se3 import quaternion_wxyz, se3_inverse, so3_log
from handeye_tri.storage import SessionFolder, find_cell, read_image

COLUMNS = {
    "quaternion-wxyz:m": lambda p: [*p[:3, 3], *quaternion_wxyz(p[:3, :3])],
    "quaternion-xyzw:mm": lambda p: [
        *(1e3 * p[:3, 3]),
        *np.roll(quaternion_wxyz(p[:3, :3]), -1),
    ],
    "rotation-vector:mm,rad": lambda p: [*(1e3 * p[:3, 3]), *so3_log(p[:3, :3])],
    "rotation-vector:m,deg": lambda p: [*p[:3, 3], *np.degrees(so3_log(p[:3, :3]))],
    "axis-angle:mm,deg": lambda p: [*(1e3 * p[:3, 3]), *axis_angle(p[:3, :3])],
    "matrix:m": lambda p: p.ravel(),
}


def axis_angle(rotation):
    vector = so3_log(rotation)
    angle = np.linalg.norm(vector)
    return [*(vector / angle), np.degrees(angle)]


@pytest.fixture(scope="module")
def bench(tmp_path_factory):
    """The drawn session's images and poses as an engineer would have them."""
    folder = tmp_path_factory.mktemp("bench")
    run = drawn_session(folder)
    poses = run.session().base_from_flange
    for camera in ("left", "right"):
        (folder / camera).mkdir()
        for j in range(len(poses)):
            source = run.folder.file(run.image_name(camera, j))
            # Without leading zeros: 10 must not come before 2.
            shutil.copy(source, folder / camera / f"shot{j}.png")
    cell = YAML(typ="safe").load(find_cell("hp3_stereo").read_text())
    measured = {
        "schema": "handeye_tri.measured_cell/1",
        "name": "bench",
        "arm": {"repeatability_mm": 0.03, "repeatability_deg": 0.005},
        "rig": {key: value for key, value in cell["rig"].items() if key != "ahead_mm"},
        "cameras": [
            {"name": c["name"], "image_size_px": c["image_size_px"]}
            for c in cell["cameras"]
        ],
    }
    with (folder / "bench.yaml").open("w") as stream:
        YAML(typ="safe").dump(measured, stream)
    return folder, run, poses


def table(rows, header=""):
    lines = [header] if header else []
    return "\n".join([*lines, *(",".join(map(repr, map(float, r))) for r in rows)])


def imported(capsys, bench, out, *options, layout="images", source=None):
    folder = bench[0]
    return call(
        *(capsys, "import", layout, source or folder, "-o", out),
        *("--cell", folder / "bench.yaml", *options),
    )


def stations(out):
    run = Run(SessionFolder.open(out), NullProgress())
    return run, np.array([s.base_from_flange.matrix for s in run.plan().stations])


@pytest.mark.parametrize("layout", COLUMNS)
def test_a_csv_of_any_format_gives_the_robots_poses(capsys, bench, tmp_path, layout):
    _, run, poses = bench
    path = tmp_path / "poses.csv"
    path.write_text(table(COLUMNS[layout](p) for p in poses))
    code, out, err = imported(
        *(capsys, bench, tmp_path / "s", "--poses", path, "--pose-format", layout),
        *("--direction", "flange_in_base"),
    )
    assert (code, err.strip()) == (0, "")
    assert "6 half-turns about normal found" in out
    session, found = stations(tmp_path / "s")
    np.testing.assert_allclose(found, poses, atol=1e-12)
    assert session.plan().half_turns == run.plan().half_turns
    image = session.image("right", 10)
    assert (image == read_image(run.folder.file("images/right_010.png"))).all()


@pytest.mark.parametrize("order", ["xyz", "zyx", "zxz", "yxy"])
@pytest.mark.parametrize("about", ["fixed", "moving"])
def test_euler_angles_of_every_kind_are_those_of_scipy(order, about):
    from scipy.spatial.transform import Rotation

    from handeye_tri.storage import PoseReader

    rng = np.random.default_rng(3)
    layout = PoseFormat.parse(f"euler-{order}-{about}:mm,deg")
    reader = PoseReader("angles", False)
    for angles in rng.uniform(-180, 180, (20, 3)):
        pose = reader.pose(layout.pose([100.0, 0.0, 0.0, *angles]), "row")
        # SciPy writes moving axes in capitals.
        name = order if about == "fixed" else order.upper()
        expected = Rotation.from_euler(name, angles, degrees=True).as_matrix()
        np.testing.assert_allclose(pose[:3, :3], expected, atol=1e-12)
        assert pose[0, 3] == pytest.approx(0.1)


def test_the_inverse_direction_is_turned_around(capsys, bench, tmp_path):
    _, _, poses = bench
    path = tmp_path / "poses.csv"
    rows = [COLUMNS["matrix:m"](p) for p in se3_inverse(poses)]
    path.write_text(table(rows))
    code, _, _ = imported(
        *(capsys, bench, tmp_path / "s", "--poses", path, "--pose-format", "matrix:m"),
        *("--direction", "base_in_flange"),
    )
    assert code == 0
    np.testing.assert_allclose(stations(tmp_path / "s")[1], poses, atol=1e-12)


def test_tum_yaml_and_moveit_files_give_the_same(capsys, bench, tmp_path):
    _, _, poses = bench
    tum = tmp_path / "poses.tum"
    rows = [
        [j, *p[:3, 3], *np.roll(quaternion_wxyz(p[:3, :3]), -1)]
        for j, p in enumerate(poses)
    ]
    text = "\n".join(" ".join(map(repr, map(float, row))) for row in rows)
    tum.write_text("# timestamp tx ty tz qx qy qz qw\n" + text)
    yaml = tmp_path / "poses.yaml"
    items = [
        {
            "name": f"shot{j}",
            "translation_mm": (1e3 * p[:3, 3]).tolist(),
            "rotation_vector_deg": np.degrees(so3_log(p[:3, :3])).tolist(),
        }
        for j, p in enumerate(poses)
    ]
    with yaml.open("w") as stream:
        YAML(typ="safe").dump(
            {"robot_poses": "flange_in_base", "poses": items[::-1]}, stream
        )
    moveit = tmp_path / "samples.yaml"
    samples = [
        {
            "effector_wrt_world": p.ravel().tolist(),
            "object_wrt_sensor": np.eye(4).ravel().tolist(),
        }
        for p in poses
    ]
    moveit.write_text(json.dumps(samples))
    for name, path, layout, options in (
        ("tum", tum, "images", ["--direction", "flange_in_base"]),
        ("yaml", yaml, "images", []),
        ("moveit", moveit, "moveit", []),
    ):
        code, _, err = imported(
            *(capsys, bench, tmp_path / name, "--poses", path, *options), layout=layout
        )
        assert (code, err.strip()) == (0, "")
        session, found = stations(tmp_path / name)
        expected = poses[::-1] if name == "yaml" else poses
        np.testing.assert_allclose(found, expected, atol=1e-12)
        first = session.image("left", 0)
        shot = bench[0] / "left" / f"shot{17 if name == 'yaml' else 0}.png"
        assert (first == read_image(shot)).all()


def test_names_match_images_and_a_missing_view_is_told(capsys, bench, tmp_path):
    folder, _, poses = bench
    source = tmp_path / "photos"
    shutil.copytree(folder / "left", source / "cam_a")
    shutil.copytree(folder / "right", source / "cam_b")
    (source / "cam_b" / "shot3.png").unlink()
    rows = [
        f"{j},{','.join(map(repr, map(float, COLUMNS['quaternion-wxyz:m'](p))))}"
        for j, p in enumerate(poses)
    ]
    path = tmp_path / "poses.csv"
    path.write_text("station,x_m,y_m,z_m,qw,qx,qy,qz\n" + "\n".join(rows))
    code, out, _ = imported(
        *(capsys, bench, tmp_path / "s", "--poses", path),
        *("--pose-format", "quaternion-wxyz:m", "--direction", "flange_in_base"),
        *("--image", "left=cam_a/*.png", "--image", "right=cam_b/*.png"),
        source=source,
    )
    assert code == 0
    assert "18 stations, 35 images" in out
    assert "pose 3 has no image of right" in out
    session, _ = stations(tmp_path / "s")
    assert not session.was_taken("right", 3)
    for verb in ("detect", "calibrate"):
        assert call(capsys, verb, tmp_path / "s")[0] == 0
    pixels = session.session().pixels
    assert np.isnan(pixels[1, 3]).all()
    assert np.isfinite(pixels[0, 3]).all()


def test_a_measured_cell_goes_all_the_way_to_the_report(capsys, bench, tmp_path):
    """No robot model anywhere: the recording draws base, flange and markers."""
    _, run, poses = bench
    path = tmp_path / "poses.csv"
    path.write_text(table(COLUMNS["matrix:m"](p) for p in poses))
    out = tmp_path / "s"
    imported(
        *(capsys, bench, out, "--poses", path, "--pose-format", "matrix:m"),
        *("--direction", "flange_in_base"),
    )
    for verb in ("detect", "calibrate", "evaluate", "report"):
        with few_replicates():
            code, printed, err = call(capsys, verb, out)
        assert code == 0, err
        if verb == "evaluate":
            assert printed.startswith("VERDICT  PASS      REAL")
            assert "truth - value" not in printed
    session, _ = stations(out)
    for one, other in zip(
        run.hand_eye().base_from_camera,
        session.hand_eye().base_from_camera,
        strict=True,
    ):
        # The adjustments end within a thousandth of their sigmas (0.03 mm).
        assert np.abs(one.matrix - other.matrix).max() < 1e-7
    assert (out / "replay.rrd").stat().st_size > 10_000
    target = tmp_path / "cameras.urdf"
    assert call(capsys, "export", out, "urdf", "-o", target)[0] == 0
    assert "REAL data" in target.read_text()
    bag = tmp_path / "again.mcap"
    assert call(capsys, "export", out, "mcap", "-o", bag)[0] == 0


@pytest.mark.parametrize(
    ("text", "options", "message"),
    [
        ("1,2,3", ["--pose-format", "matrix:m"], "line 1 has 3 columns, matrix has"),
        ("", ["--pose-format", "matrix:m"], "there is no pose in it"),
        ("1,2,3,0,0,0", [], "a CSV file needs --pose-format"),
        (
            "1,2,3,0,0,0",
            ["--pose-format", "euler-zyx:mm,deg"],
            "no rotation 'euler-zyx'",
        ),
        ("1,2,3,0,0,0", ["--pose-format", "rotation-vector:mm"], "needs ,rad or ,deg"),
        ("1,2,3,0,0,0", ["--pose-format", "rotation-vector"], "units are stated"),
        ("1,2,3,0,0,0", ["--pose-format", "euler-zzx-fixed:mm,deg"], "successive"),
        (
            "x_mm,y_mm,z_mm,a,b,c\n1,2,3,0,0,0",
            ["--pose-format", "rotation-vector:m,rad"],
            "the column 'x_mm' is in mm, but --pose-format says m",
        ),
        (
            "1,2,nan,0,0,0",
            ["--pose-format", "rotation-vector:m,rad"],
            "line 1, column 3 holds NaN",
        ),
        (
            "1,2,3,0,0,zero",
            ["--pose-format", "rotation-vector:m,rad"],
            "there is no pose in it",
        ),
        (
            "1,2,3,1,1,0,90",
            ["--pose-format", "axis-angle:m,deg"],
            "rotation_vector_deg holds NaN",
        ),
        (
            "1,2,3,1,0,0,0",
            ["--pose-format", "quaternion-wxyz:m"],
            "1 pose and 18 images of left",
        ),
        (
            "1,2,3,1,0.1,0,0",
            ["--pose-format", "quaternion-wxyz:m"],
            "the quaternion's length differs from 1",
        ),
    ],
)
def test_a_bad_table_is_one_sentence_and_writes_nothing(
    capsys, bench, tmp_path, text, options, message
):
    path = tmp_path / "poses.csv"
    path.write_text(text)
    code, _, err = imported(
        *(capsys, bench, tmp_path / "s", "--poses", path, *options),
        *("--direction", "flange_in_base"),
    )
    assert code == 2
    assert message in err
    assert len(err.splitlines()) == 1
    assert not (tmp_path / "s").exists()


def test_what_is_not_said_is_asked_for(capsys, bench, tmp_path):
    path = tmp_path / "poses.csv"
    path.write_text("1,2,3,0,0,0")
    folder = bench[0]
    for arguments, message in (
        (("--pose-format", "rotation-vector:m,rad"), "--direction flange_in_base"),
        (
            (
                *("--pose-format", "rotation-vector:m,rad"),
                *("--direction", "base_in_flange", "--image", "left=../*"),
            ),
            "it must stay below",
        ),
        (("--direction", "base_in_flange"), "--pose-format"),
    ):
        code, _, err = imported(
            capsys, bench, tmp_path / "s", "--poses", path, *arguments
        )
        assert code == 2
        assert message in err
    code, _, err = call(capsys, "import", "images", folder, "-o", tmp_path / "s")
    assert code == 2
    assert "say what is calibrated: --cell" in err
    code, _, err = imported(capsys, bench, tmp_path / "s")
    assert "images needs the robot's poses: --poses FILE" in err
    (tmp_path / "poses.txt").write_text("1")
    code, _, err = imported(
        *(capsys, bench, tmp_path / "s", "--poses", tmp_path / "poses.txt"),
    )
    assert "add --poses-kind" in err
    assert not (tmp_path / "s").exists()


def test_images_of_another_size_or_none_are_refused(capsys, bench, tmp_path):
    _, _, poses = bench
    path = tmp_path / "poses.csv"
    path.write_text(table(COLUMNS["matrix:m"](p) for p in poses))
    options = ("--pose-format", "matrix:m", "--direction", "flange_in_base")
    for content, message in (
        (b"no image at all", "this is not an image"),
        (None, "the image is 32 x 32 pixels, the cell says 1024 x 768"),
    ):
        source = tmp_path / "photos"
        shutil.rmtree(source, ignore_errors=True)
        shutil.copytree(bench[0] / "left", source / "left")
        shutil.copytree(bench[0] / "right", source / "right")
        if content is None:
            from PIL import Image

            Image.new("RGB", (32, 32)).save(source / "right" / "shot4.png")
        else:
            (source / "right" / "shot4.png").write_bytes(content)
        code, _, err = imported(
            *(capsys, bench, tmp_path / "s", "--poses", path, *options), source=source
        )
        assert code == 2
        assert message in err
        assert len(err.strip().splitlines()) == 1


@pytest.mark.parametrize(
    ("written", "stated", "direction"),
    [
        ("quaternion-wxyz:m", "quaternion-xyzw:m", "flange_in_base"),
        ("rotation-vector:mm,rad", "rotation-vector:mm,deg", "flange_in_base"),
        ("rotation-vector:m,deg", "euler-zyx-moving:m,deg", "flange_in_base"),
        ("axis-angle:mm,deg", "axis-angle:mm,deg", "base_in_flange"),
    ],
)
def test_numbers_read_wrongly_are_told_what_they_could_mean(
    capsys, bench, tmp_path, written, stated, direction
):
    path = tmp_path / "poses.csv"
    path.write_text(table(COLUMNS[written](pose) for pose in bench[2]))
    out = tmp_path / "out"
    options = ("--poses", path, "--pose-format", stated, "--direction", direction)
    code, _, err = imported(capsys, bench, out, *options)
    assert code == 2
    assert (
        f"read by --pose-format {written} --direction flange_in_base there would be "
        "6: is that what the numbers mean?" in err
    )
    assert not out.exists()


@pytest.mark.parametrize(
    ("written", "stated"),
    [
        ("quaternion-wxyz:m", "quaternion-wxyz:mm"),
        ("quaternion-xyzw:mm", "quaternion-xyzw:m"),
    ],
)
def test_lengths_that_no_robot_has_are_no_unit(
    capsys, bench, tmp_path, written, stated
):
    path = tmp_path / "poses.csv"
    # A robot that misses its half-turns by nothing has them in every unit.
    path.write_text(table(COLUMNS[written](pose) for pose in bench[2]))
    options = ("--poses", path, "--pose-format", stated)
    code, _, err = imported(
        capsys, bench, tmp_path / "out", *options, "--direction", "flange_in_base"
    )
    assert code == 2
    assert "robots that calibrate move by 0.005 to 10 m: is the unit" in err


def test_an_image_that_two_poses_name_is_refused(capsys, bench, tmp_path):
    rows = [COLUMNS["matrix:m"](pose) for pose in bench[2]]
    names = [f"shot{max(j, 1)}.png" for j in range(len(rows))]
    lines = [
        ",".join([name, *map(repr, map(float, row))])
        for name, row in zip(names, rows, strict=True)
    ]
    path = tmp_path / "poses.csv"
    path.write_text("\n".join(["image", *lines]))
    options = ("--pose-format", "matrix:m", "--direction", "flange_in_base")
    code, _, err = imported(capsys, bench, tmp_path / "out", "--poses", path, *options)
    assert code == 2
    assert "'shot1.png' and 'shot1.png' have one image, left/shot1.png" in err

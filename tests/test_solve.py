"""`handeye-tri solve`: seven wrong inputs, other readings, output, exit codes."""

import json
from pathlib import Path

import numpy as np
import pytest

from handeye_tri import cli
from handeye_tri.errors import DegenerateMotionError
from handeye_tri.hand_eye import solve_pose_pairs
from handeye_tri.records import PosePairs
from handeye_tri.se3 import (
    rotation_from_quaternion_wxyz,
    se3_exp,
    se3_inverse,
    so3_exp,
    so3_log,
)
from handeye_tri.solve import solve_and_judge, solved_json, solved_text

DATA = Path(__file__).resolve().parents[2] / "shared" / "data"
OPPOSITE = {
    "eye_in_hand": "eye_to_hand",
    "eye_to_hand": "eye_in_hand",
    "flange_in_base": "base_in_flange",
    "target_in_camera": "camera_in_target",
}


def random_pose(rng, spread=0.1):
    pose = np.eye(4)
    pose[:3, :3] = rotation_from_quaternion_wxyz(rng.standard_normal(4))
    pose[:3, 3] = spread * rng.standard_normal(3)
    return pose


def observe(base_from_flange, x, z, mounting, rng):
    """What a camera sees with 0.5 mm and 0.1 degrees of noise."""
    b = se3_inverse(z) @ base_from_flange @ x
    camera_from_target = se3_inverse(b) if mounting == "eye_in_hand" else b
    sigma = np.repeat([5e-4, 2e-3], 3)
    n = len(base_from_flange)
    return camera_from_target @ se3_exp(sigma * rng.standard_normal((n, 6)))


def simulated(mounting):
    rng = np.random.default_rng(11)
    x, z = random_pose(rng), random_pose(rng)
    z[:3, 3] += (0.7, 0.1, 0.9)
    seen = np.tile(np.eye(4), (20, 1, 1))
    seen[:, :3, :3] = so3_exp(0.5 * rng.standard_normal((20, 3)))
    seen[:, :3, 3] = (0, 0, 0.8) + 0.15 * rng.standard_normal((20, 3))
    b = se3_inverse(seen) if mounting == "eye_in_hand" else seen
    robot = z @ b @ se3_inverse(x)
    return robot, observe(robot, x, z, mounting, rng), mounting, x, z


def streams():
    """A real arm's stream beside a camera's, brought on one clock."""
    folder = DATA / "eth_robot_arm" / "robot_arm"
    if not folder.is_dir():
        pytest.skip(f"the recorded streams are not at {folder}")
    times, poses = [], []
    for name in ("base_link_sr300_hinge", "target_ir"):
        rows = np.loadtxt(
            folder / f"robot_arm_complete_bag_color_and_ir_{name}.csv", delimiter=","
        )
        later = rows[1:, 0] > np.maximum.accumulate(rows[:, 0])[:-1]
        rows = rows[np.append(True, later)]
        motions = np.tile(np.eye(4), (len(rows), 1, 1))
        motions[:, :3, :3] = rotation_from_quaternion_wxyz(rows[:, [7, 4, 5, 6]])
        motions[:, :3, 3] = rows[:, 1:4]
        times.append(rows[:, 0] - 1487321563.0)
        poses.append(motions)
    stated = ("eye_in_hand", "flange_in_base", "camera_in_target")
    solution = solve_pose_pairs(
        PosePairs(
            poses[0],
            poses[1][::40],
            *stated,
            robot_times=times[0],
            observed_times=times[1][::40],
        )
    )
    kept = solution.used
    robot, observed = solution.base_from_flange[kept], se3_inverse(solution.b[kept])
    return robot, observed, stated[0], solution.x.matrix, solution.z.matrix


def real():
    path = DATA / "moveit_pose_samples" / "pose_samples.json"
    if not path.exists():
        pytest.skip(f"the real pose samples are not at {path}")
    poses = np.array(json.loads(path.read_text()))
    pairs = PosePairs(
        poses[:, 0], poses[:, 1], "eye_to_hand", "flange_in_base", "target_in_camera"
    )
    solution = solve_and_judge(pairs).solution
    return poses[:, 0], poses[:, 1], "eye_to_hand", solution.x.matrix, solution.z.matrix


SOURCES = {
    "real": real,
    "eye_in_hand": lambda: simulated("eye_in_hand"),
    "eye_to_hand": lambda: simulated("eye_to_hand"),
}


@pytest.fixture(scope="module", params=SOURCES)
def source(request):
    return SOURCES[request.param]()


def judge(robot, observed, mounting, **changes):
    stated = {
        "robot_direction": "flange_in_base",
        "observed_direction": "target_in_camera",
        **changes,
    }
    return solve_and_judge(PosePairs(robot, observed, mounting, **stated))


def codes(solved):
    return [finding.code for finding in solved.verdict.findings]


def scaled(poses, factor):
    result = np.array(poses)
    result[:, :3, 3] *= factor
    return result


def test_right_input_passes(source):
    robot, observed, mounting, x, z = source
    solved = judge(robot, observed, mounting)
    assert solved.verdict.outcome == "PASS"
    assert codes(solved) == []
    assert np.linalg.norm(solved.solution.x.translation - x[:3, 3]) < 3e-3
    assert np.linalg.norm(solved.solution.z.translation - z[:3, 3]) < 3e-3
    assert "mm (95 %)" in solved.verdict.sentence


@pytest.mark.parametrize(
    ("robot_factor", "observed_factor", "meaning"),
    [
        (1.0, 1e3, "observed translations are millimetres"),
        (1.0, 1e-3, "robot translations are millimetres"),
        (1e3, 1.0, "robot translations are millimetres"),
        (1.0, 1 / 0.0254, "observed translations are inches"),
    ],
)
def test_a_wrong_unit_is_named(source, robot_factor, observed_factor, meaning):
    robot, observed, mounting, *_ = source
    solved = judge(
        scaled(robot, robot_factor), scaled(observed, observed_factor), mounting
    )
    assert solved.verdict.outcome == "FAIL"
    assert codes(solved)[0] == "SCALE"
    assert meaning in solved.verdict.findings[0].cause
    assert meaning in solved.verdict.sentence


@pytest.mark.parametrize("factor", [1e3, 1e-3])
def test_a_wrong_unit_on_both_sides_is_doubted(source, factor):
    robot, observed, mounting, *_ = source
    solved = judge(scaled(robot, factor), scaled(observed, factor), mounting)
    assert solved.verdict.outcome == "CANNOT TELL"
    assert "UNIT" in codes(solved)


def test_a_target_two_percent_too_large_is_flagged_but_not_corrected():
    robot, observed, mounting, x, _ = simulated("eye_in_hand")
    solved = judge(robot, scaled(observed, 1.05), mounting)
    assert solved.verdict.outcome == "FAIL"
    assert "SCALE" in codes(solved)
    assert solved.scale[0] == pytest.approx(1 / 1.05, abs=4 * solved.scale[1])
    assert solved.solution.scale == 1.0


@pytest.mark.parametrize("what", ["robot", "observed", "mounting"])
def test_inverted_poses_and_swapped_mounting_are_named_together(source, what):
    robot, observed, mounting, *_ = source
    changes = {}
    if what == "robot":
        changes["robot_direction"] = "base_in_flange"
    elif what == "observed":
        changes["observed_direction"] = "camera_in_target"
    else:
        mounting = OPPOSITE[mounting]
    solved = judge(robot, observed, mounting, **changes)
    assert solved.verdict.outcome == "FAIL"
    assert codes(solved)[0] == "READING"
    cause = solved.verdict.findings[0].cause
    assert OPPOSITE[mounting] in cause
    stated, inverted = solved.readings[:2]
    assert inverted.key == "inverted"
    assert stated.misfit > 20 * inverted.misfit
    assert ("flange_in_base" if what == "robot" else "base_in_flange") in cause


def transposed(poses):
    result = np.array(poses)
    result[:, :3, :3] = np.swapaxes(poses[:, :3, :3], 1, 2)
    return result


def mirrored(poses):
    mirror = np.diag([-1.0, 1.0, 1.0, 1.0])
    return mirror @ poses @ mirror


@pytest.mark.parametrize(
    ("spoil_robot", "spoil_observed", "cause"),
    [
        (transposed, np.array, "the robot poses' rotations are transposed"),
        (np.array, transposed, "the observed poses' rotations are transposed"),
        (transposed, transposed, "both sides' rotations are transposed"),
        (mirrored, np.array, "left-handed"),
        (np.array, mirrored, "left-handed"),
    ],
)
@pytest.mark.parametrize("inverse", [False, True])
@pytest.mark.parametrize("mounting", ["eye_in_hand", "eye_to_hand"])
def test_wrong_rotations_at_right_places_are_named(
    spoil_robot, spoil_observed, cause, inverse, mounting
):
    robot, observed, *_ = simulated(mounting)
    directions = {}
    if inverse:
        robot, observed = se3_inverse(robot), se3_inverse(observed)
        directions["robot_direction"] = "base_in_flange"
        directions["observed_direction"] = "camera_in_target"
    solved = judge(spoil_robot(robot), spoil_observed(observed), mounting, **directions)
    assert solved.verdict.outcome == "FAIL"
    assert cause in solved.verdict.sentence


@pytest.mark.parametrize("side", [0, 1])
def test_sides_that_turn_by_other_angles_are_named_with_them(side):
    *both, mounting, _, _ = simulated("eye_in_hand")
    # Radians that were read as degrees.
    turns = so3_log(both[side][:, :3, :3])
    both[side] = np.array(both[side])
    both[side][:, :3, :3] = so3_exp(np.radians(turns))
    solved = judge(*both, mounting)
    assert solved.verdict.outcome in ("FAIL", "CANNOT TELL")
    assert "do not turn alike" in solved.verdict.sentence
    assert "MOTION" not in codes(solved)
    assert any("degrees or radians" in one.remedy for one in solved.verdict.findings)


@pytest.mark.parametrize("by", [1, -1])
def test_pairs_shifted_by_one_are_named(source, by):
    robot, observed, mounting, *_ = source
    solved = judge(robot, np.roll(observed, by, axis=0), mounting)
    assert solved.verdict.outcome == "FAIL"
    assert codes(solved)[0] == "READING"
    before_or_after = "before" if by == 1 else "after"
    assert f"the robot pose {before_or_after} it" in solved.verdict.findings[0].cause


def test_without_rotation_nothing_passes(source):
    robot, _, mounting, x, z = source
    rng = np.random.default_rng(1)
    still = np.tile(robot[0], (15, 1, 1))
    still[:, :3, 3] += 0.1 * rng.standard_normal((15, 3))
    solved = judge(still, observe(still, x, z, mounting, rng), mounting)
    assert solved.verdict.outcome == "CANNOT TELL"
    assert codes(solved)[0] == "MOTION"
    assert [one.kind for one in solved.solution.undetermined] == ["shift"] * 3
    assert "3 shifts open" in solved.verdict.sentence


@pytest.mark.parametrize("with_shifts", [False, True])
def test_one_axis_only_is_named_with_the_axis(source, with_shifts):
    robot, _, mounting, x, z = source
    rng = np.random.default_rng(2)
    turned = np.zeros((15, 6))
    turned[:, 5] = np.linspace(-0.8, 0.8, 15)
    if with_shifts:
        turned[:, :3] = 0.1 * rng.standard_normal((15, 3))
    one_axis = robot[0] @ se3_exp(turned)
    solved = judge(one_axis, observe(one_axis, x, z, mounting, rng), mounting)
    assert solved.verdict.outcome == "CANNOT TELL"
    assert codes(solved)[0] == "MOTION"
    kinds = {one.kind for one in solved.solution.undetermined}
    assert kinds == ({"shift"} if with_shifts else {"shift", "turn"})
    for one in solved.solution.undetermined:
        np.testing.assert_allclose(one.axis_in_flange, (0, 0, 1), atol=0.05)


@pytest.mark.parametrize("count", [3, 5])
def test_three_poses_prove_nothing(source, count):
    robot, observed, mounting, *_ = source
    solved = judge(robot[:count], observed[:count], mounting)
    assert solved.verdict.outcome == "CANNOT TELL"
    assert "FEW" in codes(solved)


def test_identical_poses_are_an_error(source):
    robot, observed, mounting, *_ = source
    same = [np.tile(poses[:1], (9, 1, 1)) for poses in (robot, observed)]
    with pytest.raises(DegenerateMotionError, match="are the same"):
        judge(*same, mounting)


def test_a_third_of_wrong_poses_still_passes_with_their_names(source):
    robot, observed, mounting, x, _ = source
    rng = np.random.default_rng(3)
    wrong = rng.choice(len(robot), int(0.3 * len(robot)), replace=False)
    spoiled = np.array(robot)
    spoiled[wrong] = [random_pose(rng, 0.5) for _ in wrong]
    solved = judge(spoiled, observed, mounting)
    assert solved.verdict.outcome == "PASS"
    assert sorted(map(int, solved.solution.dropped)) == sorted(wrong)
    assert np.linalg.norm(solved.solution.x.translation - x[:3, 3]) < 4e-3
    assert solved_text(solved).count("DROPPED") == len(wrong)


def without_turning(robot, observed, x, z, mounting):
    rng = np.random.default_rng(5)
    still = np.tile(robot[0], (15, 1, 1))
    still[:, :3, 3] += 0.1 * rng.standard_normal((15, 3))
    return {"robot": still, "observed": observe(still, x, z, mounting, rng)}


def about_one_axis(robot, observed, x, z, mounting):
    rng = np.random.default_rng(6)
    turned = np.zeros((15, 6))
    turned[:, :3] = 0.1 * rng.standard_normal((15, 3))
    turned[:, 3:] = np.outer(rng.uniform(-0.8, 0.8, 15), (0.6, 0.0, 0.8))
    poses = robot[0] @ se3_exp(turned)
    return {"robot": poses, "observed": observe(poses, x, z, mounting, rng)}


@pytest.fixture(scope="module")
def recorded():
    return streams()


@pytest.mark.parametrize(
    ("spoil", "outcome", "code"),
    [
        (lambda *_: {}, "PASS", None),
        (lambda r, o, *_: {"observed": scaled(o, 1e3)}, "FAIL", "SCALE"),
        (lambda *_: {"robot_direction": "base_in_flange"}, "FAIL", "READING"),
        (lambda *_: {"mounting": "eye_to_hand"}, "FAIL", "READING"),
        (lambda r, o, *_: {"observed": np.roll(o, 1, axis=0)}, "FAIL", "READING"),
        (without_turning, "CANNOT TELL", "MOTION"),
        (about_one_axis, "CANNOT TELL", "MOTION"),
        (
            lambda r, o, *_: {"robot": r[:3], "observed": o[:3]},
            "CANNOT TELL",
            "FEW",
        ),
    ],
    ids=[
        "right",
        "unit",
        "inverted",
        "mounting",
        "shifted",
        "no-turn",
        "one-axis",
        "three",
    ],
)
def test_wrong_inputs_of_a_recorded_stream(recorded, spoil, outcome, code):
    robot, observed, mounting, x, z = recorded
    given = {
        "robot": robot,
        "observed": observed,
        "mounting": mounting,
        "robot_direction": "flange_in_base",
        "observed_direction": "target_in_camera",
        **spoil(robot, observed, x, z, mounting),
    }
    # The recording leaves 7 mm in the median.
    solved = solve_and_judge(PosePairs(**given), limit_position=0.03)
    assert solved.verdict.outcome == outcome
    assert codes(solved)[:1] == ([] if code is None else [code])
    # Every other reading was solved, and is shown.
    keys = [reading.key for reading in solved.readings]
    several = ["later", "earlier"] if len(solved.solution.poses) > 3 else []
    assert keys == ["stated", "inverted", *several, "scaled"]
    assert solved_text(solved).count(" deg   ") >= len(keys)


@pytest.mark.parametrize("spoil", [without_turning, about_one_axis])
def test_exact_poses_do_not_determine_more_than_noisy_ones(spoil):
    robot, observed, mounting, x, z = simulated("eye_in_hand")
    poses = spoil(robot, observed, x, z, mounting)["robot"]
    seen = se3_inverse(se3_inverse(z) @ poses @ x)
    solved = judge(poses, seen, mounting)
    assert solved.verdict.outcome == "CANNOT TELL"
    assert codes(solved)[0] == "MOTION"


def test_inverting_both_sides_cannot_be_seen_and_the_gate_says_so():
    robot, observed, mounting, x, z = simulated("eye_in_hand")
    solved = judge(
        robot,
        observed,
        mounting,
        robot_direction="base_in_flange",
        observed_direction="camera_in_target",
    )
    assert np.linalg.norm(solved.solution.x.translation - z[:3, 3]) < 5e-3
    (gate,) = (g for g in solved.verdict.gates if g.name == "no other reading fits")
    assert gate.blind_to == "both sides inverted"


def test_stated_noise_that_is_too_small_fails():
    from handeye_tri.records import PoseNoise

    robot, observed, mounting, *_ = simulated("eye_to_hand")
    right = PoseNoise(1e-6, 1e-6, 5e-4, 5e-4, 2e-3)
    tight = PoseNoise(1e-6, 1e-6, 1e-4, 1e-4, 4e-4)
    good, bad = (judge(robot, observed, mounting, noise=n) for n in (right, tight))
    assert good.verdict.outcome == "PASS"
    assert bad.verdict.outcome != "PASS"
    assert "LOOP" in codes(bad) or "DROPPED" in codes(bad)


def test_text_holds_what_is_asked_for():
    robot, observed, mounting, *_ = simulated("eye_in_hand")
    text = solved_text(judge(robot, observed, mounting))
    assert text.startswith("VERDICT  PASS")
    for name in (
        "flange_from_camera",
        "camera_from_flange",
        "base_from_target",
        "target_from_base",
    ):
        assert f"  {name}.x, mm" in text
        assert f"  {name}.rz, deg" in text
    assert "+- (1 sd)" in text
    assert text.count(" mm ") > 20
    assert "estimated from the residuals" in text


def test_long_lists_are_cut_but_not_what_was_dropped():
    robot, observed, mounting, *_ = simulated("eye_in_hand")
    rng = np.random.default_rng(1)
    robot, observed = (np.tile(poses, (4, 1, 1)) for poses in (robot, observed))
    observed = observed @ se3_exp(1e-4 * rng.standard_normal((80, 6)))
    robot[[7, 70]] = [random_pose(rng) for _ in range(2)]
    text = solved_text(judge(robot, observed, mounting))
    listed = text[text.index("RESIDUALS") :].splitlines()[1:]
    assert len(listed) == 61
    assert sorted(line.split()[0] for line in listed[:2]) == ["7", "70"]
    assert all("DROPPED" in line for line in listed[:2])
    assert listed[-1].startswith("  and 20 more, of at most ")


def test_json_is_complete_and_consistent():
    robot, observed, mounting, *_ = simulated("eye_to_hand")
    data = json.loads(
        json.dumps(solved_json(judge(robot, observed, mounting)), allow_nan=False)
    )
    assert data["verdict"] == "PASS"
    there = np.array(data["motions"]["flange_from_target"]["matrix"])
    back = np.array(data["motions"]["target_from_flange"]["matrix"])
    np.testing.assert_allclose(there @ back, np.eye(4), atol=1e-12)
    assert len(data["residuals"]) == 20
    # A position's sigma is the same seen from both ends up to the lever.
    there, back = (
        data["motions"][name]["sigma_rotation_rad"]
        for name in ("base_from_camera", "camera_from_base")
    )
    assert np.linalg.norm(there) == pytest.approx(np.linalg.norm(back), rel=1e-9)


def test_the_covariance_of_an_inverse_is_what_sampling_gives():
    from handeye_tri.solve import _motions

    robot, observed, mounting, *_ = simulated("eye_to_hand")
    named = {
        name: rest
        for name, *rest in _motions(judge(robot, observed, mounting).solution)
    }
    motion, covariance = named["base_from_camera"]
    inverse, expected = named["camera_from_base"]
    rng = np.random.default_rng(0)
    draws = rng.multivariate_normal(np.zeros(6), covariance, 20000)
    from handeye_tri.se3 import se3_log

    moved = se3_log(
        inverse.inverse().matrix @ se3_inverse(motion.matrix @ se3_exp(draws))
    )
    sampled = np.cov(moved.T)
    scale = np.sqrt(np.outer(np.diagonal(expected), np.diagonal(expected)))
    # 20000 draws tell a correlation to 0.7 %.
    np.testing.assert_allclose(sampled / scale, expected / scale, atol=0.04)


def write(path, robot, observed, mounting, **changes):
    data = {
        "schema": "handeye-tri poses 1",
        "mounting": mounting,
        "robot_poses": "flange_in_base",
        "observed_poses": "target_in_camera",
        "target_size": "known",
        "pairs": [
            {"robot": {"matrix_m": a.tolist()}, "observed": {"matrix_m": b.tolist()}}
            for a, b in zip(robot, observed, strict=True)
        ],
        **changes,
    }
    path.write_text(json.dumps(data))
    return path


def call(capsys, *arguments):
    with pytest.raises(SystemExit) as left:
        cli.main([str(argument) for argument in arguments])
    out, err = capsys.readouterr()
    return left.value.code, out, err


@pytest.mark.parametrize(
    ("option", "value"),
    [("--limit-mm", "-1"), ("--limit-deg", "0"), ("--limit-mm", "nan"), ("--seed", -1)],
)
def test_numbers_that_cannot_be_are_refused(capsys, tmp_path, option, value):
    robot, observed, mounting, *_ = simulated("eye_in_hand")
    path = write(tmp_path / "poses.json", robot, observed, mounting)
    code, out, err = call(capsys, "solve", path, option, value)
    assert (code, out) == (2, "")
    assert f"{value}" in err


def test_exit_codes_follow_the_verdict(capsys, tmp_path):
    robot, observed, mounting, x, z = simulated("eye_in_hand")
    path = tmp_path / "poses.json"
    write(path, robot, observed, mounting)
    code, out, err = call(capsys, "solve", path)
    assert (code, err) == (0, "")
    assert out.startswith("VERDICT  PASS")
    again = call(capsys, "solve", path)[1]
    assert again == out
    write(path, robot, observed, OPPOSITE[mounting])
    assert call(capsys, "solve", path)[0] == 3
    write(path, robot[:3], observed[:3], mounting)
    assert call(capsys, "solve", path)[0] == 4
    write(path, robot[:1], observed[:1], mounting)
    code, out, err = call(capsys, "solve", path)
    assert (code, out) == (2, "")
    assert "at least 3" in err
    write(
        path, np.tile(robot[:1], (5, 1, 1)), np.tile(observed[:1], (5, 1, 1)), mounting
    )
    code, out, err = call(capsys, "solve", path)
    assert (code, out) == (4, "")
    assert "cannot tell" in err
    assert call(capsys, "solve", tmp_path / "absent.json")[0] == 2


@pytest.mark.parametrize("method", ["shah", "li", "tsai_lenz", "daniilidis", "refined"])
def test_closed_forms_by_name(capsys, tmp_path, method):
    robot, observed, mounting, x, _ = simulated("eye_in_hand")
    path = write(tmp_path / "poses.json", robot, observed, mounting)
    code, out, _ = call(capsys, "solve", path, "--method", method, "--json")
    data = json.loads(out)
    assert code == 0
    assert method in data["method"]
    found = np.array(data["motions"]["flange_from_camera"]["translation_m"])
    assert np.linalg.norm(found - x[:3, 3]) < 6e-3


def test_an_unknown_method_is_named(capsys, tmp_path):
    robot, observed, mounting, *_ = simulated("eye_in_hand")
    path = write(tmp_path / "poses.json", robot, observed, mounting)
    code, _, err = call(capsys, "solve", path, "--method", "magic")
    assert code == 2
    assert "'magic'" in err
    assert "park_martin" in err


def test_a_scara_with_a_measured_shift_passes(capsys, tmp_path):
    rng = np.random.default_rng(4)
    x, z = random_pose(rng), random_pose(rng)
    z[:3, 3] += (0.3, 0.0, 1.0)
    turned = np.zeros((20, 6))
    turned[:, :3] = (0.2, 0.2, 0.08) * rng.standard_normal((20, 3))
    turned[:, 5] = rng.uniform(-2, 2, 20)
    robot = se3_exp(turned)
    observed = observe(robot, x, z, "eye_to_hand", rng)
    path = write(tmp_path / "poses.json", robot, observed, "eye_to_hand")
    code, out, _ = call(capsys, "solve", path)
    assert code == 4
    assert "OPEN: the shift along the axis" in out
    # Moved along the axis, X and Z fit as well: these numbers have no sigma.
    opened = [line.split()[0] for line in out.splitlines() if line.endswith(" OPEN")]
    shifted = np.eye(4)
    shifted[2, 3] = 1.0
    moved = {
        "flange_from_target": (x, shifted @ x),
        "base_from_camera": (z, shifted @ z),
        "target_from_flange": (se3_inverse(x), se3_inverse(shifted @ x)),
        "camera_from_base": (se3_inverse(z), se3_inverse(shifted @ z)),
    }
    assert sorted(opened) == sorted(
        f"{name}.{axis},"
        for name, (here, there) in moved.items()
        for axis, change in zip("xyz", (there - here)[:3, 3], strict=True)
        if abs(change) > 0.02
    )
    code, out, _ = call(
        capsys, "solve", path, "--shift-along-axis-mm", 1e3 * x[2, 3], "--json"
    )
    assert code == 0
    found = json.loads(out)["motions"]["flange_from_target"]["translation_m"]
    np.testing.assert_allclose(found, x[:3, 3], atol=5e-3)


def test_moveit_samples_need_the_mounting(capsys):
    real()
    path = DATA / "moveit_pose_samples" / "pose_samples.json"
    code, _, err = call(capsys, "solve", path, "--format", "moveit")
    assert code == 2
    assert "--mounting" in err
    arguments = ("solve", path, "--format", "moveit", "--mounting")
    assert call(capsys, *arguments, "eye_to_hand")[0] == 0
    assert call(capsys, *arguments, "eye_in_hand")[0] == 3

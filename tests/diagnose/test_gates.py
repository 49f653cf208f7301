import pytest

from handeye_tri.diagnose import gates

HEALTHY = (
    gates.half_turn_gate(0.05, 0.1),
    gates.motion_gate(60.0, 3, 20.0),
    gates.loop_gate(1.0),
    gates.scale_gate(1.0001, 0.0001),
    gates.track_gate(0.2, 1.0),
    gates.prediction_gate(1.0),
    gates.touch_gate(),
)
SICK = (
    gates.half_turn_gate(0.6, 0.1),
    gates.motion_gate(10.0, 3, 20.0),
    gates.loop_gate(3.0),
    gates.scale_gate(1.01, 0.0001),
    gates.track_gate(1.2, 1.0),
    gates.prediction_gate(3.0),
)


def test_healthy_gates_pass_and_name_the_nearest():
    verdict = gates.judge(HEALTHY, "All is well.")
    assert verdict.outcome == "PASS"
    assert verdict.findings == ()
    assert verdict.nearest.startswith("loop residual / expected 1.00")
    assert verdict.sentence == "All is well."


@pytest.mark.parametrize("number", range(len(SICK)))
def test_each_gate_alone_stops_a_pass_and_leaves_a_finding(number):
    mixed = tuple(
        SICK[number] if k == number else gate for k, gate in enumerate(HEALTHY)
    )
    verdict = gates.judge(mixed, "")
    expected = "CANNOT TELL" if SICK[number].undecided else "FAIL"
    assert verdict.outcome == expected
    assert len(verdict.findings) == 1
    assert SICK[number].found in verdict.findings[0].evidence
    assert verdict.findings[0].remedy


def test_findings_stand_worst_first():
    verdict = gates.judge(SICK, "")
    uses = [gate.use for gate in SICK]
    worst = SICK[uses.index(max(uses))]
    assert worst.name in verdict.findings[0].evidence
    assert len(verdict.findings) == len(SICK)


def test_a_gate_that_did_not_run_decides_nothing():
    assert gates.touch_gate().verdict == "not run"
    assert gates.judge(HEALTHY[:1] + HEALTHY[-1:], "").outcome == "PASS"


@pytest.mark.parametrize(
    ("use", "grade"),
    [(0.0, "good"), (0.84, "good"), (0.9, "marginal"), (1.01, "bad"),
     (float("nan"), "bad"), (float("inf"), "bad")],
)  # fmt: skip
def test_grades(use, grade):
    assert gates.graded(use) == grade


def test_limits_work_on_both_sides():
    assert gates.loop_gate(0.5).verdict == "bad"
    assert gates.loop_gate(0.0).verdict == "bad"
    assert gates.scale_gate(0.99, 0.0001).verdict == "bad"
    assert gates.scale_gate(1.0, 0.01).undecided
    assert gates.motion_gate(90.0, 1, 20.0).verdict == "bad"
    assert gates.motion_gate(0.0, 3, 20.0).verdict == "bad"

"""What is wrong with a session: each cause by name, with its numbers."""

from __future__ import annotations

from collections.abc import Sequence, Set
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from handeye_tri.adjustment import RobotParameters
from handeye_tri.diagnose.causes import best_cause, possible_causes, turned_angle
from handeye_tri.diagnose.gates import PREDICTION_GATE, Finding, Verdict
from handeye_tri.diagnose.images import blurred_views, image_findings, views_due
from handeye_tri.diagnose.loop import Cause, Fit, Loop
from handeye_tri.diagnose.mounts import mount_findings
from handeye_tri.diagnose.odd_views import OddView, odd_views
from handeye_tri.diagnose.sides import side_finding
from handeye_tri.records import DroppedHalfTurn, HandEyeCalibration, Session

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

# A cause, chi2 before it, and the cell as it has it.
Explained = tuple[Cause, float, Fit]

# Kinds of causes at single stations, and everywhere by a model of few numbers.
_SINGLE = ("turn", "pose", "view")
_EVERYWHERE = ("clock", "joint")
# Causes that are looked for one after the other.
_MOST = 8
# A reported half-turn may miss 180 degrees by this, radians, and by so many sigmas.
_TURN_TOLERANCE = float(np.radians(0.1))
_TURN_SIGMAS = 5.0


@dataclass(frozen=True, slots=True, eq=False)
class Evidence:
    """What a session is judged by.

    Attributes:
        session: All that was detected, whatever calibration left out.
        calibration: The calibrated cell.
        dropped: What the cameras' calibration left out.
        joints: The joints' offsets, where there is a model of the robot.
        edges: How wide each marker's edge is, (m, n, 3, 3): mean variance and both
            parts of its elongation, px^2; None where nobody measured it.
        recorded: The session as recorded, where ``session`` has other mounts, with
            which it calibrates; None where it is that.
    """

    session: Session
    calibration: HandEyeCalibration
    dropped: Sequence[DroppedHalfTurn] = ()
    joints: RobotParameters | None = None
    edges: Floats | None = None
    recorded: Session | None = None


def session_causes(evidence: Evidence) -> tuple[Finding, ...]:
    """Name what is wrong with a session, the likeliest first.

    Images speak first: views that are blurred, whose markers are exchanged, or that
    are those of another mount or station, are named and set aside. On the others the
    causes of :func:`possible_causes` compete, again and again until no further one is
    more than chance. With what is left the markers' sides, as the robot's motions give
    them, are held against the stated ones.
    """
    session = evidence.session
    shape = session.pixels.shape[:2]
    blurred = blurred_views(session, evidence.edges)
    usable: Bools = np.ones(shape, dtype=bool)
    for i, j in blurred:
        usable[i, j] = False
    start = _robust_start(evidence, usable)
    usable &= Loop(session).in_front(start)
    odd = odd_views(session, Loop(session).predicted_with_mounts(start))
    odd = [view for view in odd if usable[view.camera, view.station]]
    for view in odd:
        usable[view.camera, view.station] = False
    loop = Loop(session, usable)
    fit = loop.fitted(start)
    found: list[Explained] = []
    causes = possible_causes(session, evidence.joints)
    for _ in range(_MOST):
        best = best_cause(loop, fit, causes)
        if best is None:
            break
        cause, after, _ = best
        # A second motion at a station refines the first, which was fitted beside
        # what was not yet known.
        if not any(cause.station == one.station >= 0 for one, _, _ in found):
            found.append((cause, fit.chi2, after))
        fit = after
    names = [info.name for info in session.cameras]
    findings = [
        *image_findings(session, blurred, evidence.edges, views_due(loop, fit)),
        *mount_findings(
            evidence.recorded or session, session.mounts, session.half_turns, odd
        ),
        *_odd_findings(odd, names),
        *turn_findings(session, {c.station for c, _, _ in found if c.kind == "pose"}),
        *_cause_findings(found, names, "BLUR" if blurred else ""),
    ]
    side = side_finding(session, fit)
    return tuple(findings if side is None else [*findings, side])


def with_causes(verdict: Verdict, causes: Sequence[Finding]) -> Verdict:
    """The verdict with the causes before what follows from them.

    What is wrong with the whole session is not passed, whatever the gates say. Where
    all is passed nonetheless, each cause says what shows that the result holds.
    """
    if not causes:
        return verdict
    own = sorted((one for one in causes if not one.follows), key=_is_mild)
    symptoms = [replace(one, follows=own[0].code) for one in verdict.findings]
    further = [one for one in causes if one.follows]
    outcome = verdict.outcome
    if outcome == "PASS" and any(one.severity == "error" for one in causes):
        outcome = "FAIL"
    if outcome == "PASS":
        (gate,) = (gate for gate in verdict.gates if gate.name == PREDICTION_GATE)
        holds = f"; the result holds: {gate.name} {gate.found} (limit {gate.limit})"
        own = [replace(one, evidence=one.evidence + holds) for one in own]
    return replace(verdict, outcome=outcome, findings=(*own, *further, *symptoms))


def _is_mild(finding: Finding) -> bool:
    return finding.severity != "error"


def _robust_start(evidence: Evidence, usable: Bools) -> Fit:
    """The cell without what calibration left out, bad stations weighed down."""
    session = evidence.session.without(evidence.dropped)
    calibrated = Loop(session).start(evidence.calibration)
    loop = Loop(session, usable & Loop(session).in_front(calibrated))
    return loop.fitted(calibrated, robust=True)


def _odd_findings(odd: list[OddView], names: list[str]) -> list[Finding]:
    findings = []
    labels = [view for view in odd if view.kind == "labels"]
    if labels:
        findings.append(
            Finding(
                "LABELS",
                "markers were taken for each other",
                "; ".join(
                    f"{names[view.camera]}, station {view.station}: A, B, C are "
                    f"{view.reading} ({view.residual:.1f} px off, then {view.left:.2f})"
                    for view in labels
                ),
                "warning",
                "look at those images; check rig.marker_colours or marker_radii_mm "
                "against the markers in place, then detect again",
                *_where(labels, names),
            )
        )
    stale = [view for view in odd if view.kind == "stale"]
    if stale:
        findings.append(
            Finding(
                "STALE",
                "an image is that of another station",
                "; ".join(
                    f"{names[view.camera]}, station {view.station}: as at station "
                    f"{view.reading}, {view.residual:.0f} px from where it should be"
                    for view in stale
                ),
                "warning",
                "take an image only after the robot stands, and wait for a new frame; "
                "record those stations again",
                *_where(stale, names),
            )
        )
    return findings


def _where(views: list[OddView], names: list[str]) -> tuple[tuple[int, ...], str]:
    cameras = {view.camera for view in views}
    return (
        tuple(sorted({view.station for view in views})),
        names[cameras.pop()] if len(cameras) == 1 else "",
    )


def turn_findings(session: Session, misreported: Set[int]) -> list[Finding]:
    """Half-turns that are none, as the robot itself reports.

    Args:
        session: With the reported poses.
        misreported: Stations at which the cameras contradict the report.
    """
    poses = session.base_from_flange
    limit = max(_TURN_TOLERANCE, _TURN_SIGMAS * session.repeatability.rotation)
    wrong = [
        (turn, angle)
        for turn in session.half_turns
        if not misreported & {turn.before, turn.after}
        and abs(np.pi - (angle := turned_angle(poses[turn.before], poses[turn.after])))
        > limit
    ]
    if not wrong:
        return []
    return [
        Finding(
            "TURN_ANGLE",
            "a half-turn is not one of 180 degrees, by the robot's own account",
            "; ".join(
                f"stations {turn.before} and {turn.after}: "
                f"{np.degrees(angle):.2f} degrees reported"
                for turn, angle in wrong
            ),
            "warning",
            "correct the programme and repeat those half-turns; as they are, the "
            "cameras cannot use them",
            tuple(sorted({j for turn, _ in wrong for j in (turn.before, turn.after)})),
        )
    ]


def _cause_findings(
    found: list[Explained], names: list[str], moving: str
) -> list[Finding]:
    """A finding for each kind, in the order in which they explained most.

    How far a robot had got when its images were taken, or how its joints are off, is
    known by a model of few numbers. What single stations are off beside such a cause is
    what the model leaves of it, more likely than a further cause. Beside images of
    another time so is a step: there every station is off, each by another motion.

    Args:
        found: The causes.
        names: The cameras' names.
        moving: Code of the finding that the robot moved at single stations; "" where
            it did not.
    """
    kinds: dict[str, list[Explained]] = {}
    for one in found:
        kind = "joint" if one[0].kind == "joints" else one[0].kind
        kinds.setdefault(kind, []).append(one)
    makers = {
        "camera": _moved_finding,
        "rig": _moved_finding,
        "joint": _joint_finding,
        "clock": _clock_finding,
        "turn": _angle_finding,
        "pose": _pose_finding,
        "view": _view_finding,
    }
    findings = []
    for kind, group in kinds.items():
        finding = makers[kind](group, names)
        if moving and (kind in _SINGLE or moving == "CLOCK_OFFSET"):
            finding = replace(finding, follows=moving)
        elif kind in _EVERYWHERE:
            moving = finding.code
        findings.append(finding)
    return findings


def _fall(group: list[Explained]) -> str:
    return f"chi2 falls from {group[0][1]:.0f} to {group[-1][2].chi2:.0f}"


def _size(tangent: Floats) -> str:
    moved = 1e3 * float(np.linalg.norm(tangent[:3]))
    turned = float(np.degrees(np.linalg.norm(tangent[3:])))
    return f"{moved:.2f} mm, {turned:.3f} deg"


def _moved_finding(group: list[Explained], names: list[str]) -> Finding:
    steps = []
    for cause, _, fit in group:
        sigma = 1e3 * float(np.sqrt(np.trace(fit.covariance[:3, :3])))
        steps.append(
            f"{_size(fit.values)} (+- {sigma:.2f} mm) between stations "
            f"{cause.station - 1} and {cause.station}"
        )
    held = " and ".join(dict.fromkeys(c.label for c, _, _ in group if c.label))
    first = group[0][0]
    stations = tuple(sorted({cause.station for cause, _, _ in group}))
    if first.kind == "rig":
        return Finding(
            "RIG_SLIPPED",
            f"the rig moved on {held or 'the flange'} in the middle of the session",
            f"by {'; '.join(steps)}; {_fall(group)}",
            "error",
            "tighten the rig and record the session again; all before or all after it "
            "is a session of its own",
            stations,
        )
    moved = {names[cause.camera] for cause, _, _ in group}
    return Finding(
        "CAMERA_MOVED",
        f"the camera {' and '.join(sorted(moved))} moved in the middle of the session",
        f"by {'; '.join(steps)}; {_fall(group)}",
        "error",
        "fix the camera and record the session again; all before or all after it is a "
        "session of its own",
        stations,
        moved.pop() if len(moved) == 1 else "",
    )


def _joint_finding(group: list[Explained], names: list[str]) -> Finding:
    del names
    told = []
    for cause, _, fit in group:
        if cause.kind == "joint":
            sigma = np.degrees(np.sqrt(fit.covariance[0, 0]))
            told.append(
                f"{cause.label} {np.degrees(fit.values[0]):+.3f} +- {sigma:.3f} deg"
            )
        else:
            told.append(f"several joints together, {fit.rank} of them told apart")
    return Finding(
        "JOINT_OFFSET",
        "joints of the robot are not where it reports them",
        f"{'; '.join(told)}; {_fall(group)}",
        "error",
        "calibrate the robot's zero positions, or estimate them here: handeye-tri "
        "calibrate --robot joint-offsets,link-corrections",
    )


def _clock_finding(group: list[Explained], names: list[str]) -> Finding:
    del names
    cause, _, fit = group[0]
    word = {
        "late": "the robot had left for the next station",
        "early": "the robot had not arrived from the station before",
    }[cause.label]
    moved = 1e3 * np.linalg.norm(cause.flange[:, :3, 0] * fit.values[0], axis=1)
    return Finding(
        "CLOCK_OFFSET",
        f"images and robot poses are of different times: {word}",
        f"by {moved.max():.2f} mm at most, {np.median(moved):.2f} mm at the median "
        f"station; {_fall(group)}",
        "error",
        "wait until the robot stands, and read its pose and the image at the same time",
    )


def _angle_finding(group: list[Explained], names: list[str]) -> Finding:
    del names
    told = [
        f"station {cause.station}: {np.degrees(fit.values[0]):+.2f} +- "
        f"{np.degrees(np.sqrt(fit.covariance[0, 0])):.3f} deg"
        for cause, _, fit in group
    ]
    return Finding(
        "TURN_ANGLE",
        "a half-turn was not one of 180 degrees, although the robot reports so",
        f"{'; '.join(told)} about its axis beyond what was reported; {_fall(group)}",
        "error",
        "look whether the rig slips in the turn or the wrist is off; repeat those "
        "half-turns",
        tuple(sorted({cause.station for cause, _, _ in group})),
    )


def _pose_finding(group: list[Explained], names: list[str]) -> Finding:
    del names
    told = [f"station {cause.station}: {_size(fit.values)}" for cause, _, fit in group]
    return Finding(
        "POSE",
        "the robot was not where it reports at single stations",
        f"{'; '.join(told)}; {_fall(group)}",
        "error",
        "look whether it had come to rest, or was touched; record those stations again",
        tuple(sorted({cause.station for cause, _, _ in group})),
    )


def _view_finding(group: list[Explained], names: list[str]) -> Finding:
    views = [f"{names[cause.camera]}, station {cause.station}" for cause, _, _ in group]
    cameras = {names[cause.camera] for cause, _, _ in group}
    return Finding(
        "DETECTION",
        "markers in single images are not where everything else has them",
        f"{'; '.join(views)}; {_fall(group)}",
        "warning",
        "look at those images: light, focus, something before a marker; record those "
        "stations again",
        tuple(sorted({cause.station for cause, _, _ in group})),
        cameras.pop() if len(cameras) == 1 else "",
    )

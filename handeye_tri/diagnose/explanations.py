"""What stands behind each code of a finding, at length."""

from __future__ import annotations

from difflib import get_close_matches

from handeye_tri.diagnose.cause_explanations import CAUSES
from handeye_tri.diagnose.explanation import Explanation
from handeye_tri.errors import InputError

EXPLANATIONS: dict[str, Explanation] = {
    **CAUSES,
    "HALF_TURN": Explanation(
        "Between two stations the markers did not turn by 180 degrees about the stated "
        "axis, as the images alone show.",
        (
            "two markers were taken for each other, or something else for a marker",
            "the rig slipped on the flange, or a marker on the rig",
            "the robot did not turn by 180 degrees, or about another axis than the "
            "cell's rig.axis (the lines AA', BB', CC' then miss one common point O)",
            "the camera moved between the two images",
            "a lens bends the image more than the noise, and is not estimated "
            "(cameras[].estimate.lens)",
        ),
        "The figure is the worst half-turn's misfit in pixels: how far the lines "
        "through each marker before and after the turn miss their common point (normal "
        "axis), or the markers miss the plane pencil of an edge axis. The limit is "
        "five times what pixel noise and the robot's stated repeatability explain.",
        "Everything: the half-turns are what the cameras are calibrated from. The "
        "verdict is FAIL and export is refused.",
        (
            "look at the worst view's crops in report.html: were A, B and C found?",
            "check rig.axis in the cell, and that rig and markers are tight",
            "leave the half-turn out or repeat it; for an import, list them with "
            "--half-turns",
        ),
    ),
    "MOTION": Explanation(
        "The motions leave something undetermined, or nearly so.",
        (
            "the markers' planes at the half-turns are nearly parallel: two parallel "
            "planes say nothing new about a camera (Sec. III-F of the method's paper)",
            "the robot turned about one axis only: the position along that axis is "
            "then free in every hand-eye calibration",
            "there are too few stations",
        ),
        "For a session: the largest angle between two of the half-turns' planes, and "
        "the dimension that the axes of the robot's rotations span (needs 2). For bare "
        "poses: which directions are undetermined, by name. The limit is the cell's "
        "plan.min_plane_spread_deg.",
        "What is named as undetermined, and all that depends on it. Residuals stay "
        "small in this case and prove nothing: the verdict is CANNOT TELL.",
        (
            "add half-turns whose plane is tilted by 30 degrees about another axis",
            "for bare poses, add poses that turn by 20 degrees or more about a second "
            "axis; a 4-axis robot cannot: measure the open shift and state it",
        ),
    ),
    "LOOP": Explanation(
        "Robot poses and camera poses around the loop base, flange, markers, camera "
        "disagree by more, or less, than their stated noise.",
        (
            "more: the robot is less accurate than stated: joint offsets, link "
            "lengths, backlash (repeatability is not accuracy)",
            "more: poses and images do not belong together: shifted by one, taken "
            "while the robot still moved, or stamped by different clocks",
            "more: a camera or the rig moved in the middle of the session",
            "less: the stated repeatability is too large",
        ),
        "The root of chi2 per degree of freedom: 1 where the noise is as stated. "
        "Limits 0.6 and 1.6. It is blind to a scale that both sides share.",
        "The standard deviations at least: they are too small by that factor. Far "
        "above 1, the result itself.",
        (
            "see the residuals station by station in report.html: one station, a step "
            "in the middle, or all alike?",
            "check how poses and images were paired",
            "measure the robot's repeatability and state it "
            "(arm.repeatability_mm, arm.repeatability_deg)",
            "estimate the robot's own errors, too: handeye-tri calibrate --robot "
            "joint-offsets,link-corrections",
        ),
    ),
    "SCALE": Explanation(
        "Robot and cameras disagree on lengths, or the data cannot tell.",
        (
            "the triangle's sides (or the target's size) were measured wrongly",
            "millimetres were read as metres, or inches as millimetres",
            "the robot's lengths are off by a common factor",
        ),
        "The robot's lengths over the cameras' lengths with everything else free, "
        "against 1, within four of its standard deviations. Where those four exceed "
        "2 %, the motions were too small to tell.",
        "All positions, in proportion to the distance: 0.1 % is 1 mm at 1 m. Rotations "
        "and focal lengths stay right.",
        (
            "measure the sides again, between the marker centres",
            "check the unit of the poses; nothing is converted on a guess, and a small "
            "factor is never corrected in silence",
        ),
    ),
    "TRACK": Explanation(
        "At a station that calibration never saw, a marker lies farther from where the "
        "robot reports it than the cell allows.",
        (
            "whatever stands beside this finding: it is the sum of all errors",
            "the robot's repeatability is of the size of the limit",
            "too few half-turns: see where the predicted error comes from",
            "the station lies far outside of what the half-turns covered",
        ),
        "The largest distance of a marker's reported and observed positions, against "
        "the cell's track_limit_mm.",
        "Work that needs the limit. Coarser work may go on: set the limit that the "
        "work needs in the cell, not the one that passes.",
        (
            "mend what the other findings name",
            "see WHERE THE PREDICTED TRACK ERROR COMES FROM: add half-turns where it "
            "is the calibration, a better robot or detection where it is those",
        ),
    ),
    "PREDICTION": Explanation(
        "The held-out track is worse than the calibration's own covariance promised.",
        (
            "noise that is larger than stated, or not independent from station to "
            "station",
            "a wrong model: an unmodelled lens, a bent rig, a robot with systematic "
            "errors",
            "something moved between calibration and test",
        ),
        "The held-out track's root mean square over the predicted one. The limit is 2.",
        "Every standard deviation in the result. The values may still be good; they "
        "are not as good as they say.",
        (
            "look at the residuals: direction and place tell the cause",
            "estimate the lens (cameras[].estimate.lens) or the robot (calibrate "
            "--robot), and see which one brings it to 1",
        ),
    ),
    "DROPPED": Explanation(
        "Some data contradict the rest and were left out.",
        (
            "a marker was mistaken or half hidden in one image",
            "an image is stale, blurred, or of another station",
            "the robot was touched, or had not come to rest",
        ),
        "What was dropped, with its misfit and that of the others. One or two "
        "are ordinary; many point to something systematic.",
        "Nothing in the result; what was left out has no say in it. Coverage suffers "
        "where all of one region went.",
        (
            "look at the named images",
            "record those stations again where they are needed",
        ),
    ),
    "FEW": Explanation(
        "There are so few poses that wrong input would fit them as well.",
        ("fewer poses were recorded or given than a check needs",),
        "The number of poses against the least at which a wrong unit, an inverse or a "
        "shifted pairing would show.",
        "The verdict, not the numbers: they may be right, but nothing here shows it.",
        ("record 15 poses or more, turned about at least two axes",),
    ),
    "UNIT": Explanation(
        "The poses spread over a distance that no robot covers.",
        ("millimetres were read as metres, on both sides alike",),
        "The extent of the robot's positions in metres, against what robots reach.",
        "All lengths. A unit that is wrong on both sides leaves no other trace: "
        "residuals and rotations look perfect.",
        ("write translation_mm where the numbers are millimetres",),
    ),
    "RESIDUAL": Explanation(
        "Robot and camera contradict each other by more than any use allows.",
        (
            "poses are inverted: base_in_flange was given as flange_in_base",
            "the mounting is the other one (camera on the flange, or target on it)",
            "a rotation format or its order was read wrongly (x y z w for w x y z, "
            "rotation vector for Euler angles, degrees for radians)",
            "pairs are shifted: each pose beside the next one's picture",
        ),
        "Root mean square of the position (mm) or orientation (deg) residuals around "
        "the loop, against --limit-mm and --limit-deg.",
        "Everything.",
        (
            "see the other readings: each is solved and shown with its residual",
            "correct the file; nothing is converted on a guess",
        ),
    ),
    "READING": Explanation(
        "Another reading of the same file fits as well as the stated one, or better.",
        (
            "directions or mounting were stated the wrong way round (inverted poses "
            "and the other mounting give the same equation: both are named)",
            "pairs are shifted by one, or a unit is wrong on one side",
            "the motions are too poor to tell the readings apart",
        ),
        "The misfit of the stated reading and of the best other one.",
        "Everything: which of the two is true cannot be seen in the data.",
        (
            "find out which is true: move the robot along its base's x and see which "
            "number changes",
            "correct the head of the file",
        ),
    ),
    "CLOCKS": Explanation(
        "The two streams hardly turn alike, so that their clocks cannot be aligned.",
        (
            "they are of different motions",
            "the motion is too slow or too even: constant turning looks the same at "
            "every offset",
        ),
        "The largest correlation of both streams' rotation speeds over all offsets.",
        "The pairing of poses, and with it everything.",
        ("record a motion that turns fast and slow about several axes",),
    ),
}


def explain(code: str) -> Explanation:
    """The explanation of a code, in any case of letters.

    Raises:
        InputError: there is no such code; names those that there are.
    """
    name = code.strip().upper().replace("-", "_")
    if name not in EXPLANATIONS:
        near = get_close_matches(name, EXPLANATIONS, n=1)
        hint = f"did you mean {near[0]}? " if near else ""
        raise InputError(
            f"there is no finding {code!r:.60}; {hint}There are "
            f"{', '.join(sorted(EXPLANATIONS))}"
        )
    return EXPLANATIONS[name]

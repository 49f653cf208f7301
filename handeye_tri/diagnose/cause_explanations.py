"""What stands behind the causes that a session's own data name."""

from __future__ import annotations

from handeye_tri.diagnose.explanation import Explanation

# How a cause that moves something is told from others and from chance.
_COMPETED = (
    "chi2 is the sum of squared pixel residuals, each over its sigma with the robot's "
    "repeatability in it: once with nothing wrong, once with this cause's own numbers "
    "free. Causes compete by chi2 over the noise left, plus log(N) for each number "
    "and 2 log(k) for one of k places (Schwarz 1978, doi:10.1214/aos/1176344136); "
    "named is only what chance gives to 1 healthy session in 10,000 (Fisher's F)."
)

CAUSES: dict[str, Explanation] = {
    "CAMERA_MOVED": Explanation(
        "From some station on one camera stands elsewhere than before.",
        (
            "the camera or its stand was touched, or a screw gave way",
            "it had not warmed up, or a cable pulls on it",
        ),
        f"By how much it moved and turned, and between which stations. {_COMPETED}",
        "The place of that camera, and what it measures together with others. Its "
        "intrinsics may be good: half-turns on either side are whole.",
        (
            "fix the camera and record the session again",
            "or calibrate what lies on one side of the step as a session of its own",
        ),
    ),
    "RIG_SLIPPED": Explanation(
        "From some station on the rig sits elsewhere on the flange than before.",
        (
            "the clamp or the gripper gave way, often at a fast turn of the wrist",
            "the rig touched something",
        ),
        "By how much it moved and turned in the flange, and between which stations. "
        "All cameras see it, and it turns with the flange: that tells it from a "
        f"moved camera. {_COMPETED}",
        "The rig on the flange, and the cameras in the base, which hang on it.",
        (
            "tighten the rig, and record the session again",
            "or calibrate what lies on one side of the step as a session of its own",
        ),
    ),
    "JOINT_OFFSET": Explanation(
        "The robot's joints are not where it reports them, by a constant angle.",
        (
            "the zero of a joint was lost, or set by eye",
            "a link is bent or of another length: one joint's offset looks alike",
        ),
        "The offset of the joint that explains most. That of the first joint turns the "
        "base, that of the last often the rig: neither can be seen, and neither "
        f"matters. {_COMPETED}",
        "Positions all over the workspace, more the farther the robot reaches.",
        (
            "set the robot's zero positions by its maker's procedure",
            "or estimate them: handeye-tri calibrate --robot "
            "joint-offsets,link-corrections",
        ),
    ),
    "CLOCK_OFFSET": Explanation(
        "Every image belongs to another moment than the robot's pose beside it: the "
        "robot was still arriving, or already leaving.",
        (
            "the pose is read before the robot stands, or the image is late",
            "two clocks are not synchronised",
        ),
        "By how much the flange was off, along the way to the next station or from the "
        f"last one. {_COMPETED}",
        "Everything: each station is off by another amount in another direction.",
        (
            "wait at each station until the robot stands (0.5 s is ample)",
            "read pose and image at the same time, and after that wait",
        ),
    ),
    "TURN_ANGLE": Explanation(
        "A half-turn was not one of 180 degrees.",
        (
            "the rig or a gripper finger slipped in the turn",
            "the wrist has a limit, or the programme another angle",
        ),
        "By how many degrees the turn about the half-turn's own axis went on or "
        f"stopped short; or the angle that the robot itself reports. {_COMPETED}",
        "That half-turn for the cameras; with an angle that was reported wrongly, the "
        "robot's pose there as well.",
        (
            "look whether the wrist reaches the angle and whether the rig holds",
            "repeat those half-turns",
        ),
    ),
    "POSE": Explanation(
        "At single stations the robot was not where it reports, as all cameras see it.",
        (
            "it had not come to rest, or was touched",
            "the pose is that of another moment, or was typed in wrongly",
            "all cameras delivered an old image",
        ),
        f"How far from the reported pose the flange was. {_COMPETED}",
        "Those stations. They pull on the result unless they are left out.",
        ("record those stations again, or leave them out",),
    ),
    "LABELS": Explanation(
        "Markers were taken for each other.",
        (
            "colours or sizes in the cell are not those of the markers",
            "light or white balance changes their colours; radii too alike",
            "the rig was mounted with markers exchanged",
        ),
        "In which order A, B, C fit, and how far the markers are from where everything "
        "else has them, as named and in that order, px.",
        "Those views; where all are named wrongly, everything.",
        (
            "compare rig.marker_colours or marker_radii_mm with the markers in place",
            "look at the crops of those views in report.html",
        ),
    ),
    "MOUNT": Explanation(
        "The triangle was on another mount than is recorded for some stations.",
        (
            "the tool was changed earlier or later than the programme says",
            "the mounts were put on in the other order",
            "the stations' mounts, or the station of the tool change, were typed in "
            "wrongly",
        ),
        "How far the markers are from where everything else has them, as recorded and "
        "on the other mount, px; or what the half-turns turn about, as the markers "
        "show that stand still.",
        "Those stations; where half-turns are among them, what was calibrated from "
        "them.",
        (
            "see in the images which holder was on the flange",
            "state the tool change where it was made, and calibrate again",
        ),
    ),
    "STALE": Explanation(
        "An image shows the markers where they were at another station.",
        (
            "the camera's buffer still held the frame before",
            "the image was taken before the robot had left, or saved twice",
        ),
        "Which station's image it repeats (no marker moved by more than 6 sigmas), and "
        "how far the markers are from where they should be, px.",
        "Those views.",
        (
            "throw away one frame before each image, or trigger by software",
            "record those stations again",
        ),
    ),
    "BLUR": Explanation(
        "The markers' edges are wider along one direction than across it.",
        (
            "the robot still moved while the image was exposed",
            "something vibrates: the stand of the camera, the rig",
        ),
        "The length over which the image is drawn out, px: from the difference of the "
        "edges' variances along and across it, which is that length squared over 12. "
        "Limit 1 px, three times what views usually show, and five of its sigmas.",
        "Those views: a marker's centre is that of its way, the robot's pose that of "
        "one moment. They are left out of what else is judged here, not of the result.",
        (
            "wait until the robot stands; expose for a shorter time, with more light",
            "record those stations again",
        ),
    ),
    "DETECTION": Explanation(
        "Markers are found with much noise, or not at all, or in single images not "
        "where everything else has them.",
        (
            "little light, low contrast, high gain, glare, or out of focus",
            "something hides a part of a marker",
            "markers are small in the image: below 5 px radius",
        ),
        "How many markers lack, and the standard deviation of a centre, px, at the "
        "median and the worst view; 0.02 px is usual in a clean image. Limits: 2 % "
        f"missing, 0.1 px, five times the median. For single images: {_COMPETED}",
        "The accuracy, not the truth, where the stated sigmas are honest; images that "
        "fit nothing else pull on the result.",
        (
            "more and even light, focus, larger or more saturated markers, less gain",
            "look at the crops of the worst views in report.html",
        ),
    ),
    "SIDES": Explanation(
        "The triangle's sides, as the robot's motions give them, are not those stated.",
        (
            "a side was measured wrongly, or not between the marker centres",
            "markers sit otherwise than in the drawing",
            "after a tool change: another triangle, or a marker that moved in it",
            "where all sides are off by one factor: the robot's own lengths",
        ),
        "The sides |AB|, |AC| and the angle at A by the robot's motions with their "
        "standard deviations, against the stated ones. Named from 0.1 % on.",
        "Calibrated jointly, little: the sides are found anew. Step by step (--method "
        "separate), all positions.",
        (
            "measure again, between the marker centres",
            "correct rig.side_ab_mm, side_ac_mm, angle_deg",
        ),
    ),
}

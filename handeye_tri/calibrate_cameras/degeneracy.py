"""What leaves the camera undetermined, said before or after solving (Sec. III-F).

Zhao, Liu and Zhang 2008 (doi:10.1109/TIP.2008.2005562), Proposition 1: half-turns
whose supporting planes are parallel give the same two constraints. Singular values
say so on exact data only; on noisy data the spread of the planes against its own
uncertainty and the predicted sigma of the focal length are the better judges.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri, fdtri

from handeye_tri.calibrate_cameras.closed_form import NOMINAL_FOCAL
from handeye_tri.calibrate_cameras.half_turns import HalfTurnData
from handeye_tri.calibrate_cameras.homography import Homographies, vanishing_lines
from handeye_tri.calibrate_cameras.special_motion import foot_fraction
from handeye_tri.counting import counted
from handeye_tri.errors import DegenerateMotionError
from handeye_tri.triangle import EDGES, VERTICES, Axis, TriangleRig

Floats = NDArray[np.float64]

# Angle at an end of an edge axis nearer to 90 degrees than this: no homography.
_MIN_OFF_RIGHT_ANGLE = np.radians(1.0)
# Planes closer to parallel than this are one plane for any practical noise.
_MIN_PLANE_SPREAD_DEG = 0.5
# Homography residual over the triangle's mean side in the image; 2 degrees off a
# half-turn make about 0.01.
_MAX_TURN_RESIDUAL = 0.05
# Chance that noise alone makes parallel planes look different.
_CHANCE = 1e-3
# A focal length whose sigma is a larger part of it than this is not determined: four
# sigmas reach zero and infinity, and sigma itself means nothing.
MAX_RELATIVE_SIGMA = 0.25
# One whose sigma is larger than this is weak, and said to be.
_WEAK_RELATIVE_SIGMA = 0.02
# Sides over the image's longer side, tilt, spread and number below which each is named
# as a cause.
_SMALL_PART = 0.08
_LOW_TILT_DEG = 15.0
_LOW_SPREAD_DEG = 20.0
_FEW = 6
# Scaled information worse conditioned than this is singular in double precision.
MAX_CONDITION = 1e13
# Noise that is assumed at least where the residuals are at rounding, pixels.
_LEAST_NOISE_PX = 1e-3


def check_count(n: int, intrinsics: int, unknowns: int, per_half_turn: int) -> None:
    """Refuse fewer half-turns than unknowns need (Sec. III-C).

    Args:
        n: Complete half-turns.
        intrinsics: How many of the five are estimated.
        unknowns: Shared unknowns: intrinsics, lens coefficients, a shared O.
        per_half_turn: Observations of a half-turn less its own unknowns.

    Raises:
        DegenerateMotionError: says how many there are and how many are needed.
    """
    needed = max((intrinsics + 1) // 2, unknowns // per_half_turn + 1)
    if n < needed:
        remedy = "add half-turns about other planes"
        if intrinsics == 5 and n == 2 and unknowns - 1 < n * per_half_turn:
            remedy += ", or fix the skew at zero (skew=False), for which 2 are enough"
        raise DegenerateMotionError(
            f"{counted(n, 'half-turn')} {'is' if n == 1 else 'are'} too few for "
            f"{unknowns} unknowns of camera and axis"
            f"{' with skew' if intrinsics == 5 else ''}: at least {needed} are needed, "
            f"because each gives 2 constraints on K; {remedy}"
        )


def check_axis_ends(triangle: TriangleRig, axes: Sequence[Axis]) -> None:
    """Refuse an edge axis with a right angle at one of its ends.

    There B, B' and that end are in line: no homography, one constraint, not two.

    Raises:
        DegenerateMotionError: names the edge, the angle and the edge to use.
    """
    for axis in dict.fromkeys(axes):
        if axis == "normal":
            continue
        for vertex in EDGES[axis]:
            angle = triangle.angles[vertex]
            if abs(angle - 0.5 * np.pi) < _MIN_OFF_RIGHT_ANGLE:
                lengths = {
                    "AB": triangle.side_ab,
                    "BC": triangle.side_bc,
                    "CA": triangle.side_ac,
                }
                longest = max(lengths, key=lambda name: lengths[name])
                raise DegenerateMotionError(
                    f"the angle at {VERTICES[vertex]}, an end of the axis {axis}, is "
                    f"{np.degrees(angle):.2f} degrees (k = "
                    f"{foot_fraction(triangle, axis):.4f}): the turned marker, its "
                    "image and that end are in line, and each half-turn gives one "
                    f"constraint instead of two; turn about the longest edge {longest}"
                )


def _side_px(data: HalfTurnData) -> Floats:
    """Mean side of the triangle before each half-turn, shape (n,), pixels."""
    first = data.pixels[:, 0]
    sides = np.linalg.norm(first - np.roll(first, -1, axis=1), axis=-1)
    return np.asarray(sides.mean(axis=1))


def is_turn(
    data: HalfTurnData, residual_px: Floats, *, lens_ahead: bool = False
) -> NDArray[np.bool_]:
    """Which half-turns fit to within a twentieth of the triangle's side.

    Args:
        data: The half-turns.
        residual_px: Root mean square residual of each, shape (n,), pixels.
        lens_ahead: The residuals are of planes seen without the lens that is yet to
            be estimated. It bends a half-turn by a part of how far its two images
            reach, however small the triangle: a twentieth of that is allowed.
    """
    size = _reach_px(data) if lens_ahead else _side_px(data)
    return np.asarray(residual_px <= _MAX_TURN_RESIDUAL * size)


def _reach_px(data: HalfTurnData) -> Floats:
    """Largest distance of two of the six points of each half-turn, (n,), pixels."""
    points = data.pixels.reshape(-1, 6, 2)
    apart = np.linalg.norm(points[:, :, None] - points[:, None], axis=-1)
    return np.asarray(apart.max(axis=(1, 2)))


def check_turns(
    data: HalfTurnData, residual_px: Floats, *, lens_ahead: bool = False
) -> None:
    """Refuse images that are no half-turn about the stated axis, whatever K is.

    One plane must map to both images of a half-turn. An inexact robot misses that by
    pixels; a wrong axis, triangle or marker order by a good part of the triangle.

    Args:
        data: The half-turns.
        residual_px: Root mean square residual of each, shape (n,), pixels.
        lens_ahead: As for :func:`is_turn`.

    Raises:
        DegenerateMotionError: names the worst half-turn and its residual.
    """
    if is_turn(data, residual_px, lens_ahead=lens_ahead).all():
        return
    side = _side_px(data)
    worst = int(np.argmax(residual_px / side))
    raise DegenerateMotionError(
        f"half-turn {data.index[worst]} is no half-turn about {data.axes[worst]!r}: no "
        f"plane fits its two images, RMS residual {residual_px[worst]:.2f} px for a "
        f"triangle of {side[worst]:.0f} px; check the axis, the triangle, the order of "
        "A, B, C and which images belong together"
    )


def plane_spread_deg(normals: Floats) -> float:
    """Largest angle between two planes, degrees, of unit normals (n, 3)."""
    cosine = np.abs(normals @ normals.T).min()
    return float(np.degrees(np.arccos(min(cosine, 1.0))))


def check_planes(
    data: HalfTurnData, homographies: Homographies, noise_known: bool
) -> None:
    """Refuse planes that cannot be told from parallel ones (Proposition 1).

    The vanishing lines of parallel planes are equal, whatever K is. If their scatter
    is within what the pixel noise explains (chi-square, or Fisher's F where the noise
    is itself estimated; 1 in 1000), or the planes are within half a degree, K is
    undetermined.

    Args:
        data: The half-turns.
        homographies: One per half-turn.
        noise_known: Whether the covariances are absolute; otherwise they are scaled
            by the homographies' own chi2 / dof.

    Raises:
        DegenerateMotionError: says the spread and the tilt, in degrees, and how large
            the triangle is in the image.
    """
    line, covariance = vanishing_lines(homographies)
    # Normals as a nominal camera sees them: K is not known yet.
    normals = np.concatenate([NOMINAL_FOCAL * line, np.ones((len(line), 1))], axis=1)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    spread = plane_spread_deg(normals)
    if not noise_known:
        covariance = covariance * (homographies.chi2 / homographies.dof)
    covariance = covariance + np.eye(2) * 1e-18
    weight = np.linalg.inv(covariance)
    mean = np.linalg.solve(
        weight.sum(axis=0), (weight @ line[..., None])[..., 0].sum(axis=0)
    )
    chi2 = float(np.einsum("ni,nij,nj->", line - mean, weight, line - mean))
    freedom = 2 * (len(line) - 1)
    if noise_known:
        limit = float(chdtri(freedom, _CHANCE))
    else:
        limit = freedom * float(fdtri(freedom, homographies.dof, 1.0 - _CHANCE))
    explained = chi2 <= limit
    if not explained and spread >= _MIN_PLANE_SPREAD_DEG:
        return
    tilt = float(np.degrees(np.arccos(normals[:, 2].clip(-1.0, 1.0))).max())
    if explained and spread >= _LOW_SPREAD_DEG:
        raise DegenerateMotionError(
            f"the triangle's planes cannot be told from parallel ones in all "
            f"{len(line)} half-turns: the spread of {spread:.2f} degrees is no more "
            f"than noise, chi2 {chi2:.1f} of {limit:.1f}, because the triangle's mean "
            f"side is only {np.median(_side_px(data)):.0f} px; come nearer, use a "
            "larger triangle, or average images, and tilt it by at least 20 degrees "
            "between half-turns"
        )
    facing = " (all of them face the camera: fronto-parallel)" if tilt < 10 else ""
    scatter = (
        f"its scatter is no more than noise, chi2 {chi2:.1f} of {limit:.1f}"
        if explained
        else "the same plane to within half a degree"
    )
    raise DegenerateMotionError(
        f"the triangle's planes are parallel in all {len(line)} half-turns: spread "
        f"{spread:.2f} degrees, {scatter}; tilt at most {tilt:.1f} degrees{facing}. "
        "By Proposition 1 they give one pair of constraints; tilt the triangle by at "
        "least 20 degrees between half-turns"
    )


def invert_information(information: Floats) -> tuple[Floats, float]:
    """Covariance of an information matrix, and its condition scaled to unit diagonal.

    Through the eigenvalues of the scaled matrix, so that variances of nearly
    undetermined unknowns stay positive; infinite where the matrix is singular.

    Args:
        information: Shape (p, p).

    Returns:
        Shape (p, p); the condition number, infinite where singular.
    """
    diagonal = np.sqrt(np.diagonal(information))
    nothing = np.full(information.shape, np.inf)
    if not np.isfinite(information).all() or not (diagonal > 0).all():
        return nothing, float("inf")
    scale = np.outer(diagonal, diagonal)
    values, vectors = np.linalg.eigh(information / scale)
    if values[0] <= 0:
        return nothing, float("inf")
    covariance = (vectors / values) @ vectors.T / scale
    return 0.5 * (covariance + covariance.T), float(values[-1] / values[0])


def scaled_condition(information: Floats) -> float:
    """Condition number of an information matrix, (p, p), scaled to unit diagonal."""
    return invert_information(information)[1]


def check_determined(
    condition: float,
    focal: Floats,
    sigma: Floats,
    spread_deg: float,
    data: HalfTurnData,
    coefficients: int,
) -> None:
    """Refuse a focal length that the data do not determine.

    Args:
        condition: Of the scaled information on the shared unknowns.
        focal: fx and fy, shape (2,), pixels.
        sigma: Their predicted standard deviations, shape (2,), pixels.
        spread_deg: Largest angle between two planes, degrees.
        data: The half-turns.
        coefficients: How many lens coefficients are estimated.

    Raises:
        DegenerateMotionError: says sigma, spread, condition and the triangle's size.
    """
    relative = float((sigma / focal).max()) if np.isfinite(sigma).all() else np.inf
    if condition <= MAX_CONDITION and relative <= MAX_RELATIVE_SIGMA:
        return
    if coefficients > 2 and (relative <= MAX_RELATIVE_SIGMA or np.isinf(relative)):
        raise DegenerateMotionError(
            f"the half-turns do not tell {coefficients} lens coefficients apart "
            f"(condition {condition:.2g}, of fx alone a predicted sigma of "
            f'{sigma[0]:.3g} px); estimate fewer, as distortion=("k1", "k2"), give '
            "the others in fixed, or add views with the triangle in the image's corners"
        )
    raise DegenerateMotionError(
        f"the half-turns do not determine the focal length: fx {focal[0]:.1f} px with "
        f"a predicted sigma of {sigma[0]:.3g} px, fy {focal[1]:.1f} with "
        f"{sigma[1]:.3g} (condition {condition:.2g}, planes spread by "
        f"{spread_deg:.1f} degrees, sides of {np.median(_side_px(data)):.0f} px in the "
        f"image, {len(data)} half-turns); use at least three different planes, 20 "
        "degrees or more apart, and a triangle that is larger in the image"
    )


def weaknesses(
    data: HalfTurnData, normals: Floats, focal: Floats, sigma: Floats, condition: float
) -> tuple[str, ...]:
    """What makes a camera that is determined a weakly determined one.

    Args:
        data: The half-turns.
        normals: Unit normals of the planes in the camera's frame, shape (n, 3).
        focal: fx and fy, shape (2,), pixels.
        sigma: Their predicted standard deviations, shape (2,), pixels.
        condition: Of the scaled information on the shared unknowns.

    Returns:
        One sentence per cause, with the numbers and the remedy; none where both focal
        lengths are known to a fiftieth.
    """
    relative = float((sigma / focal).max())
    if relative <= _WEAK_RELATIVE_SIGMA:
        return ()
    side = float(np.median(_side_px(data)))
    spread = plane_spread_deg(normals)
    tilt = float(np.degrees(np.arccos(np.abs(normals[:, 2]).clip(0.0, 1.0))).max())
    n = len(data)
    part = side / max(data.image_size)
    causes = []
    if part < _SMALL_PART:
        causes.append(
            f"the triangle's sides are {side:.0f} px, {100 * part:.0f} % of the image: "
            "sigma falls with the square of the size, so bring it nearer or enlarge it"
        )
    if tilt < _LOW_TILT_DEG:
        causes.append(
            f"the triangle faces the camera, tilted by {tilt:.0f} degrees at most: "
            "tilt it by 30 to 60 degrees"
        )
    elif spread < _LOW_SPREAD_DEG:
        causes.append(
            f"the planes differ by {spread:.0f} degrees at most: turn the triangle so "
            "that they differ by 20 or more"
        )
    if n < _FEW:
        causes.append(f"there are {n} half-turns: use {_FEW} or more")
    if not causes:
        causes.append("the noise is large: average images, or add half-turns")
    head = (
        f"fx {focal[0]:.1f} +- {sigma[0]:.2g} px, fy {focal[1]:.1f} +- {sigma[1]:.2g} "
        f"px (plane spread {spread:.1f} degrees, condition {condition:.2g})"
    )
    return tuple(f"{head}: {cause}" for cause in causes)


def least_noise(chi2_per_dof: float, noise_known: bool) -> float:
    """Factor on covariances that keeps rounding-level residuals from hiding a gap."""
    return 1.0 if noise_known else max(chi2_per_dof, _LEAST_NOISE_PX**2)

"""Cameras: intrinsics, lens, projection with derivatives, triangulation.

Camera frames are optical: z forward, x right, y down. Pixel (0, 0) is the
*centre* of the first pixel. A point goes through: normalised plane (x/z, y/z),
lens (Brown-Conrady or rational), then K = [fx skew cx; 0 fy cy; 0 0 1].
"""

from handeye_tri.camera.lens import (
    LENS_COEFFICIENTS,
    Lens,
    LensModel,
    distort,
    distort_components,
    distort_jacobians,
)
from handeye_tri.camera.pinhole import (
    INTRINSIC_NAMES,
    Intrinsics,
    PinholeCamera,
    project_jacobians,
)
from handeye_tri.camera.stereo import StereoRig, triangulate

__all__ = [
    "INTRINSIC_NAMES",
    "LENS_COEFFICIENTS",
    "Intrinsics",
    "Lens",
    "LensModel",
    "PinholeCamera",
    "StereoRig",
    "distort",
    "distort_components",
    "distort_jacobians",
    "project_jacobians",
    "triangulate",
]

"""Projection against OpenCV, its derivatives, pixel conventions, bad input."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from handeye_tri.camera import Intrinsics, Lens, PinholeCamera
from handeye_tri.errors import InputError

Floats = NDArray[np.float64]
K = Intrinsics(1720.0, 1655.0, 0.0, 519.3, 377.8)
SKEWED = Intrinsics(1720.0, 1655.0, 2.5, 519.3, 377.8)
LENSES = [
    Lens(),
    Lens("radtan", np.array([-0.21, 0.09, 0.0008, -0.0011, 0.013])),
    Lens(
        "rational",
        np.array([-0.21, 0.09, 0.0008, -0.0011, 0.013, 0.11, -0.04, 0.006]),
    ),
]


def points(n: int = 60) -> Floats:
    rng = np.random.default_rng(1)
    return rng.uniform((-0.3, -0.2, 0.6), (0.3, 0.2, 1.4), (n, 3))


@pytest.mark.parametrize("lens", LENSES)
def test_projection_is_opencvs(lens: Lens) -> None:
    ours = PinholeCamera("left", K, (1024, 768), lens).project(points())
    expected, _ = cv2.projectPoints(
        points(), np.zeros(3), np.zeros(3), K.matrix, lens.coefficients
    )
    assert np.abs(ours - expected[:, 0]).max() < 1e-11


def test_skew_adds_to_u_in_proportion_to_the_distorted_y() -> None:
    """cv2 knows no skew: K as a matrix on the distorted plane is the oracle."""
    camera = PinholeCamera("left", SKEWED, (1024, 768), LENSES[1])
    p = points()
    distorted = camera.lens.distort(p[:, :2] / p[:, 2:])
    expected = np.c_[distorted, np.ones(len(p))] @ SKEWED.matrix.T
    assert np.abs(camera.project(p) - expected[:, :2]).max() < 1e-12


def test_pixel_conventions() -> None:
    """x right is u along fx and cx, y down is v along fy and cy; no transposition."""
    camera = PinholeCamera("left", SKEWED, (1024, 768))
    assert camera.project([0.0, 0.0, 0.7]) == pytest.approx([519.3, 377.8])
    assert camera.project([0.1, 0.0, 1.0]) == pytest.approx([519.3 + 172.0, 377.8])
    assert camera.project([0.0, 0.1, 1.0]) == pytest.approx(
        [519.3 + 0.25, 377.8 + 165.5]
    )


def test_behind_the_camera_is_nan() -> None:
    camera = PinholeCamera("left", K, (1024, 768), LENSES[1])
    pixels = camera.project([[0.1, 0.1, -1.0], [0.1, 0.1, 0.0], [0.1, 0.1, 1.0]])
    assert np.isnan(pixels[:2]).all()
    assert np.isfinite(pixels[2]).all()


@pytest.mark.parametrize("lens", LENSES)
def test_normalised_inverts_pixels(lens: Lens) -> None:
    camera = PinholeCamera("left", SKEWED, (1024, 768), lens)
    xy = points()[:, :2] / points()[:, 2:]
    assert np.abs(camera.normalised(camera.pixels(xy)) - xy).max() < 5e-15


@pytest.mark.parametrize("lens", LENSES)
def test_derivatives(lens: Lens) -> None:
    """Steps of 1e-6 of each unknown's size; errors eps * 1000 px / 1e-6 = 2e-7."""
    camera = PinholeCamera("left", SKEWED, (1024, 768), lens)
    p = points(12)
    pixels, by_point, by_intrinsics, by_lens = camera.project_jacobians(p)
    assert np.abs(pixels - camera.project(p)).max() < 1e-12

    def difference(plus: Floats, minus: Floats, step: float) -> Floats:
        return np.asarray((plus - minus) / (2 * step))

    for i in range(3):
        step = np.zeros(3)
        step[i] = 1e-6
        numeric = difference(camera.project(p + step), camera.project(p - step), 1e-6)
        assert np.abs(numeric - by_point[..., i]).max() < 1e-5  # px/m of 3000
    for i, size in enumerate((1000.0, 1000.0, 1.0, 1.0, 1.0)):
        step = np.zeros(5)
        step[i] = h = 1e-4 * size
        plus, minus = (
            PinholeCamera("c", Intrinsics.from_vector(v), (1, 1), lens).project(p)
            for v in (SKEWED.vector + step, SKEWED.vector - step)
        )
        # Linear in these unknowns: only rounding, eps * 1000 px / 1e-4.
        assert np.abs(difference(plus, minus, h) - by_intrinsics[..., i]).max() < 1e-8
    for i in range(len(lens.coefficients)):
        step = np.zeros(len(lens.coefficients))
        step[i] = 1e-5
        plus, minus = (
            PinholeCamera("c", SKEWED, (1, 1), Lens(lens.model, v)).project(p)
            for v in (lens.coefficients + step, lens.coefficients - step)
        )
        assert np.abs(difference(plus, minus, 1e-5) - by_lens[..., i]).max() < 1e-7


def test_batches_of_any_shape() -> None:
    camera = PinholeCamera("left", SKEWED, (1024, 768), LENSES[1])
    p = points(24)
    flat = camera.project_jacobians(p)
    batched = camera.project_jacobians(p.reshape(2, 4, 3, 3))
    for one, many in zip(flat, batched, strict=True):
        assert many.shape[:3] == (2, 4, 3)
        assert np.array_equal(many.reshape(one.shape), one)


def test_intrinsics_to_matrix_and_back_at_any_scale() -> None:
    back = Intrinsics.from_matrix(-3.0 * SKEWED.matrix)
    assert back.vector == pytest.approx(SKEWED.vector, rel=1e-15)
    assert Intrinsics.from_vector(SKEWED.vector) == SKEWED


@pytest.mark.parametrize(
    ("matrix", "message"),
    [
        (np.eye(4), r"shape \(3, 3\), got \(4, 4\)"),
        (K.matrix.T, "upper triangular"),
        (np.diag([1.0, 1.0, 0.0]), "non-zero last entry"),
        (np.diag([-1.0, 1.0, 1.0]), "fx > 0"),
        (np.full((3, 3), np.nan), "upper triangular"),
    ],
)
def test_matrix_refused(matrix: Floats, message: str) -> None:
    with pytest.raises(InputError, match=message):
        Intrinsics.from_matrix(matrix)


def test_vector_refused() -> None:
    with pytest.raises(InputError, match=r"five numbers \(fx fy skew cx cy\)"):
        Intrinsics.from_vector([1.0, 1.0, 0.0, 0.0])
    with pytest.raises(InputError, match="fx=nan"):
        Intrinsics(float("nan"), 1.0, 0.0, 0.0, 0.0)


@pytest.mark.parametrize("size", [(0, 10), (10,), (10, 10, 3), (10.5, 10)])
def test_image_size_refused(size: tuple[int, ...]) -> None:
    with pytest.raises(InputError, match=r"camera 'left': image_size must be"):
        PinholeCamera("left", K, size)  # type: ignore[arg-type]


def test_parameters_by_name():
    camera = PinholeCamera(
        "left",
        Intrinsics(1720.0, 1715.0, 0.5, 519.0, 377.0),
        (1024, 768),
        Lens("radtan", np.array([0.1, 0.2, 0.3, 0.4, 0.5])),
    )
    assert camera.parameter("skew") == 0.5
    assert camera.parameter("p2") == 0.4
    assert camera.parameter("k6") == 0.0
    with pytest.raises(InputError, match="no parameter 'k9'"):
        camera.parameter("k9")

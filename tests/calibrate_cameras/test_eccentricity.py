import numpy as np
import pytest
from scipy.optimize import least_squares

from handeye_tri.calibrate_cameras.eccentricity import sphere_shift
from handeye_tri.camera import Intrinsics, Lens, PinholeCamera
from handeye_tri.errors import InputError

INTRINSICS = Intrinsics(1720.0, 1715.0, 1.3, 519.3, 377.8)
PINHOLE = PinholeCamera("left", INTRINSICS, (1024, 768))
CENTRES = np.array(
    [[0.2, 0.15, 0.9], [-0.18, 0.1, 0.7], [0.0, 0.0, 0.8], [0.1, -0.2, 1.1]]
)


def traced_outline(camera, centre, radius, count=4000):
    """Pixels of points of the sphere at which the line of sight is tangential."""
    distance = np.linalg.norm(centre)
    toward = -centre / distance
    across = np.linalg.svd(toward[None])[2][1:]
    angle = np.linspace(0, 2 * np.pi, count, endpoint=False)
    circle = np.cos(angle)[:, None] * across[0] + np.sin(angle)[:, None] * across[1]
    ring = (
        centre
        + toward * radius**2 / distance
        + circle * radius * np.sqrt(1 - (radius / distance) ** 2)
    )
    return camera.project(ring)


def area_centroid(polygon):
    x, y = polygon.T
    following = np.roll(polygon, -1, axis=0)
    cross = x * following[:, 1] - following[:, 0] * y
    return ((polygon + following) * cross[:, None]).sum(0) / (3 * cross.sum())


@pytest.mark.parametrize("centre", CENTRES)
@pytest.mark.parametrize("radius", [0.004, 0.008, 0.05])
def test_pinhole_outline_has_its_centre_there_exactly(centre, radius):
    outline = traced_outline(PINHOLE, centre, radius)
    middle = PINHOLE.project(centre) + sphere_shift(PINHOLE, centre, radius)
    # An ellipse is its own mirror image in its centre; so is a regular sampling
    # of 4000 points up to the polygon's own resolution, (pi / 4000)^2 of 100 px.
    np.testing.assert_allclose(area_centroid(outline), middle, atol=1e-9)


@pytest.mark.parametrize("k1", [-0.2, 0.2])
@pytest.mark.parametrize("centre", CENTRES)
def test_bent_outline_to_fourth_order(k1, centre):
    lens = Lens("radtan", np.array([k1, 0.05, 1e-3, -5e-4, 0.0]))
    camera = PinholeCamera("left", INTRINSICS, (1024, 768), lens)
    outline = area_centroid(traced_outline(camera, centre, 0.008))
    middle = camera.project(centre) + sphere_shift(camera, centre, 0.008)
    np.testing.assert_allclose(outline, middle, atol=1e-4)
    # Mapping the ellipse's centre through the lens would not do: off by 0.03 px.
    depth = centre[2]
    mapped = camera.pixels(centre[:2] * depth / (depth**2 - 0.008**2))
    off_axis = np.hypot(*centre[:2]) > 0.1
    assert (np.linalg.norm(outline - mapped) > 5e-3) == off_axis


def test_least_squares_ellipse_lies_at_the_centroid():
    lens = Lens("rational", np.array([0.2, 0.05, 1e-3, -5e-4, 0, 0.1, 0, 0]))
    camera = PinholeCamera("left", INTRINSICS, (1024, 768), lens)
    outline = traced_outline(camera, CENTRES[0], 0.008, 400)
    x, y = (outline - outline.mean(0)).T / 10
    terms = np.stack([x * x, x * y, y * y, x, y], axis=1)
    a, b, c, d, e = np.linalg.lstsq(terms, np.ones(len(x)), rcond=None)[0]
    fitted = 10 * np.linalg.solve([[2 * a, b], [b, 2 * c]], [-d, -e])
    middle = camera.project(CENTRES[0]) + sphere_shift(camera, CENTRES[0], 0.008)
    # Second order in the bending, which moves the outline by 0.03 of 15 px.
    np.testing.assert_allclose(fitted + outline.mean(0), middle, atol=2e-3)


@pytest.mark.parametrize("centre", CENTRES)
def test_the_ellipse_nearest_to_a_bent_outline_lies_there(centre):
    """Detection fits distances to the outline: the same centre to 1e-5 px."""
    lens = Lens("radtan", np.array([-0.19, 0.14, 6e-4, -4e-4, 0.0]))
    camera = PinholeCamera("left", INTRINSICS, (1024, 768), lens)
    outline = traced_outline(camera, centre, 0.008, 400)

    def distances(ellipse):
        x, y = (outline - ellipse[:2]).T
        size, e, f = ellipse[2:]
        across, down = (1 + e) * x + f * y, f * x + (1 - e) * y
        q = np.sqrt(x * across + y * down)
        return (q - size) * q / np.hypot(across, down)

    start = [*outline.mean(axis=0), 15.0, 0.0, 0.0]
    fitted = least_squares(distances, start, xtol=1e-14, ftol=1e-14).x[:2]
    middle = camera.project(centre) + sphere_shift(camera, centre, 0.008)
    np.testing.assert_allclose(fitted, middle, atol=1e-5)
    # What the lens adds to a pinhole's outline is a thousand times that.
    axial = centre - np.array([0.0, 0.0, 0.008**2 / centre[2]])
    added = np.linalg.norm(middle - camera.project(axial))
    assert (added > 5e-3) == (np.hypot(*centre[:2]) > 0.1)


def test_point_and_unseen_and_engulfed():
    points = np.array([[0.1, 0.1, 1.0], [np.nan, 0.1, 1.0], [0.0, 0.0, 0.01]])
    shift = sphere_shift(PINHOLE, points, np.array([0.0, 0.01, 0.01]))
    np.testing.assert_array_equal(shift[0], 0.0)
    assert np.isnan(shift[1:]).all()


def test_radii_broadcast_over_views():
    points = np.stack([CENTRES[:3], CENTRES[1:]])
    radii = np.array([0.006, 0.008, 0.01])
    shift = sphere_shift(PINHOLE, points, radii)
    assert shift.shape == (2, 3, 2)
    np.testing.assert_array_equal(
        shift[1, 2], sphere_shift(PINHOLE, points[1, 2], radii[2])
    )


@pytest.mark.parametrize("radius", [-0.001, np.nan, np.inf])
def test_impossible_radius(radius):
    with pytest.raises(InputError, match="radii"):
        sphere_shift(PINHOLE, CENTRES, radius)

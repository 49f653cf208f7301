"""Detection on analytic discs: accuracy, honest covariance, reasons; and on renders."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from handeye_tri import storage
from handeye_tri.arm import Arm
from handeye_tri.calibrate_cameras.eccentricity import sphere_shift
from handeye_tri.detect import (
    Detection,
    MarkerSpec,
    detect_markers,
    detection_sheet,
)
from handeye_tri.detect.outline import common_scatter
from handeye_tri.errors import InputError
from handeye_tri.plan import plan_motions
from handeye_tri.simulate import compile_mechanism, render_views

Floats = NDArray[np.float64]
Image = NDArray[np.uint8]

PURE = np.eye(3)
EQUAL = np.array([0.008, 0.008, 0.008])
THREE_SIZES = np.array([0.0065, 0.008, 0.010])
BY_COLOUR = MarkerSpec("colour", PURE, EQUAL)
BY_RADIUS = MarkerSpec("radius", np.ones((3, 3)), THREE_SIZES)
Inside = Callable[[Floats, Floats], NDArray[np.bool_]]


class Canvas:
    """A picture in which shapes cover parts of pixels by area."""

    def __init__(self, width: int, height: int, level: float, channels: int = 3):
        self.levels = np.full((height, width, channels), float(level))

    def paint(
        self, colour: object, box: tuple[float, ...], inside: Inside, fine: int
    ) -> None:
        """Cover what ``inside(x, y)`` says within box (left, top, right, bottom)."""
        height, width = self.levels.shape[:2]
        left, top = (max(0, int(np.floor(v)) - 1) for v in box[:2])
        right = min(width, int(np.ceil(box[2])) + 2)
        bottom = min(height, int(np.ceil(box[3])) + 2)
        if right <= left or bottom <= top:
            return
        part = (np.arange(fine) + 0.5) / fine - 0.5
        x = (np.arange(left, right)[:, None] + part).ravel()
        y = (np.arange(top, bottom)[:, None] + part).ravel()
        mask = inside(x[None, :], y[:, None])
        cover = mask.reshape(bottom - top, fine, right - left, fine).mean(axis=(1, 3))
        area = self.levels[top:bottom, left:right]
        area += cover[..., None] * (np.asarray(colour, dtype=float) - area)

    def disc(
        self,
        colour: object,
        centre: Floats,
        radius: float,
        stretch: float = 1.0,
        fine: int = 16,
    ) -> None:
        """An ellipse, stretched by a factor along the diagonal."""
        u, v = centre

        def inside(x: Floats, y: Floats) -> NDArray[np.bool_]:
            along, across = (x - u + y - v) / np.sqrt(2), (x - u - y + v) / np.sqrt(2)
            return (along / stretch) ** 2 + across**2 < radius**2

        r = radius * max(stretch, 1.0) + 1
        self.paint(colour, (u - r, v - r, u + r, v + r), inside, fine)

    def rod(self, colour: object, start: Floats, end: Floats, width: float) -> None:
        """A straight bar with round ends."""
        d = np.subtract(end, start)
        length = float(np.linalg.norm(d))
        d = d / length

        def inside(x: Floats, y: Floats) -> NDArray[np.bool_]:
            along = np.clip((x - start[0]) * d[0] + (y - start[1]) * d[1], 0, length)
            away = np.hypot(x - start[0] - along * d[0], y - start[1] - along * d[1])
            return away < width / 2

        low, high = np.minimum(start, end) - width, np.maximum(start, end) + width
        self.paint(colour, (*low, *high), inside, 4)

    def image(
        self, rng: np.random.Generator, noise: float = 0.0, blur: float = 0.0
    ) -> Image:
        """8 bits, blur in px, noise in percent of 255."""
        levels = self.levels
        if blur:
            levels = gaussian_filter(levels, blur, axes=(0, 1))
        levels = levels + rng.normal(0.0, 2.55 * noise, levels.shape)
        image = np.clip(np.rint(levels), 0, 255).astype(np.uint8)
        return image[..., 0] if image.shape[2] == 1 else image


def place(rng: np.random.Generator) -> Floats:
    """Three centres in a 320 x 240 image, apart from each other and the border."""
    while True:
        centres = rng.uniform((40, 40), (279, 199), (3, 2))
        gaps = [
            np.linalg.norm(centres[i] - centres[j]) for i, j in ((0, 1), (1, 2), (0, 2))
        ]
        if min(gaps) > 60:
            return centres


def errors_of(
    detections: list[Detection], centres: list[Floats]
) -> tuple[Floats, Floats]:
    """Errors, shape (n, 2), and normalised squared errors per axis, shape (n,)."""
    for detection in detections:
        assert detection.complete, detection.reasons
    error = np.array([d.pixels - c for d, c in zip(detections, centres, strict=True)])
    cov = np.array([d.covariance for d in detections])
    squares = np.einsum("nmi,nmij,nmj->nm", error, np.linalg.inv(cov), error) / 2
    return error.reshape(-1, 2), squares.ravel()


def coloured(
    rng: np.random.Generator,
    centres: Floats,
    *,
    colours: Floats = PURE,
    radius: float = 14.3,
    rods: int = 0,
    noise: float = 0.0,
    blur: float = 0.0,
    fine: int = 16,
) -> Image:
    """Three discs on neutral patches, rods behind them."""
    canvas = Canvas(320, 240, 120)
    for _ in range(4):
        start = rng.uniform((0, 0), (300, 220))
        level = rng.uniform(30, 220)
        canvas.rod(level, start, start + rng.uniform(-90, 90, 2), rng.uniform(20, 60))
    for centre in np.repeat(centres, rods, axis=0):
        end = centre + 60 * np.array(np.sin(rng.uniform(0, 6.3) + np.array([0, 1.57])))
        canvas.rod(rng.uniform(20, 90), centre, end, 5.0)
    for centre, colour in zip(centres, colours, strict=True):
        canvas.disc(255 * colour, centre, radius, rng.uniform(1.0, 1.06), fine)
    return canvas.image(rng, noise, blur)


def test_exact_areas_give_the_centre_to_a_few_thousandths() -> None:
    rng = np.random.default_rng(1)
    centres = [place(rng) for _ in range(8)]
    found = [detect_markers(coloured(rng, c), BY_COLOUR) for c in centres]
    error, _ = errors_of(found, centres)
    # 8 bits and 16 x 16 parts per pixel leave about 0.002 px.
    assert np.sqrt((error**2).mean(axis=0)).max() < 0.005
    radii = np.array([d.radii_px for d in found])
    assert np.abs(radii - 14.3 * np.sqrt(1.03)).max() < 0.3


@pytest.mark.parametrize(("noise", "blur"), [(2.0, 0.8), (3.0, 0.0)])
def test_noise_blur_and_rods(noise: float, blur: float) -> None:
    rng = np.random.default_rng(2)
    centres = [place(rng) for _ in range(25)]
    found = [
        detect_markers(coloured(rng, c, rods=2, noise=noise, blur=blur), BY_COLOUR)
        for c in centres
    ]
    error, squares = errors_of(found, centres)
    assert np.sqrt((error**2).mean(axis=0)).max() < 0.02
    # 1 is expected of 75 centres, with a standard deviation of 0.12.
    assert 0.65 < squares.mean() < 1.4


@pytest.mark.parametrize(("noise", "blur"), [(2.0, 0.8), (0.0, 0.8), (0.0, 0.0)])
def test_the_covariance_of_a_rendered_staircase(noise: float, blur: float) -> None:
    """Pixels of 2 x 2 samples: the edge's steps are the noise, smoothed by the blur."""
    rng = np.random.default_rng(16)
    centres = [place(rng) for _ in range(25)]
    found = [
        detect_markers(coloured(rng, c, noise=noise, blur=blur, fine=2), BY_COLOUR)
        for c in centres
    ]
    error, squares = errors_of(found, centres)
    assert 0.01 < np.sqrt((error**2).mean()) < 0.02
    assert 0.65 < squares.mean() < 1.4


@pytest.mark.parametrize("shown", [0.45, 0.6, 0.75])
def test_a_cap_of_a_ball_is_not_a_smaller_ball(shown: float) -> None:
    """A slanted bar hides the lower part: found where it is, or not at all."""
    for seed in range(6):
        rng = np.random.default_rng([18, seed])
        canvas = Canvas(160, 120, 60)
        centre = np.array([80.0, 60.0]) + rng.uniform(-0.5, 0.5, 2)
        canvas.disc((0, 0, 255), centre, 15.0, fine=8)
        slope, level = rng.uniform(-0.3, 0.3), rng.uniform(120, 200)
        top = centre[1] + 15.0 * (2 * shown - 1)

        def below(x: Floats, y: Floats) -> NDArray[np.bool_]:
            return y > top + slope * (x - centre[0])  # noqa: B023

        canvas.paint((level,) * 3, (40.0, 30.0, 120.0, 100.0), below, 8)
        found = detect_markers(canvas.image(rng), BY_COLOUR)
        off = np.linalg.norm(found.pixels[2] - centre)
        assert not off > 0.5


def test_a_ball_before_a_dark_and_a_light_thing_is_whole() -> None:
    """A dark collar behind most of the largest ball, a light arm behind the rest."""
    rng = np.random.default_rng(21)
    centres = place(rng)
    canvas = Canvas(320, 240, 140, channels=1)
    x, y = centres[2]

    def collar(u: Floats, v: Floats) -> NDArray[np.bool_]:
        return v < y + 6.0 + 0.1 * (u - x)

    def arm(u: Floats, v: Floats) -> NDArray[np.bool_]:
        return v >= y + 6.0 + 0.1 * (u - x)

    box = (x - 30.0, y - 30.0, x + 30.0, y + 30.0)
    canvas.paint(45, box, collar, 8)
    canvas.paint(175, box, arm, 8)
    for centre, radius in zip(centres, (13.0, 16.0, 20.0), strict=True):
        canvas.disc(250, centre, radius)
    found = detect_markers(canvas.image(rng), BY_RADIUS)
    assert np.abs(found.pixels - centres).max() < 0.1


def test_noise_of_the_background_is_in_the_covariance() -> None:
    """What it moves together counts more for the centre than for a finer wave."""
    rng = np.random.default_rng(17)
    squares = []
    for _ in range(200):
        canvas = Canvas(230, 80, 120)
        centres = np.array([[40.0, 40.0], [115.0, 40.0], [190.0, 40.0]])
        centres += rng.uniform(-0.5, 0.5, (3, 2))
        for centre, colour in zip(centres, PURE, strict=True):
            canvas.disc(255 * colour, centre, 18.0, fine=8)
        found = detect_markers(canvas.image(rng, noise=2.0, blur=0.8), BY_COLOUR)
        squares.append(errors_of([found], [centres])[1])
    # 1 is expected of 600 centres, with a standard deviation of 0.041.
    assert 0.9 < np.mean(squares) < 1.08


def test_one_scatter_for_the_outlines_of_an_image() -> None:
    """Three of 16 numbers each: the mean of Student's t with 48; a bad one alone."""
    alike = common_scatter(np.array([1.0, 2.0, 1.5]))
    np.testing.assert_allclose(alike, 1.5 * 48 / 46)
    bad = common_scatter(np.array([1.0, 9.0, 1.4]))
    np.testing.assert_allclose(bad, [1.2 * 32 / 30, 9.0 * 16 / 14, 1.2 * 32 / 30])
    np.testing.assert_allclose(common_scatter(np.array([2.0])), 2.0 * 16 / 14)


def test_the_covariance_follows_the_contrast_and_the_noise() -> None:
    """One scene, many noises: predicted against sampled spread, grey on grey."""
    rng = np.random.default_rng(3)
    centres = place(rng)
    for level, noise in ((235, 1.0), (60, 2.0)):
        canvas = Canvas(320, 240, 140, channels=1)
        for centre, radius in zip(centres, (13.0, 16.0, 20.0), strict=True):
            canvas.disc(level, centre, radius)
        clean = canvas.levels
        found = []
        for _ in range(60):
            canvas.levels = clean
            found.append(detect_markers(canvas.image(rng, noise, 0.0), BY_RADIUS))
        error, _ = errors_of(found, [centres] * 60)
        sampled = error.reshape(60, 3, 2).std(axis=0)
        predicted = np.mean([d.covariance for d in found], axis=0)
        sigma = np.sqrt(np.diagonal(predicted, axis1=1, axis2=2))
        # 60 samples tell a standard deviation to 9 %; the steps of the discs, the same
        # in all samples, are part of the prediction.
        ratio = sigma / np.hypot(sampled, 0.003)
        assert ratio.min() > 0.7
        assert ratio.max() < 1.4


def grey_scene(
    rng: np.random.Generator,
    centres: Floats,
    level: float,
    background: float,
    radii: tuple[float, ...] = (13.0, 16.0, 20.0),
) -> Canvas:
    """Three sizes of one level, each with two rods behind it, before two patches."""
    canvas = Canvas(320, 240, background, channels=1)
    canvas.rod(background + 20, np.array([0, 30]), np.array([320, 190]), 70)
    for centre, radius in zip(centres, radii, strict=True):
        for turn in rng.uniform(0, 2 * np.pi, 2):
            end = centre + 45 * np.array([np.cos(turn), np.sin(turn)])
            canvas.rod(background - 45, centre, end, 5.0)
        canvas.disc(level, centre, radius)
    return canvas


@pytest.mark.parametrize(("level", "background"), [(250, 110), (15, 150), (200, 110)])
def test_grey_markers_of_either_contrast_are_told_apart_by_size(
    level: float, background: float
) -> None:
    rng = np.random.default_rng(4)
    spec = MarkerSpec("radius", np.full((3, 3), level / 255), THREE_SIZES)
    centres = [place(rng) for _ in range(12)]
    found = [
        detect_markers(grey_scene(rng, c, level, background).image(rng, 2.0), spec)
        for c in centres
    ]
    error, _ = errors_of(found, centres)
    assert np.sqrt((error**2).mean()) < 0.04
    assert np.abs(error).max() < 0.2


def test_sizes_name_the_markers_in_any_order() -> None:
    rng = np.random.default_rng(5)
    centres = place(rng)
    canvas = grey_scene(rng, centres, 250, 110, (20.0, 13.0, 16.0))
    spec = MarkerSpec("radius", np.ones((3, 3)), THREE_SIZES[[2, 0, 1]])
    found = detect_markers(canvas.image(rng), spec)
    assert np.abs(found.pixels - centres).max() < 0.1


def test_an_rgb_image_of_grey_balls_will_do() -> None:
    rng = np.random.default_rng(6)
    centres = place(rng)
    image = grey_scene(rng, centres, 250, 110).image(rng)
    rgb = np.repeat(image[..., None], 3, axis=2)
    found = detect_markers(rgb, BY_RADIUS)
    assert np.abs(found.pixels - centres).max() < 0.1


def test_round_things_of_another_level_are_no_markers() -> None:
    """A hub's cap may have a marker's size: the balls' common paint tells."""
    rng = np.random.default_rng(7)
    centres = np.array([[70.2, 80.4], [160.8, 150.1], [250.3, 70.6]])
    canvas = grey_scene(rng, centres[1:], 250, 110, (16.0, 20.0))
    canvas.disc(40, centres[0], 13.0)
    assert not detect_markers(canvas.image(rng), BY_RADIUS).complete
    canvas.disc(250, centres[0], 13.0)
    canvas.disc(40, np.array([60.0, 180.0]), 14.0)
    found = detect_markers(canvas.image(rng), BY_RADIUS)
    assert np.abs(found.pixels - centres).max() < 0.1


@pytest.mark.parametrize(
    "colours",
    [PURE, 1.0 - PURE, np.array([[1, 0.5, 0], [0.1, 0.9, 0.3], [0.6, 0.1, 0.9]])],
    ids=["pure", "two channels", "mixed"],
)
def test_any_three_hues(colours: Floats) -> None:
    rng = np.random.default_rng(8)
    spec = MarkerSpec("colour", colours, EQUAL)
    centres = [place(rng) for _ in range(6)]
    found = [
        detect_markers(coloured(rng, c, colours=colours, rods=1, noise=1.0), spec)
        for c in centres
    ]
    error, _ = errors_of(found, centres)
    assert np.sqrt((error**2).mean()) < 0.02


def test_small_markers_are_found_at_a_finer_look() -> None:
    rng = np.random.default_rng(9)
    centres = [place(rng) for _ in range(4)]
    found = [
        detect_markers(coloured(rng, c, radius=4.5, noise=2.0), BY_COLOUR)
        for c in centres
    ]
    error, squares = errors_of(found, centres)
    assert np.abs(error).max() < 0.1
    assert 0.3 < squares.mean() < 2.0


@pytest.mark.parametrize("depth", [2.0, 4.0, 7.0, 12.0])
@pytest.mark.parametrize("spec", [BY_COLOUR, BY_RADIUS], ids=["colour", "grey"])
def test_a_hidden_outline_gives_a_reason_and_no_biased_centre(
    spec: MarkerSpec, depth: float
) -> None:
    """A bar before the third ball; its straight edge is ``depth`` px inside."""
    rng = np.random.default_rng(10)
    centres = np.array([[80.3, 100.2], [160.7, 60.4], [240.2, 130.8]])
    is_grey = spec.identity == "radius"
    refused = 0
    for turn in rng.uniform(0, 2 * np.pi, 6):
        canvas = Canvas(320, 240, 120, 1 if is_grey else 3)
        for k, radius in enumerate((13.0, 16.0, 20.0)):
            canvas.disc(250 if is_grey else 255 * PURE[k], centres[k], radius)
        away = np.array([np.cos(turn), np.sin(turn)])
        along = np.array([-away[1], away[0]])
        middle = centres[2] + (20.0 - depth + 10.0) * away
        canvas.rod(60, middle - 40 * along, middle + 40 * along, 20)
        found = detect_markers(canvas.image(rng, 1.0, 0.5), spec)
        if found.reasons[2] is None:
            assert np.abs(found.pixels[2] - centres[2]).max() < 0.1
        else:
            refused += 1
            assert np.isnan(found.pixels[2]).all()
            assert np.isnan(found.covariance[2]).all()
            if not is_grey:
                assert found.reasons[2] in ("occluded", "not_round")
                assert np.abs(found.pixels[:2] - centres[:2]).max() < 0.1
    assert refused >= 5


@pytest.mark.parametrize("shift", [0.0, 7.0, 13.0])
def test_a_marker_cut_by_the_border_is_refused(shift: float) -> None:
    rng = np.random.default_rng(11)
    centres = np.array([[shift, 120.0], [160.0, 60.0], [240.0, 150.0]])
    found = detect_markers(coloured(rng, centres), BY_COLOUR)
    assert found.reasons[0] in ("at_border", "occluded", "no_fit")
    assert np.isnan(found.pixels[0]).all()
    assert found.reasons[1:] == (None, None)


def test_what_is_missing_is_named() -> None:
    rng = np.random.default_rng(12)
    empty = Canvas(320, 240, 120).image(rng, 2.0)
    assert detect_markers(empty, BY_COLOUR).reasons == ("no_candidate",) * 3
    assert detect_markers(empty[..., 0], BY_RADIUS).reasons == ("no_candidate",) * 3
    canvas = Canvas(320, 240, 120)
    canvas.disc((0, 255, 0), np.array([150.0, 100.0]), 15.0)
    found = detect_markers(canvas.image(rng), BY_COLOUR)
    assert found.reasons == ("no_candidate", None, "no_candidate")
    assert not found.complete


def test_two_sizes_alone_do_not_name_a_marker_they_cannot() -> None:
    """13 to 16 is as 16 to 20: which two of the three balls are these?"""
    rng = np.random.default_rng(13)
    canvas = grey_scene(
        rng, np.array([[80.0, 80.0], [220.0, 150.0]]), 250, 110, (13.0, 16.0)
    )
    assert detect_markers(canvas.image(rng), BY_RADIUS).reasons == ("ambiguous",) * 3


@pytest.mark.parametrize(
    ("image", "spec", "words"),
    [
        (np.zeros((240, 320, 3)), BY_COLOUR, "uint8, got float64"),
        (np.zeros((240, 320, 4), np.uint8), BY_COLOUR, r"got \(240, 320, 4\)"),
        (np.zeros(320, np.uint8), BY_RADIUS, r"got \(320,\)"),
        (np.zeros((8, 8, 3), np.uint8), BY_COLOUR, "at least 32"),
        (np.zeros((240, 320), np.uint8), BY_COLOUR, "the image is grey"),
        ([[0]], BY_COLOUR, "uint8, got list"),
    ],
)
def test_bad_images(image: object, spec: MarkerSpec, words: str) -> None:
    with pytest.raises(InputError, match=words):
        detect_markers(image, spec)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("identity", "colours", "radii", "words"),
    [
        ("size", PURE, EQUAL, "identity"),
        ("colour", PURE[:2], EQUAL, "shape"),
        ("colour", 255 * PURE, EQUAL, "0-1"),
        ("colour", PURE, -EQUAL, "positive"),
        ("colour", np.full((3, 3), 0.5), EQUAL, "nearly grey"),
        ("colour", [[1, 0, 0], [0.8, 0, 0], [0, 0, 1]], EQUAL, "A and B"),
        ("radius", PURE, EQUAL, "10 %"),
        ("radius", PURE, [np.nan, 0.01, 0.02], "finite"),
    ],
)
def test_bad_markers(identity: str, colours: object, radii: object, words: str) -> None:
    with pytest.raises(InputError, match=words):
        MarkerSpec(identity, colours, radii)  # type: ignore[arg-type]


def test_a_detection_cannot_contradict_itself() -> None:
    with pytest.raises(InputError, match="reasons"):
        Detection(
            np.zeros((3, 2)), np.zeros((3, 2, 2)), np.ones(3), ("occluded", None, None)
        )


def test_every_run_gives_the_same_numbers() -> None:
    rng = np.random.default_rng(14)
    image = coloured(rng, place(rng), noise=2.0)
    first, second = (detect_markers(image, BY_COLOUR) for _ in range(2))
    assert np.array_equal(first.pixels, second.pixels)
    assert np.array_equal(first.covariance, second.covariance)


@pytest.mark.parametrize(
    "name", ["hp3_stereo", "hp3_stereo_edge", "hp3_stereo_lens", "hp3_stereo_mono"]
)
def test_rendered_views_of_planned_stations(name: str) -> None:
    """No miss, no swap, 0.03 px; scripts/check_detection.py has the larger sample."""
    path = storage.find_cell(name)
    cell = storage.read_cell(path)
    model = storage.find_model(cell, path)
    arm = Arm(compile_mechanism(cell, model))
    plan = plan_motions(cell, arm, 3, half_turns=2)
    joints = np.array([station.joints for station in plan.stations])
    radii = 1e-3 * np.array(cell.rig.marker_radii_mm)
    spec = MarkerSpec.from_rig(cell.rig)
    wanted = [(j % 2, j) for j in range(len(joints))]
    found, truth = [], []
    for i, j, image in render_views(cell, model, joints, 3, wanted):
        world = arm.base_from_world.inverse().apply(arm.marker_positions(joints[j]))
        points = cell.cameras[i].world_from_camera.inverse().apply(world)
        camera = cell.cameras[i].camera
        found.append(detect_markers(image, spec))
        truth.append(camera.project(points) + sphere_shift(camera, points, radii))
    error, squares = errors_of(found, truth)
    assert np.sqrt((error**2).mean(axis=0)).max() < 0.03
    assert np.abs(error).max() < 0.15
    assert 0.4 < squares.mean() < 2.5


TRIANGLE = np.array([[0.0, 0.0], [0.13, 0.0], [0.05, 0.11]])


@pytest.mark.parametrize("seed", range(4))
def test_the_triangle_tells_a_marker_from_a_second_thing_of_its_looks(
    seed: int,
) -> None:
    """A triangle aslant by 40 degrees, and a second red disc of a ball's size."""
    rng = np.random.default_rng([31, seed])
    turn = rng.uniform(0, 2 * np.pi)
    rotation = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    scale = 900.0
    shape = rotation @ np.diag([1.0, np.cos(np.radians(40))]) @ rotation.T
    centres = (TRIANGLE - TRIANGLE.mean(axis=0)) @ rotation.T @ shape * scale
    centres += [160, 120]
    canvas = Canvas(320, 240, 120)
    for centre, colour in zip(centres, PURE, strict=True):
        canvas.disc(255 * colour, centre, 0.008 * scale)
    decoy = np.array([20.0, 20.0])
    canvas.disc(255 * PURE[0], decoy, 0.008 * scale)
    image = canvas.image(rng)
    blind = detect_markers(image, BY_COLOUR)
    assert blind.reasons[0] == "ambiguous"
    known = MarkerSpec("colour", PURE, EQUAL, TRIANGLE)
    found = detect_markers(image, known)
    assert found.complete
    assert np.abs(found.pixels - centres).max() < 0.1


def test_a_triangle_seen_nearly_from_its_edge_is_left_and_said_to_be_so() -> None:
    canvas = Canvas(320, 240, 120)
    centres = (TRIANGLE - TRIANGLE.mean(axis=0)) * [900.0, 270.0] + [160, 120]
    for centre, colour in zip(centres, PURE, strict=True):
        canvas.disc(255 * colour, centre, 7.2)
    known = MarkerSpec("colour", PURE, EQUAL, TRIANGLE)
    found = detect_markers(canvas.image(np.random.default_rng(1)), known)
    assert found.reasons == ("aslant",) * 3


def test_a_lone_thing_too_far_from_the_others_is_not_taken() -> None:
    """A is hidden; a red disc lies where A cannot be."""
    canvas = Canvas(320, 240, 120)
    for centre, colour in (((150, 200), PURE[1]), ((110, 150), PURE[2])):
        canvas.disc(255 * colour, np.array(centre, dtype=float), 7.2)
    canvas.disc(255 * PURE[0], np.array([300.0, 20.0]), 7.2)
    image = canvas.image(np.random.default_rng(32))
    found = detect_markers(image, MarkerSpec("colour", PURE, EQUAL, TRIANGLE))
    assert [reason is None for reason in found.reasons] == [False, True, True]


def test_flat_dots_seen_aslant_are_found() -> None:
    rng = np.random.default_rng(33)
    canvas = Canvas(320, 240, 230)
    centres = place(rng)
    for centre, radius in zip(centres, (9.0, 11.0, 13.8), strict=True):
        # 0.5 the other way: 60 degrees.
        canvas.disc((10, 10, 10), centre, radius, 0.55)
    image = canvas.image(rng, noise=1.0, blur=0.5)
    found = detect_markers(image, BY_RADIUS)
    assert found.complete
    assert np.abs(found.pixels - centres).max() < 0.15


def test_the_sheet_shows_what_was_found_and_why_not() -> None:
    rng = np.random.default_rng(15)
    canvas = Canvas(320, 240, 120)
    canvas.disc((0, 255, 0), np.array([150.0, 100.0]), 15.0)
    image = canvas.image(rng)
    found = detect_markers(image, BY_COLOUR)
    sheet = detection_sheet(image, found)
    assert sheet.shape == (240, 320 + 80, 3)
    magenta = (sheet == (255, 0, 255)).all(axis=2)
    # A ring in the image and in B's enlargement; words in the places of A and C.
    assert magenta[100, 134:137].any()
    assert magenta[80:160, 320:].sum() > 100
    assert sheet[:80, 320:].any()
    assert sheet[160:, 320:].any()
    grey = detection_sheet(image[..., 0], found)
    assert np.array_equal(grey[10, 10], np.repeat(image[10, 10, 0], 3))

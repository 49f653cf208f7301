"""The cell description that ``scenes/*.yaml`` are read into; units in the keys."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from handeye_tri.camera import LENS_COEFFICIENTS, Intrinsics, Lens, PinholeCamera
from handeye_tri.errors import InputError
from handeye_tri.records import CameraInfo, Repeatability
from handeye_tri.se3 import SE3, so3_exp
from handeye_tri.triangle import Axis, TriangleRig

if TYPE_CHECKING:
    from collections.abc import Mapping

SCHEMA = "handeye_tri.cell/1"
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
NotNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Number = Annotated[float, Field(allow_inf_nan=False)]
Unit = Annotated[float, Field(ge=0, le=1, allow_inf_nan=False)]
Point = tuple[Number, Number, Number]


class _Model(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class ArmConfig(_Model):
    """The robot: which model, which frames, how repeatable."""

    model: str = Field(description="MJCF or URDF; a path, or a name in robot_models")
    base: str | None = Field(
        None, description="body that poses refer to; default: the model's first body"
    )
    flange: str = Field(description="body or site that the robot reports")
    position_m: Point = (0.0, 0.0, 0.0)
    repeatability_mm: NotNegative = 0.03
    repeatability_deg: NotNegative = 0.005


class RigConfig(_Model):
    """The triangle on the flange, and how its markers look.

    The flange's z axis is the half-turn axis. "normal": it meets the triangle's
    plane in the circumcentre. An edge: the edge lies on it, its first vertex
    ``ahead_mm`` from the flange.
    """

    axis: Axis
    side_ab_mm: Positive
    side_ac_mm: Positive
    angle_deg: Annotated[float, Field(gt=0, lt=180)]
    ahead_mm: Positive
    turn_deg: Number = 0.0
    marker_radii_mm: tuple[Positive, Positive, Positive]
    marker_colours: tuple[tuple[Unit, Unit, Unit], ...] = Field(
        min_length=3, max_length=3, description="A, B, C as red green blue, 0-1"
    )
    identity: Literal["colour", "radius"]

    @model_validator(mode="after")
    def _distinguishable(self) -> RigConfig:
        try:
            _ = self.triangle
        except InputError as error:
            raise ValueError(str(error)) from None
        if self.identity == "colour" and len(set(self.marker_colours)) < 3:
            raise ValueError(
                "identity: colour needs three different marker_colours; "
                "use three colours, or identity: radius"
            )
        radii = sorted(self.marker_radii_mm)
        if self.identity == "radius" and min(np.diff(radii)) < 0.1 * radii[0]:
            raise ValueError(
                "identity: radius needs marker_radii_mm at least 10 % apart, "
                f"got {list(self.marker_radii_mm)}"
            )
        return self

    @property
    def triangle(self) -> TriangleRig:
        """The rig in metres and radians."""
        return TriangleRig(
            1e-3 * self.side_ab_mm,
            1e-3 * self.side_ac_mm,
            float(np.radians(self.angle_deg)),
        )

    @property
    def flange_from_triangle(self) -> SE3:
        """Where the triangle's frame sits on the flange, as built."""
        triangle = self.triangle
        ahead = np.array([0.0, 0.0, 1e-3 * self.ahead_mm])
        spin = so3_exp([0.0, 0.0, np.radians(self.turn_deg)])
        if self.axis == "normal":
            # The triangle looks ahead, away from the flange.
            o = np.append(triangle.circumcentre, 0.0)
            return SE3.from_parts(spin, ahead - spin @ o)
        start = {"AB": 0, "BC": 1, "CA": 2}[self.axis]
        points = triangle.points
        along = points[(start + 1) % 3] - points[start]
        along /= np.linalg.norm(along)
        normal = np.array([0.0, 0.0, 1.0])
        # Rows: flange axes in the triangle's frame; z along the edge, y the normal.
        rotation = spin @ np.array([np.cross(normal, along), normal, along])
        return SE3.from_parts(rotation, ahead - rotation @ points[start])


class LensConfig(_Model):
    """Distortion of a simulated camera, by name of the coefficient."""

    model: Literal["radtan", "rational"] = "radtan"
    coefficients: dict[str, Number]

    @model_validator(mode="after")
    def _known(self) -> LensConfig:
        unknown = set(self.coefficients) - set(LENS_COEFFICIENTS[self.model])
        if unknown:
            raise ValueError(
                f"coefficients {sorted(unknown)} are not in a {self.model} lens; "
                f"it has {' '.join(LENS_COEFFICIENTS[self.model])}"
            )
        return self

    @property
    def lens(self) -> Lens:
        """The lens, absent coefficients zero."""
        names = LENS_COEFFICIENTS[self.model]
        return Lens(
            self.model, np.array([self.coefficients.get(name, 0.0) for name in names])
        )


class EstimateConfig(_Model):
    """What is to be estimated of a camera."""

    skew: bool = True
    lens_model: Literal["radtan", "rational"] = "radtan"
    lens: tuple[str, ...] = ()

    @model_validator(mode="after")
    def _known(self) -> EstimateConfig:
        unknown = set(self.lens) - set(LENS_COEFFICIENTS[self.lens_model])
        if unknown or len(set(self.lens)) < len(self.lens):
            raise ValueError(
                f"lens {list(self.lens)} must name coefficients of a "
                f"{self.lens_model} lens, each once: "
                f"{' '.join(LENS_COEFFICIENTS[self.lens_model])}"
            )
        return self


class CameraConfig(_Model):
    """One camera: its truth (for simulation), place, and what is estimated."""

    name: Annotated[str, Field(pattern=r"^[A-Za-z][A-Za-z0-9_]*$")]
    image_size_px: tuple[Annotated[int, Field(gt=0)], Annotated[int, Field(gt=0)]]
    focal_px: tuple[Positive, Positive]
    principal_point_px: tuple[Number, Number]
    skew_px: Number = 0.0
    lens: LensConfig | None = None
    position_m: Point
    look_at_m: Point
    roll_deg: Number = 0.0
    estimate: EstimateConfig = EstimateConfig()

    @model_validator(mode="after")
    def _looks_somewhere(self) -> CameraConfig:
        if np.allclose(self.position_m, self.look_at_m):
            raise ValueError("look_at_m must differ from position_m")
        return self

    @property
    def camera(self) -> PinholeCamera:
        """The true camera."""
        fx, fy = self.focal_px
        cx, cy = self.principal_point_px
        return PinholeCamera(
            self.name,
            Intrinsics(fx, fy, self.skew_px, cx, cy),
            self.image_size_px,
            self.lens.lens if self.lens else Lens(),
        )

    @property
    def info(self) -> CameraInfo:
        """What the estimators may know."""
        return CameraInfo(
            self.name,
            self.image_size_px,
            self.estimate.skew,
            self.estimate.lens,
            self.estimate.lens_model,
        )

    @property
    def world_from_camera(self) -> SE3:
        """Optical frame (z forward, x right, y down) in the world, z up."""
        position = np.array(self.position_m)
        forward = np.array(self.look_at_m) - position
        forward /= np.linalg.norm(forward)
        up = np.array([0.0, 0.0, 1.0])
        if abs(forward @ up) > 0.999:
            up = np.array([1.0, 0.0, 0.0])
        right = np.cross(forward, up)
        right /= np.linalg.norm(right)
        down = np.cross(forward, right)
        roll = so3_exp([0.0, 0.0, np.radians(self.roll_deg)])
        return SE3.from_parts(np.stack([right, down, forward], axis=1) @ roll, position)


class ImagingConfig(_Model):
    """From the ideal picture to the file."""

    supersample: Annotated[int, Field(ge=1, le=4)] = 2
    noise_percent: NotNegative = 0.0
    blur_px: NotNegative = 0.0
    grey: bool = False


class BoxConfig(_Model):
    """Something that stands in the cell."""

    name: Annotated[str, Field(pattern=r"^[A-Za-z][A-Za-z0-9_]*$")]
    size_mm: tuple[Positive, Positive, Positive]
    position_m: Point


class PlanConfig(_Model):
    """What a programme must satisfy."""

    half_turns: Annotated[int, Field(ge=2)] = 11
    evaluation_stations: Annotated[int, Field(ge=1)] = 6
    min_plane_spread_deg: Annotated[float, Field(gt=0, le=60)] = 20.0
    max_tilt_deg: Annotated[float, Field(gt=0, lt=90)] = 55.0
    image_margin_px: NotNegative = 20.0
    workspace_min_m: Point
    workspace_max_m: Point

    @model_validator(mode="after")
    def _box(self) -> PlanConfig:
        sides = np.subtract(self.workspace_max_m, self.workspace_min_m)
        if not (sides > 0).all():
            raise ValueError(
                "workspace_max_m must exceed workspace_min_m on every axis, "
                f"got sides {sides.tolist()} m"
            )
        return self


class Cell(_Model):
    """Everything about a cell."""

    schema_: Literal["handeye_tri.cell/1"] = Field(alias="schema")
    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_-]*$")]
    arm: ArmConfig
    rig: RigConfig
    cameras: tuple[CameraConfig, ...] = Field(min_length=2)
    imaging: ImagingConfig = ImagingConfig()
    surroundings: tuple[BoxConfig, ...] = ()
    plan: PlanConfig
    track_limit_mm: Positive = 1.0

    @model_validator(mode="after")
    def _names(self) -> Cell:
        names = [camera.name for camera in self.cameras]
        if len(set(names)) < len(names):
            raise ValueError(f"camera names must differ, got {names}")
        return self

    @property
    def repeatability(self) -> Repeatability:
        """The robot's stated repeatability in metres and radians."""
        return Repeatability(
            1e-3 * self.arm.repeatability_mm,
            float(np.radians(self.arm.repeatability_deg)),
        )


def parse_cell(data: Mapping[str, object], source: str) -> Cell:
    """Check a cell description.

    Args:
        data: What the YAML file holds.
        source: The file's name, for messages.

    Raises:
        InputError: unknown key, missing unit, impossible value; names each key.
    """
    try:
        return Cell.model_validate(data)
    except ValidationError as error:
        problems = [
            f"{'.'.join(str(part) for part in e['loc']) or 'the cell'}: "
            + _explain(e["type"], e["msg"], e["input"])
            for e in error.errors(include_url=False)
        ]
        raise InputError(f"{source}: " + "; ".join(problems)) from None


def _explain(kind: str, message: str, value: object) -> str:
    if kind == "extra_forbidden":
        return "this key is not known here; remove it or check its spelling and unit"
    if kind == "missing":
        return "this key is missing; add it"
    text = message.removeprefix("Value error, ")
    if kind == "value_error":
        return text
    return f"{text[0].lower()}{text[1:]}, got {value!r}"

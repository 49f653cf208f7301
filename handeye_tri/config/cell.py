"""The cell description that ``scenes/*.yaml`` are read into; units in the keys."""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np
from pydantic import Field, model_validator

from handeye_tri.camera import LENS_COEFFICIENTS, Intrinsics, Lens, PinholeCamera
from handeye_tri.config.fields import (
    Count,
    Model,
    NotNegative,
    Number,
    Point,
    Positive,
    Switch,
)
from handeye_tri.config.rig import MountConfig, RigConfig, SecondAxis, TriangleConfig
from handeye_tri.records import CameraInfo, Repeatability
from handeye_tri.se3 import SE3, so3_exp
from handeye_tri.triangle import Axis


class RobotAccuracy(Model):
    """What is to be known of any robot: one standard deviation per axis."""

    repeatability_mm: NotNegative
    repeatability_deg: NotNegative


class ArmConfig(RobotAccuracy):
    """The robot: which model, which frames, how repeatable."""

    model: str = Field(description="MJCF or URDF; a path, or a name in robot_models")
    base: str | None = Field(
        None, description="body that poses refer to; default: the model's first body"
    )
    flange: str = Field(description="body or site that the robot reports")
    position_m: Point = (0.0, 0.0, 0.0)
    repeatability_mm: NotNegative = 0.03
    repeatability_deg: NotNegative = 0.005
    acceleration_time_s: Positive = Field(
        0.3, description="what a joint takes from rest to its full speed"
    )


class LensConfig(Model):
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


class EstimateConfig(Model):
    """What is to be estimated of a camera."""

    skew: Switch = True
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


class CameraToCalibrate(Model):
    """What is to be known of any camera, and what is estimated of it."""

    name: Annotated[str, Field(pattern=r"^[A-Za-z][A-Za-z0-9_]*$")]
    image_size_px: tuple[Count, Count]
    estimate: EstimateConfig = EstimateConfig()

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


class CameraConfig(CameraToCalibrate):
    """One camera's truth and place, for planning and simulation."""

    focal_px: tuple[Positive, Positive]
    principal_point_px: tuple[Number, Number]
    skew_px: Number = 0.0
    lens: LensConfig | None = None
    position_m: Point
    look_at_m: Point
    roll_deg: Number = 0.0

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


class ImagingConfig(Model):
    """From the ideal picture to the file."""

    supersample: Annotated[Count, Field(le=4)] = 2
    noise_percent: NotNegative = 0.0
    blur_px: NotNegative = 0.0
    grey: Switch = False


class BoxConfig(Model):
    """Something that stands in the cell."""

    name: Annotated[str, Field(pattern=r"^[A-Za-z][A-Za-z0-9_]*$")]
    size_mm: tuple[Positive, Positive, Positive]
    position_m: Point


class MotionConfig(Model):
    """What any robot's motions must satisfy."""

    min_plane_spread_deg: Annotated[Number, Field(gt=0, le=60)] = 20.0


class PlanConfig(MotionConfig):
    """What a programme must satisfy."""

    half_turns: Annotated[Count, Field(ge=2)] = 11
    evaluation_stations: Annotated[int, Field(strict=True, ge=0)] = 6
    max_tilt_deg: Annotated[Number, Field(gt=0, lt=90)] = 55.0
    image_margin_px: NotNegative = 20.0
    expected_sigma_px: Positive = Field(
        0.03, description="detection error per axis that predictions assume"
    )
    workspace_min_m: Point
    workspace_max_m: Point

    @model_validator(mode="after")
    def _box(self) -> PlanConfig:
        sides = np.subtract(self.workspace_max_m, self.workspace_min_m)
        if not (sides > 0).all():
            raise ValueError(
                "workspace_max_m must exceed workspace_min_m on every axis, "
                f"got sides {sides.round(6).tolist()} m"
            )
        return self


class CellToCalibrate(Model):
    """What calibration needs to know of a cell, simulated or real."""

    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_-]*$")]
    arm: RobotAccuracy
    rig: TriangleConfig
    second_mount: SecondAxis | None = Field(
        None, description="how the same triangle is held after a tool change"
    )
    cameras: tuple[CameraToCalibrate, ...] = Field(min_length=1)
    plan: MotionConfig = MotionConfig()
    track_limit_mm: Positive = 1.0

    @model_validator(mode="after")
    def _cameras_differ(self) -> CellToCalibrate:
        names = [camera.name for camera in self.cameras]
        if len(set(names)) < len(names):
            raise ValueError(f"camera names must differ, got {names}")
        return self

    @property
    def axes(self) -> tuple[Axis, ...]:
        """The half-turn axis of each mount."""
        second = () if self.second_mount is None else (self.second_mount.axis,)
        return (self.rig.axis, *second)

    def mount_name(self, mount: int) -> str:
        """What a person calls a mount (from 0): by its number and its half-turns."""
        axis = self.axes[mount]
        about = "a normal" if axis == "normal" else f"its edge {axis}"
        return f"mount {mount + 1} (about {about})"

    @property
    def repeatability(self) -> Repeatability:
        """The robot's stated repeatability in metres and radians."""
        return Repeatability(
            1e-3 * self.arm.repeatability_mm,
            float(np.radians(self.arm.repeatability_deg)),
        )


class MeasuredCell(CellToCalibrate):
    """A real cell of which nothing is designed here: no model, no nominal cameras."""

    schema_: Literal["handeye_tri.measured_cell/1"] = Field(alias="schema")


class Cell(CellToCalibrate):
    """Everything about a cell that can be planned and simulated."""

    schema_: Literal["handeye_tri.cell/1"] = Field(alias="schema")
    arm: ArmConfig
    rig: RigConfig
    second_mount: MountConfig | None = Field(
        None, description="how the same triangle is held after a tool change"
    )
    cameras: tuple[CameraConfig, ...] = Field(min_length=1)
    imaging: ImagingConfig = ImagingConfig()
    surroundings: tuple[BoxConfig, ...] = ()
    plan: PlanConfig

    @model_validator(mode="after")
    def _boxes_differ(self) -> Cell:
        boxes = [box.name for box in self.surroundings]
        if len(set(boxes)) < len(boxes):
            raise ValueError(f"names of surroundings must differ, got {boxes}")
        return self

    @model_validator(mode="after")
    def _mounts_differ(self) -> Cell:
        if self.second_mount is not None and self.mounted[0].rig == self.mounted[1].rig:
            raise ValueError(
                "second_mount holds the triangle as rig does, so there is no tool to "
                "change; give it another axis, ahead_mm, turn_deg, o_mm or holder, or "
                "leave it out"
            )
        return self

    @property
    def mounted(self) -> tuple[Cell, ...]:
        """The cell with each mount, in order, as the rig of a cell without another."""
        if self.second_mount is None:
            return (self,)
        rig = self.rig.model_copy(update=self.second_mount.model_dump())
        alone = self.model_copy(update={"second_mount": None})
        return alone, alone.model_copy(update={"rig": rig})

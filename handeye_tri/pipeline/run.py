"""A session being worked on: what its stages share, read back from disk."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, TypeVar

import numpy as np

from handeye_tri import storage
from handeye_tri.errors import InputError, StorageError
from handeye_tri.records import (
    CameraCalibration,
    GroundTruth,
    HandEyeCalibration,
    Plan,
    Session,
    locked,
)
from handeye_tri.storage import SessionFolder, codec

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from handeye_tri.arm import Arm
    from handeye_tri.config import Cell, CellToCalibrate
    from handeye_tri.mechanism import Mechanism

PLAN_SCHEMA = "handeye_tri.plan/1"
TRUTH_SCHEMA = "handeye_tri.truth/1"
CAMERAS_SCHEMA = "handeye_tri.cameras/1"
HAND_EYE_SCHEMA = "handeye_tri.hand_eye/1"
EVALUATION_SCHEMA = "handeye_tri.evaluation/2"
# Of what each stage writes. A file whose keys change gets a new number here, so that
# a stage that wrote the old ones counts as stale.
SCHEMAS = {
    "plan": PLAN_SCHEMA,
    "simulate": TRUTH_SCHEMA,
    "cameras": CAMERAS_SCHEMA,
    "hand_eye": HAND_EYE_SCHEMA,
    "evaluate": EVALUATION_SCHEMA,
}
# What terminal, report and recording take from evaluation.json.
_EVALUATION_KEYS = (
    *("verdict", "sentence", "nearest", "simulated", "gates", "findings", "result"),
    *("robot.asked", "robot.estimated", "robot.undetermined"),
    *(
        f"track.{key}"
        for key in (
            *("source", "stations", "mean_mm", "rms_mm", "max_mm", "positions"),
            *("worst_station", "worst_marker", "predicted_rms_mm"),
            *("against_prediction", "predicted_parts_mm"),
        )
    ),
    "cross_checks.cross_validation",
    "cross_checks.bootstrap",
    "cross_checks.parametric_bootstrap",
)
T = TypeVar("T")
# How the cell is calibrated: everything together, or step by step.
METHODS = ("joint", "separate")
# Systematic errors of the robot that a joint calibration can be asked to estimate.
ROBOT_ERRORS = ("joint-offsets", "link-corrections")
_PACKAGES = (
    "handeye-tri",
    "numpy",
    "scipy",
    "mujoco",
    "pin",
    "opencv-python-headless",
    "rerun-sdk",
)


class Progress(Protocol):
    """What a stage tells while it runs; the command line draws it."""

    def begin(self, number: int, total: int, stage: str) -> None:
        """A stage starts."""

    def advance(self, done: int, total: int) -> None:
        """So much of the stage is done."""

    def end(self, line: str, seconds: float | None) -> None:
        """The stage ended with its own quality figure; None: it was up to date."""


class NullProgress:
    """Progress that nobody looks at."""

    def begin(self, number: int, total: int, stage: str) -> None:
        """A stage starts."""

    def advance(self, done: int, total: int) -> None:
        """So much of the stage is done."""

    def end(self, line: str, seconds: float | None) -> None:
        """The stage ended."""


def software() -> dict[str, str]:
    """Versions of what computes the numbers."""
    found = {}
    for name in _PACKAGES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "absent"
    return found


def start(
    cell_name: str,
    out: Path,
    seed: int,
    half_turns: int | None,
    stations: Path | None = None,
) -> SessionFolder:
    """Check a cell and take a folder for it; writes nothing.

    Args:
        cell_name: Path of a YAML file, or a name in ``scenes``.
        out: The session's folder.
        seed: Of all randomness.
        half_turns: How many to plan; None: as the cell says.
        stations: CSV of joint values that stand for a plan of our own.

    Raises:
        InputError: the cell or the model cannot be used.
        StorageError: the folder holds something else.
    """
    path = storage.find_cell(cell_name)
    cell = storage.read_cell(path)
    model = storage.find_model(cell, path)
    if seed < 0:
        raise InputError(f"--seed must not be negative, got {seed}")
    return SessionFolder.prepare(
        out,
        {
            "schema": storage.SESSION_SCHEMA,
            "software": software(),
            "cell": cell.model_dump(mode="json", by_alias=True),
            "cell_file": str(path),
            "model_file": str(model),
            "seed": seed,
            "half_turns": cell.plan.half_turns if half_turns is None else half_turns,
            "method": METHODS[0],
            "simulated": True,
            **(_stations(stations, cell, model) if stations else _NO_STATIONS),
            "stages": {},
        },
    )


_NO_STATIONS = {"stations_rad_or_m": None, "station_mounts": None}


def _stations(path: Path, cell: Cell, model: Path) -> dict[str, Any]:
    """Joints and mounts of a user's own stations."""
    from handeye_tri.arm import Arm
    from handeye_tri.simulate import compile_mechanism

    arm = Arm(compile_mechanism(cell, model))
    joints, mounts = storage.read_joint_list(
        path, arm.joint_names, arm.slides, len(cell.mounted)
    )
    return {"stations_rad_or_m": joints.tolist(), "station_mounts": mounts.tolist()}


class Run:
    """A session with what its stages share."""

    def __init__(self, folder: SessionFolder, progress: Progress) -> None:
        self.folder = folder
        self.progress = progress

    @cached_property
    def cell(self) -> CellToCalibrate:
        """The cell's description, as far as calibration needs it."""
        return self.folder.cell

    @property
    def is_designed(self) -> bool:
        """Whether the cell is described whole, not only as measured."""
        from handeye_tri.config import Cell

        return isinstance(self.cell, Cell)

    @property
    def designed_cell(self) -> Cell:
        """The whole description.

        Raises:
            InputError: the session is of a real cell that nobody designed here.
        """
        from handeye_tri.config import Cell

        if not isinstance(self.cell, Cell):
            raise InputError(
                f"{self.folder.path}: this session's cell was measured and has neither "
                "a robot model nor nominal cameras; describe it with "
                "schema: handeye_tri.cell/1 for that (scenes/README.md)"
            )
        return self.cell

    @property
    def imported_by(self) -> str:
        """The command that imported the session; "" where it was simulated.

        Raises:
            StorageError: session.json does not say it as it should.
        """
        source = self.folder.header.get("source")
        if source is None:
            return ""
        command = source.get("command") if isinstance(source, dict) else None
        if not isinstance(command, str) or not command:
            raise StorageError(
                f"{self.folder.path / 'session.json'}: source.command is missing or "
                "wrong; import the data again into another folder"
            )
        return command

    @property
    def has_robot(self) -> bool:
        """Whether there is a model of the robot and joints of every station."""
        named = bool(self.folder.header["model_file"])
        return named and all(len(station.joints) for station in self.plan().stations)

    @property
    def seed(self) -> int:
        """The seed of everything random."""
        return int(self.folder.header["seed"])

    @property
    def method(self) -> str:
        """How the cell is calibrated, one of METHODS."""
        method = str(self.folder.header.get("method", METHODS[0]))
        if method not in METHODS:
            raise StorageError(
                f"{self.folder.path / 'session.json'}: method must be one of "
                f"{', '.join(METHODS)}, got {method!r}"
            )
        return method

    @property
    def robot_errors(self) -> tuple[str, ...]:
        """Which errors of the robot are estimated, some of ROBOT_ERRORS."""
        asked = tuple(self.folder.header.get("robot_errors", ()))
        if not set(asked) <= set(ROBOT_ERRORS):
            raise StorageError(
                f"{self.folder.path / 'session.json'}: robot_errors must be some of "
                f"{', '.join(ROBOT_ERRORS)}, got {', '.join(map(str, asked))}"
            )
        return asked

    @property
    def model_path(self) -> Path:
        """The arm's model."""
        return Path(self.folder.header["model_file"])

    @cached_property
    def mechanisms(self) -> tuple[Mechanism, ...]:
        """The compiled cell with each mount."""
        from handeye_tri.simulate import compile_mechanism

        return tuple(
            compile_mechanism(cell, self.model_path)
            for cell in self.designed_cell.mounted
        )

    @property
    def mechanism(self) -> Mechanism:
        """The compiled cell with its first mount."""
        return self.mechanisms[0]

    @cached_property
    def arms(self) -> tuple[Arm, ...]:
        """Kinematics and collisions of the compiled cell with each mount."""
        from handeye_tri.arm import Arm

        return tuple(Arm(mechanism) for mechanism in self.mechanisms)

    @property
    def arm(self) -> Arm:
        """Kinematics of the compiled cell, and collisions with its first mount."""
        return self.arms[0]

    def plan(self) -> Plan:
        """The programme, read back."""
        return self._decoded("plan", "plan", "plan.json", codec.plan_from_json)

    def truth(self) -> tuple[GroundTruth, NDArray[np.float64]] | None:
        """The ground truth and executed joints, where there are any."""
        if not self.folder.header["simulated"]:
            return None
        return self._decoded(
            "simulate", "simulate", "truth.json", codec.truth_from_json
        )

    def cameras(self) -> CameraCalibration:
        """The calibrated cameras, read back."""
        return self._decoded(
            "cameras",
            "calibrate",
            "cameras.json",
            codec.camera_calibration_from_json,
        )

    def hand_eye(self) -> HandEyeCalibration:
        """The calibrated cell, read back."""
        return self._decoded(
            "hand_eye", "calibrate", "hand_eye.json", codec.hand_eye_from_json
        )

    def image_name(self, camera: str, station: int) -> str:
        """Name of the file of one view."""
        return f"images/{camera}_{station:03d}.png"

    def was_taken(self, camera: str, station: int) -> bool:
        """Whether there is such a view; a real camera may have missed a station."""
        return self.image_name(camera, station) in self.folder.outputs("simulate")

    def image(self, camera: str, station: int) -> NDArray[np.uint8]:
        """One view, read back; black where it was not taken."""
        if not self.was_taken(camera, station):
            sizes = {c.name: c.image_size_px for c in self.cell.cameras}
            width, height = sizes[camera]
            return np.zeros((height, width, 3), dtype=np.uint8)
        return storage.read_image(self.folder.file(self.image_name(camera, station)))

    def evaluation(self) -> dict[str, Any]:
        """The evaluation as it stands in evaluation.json."""

        def complete(data: dict[str, Any]) -> dict[str, Any]:
            for path in _EVALUATION_KEYS:
                part: Any = data
                for key in path.split("."):
                    part = part[key]
            return data

        return self._decoded("evaluate", "evaluate", "evaluation.json", complete)

    def _decoded(
        self, stage: str, verb: str, name: str, decode: Callable[[dict[str, Any]], T]
    ) -> T:
        """What a stage, run by a verb, wrote into a file of the session."""
        remedy = f"run: handeye-tri {verb} {self.folder.path} --again"
        if verb in ("plan", "simulate") and self.imported_by:
            remedy = f"import it again into another folder: {self.imported_by}"
        return storage.decoded(self.folder.file(name), SCHEMAS[stage], decode, remedy)

    def written(self) -> list[str]:
        """Files that a person opens, where they are there, first one first."""
        names = ("report.html", "replay.rrd", "evaluation.json", "hand_eye.json")
        return [name for name in names if self.folder.file(name).is_file()]

    def session(self) -> Session:
        """What was observed, without half-turns that the cameras' stage dropped."""
        if not self.folder.file("cameras.json").is_file():
            return self.observed()
        return self.observed().without(self.cameras().details["dropped"])

    def edges(self) -> NDArray[np.float64] | None:
        """How wide the markers' edges are, see :class:`handeye_tri.detect.Detection`.

        None where detection was made by something that does not measure it.
        """
        path = self.folder.file("observations.npz")
        edges = storage.read_arrays(path, (), ("edges",)).get("edges")
        if edges is None:
            return None
        shape = (len(self.cell.cameras), len(self.plan().stations), 3, 3)
        return locked(f"{path}: edges", edges, shape, finite=False)

    def observed(self) -> Session:
        """What the estimators get to know."""
        arrays = storage.read_arrays(
            self.folder.file("observations.npz"), ("pixels", "pixel_covariance")
        )
        plan = self.plan()
        return Session(
            triangle=self.cell.rig.triangle,
            marker_radii=1e-3 * np.array(self.cell.rig.marker_radii_mm),
            cameras=tuple(camera.info for camera in self.cell.cameras),
            stations=plan.stations,
            half_turns=plan.half_turns,
            pixels=arrays["pixels"],
            pixel_covariance=arrays["pixel_covariance"],
            repeatability=self.cell.repeatability,
            simulated=bool(self.folder.header["simulated"]),
        )

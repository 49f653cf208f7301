"""Poses in files: one translation and one rotation in stated forms and units.

A POSE has one translation (``translation_m`` or ``translation_mm``) and one rotation:
``quaternion`` {w, x, y, z}, ``rotation_matrix`` (3 rows), ``rotation_vector_rad`` or
``_deg``, or ``euler`` {order: "xyz", about: "fixed" | "moving", angles_deg}; or it is
a homogeneous ``matrix_m`` or ``matrix_mm`` (4 rows).
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from handeye_tri.errors import InputError
from handeye_tri.records import Floats, PoseNoise
from handeye_tri.se3 import (
    nearest_rotation,
    rotation_from_quaternion_wxyz,
    so3_exp,
)

# Words that the head of a file of pose pairs must choose from.
HEAD = {
    "mounting": ("eye_in_hand", "eye_to_hand"),
    "robot_poses": ("flange_in_base", "base_in_flange"),
    "observed_poses": ("target_in_camera", "camera_in_target"),
    "target_size": ("known", "unknown"),
}
_NOISE = {
    "robot_translation_mm": 1e-3,
    "robot_rotation_deg": np.pi / 180,
    "lateral_mm": 1e-3,
    "depth_mm": 1e-3,
    "rotation_deg": np.pi / 180,
}
_TRANSLATIONS = {"translation_m": 1.0, "translation_mm": 1e-3}
_MATRICES = {"matrix_m": 1.0, "matrix_mm": 1e-3}
_ROTATIONS = (
    "quaternion",
    "rotation_matrix",
    "rotation_vector_rad",
    "rotation_vector_deg",
    "euler",
)
# Rotations farther than this from one are not accepted as they are, and farther than
# this not even when asked to make them orthonormal.
_EXACT = 1e-6
_ROUNDED = 0.02
# Longer rotation vectors in radians are degrees (once round is 6.3); places farther
# away than this, in metres, are none.
_LONGEST_TURN = 2 * np.pi + 1e-3
_FARTHEST = 1e6


class PoseReader:
    """Reads parts of one file; every message starts with its path."""

    def __init__(self, path: Path, orthonormalise: bool) -> None:
        self.path = path
        self.orthonormalise = orthonormalise

    def fail(self, text: str) -> InputError:
        """An error that names the file."""
        return InputError(f"{self.path}: {text}")

    def only(self, data: Mapping[str, Any], known: set[str], where: str) -> None:
        """Refuse keys that are not known."""
        unknown = sorted(set(data) - known)
        if unknown:
            raise self.fail(
                f"{where} has an unknown key {unknown[0]!r}; known are "
                f"{', '.join(sorted(known))}"
            )

    def need(self, data: Any, key: str, where: str) -> Any:
        """The value of a key that must be there."""
        if not isinstance(data, Mapping) or key not in data:
            raise self.fail(f"{where} lacks {key!r}")
        return data[key]

    def word(self, data: Mapping[str, Any], key: str) -> str:
        """One of the words that a key of the head allows."""
        allowed = " or ".join(f'"{word}"' for word in HEAD[key])
        if key not in data:
            raise self.fail(
                f'the head lacks "{key}"; write {allowed} (nothing is guessed)'
            )
        if data[key] not in HEAD[key]:
            raise self.fail(f'"{key}" must be {allowed}, got {data[key]!r}')
        return str(data[key])

    def noise(self, data: Any) -> PoseNoise | None:
        """The optional noise of the head."""
        if data is None:
            return None
        if not isinstance(data, Mapping):
            raise self.fail('"noise" must be an object')
        self.only(data, set(_NOISE), '"noise"')
        values = [
            factor * self.numbers(self.need(data, key, '"noise"'), (), f"noise.{key}")
            for key, factor in _NOISE.items()
        ]
        try:
            return PoseNoise(*(float(value) for value in values))
        except InputError as error:
            raise self.fail(str(error)) from None

    def streams(
        self, data: Mapping[str, Any]
    ) -> tuple[Floats, Floats, tuple[str, ...], list[Floats | None]]:
        """Robot poses, observed poses, names, and both streams' times."""
        if ("pairs" in data) == ("robot" in data or "observed" in data):
            raise self.fail(
                'give either "pairs" or both "robot" and "observed", one of the two'
            )
        if "pairs" in data:
            pairs = self.items(data["pairs"], "pairs")
            for i, pair in enumerate(pairs):
                self.only(pair, {"name", "robot", "observed"}, f"pairs[{i}]")
            both = [
                [self.need(pair, key, f"pairs[{i}]") for i, pair in enumerate(pairs)]
                for key in ("robot", "observed")
            ]
            names = [str(pair.get("name", i)) for i, pair in enumerate(pairs)]
        else:
            both = [
                self.items(self.need(data, key, "the head"), key)
                for key in ("robot", "observed")
            ]
            names = [str(item.get("name", i)) for i, item in enumerate(both[1])]
        times: list[Floats | None] = []
        for key, items in zip(("robot", "observed"), both, strict=True):
            timed = ["time_s" in item for item in items if isinstance(item, Mapping)]
            if any(timed) and not all(timed):
                raise self.fail(
                    f"{key}[{timed.index(False)}] lacks time_s, which others have"
                )
            times.append(
                np.array(
                    [
                        self.numbers(item["time_s"], (), f"{key}[{i}].time_s")
                        for i, item in enumerate(items)
                    ]
                )
                if timed and all(timed)
                else None
            )
        poses = [
            np.array([self.pose(item, f"{key}[{i}]") for i, item in enumerate(items)])
            for key, items in zip(("robot", "observed"), both, strict=True)
        ]
        return poses[0], poses[1], tuple(names), times

    def items(self, data: Any, key: str) -> list[Any]:
        """A list of mappings with at least one item."""
        if not isinstance(data, list) or not data:
            raise self.fail(f'"{key}" must be a list with at least one item')
        for i, item in enumerate(data):
            if not isinstance(item, Mapping):
                raise self.fail(f"{key}[{i}] must be an object, got {item!r:.60}")
        return data

    def pose(self, data: Any, where: str) -> Floats:
        """A pose in any of the forms of the module's head, shape (4, 4), metres."""
        if not isinstance(data, Mapping):
            raise self.fail(f"{where} must be an object, got {data!r:.60}")
        known = {*_TRANSLATIONS, *_MATRICES, *_ROTATIONS, "time_s", "name"}
        self.only(data, known, where)
        matrices = [key for key in _MATRICES if key in data]
        translations = [key for key in _TRANSLATIONS if key in data]
        rotations = [key for key in _ROTATIONS if key in data]
        if matrices and not translations and not rotations and len(matrices) == 1:
            key = matrices[0]
            return self.matrix(data[key], _MATRICES[key], f"{where}.{key}")
        if matrices or len(translations) != 1 or len(rotations) != 1:
            raise self.fail(
                f"{where} must have one translation ({' or '.join(_TRANSLATIONS)}) and "
                f"one rotation ({', '.join(_ROTATIONS)}), or one matrix "
                f"({' or '.join(_MATRICES)}); it has {', '.join(sorted(data))}"
            )
        result = np.eye(4)
        key = translations[0]
        place = self.numbers(data[key], (3,), f"{where}.{key}")
        result[:3, 3] = self.near(_TRANSLATIONS[key] * place, f"{where}.{key}")
        key = rotations[0]
        result[:3, :3] = self.rotation(key, data[key], f"{where}.{key}")
        return result

    def matrix(self, data: Any, unit: float, where: str) -> Floats:
        """A homogeneous matrix, its lengths times ``unit``, shape (4, 4)."""
        flat = isinstance(data, list) and len(data) == 16
        given = self.numbers(data, (16,) if flat else (4, 4), where).reshape(4, 4)
        if np.abs(given[3] - (0, 0, 0, 1)).max() > 1e-9:
            raise self.fail(
                f"{where}: the last row must be 0 0 0 1, got {given[3].tolist()}; "
                "matrices are written row by row, the translation in the last column"
            )
        result = np.array(given)
        result[:3, :3] = self.nearest(given[:3, :3], where)
        result[:3, 3] = self.near(unit * given[:3, 3], where)
        return result

    def near(self, place: Floats, where: str) -> Floats:
        """A place in metres, shape (3,), where a robot can be."""
        if np.abs(place).max() > _FARTHEST:
            raise self.fail(
                f"{where} is {np.abs(place).max():.3g} m away; check how it was written"
            )
        return place

    def rotation(self, key: str, data: Any, where: str) -> Floats:
        """A rotation in the form that ``key`` names, shape (3, 3)."""
        if key == "rotation_matrix":
            return self.nearest(self.numbers(data, (3, 3), where), where)
        if key == "quaternion":
            if not isinstance(data, Mapping) or set(data) != set("wxyz"):
                raise self.fail(
                    f"{where} must be an object with w, x, y and z by name (files "
                    "differ in their order)"
                )
            q = np.array([self.numbers(data[n], (), f"{where}.{n}") for n in "wxyz"])
            off = abs(float(np.linalg.norm(q)) - 1)
            self.allow(off, f"{where}: the quaternion's length differs from 1 by", "")
            return rotation_from_quaternion_wxyz(q)
        if key == "euler":
            return self.euler(data, where)
        vector = self.numbers(data, (3,), where)
        if key.endswith("_deg"):
            return so3_exp(np.radians(vector))
        length = float(np.linalg.norm(vector))
        if length > _LONGEST_TURN:
            raise self.fail(
                f"{where} is a turn by {length:.4g} rad, more than once round; if "
                "these are degrees, the key is rotation_vector_deg"
            )
        return so3_exp(vector)

    def euler(self, data: Any, where: str) -> Floats:
        """A rotation by three angles, order and kind of axes stated, shape (3, 3)."""
        self.only(data, {"order", "about", "angles_deg"}, where)
        order = str(self.need(data, "order", where))
        about = self.need(data, "about", where)
        if (
            len(order) != 3
            or set(order) - set("xyz")
            or about not in ("fixed", "moving")
        ):
            raise self.fail(
                f'{where} needs "order" of three letters x, y, z and "about" "fixed" '
                f'or "moving" axes, got {order!r} and {about!r}'
            )
        angles = np.radians(
            self.numbers(
                self.need(data, "angles_deg", where), (3,), f"{where}.angles_deg"
            )
        )
        turns = [
            so3_exp(angle * np.eye(3)["xyz".index(axis)])
            for axis, angle in zip(order, angles, strict=True)
        ]
        first, second, third = turns if about == "moving" else turns[::-1]
        return np.asarray(first @ second @ third)

    def nearest(self, rotation: Floats, where: str) -> Floats:
        """The rotation, shape (3, 3), or the nearest one where that was asked for."""
        defect = float(np.abs(rotation.T @ rotation - np.eye(3)).max())
        determinant = float(np.linalg.det(rotation))
        if determinant < 0:
            raise self.fail(
                f"{where} is no rotation but a mirror image (determinant "
                f"{determinant:+.6f}); one axis has the wrong sign"
            )
        self.allow(
            defect,
            f"{where} is no rotation: R'R differs from I by",
            f" (determinant {determinant:+.6f})",
        )
        return nearest_rotation(rotation) if defect > _EXACT else rotation

    def allow(self, defect: float, text: str, detail: str) -> None:
        """Accept a rotation's defect, or say what it is and what to do."""
        if defect <= _EXACT or (self.orthonormalise and defect <= _ROUNDED):
            return
        advice = (
            "if that is rounding in print, add --orthonormalise"
            if defect <= _ROUNDED
            else "that is too far for rounding; check how it was written"
        )
        raise self.fail(f"{text} {defect:.2g}{detail}, allowed {_EXACT:g}; {advice}")

    def numbers(self, data: Any, shape: tuple[int, ...], where: str) -> Floats:
        """Finite numbers of a given shape."""
        try:
            array = np.array(data, dtype=float)
        except (TypeError, ValueError):
            raise self.fail(f"{where} must be numbers, got {data!r:.60}") from None
        if array.shape != shape:
            raise self.fail(
                f"{where} must have shape {shape or 'of one number'}, got {array.shape}"
            )
        if not np.isfinite(array).all():
            raise self.fail(f"{where} holds NaN or infinity; drop that pose")
        return array

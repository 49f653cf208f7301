"""One JSON document of everything in a session, and the schema that it follows."""

from __future__ import annotations

from typing import Any

Json = dict[str, Any]

EXPORT_SCHEMA = "handeye_tri.export/1"
_DRAFT = "https://json-schema.org/draft/2020-12/schema"
_NUMBER: Json = {"type": "number"}
_TEXT: Json = {"type": "string"}


def _row(count: int, item: Json | None = None) -> Json:
    return {
        "type": "array",
        "items": item or _NUMBER,
        "minItems": count,
        "maxItems": count,
    }


def _object(properties: Json, optional: tuple[str, ...] = (), **more: Any) -> Json:
    return {
        "type": "object",
        "properties": properties,
        "required": [key for key in properties if key not in optional],
        **more,
    }


def _ref(name: str) -> Json:
    return {"$ref": f"#/$defs/{name}"}


def _definitions() -> Json:
    quaternion = _object(dict.fromkeys("wxyz", _NUMBER), additionalProperties=False)
    motion = _object(
        {"translation_m": _row(3), "quaternion": quaternion},
        description="a_from_b: maps coordinates in b to a; the pose of b in a",
        additionalProperties=False,
    )
    camera = _object(
        {
            "name": _TEXT,
            "image_size_px": _row(2, {"type": "integer", "minimum": 1}),
            **{f"{name}_px": _NUMBER for name in ("fx", "fy", "skew", "cx", "cy")},
            "lens": _object(
                {
                    "model": {"enum": ["radtan", "rational"]},
                    "coefficients": {
                        "type": "object",
                        "additionalProperties": _NUMBER,
                    },
                }
            ),
        },
        description="pixel (0, 0) is the centre of the first pixel",
    )
    covariance = _object(
        {
            "labels": {"type": "array", "items": _TEXT},
            "matrix": {"type": "array", "items": {"type": "array", "items": _NUMBER}},
        },
        description="px, m, rad by label; tangents on the right: "
        "true = estimate @ exp(tangent), translation first",
    )
    station = _object(
        {
            "index": {"type": "integer"},
            "kind": {"enum": ["calibration", "evaluation"]},
            "mount": {"type": "integer", "minimum": 0},
            "joints_rad_or_m": {"type": "array", "items": _NUMBER},
            "base_from_flange": _ref("motion"),
        },
        description="mount: what holds the triangle there; 0 before a tool change",
    )
    mount = _object(
        {
            "flange_from_triangle": _ref("motion"),
            "markers_in_flange_m": _row(3, _row(3)),
        },
        description="after the tool change",
    )
    half_turn = _object(
        {
            "before": {"type": "integer"},
            "after": {"type": "integer"},
            "axis": {"enum": ["normal", "AB", "BC", "CA"]},
        }
    )
    return {
        "motion": motion,
        "camera": camera,
        "covariance": covariance,
        "station": station,
        "mount": mount,
        "half_turn": half_turn,
        "gate": _object({key: _TEXT for key in ("name", "found", "limit", "verdict")}),
        "finding": _object(
            {
                **{key: _TEXT for key in ("code", "cause", "evidence", "severity")},
                "remedy": _TEXT,
                "stations": {"type": "array", "items": {"type": "integer"}},
                "camera": _TEXT,
                "follows": _TEXT,
            },
            ("stations", "camera", "follows"),
        ),
    }


def json_schema() -> Json:
    """The JSON Schema (draft 2020-12) that an exported document follows."""
    many = {"type": "array"}
    motions = {"type": "object", "additionalProperties": _ref("motion")}
    calibrated = {
        "cameras": {**many, "items": _ref("camera"), "minItems": 1},
        "covariance": _ref("covariance"),
        "chi2": _NUMBER,
        "dof": {"type": "integer"},
        "method": _TEXT,
    }
    return {
        "$schema": _DRAFT,
        "title": "Everything in a handeye-tri session",
        "$defs": _definitions(),
        **_object(
            {
                "schema": {"const": EXPORT_SCHEMA},
                "notice": {"type": "array", "items": _TEXT},
                "frames": _object(
                    {
                        "base": _TEXT,
                        "flange": _TEXT,
                        "optical": {"type": "object", "additionalProperties": _TEXT},
                    }
                ),
                "session": _object(
                    {
                        "software": {"type": "object"},
                        "cell": {"type": "object"},
                        "seed": {"type": "integer"},
                        "simulated": {"type": "boolean"},
                        "method": _TEXT,
                    }
                ),
                "plan": _object(
                    {
                        "stations": {**many, "items": _ref("station")},
                        "half_turns": {**many, "items": _ref("half_turn")},
                        "tool_change": {
                            "type": ["object", "null"],
                            "properties": {"before": {"type": "integer"}},
                            "required": ["before"],
                        },
                    }
                ),
                "observations": _object(
                    {
                        "pixels_px": many,
                        "pixel_covariance_px2": many,
                    },
                    description="[camera][station][marker A, B, C][u, v]; null: unseen",
                ),
                "cameras": _object(
                    {**calibrated, "reference_from_camera": many},
                    description="step by step, as the paper does",
                ),
                "hand_eye": _object(
                    {
                        **calibrated,
                        "base_from_camera": motions,
                        "flange_from_triangle": _ref("motion"),
                        "markers_in_flange_m": _row(3, _row(3)),
                        "other_mounts": {**many, "items": _ref("mount")},
                    }
                ),
                "evaluation": _object(
                    {
                        "verdict": {"enum": ["PASS", "FAIL", "CANNOT TELL"]},
                        "sentence": _TEXT,
                        "gates": {**many, "items": _ref("gate")},
                        "findings": {**many, "items": _ref("finding")},
                        "track": {"type": "object"},
                    }
                ),
                "truth": {"type": ["object", "null"]},
            },
            ("truth",),
        ),
    }

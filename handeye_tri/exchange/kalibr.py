"""Kalibr's camchain YAML."""

from __future__ import annotations

from handeye_tri.camera import PinholeCamera
from handeye_tri.errors import InputError
from handeye_tri.exchange.results import Results, flat, skew_effect_px


def kalibr_yaml(results: Results) -> str:
    """A camchain: ``T_cn_cnm1`` of cam<n> maps cam<n-1> to cam<n>, metres.

    Kalibr's ``pinhole`` has fu fv pu pv, its ``radtan`` k1 k2 r1 r2 (our p1 p2).

    Raises:
        InputError: a lens has coefficients that the format lacks.
    """
    calibration = results.calibration
    lines = [
        *results.head,
        "intrinsics: fu fv pu pv, px; pixel (0, 0) is the centre of the first.",
        "T_cn_cnm1: maps points of the camera before to this one, metres.",
    ]
    body = ""
    for i, camera in enumerate(calibration.cameras):
        _refuse_other_lenses(camera)
        k = camera.intrinsics
        lines.append(f"cam{i} is {camera.name}.")
        if k.skew:
            effect = skew_effect_px(k.fy, k.cy, camera.image_size[1], k.skew)
            lines.append(
                f"cam{i}: the format has no skew factor; {k.skew:.6g} px is left out, "
                f"which moves a pixel by {effect:.3g} px at most."
            )
        body += f"cam{i}:\n"
        others = [j for j in range(len(calibration.cameras)) if j != i]
        body += f"  cam_overlaps: {others}\n  camera_model: pinhole\n"
        body += f"  distortion_coeffs: {flat(camera.lens.coefficients[:4])}\n"
        body += "  distortion_model: radtan\n"
        body += f"  intrinsics: {flat(k.vector[[0, 1, 3, 4]])}\n"
        body += f"  resolution: [{camera.image_size[0]}, {camera.image_size[1]}]\n"
        body += f"  rostopic: /{camera.name}/image_raw\n"
        if i:
            before = calibration.base_from_camera[i - 1]
            chain = calibration.base_from_camera[i].inverse() @ before
            rows = "".join(f"  - {flat(row)}\n" for row in chain.matrix)
            body += f"  T_cn_cnm1:\n{rows}"
    return "".join(f"# {line}\n" for line in lines) + body


def _refuse_other_lenses(camera: PinholeCamera) -> None:
    lacking = {
        name: camera.parameter(name)
        for name in camera.lens.names
        if name not in ("k1", "k2", "p1", "p2") and camera.parameter(name) != 0
    }
    if lacking:
        name, value = next(iter(lacking.items()))
        raise InputError(
            f"kalibr: its radtan lens has k1 k2 p1 p2 only, but {camera.name}.{name} "
            f"is {value:.6g}; export opencv or camera_info, or estimate only those "
            "four (cameras[].estimate.lens in the cell)"
        )

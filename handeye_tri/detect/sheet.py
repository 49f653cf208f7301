"""A picture of what a detection took for what."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from handeye_tri.detect.markers import Detection

_MARGIN_PX = 8.0
_LINE = (255, 0, 255)


def detection_sheet(
    image: NDArray[np.uint8], detection: Detection
) -> NDArray[np.uint8]:
    """Draw a detection over its image, with each marker enlarged on the right.

    Args:
        image: RGB, shape (h, w, 3), or grey, shape (h, w).
        detection: What was found in it.

    Returns:
        RGB, shape (h, w + h // 3, 3). Outlines and centres are magenta; a marker that
        was not found has its reason in its place.
    """
    rgb = image if image.ndim == 3 else np.repeat(image[..., None], 3, axis=2)
    height, width = rgb.shape[:2]
    side = height // 3
    sheet = Image.new("RGB", (width + side, height))
    sheet.paste(Image.fromarray(rgb), (0, 0))
    draw = ImageDraw.Draw(sheet)
    for k, letter in enumerate("ABC"):
        corner = (width, k * side)
        reason = detection.reasons[k]
        if reason is not None:
            draw.text((width + 6, k * side + 6), f"{letter}: {reason}", _LINE)
            continue
        u, v = (float(x) for x in detection.pixels[k])
        radius = float(detection.radii_px[k])
        _ring(draw, u, v, radius)
        draw.text((u + radius + 3, v - radius - 8), letter, _LINE)
        # The pixel (0, 0) has its centre there: its corner is at -0.5.
        reach = radius + _MARGIN_PX
        box = (u + 0.5 - reach, v + 0.5 - reach, u + 0.5 + reach, v + 0.5 + reach)
        zoom = side / (2 * reach)
        crop = Image.fromarray(rgb).transform(
            (side, side), Image.Transform.EXTENT, box, Image.Resampling.NEAREST
        )
        sheet.paste(crop, corner)
        middle = 0.5 * side - 0.5
        _ring(draw, corner[0] + middle, corner[1] + middle, radius * zoom)
        sigma = np.sqrt(np.diagonal(detection.covariance[k]))
        draw.text(
            (corner[0] + 6, corner[1] + 6),
            f"{letter}  {u:.3f} {v:.3f}\nsigma {sigma[0]:.3f} {sigma[1]:.3f} px",
            _LINE,
        )
    return np.asarray(sheet)


def _ring(draw: ImageDraw.ImageDraw, x: float, y: float, radius: float) -> None:
    draw.ellipse((x - radius, y - radius, x + radius, y + radius), outline=_LINE)
    draw.line((x - 3, y, x + 3, y), fill=_LINE)
    draw.line((x, y - 3, x, y + 3), fill=_LINE)

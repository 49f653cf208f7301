"""Pixels of the image messages in ROS recordings."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from handeye_tri.errors import InputError
from handeye_tri.storage import decode_image

# Channels of the encodings that say all there is to know.
_ENCODINGS = {
    "mono8": (1, (0,)),
    "8UC1": (1, (0,)),
    "rgb8": (3, (0, 1, 2)),
    "bgr8": (3, (2, 1, 0)),
    "rgba8": (4, (0, 1, 2)),
    "bgra8": (4, (2, 1, 0)),
}
_MAX_PIXELS = 100_000_000


def decode_message(message: Any, where: str) -> NDArray[np.uint8]:
    """Pixels of an image message, raw or compressed.

    Args:
        message: sensor_msgs/Image or CompressedImage, as the library decodes it.
        where: What a message to the user calls it.

    Returns:
        Shape (h, w) or (h, w, 3), red first.

    Raises:
        InputError: an encoding that is not read, or bytes that are no image.
    """
    if hasattr(message, "format"):
        return decode_image(bytes(message.data), where)
    encoding = str(message.encoding)
    if encoding not in _ENCODINGS:
        raise InputError(
            f"{where}: images of encoding {encoding!r} are not read; use one of "
            f"{', '.join(_ENCODINGS)} or compressed ones"
        )
    channels, order = _ENCODINGS[encoding]
    height, width, step = int(message.height), int(message.width), int(message.step)
    data = np.asarray(message.data, dtype=np.uint8)
    fits = 0 < width * height <= _MAX_PIXELS and step >= width * channels
    if not fits or data.size < step * height:
        raise InputError(
            f"{where}: {data.size} bytes are no image of {width} x {height} pixels "
            f"({encoding}, {step} bytes a row)"
        )
    rows = data[: step * height].reshape(height, step)[:, : width * channels]
    pixels = rows.reshape(height, width, channels)[..., list(order)]
    return np.array(pixels[..., 0] if channels == 1 else pixels)

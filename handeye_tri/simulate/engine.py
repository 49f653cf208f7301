"""The only place that imports MuJoCo: OpenGL without a display, and its canvas."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from handeye_tri.errors import MissingDependencyError

if sys.platform == "linux":
    # Read by mujoco when it is imported: render without a display.
    os.environ.setdefault("MUJOCO_GL", "egl")

_MISSING_GL = (
    "MuJoCo finds no OpenGL to render with ({}); on Debian and Ubuntu install it by "
    "`apt-get install libegl1 libegl-mesa0 libgl1 libgl1-mesa-dri`"
)


def import_mujoco() -> Any:
    """Import MuJoCo; the import itself loads OpenGL.

    Raises:
        MissingDependencyError: there is no OpenGL; names the Debian packages.
    """
    try:
        import mujoco
    except (ImportError, AttributeError, OSError) as error:
        raise MissingDependencyError(_MISSING_GL.format(error)) from None
    return mujoco


def one_line(error: Exception) -> str:
    """The text of an error that spreads over several lines."""
    return " ".join(str(error).split())


def check_rendering() -> None:
    """Draw a few pixels.

    Raises:
        MissingDependencyError: that fails; names the Debian packages.
    """
    mujoco = import_mujoco()
    with canvas(mujoco, mujoco.MjSpec().compile(), 8, 8):
        pass


@contextmanager
def canvas(
    mujoco: Any, model: Any, width: int, height: int
) -> Iterator[tuple[Any, Any]]:
    """An off-screen picture; yields its OpenGL context and MuJoCo's.

    Raises:
        MissingDependencyError: OpenGL is absent or fails.
    """
    model.vis.global_.offwidth = width
    model.vis.global_.offheight = height
    try:
        context = mujoco.GLContext(width, height)
    except (ImportError, AttributeError, RuntimeError, OSError) as error:
        raise MissingDependencyError(_MISSING_GL.format(one_line(error))) from None
    try:
        context.make_current()
        try:
            painter = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100)
        except mujoco.FatalError as error:
            raise MissingDependencyError(_MISSING_GL.format(one_line(error))) from None
        try:
            mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, painter)
            yield context, painter
        finally:
            context.make_current()
            painter.free()
    finally:
        context.free()

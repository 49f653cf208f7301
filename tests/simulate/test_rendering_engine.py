"""A machine without OpenGL is told which packages to install."""

from __future__ import annotations

import subprocess
import sys

import mujoco
import pytest

from handeye_tri.errors import MissingDependencyError
from handeye_tri.simulate import check_rendering


def test_no_opengl_names_the_packages(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(width: int, height: int) -> None:
        raise ImportError("Cannot initialize a EGL device display")

    check_rendering()
    monkeypatch.setattr(mujoco, "GLContext", broken)
    with pytest.raises(MissingDependencyError, match="apt-get install libegl1"):
        check_rendering()


def test_no_opengl_library_at_all_names_the_packages() -> None:
    """PyOpenGL fails while mujoco is imported, in ways that are no ImportError."""
    code = (
        "import ctypes, ctypes.util\n"
        "ctypes.util.find_library = lambda name: None\n"
        "real = ctypes.CDLL.__init__\n"
        "def fake(self, name=None, *a, **k):\n"
        "    if name and ('EGL' in str(name) or 'libGL' in str(name)\n"
        "                 or 'libOpenGL' in str(name)):\n"
        "        raise OSError(f'{name}: cannot open shared object file')\n"
        "    real(self, name, *a, **k)\n"
        "ctypes.CDLL.__init__ = fake\n"
        "from handeye_tri.errors import MissingDependencyError\n"
        "from handeye_tri.simulate import check_rendering\n"
        "try:\n"
        "    check_rendering()\n"
        "except MissingDependencyError as error:\n"
        "    print(error)\n"
    )
    result = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    assert "apt-get install libegl1" in result.stdout

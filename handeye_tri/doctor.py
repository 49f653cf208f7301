"""What this machine has and lacks for calibrating, drawing and looking."""

from __future__ import annotations

import ctypes
import importlib.metadata
import importlib.util
import os
import platform
import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

OLDEST_PYTHON = (3, 11)
BROWSERS = ("chromium", "chromium-browser", "google-chrome")
# A driver that hangs must not hang the doctor.
_PATIENCE_S = 60.0


@dataclass(frozen=True, slots=True)
class Check:
    """One thing that was looked for.

    Attributes:
        name: What was looked for.
        ok: Whether it is there and works.
        found: What was found: a version, a device, or why it does not work.
        remedy: What to do about it; empty where all is well.
        optional: Whether calibrating works without it.
    """

    name: str
    ok: bool
    found: str
    remedy: str = ""
    optional: bool = False


def examine() -> tuple[Check, ...]:
    """Look for everything that any command needs; takes a few seconds."""
    return (
        check_python(),
        check_packages(),
        check_opengl(),
        check_vulkan(),
        check_viewer(),
        check_browser(),
        check_recordings(),
    )


def check_python() -> Check:
    """The interpreter that runs this."""
    oldest = ".".join(map(str, OLDEST_PYTHON))
    ok = sys.version_info[:2] >= OLDEST_PYTHON
    remedy = "" if ok else f"use Python {oldest} or newer"
    return Check("Python", ok, f"{platform.python_version()}, {sys.executable}", remedy)


def check_packages(distribution: str = "handeye-tri") -> Check:
    """The versions of all packages that a distribution asks for, extras left out."""
    from packaging.requirements import Requirement

    name = "Python packages"
    try:
        stated = importlib.metadata.requires(distribution) or []
    except importlib.metadata.PackageNotFoundError:
        return Check(
            name,
            False,
            f"{distribution} runs from source and is not installed",
            "python -m pip install . in its folder",
        )
    versions, wrong = [], []
    for requirement in map(Requirement, stated):
        if requirement.marker and not requirement.marker.evaluate({"extra": ""}):
            continue
        try:
            version = importlib.metadata.version(requirement.name)
        except importlib.metadata.PackageNotFoundError:
            version = "missing"
        versions.append(f"{requirement.name} {version}")
        if version == "missing" or not requirement.specifier.contains(
            version, prereleases=True
        ):
            wrong.append(requirement)
    if not wrong:
        return Check(name, True, ", ".join(versions))
    asked = " ".join(f'"{r.name}{r.specifier}"' for r in wrong)
    names = {requirement.name for requirement in wrong}
    return Check(
        name,
        False,
        ", ".join(text for text in versions if text.split()[0] in names),
        f"python -m pip install {asked}",
    )


def check_opengl() -> Check:
    """Whether MuJoCo can draw without a display; in a process that may crash."""
    name = "OpenGL off screen"
    backend = os.environ.get("MUJOCO_GL", "default")
    text, ok = _in_child(
        "from handeye_tri.errors import MissingDependencyError\n"
        "from handeye_tri.simulate import check_rendering\n"
        "try:\n"
        "    check_rendering()\n"
        "except MissingDependencyError as error:\n"
        "    sys.exit(str(error))\n"
    )
    if ok:
        return Check(name, True, f"draws, MUJOCO_GL is {backend}")
    return Check(
        name,
        False,
        text.splitlines()[-1] if text else "drawing crashed",
        "sudo apt-get install libegl1 libegl-mesa0 libgl1 libgl1-mesa-dri; "
        "unset MUJOCO_GL or set it to egl",
    )


def check_vulkan() -> Check:
    """Whether the recording can be drawn without a display, by GPU or software."""
    text, ok = _in_child(
        "from handeye_tri.doctor import vulkan_devices\n"
        "print(', '.join(vulkan_devices()))\n"
    )
    if ok and text:
        return Check("Vulkan", True, text, optional=True)
    return Check(
        "Vulkan",
        False,
        "no device; replay --screenshot draws with one",
        "sudo apt-get install libvulkan1 mesa-vulkan-drivers",
        optional=True,
    )


def check_viewer() -> Check:
    """The viewer of recordings that comes with the rerun-sdk package."""
    spec = importlib.util.find_spec("rerun_cli")
    folders = (spec.submodule_search_locations if spec else None) or []
    for folder in folders:
        viewer = Path(folder) / "rerun"
        if not viewer.is_file():
            continue
        text, ok = _run([str(viewer), "--version"])
        if ok:
            version = text.partition(" (")[0]
            return Check("rerun viewer", True, f"{version}, {viewer}", optional=True)
    return Check(
        "rerun viewer",
        False,
        "absent, or it does not start; replay needs it",
        'python -m pip install --force-reinstall "rerun-sdk>=0.41,<0.42"',
        optional=True,
    )


def check_browser() -> Check:
    """A Chromium, in which the tests look at the report."""
    for name in BROWSERS:
        path = shutil.which(name)
        if path:
            return Check("chromium", True, path, optional=True)
    return Check(
        "chromium",
        False,
        "not found; only the tests of the report need it",
        "sudo apt-get install chromium",
        optional=True,
    )


def vulkan_devices() -> tuple[str, ...]:
    """Names of the devices that Vulkan offers here; empty without Vulkan."""
    try:
        vulkan = ctypes.CDLL("libvulkan.so.1")
    except OSError:
        return ()
    # VkInstanceCreateInfo: sType 1, everything else zero.
    request = (ctypes.c_uint64 * 8)(1)
    instance = ctypes.c_void_p()
    if vulkan.vkCreateInstance(request, None, ctypes.byref(instance)) != 0:
        return ()
    count = ctypes.c_uint32()
    vulkan.vkEnumeratePhysicalDevices(instance, ctypes.byref(count), None)
    devices = (ctypes.c_void_p * count.value)()
    vulkan.vkEnumeratePhysicalDevices(instance, ctypes.byref(count), devices)
    names = []
    for device in devices:
        # VkPhysicalDeviceProperties: 824 bytes; the name is 256 bytes at offset 20.
        properties = ctypes.create_string_buffer(1024)
        vulkan.vkGetPhysicalDeviceProperties(ctypes.c_void_p(device), properties)
        names.append(properties.raw[20:276].split(b"\0")[0].decode(errors="replace"))
    vulkan.vkDestroyInstance(instance, None)
    return tuple(names)


def _in_child(code: str) -> tuple[str, bool]:
    """Run Python code in a process of its own, which a driver may take down."""
    return _run([sys.executable, "-c", f"import sys\n{code}"])


def _run(command: list[str]) -> tuple[str, bool]:
    """What a command printed, or complained of, and whether it succeeded."""
    try:
        done = subprocess.run(
            command,
            check=False,
            capture_output=True,
            text=True,
            timeout=_PATIENCE_S,
            stdin=subprocess.DEVNULL,
        )
    except subprocess.TimeoutExpired:
        return f"no answer within {_PATIENCE_S:.0f} s", False
    except OSError as error:
        return str(error), False
    ok = done.returncode == 0
    return (done.stdout if ok else done.stderr).strip(), ok


def check_recordings() -> Check:
    """What ROS recordings are read and written with."""
    lacking = [
        package
        for module, package in (
            ("mcap", "mcap"),
            ("mcap_ros2", "mcap-ros2-support"),
            ("rosbags", "rosbags"),
        )
        if importlib.util.find_spec(module) is None
    ]
    if not lacking:
        text = f"rosbags {importlib.metadata.version('rosbags')}"
        return Check("ROS recordings", True, text, optional=True)
    return Check(
        "ROS recordings",
        False,
        f"{', '.join(lacking)} absent",
        'install them with: pip install "handeye-tri[ros]"',
        optional=True,
    )

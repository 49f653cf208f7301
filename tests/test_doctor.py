"""The doctor sees what is there, and says what to do about what is not."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from handeye_tri import doctor


def fake_distribution(folder: Path, *requirements: str) -> str:
    """Metadata of a package that asks for ``requirements``, as pip leaves it."""
    info = folder / "asks_for_things-1.0.dist-info"
    info.mkdir()
    lines = ["Metadata-Version: 2.1", "Name: asks-for-things", "Version: 1.0"]
    lines += [f"Requires-Dist: {requirement}" for requirement in requirements]
    (info / "METADATA").write_text("\n".join(lines) + "\n")
    return "asks-for-things"


def test_examine_looks_at_everything_once() -> None:
    """The test machine has what is needed: scripts/setup.sh put it there."""
    checks = doctor.examine()
    assert len({check.name for check in checks}) == len(checks) == 7
    assert [check for check in checks if not check.ok and not check.optional] == []
    assert all(check.found for check in checks)
    assert all(bool(check.remedy) != check.ok for check in checks)


def test_an_old_python(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "version_info", (3, 10, 4, "final", 0))
    check = doctor.check_python()
    assert not check.ok
    assert check.remedy == "use Python 3.11 or newer"


def test_packages_too_old_or_absent(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    name = fake_distribution(
        tmp_path,
        "numpy>=1",
        "click>=999",
        "never-heard-of-it>=2",
        "also-never; extra == 'test'",
        "neither; python_version < '3'",
    )
    monkeypatch.syspath_prepend(str(tmp_path))
    check = doctor.check_packages(name)
    assert not check.ok
    assert check.remedy == 'python -m pip install "click>=999" "never-heard-of-it>=2"'
    assert check.found.startswith("click ")
    assert check.found.endswith("never-heard-of-it missing")
    assert "numpy" not in check.found


def test_packages_in_order(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    name = fake_distribution(tmp_path, "numpy>=1")
    monkeypatch.syspath_prepend(str(tmp_path))
    check = doctor.check_packages(name)
    assert check.ok
    assert check.found.startswith("numpy ")


def test_a_distribution_that_is_not_installed() -> None:
    check = doctor.check_packages("handeye-tri-of-another-world")
    assert not check.ok
    assert "not installed" in check.found


def test_opengl_that_cannot_work(monkeypatch: pytest.MonkeyPatch) -> None:
    """GLFW opens windows; without a display there is none to draw in."""
    monkeypatch.setenv("MUJOCO_GL", "glfw")
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    check = doctor.check_opengl()
    assert not check.ok
    assert "OpenGL" in check.found
    assert "libegl1" in check.remedy


def test_a_driver_that_crashes_or_hangs_is_only_a_failed_check(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    text, ok = doctor._in_child("import os; os.abort()")
    assert (text, ok) == ("", False)
    monkeypatch.setattr(doctor, "_PATIENCE_S", 0.5)
    text, ok = doctor._in_child("import time; time.sleep(30)")
    assert not ok
    assert text.startswith("no answer within")


def test_vulkan_without_a_driver(monkeypatch: pytest.MonkeyPatch) -> None:
    for variable in ("VK_ICD_FILENAMES", "VK_DRIVER_FILES"):
        monkeypatch.setenv(variable, "/nowhere.json")
    check = doctor.check_vulkan()
    assert not check.ok
    assert check.optional
    assert check.remedy == "sudo apt-get install libvulkan1 mesa-vulkan-drivers"


def test_no_viewer(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    check = doctor.check_viewer()
    assert not check.ok
    assert "rerun-sdk" in check.remedy


def test_no_browser(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    assert not doctor.check_browser().ok
    chromium = tmp_path / "chromium"
    chromium.write_text("#!/bin/sh\n")
    chromium.chmod(0o755)
    assert doctor.check_browser().found == str(chromium)


def test_without_the_extra_ros_it_says_how_to_get_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    assert doctor.check_recordings().ok
    monkeypatch.setattr(
        doctor.importlib.util, "find_spec", lambda name: None if "mcap" in name else 1
    )
    check = doctor.check_recordings()
    assert not check.ok
    assert check.optional
    assert check.found == "mcap, mcap-ros2-support absent"
    assert 'pip install "handeye-tri[ros]"' in check.remedy

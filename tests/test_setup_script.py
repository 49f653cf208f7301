"""scripts/setup.sh: which Python, which packages, what it says, when it rests."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

REPO = Path(__file__).resolve().parent.parent


class Machine:
    """A folder of pretended commands before PATH, and what they were called with."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.calls = folder / "calls"
        self.calls.touch()
        self.command(
            "dpkg-query", 'grep -qx "${@: -1}" "$HERE/has" && echo -n installed'
        )
        self.command("id", "echo 0")
        self.command("apt-get", 'echo "apt-get $*" >>"$HERE/calls"')
        (folder / "has").write_text("libegl1\n")

    def command(self, name: str, script: str) -> None:
        path = self.folder / name
        path.write_text(f"#!/bin/bash\nHERE={self.folder}\n{script}\n")
        path.chmod(0o755)

    def run(
        self, script: str, path: str | None = None
    ) -> subprocess.CompletedProcess[str]:
        """Run bash code after sourcing setup.sh, seeing the pretended commands."""
        return subprocess.run(
            ["bash", "-c", f'source "{REPO}/scripts/setup.sh"\n{script}'],
            env={
                "PATH": f"{self.folder}:{os.environ['PATH'] if path is None else path}"
            },
            cwd=self.folder,
            check=False,
            capture_output=True,
            text=True,
        )


@pytest.fixture
def machine(tmp_path: Path) -> Machine:
    return Machine(tmp_path)


def test_nothing_is_installed_where_nothing_is_missing(machine: Machine) -> None:
    done = machine.run("install_packages libegl1")
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
    assert machine.calls.read_text() == ""


def test_root_installs_exactly_what_is_missing(machine: Machine) -> None:
    done = machine.run("install_packages libegl1 libgl1 libvulkan1")
    assert done.returncode == 0
    assert machine.calls.read_text().splitlines() == [
        "apt-get update -qq",
        "apt-get install -y -qq --no-install-recommends libgl1 libvulkan1",
    ]


def test_a_user_with_passwordless_sudo_does_too(machine: Machine) -> None:
    machine.command("id", "echo 1000")
    machine.command("sudo", 'echo "sudo $1" >>"$HERE/calls"; shift; exec "$@"')
    done = machine.run("install_packages libgl1")
    assert done.returncode == 0
    assert "sudo -n" in machine.calls.read_text()
    assert "--no-install-recommends libgl1" in machine.calls.read_text()


def test_without_rights_one_sentence_names_what_is_missing(machine: Machine) -> None:
    machine.command("id", "echo 1000")
    machine.command("sudo", "exit 1")
    done = machine.run("install_packages libegl1 libgl1 libvulkan1")
    assert done.returncode == 2
    assert done.stderr == (
        "setup: these Debian packages are missing: libgl1 libvulkan1; install them "
        "with: sudo apt-get install libgl1 libvulkan1\n"
    )
    assert machine.calls.read_text() == ""


def test_an_installation_that_fails_names_them_too(machine: Machine) -> None:
    machine.command("apt-get", "echo no network >&2; exit 100")
    done = machine.run("install_packages libgl1")
    assert done.returncode == 2
    assert done.stderr.splitlines()[-1] == (
        "setup: apt-get could not install libgl1; install these Debian packages by hand"
    )


def test_chromium_counts_however_it_came(machine: Machine) -> None:
    machine.command("chromium", "")
    assert machine.run("install_packages chromium").returncode == 0
    assert machine.calls.read_text() == ""


def test_the_first_python_that_is_new_enough(machine: Machine) -> None:
    machine.command("python3", "exit 1")  # too old: its version check fails
    machine.command("python3.13", "exit 0")
    done = machine.run("find_python", path="/usr/bin:/bin")
    assert done.returncode == 0
    found = Path(done.stdout.strip()).name
    assert found in ("python3.11", "python3.12", "python3.13")
    machine.command("mine", "exit 0")
    done = machine.run(f"PYTHON={machine.folder}/mine find_python")
    assert done.stdout.strip() == f"{machine.folder}/mine"


def test_no_python_that_is_new_enough(machine: Machine) -> None:
    tools = machine.folder / "tools"
    tools.mkdir()
    for name in ("bash", "dirname"):
        (tools / name).symlink_to(str(shutil.which(name)))
    done = machine.run("find_python", path=str(tools))
    assert done.returncode == 2
    assert done.stderr.startswith("setup: no Python 3.11 or newer found; install one")


def test_a_finished_environment_is_left_alone_and_a_stale_one_is_not(
    machine: Machine,
) -> None:
    """The stamp holds for this lock and this Python; a broken venv is made anew."""
    venv = machine.folder / "venv"
    (venv / "bin").mkdir(parents=True)
    (venv / "bin" / "python").symlink_to(sys.executable)
    (venv / "bin" / "handeye-tri").touch(mode=0o755)
    machine.command("python", '[ "$1" = -VV ] && echo Python 3.11.0 || exit 7')
    prefix = f"VENV={venv}; stamp={venv}/installed; py={machine.folder}/python\n"
    write = (
        'echo "$($py -VV) $REPO $(cat "$REPO/scripts/requirements.txt" '
        '"$REPO/pyproject.toml" | sha256sum)" >$stamp\n'
    )
    done = machine.run(prefix + write + "install_python $py")
    assert (done.returncode, done.stderr) == (0, "")
    assert venv.exists()
    done = machine.run(prefix + "echo old >$stamp\ninstall_python $py")
    assert done.returncode == 2  # the pretended Python makes no environment
    assert "could not make a virtual environment" in done.stderr
    assert not (venv / "installed").exists()

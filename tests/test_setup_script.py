"""scripts/setup.sh: which Python, which packages, what it says, when it rests."""

from __future__ import annotations

import os
import shutil
import subprocess
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


class Environment:
    """A pretended virtual environment, and the Python that it was made with."""

    def __init__(self, machine: Machine) -> None:
        self.machine = machine
        self.venv = machine.folder / "venv"
        # A Python that makes environments whose pip only says what it was asked.
        pip = f'[ "$1" = -m ] && echo "${{@: -1}}" >>{machine.calls}; exit 0'
        machine.command("pip-python", pip)
        machine.command(
            "py",
            'case "$*" in\n'
            "-VV) echo Python 3.11.0 ;;\n"
            f'*venv*) mkdir -p "$3/bin"; cp {machine.folder}/pip-python '
            '"$3/bin/python"; echo venv >>"$HERE/calls" ;;\n'
            "esac",
        )

    def install(self) -> list[str]:
        """What one more installation did."""
        self.machine.calls.write_text("")
        done = self.machine.run(
            f"VENV={self.venv}; install_python {self.machine.folder}/py"
        )
        assert done.returncode == 0, done.stderr
        return self.machine.calls.read_text().splitlines()


def test_an_environment_is_made_once_and_again_when_it_is_stale(
    machine: Machine,
) -> None:
    environment = Environment(machine)
    everything = ["venv", str(REPO / "scripts" / "requirements.txt"), str(REPO)]
    assert environment.install() == everything
    assert environment.install() == []
    # Another lock or Python, an interpreter that is gone, an interrupted first time.
    (environment.venv / "packages").write_text("something else\n")
    assert environment.install() == everything
    (environment.venv / "bin" / "python").unlink()
    assert environment.install() == everything
    (environment.venv / "packages").unlink()
    assert environment.install() == everything
    # Another pyproject.toml.
    (environment.venv / "project").write_text("something else\n")
    assert environment.install() == [str(REPO)]
    assert environment.install() == []


def test_a_python_that_makes_no_environment(machine: Machine) -> None:
    machine.command("py", '[ "$1" = -VV ] || exit 7')
    done = machine.run(
        f"VENV={machine.folder}/venv; install_python {machine.folder}/py"
    )
    assert done.returncode == 2
    assert "could not make a virtual environment" in done.stderr

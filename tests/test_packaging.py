"""What is committed, locked and shipped."""

from __future__ import annotations

import hashlib
import re
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

REPO = Path(__file__).resolve().parent.parent
LOCK = REPO / "scripts" / "requirements.txt"
# Spelt so that this file does not name one either.
HOSTS = [
    "pypi" + ".org",
    "pythonhosted" + ".org",
    "anaconda" + ".org",
    "npmjs" + ".org",
    "crates" + ".io",
    "rubygems" + ".org",
]
MIB = 2**20
# On Windows, and what Dask needs of Pythons before 3.12.
ONLY_SOMEWHERE = {"colorama", "importlib-metadata", "lazy-importer", "zipp"}


@pytest.fixture(scope="module")
def tracked() -> list[Path]:
    listing = subprocess.run(
        ["git", "ls-files"], cwd=REPO, check=False, capture_output=True, text=True
    )
    if listing.returncode != 0:
        pytest.skip("not a git checkout")
    return [REPO / line for line in listing.stdout.splitlines()]


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The wheel, built from the working tree with the locked build backend."""
    folder = tmp_path_factory.mktemp("wheel")
    command = [sys.executable, "-m", "build", "--wheel", "--no-isolation"]
    subprocess.run(
        [*command, "--outdir", str(folder), str(REPO)],
        check=True,
        capture_output=True,
    )
    (path,) = folder.glob("*.whl")
    return path


def locked_packages() -> dict[str, list[str]]:
    """Versions by canonical name."""
    found: dict[str, list[str]] = {}
    for line in LOCK.read_text().splitlines():
        if line[:1] not in ("#", " ", ""):
            requirement = Requirement(line.removesuffix("\\"))
            (pin,) = requirement.specifier
            assert pin.operator == "=="
            name = canonicalize_name(requirement.name)
            found.setdefault(name, []).append(pin.version)
    return found


def test_no_file_names_a_package_registry(tracked: list[Path]) -> None:
    naming = [
        f"{path.relative_to(REPO)}: {host}"
        for path in tracked
        if path.exists()
        for host in HOSTS
        if host.encode() in path.read_bytes()
    ]
    assert naming == []


def test_no_large_files(tracked: list[Path]) -> None:
    large = [p for p in tracked if p.exists() and p.stat().st_size > MIB]
    assert large == []


def test_every_locked_package_is_hashed_and_has_no_address() -> None:
    text = LOCK.read_text()
    assert "://" not in text
    assert "--index" not in text
    assert "--find-links" not in text
    blocks = re.split(r"\n(?=[a-zA-Z])", text.partition("\n\n")[0])
    unhashed = [
        block.split()[0]
        for block in blocks
        if not block.startswith("#") and "--hash=sha256:" not in block
    ]
    assert unhashed == []
    assert len(locked_packages()) > 50


def test_the_lock_satisfies_pyproject() -> None:
    """After a change of pyproject.toml: bash scripts/lock.sh."""
    project = tomllib.loads((REPO / "pyproject.toml").read_text())
    stated = [
        *project["build-system"]["requires"],
        *project["project"]["dependencies"],
        *project["project"]["optional-dependencies"]["test"],
    ]
    lock = locked_packages()
    for requirement in map(Requirement, stated):
        versions = lock.get(canonicalize_name(requirement.name), [])
        assert versions, f"{requirement.name} is not locked"
        for version in versions:
            assert requirement.specifier.contains(version), (requirement, version)


def test_every_python_gets_the_same_versions() -> None:
    """Same cell, same seed, same numbers: also on another Python."""
    several = {n: v for n, v in locked_packages().items() if len(v) > 1}
    assert several == {}


def test_wheel_holds_the_package_the_models_and_the_scenes(
    wheel: Path, tracked: list[Path]
) -> None:
    with zipfile.ZipFile(wheel) as archive:
        shipped = {
            name: hashlib.sha256(archive.read(name)).hexdigest()
            for name in archive.namelist()
        }
    for path in tracked:
        if not path.exists():
            continue
        inside = path.relative_to(REPO)
        if inside.parts[0] in ("robot_models", "scenes"):
            inside = Path("handeye_tri") / inside
        if inside.parts[0] == "handeye_tri":
            digest = hashlib.sha256(path.read_bytes()).hexdigest()
            assert shipped.get(str(inside)) == digest, inside
    tops = {name.split("/")[0] for name in shipped}
    assert tops == {"handeye_tri", "handeye_tri-0.1.0.dist-info"}
    assert [name for name in shipped if "__pycache__" in name] == []


def test_an_installed_wheel_finds_its_cells_from_any_folder(
    wheel: Path, tmp_path: Path
) -> None:
    """Unpacked far from the checkout: what it reads can only be its own."""
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(tmp_path / "site")
    code = (
        "import sys\n"
        f"sys.path[:] = [p for p in sys.path if p != {str(REPO)!r}]\n"
        f"sys.path.insert(0, {str(tmp_path / 'site')!r})\n"
        "from handeye_tri import storage\n"
        "path = storage.find_cell('hp3_stereo')\n"
        "cell = storage.read_cell(path)\n"
        "print(path)\n"
        "print(storage.find_model(cell, path))\n"
    )
    done = subprocess.run(
        [sys.executable, "-I", "-c", code],
        cwd=tmp_path,
        check=True,
        capture_output=True,
        text=True,
    )
    inside = tmp_path / "site" / "handeye_tri"
    assert done.stdout.split() == [
        str(inside / "scenes" / "hp3_stereo.yaml"),
        str(inside / "robot_models" / "hp3_like.xml"),
    ]


def test_wheel_installs_the_command(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        (name,) = [n for n in archive.namelist() if n.endswith("entry_points.txt")]
        assert "handeye-tri = handeye_tri.cli:main" in archive.read(name).decode()

"""What the source must look like: directions, engines, names, places."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

REPO = Path(__file__).resolve().parent.parent
PACKAGE = REPO / "handeye_tri"

# A module imports only from rows before its own. A folder is one module.
ROWS: tuple[tuple[str, ...], ...] = (
    ("errors", "threads", "counting"),
    ("se3", "arguments"),
    ("camera", "triangle"),
    ("records",),
    # Both hand out, or hold their arrays as, records.
    ("mechanism", "config"),
    # Plain numpy below what talks to an engine: arm, simulate.
    ("kinematics", "solids"),
    ("storage", "arm"),
    # Other tools' files are read with the same care as ours.
    ("exchange",),
    ("plan", "synthesize", "simulate", "detect"),
    ("calibrate_cameras",),
    ("hand_eye",),
    ("adjustment",),
    ("evaluate", "diagnose"),
    # The words on the terminal, in the report and in the recording are the same.
    ("summary",),
    ("report", "replay", "sweep", "solve"),
    ("doctor",),
    ("pipeline",),
    # Fig. 12 is a whole run of the pipeline.
    ("experiments",),
    ("cli",),
    # What the package re-exports, and `python -m handeye_tri`.
    ("__init__", "__main__"),
)
RANK = {name: rank for rank, row in enumerate(ROWS) for name in row}

ENGINES = {
    "mujoco": ("simulate",),
    "OpenGL": ("simulate",),
    "glfw": ("simulate",),
    "pinocchio": ("arm",),
    "coal": ("solids",),
    "hppfcl": ("solids",),
    # The baselines of the experiments are OpenCV's.
    "cv2": ("detect", "experiments"),
    "ompl": ("plan",),
    "rerun": ("replay",),
    "rerun_bindings": ("replay",),
}
ESTIMATORS = ("calibrate_cameras", "hand_eye", "adjustment")
# Rank alone would let an estimator read these.
CLOSED_TO_ESTIMATORS = {
    *("arm", "kinematics", "mechanism", "plan", "simulate", "synthesize", "detect"),
    *("storage", "exchange", "config"),
}
# Imported when a command needs them, not when the command line starts.
SLOW = {*ENGINES, "matplotlib", "scipy", "pydantic", "rich", "jinja2", "PIL"}

TOP_LEVEL = {
    "pyproject.toml",
    "README.md",
    "handeye_tri",
    "robot_models",
    "scenes",
    "tests",
    "scripts",
}
VAGUE_NAMES = {"utils", "util", "common", "helpers", "helper", "core", "misc"}


def tracked() -> list[Path]:
    """Files in the repository, relative to its top."""
    listing = subprocess.run(
        ["git", "ls-files"],
        cwd=REPO,
        check=False,
        capture_output=True,
        text=True,
    )
    if listing.returncode != 0:
        pytest.skip("not a git checkout")
    return [
        Path(line) for line in listing.stdout.splitlines() if (REPO / line).exists()
    ]


def sources() -> list[Path]:
    return sorted(PACKAGE.rglob("*.py"))


def module_of(path: Path) -> str:
    """Name of the row entry that a file of the package belongs to."""
    return path.relative_to(PACKAGE).parts[0].removesuffix(".py")


def imported(tree: ast.AST) -> Iterator[tuple[str, int]]:
    """Dotted names that a syntax tree imports anywhere, with their lines.

    ``from a import b`` yields ``a.b``; ``import_module("a")`` counts too.
    """
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            for alias in node.names:
                yield alias.name, node.lineno
        elif isinstance(node, ast.ImportFrom):
            source = "." * node.level + (node.module or "")
            for alias in node.names:
                yield f"{source}.{alias.name}", node.lineno
        elif isinstance(node, ast.Call) and node.args:
            called = node.func.attr if isinstance(node.func, ast.Attribute) else None
            if isinstance(node.func, ast.Name):
                called = node.func.id
            first = node.args[0]
            if called in ("import_module", "__import__") and isinstance(
                first, ast.Constant
            ):
                yield str(first.value), node.lineno


def violations(module: str, text: str) -> list[str]:
    """What a module's source imports that its row does not allow."""
    found = []
    for name, line in imported(ast.parse(text)):
        parts = name.split(".")
        if name.startswith("."):
            found.append(f"line {line}: relative import {name}")
        elif parts[0] in ENGINES and module not in ENGINES[parts[0]]:
            owners = " and ".join(ENGINES[parts[0]])
            found.append(f"line {line}: {parts[0]} belongs to {owners}")
        elif parts[0] == "handeye_tri":
            target = parts[1] if len(parts) > 1 else "__init__"
            if target == module:
                continue
            if target not in RANK:
                # Names that __init__ re-exports bring everything with them.
                found.append(f"line {line}: {name} is no module that has a row")
            elif RANK[target] >= RANK[module]:
                found.append(f"line {line}: {module} must not import {target}")
            elif module in ESTIMATORS and target in CLOSED_TO_ESTIMATORS:
                found.append(f"line {line}: an estimator must not import {target}")
    return found


@pytest.mark.parametrize(
    ("module", "text"),
    [
        ("se3", "from handeye_tri.camera import PinholeCamera"),
        ("camera", "from handeye_tri.triangle import AXES"),
        ("camera", "def f():\n    import handeye_tri.records"),
        ("hand_eye", "from handeye_tri import adjustment"),
        ("hand_eye", "from handeye_tri.config import Cell"),
        ("hand_eye", "from handeye_tri import SE3"),
        ("plan", "def f():\n    import pinocchio as pin"),
        ("report", "import importlib\nimportlib.import_module('cv2')"),
        ("detect", "from .camera import Lens"),
        ("detect", "if TYPE_CHECKING:\n    from handeye_tri.simulate import x"),
    ],
)
def test_the_check_itself_sees_violations(module: str, text: str) -> None:
    assert len(violations(module, text)) == 1


def test_every_module_has_its_row() -> None:
    assert sorted({module_of(path) for path in sources()} - set(RANK)) == []


@pytest.mark.parametrize(
    "path",
    [path for path in sources() if module_of(path) in RANK],
    ids=lambda path: str(path.relative_to(PACKAGE)),
)
def test_imports_point_upstream_and_engines_stay_in_their_file(path: Path) -> None:
    assert violations(module_of(path), path.read_text()) == []


def test_an_engine_is_imported_by_one_file_of_a_module() -> None:
    users: dict[tuple[str, str], set[Path]] = {}
    for path in sources():
        for name, _ in imported(ast.parse(path.read_text())):
            engine = name.split(".")[0]
            if engine in ENGINES:
                users.setdefault((engine, module_of(path)), set()).add(path)
    assert {engine for engine, paths in users.items() if len(paths) > 1} == set()


def test_estimators_never_name_the_truth() -> None:
    for path in sources():
        if module_of(path) in ESTIMATORS:
            names = {
                getattr(node, "id", None) or getattr(node, "attr", None)
                for node in ast.walk(ast.parse(path.read_text()))
            } | {
                name.split(".")[-1] for name, _ in imported(ast.parse(path.read_text()))
            }
            assert "GroundTruth" not in names, path


@pytest.mark.parametrize("module", ["handeye_tri", "handeye_tri.cli"])
def test_importing_is_light(module: str) -> None:
    code = f"import sys, {module}; print(*{{m.split('.')[0] for m in sys.modules}})"
    loaded = subprocess.run(
        [sys.executable, "-c", code], check=True, capture_output=True, text=True
    ).stdout.split()
    assert SLOW & set(loaded) == set()


def test_public_names_are_there() -> None:
    import handeye_tri

    for name in handeye_tri.__all__:
        assert getattr(handeye_tri, name).__name__ == name
    assert set(handeye_tri.__all__) <= set(dir(handeye_tri))
    with pytest.raises(AttributeError, match="no attribute 'calibrate_everything'"):
        _ = handeye_tri.calibrate_everything


def test_tests_mirror_the_modules() -> None:
    """module.py has test_module*.py; a folder has it too, or a folder of tests."""
    missing = []
    for module in sorted({module_of(path) for path in sources()} - set(ROWS[-1])):
        beside = list((REPO / "tests").glob(f"test_{module}*.py"))
        inside = list((REPO / "tests" / module).glob("test_*.py"))
        if not beside + inside:
            missing.append(module)
    assert missing == []


def test_top_level_holds_what_it_should() -> None:
    top = {path.parts[0] for path in tracked()}
    assert {name for name in top if not name.startswith(".")} <= TOP_LEVEL


def test_no_vague_names() -> None:
    vague = [
        str(path)
        for path in tracked()
        if VAGUE_NAMES & {Path(part).stem for part in path.parts}
    ]
    assert vague == []


def test_files_stay_readable_in_one_go() -> None:
    """About 400 lines is where a file is split; a tenth more is no reason."""
    long = {
        path.name: lines
        for path in sources()
        if (lines := len(path.read_text().splitlines())) > 470
    }
    assert long == {}


def public_functions(tree: ast.Module) -> Iterator[ast.FunctionDef]:
    """Functions of a module and methods of its classes, not what is nested in them."""
    for node in tree.body:
        for inner in node.body if isinstance(node, ast.ClassDef) else [node]:
            if isinstance(inner, ast.FunctionDef) and not inner.name.startswith("_"):
                yield inner


def test_docstrings_say_the_shape_of_arrays() -> None:
    """Beyond ruff's D rules: where arrays go in, the docstring says a shape."""
    silent = []
    for path in sources():
        for node in public_functions(ast.parse(path.read_text())):
            text = ast.get_docstring(node) or ""
            takes_arrays = any(
                re.match(r"ArrayLike|Floats|NDArray", ast.unparse(argument.annotation))
                for argument in (*node.args.args, *node.args.kwonlyargs)
                if argument.annotation
            )
            if takes_arrays and not re.search(r"[Ss]hape|\((\.\.\.|\w+), ", text):
                silent.append(f"{path.name}:{node.lineno} {node.name}")
    assert silent == []


def test_the_source_stands_alone() -> None:
    """No text leans on how it was made or on what does not ship with it."""
    leaning = re.compile(
        r"\b((?i:shared/|prototype|issue #?\d|the brief\b)|TODO|FIXME|XXX)"
    )
    found = []
    for path in tracked():
        if path.suffix in (".py", ".sh", ".yaml", ".xml", ".toml") and path.parts[
            0
        ] not in ("tests",):
            for number, line in enumerate((REPO / path).read_text().splitlines(), 1):
                if leaning.search(line):
                    found.append(f"{path}:{number}: {line.strip()}")
    assert found == []

"""The rules of the house that no type checker knows."""

import ast
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
SOURCES = ROOT / "src"
PACKAGES = sorted(path.name for path in SOURCES.iterdir() if (path / path.name / "__init__.py").is_file())
MODULES = sorted(path for package in PACKAGES for path in (SOURCES / package / package).rglob("*.py"))

# What each package may import of the others.
MAY_IMPORT = {
    "knee_gap_core": {"knee_gap_msgs"},
    "knee_gap_perception": {"knee_gap_msgs", "knee_gap_core"},
    "knee_gap_uncertainty": {"knee_gap_msgs", "knee_gap_core"},
    "knee_gap_simulation": {"knee_gap_msgs", "knee_gap_core"},
    "knee_gap_replay": {
        "knee_gap_msgs",
        "knee_gap_core",
        "knee_gap_perception",
        "knee_gap_uncertainty",
        "knee_gap_simulation",
    },
    "knee_gap_bringup": {
        "knee_gap_msgs",
        "knee_gap_core",
        "knee_gap_perception",
        "knee_gap_uncertainty",
        "knee_gap_simulation",
        "knee_gap_replay",
    },
}


def imported(path: Path) -> Iterator[str]:
    """Full names of all modules that a file imports, wherever in it."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            yield node.module


def test_every_package_is_listed() -> None:
    assert set(PACKAGES) == set(MAY_IMPORT)


@pytest.mark.parametrize("path", MODULES, ids=lambda path: str(path.relative_to(SOURCES)))
def test_only_nodes_import_rclpy(path: Path) -> None:
    if not path.stem.endswith("_node"):
        assert not [name for name in imported(path) if name.split(".")[0] == "rclpy"]


@pytest.mark.parametrize("path", MODULES, ids=lambda path: str(path.relative_to(SOURCES)))
def test_dependencies_run_one_way(path: Path) -> None:
    package = path.relative_to(SOURCES).parts[0]
    others = {name.split(".")[0] for name in imported(path)} - {package}
    assert {name for name in others if name.startswith("knee_gap")} <= MAY_IMPORT[package]


def test_everything_but_nodes_imports_without_rclpy() -> None:
    names = [
        ".".join(path.relative_to(SOURCES / path.relative_to(SOURCES).parts[0]).with_suffix("").parts)
        for path in MODULES
        if not path.stem.endswith("_node") and path.stem not in ("__main__", "__init__")
    ]
    assert len(names) > 50
    program = (
        "import importlib, sys\n"
        "sys.modules['rclpy'] = None\n"
        f"for name in {names!r}: importlib.import_module(name)\n"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-2000:]


def test_no_path_of_a_machine_and_no_index_host_in_the_tree() -> None:
    tracked = subprocess.run(
        ["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=False
    ).stdout.split()
    texts = [ROOT / name for name in tracked if not name.endswith((".mcap", ".png", ".svg", ".jpg"))]
    if not texts:
        pytest.skip("not a git checkout")
    forbidden = ("/" + "work/", "/" + "root/", "pypi" + ".org", "files.python" + "hosted")
    found = [
        f"{path.relative_to(ROOT)}: {word}"
        for path in texts
        if path.is_file()
        for word in forbidden
        if word in path.read_text(errors="replace")
    ]
    assert not found

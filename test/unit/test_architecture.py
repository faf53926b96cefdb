"""The rules of the house that no type checker knows."""

import ast
import re
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


FOLDERS = sorted({path.parent for path in MODULES})
MOST_MODULES = 12
MOST_FLOORS = 7


def name_of(path: Path) -> str:
    """Dotted name of a module or, for its __init__.py, of a package."""
    return ".".join(path.relative_to(SOURCES).with_suffix("").parts[1:]).removesuffix(".__init__")


NAMES = {name_of(path): path for path in MODULES}


def imported_modules(path: Path) -> Iterator[str]:
    """Full names of all modules of this repository that a file imports."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names if alias.name in NAMES)
        elif isinstance(node, ast.ImportFrom) and node.module:
            for alias in node.names:
                full = f"{node.module}.{alias.name}"
                yield from (name for name in (full if full in NAMES else node.module,) if name in NAMES)


def neighbours(folder: Path) -> dict[str, set[str]]:
    """What each module or folder inside a folder imports of the others in it, by their names."""
    inside = name_of(folder / "__init__.py") + "."
    arrows: dict[str, set[str]] = {}
    for path in (path for path in MODULES if folder in path.parents and path != folder / "__init__.py"):
        own = name_of(path).removeprefix(inside).split(".")[0]
        others = (name for name in imported_modules(path) if name.startswith(inside))
        arrows.setdefault(own, set()).update(name.removeprefix(inside).split(".")[0] for name in others)
    return {own: others - {own} for own, others in arrows.items()}


def floors(arrows: dict[str, set[str]]) -> list[list[str]]:
    """Names by floor, the lowest first; each imports from lower floors alone. Circles are left out."""
    built: list[list[str]] = []
    standing: set[str] = set()
    while floor := sorted(name for name in arrows.keys() - standing if arrows[name] <= standing):
        built.append(floor)
        standing.update(floor)
    return built


@pytest.mark.parametrize("folder", FOLDERS, ids=lambda folder: str(folder.relative_to(SOURCES)))
def test_imports_inside_a_folder_run_one_way(folder: Path) -> None:
    arrows = neighbours(folder)
    stacked = floors(arrows)
    assert sorted(name for floor in stacked for name in floor) == sorted(arrows), "a circle of imports"
    assert len(stacked) <= MOST_FLOORS


def test_a_circle_of_imports_has_no_floor() -> None:
    assert floors({"a": {"b"}, "b": {"a"}, "c": set(), "d": {"c"}}) == [["c"], ["d"]]


@pytest.mark.parametrize("folder", FOLDERS, ids=lambda folder: str(folder.relative_to(SOURCES)))
def test_no_folder_is_a_hall(folder: Path) -> None:
    assert len([path for path in folder.glob("*.py") if path.stem != "__init__"]) <= MOST_MODULES
    assert (folder / "__init__.py").is_file()


@pytest.mark.parametrize("package", PACKAGES)
def test_entry_points_are_of_their_own_package(package: str) -> None:
    text = (SOURCES / package / "setup.py").read_text()
    modules = re.findall(r'"[\w.]+ = ([\w.]+):\w+"', text)
    assert all(module in NAMES and module.split(".")[0] == package for module in modules)
    assert set(re.findall(r'"([\w.]+)": \[', text.partition("entry_points")[2])) == {"console_scripts"}


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

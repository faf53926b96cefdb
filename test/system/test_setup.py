"""Set-up refuses what it cannot build on, in one line that names what to do."""

import os
import shutil
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
needs_wheels = pytest.mark.skipif(Path("/opt/ros/jazzy").exists(), reason="ROS 2 Jazzy is installed here")


def refusal(checkout: Path, **environment: str) -> str:
    """The line with which tools/setup refuses; fails if it does not, or says more."""
    done = subprocess.run(
        [shutil.which("bash") or "/bin/bash", str(checkout / "tools" / "setup")],
        env={"HOME": os.environ.get("HOME", "/"), "PATH": os.environ["PATH"], **environment},
        capture_output=True,
        text=True,
        check=False,
        timeout=60,
    )
    assert done.returncode != 0
    assert done.stderr.count("\n") == 1, done.stderr
    return done.stderr


def folder_of_commands(folder: Path, *left_out: str) -> str:
    """A PATH with the commands that set-up uses, less some."""
    folder.mkdir()
    used = (
        "bash",
        "uname",
        "getconf",
        "cut",
        "sort",
        "head",
        "dirname",
        "c++",
        "make",
        "python3",
        "cat",
        "sha256sum",
    )
    for name in used:
        found = shutil.which(name)
        if found and name not in left_out:
            (folder / name).symlink_to(Path(found).resolve() if name != "python3" else found)
    return str(folder)


def test_path_with_a_space(tmp_path: Path) -> None:
    checkout = tmp_path / "my project"
    shutil.copytree(ROOT / "tools", checkout / "tools")
    assert "move the checkout" in refusal(checkout)


@needs_wheels
@pytest.mark.parametrize("missing", ["c++", "make"])
def test_missing_tool(missing: str, tmp_path: Path) -> None:
    line = refusal(ROOT, PATH=folder_of_commands(tmp_path / "bin", missing), KNEE_GAP_ROOT=str(tmp_path))
    assert f"{missing} is missing: sudo apt install build-essential" in line


@needs_wheels
def test_python_that_is_too_old(tmp_path: Path) -> None:
    old = tmp_path / "python3"
    old.write_text("#!/bin/sh\nexit 1\n")
    old.chmod(0o755)
    line = refusal(ROOT, KNEE_GAP_PYTHON=str(old), KNEE_GAP_ROOT=str(tmp_path))
    assert "is not Python 3.11, 3.12 or 3.13" in line


@needs_wheels
def test_no_python_at_all(tmp_path: Path) -> None:
    line = refusal(ROOT, PATH=folder_of_commands(tmp_path / "bin", "python3"), KNEE_GAP_ROOT=str(tmp_path))
    assert "sudo apt install python3" in line


@needs_wheels
def test_missing_python_header(tmp_path: Path) -> None:
    # A Python that says its headers are where none are.
    fake = tmp_path / "python3"
    fake.write_text(
        '#!/bin/sh\ncase "$2" in *include*) echo /nowhere ;; *print*version_info*) echo 3.12 ;; esac\n'
    )
    fake.chmod(0o755)
    line = refusal(ROOT, KNEE_GAP_PYTHON=str(fake), KNEE_GAP_ROOT=str(tmp_path))
    assert "Python.h of Python 3.12 is missing: sudo apt install python3-dev" in line


@pytest.mark.parametrize("tool", ["env", "run"])
def test_tools_without_a_build_say_what_to_do(tool: str, tmp_path: Path) -> None:
    done = subprocess.run(
        [str(ROOT / "tools" / tool), "knee_gap_perception", "tracking_node"],
        env={**os.environ, "KNEE_GAP_ROOT": str(tmp_path)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 1
    assert done.stderr.count("\n") == 1
    assert "run make setup" in done.stderr


def test_run_names_what_there_is() -> None:
    done = subprocess.run(
        [str(ROOT / "tools" / "run"), "knee_gap_perception", "no_such_node"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 1
    assert "it has: " in done.stderr
    assert "tracking_node" in done.stderr

"""The last lines of a test run: how many tests did not run, and why."""

import os
import subprocess
import sys
from pathlib import Path

TEST = Path(__file__).parents[1]
# Two reasons: one in two files, once for a whole file; and a test that runs.
FILES = {
    "test_a.py": """
import pytest

@pytest.mark.parametrize("k", range(3))
def test_skipped(k):
    pytest.skip("no microphone here")

def test_run():
    pass
""",
    "test_b.py": """
import pytest

pytest.skip("no microphone here", allow_module_level=True)
""",
    "test_c.py": """
import pytest

@pytest.mark.skipif(True, reason="the moon is full")
def test_skipped():
    pass
""",
}


def closing_lines(folder: Path, beside: bool) -> list[str]:
    """The lines below the heading, of a run of FILES in a checkout with and without recordings beside it."""
    checkout = folder / "checkout"
    support = checkout / "test" / "support"
    support.mkdir(parents=True)
    (support / "recordings.py").write_text((TEST / "support" / "recordings.py").read_text())
    (checkout / "test" / "conftest.py").write_text((TEST / "conftest.py").read_text())
    for name, text in FILES.items():
        (checkout / "test" / name).write_text(text)
    if beside:
        (folder / "shared" / "data").mkdir(parents=True)
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-c", os.devnull]
    command += ["--rootdir", str(checkout), "-o", f"pythonpath={support}", str(checkout / "test")]
    run = subprocess.run(command, capture_output=True, text=True, check=False, cwd=checkout)
    assert run.returncode == 0, run.stdout + run.stderr
    _, _, closing = run.stdout.partition("not tested")
    return [line for line in closing.splitlines()[1:] if line]


def test_each_reason_stands_once_with_its_count(tmp_path: Path) -> None:
    *lines, total = closing_lines(tmp_path, beside=True)
    assert lines[:3] == ["4 skipped: no microphone here", "1 skipped: the moon is full", "5 skipped in all"]
    assert "1 passed, 5 skipped" in total


def test_recordings_that_are_not_there_are_named(tmp_path: Path) -> None:
    lines = closing_lines(tmp_path, beside=False)
    assert "recordings of others: not at ../shared/data, so only input that the tests made" in lines

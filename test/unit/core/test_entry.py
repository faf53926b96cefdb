"""An executable that is stopped while it imports ends in silence."""

import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

SOURCES = str(Path(__file__).parents[3] / "src" / "knee_gap_core")
SETUPS = sorted(Path(SOURCES).parent.glob("*/setup.py"))
# A module that takes long to import, and swallows what is raised meanwhile as some foreign ones do.
SLOW = """
import sys, time
print("importing", flush=True)
for _ in range(600):
    try:
        time.sleep(0.05)
    except BaseException as error:
        print("swallowed", error, file=sys.stderr)
def main():
    return 5
"""
RUNS = """
import time
def main():
    print("importing", flush=True)
    time.sleep(30)
"""
QUICK = """
def main():
    return 5
"""


def started(tmp_path, text, *, node, mask=()):
    (tmp_path / "slow.py").write_text(text)
    program = (
        f"import sys; from knee_gap_core.node.entry import run_main; sys.exit(run_main('slow', node={node}))"
    )
    environment = {**os.environ, "PYTHONPATH": f"{SOURCES}:{tmp_path}"}
    before = signal.pthread_sigmask(signal.SIG_BLOCK, mask)
    try:
        return subprocess.Popen(
            [sys.executable, "-c", program],
            env=environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


@pytest.mark.parametrize("text", [SLOW, RUNS], ids=["importing", "running"])
@pytest.mark.parametrize(
    ("node", "number", "code"),
    [(True, signal.SIGINT, 0), (False, signal.SIGINT, 130)],
)
def test_an_interrupt_ends_it_without_a_word(tmp_path, text, node, number, code):
    process = started(tmp_path, text, node=node)
    assert process.stdout.readline() == "importing\n"
    process.send_signal(number)
    _, errors = process.communicate(timeout=20)
    assert errors == ""
    assert process.returncode == code


@pytest.mark.parametrize(("node", "code"), [(True, 0), (False, 143)])
def test_so_does_a_request_to_terminate_while_it_imports(tmp_path, node, code):
    process = started(tmp_path, SLOW, node=node)
    assert process.stdout.readline() == "importing\n"
    process.send_signal(signal.SIGTERM)
    _, errors = process.communicate(timeout=20)
    assert errors == ""
    assert process.returncode == code


@pytest.mark.parametrize("delay", [0.0, 0.01, 0.03, 0.1])
def test_a_signal_that_comes_before_python_is_up_waits_where_it_is_blocked(tmp_path, delay):
    process = started(tmp_path, SLOW, node=True, mask=(signal.SIGINT,))
    time.sleep(delay)
    process.send_signal(signal.SIGINT)
    _, errors = process.communicate(timeout=20)
    assert errors == ""
    assert process.returncode == 0


def test_otherwise_it_returns_what_main_returns(tmp_path):
    process = started(tmp_path, QUICK, node=True)
    process.communicate(timeout=20)
    assert process.returncode == 5


def test_an_import_that_fails_is_still_loud(tmp_path):
    process = started(tmp_path, "raise ImportError('no such thing')", node=True)
    _, errors = process.communicate(timeout=20)
    assert "no such thing" in errors
    assert process.returncode == 1


@pytest.mark.parametrize("setup", SETUPS, ids=lambda path: path.parent.name)
def test_every_executable_starts_this_way(setup):
    # Otherwise tools/run and the launch files, which block signals until an entry point lets them through,
    # would start something that no Ctrl-C ends.
    package = setup.parent.name
    text = re.findall(r'"console_scripts": \[(.*?)\]', setup.read_text(), re.DOTALL)
    scripts = re.findall(r'"(\w+) = ([\w.]+):(\w+)"', text[0])
    assert len(scripts) == text[0].count('"') / 2
    entries = setup.parent / package / "entry_points.py"
    for name, module, function in scripts:
        assert (module, function) == (f"{package}.entry_points", name)
        module = re.findall(rf'^{name} = entry\("([\w.]+)"', entries.read_text(), re.MULTILINE)
        assert len(module) == 1
        source = SETUPS[0].parent.parent / package / Path(*module[0].split(".")).with_suffix(".py")
        assert "\ndef main(" in source.read_text()

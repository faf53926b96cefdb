"""The suite is set up, built and run on another Python of this machine: 3.13, with numpy 2."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
# The oldest and the newest: setting up a third one takes four minutes, of which a test run has not enough.
VERSIONS = [(3, 11), (3, 13)]


def interpreter(version: tuple[int, int]) -> str | None:
    """Path of a Python of this version that runs and has its headers, or None."""
    name = f"python{version[0]}.{version[1]}"
    managed = Path(os.environ.get("PYENV_ROOT", Path.home() / ".pyenv")) / "versions"
    candidates = [
        shutil.which(name),
        *map(str, sorted(managed.glob(f"{version[0]}.{version[1]}*/bin/{name}"))),
    ]
    probe = (
        "import ensurepip, os, sys, sysconfig; header = sysconfig.get_path('include') + '/Python.h'; "
        f"sys.exit(sys.version_info[:2] != {version} or not os.path.exists(header))"
    )
    for candidate in candidates:
        if (
            candidate
            and subprocess.run([candidate, "-c", probe], capture_output=True, check=False).returncode == 0
        ):
            return candidate
    return None


@pytest.mark.system
@pytest.mark.timeout(900)
@pytest.mark.parametrize("version", [v for v in VERSIONS if v != sys.version_info[:2]], ids=str)
def test_sets_up_builds_and_measures(version: tuple[int, int], tmp_path: Path) -> None:
    python = interpreter(version)
    if python is None:
        pytest.skip(f"no Python {version[0]}.{version[1]} with headers here")
    if Path("/opt/ros/jazzy").exists():
        pytest.skip("installed ROS 2 Jazzy runs on the system's Python only")
    environment = {
        # Nothing of the workspace that runs this test may leak into the other one.
        **{key: os.environ[key] for key in ("HOME", "PATH", "LANG") if key in os.environ},
        **{
            key: value
            for key, value in os.environ.items()
            if key.startswith(("PIP_", "UV_", "SSL_", "REQUESTS_"))
        },
        "KNEE_GAP_PYTHON": python,
        "KNEE_GAP_ROOT": str(tmp_path),
        "ROS_DOMAIN_ID": str(90 + version[1] % 10),
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
    }
    environment["PATH"] = ":".join(p for p in environment["PATH"].split(":") if not p.startswith(str(ROOT)))

    def run(*command: str) -> str:
        done = subprocess.run(
            command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False, timeout=600
        )
        assert done.returncode == 0, f"{command}\n{done.stdout[-2000:]}\n{done.stderr[-2000:]}"
        return done.stdout

    run("tools/setup")
    reported = run(
        "tools/env", "python", "-c", "import sys, numpy; print(*sys.version_info[:2], numpy.__version__)"
    )
    assert reported.split()[:2] == [str(version[0]), str(version[1])]
    assert reported.split()[2].startswith("2." if version >= (3, 13) else "1.26")
    # The whole suite at once: messages, nodes, DDS, compiled kernels, bags.
    demo = run("tools/run", "knee_gap_bringup", "demo", "--rate", "0.5", "--out", str(tmp_path / "demo"))
    last = demo.splitlines()[-1]
    assert last.startswith("demo: ")
    assert "truth inside [min, max] 100.0 %" in last

"""What is started together: refusals before anything is, failures with their code, nodes that come back."""

import os
import re
import shutil
import signal
import subprocess
import time
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("rclpy")

from live import Client
from sample_bag import SAMPLE

from knee_gap_bringup.launching.processes import executable
from knee_gap_msgs.msg import GapEdges, GapEstimate

ROOT = Path(__file__).parents[2]
DOMAIN = 112
ENVIRONMENT = {**os.environ, "ROS_DOMAIN_ID": str(DOMAIN), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
LIVE = executable("knee_gap_bringup", "live")
REPLAY = executable("knee_gap_bringup", "replay")
PLAY = executable("knee_gap_replay", "play")
EXECUTABLES = {
    "segmentation_node": "knee_gap_perception",
    "tracking_node": "knee_gap_perception",
    "uncertainty_node": "knee_gap_uncertainty",
    "leg_controller_node": "knee_gap_bringup",
    "play": "knee_gap_replay",
    "record": "knee_gap_replay",
}
COMMANDS = {
    "process": "knee_gap_replay",
    "check": "knee_gap_replay",
    "calibrate": "knee_gap_perception",
    "make_bag": "knee_gap_simulation",
    "demo": "knee_gap_bringup",
    "replay": "knee_gap_bringup",
}
INPUTS = [f"/knee_gap/{topic}" for topic in ("image_raw/compressed", "camera_info", "scope_body/pose")]

pytestmark = [pytest.mark.system, pytest.mark.timeout(280)]


def run(*command: str, timeout: float = 120.0) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        command, env=ENVIRONMENT, capture_output=True, text=True, check=False, timeout=timeout
    )


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["nowhere"], "bag: nowhere does not exist"),
        ([str(SAMPLE), "--out", str(ROOT / "bags")], "exists already; choose another name or remove it"),
        ([str(SAMPLE), "--params", "no.yaml"], "params: no.yaml does not exist"),
        ([str(SAMPLE), "--rate", "nan"], "rate: must be a finite number"),
    ],
)
def test_a_replay_that_cannot_be_is_refused_in_one_line_before_anything_starts(
    arguments: list[str], words: str
) -> None:
    done = run(REPLAY, *arguments)
    assert done.returncode == 1
    assert done.stdout == ""
    assert done.stderr.count("\n") == 1
    assert words in done.stderr


def test_live_without_its_parameters_is_refused_in_one_line() -> None:
    done = run(LIVE, "--params", "no.yaml")
    assert (done.returncode, done.stdout) == (1, "")
    assert done.stderr == "live: params: no.yaml does not exist\n"


def test_a_node_that_refuses_its_settings_ends_all_with_its_code(tmp_path: Path) -> None:
    params = tmp_path / "params.yaml"
    params.write_text("/**/uncertainty_node:\n  ros__parameters:\n    interval: best\n")
    done = run(LIVE, "--params", str(params))
    assert done.returncode == 2
    assert "ended with exit code 2; stopping all" in done.stdout
    assert "Traceback" not in done.stdout + done.stderr


def test_a_player_that_fails_ends_the_replay_with_its_code(tmp_path: Path) -> None:
    bag = tmp_path / "bag.mcap"
    bag.write_bytes(b"not a bag, and yet not empty")
    done = run(REPLAY, str(bag))
    assert done.returncode == 1
    assert "play ended with exit code 1; stopping all" in done.stdout


def catches(pid: int, number: int) -> bool:
    """Whether a process has a handler of its own for a signal."""
    status = Path(f"/proc/{pid}/status").read_text()
    return bool(int(re.findall(r"SigCgt:\s*(\w+)", status)[0], 16) >> (number - 1) & 1)


def is_python(pid: int) -> bool:
    """Whether a process has become Python, however young."""
    return b"python" in Path(f"/proc/{pid}/cmdline").read_bytes().partition(b"\0")[0]


@pytest.mark.parametrize("name", [*EXECUTABLES, *COMMANDS])
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_while_an_executable_imports_prints_nothing(name: str, number: int) -> None:
    node = name in EXECUTABLES
    command = executable((EXECUTABLES | COMMANDS)[name], name)
    process = subprocess.Popen(
        [command], env=ENVIRONMENT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    # Python itself does not handle SIGTERM: the entry point does, from its first line on.
    while process.poll() is None and not catches(process.pid, signal.SIGTERM):
        time.sleep(0.001)
    process.send_signal(number)
    output, errors = process.communicate(timeout=60)
    assert (output, errors) == ("", "")
    assert process.returncode == (0 if node else 128 + number)


@pytest.mark.parametrize("delay", [0.0, 0.05, 0.2, 0.6])
def test_started_by_tools_run_it_does_so_before_python_is_up_as_well(delay: float) -> None:
    command = [str(ROOT / "tools" / "run"), "knee_gap_perception", "segmentation_node"]
    process = subprocess.Popen(
        command, env=ENVIRONMENT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    # bash itself, which sets the environment, ends by the signal without a word.
    while process.poll() is None and not is_python(process.pid):
        time.sleep(0.001)
    time.sleep(delay)
    process.send_signal(signal.SIGINT)
    output, errors = process.communicate(timeout=60)
    assert "Traceback" not in output + errors
    assert process.returncode == 0


class Live:
    """The command `live` as a process, and what it prints."""

    def __init__(self, log: Path, *arguments: str) -> None:
        self._log = log
        with log.open("wb") as out:
            self.process = subprocess.Popen(
                [LIVE, *arguments], env=ENVIRONMENT, stdout=out, stderr=subprocess.STDOUT
            )

    @property
    def text(self) -> str:
        """All that it and its nodes wrote."""
        return self._log.read_text(errors="replace")

    def pid(self, name: str) -> int:
        """Process id of the latest start of a node."""
        return int(re.findall(rf"live: {name} started, process (\d+)", self.text)[-1])

    def wait(self, words: str, count: int, seconds: float = 90.0) -> None:
        """Wait until it wrote some words so often."""
        end = time.monotonic() + seconds
        while self.text.count(words) < count:
            assert self.process.poll() is None, self.text
            assert time.monotonic() < end, self.text
            time.sleep(0.05)

    def stop(self) -> int:
        """Interrupt it, as Ctrl-C does; return its exit code."""
        self.process.send_signal(signal.SIGINT)
        return self.process.wait(60)


@pytest.fixture
def params(tmp_path: Path) -> str:
    """Settings for the sample bag, played by its own clock."""
    beside = (SAMPLE / "scope.yaml").read_text()
    path = tmp_path / "params.yaml"
    general = "/**:\n  ros__parameters:\n    use_sim_time: true\n"
    transport = "/**/segmentation_node:\n  ros__parameters:\n    image_transport: compressed\n"
    path.write_text(general + transport + beside)
    return str(path)


def valid(messages: list[Any]) -> list[Any]:
    return [message for message in messages if message.status == 1]


def test_a_node_that_is_killed_comes_back_and_goes_on_with_new_tracks(params: str, tmp_path: Path) -> None:
    live = Live(tmp_path / "live.log", "--params", params, "--respawn-delay", "0.5")
    player = None
    try:
        live.wait("ready", 3)
        with Client(DOMAIN) as client:
            client.listen(GapEdges, "gap_edges")
            client.listen(GapEstimate, "gap")
            edges, gaps = client.received["gap_edges"], client.received["gap"]

            def play() -> subprocess.Popen[bytes]:
                command = [PLAY, str(SAMPLE), "--clock", "--rate", "0.5", "--topics", *INPUTS]
                return subprocess.Popen([*command, "--wait-for", *INPUTS], env=ENVIRONMENT)

            player = play()
            client.spin_until(lambda: len(valid(gaps)) > 20, timeout=60.0)
            before = {message.track_id for message in edges if message.track_id}
            assert before

            os.kill(live.pid("segmentation_node"), signal.SIGKILL)
            live.wait("segmentation_node was ended by signal 9; restart in 0.5 s", 1)
            # Nothing that was measured with the node that is dead is repeated as new.
            client.spin(0.5)
            del gaps[:], edges[:]
            live.wait("ready", 4)
            player.wait(60)
            assert not valid(gaps) or not {m.track_id for m in valid(gaps)} & before
            del gaps[:], edges[:]
            player = play()
            client.spin_until(lambda: len(valid(gaps)) > 20, timeout=60.0)
            after = {message.track_id for message in edges if message.track_id}
            assert after
            assert min(after) > max(before)
            assert {message.track_id for message in valid(gaps)} <= after

            os.kill(live.pid("uncertainty_node"), signal.SIGKILL)
            live.wait("uncertainty_node was ended by signal 9; restart in 0.5 s", 1)
            live.wait("ready", 5)
            player.wait(60)
            client.spin(0.3)
            del gaps[:]
            player = play()
            client.spin_until(lambda: len(valid(gaps)) > 20, timeout=60.0)
            # The two others did not notice.
            assert live.text.count("live: segmentation_node started") == 2
            assert live.text.count("live: tracking_node started") == 1
        assert live.stop() == 0
        assert "Traceback" not in live.text
    finally:
        for process in (player, live.process):
            if process is not None and process.poll() is None:
                process.send_signal(signal.SIGINT)
                process.wait(60)


@pytest.mark.skipif(shutil.which("ros2") is None, reason="ros2 launch is not installed here")
@pytest.mark.parametrize(
    ("arguments", "code", "words"),
    [
        (["replay.launch.py", "bag:=nowhere"], 1, "bag: nowhere does not exist"),
        (["replay.launch.py", f"bag:={SAMPLE}", f"out:={ROOT / 'bags'}"], 1, "exists already"),
        (["replay.launch.py", f"bag:={ROOT / 'README.md'}"], 1, "play ended with exit code 1; stopping all"),
        (["live.launch.py"], 2, "tracking_node ended with exit code 2; stopping all"),
    ],
)
def test_ros2_launch_ends_with_the_code_of_what_failed(arguments: list[str], code: int, words: str) -> None:
    done = run("ros2", "launch", "knee_gap_bringup", *arguments)
    assert done.returncode == code
    assert words in done.stdout + done.stderr
    assert "Traceback" not in done.stdout + done.stderr


def test_without_respawn_the_end_of_a_node_ends_all_with_its_code(params: str, tmp_path: Path) -> None:
    live = Live(tmp_path / "live.log", "--params", params, "--no-respawn")
    live.wait("ready", 3)
    others = [live.pid(name) for name in ("segmentation_node", "uncertainty_node")]
    os.kill(live.pid("tracking_node"), signal.SIGKILL)
    assert live.process.wait(60) == 128 + signal.SIGKILL
    assert "tracking_node was ended by signal 9; stopping all" in live.text
    assert not any(Path(f"/proc/{pid}").exists() for pid in others)


def test_an_interrupt_while_the_nodes_import_prints_no_traceback(params: str, tmp_path: Path) -> None:
    for delay in (0.0, 0.1, 0.4, 1.0):
        live = Live(tmp_path / f"live_{delay}.log", "--params", params)
        live.wait("started, process", 3)
        time.sleep(delay)
        assert live.stop() == 0
        assert "Traceback" not in live.text
        assert "KeyboardInterrupt" not in live.text


def test_a_node_that_dies_ends_the_demo_at_once_with_its_code(tmp_path: Path) -> None:
    out = tmp_path / "out"
    command = [executable("knee_gap_bringup", "demo"), "--bag", str(SAMPLE), "--out", str(out)]
    process = subprocess.Popen(
        [*command, "--rate", "0.5"],
        env=ENVIRONMENT,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert process.stdout is not None
    assert "nodes ready" in process.stdout.readline()
    children = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()
    tracking = next(
        int(pid) for pid in children if b"tracking_node" in Path(f"/proc/{pid}/cmdline").read_bytes()
    )
    os.kill(tracking, signal.SIGKILL)
    killed = time.monotonic()
    _, errors = process.communicate(timeout=60)
    assert process.returncode == 128 + signal.SIGKILL
    assert time.monotonic() - killed < 15
    assert "tracking_node ended with exit code -9" in errors
    assert "Traceback" not in errors

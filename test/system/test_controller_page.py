"""The subscribers that docs/controller.md prints, as processes: they pass what fits, and hold on all else."""

import os
import re
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("rclpy")

from ament_index_python.packages import PackageNotFoundError, get_package_prefix
from live import Client
from rclpy.duration import Duration
from rclpy.qos import QoSProfile

from knee_gap_msgs.msg import GapEstimate

DOMAIN = 143
PAGE = Path(__file__).parents[2] / "docs" / "controller.md"
GAP_QOS = QoSProfile(depth=64, deadline=Duration(nanoseconds=100_000_000))

CMAKE = """
cmake_minimum_required(VERSION 3.16)
project(my_leg)
find_package(rclcpp REQUIRED)
find_package(knee_gap_msgs REQUIRED)
add_executable(my_leg my_leg.cpp)
target_compile_features(my_leg PRIVATE cxx_std_17)
target_link_libraries(my_leg rclcpp::rclcpp ${knee_gap_msgs_TARGETS})
"""

pytestmark = [pytest.mark.system, pytest.mark.timeout(120)]


class Subscriber:
    """The printed subscriber, what it has said, and the gap that the test publishes."""

    def __init__(self, client: Client, said: Path) -> None:
        self._client, self._said = client, said
        client.offer(GapEstimate, "gap", GAP_QOS)
        client.wait_matched()

    @property
    def lines(self) -> list[str]:
        """The lines printed so far."""
        return self._said.read_text().splitlines()

    def answer(self, **changes: Any) -> str:
        """Publish an estimate that fits, with changes; return the line that it gets."""
        one = GapEstimate(
            status=GapEstimate.STATUS_VALID, track_id=1, gap_min=0.0041, gap=0.005, gap_max=0.006
        )
        age = changes.pop("age", 0.0)
        now = self._client.node.get_clock().now() - Duration(nanoseconds=round(age * 1e9))
        one.header.stamp = now.to_msg()
        for name, value in changes.items():
            setattr(one, name, value)
        before = len(self._answers())
        self._client.publish("gap", one)
        self.wait(lambda: len(self._answers()) > before)
        return self._answers()[-1]

    def wait(self, condition: Callable[[], bool]) -> None:
        """Wait for a condition; fails after ten seconds."""
        end = time.monotonic() + 10.0
        while not condition():
            assert time.monotonic() < end, self.lines
            time.sleep(0.01)

    def _answers(self) -> list[str]:
        return [line for line in self.lines if line != "hold: silence"]


def written_in_python(folder: Path) -> list[str]:
    """The command of the subscriber that the page prints in Python."""
    program = folder / "my_leg.py"
    program.write_text(printed("python"))
    return [sys.executable, str(program)]


def written_in_cpp(folder: Path) -> list[str]:
    """The command of the subscriber that the page prints in C++; skips where it cannot be built."""
    try:
        get_package_prefix("rclcpp")
    except PackageNotFoundError:
        pytest.skip("rclcpp is not installed: the subscriber in C++ is not built")
    (folder / "my_leg.cpp").write_text(printed("cpp"))
    (folder / "CMakeLists.txt").write_text(CMAKE)
    for command in (["cmake", "-S", ".", "-B", "build"], ["cmake", "--build", "build"]):
        done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stdout + done.stderr
    return [str(folder / "build" / "my_leg")]


def printed(language: str) -> str:
    """The one program in a language on the page."""
    (text,) = re.findall(rf"```{language}\n(.*?)```", PAGE.read_text(), re.DOTALL)
    return str(text)


@pytest.fixture(scope="module", params=[written_in_python, written_in_cpp], ids=["python", "c++"])
def subscriber(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Subscriber]:
    folder = tmp_path_factory.mktemp("page")
    command, said = request.param(folder), folder / "said"
    environment = {
        **os.environ,
        "ROS_DOMAIN_ID": str(DOMAIN),
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
    }
    with (
        said.open("w") as output,
        subprocess.Popen(command, stdout=output, env=environment) as process,
    ):
        try:
            with Client(DOMAIN) as client:
                yield Subscriber(client, said)
        finally:
            process.kill()


def test_what_fits_may_pass(subscriber: Subscriber) -> None:
    assert subscriber.answer() == "pass"
    assert subscriber.answer(gap_min=0.004) == "pass"


@pytest.mark.parametrize(
    "changes",
    [
        {"gap_min": 0.0039},
        {"gap_min": float("nan")},
        {"age": 0.7},
        {"age": -0.2},
        {"interval": GapEstimate.INTERVAL_PAPER},
        *({"status": status} for status in (0, 2, 3, 4, 5, 6, 7)),
    ],
    ids=str,
)
def test_all_else_holds(subscriber: Subscriber, changes: dict[str, Any]) -> None:
    assert subscriber.answer(**changes, reason="as given") == "hold: as given"


def test_silence_holds(subscriber: Subscriber) -> None:
    subscriber.answer()
    begin = time.monotonic()
    before = len(subscriber.lines)
    subscriber.wait(lambda: "hold: silence" in subscriber.lines[before:])
    assert time.monotonic() - begin < 1.0

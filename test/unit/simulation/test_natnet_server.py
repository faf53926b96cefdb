import os
import socket
import threading
import time
from pathlib import Path

import numpy as np
import pytest
from ports import free_port

from knee_gap_core.values.poses import BodyPose, LensPose
from knee_gap_perception.errors import PerceptionError
from knee_gap_perception.scope_pose.pose_validity import RefusalReason
from knee_gap_perception.scope_pose.scope_tracker import ScopeTracker
from knee_gap_perception.scope_pose.tracking_parameters import TrackingParameters
from knee_gap_perception.trackers.body_source import choose_body
from knee_gap_perception.trackers.natnet.client import NatNetClient, NatNetParameters
from knee_gap_perception.trackers.natnet.packets import NatNetVersion, decode_packet
from knee_gap_simulation.errors import SimulationError
from knee_gap_simulation.natnet import packets
from knee_gap_simulation.natnet.command import main
from knee_gap_simulation.natnet.packets import VERSIONS
from knee_gap_simulation.natnet.scene import CLOCK_SECONDS, Faults, TrackedScene
from knee_gap_simulation.natnet.server import NatNetServer, ServerSettings


class Served:
    """A server that runs in a thread while the test talks to it."""

    def __init__(self, *, names=("scope", "tibia", "clock"), faults=None, **settings):
        self.port = free_port()
        self.scene = TrackedScene(names, faults or Faults())
        self.server = NatNetServer(self.scene, ServerSettings(command_port=self.port, **settings))
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run)

    def _run(self):
        with self.server:
            while not self._stop.is_set():
                self.server.step(0.01)

    def __enter__(self):
        self._thread.start()
        return self

    def __exit__(self, *_):
        self._stop.set()
        self._thread.join()


def collect(client, seconds):
    frames, end = [], time.monotonic() + seconds
    while time.monotonic() < end:
        frames += client.poll(0.02)
    return frames


def stamp_errors(frames):
    """How far each stamp is from the time that the clock body shows [s]."""
    shown = np.array([choose_body(frame, "clock")[0].position[0] for frame in frames]) * CLOCK_SECONDS
    stamps = np.array([frame.stamp_ns % (CLOCK_SECONDS * 1e9) / 1e9 for frame in frames])
    return (stamps - shown + CLOCK_SECONDS / 2) % CLOCK_SECONDS - CLOCK_SECONDS / 2


@pytest.mark.parametrize("version", VERSIONS)
def test_frames_come_by_unicast_with_the_time_of_exposure(version):
    with (
        Served(version=version, rate=120.0, latency=0.02) as served,
        NatNetClient(NatNetParameters(command_port=served.port)) as client,
    ):
        frames = collect(client, 1.5)
        status = client.status()
    assert len(frames) > 100
    assert status.ok, status.words
    # Half of a processor's time slice is lost to other tests now and then; the latency of 20 ms would show.
    assert np.median(np.abs(stamp_errors(frames))) < 0.001


def test_frames_come_by_the_multicast_group_that_was_set():
    port = free_port()
    settings = {"multicast_address": "239.255.42.88", "data_port": port}
    with (
        Served(rate=120.0, **settings) as served,
        NatNetClient(NatNetParameters(command_port=served.port, **settings)) as client,
    ):
        frames = collect(client, 1.5)
        if not frames and "cannot be joined" in client.status().words:
            pytest.skip("no multicast on the loopback of this machine")
    assert len(frames) > 100


def test_no_group_is_joined_because_the_server_states_it():
    number = 1 + os.getpid() % 250
    with (
        Served(multicast_address=f"239.255.77.{number}", data_port=free_port(), rate=120.0) as served,
        NatNetClient(NatNetParameters(command_port=served.port, data_port=free_port())) as client,
    ):
        frames = collect(client, 1.5)
        words = client.status().words
        joined = Path("/proc/net/igmp").read_text() if Path("/proc/net/igmp").exists() else ""
    assert not frames
    assert f"Motive sends to 239.255.77.{number}:" in words
    assert "set multicast_address and data_port" in words
    # As the kernel writes the group.
    assert f"{number:02X}4DFFEF" not in joined


def test_forged_packets_from_another_port_change_nothing():
    swapped = packets.Models(bodies=[packets.BodyModel(1, "tibia"), packets.BodyModel(2, "scope")])
    forged = [
        packets.model_definitions((4, 1), swapped),
        packets.server_info((4, 1), frequency=1000, data_port=9, multicast_address="239.1.2.3"),
        packets.echo_response(bytes(8), 12345),
        packets.packet(packets.UNRECOGNIZED_REQUEST, b""),
    ]
    with (
        Served(rate=120.0) as served,
        NatNetClient(NatNetParameters(command_port=served.port)) as client,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as forger,
    ):
        frames, sent = collect(client, 1.0), 0
        for _ in range(20):
            for data in forged:
                client.session._models_wanted = True
                forger.sendto(data, client._command.getsockname())
                sent += 1
            frames += collect(client, 0.1)
        status = client.status()
    assert status.ok, status.words
    assert status.values["packets from other ports of the server"] == sent
    assert len(frames) > 200
    assert {tuple(sorted(frame.names.items())) for frame in frames} == {
        ((1, "scope"), (2, "tibia"), (3, "clock"))
    }
    assert np.median(np.abs(stamp_errors(frames))) < 0.001


def test_poses_are_those_of_the_scene_turned_to_z_up():
    with Served(rate=120.0) as served, NatNetClient(NatNetParameters(command_port=served.port)) as client:
        frames = collect(client, 1.0)
    frame = frames[-1]
    position, _ = served.scene.true_pose(1, frame.stamp_ns / 1e9)
    x, y, z = position
    np.testing.assert_allclose(choose_body(frame, "scope")[0].position, [x, -z, y], atol=3e-4)


def test_no_hidden_or_swapped_pose_is_published():
    """Faults in every phase to each other, through the packets and the checks, without the sockets."""
    faults = Faults(
        lost_share=0.01,
        invalid_share=0.02,
        occlusion_period=0.7,
        occlusion_length=0.2,
        swap_period=1.13,
        swap_length=0.3,
    )
    scene, tracker, worst = (
        TrackedScene(("scope", "tibia", "clock"), faults, seed=3),
        ScopeTracker(TrackingParameters(body_to_shaft_translation=(0.0, 0.0, 0.0))),
        0.0,
    )
    for number in range(150 * 120):
        time_s = 1000.0 + number / 120.0
        content = packets.FrameContent(number=number, bodies=scene.bodies(time_s))
        if scene.frame_is_lost() or number / 120.0 % 9.7 > 8.0:
            continue
        frame = decode_packet(packets.frame((4, 1), content), NatNetVersion(4, 1))
        body, *others = (
            BodyPose(
                stamp_ns=round(time_s * 1e9),
                position=np.array(item.position),
                quaternion_xyzw=np.array(item.quaternion_xyzw),
                name=scene.names[item.id - 1],
                tracking_valid=item.tracking_valid,
            )
            for item in frame.bodies
        )
        if isinstance(tracker.update(body, others), LensPose):
            worst = max(worst, float(np.linalg.norm(body.position - scene.true_pose(1, time_s)[0])))
    assert tracker.accepted_count > 150 * 120 * 0.35
    assert worst < 2e-4
    counts = tracker.validity.counts
    assert counts[RefusalReason.NOT_TRACKED] > 1000
    assert counts[RefusalReason.SWAPPED] > 1000


def test_a_restart_is_survived_with_right_stamps():
    with (
        Served(rate=120.0, restart_period=1.5, down_time=2.5) as served,
        NatNetClient(NatNetParameters(command_port=served.port)) as client,
    ):
        before = collect(client, 1.4)
        after = collect(client, 5.0)
    assert served.server.counts.restarts >= 1
    assert len(before) > 80
    gap = np.diff([frame.stamp_ns for frame in after]).max() / 1e9
    assert 2.4 < gap < 5.0
    assert (np.diff([frame.stamp_ns for frame in before + after]) > 0).all()
    assert np.median(np.abs(stamp_errors(after))) < 0.001


def test_without_a_server_the_client_waits_and_says_why():
    with NatNetClient(NatNetParameters(command_port=free_port())) as client:
        assert collect(client, 0.5) == []
        status = client.status()
    assert not status.ok
    assert "no answer from 127.0.0.1" in status.words


@pytest.mark.parametrize(
    ("values", "message"),
    [
        (
            {"server_address": "no.such.host.invalid"},
            "server_address 'no.such.host.invalid' cannot be resolved",
        ),
        ({"local_address": "192.0.2.1"}, "no interface 192.0.2.1"),
        ({"transmission": "broadcast"}, "must be one of auto, unicast, multicast"),
        ({"command_port": 0}, r"command_port must lie in \[1, 65535\], not 0"),
    ],
)
def test_settings_of_the_client(values, message):
    with pytest.raises(PerceptionError, match=message):
        NatNetClient(NatNetParameters(**values))


def test_the_server_binds_to_the_loopback_only():
    with Served() as served:
        assert served.server._command.getsockname()[0] == "127.0.0.1"


def test_a_port_that_is_taken_is_one_line(capsys):
    with Served() as served, pytest.raises(SystemExit) as ended:
        main(["--command-port", str(served.port)])
    assert ended.value.code != 0
    error = capsys.readouterr().err.strip()
    assert "cannot be used" in error
    assert "\n" not in error


@pytest.mark.parametrize(
    "arguments", [["--version", "2.7"], ["--version", "x"], ["--lose", "2"], ["--rate", "0"]]
)
def test_mistakes_on_the_command_line_are_one_line(arguments, capsys):
    with pytest.raises(SystemExit) as ended:
        main(arguments)
    assert ended.value.code != 0
    assert len(capsys.readouterr().err.strip().splitlines()) == 1


def test_bodies_need_names_that_differ():
    with pytest.raises(SimulationError, match="must have different names"):
        TrackedScene(("scope", "scope"))

"""Frames and a trajectory of others, which do not belong together, through the live nodes: no crash."""

import time
from itertools import islice
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

pytest.importorskip("rclpy")

from endoscope_images import RIGID_ENDOSCOPE, EndoscopeFrames, rigid_endoscope
from motive_takes import THREE_BODIES, three_body_take
from recordings import origins

from knee_gap_bringup.demo import play_through_nodes
from knee_gap_core.bag.bag import BagReader, BagWriter
from knee_gap_core.bag.message_types import blank
from knee_gap_core.values.stamps import set_stamp
from knee_gap_msgs.msg import GapEdges, GapEstimate
from knee_gap_perception.trackers.motive_csv import read_take
from knee_gap_replay.report.comparison import EDGES, GAP
from knee_gap_simulation.recordings.recording import BODY_POSE, CAMERA_INFO, IMAGE, PARAMETERS_FILE

ROOT = Path(__file__).parents[2]
OUT = ROOT / "out" / "real"
START_NS = 1_700_000_000_000_000_000
IMAGE_PERIOD_NS = 40_000_000
SCOPE_POSE = "/knee_gap/scope_pose"
MAX_POSE_AGE_NS = 25_000_000

pytestmark = [
    pytest.mark.system,
    pytest.mark.timeout(240),
]


def stamped(message: Any, stamp_ns: int, frame_id: str) -> Any:
    set_stamp(message.header, stamp_ns)
    message.header.frame_id = frame_id
    return message


def write_bag(path: Path, frames: EndoscopeFrames, take_path: Path) -> int:
    """Frames to and fro at 25 Hz for 4 s, poses at the take's own times; returns the number of images."""
    pictures = [file.read_bytes() for file in frames.files]
    order = (list(range(len(pictures))) + list(range(len(pictures) - 2, 0, -1))) * 4
    fx, fy, cx, cy = frames.pinhole
    size = cv2.imdecode(np.frombuffer(pictures[0], np.uint8), cv2.IMREAD_COLOR).shape
    records: list[tuple[int, str, Any]] = []
    for k, index in enumerate(order[:100]):
        stamp = START_NS + k * IMAGE_PERIOD_NS
        info = stamped(blank("sensor_msgs/msg/CameraInfo"), stamp, "arthroscope_optical")
        info.height, info.width, info.distortion_model = size[0], size[1], "plumb_bob"
        info.d, info.k = np.zeros(5), np.array([fx, 0, cx, 0, fy, cy, 0, 0, 1.0])
        image = stamped(blank("sensor_msgs/msg/CompressedImage"), stamp, "arthroscope_optical")
        image.format, image.data = "jpeg", np.frombuffer(pictures[index], np.uint8)
        records += [(stamp + 1, CAMERA_INFO, info), (stamp + 2, IMAGE, image)]
    take = read_take(take_path)
    name = take.bodies[0].name
    # The take begins in the middle of a longer capture.
    for frame in islice(take.frames(START_NS - round(float(take.time[0]) * 1e9)), 405):
        body = next((body for body in frame.bodies if body.name == name), None)
        if body is None:
            continue
        pose = stamped(blank("geometry_msgs/msg/PoseStamped"), body.stamp_ns, "world")
        point, turn = pose.pose.position, pose.pose.orientation
        point.x, point.y, point.z = (float(v) for v in body.position)
        turn.x, turn.y, turn.z, turn.w = (float(v) for v in body.quaternion_xyzw)
        records.append((body.stamp_ns, BODY_POSE, pose))
    with BagWriter(path) as bag:
        bag.add_topic(CAMERA_INFO, "sensor_msgs/msg/CameraInfo", "sensor")
        bag.add_topic(IMAGE, "sensor_msgs/msg/CompressedImage", "sensor")
        bag.add_topic(BODY_POSE, "geometry_msgs/msg/PoseStamped", "sensor")
        for time_ns, topic, message in sorted(records, key=lambda record: record[0]):
            bag.write(topic, message, time_ns)
    (path / PARAMETERS_FILE).write_text(
        "/**/tracking_node:\n  ros__parameters:\n    body_to_shaft_translation: [0.0, 0.0, 0.2]\n"
    )
    return 100


def stamp_of(message: Any) -> int:
    stamp = message.header.stamp
    return int(stamp.sec) * 10**9 + int(stamp.nanosec)


def draw_contact_sheet(bag: Path, edges: dict[int, Any], path: Path) -> None:
    """Every sixth image with the points and the status that were published for it."""
    tiles: list[Any] = []
    with BagReader(bag) as reader:
        for k, entry in enumerate(reader.messages([IMAGE])):
            message = reader.deserialize(entry)
            if k % 6 or len(tiles) == 16:
                continue
            picture = cv2.imdecode(np.asarray(message.data), cv2.IMREAD_COLOR)
            reported = edges.get(stamp_of(message))
            status = "no answer" if reported is None else STATUS_NAMES[reported.status]
            if reported is not None and reported.status == GapEdges.STATUS_VALID:
                for pixel, colour in ((reported.pixel_0, (80, 220, 80)), (reported.pixel_1, (80, 160, 255))):
                    centre = tuple(round(v) for v in pixel)
                    cv2.circle(picture, centre, 28, colour, 9, cv2.LINE_AA)
                status += f", track {reported.track_id}"
            small = cv2.resize(picture, (480, 270), interpolation=cv2.INTER_AREA)
            cv2.putText(
                small, status, (8, 260), cv2.FONT_HERSHEY_SIMPLEX, 0.6, (255, 255, 255), 2, cv2.LINE_AA
            )
            tiles.append(small)
    rows = [np.hstack(tiles[k : k + 4]) for k in range(0, 16, 4)]
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), np.vstack(rows))


STATUS_NAMES = {
    getattr(GapEdges, name): name.removeprefix("STATUS_")
    for name in dir(GapEdges)
    if name.startswith("STATUS_")
}


@pytest.mark.parametrize("origin", origins(RIGID_ENDOSCOPE, THREE_BODIES))
def test_real_frames_and_poses(origin: str, tmp_path: Path) -> None:
    bag, frames = tmp_path / "real", tmp_path / "frames"
    frames.mkdir()
    images = write_bag(bag, rigid_endoscope(origin, frames, count=16), three_body_take(origin, tmp_path).path)
    out = tmp_path / "out"
    out.mkdir()
    # Fails if a node has died on the way.
    recording = play_through_nodes(bag, out, time.monotonic(), rate=0.25)
    received: dict[str, list[Any]] = {EDGES: [], GAP: [], SCOPE_POSE: []}
    with BagReader(recording) as reader:
        for entry in reader.messages([topic for topic in received if topic in reader.topics]):
            received[entry.topic].append(reader.deserialize(entry))
    for log in out.glob("*.log"):
        assert "Traceback" not in log.read_text()

    edges = {stamp_of(message): message for message in received[EDGES]}
    draw_contact_sheet(bag, edges, OUT / origin / "contact_sheet.png")
    assert len(edges) >= 0.9 * images
    assert len(received[GAP]) >= 0.9 * images
    poses = np.array(sorted(stamp_of(message) for message in received[SCOPE_POSE]))
    for estimate in received[GAP]:
        numbers = [estimate.gap, estimate.gap_min, estimate.gap_max, estimate.snr]
        if estimate.status != GapEstimate.STATUS_VALID:
            assert np.isnan(estimate.gap)
            continue
        # Promise 1: everything behind a valid number is there, fresh, and of the same two points.
        stamp = stamp_of(estimate)
        behind = edges[stamp]
        assert behind.status == GapEdges.STATUS_VALID
        assert behind.track_id == estimate.track_id
        assert np.isfinite(numbers).all()
        assert 0.0 <= numbers[1] <= numbers[0] <= numbers[2]
        before, after = poses[poses <= stamp], poses[poses >= stamp]
        assert stamp - before.max() <= MAX_POSE_AGE_NS
        assert after.min() - stamp <= MAX_POSE_AGE_NS

"""segmentation_node and tracking_node as processes: bad input is reported and survived, good input passes."""

import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

pytest.importorskip("rclpy")

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped
from live import Client
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sample_bag import sample_camera_info, sample_images
from sensor_msgs.msg import CameraInfo, CompressedImage, Image

from knee_gap_bringup.launching.processes import Processes, executable
from knee_gap_core.values.stamps import set_stamp
from knee_gap_msgs.msg import GapEdges

DOMAIN = 52
ENVIRONMENT = {"ROS_DOMAIN_ID": str(DOMAIN), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}

pytestmark = [pytest.mark.system, pytest.mark.timeout(180)]


@pytest.fixture(scope="module")
def frames() -> list[np.ndarray]:
    """The first images of the sample bag."""
    return sample_images(10)


@pytest.fixture(scope="module")
def camera() -> CameraInfo:
    info = sample_camera_info()
    message = CameraInfo(height=int(info.height), width=int(info.width))
    message.distortion_model = info.distortion_model
    message.d, message.k = [float(v) for v in info.d], np.asarray(info.k, dtype=float)
    return message


def image_message(picture: np.ndarray, stamp_ns: int, encoding: str = "bgr8") -> Image:
    message = Image(height=picture.shape[0], width=picture.shape[1], encoding=encoding)
    message.step = picture.strides[0]
    set_stamp(message.header, stamp_ns)
    message.header.frame_id = "arthroscope_optical"
    message.data = picture.tobytes()
    return message


@pytest.fixture
def segmentation(tmp_path: Path) -> Iterator[tuple[Client, Processes]]:
    with Processes(tmp_path, ENVIRONMENT) as processes, Client(DOMAIN) as client:
        command = [executable("knee_gap_perception", "segmentation_node")]
        command += ["--ros-args", "-r", "__ns:=/knee_gap", "-p", "medium:=1.0"]  # air, as a number
        processes.start("segmentation_node", command)
        client.offer(Image, "image_raw")
        client.offer(CameraInfo, "camera_info")
        client.listen(GapEdges, "gap_edges")
        client.listen(DiagnosticArray, "/diagnostics")
        processes.wait_ready(["segmentation_node"], 120.0)
        client.wait_matched()
        yield client, processes


def send(client: Client, message: Image) -> GapEdges:
    """Publish an image and return the edges that the node answers with."""
    before = len(client.received["gap_edges"])
    client.publish("image_raw", message)
    client.spin_until(lambda: len(client.received["gap_edges"]) > before)
    return client.received["gap_edges"][before]


def test_every_bad_image_gets_a_status_and_good_ones_go_on(
    segmentation: tuple[Client, Processes], frames: list[np.ndarray], camera: CameraInfo
) -> None:
    client, processes = segmentation
    stamp = iter(range(10**18, 2 * 10**18, 16_666_667))
    good = frames[0]

    early = send(client, image_message(good, next(stamp)))
    assert early.status == GapEdges.STATUS_UNKNOWN  # no camera_info yet
    client.publish("camera_info", camera)
    client.spin(0.3)
    first = send(client, image_message(frames[1], next(stamp)))
    assert first.status == GapEdges.STATUS_VALID
    assert np.linalg.norm([first.bearing_0.x, first.bearing_0.y, first.bearing_0.z]) == pytest.approx(1.0)

    bad = {
        "unknown encoding": image_message(good, next(stamp), "guess8"),
        "depth": image_message(good[..., 0].astype(np.uint16), next(stamp), "16UC1"),
        "zero size": image_message(np.zeros((0, 0, 3), np.uint8), next(stamp)),
        "another size": image_message(good[:360, :640].copy(), next(stamp)),
        "black": image_message(np.zeros_like(good), next(stamp)),
        "white": image_message(np.full_like(good, 255), next(stamp)),
    }
    cut = image_message(good, next(stamp))
    cut.data = cut.data[: len(cut.data) // 2]
    bad["half its data"] = cut
    for name, message in bad.items():
        edges = send(client, message)
        assert edges.status != GapEdges.STATUS_VALID, name
        assert np.isnan([edges.bearing_0.x, edges.pixel_0[0], edges.angular_error]).all(), name
        processes.check("segmentation_node")

    again = send(client, image_message(frames[2], next(stamp)))
    assert again.status == GapEdges.STATUS_VALID
    assert again.track_id > first.track_id
    backwards = send(client, image_message(frames[3], 10**17))
    assert backwards.track_id != again.track_id

    counts: dict[str, str] = {}

    def reported() -> bool:
        for array in client.received["/diagnostics"]:
            for status in array.status:
                counts.update({value.key: value.value for value in status.values})
        return "UNKNOWN" in counts and "VALID" in counts

    client.spin_until(reported)
    assert "Traceback" not in processes.log("segmentation_node").read_text()


def test_mask_and_overlay_are_there_once_somebody_listens(
    segmentation: tuple[Client, Processes], frames: list[np.ndarray], camera: CameraInfo
) -> None:
    client, _ = segmentation
    client.publish("camera_info", camera)
    client.spin(0.3)
    for topic in ("gap_mask", "segmentation_node/overlay"):
        client.listen(Image, topic, qos=QoSProfile(depth=4, reliability=ReliabilityPolicy.BEST_EFFORT))
    client.spin(0.5)
    send(client, image_message(frames[0], 10**18))
    client.spin_until(lambda: bool(client.received["gap_mask"]))
    client.spin_until(lambda: bool(client.received["segmentation_node/overlay"]))
    overlay = client.received["segmentation_node/overlay"][0]
    drawn = np.frombuffer(overlay.data, np.uint8).reshape(frames[0].shape)
    assert 0.001 < (drawn != frames[0]).any(axis=2).mean() < 0.3
    mask = client.received["gap_mask"][0]
    pixels = np.frombuffer(mask.data, np.uint8).reshape(mask.height, mask.width)
    assert (mask.width, mask.height, mask.encoding) == (1280, 720, "mono8")
    assert set(np.unique(pixels)) == {0, 255}
    assert 0.02 < (pixels > 0).mean() < 0.5


def pose_message(stamp_ns: int, x: float = 0.0, w: float = 1.0) -> PoseStamped:
    message = PoseStamped()
    message.header.frame_id = "world"
    set_stamp(message.header, stamp_ns)
    message.pose.position.x = x
    message.pose.orientation.w = w
    return message


def test_tracking_node_publishes_good_poses_only(tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    period = 8_333_333
    with Processes(tmp_path, ENVIRONMENT) as processes, Client(DOMAIN) as client:
        command = [executable("knee_gap_perception", "tracking_node"), "--ros-args", "-r", "__ns:=/knee_gap"]
        processes.start("tracking_node", [*command, "-p", "body_to_shaft_translation:=[0.0, 0.0, 0.2]"])
        client.offer(PoseStamped, "scope_body/pose")
        client.listen(PoseWithCovarianceStamped, "scope_pose")
        processes.wait_ready(["tracking_node"], 60.0)
        client.wait_matched()
        stamp = 10**18
        for _ in range(60):
            stamp += period
            client.publish("scope_body/pose", pose_message(stamp, rng.normal(0.0, 1e-5)))
            client.spin(0.004)
        client.spin_until(lambda: len(client.received["scope_pose"]) >= 50)
        lens = client.received["scope_pose"][-1]
        assert lens.header.frame_id == "world"
        assert lens.pose.pose.position.z == pytest.approx(0.2)
        assert lens.pose.covariance[0] == pytest.approx((0.0367e-3) ** 2 / 3)

        before = len(client.received["scope_pose"])
        rubbish: list[Any] = [
            pose_message(stamp + 1 * period, np.nan),
            pose_message(stamp + 2 * period, 0.0, w=0.5),
            pose_message(stamp + 3 * period, 0.0, w=0.0),
            pose_message(stamp - 10 * period),
        ]
        for message in rubbish:
            client.publish("scope_body/pose", message)
            client.spin(0.05)
        processes.check("tracking_node")
        published = client.received["scope_pose"][before:]
        assert all(np.isfinite(m.pose.pose.position.x) for m in published)
        assert len(published) <= 1  # a stamp that ran backwards may begin again, and nothing else may pass


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["-p", "no_such_parameter:=1"], "no parameter no_such_parameter; there are: "),
        (["-p", "image_transport:=smoke_signals"], "image_transport"),
        (["-p", "working_rows:=-5"], "working_rows"),
        (["-p", "medium:=beer"], "medium must be air, saline, water or a refractive index"),
        (["-p", "camera_info_medium:=0.5"], "camera_info_medium must be"),
        (["--params-file", "/nowhere/at/all.yaml"], "all.yaml"),
    ],
)
def test_mistaken_parameters_end_the_start_in_one_line(arguments: list[str], words: str) -> None:
    done = subprocess.run(
        [executable("knee_gap_perception", "segmentation_node"), "--ros-args", *arguments],
        capture_output=True,
        text=True,
        check=False,
        timeout=60,
    )
    assert done.returncode == 2
    assert words in done.stderr
    # ROS's own parser may add a line to ours.
    ours = [line for line in done.stderr.splitlines() if "[rcl]" not in line]
    assert len(ours) == 1, done.stderr


def test_inputs_that_nobody_publishes_are_named_and_compressed_images_are_found(
    frames: list[np.ndarray], camera: CameraInfo, tmp_path: Path
) -> None:
    with Processes(tmp_path, ENVIRONMENT) as processes, Client(DOMAIN) as client:
        command = [
            executable("knee_gap_perception", "segmentation_node"),
            "--ros-args",
            "-r",
            "__ns:=/knee_gap",
        ]
        command += ["-p", "medium:=air"]
        processes.start("segmentation_node", command)
        client.listen(DiagnosticArray, "/diagnostics")
        nobody = "nobody publishes /knee_gap/camera_info, /knee_gap/image_raw;"
        client.spin_until(lambda: any(nobody in words for words in said(client)), 120.0)
        client.offer(CompressedImage, "image_raw/compressed")
        client.offer(CameraInfo, "camera_info")
        client.listen(GapEdges, "gap_edges")
        processes.wait_ready(["segmentation_node"], 120.0)
        client.wait_matched()
        client.publish("camera_info", camera)
        client.spin(0.3)
        contents = [b"", b"no picture", cv2.imencode(".jpg", frames[0])[1].tobytes()]
        for k, data in enumerate(contents):
            message = CompressedImage(format="jpeg", data=data)
            message.header.stamp.sec = 10 + k
            client.publish("image_raw/compressed", message)
            client.spin(0.2)
        client.spin_until(lambda: len(client.received["gap_edges"]) >= 3)
        statuses = [edges.status for edges in client.received["gap_edges"]]
        assert statuses == [GapEdges.STATUS_UNKNOWN, GapEdges.STATUS_UNKNOWN, GapEdges.STATUS_VALID]
        client.received["/diagnostics"].clear()
        client.spin_until(lambda: bool(said(client)))
        assert not any("nobody publishes" in words for words in said(client))


def said(client: Client) -> list[str]:
    """Messages of the node's diagnostics."""
    return [status.message for array in client.received["/diagnostics"] for status in array.status]

"""segmentation_node as a process: lens poses, chosen points, and the bad pictures that a theatre sends."""

from collections.abc import Iterator
from typing import Any

import cv2
import numpy as np
import pytest

pytest.importorskip("rclpy")

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PointStamped, PoseWithCovarianceStamped
from live import Client
from sample_bag import sample_camera_info, sample_images
from sensor_msgs.msg import CameraInfo, Image
from std_srvs.srv import Trigger

from knee_gap_bringup.launching.processes import Processes, executable
from knee_gap_core.values.stamps import set_stamp
from knee_gap_msgs.msg import GapEdges
from knee_gap_msgs.srv import ChoosePoint

DOMAIN = 57
ENVIRONMENT = {"ROS_DOMAIN_ID": str(DOMAIN), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
FRAME_NS = 16_666_667
VALID, UNKNOWN = GapEdges.STATUS_VALID, GapEdges.STATUS_UNKNOWN
NO_GAP, LOW_CONTRAST = GapEdges.STATUS_NO_GAP, GapEdges.STATUS_LOW_CONTRAST

pytestmark = [pytest.mark.system, pytest.mark.timeout(240)]


@pytest.fixture(scope="module")
def frames() -> list[np.ndarray]:
    """The first images of the sample bag."""
    return sample_images(12)


class Feed:
    """A running node, and a client that sends it pictures and takes its answers."""

    def __init__(self, client: Client, processes: Processes) -> None:
        self.client, self.processes = client, processes
        self.stamp_ns = 10**18
        self.info = sample_camera_info()

    def camera(self, width: int = 1280, height: int = 720, model: str = "equidistant") -> None:
        """Publish the sample's camera, scaled to another size."""
        message = CameraInfo(height=height, width=width, distortion_model=model)
        k = np.array(self.info.k, dtype=float)
        k[[0, 2]] *= width / self.info.width
        k[[4, 5]] *= height / self.info.height
        message.d, message.k = [0.0] * 4, k
        self.client.publish("camera_info", message)
        self.client.spin(0.2)

    def send(self, picture: np.ndarray, encoding: str = "bgr8", stamp_ns: int | None = None) -> GapEdges:
        """Publish an image and return the edges that the node answers with."""
        self.stamp_ns += FRAME_NS
        self.publish(picture, encoding, stamp_ns or self.stamp_ns)
        before = self.answers
        self.client.spin_until(lambda: self.answers > before)
        return self.client.received["gap_edges"][before]

    def publish(self, picture: np.ndarray, encoding: str, stamp_ns: int) -> None:
        message = Image(height=picture.shape[0], width=picture.shape[1], encoding=encoding)
        message.step = picture.strides[0]
        set_stamp(message.header, stamp_ns)
        message.header.frame_id = "arthroscope_optical"
        message.data = picture.tobytes()
        self.client.publish("image_raw", message)

    @property
    def answers(self) -> int:
        return len(self.client.received["gap_edges"])

    def pose(self, stamp_ns: int) -> None:
        message = PoseWithCovarianceStamped()
        message.header.frame_id = "world"
        set_stamp(message.header, stamp_ns)
        message.pose.pose.orientation.w = 1.0
        message.pose.covariance = np.diag([4e-10] * 3 + [1e-10] * 3).ravel()
        self.client.publish("scope_pose", message)

    def call(self, kind: Any, name: str, request: Any) -> Any:
        caller = self.client.node.create_client(kind, name)
        self.client.spin_until(caller.service_is_ready)
        future = caller.call_async(request)
        self.client.spin_until(future.done)
        return future.result()

    def reported(self, words: str) -> bool:
        """Whether the latest diagnostics contain a word."""
        texts = [
            status.message for array in self.client.received["/diagnostics"][-1:] for status in array.status
        ]
        return any(words in text for text in texts)


@pytest.fixture(scope="module")
def feed(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Feed]:
    with Processes(tmp_path_factory.mktemp("logs"), ENVIRONMENT) as processes, Client(DOMAIN) as client:
        command = [executable("knee_gap_perception", "segmentation_node"), "--ros-args"]
        # A wait that a busy machine does not exceed before the pose arrives.
        command += ["-r", "__ns:=/knee_gap", "-p", "max_pose_wait:=0.1", "-p", "medium:=air"]
        processes.start("segmentation_node", command)
        client.offer(Image, "image_raw")
        client.offer(CameraInfo, "camera_info")
        client.offer(PointStamped, "clicked_point")
        client.offer(PoseWithCovarianceStamped, "scope_pose")
        client.listen(GapEdges, "gap_edges")
        client.listen(DiagnosticArray, "/diagnostics")
        processes.wait_ready(["segmentation_node"], 120.0)
        client.wait_matched()
        yield Feed(client, processes)
        processes.check("segmentation_node")
        assert "Traceback" not in processes.log("segmentation_node").read_text()


def grown(picture: np.ndarray, top: int, left: int) -> np.ndarray:
    """The picture at half size somewhere in a black frame of the same size."""
    small = cv2.resize(picture, (640, 360), interpolation=cv2.INTER_AREA)
    frame = np.zeros_like(picture)
    frame[top : top + 360, left : left + 640] = small
    return frame


def noisy(picture: np.ndarray, seed: int = 0) -> np.ndarray:
    """Even pictures of a live camera differ by noise."""
    noise = np.random.default_rng(seed).integers(-2, 3, picture.shape)
    return np.clip(picture.astype(int) + noise, 0, 255).astype(np.uint8)


def test_poses_are_used_once_they_come_and_the_image_waits_for_the_next(
    feed: Feed, frames: list[np.ndarray]
) -> None:
    feed.camera()
    first = feed.send(frames[0])
    assert (first.status, first.pose_used) == (VALID, False)
    stamp = feed.stamp_ns + FRAME_NS
    for k in (3, 2, 1):
        feed.pose(stamp - k * 8_333_333)
    feed.client.spin(0.2)
    before = feed.answers
    feed.publish(frames[1], "bgr8", stamp)
    feed.pose(stamp + 2_000_000)
    feed.client.spin_until(lambda: feed.answers > before)
    posed = feed.client.received["gap_edges"][before]
    assert (posed.status, posed.pose_used, posed.hidden_0, posed.hidden_1) == (VALID, True, False, False)
    assert posed.track_id == first.track_id + 1
    # No pose follows this one: it is looked at all the same, once it has waited.
    feed.stamp_ns = stamp
    late = feed.send(frames[2])
    assert (late.status, late.pose_used, late.track_id) == (VALID, True, posed.track_id)
    feed.stamp_ns += 10**9


def test_poses_that_come_in_a_burst_are_all_there_for_the_image_behind_them(
    feed: Feed, frames: list[np.ndarray]
) -> None:
    feed.camera()
    stamp = feed.stamp_ns + 10**9
    before = feed.answers
    for k in range(48, -1, -1):
        feed.pose(stamp + 1_000_000 - k * 8_333_333)
    feed.publish(frames[3], "bgr8", stamp)
    feed.client.spin_until(lambda: feed.answers > before)
    edges = feed.client.received["gap_edges"][before]
    assert (edges.status, edges.pose_used) == (VALID, True)
    feed.stamp_ns = stamp + 10**9


def test_a_point_is_chosen_and_a_track_ended_by_service(feed: Feed, frames: list[np.ndarray]) -> None:
    feed.camera()
    first = feed.send(frames[0])
    assert first.status == VALID
    refused = feed.call(ChoosePoint, "choose_point", ChoosePoint.Request(column=9999.0, row=360.0))
    assert not refused.accepted
    assert "1280x720" in refused.reason
    assert feed.send(frames[1]).track_id == first.track_id
    middle = (np.asarray(first.pixel_0) + np.asarray(first.pixel_1)) / 2
    away = middle + 70 * np.array([1.0, 0.0])
    taken = feed.call(ChoosePoint, "choose_point", ChoosePoint.Request(column=away[0], row=away[1]))
    assert (taken.accepted, taken.reason) == (True, "")
    chosen = feed.send(frames[2])
    assert (chosen.status, chosen.track_id) == (VALID, first.track_id + 1)
    again = feed.call(Trigger, "restart", Trigger.Request())
    assert again.success
    assert feed.send(frames[3]).track_id == first.track_id + 2
    click = PointStamped()
    click.point.x, click.point.y = (float(value) for value in middle)
    feed.client.publish("clicked_point", click)
    feed.client.spin(0.3)
    assert feed.send(frames[4]).track_id == first.track_id + 3


@pytest.mark.parametrize(
    ("name", "statuses", "words"),
    [
        ("black", {LOW_CONTRAST}, "dark"),
        ("white", {LOW_CONTRAST}, "overexposed"),
        ("overexposed", {LOW_CONTRAST}, "overexposed"),
        ("all glare", {LOW_CONTRAST, NO_GAP}, ""),
        ("closed joint", {NO_GAP}, ""),
        ("depth", {UNKNOWN}, "depth"),
        ("camera_info of another size", {UNKNOWN}, "camera_info is for"),
        ("camera_info of no model", {UNKNOWN}, ""),
    ],
)
def test_a_picture_that_shows_no_points_is_told(
    feed: Feed, frames: list[np.ndarray], name: str, statuses: set[int], words: str
) -> None:
    good = frames[5]
    feed.camera()
    field = good.max(axis=2, keepdims=True) > 12
    rng = np.random.default_rng(4)
    glare = np.where(rng.random((720, 1280, 1)) < 0.8, 255, 210).astype(np.uint8)
    picture, encoding = {
        "black": (noisy(np.zeros_like(good)), "bgr8"),
        "white": (np.full_like(good, 255), "bgr8"),
        "overexposed": (np.where(field, 254, good).astype(np.uint8), "bgr8"),
        "all glare": (np.where(field, cv2.GaussianBlur(glare, (0, 0), 3)[..., None], good), "bgr8"),
        "closed joint": (noisy(np.where(field, (110, 130, 160), 0).astype(np.uint8)), "bgr8"),
        "depth": (good[..., 0].astype(np.uint16), "16UC1"),
    }.get(name, (good, "bgr8"))
    if name == "camera_info of another size":
        feed.camera(1920, 1080)
    if name == "camera_info of no model":
        feed.camera(model="guesswork")
    edges = feed.send(np.ascontiguousarray(picture), encoding)
    if name in ("closed joint", "all glare"):
        # Points that were followed are hidden at first; then a gap is looked for.
        feed.call(Trigger, "restart", Trigger.Request())
        edges = feed.send(noisy(picture, 1), encoding)
    assert edges.status in statuses
    assert np.isnan([edges.bearing_0.x, edges.pixel_1[1], edges.angular_error, edges.covariance_0[0]]).all()
    assert (edges.hidden_0, edges.hidden_1) == (False, False)
    feed.client.received["/diagnostics"].clear()
    feed.client.spin_until(lambda: bool(feed.client.received["/diagnostics"]))
    status = feed.client.received["/diagnostics"][-1].status[0]
    assert status.message
    assert words in status.message
    feed.processes.check("segmentation_node")


@pytest.mark.parametrize(
    "name", ["letter-boxed", "small, in a corner", "turned", "mono", "mono16", "Bayer", "rgb", "bgra"]
)
def test_an_unusual_picture_gives_points_all_the_same(
    feed: Feed, frames: list[np.ndarray], name: str
) -> None:
    good = frames[6]
    feed.camera()
    letterbox = good.copy()
    letterbox[:90], letterbox[-90:] = 0, 0
    turned = cv2.warpAffine(good, cv2.getRotationMatrix2D((639.5, 359.5), 67.0, 1.0), (1280, 720))
    mosaic = good[..., 1].copy()
    mosaic[0::2, 0::2], mosaic[1::2, 1::2] = good[0::2, 0::2, 2], good[1::2, 1::2, 0]
    picture, encoding = {
        "letter-boxed": (letterbox, "bgr8"),
        "small, in a corner": (grown(good, 350, 20), "bgr8"),
        "turned": (turned, "bgr8"),
        "mono": (cv2.cvtColor(good, cv2.COLOR_BGR2GRAY), "mono8"),
        "mono16": (cv2.cvtColor(good, cv2.COLOR_BGR2GRAY).astype(np.uint16) << 8, "mono16"),
        "Bayer": (mosaic, "bayer_rggb8"),
        "rgb": (cv2.cvtColor(good, cv2.COLOR_BGR2RGB), "rgb8"),
        "bgra": (cv2.cvtColor(good, cv2.COLOR_BGR2BGRA), "bgra8"),
    }[name]
    feed.call(Trigger, "restart", Trigger.Request())
    edges = feed.send(np.ascontiguousarray(picture), encoding)
    for turn in range(30):
        # Where the field of view has moved it is found again within half a second.
        if edges.status == VALID:
            break
        edges = feed.send(np.ascontiguousarray(noisy(picture, turn)), encoding)
    assert edges.status == VALID
    # Both points lie on what is drawn, not on the black around it.
    grey = picture if picture.ndim == 2 else picture[..., :3].max(axis=2)
    for column, row in (edges.pixel_0, edges.pixel_1):
        assert grey[round(row) - 2 : round(row) + 3, round(column) - 2 : round(column) + 3].mean() > 40


def test_frozen_video_and_a_new_resolution(feed: Feed, frames: list[np.ndarray]) -> None:
    feed.camera()
    statuses = [feed.send(frames[7]).status for _ in range(5)]
    assert statuses[0] == VALID
    assert set(statuses[3:]) == {UNKNOWN}
    feed.client.received["/diagnostics"].clear()
    feed.client.spin_until(lambda: bool(feed.client.received["/diagnostics"]))
    assert feed.reported("frozen")
    before = feed.send(frames[8])
    assert before.status == VALID
    large = cv2.resize(frames[9], (1920, 1080))
    assert feed.send(large).status == UNKNOWN
    feed.camera(1920, 1080)
    after = feed.send(cv2.resize(frames[10], (1920, 1080)))
    assert after.status == VALID
    assert after.track_id > before.track_id
    feed.camera()
    assert feed.send(frames[11]).status == VALID

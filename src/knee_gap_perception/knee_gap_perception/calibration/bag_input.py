"""What calibration reads of a recorded bag, through `rosbags` alone: no ROS and no workspace needed."""

from collections.abc import Generator, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from rosbags.highlevel import AnyReader, AnyReaderError
from rosbags.interfaces import Connection
from rosbags.rosbag2 import ReaderError
from rosbags.typesys import Stores, get_typestore
from scipy.spatial.transform import Rotation

from knee_gap_node.bag_paths import missing_bag
from knee_gap_perception.calibration.rigid import Array, rigid
from knee_gap_perception.errors import PerceptionError
from knee_gap_perception.messages import image_from_compressed, image_from_message, stamp_ns

STEP_TOPIC = "/knee_gap/calibration_step"
IMAGE_TYPES = {
    "sensor_msgs/msg/CompressedImage": image_from_compressed,
    "sensor_msgs/msg/Image": image_from_message,
}
POSE_TYPES = ("geometry_msgs/msg/PoseStamped", "geometry_msgs/msg/PoseWithCovarianceStamped")


@dataclass(frozen=True)
class CalibrationBag:
    """A recorded bag, and the part of it [s from its start] that is to be read."""

    path: Path
    begin: float = 0.0
    end: float = float("inf")

    def steps(self) -> dict[str, tuple[float, float]]:
        """Parts [s] that the step topic marks, by name; empty where nothing was marked."""
        marks: list[tuple[float, str]] = []
        with opened(self.path) as reader:
            connections = [c for c in reader.connections if c.topic == STEP_TOPIC]
            for connection, time_ns, data in reader.messages(connections) if connections else ():
                name = str(getattr(reader.deserialize(data, connection.msgtype), "data", ""))
                marks.append(((time_ns - reader.start_time) * 1e-9, name))
            ends = [begin for begin, _ in marks[1:]] + [reader.duration * 1e-9]
        return {name: (begin, end) for (begin, name), end in zip(marks, ends, strict=True) if name != "end"}

    def part(self, name: str) -> "CalibrationBag":
        """The part that a step marks, or the whole bag where no step is marked at all.

        Raises PerceptionError where others are marked, but not this one.
        """
        steps = self.steps()
        if not steps:
            return self
        if name not in steps:
            raise PerceptionError(f"{self.path} has no step '{name}'; it has {', '.join(steps)}")
        begin, end = steps[name]
        return CalibrationBag(self.path, max(begin, self.begin), min(end, self.end))

    def images(self, topic: str) -> Generator[tuple[int, npt.NDArray[np.uint8]], None, None]:
        """Stamp [ns] and image (h, w, 3) of every image.

        Raises PerceptionError for a topic that is not in the bag or carries no images.
        """
        for stamp, message, msgtype in self._messages(topic, tuple(IMAGE_TYPES)):
            yield stamp, IMAGE_TYPES[msgtype](message)

    def has(self, topic: str) -> bool:
        """Whether the bag has messages on a topic."""
        with opened(self.path) as reader:
            return any(c.topic == topic and c.msgcount for c in reader.connections)

    def camera_info(self, topic: str) -> Any | None:
        """The first sensor_msgs/CameraInfo on a topic; None where there is none."""
        if not self.has(topic):
            return None
        return next(iter(self._messages(topic, ("sensor_msgs/msg/CameraInfo",))))[1]

    def image_stamps(self, topic: str) -> npt.NDArray[np.int64]:
        """Stamps [ns] of every image, none decoded."""
        return np.array([stamp for stamp, _, _ in self._messages(topic, tuple(IMAGE_TYPES))], dtype=np.int64)

    def poses(self, topic: str) -> tuple[npt.NDArray[np.int64], Array]:
        """Stamps (n,) [ns] and poses (n, 4, 4); what is no pose (NaN, no unit quaternion) is left out."""
        stamps, quaternions, positions = [], [], []
        for stamp, message, _ in self._messages(topic, POSE_TYPES):
            pose = message.pose if hasattr(message.pose, "position") else message.pose.pose
            q = np.array([pose.orientation.x, pose.orientation.y, pose.orientation.z, pose.orientation.w])
            p = np.array([pose.position.x, pose.position.y, pose.position.z])
            if np.isfinite(p).all() and abs(float(q @ q) - 1) < 1e-3:
                stamps.append(stamp)
                quaternions.append(q)
                positions.append(p)
        if not stamps:
            raise PerceptionError(f"no usable pose on {topic} in {self.path}: did the tracker see the body?")
        return np.array(stamps, dtype=np.int64), rigid(Rotation.from_quat(quaternions).as_matrix(), positions)

    def _messages(self, topic: str, msgtypes: tuple[str, ...]) -> Iterator[tuple[int, Any, str]]:
        with opened(self.path) as reader:
            connections = _connections(reader, topic, msgtypes, self.path)
            start, stop = reader.start_time + int(self.begin * 1e9), None
            if np.isfinite(self.end):
                stop = reader.start_time + int(self.end * 1e9)
            for connection, _, data in reader.messages(connections, start=start, stop=stop):
                message: Any = reader.deserialize(data, connection.msgtype)
                yield stamp_ns(message.header), message, connection.msgtype


def opened(path: Path) -> AnyReader:
    """Reader of a bag, named by its folder or a file in it. Raises PerceptionError where it is none."""
    folder = path.parent if path.suffix == ".mcap" else path
    # Other storages than MCAP are read as well, where there is one.
    if not any(folder.glob("*.db3")) and (flaw := missing_bag(path)):
        raise PerceptionError(flaw)
    if not (folder / "metadata.yaml").is_file():
        raise PerceptionError(f"{path} is no ROS 2 bag: there is no metadata.yaml")
    try:
        return AnyReader([folder], default_typestore=get_typestore(Stores.ROS2_JAZZY))
    except (AnyReaderError, ReaderError) as error:
        raise PerceptionError(f"{path} cannot be read: {error}") from None


def _connections(reader: AnyReader, topic: str, msgtypes: tuple[str, ...], path: Path) -> list[Connection]:
    connections = [c for c in reader.connections if c.topic == topic]
    fitting = [c for c in connections if c.msgtype in msgtypes]
    if fitting:
        return fitting
    if connections:
        raise PerceptionError(f"{topic} carries {connections[0].msgtype}, not {' or '.join(msgtypes)}")
    others = ", ".join(sorted({c.topic for c in reader.connections if c.msgtype in msgtypes})) or "none"
    raise PerceptionError(f"{topic} is not in {path}; topics of that kind: {others}")

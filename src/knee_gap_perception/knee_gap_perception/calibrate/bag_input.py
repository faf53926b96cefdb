"""Input of a calibration from recorded bags: images, poses, camera_info and marked steps, without ROS."""

import logging
from collections.abc import Generator, Iterator, Mapping
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from knee_gap_core.bag.bag import BagMessage, BagReader
from knee_gap_core.bag.errors import BagError
from knee_gap_core.values.arrays import Array
from knee_gap_core.values.rigid_transforms import rigid
from knee_gap_core.values.stamps import stamp_ns
from knee_gap_perception.errors import PerceptionError
from knee_gap_perception.messages import image_from_compressed, image_from_message

_LOG = logging.getLogger(__name__)
STEP_TOPIC = "/knee_gap/calibration_step"
LONGEST_BAG = 1e9  # [s]
IMAGE_TYPES = {
    "sensor_msgs/msg/CompressedImage": image_from_compressed,
    "sensor_msgs/msg/Image": image_from_message,
}
POSE_TYPES = ("geometry_msgs/msg/PoseStamped", "geometry_msgs/msg/PoseWithCovarianceStamped")


@dataclass(frozen=True)
class CalibrationBag:
    """A recorded bag, and the part of it [s from its start] to be read.

    Raises PerceptionError if there is not a bag or it cannot be read.
    """

    path: Path
    begin: float = 0.0
    end: float = float("inf")
    # Opened once for all parts, so that damage is reported once.
    _reader: BagReader | None = field(default=None, repr=False, compare=False)

    def __post_init__(self) -> None:
        if self._reader is None:
            object.__setattr__(self, "_reader", opened(self.path))

    @property
    def reader(self) -> BagReader:
        """The reader of the bag."""
        assert self._reader is not None
        return self._reader

    def steps(self) -> dict[str, tuple[float, float]]:
        """Parts [s] that the step topic marks, by name; empty if none is marked."""
        if STEP_TOPIC not in self.reader.topics:
            return {}
        start_ns, marks = self._start_ns(), []
        for entry in self.reader.messages([STEP_TOPIC]):
            message = self._readable(entry)
            if message is not None:
                marks.append(((entry.time_ns - start_ns) * 1e-9, str(getattr(message, "data", ""))))
        ends = [begin for begin, _ in marks[1:]] + [float("inf")]
        return {
            name: (begin, end)
            for (begin, name), end in zip(marks, ends[: len(marks)], strict=True)
            if name != "end"
        }

    def part(self, name: str) -> "CalibrationBag":
        """The part marked as a step, or the whole bag if no step is marked.

        Raises PerceptionError if other steps are marked, but not this one.
        """
        steps = self.steps()
        if not steps:
            return self
        if name not in steps:
            raise PerceptionError(f"{self.path} has no step '{name}'; it has {', '.join(steps)}")
        begin, end = steps[name]
        return CalibrationBag(self.path, max(begin, self.begin), min(end, self.end), self.reader)

    def images(self, topic: str) -> Generator[tuple[int, npt.NDArray[np.uint8]], None, None]:
        """Stamp [ns] and image (h, w, 3) of every image.

        Raises PerceptionError if the topic is not in the bag or does not contain images.
        """
        for stamp, message, msgtype in self._messages(topic, tuple(IMAGE_TYPES)):
            yield stamp, IMAGE_TYPES[msgtype](message)

    def has(self, topic: str) -> bool:
        """Whether the bag has messages on a topic."""
        if topic not in self.reader.topics:
            return False
        count = self.reader.count([topic])
        return next(self.reader.messages([topic]), None) is not None if count is None else count > 0

    def camera_info(self, topic: str) -> Any | None:
        """The first sensor_msgs/CameraInfo on a topic; None if there is none."""
        if not self.has(topic):
            return None
        first = next(iter(self._messages(topic, ("sensor_msgs/msg/CameraInfo",))), None)
        return None if first is None else first[1]

    def image_stamps(self, topic: str) -> npt.NDArray[np.int64]:
        """Stamps [ns] of all images, without decoding them."""
        stamps = [self.reader.stamp_ns(entry) for entry in self._entries(topic, tuple(IMAGE_TYPES))]
        return np.array([stamp for stamp in stamps if stamp is not None], dtype=np.int64)

    def poses(self, topic: str) -> tuple[npt.NDArray[np.int64], Array]:
        """Stamps (n,) [ns] and poses (n, 4, 4); invalid poses (NaN, no unit quaternion) are left out."""
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

    def span_ns(self, topic: str) -> tuple[int, int] | None:
        """First and last stamp [ns] on a topic; None if it has no messages."""
        entries = self._entries(topic, POSE_TYPES) if self.has(topic) else ()
        stamps = [stamp for entry in entries if (stamp := self.reader.stamp_ns(entry)) is not None]
        return (min(stamps), max(stamps)) if stamps else None

    def _messages(self, topic: str, msgtypes: tuple[str, ...]) -> Iterator[tuple[int, Any, str]]:
        for entry in self._entries(topic, msgtypes):
            message = self._readable(entry)
            if message is not None:
                yield stamp_ns(message.header), message, entry.msgtype

    def _entries(self, topic: str, msgtypes: tuple[str, ...]) -> Iterator[BagMessage]:
        """The part's messages on a topic. Raises PerceptionError if it is of none of the types."""
        _require_type(self.reader, topic, msgtypes)
        start_ns = self._start_ns()
        first_ns = start_ns + round(self.begin * 1e9)
        last_ns = start_ns + round(self.end * 1e9) if self.end < LONGEST_BAG else None
        for entry in self.reader.messages([topic]):
            if last_ns is not None and entry.time_ns >= last_ns:
                return
            if entry.time_ns >= first_ns:
                yield entry

    def _start_ns(self) -> int:
        """Recording time of the first message of the bag [ns]."""
        first = next(self.reader.messages(), None)
        return 0 if first is None else first.time_ns

    def _readable(self, entry: BagMessage) -> Any | None:
        """The message; None, and one line in the log, if it cannot be read."""
        try:
            return self.reader.deserialize(entry)
        except BagError as error:
            _LOG.warning(str(error))
            return None


class CalibrationBags:
    """The bags of one calibration: one for all steps, or one per step.

    `bags` are the bags by step; the bag without a name ("") has the steps that are marked in it. A bag
    without marks serves for any step. Raises PerceptionError for a bag that cannot be read.
    """

    def __init__(self, bags: Mapping[str, Path], begin: float = 0.0, end: float = float("inf")) -> None:
        self._bags = {step: CalibrationBag(path, begin, end) for step, path in bags.items()}

    def steps(self) -> list[str]:
        """Steps for which there are parts, by names of bags or marks."""
        marked = list(self._bags[""].steps()) if "" in self._bags else []
        return [*(step for step in self._bags if step), *marked]

    def part(self, step: str) -> CalibrationBag:
        """The part of a step. Raises PerceptionError if there is none."""
        if step in self._bags:
            return self._bags[step].part(step)
        if "" in self._bags:
            return self._bags[""].part(step)
        raise PerceptionError(f"no bag is named for the step '{step}'; there are {', '.join(self._bags)}")

    def poses(self, topic: str) -> tuple[npt.NDArray[np.int64], Array]:
        """Stamps (n,) [ns] and poses (n, 4, 4) of all bags, one after the other."""
        read = [bag.poses(topic) for bag in self._each() if len(self._bags) == 1 or bag.has(topic)]
        if not read:
            raise PerceptionError(f"no bag has poses on {topic}")
        return np.concatenate([stamps for stamps, _ in read]), np.concatenate([poses for _, poses in read])

    def require_apart(self, topic: str) -> None:
        """Raise PerceptionError if the poses of two bags overlap in time, which would mix them up."""
        bags = self._each() if len(self._bags) > 1 else []
        spans = sorted((*span, str(bag.path)) for bag in bags if (span := bag.span_ns(topic)))
        for (_, last, one), (first, _, other) in pairwise(spans):
            if first <= last:
                raise PerceptionError(
                    f"{one} and {other} overlap in time: record the steps one after the other"
                )

    def _each(self) -> list[CalibrationBag]:
        """The bags, each once."""
        return list({bag.path: bag for bag in self._bags.values()}.values())


def opened(path: Path) -> BagReader:
    """Reader of a bag, which is a folder or an MCAP file. Raises PerceptionError if it is not one."""
    try:
        return BagReader(path)
    except BagError as error:
        raise PerceptionError(str(error)) from None
    except OSError as error:
        raise PerceptionError(f"{path} cannot be read: {error.strerror}") from None


def _require_type(reader: BagReader, topic: str, msgtypes: tuple[str, ...]) -> None:
    """Raise PerceptionError if a topic is not in the bag or is of none of the types."""
    if (msgtype := reader.topics.get(topic)) in msgtypes:
        return
    if msgtype is not None:
        raise PerceptionError(f"{topic} is of type {msgtype}, not {' or '.join(msgtypes)}")
    others = ", ".join(sorted(name for name, kind in reader.topics.items() if kind in msgtypes)) or "none"
    raise PerceptionError(f"{topic} is not in {reader.path}; topics of that kind: {others}")

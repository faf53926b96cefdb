"""What happens to the messages and nodes of bench_live_faults: the rows of its table."""

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import cv2
import numpy as np
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped
from live_messages import with_stamp
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import CompressedImage

from knee_gap_bringup.launching.plan import NODES
from knee_gap_msgs.msg import GapEdges
from knee_gap_simulation.recordings.recording import BODY_POSE, IMAGE

BEGIN = 2.0  # of a fault, after the first message [s]
EDGES, LENS_POSE, LEG_POSE = "/knee_gap/gap_edges", "/knee_gap/scope_pose", "/knee_gap/reference_body/pose"
# How much later than a node's own message one of a second publisher is stamped [ns].
FORGED_LATER_NS = 3_000_000


class Sent(NamedTuple):
    """A message as CDR, its stamp and time of sending after the first [s], and its stamp in the bag [ns]."""

    topic: str
    data: bytes
    stamp: float
    due: float
    origin_ns: int


Change = Callable[[Sent], Sequence[Sent]]


@dataclass
class Fault:
    """What happens from `begin` to `end` [s] to messages, a node or the machine.

    `blind`: no gap is known meanwhile. `second`: topic that something else publishes as well, which makes
    `forge` of each message. `settings`: parameters of tracking_node in this row. `hogs`: a busy loop on each
    core. `fills_disk`: a recorder runs, and its disk is full meanwhile.
    """

    name: str
    end: float = BEGIN
    change: Change = lambda sent: [sent]
    node: str = ""
    blind: bool = True
    second: str = ""
    forge: Callable[[bytes], bytes] = field(default=bytes)
    settings: tuple[str, ...] = ()
    hogs: bool = False
    fills_disk: bool = False
    begin: float = BEGIN

    def within(self, sent: Sent) -> bool:
        """Whether a message is sent while the fault is there."""
        return self.begin <= sent.due < self.end


def of(topic: str, change: Change, begin: float, end: float) -> Change:
    """Change the messages of one topic for a while."""

    def changed(sent: Sent) -> Sequence[Sent]:
        return change(sent) if sent.topic == topic and begin <= sent.due < end else [sent]

    return changed


def frozen() -> Change:
    """The first message again and again, with new stamps."""
    kept: list[bytes] = []

    def change(sent: Sent) -> Sequence[Sent]:
        kept.append(sent.data)
        return [sent._replace(data=kept[0])]

    return change


def every_other(change: Change) -> Change:
    """Change every second message."""
    turn = itertools.cycle([False, True])
    return lambda sent: change(sent) if next(turn) else [sent]


def later(seconds: float) -> Change:
    """Send a message later, with its stamp as it was."""
    return lambda sent: [sent._replace(due=sent.due + seconds)]


def stepped(seconds: float) -> Change:
    """Stamp a message by a clock that was set."""
    return lambda sent: [sent._replace(stamp=sent.stamp + seconds)]


def moved(metres: float) -> Change:
    """A pose elsewhere, as of another body."""

    def change(sent: Sent) -> Sequence[Sent]:
        message = deserialized(sent.data, PoseStamped)
        message.pose.position.x += metres
        return [sent._replace(data=serialized(message))]

    return change


def elsewhere(data: bytes) -> bytes:
    """A pose of the tracked body that is 5 mm off."""
    message = deserialized(data, PoseStamped)
    message.pose.position.x += 0.005
    return serialized(message)


def black(data: bytes) -> bytes:
    """An image that shows nothing."""
    message = deserialized(data, CompressedImage)
    pixels = cv2.imdecode(np.frombuffer(message.data, np.uint8), cv2.IMREAD_COLOR)
    message.data = cv2.imencode(".jpg", np.zeros_like(pixels))[1].tobytes()
    return serialized(message)


def other_lens(data: bytes) -> bytes:
    """A lens pose that is 5 mm off, a little later."""
    message = deserialized(data, PoseWithCovarianceStamped)
    message.pose.pose.position.x += 0.005
    return later_stamped(message)


def other_edges(data: bytes) -> bytes:
    """Edges and points that are 2 degrees off, a little later."""
    message = deserialized(data, GapEdges)
    turn = Rotation.from_rotvec([np.radians(2.0), 0.0, 0.0])
    for name, sign in (("bearing_0", 1), ("edge_0", 1), ("bearing_1", -1), ("edge_1", -1)):
        bearing = getattr(message, name)
        turned = (turn if sign > 0 else turn.inv()).apply([bearing.x, bearing.y, bearing.z])
        bearing.x, bearing.y, bearing.z = (float(value) for value in turned)
    return later_stamped(message)


def later_stamped(message: Any) -> bytes:
    """The message as CDR, stamped as one of a second publisher."""
    stamp = message.header.stamp
    return with_stamp(serialized(message), stamp.sec * 10**9 + stamp.nanosec + FORGED_LATER_NS)


def with_leg(*, begin: float, end: float) -> Change:
    """A body on the leg beside that of the scope; the tracker swaps their labels for a while."""
    rng = np.random.default_rng(7)

    def change(sent: Sent) -> Sequence[Sent]:
        if sent.topic != BODY_POSE:
            return [sent]
        leg = deserialized(sent.data, PoseStamped)
        # At rest, but for the noise of a tracker: one that repeats itself is rejected as frozen.
        place = np.array([0.2, -0.1, 0.05]) + rng.normal(0.0, 1e-5, 3)
        leg.pose.position.x, leg.pose.position.y, leg.pose.position.z = (float(value) for value in place)
        turn = Rotation.from_rotvec([0.4, 0.0, -0.3]).as_quat()
        q = leg.pose.orientation
        q.x, q.y, q.z, q.w = (float(value) for value in turn)
        topics = (LEG_POSE, BODY_POSE) if begin <= sent.due < end else (BODY_POSE, LEG_POSE)
        return [sent._replace(topic=topics[0]), sent._replace(topic=topics[1], data=serialized(leg))]

    return change


def painted(paint: Callable[[Any], Any]) -> Change:
    """An image that is decoded, changed and encoded again."""
    known: dict[int, bytes] = {}

    def change(sent: Sent) -> Sequence[Sent]:
        if sent.origin_ns not in known:
            message = deserialized(sent.data, CompressedImage)
            pixels = paint(cv2.imdecode(np.frombuffer(message.data, np.uint8), cv2.IMREAD_COLOR))
            message.data = cv2.imencode(".jpg", pixels)[1].tobytes()
            known[sent.origin_ns] = serialized(message)
        return [sent._replace(data=known[sent.origin_ns])]

    return change


def deserialized(data: bytes, kind: type) -> Any:
    """A message of rclpy from CDR."""
    from rclpy.serialization import deserialize_message

    return deserialize_message(data, kind)


def serialized(message: Any) -> bytes:
    """CDR of a message of rclpy."""
    from rclpy.serialization import serialize_message

    return bytes(serialize_message(message))


def faults() -> list[Fault]:
    """The rows of the table."""

    def nothing(sent: Sent) -> Sequence[Sent]:
        return []

    def twice(sent: Sent) -> Sequence[Sent]:
        return [sent, sent]

    rows = [Fault("nothing", blind=False)]
    for node in NODES:
        rows.append(Fault(f"SIGKILL {node}, started again", BEGIN + 0.5, node=node))
        rows.append(Fault(f"SIGSTOP {node} 0.7 s", BEGIN + 0.7, node=node))
    for count in (1, 10, 100, 1000):
        end = BEGIN + count / 120
        rows.append(Fault(f"{count} poses lost", end, of(BODY_POSE, nothing, BEGIN, end), blind=count >= 10))
    end = BEGIN + 1.0
    for name, topic, change, blind in (
        ("poses 0.3 s late", BODY_POSE, later(0.3), True),
        ("poses in wrong order", BODY_POSE, every_other(later(0.012)), False),
        ("poses frozen", BODY_POSE, frozen(), True),
        ("poses of another body", BODY_POSE, moved(0.3), True),
        ("poses of two bodies in turn", BODY_POSE, every_other(moved(0.3)), False),
        ("poses doubled", BODY_POSE, twice, False),
        ("image frozen", IMAGE, frozen(), True),
        ("image black", IMAGE, painted(np.zeros_like), True),
        ("image white", IMAGE, painted(lambda pixels: np.full_like(pixels, 255)), True),
        ("every second image lost", IMAGE, every_other(nothing), False),
        ("images in wrong order", IMAGE, every_other(later(0.02)), False),
        ("images 0.3 s late", IMAGE, later(0.3), False),
        ("image of half the size", IMAGE, painted(lambda pixels: pixels[::2, ::2].copy()), True),
    ):
        rows.append(Fault(f"{name} 1 s", end, of(topic, change, BEGIN, end), blind=blind))
    for seconds in (0.1, -0.1):
        step = of(BODY_POSE, stepped(seconds), BEGIN, np.inf)
        rows.append(Fault(f"tracker's clock steps {1e3 * seconds:+g} ms", BEGIN, step, blind=False))
    leg = ("reference_body:=leg",)
    swap = with_leg(begin=BEGIN, end=end)
    rows.append(Fault("labels of scope and leg swapped 1 s", end, swap, settings=leg))
    for name, topic, forge in (
        ("poses, 5 mm off", BODY_POSE, elsewhere),
        ("images, black", IMAGE, black),
        ("gap_edges, 2 degrees off", EDGES, other_edges),
        ("scope_pose, 5 mm off", LENS_POSE, other_lens),
    ):
        rows.append(Fault(f"second publisher of {name}, 1 s", end, second=topic, forge=forge, blind=False))
    rows.append(Fault("busy loops on each core 2 s", BEGIN + 2.0, hogs=True, blind=False))
    rows.append(Fault("disk full while recording 1 s", end, fills_disk=True, blind=False))
    return rows

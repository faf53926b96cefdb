"""Wiring of a node: the topics that it receives and publishes, and the core between them.

A live node and the command `process` are two shells over the same core: a shell hands messages to `take`,
lets time pass with `ready`, and publishes what both return.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from enum import StrEnum
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

from knee_gap_core.node.seam import Fault

if TYPE_CHECKING:
    from knee_gap_core.bag.qos import QosName

# What a node reports of itself once a second: whether all is well, in a few words, and the counts behind it.
Health = tuple[bool, str, Mapping[str, object]]

# Makes a default-constructed message of a type, `package/msg/Name`: ROS's own, or one for bags.
Blank = Callable[[str], Any]


class Qos(StrEnum):
    """Quality of service by its purpose; `base_node` has ROS's profile of each."""

    IMAGE = "image"
    # Small, so that more may wait while the first image of a recording is searched.
    COMPRESSED_IMAGE = "compressed_image"
    TRACKER = "tracker"
    RESULT = "result"
    # A result whose absence the middleware reports to a subscriber.
    DEADLINE = "deadline"
    LATCHED = "latched"
    # Latched by more than one node: of each the last message.
    LATCHED_BY_SEVERAL = "latched_by_several"

    @property
    def in_bags(self) -> "QosName":
        """The profile with which a bag holds a topic."""
        if self in (Qos.LATCHED, Qos.LATCHED_BY_SEVERAL):
            return "latched"
        return "sensor" if self in (Qos.IMAGE, Qos.COMPRESSED_IMAGE, Qos.TRACKER) else "reliable"


class InputTopic(NamedTuple):
    """A topic that a node receives.

    `from_driver` is whether a camera, a tracker or another program from outside publishes it, so that a
    recording must hold it; the other topics are published by the nodes themselves. `needed`: a live node
    reports if nobody publishes it.
    """

    topic: str
    msgtype: str
    qos: Qos
    from_driver: bool = False
    needed: bool = False


class OutputTopic(NamedTuple):
    """A topic that a node publishes; `optional` if it depends on the settings."""

    topic: str
    msgtype: str
    qos: Qos
    optional: bool = False


class Output(NamedTuple):
    """A message to publish, and its stamp [ns]."""

    topic: str
    message: Any
    stamp_ns: int


class Notice(NamedTuple):
    """Words for the log of a live node, for the first time that their reason comes."""

    reason: str
    words: str
    is_error: bool = False


Outcome = Output | Notice


class NodeCore(Protocol):
    """The core of a node, without ROS. Topics are relative to the node's namespace, times in nanoseconds."""

    @property
    def inputs(self) -> Sequence[InputTopic]:
        """Topics to subscribe to. Of messages that wait, those of earlier topics are taken first."""

    @property
    def outputs(self) -> Sequence[OutputTopic]:
        """Topics to publish."""

    def begin(self, now_ns: int) -> Iterable[Outcome]:
        """What is published once, at the start of a live node."""

    def take(self, topic: str, message: Any, now_ns: int, queued_ns: int = 0) -> Sequence[Outcome]:
        """Receive a message, which has lain in a queue for some time; return what is published at once."""

    def ready(self, now_ns: int) -> Iterable[Outcome]:
        """Let time pass; yield what has become ready. The work is done while it is iterated."""

    def finish(self, now_ns: int) -> Iterable[Outcome]:
        """The end of a recording: yield what still waits for messages."""

    def recover(self, fault: Fault) -> Sequence[Outcome]:
        """Reset after an exception; return what is published for the message that raised it."""

    def health(self) -> Health:
        """Return the present health."""

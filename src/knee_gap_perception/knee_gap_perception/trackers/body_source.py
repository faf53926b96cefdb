"""Interface of a source of tracked bodies: frames of bodies with stamps, and its status."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple, Protocol

from knee_gap_core.values.poses import BodyPose
from knee_gap_perception.errors import PerceptionError


class UnknownBodyError(PerceptionError):
    """The tracker has no body of that name; the message lists those that it has."""


@dataclass(frozen=True)
class BodyFrame:
    """The bodies of one frame of the tracker, Z up, in metres.

    `stamp_ns` is the time of exposure by the ROS clock, or of arrival if `stamp_is_arrival`. `names` are all
    bodies of the tracker, by streaming id if it has ids; bodies that are not tracked may be missing from
    `bodies`.
    """

    stamp_ns: int
    bodies: tuple[BodyPose, ...]
    names: Mapping[int, str]
    stamp_is_arrival: bool = False


@dataclass(frozen=True)
class SourceStatus:
    """Status of a source: whether it delivers data, in words and with numbers for diagnostics."""

    ok: bool
    words: str
    values: Mapping[str, object] = field(default_factory=dict)


class Subscription(NamedTuple):
    """A topic that a source takes its messages from: its name, its type, and what a message is put into."""

    topic: str
    msgtype: str
    put: Callable[[Any], None]


class BodySource(Protocol):
    """Where tracked bodies come from.

    `waits` is whether `poll` waits for frames, and so needs a thread of its own; other sources have a frame
    only after a message of one of their `subscriptions`.
    """

    waits: bool

    @property
    def subscriptions(self) -> tuple[Subscription, ...]:
        """Topics to subscribe to; none if the source receives by itself."""

    def poll(self, timeout: float = 0.0) -> list[BodyFrame]:
        """Return the frames since the last call, in order; wait up to `timeout` [s] for one."""

    def status(self) -> SourceStatus:
        """Return the present status."""

    def close(self) -> None:
        """Release the source's resources."""


def choose_body(frame: BodyFrame, wanted: str) -> tuple[BodyPose | None, tuple[BodyPose, ...]]:
    """Return the wanted body of a frame, None if it is not tracked, and the others.

    `wanted` is a name or a streaming id; if it is empty, the only body. Raises UnknownBodyError if the
    tracker has no such body, or if it is empty and there are several bodies.
    """
    name = _name(frame.names, wanted)
    bodies = {body.name: body for body in frame.bodies}
    body = bodies.pop(name, None)
    return body, tuple(bodies.values())


def _name(names: Mapping[int, str], wanted: str) -> str:
    if wanted in names.values():
        return wanted
    if wanted.isdecimal() and int(wanted) in names:
        return names[int(wanted)]
    known = ", ".join(f"'{name}' (id {number})" for number, name in sorted(names.items()))
    if wanted:
        raise UnknownBodyError(f"the tracker has no rigid body '{wanted}'; it has: {known or 'none'}")
    if len(names) == 1:
        return next(iter(names.values()))
    raise UnknownBodyError(f"the rigid body must be named; the tracker has: {known or 'none'}")

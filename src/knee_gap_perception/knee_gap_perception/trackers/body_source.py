"""What every input of tracked bodies gives: frames of bodies with stamps, and a word on how it fares."""

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

    `stamp_ns` is the time of exposure on the clock of ROS, or of arrival where `stamp_is_arrival` says so.
    `names` are all bodies that the tracker knows, by streaming id where it has ids; those that it does not
    see may be missing from `bodies`.
    """

    stamp_ns: int
    bodies: tuple[BodyPose, ...]
    names: Mapping[int, str]
    stamp_is_arrival: bool = False


@dataclass(frozen=True)
class SourceStatus:
    """Whether data come, in plain words and with numbers for diagnostics."""

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
        """Return the frames since the last call, in their order; waits up to `timeout` [s] for one."""

    def status(self) -> SourceStatus:
        """Return how the source fares now."""

    def close(self) -> None:
        """Let go of what the source holds."""


def choose_body(frame: BodyFrame, wanted: str) -> tuple[BodyPose | None, tuple[BodyPose, ...]]:
    """Return the wanted body of a frame, None where it is not seen, and the others.

    `wanted` is a name or a streaming id; empty, it is the only body there is. Raises UnknownBodyError where
    the tracker has no such body, or several to choose from.
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

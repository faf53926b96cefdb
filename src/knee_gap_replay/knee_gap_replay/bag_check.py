"""Summary of the topics of a bag, and the check whether knee_gap can process it."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from knee_gap_core.bag.bag import BagMessage, BagReader
from knee_gap_core.bag.errors import BagError
from knee_gap_replay.topics import InputTopics

_SECOND_NS = 1e9
# Largest time between an image and the lens poses before and after it [ns]: max_pose_age of the estimator.
_MOST_POSE_AGE_NS = 25_000_000
_ENOUGH = 0.9


@dataclass
class TopicCheck:
    """Messages of one topic: their type and times [ns], in the order of the bag."""

    name: str
    msgtype: str
    record_ns: list[int] = field(default_factory=list)
    stamp_ns: list[int] = field(default_factory=list)
    unreadable: str = ""

    @property
    def times_ns(self) -> npt.NDArray[np.int64]:
        """Header stamps if the messages have them, else recording times."""
        return np.asarray(self.stamp_ns or self.record_ns, dtype=np.int64)

    @property
    def rate(self) -> float:
        """Message rate from the median interval [Hz]; NaN for fewer than two messages."""
        steps = np.diff(self.times_ns)
        steps = steps[steps > 0]
        return float(_SECOND_NS / np.median(steps)) if steps.size else float("nan")

    def remarks(self) -> Iterator[str]:
        """Yield short remarks on the topic: gaps, stamps out of order, latency, unreadable messages."""
        steps = np.diff(self.times_ns)
        period = _SECOND_NS / self.rate
        if (gaps := steps[steps > 1.5 * period]).size:
            yield f"{gaps.size} gaps, longest {gaps.max() / _SECOND_NS:.3f} s"
        if backwards := int(np.count_nonzero(steps < 0)):
            yield f"stamps run backwards {backwards} times"
        if repeated := int(np.count_nonzero(steps == 0)):
            yield f"{repeated} stamps repeated"
        if self.stamp_ns:
            latency = (np.asarray(self.record_ns) - self.times_ns) * 1e-6
            yield f"latency {np.median(latency):.1f} ms, at most {latency.max():.1f} ms"
        if self.unreadable:
            yield self.unreadable


def check_topics(reader: BagReader) -> dict[str, TopicCheck]:
    """Return a summary of each topic, from the whole bag."""
    checks = {name: TopicCheck(name, msgtype) for name, msgtype in sorted(reader.topics.items())}
    for message in reader.messages():
        check = checks[message.topic]
        check.record_ns.append(message.time_ns)
        _check_message(reader, message, check)
    return checks


def _check_message(reader: BagReader, message: BagMessage, check: TopicCheck) -> None:
    if check.unreadable:
        return
    try:
        if len(check.record_ns) == 1:
            reader.deserialize(message)
        stamp_ns = reader.stamp_ns(message)
    except BagError as error:
        check.unreadable = f"unreadable: {error}"
        check.stamp_ns.clear()
        return
    if stamp_ns is not None:
        check.stamp_ns.append(stamp_ns)


def reasons_against(checks: Mapping[str, TopicCheck], topics: InputTopics) -> list[str]:
    """Return the reasons why knee_gap cannot process a bag with these topics; empty if it can."""
    usable = {name for name, check in checks.items() if check.record_ns and not check.unreadable}
    reasons = [f"no readable message on {name}" for name in topics if name not in usable]
    if topics.image in usable and topics.body_pose in usable:
        share = _share_between_poses(checks[topics.image].times_ns, checks[topics.body_pose].times_ns)
        if share < _ENOUGH:
            most_ms = _MOST_POSE_AGE_NS * 1e-6
            reasons.append(
                f"only {share:.0%} of the images have poses within {most_ms:.0f} ms before and after them"
            )
    return reasons


def _share_between_poses(images_ns: npt.NDArray[np.int64], poses_ns: npt.NDArray[np.int64]) -> float:
    """Fraction of images with a pose before and a pose after them, both recent enough for an estimate."""
    poses_ns = np.sort(poses_ns)
    after = np.searchsorted(poses_ns, images_ns)
    before = np.searchsorted(poses_ns, images_ns, side="right") - 1
    inside = (before >= 0) & (after < poses_ns.size)
    age = images_ns[inside] - poses_ns[before[inside]]
    wait = poses_ns[after[inside]] - images_ns[inside]
    near = np.maximum(age, wait) <= _MOST_POSE_AGE_NS
    return float(np.count_nonzero(near)) / max(images_ns.size, 1)

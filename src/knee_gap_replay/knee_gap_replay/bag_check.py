"""Summary of the topics of a bag, and the check whether knee_gap can process it."""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from knee_gap_core.bag.bag import BagMessage, BagReader
from knee_gap_core.bag.errors import BagError
from knee_gap_perception.edge_tracking.edge_stream import read_image
from knee_gap_perception.errors import PerceptionError
from knee_gap_replay.topics import InputTopics
from knee_gap_replay.whole_bags.replay_clock import OTHER_CLOCK_NS, ReplayClock, replay_clock

_SECOND_NS = 1e9
_DAY_NS = 86_400e9
_IMAGES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
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
    # Of images: why none could be read, so far.
    image_flaw: str = ""
    clock: ReplayClock | None = None

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
        yield from self._latency()
        if self.unreadable:
            yield self.unreadable

    @property
    def lags_ns(self) -> npt.NDArray[np.int64]:
        """Times from stamp to recording."""
        return np.asarray(self.record_ns, dtype=np.int64) - self.times_ns

    @property
    def usual(self) -> npt.NDArray[np.bool_]:
        """Which messages are stamped by the clock of most: what a node reports of silence is not."""
        lags_ns = self.lags_ns
        # One of them, so that at least this one is usual.
        middle = np.sort(lags_ns)[lags_ns.size // 2]
        return np.asarray(np.abs(lags_ns - middle) < OTHER_CLOCK_NS)

    @property
    def usual_times(self) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
        """Recording times and stamps of the messages that are stamped by the clock of most."""
        usual = self.usual
        return np.asarray(self.record_ns, dtype=np.int64)[usual], self.times_ns[usual]

    def _latency(self) -> Iterator[str]:
        if not self.stamp_ns:
            return
        if others := int(np.count_nonzero(~self.usual)):
            yield f"{others} stamped by another clock"
        if abs(lag_ns := int(np.median(self.lags_ns))) < OTHER_CLOCK_NS:
            latency = self.lags_ns[self.usual] * 1e-6
            yield f"latency {np.median(latency):.1f} ms, at most {latency.max():.1f} ms"
            return
        when = "after" if lag_ns > 0 else "before"
        yield f"recorded {abs(lag_ns) / _DAY_NS:.1f} days {when} it was stamped"
        if self.clock is not None:
            latency = self.clock.latency_ns(*self.usual_times) * 1e-6
            words = f"{np.median(latency):.1f} ms, at most {latency.max():.1f} ms"
            yield f"{self.clock.words}: latency above the least {words}"


def _set_clocks(checks: Iterable[TopicCheck]) -> None:
    """Find the clock of a replay: of topics with stamps as far from their recording as each other."""
    far = [check for check in checks if check.stamp_ns and abs(np.median(check.lags_ns)) >= OTHER_CLOCK_NS]
    while far:
        lag_ns = np.median(far[0].lags_ns)
        alike = [check for check in far if abs(np.median(check.lags_ns) - lag_ns) < OTHER_CLOCK_NS]
        far = [check for check in far if all(check is not one for one in alike)]
        clock = replay_clock([one.usual_times for one in alike])
        for check in alike:
            check.clock = clock


def check_topics(reader: BagReader) -> dict[str, TopicCheck]:
    """Return a summary of each topic, from the whole bag."""
    checks = {name: TopicCheck(name, msgtype) for name, msgtype in sorted(reader.topics.items())}
    for message in reader.messages():
        check = checks[message.topic]
        check.record_ns.append(message.time_ns)
        _check_message(reader, message, check)
        if message.msgtype in _IMAGES and (check.image_flaw or len(check.record_ns) == 1):
            check.image_flaw = _image_flaw(reader, message)
    _set_clocks(checks.values())
    return checks


def _image_flaw(reader: BagReader, message: BagMessage) -> str:
    """Why an image cannot be read; empty if it can."""
    try:
        read_image(reader.deserialize(message))
    except (BagError, PerceptionError) as error:
        return str(error)
    return ""


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
    if topics.image in usable and (flaw := checks[topics.image].image_flaw):
        reasons.append(f"no image on {topics.image} could be read: {flaw}")
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

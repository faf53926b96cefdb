"""The results in a bag as arrays: estimates, edges, lens poses and the calibrations that were used."""

import re
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from knee_gap_core.bag.bag import BagReader
from knee_gap_core.bag.errors import BagError
from knee_gap_core.values.edges import EdgeStatus
from knee_gap_core.values.gap_estimate import GapStatus
from knee_gap_core.values.stamps import NANOSECONDS, stamp_ns
from knee_gap_uncertainty.estimation.messages import NUMBERS, SHARES

Floats = npt.NDArray[np.float64]

# Stamps this far [ns] from those of the images are of another clock: a node without images uses its own.
_OTHER_CLOCK_NS = 3_600 * 1_000_000_000
# A stream pauses where two stamps lie farther apart than this many periods.
_PAUSE_PERIODS = 1.5
# Kinds of unreadable messages that a page reports.
_MOST_REMARKS = 5
_NUMBER = re.compile(r"[-+]?\d+(?:[.,]\d+)*(?:e[-+]?\d+)?")


class Stream(NamedTuple):
    """Stamps of one topic: how many messages, their rate [Hz], its pauses, and the longest of them [s]."""

    name: str
    messages: int
    rate: float
    pauses: int
    longest: float


class Dropout(NamedTuple):
    """A time without a VALID estimate: begin, end [s], images, and its most frequent cause in words."""

    begin: float
    end: float
    images: int
    status: str
    reason: str


@dataclass(frozen=True, eq=False)
class Results:
    """What a bag holds of the gap; arrays with one entry per estimate, lengths in metres, NaN if unknown.

    `time` [s] counts from the first image; it is NaN for estimates whose stamp is of another clock. `numbers`
    are the numbers of knee_gap_msgs/GapEstimate by their names there. `edge_statuses` counts the images by
    the status of their edges.
    """

    path: Path
    stamps_ns: npt.NDArray[np.int64]
    time: Floats
    status: npt.NDArray[np.int64]
    reasons: tuple[str, ...]
    track_ids: npt.NDArray[np.int64]
    numbers: dict[str, Floats]
    edge_statuses: Counter[str]
    streams: tuple[Stream, ...]
    calibrations: tuple[Any, ...]
    remarks: tuple[str, ...]

    @property
    def valid(self) -> npt.NDArray[np.bool_]:
        """Whether each estimate is VALID."""
        return np.asarray(self.status == GapStatus.VALID)

    @property
    def duration(self) -> float:
        """Time from the first to the last image [s]; 0 if there is none."""
        known = self.time[np.isfinite(self.time)]
        return float(np.ptp(known)) if known.size else 0.0

    @property
    def valid_share(self) -> float:
        """Fraction of the estimates that are VALID; NaN if there is none."""
        return float(self.valid.mean()) if self.valid.size else float("nan")

    def median(self, values: Floats) -> float:
        """Median over the VALID estimates; NaN if it is not known of any."""
        chosen = values[self.valid]
        chosen = chosen[~np.isnan(chosen)]
        return float(np.median(chosen)) if chosen.size else float("nan")

    @property
    def width(self) -> Floats:
        """Distance of the bounds, gap_max - gap_min [m]."""
        return self.numbers["gap_max"] - self.numbers["gap_min"]

    def causes(self) -> list[tuple[str, str, int]]:
        """Status, reason and number of estimates, the most frequent first."""
        counts = Counter(
            (status_name(status), without_numbers(reason))
            for status, reason in zip(self.status, self.reasons, strict=True)
        )
        return [(status, reason, count) for (status, reason), count in counts.most_common()]

    def dropouts(self) -> list[Dropout]:
        """Times without a VALID estimate, in order; estimates of another clock are left out."""
        return list(self._dropouts())

    def _dropouts(self) -> Iterator[Dropout]:
        known = np.flatnonzero(np.isfinite(self.time))
        lost = ~self.valid[known]
        changes = np.flatnonzero(np.diff(np.concatenate([[False], lost, [False]]).astype(int)))
        for begin, end in changes.reshape(-1, 2):
            inside = known[begin:end]
            after = known[end] if end < known.size else inside[-1]
            words = Counter((int(self.status[k]), without_numbers(self.reasons[k])) for k in inside)
            (status, reason), _ = words.most_common(1)[0]
            yield Dropout(
                float(self.time[inside[0]]),
                float(self.time[after]),
                len(inside),
                status_name(status),
                reason,
            )


def status_name(status: int) -> str:
    """Name of a status of GapEstimate."""
    return GapStatus(status).name if status in GapStatus.__members__.values() else f"number {status}"


def without_numbers(reason: str) -> str:
    """A reason with its numbers replaced, so that the reasons of many images can be counted."""
    return _NUMBER.sub("#", reason)


def read_results(path: Path, space: str) -> Results:
    """Read the results of a bag in a namespace.

    Raises BagError for a bag that cannot be read, or without estimates of the gap.
    """
    gap, edges, poses = (f"{space}/{name}" for name in ("gap", "gap_edges", "scope_pose"))
    used = f"{space}/scope_calibration"
    estimates: list[Any] = []
    calibrations: dict[str, Any] = {}
    statuses: Counter[str] = Counter()
    unreadable: Counter[str] = Counter()
    stamps: dict[str, list[int]] = {gap: [], edges: [], poses: []}
    with BagReader(path) as bag:
        if gap not in bag.topics:
            raise BagError(f"{path} has no topic {gap}: process it first, or name its --namespace")
        for entry in bag.messages([topic for topic in (*stamps, used) if topic in bag.topics]):
            try:
                message = bag.deserialize(entry)
            except BagError as error:
                unreadable[str(error)] += 1
                continue
            if entry.topic == used:
                calibrations[str(message.node)] = message
                continue
            stamps[entry.topic].append(stamp_ns(message.header))
            if entry.topic == gap:
                estimates.append(_Read.of(message))
            elif entry.topic == edges:
                statuses[_edge_status(int(message.status))] += 1
        remarks = [*([bag.renamed] if bag.renamed else []), *bag.losses]
    remarks += [f"{count} times: {flaw}" for flaw, count in unreadable.most_common(_MOST_REMARKS)]
    if not estimates:
        raise BagError(f"{path} has no message on {gap}")
    at = np.array(stamps[gap], dtype=np.int64)
    time = _time(at, np.array([one.track_id for one in estimates]))
    if strange := int(np.isnan(time).sum()):
        remarks.append(f"{strange} estimates have stamps of another clock (no image yet): counted, not drawn")
    numbers = np.array([one.numbers for one in estimates])
    return Results(
        path=path,
        stamps_ns=at,
        time=time,
        status=np.array([one.status for one in estimates], dtype=np.int64),
        reasons=tuple(one.reason for one in estimates),
        track_ids=np.array([one.track_id for one in estimates], dtype=np.int64),
        numbers=dict(zip((*NUMBERS, *SHARES), numbers.T, strict=True)),
        edge_statuses=statuses,
        streams=tuple(_stream(topic, of_topic) for topic, of_topic in stamps.items()),
        calibrations=tuple(calibrations[node] for node in sorted(calibrations)),
        remarks=tuple(remarks),
    )


class _Read(NamedTuple):
    """What is kept of a GapEstimate."""

    status: int
    reason: str
    track_id: int
    numbers: tuple[float, ...]

    @classmethod
    def of(cls, message: Any) -> "_Read":
        # A bag recorded by a former version lacks the fields that are new.
        numbers = tuple(float(getattr(message, name, np.nan)) for name in (*NUMBERS, *SHARES))
        return cls(int(message.status), str(message.reason), int(message.track_id), numbers)


def _time(stamps_ns: npt.NDArray[np.int64], track_ids: npt.NDArray[np.int64]) -> Floats:
    """Time since the first image [s]; NaN for stamps of another clock."""
    of_images = stamps_ns[track_ids > 0]
    middle = np.sort(of_images if of_images.size else stamps_ns)[max(of_images.size, 1) // 2]
    near = np.abs(stamps_ns - middle) < _OTHER_CLOCK_NS
    # Differences of whole nanoseconds: seconds since 1970 as floats resolve only 0.2 us.
    return np.where(near, (stamps_ns - stamps_ns[near].min()) / NANOSECONDS, np.nan)


def _stream(topic: str, stamps: list[int]) -> Stream:
    steps = np.diff(np.array(stamps, dtype=np.int64)) / NANOSECONDS
    # Estimates before the first image may have another clock.
    steps = steps[(steps > 0.0) & (steps < _OTHER_CLOCK_NS / NANOSECONDS)]
    if not steps.size:
        return Stream(topic, len(stamps), float("nan"), 0, float("nan"))
    period = float(np.median(steps))
    pauses = steps[steps > _PAUSE_PERIODS * period]
    longest = float(pauses.max()) if pauses.size else float("nan")
    return Stream(topic, len(stamps), 1.0 / period, pauses.size, longest)


def _edge_status(status: int) -> str:
    return EdgeStatus(status).name if status in EdgeStatus.__members__.values() else f"number {status}"

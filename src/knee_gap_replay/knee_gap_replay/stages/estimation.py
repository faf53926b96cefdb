"""The second stage: edges and poses in, estimates out; the core of uncertainty_node in a bag's pipeline."""

import logging
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any, NamedTuple

from knee_gap_core.bag.message_types import blank
from knee_gap_core.bag.qos import QosName
from knee_gap_core.node.seam import Fault, Seam
from knee_gap_core.values.edge_messages import edges_from_message
from knee_gap_core.values.gap_estimate import GapEstimate, GapStatus
from knee_gap_core.values.stamps import NANOSECONDS
from knee_gap_replay.processing import Output
from knee_gap_uncertainty import messages
from knee_gap_uncertainty.estimator import GapEstimator

_LOG = logging.getLogger(__name__)
_NUMBERS = {"gap/min": "gap_min", "gap/max": "gap_max", "gap/snr": "snr"}


class Request(NamedTuple):
    """What the first stage asks of the second: `kind` is a row of `EstimationStage.handlers`.

    `what` stands in the report of an exception; `now_ns` is the time by the stamps.
    """

    kind: str
    what: str
    message: Any
    now_ns: int


class EstimationStage:
    """Answers the requests of the first stage, in their order, with messages under the namespace `space`."""

    def __init__(self, estimator: GapEstimator, space: str) -> None:
        self.estimator = estimator
        self._space = space
        self.seam = Seam(log_fault)
        self.outputs: Mapping[str, tuple[str, QosName]] = {
            self._topic("gap"): ("knee_gap_msgs/msg/GapEstimate", "reliable"),
            self._topic("gap_profile"): ("knee_gap_msgs/msg/GapProfile", "reliable"),
            self._topic("motion_advice"): ("knee_gap_msgs/msg/MotionAdvice", "reliable"),
            **{self._topic(name): ("std_msgs/msg/Float64", "reliable") for name in _NUMBERS},
        }
        # The types of the messages in requests, and what is done with each.
        self.handlers: dict[str, tuple[str, Callable[[Request], list[GapEstimate]]]] = {
            "time": ("", self._on_time),
            "end": ("", self._on_end),
            "calibration": ("knee_gap_msgs/msg/ScopeCalibration", self._on_calibration),
            "leg_pose": ("geometry_msgs/msg/PoseStamped", self._on_leg_pose),
            "rotation": ("knee_gap_msgs/msg/ScopeRotation", self._on_rotation),
            "pose": ("geometry_msgs/msg/PoseWithCovarianceStamped", self._on_pose),
            "edges": ("knee_gap_msgs/msg/GapEdges", self._on_edges),
        }

    def answer(self, request: Request) -> Iterator[Output]:
        """Return the messages published in answer to a request."""
        if request.kind == "calibration":
            self._on_calibration(request)
            return
        handle = self.handlers[request.kind][1]
        estimates = self.seam.call(
            request.what, lambda fault: self.estimator.recover(fault.reason), lambda: handle(request)
        )
        yield from self._published(estimates)
        if request.kind == "time":
            yield from self._advice()

    def _on_time(self, request: Request) -> list[GapEstimate]:
        return self.estimator.advance(request.now_ns)

    def _on_end(self, request: Request) -> list[GapEstimate]:
        wait_ns = round(self.estimator.parameters.max_pose_wait * NANOSECONDS)
        return self.estimator.advance(request.now_ns + wait_ns + 1)

    def _on_calibration(self, request: Request) -> list[GapEstimate]:
        self.estimator.add_calibration(messages.calibration_from_message(request.message))
        return []

    def _on_leg_pose(self, request: Request) -> list[GapEstimate]:
        self.estimator.add_leg_pose(messages.leg_pose_from_message(request.message))
        return []

    def _on_rotation(self, request: Request) -> list[GapEstimate]:
        return self.estimator.add_rotation(messages.rotation_from_message(request.message), request.now_ns)

    def _on_pose(self, request: Request) -> list[GapEstimate]:
        return self.estimator.add_pose(messages.pose_from_message(request.message), request.now_ns)

    def _on_edges(self, request: Request) -> list[GapEstimate]:
        return self.estimator.add_edges(edges_from_message(request.message), request.now_ns)

    def _published(self, estimates: Iterable[GapEstimate]) -> Iterator[Output]:
        for estimate in estimates:
            gap = messages.fill_gap_estimate(blank("knee_gap_msgs/msg/GapEstimate"), estimate)
            yield Output(self._topic("gap"), gap, estimate.stamp_ns)
            if estimate.status is GapStatus.VALID:
                for name, attribute in _NUMBERS.items():
                    number = blank("std_msgs/msg/Float64")
                    number.data = float(getattr(estimate, attribute))
                    yield Output(self._topic(name), number, estimate.stamp_ns)

        while self.estimator.profiles:
            profile = self.estimator.profiles.popleft()
            message = messages.fill_gap_profile(blank("knee_gap_msgs/msg/GapProfile"), profile)
            yield Output(self._topic("gap_profile"), message, profile.stamp_ns)

    def _advice(self) -> Iterator[Output]:
        while self.estimator.advice:
            advice = self.estimator.advice.popleft()
            message = blank("knee_gap_msgs/msg/MotionAdvice")
            messages.fill_motion_advice(message, advice, self.estimator.advice_parameters)
            yield Output(self._topic("motion_advice"), message, advice.stamp_ns)

    def _topic(self, name: str) -> str:
        return f"{self._space}/{name}"


def log_fault(fault: Fault) -> None:
    """Log the whole story of an exception for those who look for it."""
    _LOG.debug(fault.traceback)

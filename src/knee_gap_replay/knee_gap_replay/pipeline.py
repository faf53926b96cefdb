"""The cores of the three live nodes in one pipeline: images, camera and body poses in, gap estimates out.

The cores exchange messages, as the nodes do.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import partial
from typing import Any, Self

import numpy as np
import numpy.typing as npt

from knee_gap_core.bag.errors import BagError
from knee_gap_core.bag.message_types import blank
from knee_gap_core.bag.qos import QosName
from knee_gap_core.node.parameters_file import ParametersFile
from knee_gap_core.node.seam import Fault, Seam
from knee_gap_core.values.edge_messages import fill_gap_edges
from knee_gap_core.values.edges import GapEdges
from knee_gap_core.values.poses import LensPose
from knee_gap_core.values.stamps import set_stamp
from knee_gap_perception.calibration.in_use import CalibrationParameters
from knee_gap_perception.camera.medium import Medium
from knee_gap_perception.edge_tracking.edge_stream import EdgeStream
from knee_gap_perception.edge_tracking.parameters import CameraInfoParameters, PoseParameters
from knee_gap_perception.errors import PerceptionError
from knee_gap_perception.gap_detection.edge_parameters import EdgeParameters
from knee_gap_perception.messages_tracking import (
    fill_lens_pose,
    fill_scope_calibration,
    fill_scope_notch,
    fill_scope_rotation,
    notch_from_message,
)
from knee_gap_perception.scope_pose.pose_validity import Refusal, ValidityParameters
from knee_gap_perception.scope_pose.scope_tracker import ScopeTracker, TrackingParameters
from knee_gap_perception.scope_rotation.notch_tracker import NotchObservation
from knee_gap_perception.trackers.body_source import choose_body
from knee_gap_perception.trackers.natnet.client import NatNetParameters
from knee_gap_perception.trackers.pose_topic import PoseTopics
from knee_gap_perception.trackers.scope_feed import SCOPE, SourceParameters
from knee_gap_replay.processing import Output
from knee_gap_replay.stages.estimation import EstimationStage, Request, log_fault
from knee_gap_replay.topics import InputTopics
from knee_gap_uncertainty.estimator import GapEstimator
from knee_gap_uncertainty.estimator_parameters import EstimatorParameters
from knee_gap_uncertainty.motion_advice.motion_advice import AdviceParameters

# The parameters of each node's core.
PARAMETERS: dict[str, tuple[type, ...]] = {
    "segmentation_node": (EdgeParameters, PoseParameters, CalibrationParameters, CameraInfoParameters),
    "tracking_node": (
        TrackingParameters,
        ValidityParameters,
        CalibrationParameters,
        SourceParameters,
        NatNetParameters,
    ),
    "uncertainty_node": (EstimatorParameters, AdviceParameters),
}


class GapPipeline:
    """Feeds the cores in the order of stamps; `space` is the namespace of the published topics.

    `with_mask` publishes the gap mask of every image as well; the node does so only if there are subscribers.
    """

    @classmethod
    def from_parameters(
        cls, file: ParametersFile, topics: InputTopics, space: str, *, with_mask: bool = False
    ) -> Self:
        """Return a pipeline of cores with the node parameters in `file`; `with_mask` as in the constructor.

        Raises BagError for unknown parameters and for values that a core refuses.
        """
        file.refuse_unknown(PARAMETERS)
        built = {node: file.build(node, kinds) for node, kinds in PARAMETERS.items()}
        edges, poses, calibration_of_camera, camera_info = built["segmentation_node"]
        tracking, validity, calibration_of_lens, source, _ = built["tracking_node"]
        if calibration_of_camera.scope_rotation_notch != calibration_of_lens.scope_rotation_notch:
            raise BagError("scope_rotation_notch must be the same for segmentation_node and tracking_node")
        if calibration_of_camera.used_in != calibration_of_lens.used_in:
            raise BagError("medium must be the same for segmentation_node and tracking_node")
        try:
            stream = EdgeStream(
                edges,
                poses,
                calibration_of_camera.load(),
                by_notch=calibration_of_camera.scope_rotation_notch,
                medium=calibration_of_camera.used_in,
                camera_info_medium=camera_info.calibrated_in,
            )
            tracker = ScopeTracker(
                tracking,
                validity,
                calibration_of_lens.load(),
                by_notch=calibration_of_lens.scope_rotation_notch,
            )
        except PerceptionError as error:
            raise BagError(str(error)) from None
        return cls(
            stream,
            tracker,
            GapEstimator(*built["uncertainty_node"]),
            topics,
            space,
            up_axis=source.resolved_up_axis(),
            with_mask=with_mask,
            medium=calibration_of_lens.used_in,
        )

    def __init__(
        self,
        detector: EdgeStream,
        tracker: ScopeTracker,
        estimator: GapEstimator,
        topics: InputTopics,
        space: str,
        *,
        up_axis: str = "z",
        with_mask: bool = False,
        medium: Medium | None = None,
    ) -> None:
        self._detector = detector
        self._tracker = tracker
        # A bag contains topics only; poses received from Motive directly were recorded as poses of the lens.
        self._body_names = {topics.body_pose: SCOPE}
        for name, topic in tracker.parameters.other_bodies.items():
            self._body_names[f"{space}/{topic}"] = name
        self._bodies = PoseTopics([*self._body_names.values()], up_axis=up_axis)
        self.estimation = EstimationStage(estimator, space)
        self._topics = topics
        self._space = space
        self._with_mask = with_mask
        # Calibrations that the nodes publish at their start; in a bag only if there is one.
        used = {"segmentation_node": detector.calibration, "tracking_node": tracker.calibration}
        self._calibrations = [
            fill_scope_calibration(
                blank("knee_gap_msgs/msg/ScopeCalibration"),
                node,
                calibration,
                rotation_followed=node == "tracking_node" and tracker.follows_rotation,
                medium=medium,
            )
            for node, calibration in used.items()
            if any(used.values())
        ]
        # As in the nodes: an exception rejects one message, and that core starts again.
        self._seam = Seam(log_fault)
        self._newest_stamp_ns: int | None = None
        # The estimator's clock: it follows the stamps, and stands still while they run backwards.
        self._now_ns = 0
        self._leg_body = [f"{space}/leg_body/pose"] if estimator.parameters.leg_motion > 0.0 else []
        # Among equal stamps, the camera model and the pose come before the image.
        bodies = (*self._leg_body, *self._body_names)
        self.inputs: Sequence[str] = (topics.camera_info, *bodies, topics.image)
        self.outputs: Mapping[str, tuple[str, QosName]] = {
            self._topic("gap_edges"): ("knee_gap_msgs/msg/GapEdges", "reliable"),
            self._topic("scope_pose"): ("geometry_msgs/msg/PoseWithCovarianceStamped", "reliable"),
            **self.estimation.outputs,
        }
        if self._calibrations:
            self.outputs = {
                **self.outputs,
                self._topic("scope_calibration"): ("knee_gap_msgs/msg/ScopeCalibration", "latched"),
            }
        if tracker.by_notch:
            self.outputs = {
                **self.outputs,
                self._topic("scope_notch"): ("knee_gap_msgs/msg/ScopeNotch", "reliable"),
            }
        if tracker.follows_rotation:
            self.outputs = {
                **self.outputs,
                self._topic("scope_rotation"): ("knee_gap_msgs/msg/ScopeRotation", "reliable"),
            }
        if with_mask:
            self.outputs = {**self.outputs, self._topic("gap_mask"): ("sensor_msgs/msg/Image", "sensor")}

    def feed(self, topic: str, message: Any, stamp_ns: int) -> Iterable[Output]:
        """Process an image, a camera model or a pose of the tracked body; return the messages published."""
        return self._both(self.observe(topic, message, stamp_ns))

    def finish(self) -> Iterable[Output]:
        """Return the edges and estimates of images that are still waiting for their lens pose."""
        return self._both(self.observe_end())

    def estimate(self, request: Request) -> Iterator[Output]:
        """The second stage: answer a request of the first."""
        return self.estimation.answer(request)

    def _both(self, observed: Iterable[Output | Request]) -> Iterator[Output]:
        for item in observed:
            if isinstance(item, Output):
                yield item
            else:
                yield from self.estimate(item)

    def observe(self, topic: str, message: Any, stamp_ns: int) -> Iterator[Output | Request]:
        """The first stage: segmentation and tracking. Its requests are for `estimate`, in this order.

        It needs no answer, so that the second stage may run later or elsewhere.
        """
        if self._newest_stamp_ns is not None:
            self._now_ns += max(0, stamp_ns - self._newest_stamp_ns)
        else:
            yield from self._reported_calibrations(stamp_ns)
        self._newest_stamp_ns = stamp_ns
        # Before the message is processed: images whose wait is over go on without it, as live.
        yield from self._looked_at(self._detector.ready(self._now_ns))
        yield self._request("time", "time")
        what = f"message on {topic}"
        if topic == self._topics.camera_info:
            yield from self._segmented(what, lambda: self._detector.on_camera_info(message))
        elif topic in self._leg_body:
            yield self._request("leg_pose", what, message)
        elif topic in self._body_names:
            name = self._body_names[topic]
            yield from self._on_lenses(
                self._seam.call(what, self._restart_tracker, lambda: self._tracked(name, message))
            )
        else:
            yield from self._on_image(what, message)
        yield from self._looked_at(self._detector.ready(self._now_ns))

    def flaws(self) -> list[str]:
        """Faults, one line each: those of the calibration that make all results invalid, and exceptions."""
        return [*self.estimation_flaws(), *self.observation_flaws()]

    def observation_flaws(self) -> list[str]:
        """Faults of the first stage."""
        size = self._detector.size_flaw
        return [*([size] if size else []), *_counted(self._seam)]

    def estimation_flaws(self) -> list[str]:
        """Faults of the second stage."""
        flaw = self.estimation.estimator.calibration_flaw
        return [*([flaw] if flaw else []), *_counted(self.estimation.seam)]

    def unread(self) -> str:
        """Why no image could be read; empty if one was."""
        if self._detector.images_read:
            return ""
        return self._detector.unread_reason or "there is none"

    def observe_end(self) -> Iterator[Output | Request]:
        """The first stage of the images that are still waiting for their lens pose."""
        faults = -1
        while faults < self._seam.counts.total():
            # Repeated if an image raised, for the images after it.
            faults = self._seam.counts.total()
            yield from self._looked_at(self._detector.finish())
        yield self._request("end", "end")

    def _reported_calibrations(self, stamp_ns: int) -> Iterator[Output | Request]:
        for reported in self._calibrations:
            yield self._request("calibration", "scope_calibration", reported)
            yield Output(self._topic("scope_calibration"), reported, stamp_ns)

    def _tracked(self, name: str, message: Any) -> list[LensPose | Refusal]:
        self._bodies.put(name, message)
        lenses: list[LensPose | Refusal] = []
        for frame in self._bodies.poll():
            body, others = choose_body(frame, SCOPE)
            if body is not None:
                lenses += self._tracker.take(body, others)
        return lenses

    def _on_image(self, what: str, message: Any) -> Iterator[Output | Request]:
        observations: list[NotchObservation] = []

        def look() -> None:
            if (observation := self._detector.on_image(message, self._now_ns)) is not None:
                observations.append(observation)

        yield from self._segmented(what, look)
        for observation in observations:
            yield from self._on_notch(observation, str(message.header.frame_id))

    def _on_notch(self, observation: NotchObservation, frame_id: str) -> Iterator[Output | Request]:
        reported = fill_scope_notch(blank("knee_gap_msgs/msg/ScopeNotch"), observation, frame_id)
        yield Output(self._topic("scope_notch"), reported, observation.stamp_ns)
        observation = notch_from_message(reported)
        yield from self._on_lenses(
            self._seam.call("notch", self._restart_tracker, lambda: self._tracker.take_notch(observation))
        )

    def _on_lenses(self, lenses: Iterable[LensPose | Refusal]) -> Iterator[Output | Request]:
        for lens in lenses:
            if not isinstance(lens, LensPose):
                continue
            if self._tracker.follows_rotation:
                turn = fill_scope_rotation(blank("knee_gap_msgs/msg/ScopeRotation"), lens)
                yield Output(self._topic("scope_rotation"), turn, lens.stamp_ns)
                yield self._request("rotation", "scope_rotation", turn)
            pose = fill_lens_pose(blank("geometry_msgs/msg/PoseWithCovarianceStamped"), lens)
            yield Output(self._topic("scope_pose"), pose, lens.stamp_ns)
            yield self._request("pose", "scope_pose", pose)
            yield from self._segmented("scope_pose", partial(self._detector.on_lens_pose, pose))

    def _request(self, kind: str, what: str, message: Any = None) -> Request:
        return Request(kind, what, message, self._now_ns)

    def _segmented(self, what: str, call: Callable[[], None]) -> Iterator[Output | Request]:
        """Pass an input to the edge stream; return the messages published because of an exception, if any."""

        def nothing() -> list[GapEdges]:
            call()
            return []

        return self._looked_at(self._seam.call(what, self._restart_detector, nothing))

    def _restart_detector(self, fault: Fault) -> list[GapEdges]:
        return self._detector.recover(fault.reason)

    def _restart_tracker(self, _: Fault) -> list[LensPose | Refusal]:
        self._tracker.reset()
        return []

    def _looked_at(self, images: Iterable[GapEdges]) -> Iterator[Output | Request]:
        for edges in self._seam.each("image", self._restart_detector, images):
            edges_message = fill_gap_edges(
                blank("knee_gap_msgs/msg/GapEdges"), edges, lambda: blank("knee_gap_msgs/msg/GapSection")
            )
            yield Output(self._topic("gap_edges"), edges_message, edges.stamp_ns)
            if self._with_mask and (mask := self._detector.mask()) is not None:
                yield Output(self._topic("gap_mask"), _mask_message(edges, mask), edges.stamp_ns)
            yield self._request("edges", "gap_edges", edges_message)

    def _topic(self, name: str) -> str:
        return f"{self._space}/{name}"


def _counted(seam: Seam) -> list[str]:
    return [f"{count} times {fault}" for fault, count in seam.counts.items()]


def _mask_message(edges: GapEdges, mask: npt.NDArray[np.uint8]) -> Any:
    message = blank("sensor_msgs/msg/Image")
    set_stamp(message.header, edges.stamp_ns)
    message.header.frame_id, message.encoding = edges.frame_id, "mono8"
    message.height, message.width = mask.shape
    message.step, message.data = mask.shape[1], mask.ravel()
    return message

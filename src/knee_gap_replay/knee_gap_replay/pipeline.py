"""The cores of the three live nodes in one pipeline: images, camera and body poses in, gap estimates out.

The cores exchange the messages that the nodes exchange, by the topics that they declare.
"""

import logging
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple, Self

from knee_gap_core.bag.errors import BagError
from knee_gap_core.bag.message_types import blank
from knee_gap_core.bag.qos import QosName
from knee_gap_core.node.parameters_file import ParametersFile
from knee_gap_core.node.seam import Fault, Seam
from knee_gap_core.node.wiring import InputTopic, Outcome, Output, OutputTopic
from knee_gap_perception.edge_tracking import segmentation_core
from knee_gap_perception.edge_tracking.segmentation_core import SegmentationCore
from knee_gap_perception.errors import PerceptionError
from knee_gap_perception.scope_pose import tracking_core
from knee_gap_perception.scope_pose.tracking_core import TrackingCore
from knee_gap_perception.trackers.scope_feed import SCOPE_TOPIC, SourceParameters
from knee_gap_replay.topics import InputTopics
from knee_gap_uncertainty.estimation import uncertainty_core
from knee_gap_uncertainty.estimation.estimator import GapEstimator
from knee_gap_uncertainty.estimation.uncertainty_core import UncertaintyCore

_LOG = logging.getLogger(__name__)

# The parameters of each node's core.
PARAMETERS: dict[str, tuple[type, ...]] = {
    segmentation_core.NODE: SegmentationCore.parameters,
    tracking_core.NODE: TrackingCore.parameters,
    uncertainty_core.NODE: UncertaintyCore.parameters,
}


class Request(NamedTuple):
    """A call of the second stage: `call` is a method of its core, `topic` and `message` are what it takes.

    `what` stands in the report of an exception; `now_ns` is the time by the stamps.
    """

    call: str
    topic: str
    what: str
    message: Any
    now_ns: int


class GapPipeline:
    """Feeds the cores in the order of stamps; `space` is the namespace of the published topics.

    Its first stage is segmentation and tracking, its second the estimation, from which the first needs
    nothing back. `with_mask` publishes the gap mask of every image as well; the node does so only if there
    are subscribers.
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
        _, _, of_camera, _ = built[segmentation_core.NODE]
        tracking, validity, of_lens, source, natnet = built[tracking_core.NODE]
        if of_camera.scope_rotation_notch != of_lens.scope_rotation_notch:
            raise BagError("scope_rotation_notch must be the same for segmentation_node and tracking_node")
        if of_camera.used_in != of_lens.used_in:
            raise BagError("medium must be the same for segmentation_node and tracking_node")
        # A bag contains topics only; poses received from Motive directly were recorded as poses of the lens.
        of_topics = SourceParameters(source="pose", up_axis=source.resolved_up_axis())
        of_tracking = (tracking, validity, of_lens, of_topics, natnet)
        try:
            segmentation = SegmentationCore.from_parameters(built[segmentation_core.NODE], blank)
            tracker = TrackingCore.from_parameters(of_tracking, blank)
        except PerceptionError as error:
            raise BagError(str(error)) from None
        estimator = GapEstimator(*built[uncertainty_core.NODE])
        uncertainty = UncertaintyCore(estimator, blank)
        return cls(segmentation, tracker, uncertainty, topics, space, with_mask=with_mask)

    def __init__(
        self,
        segmentation: SegmentationCore,
        tracking: TrackingCore,
        uncertainty: UncertaintyCore,
        topics: InputTopics,
        space: str,
        *,
        with_mask: bool = False,
    ) -> None:
        self.segmentation, self.tracking, self.uncertainty = segmentation, tracking, uncertainty
        self._space = space
        self._with_mask = with_mask
        # Names in the bag, by those of the nodes; the others lie in the namespace.
        self._names = {
            **{given.topic: topics.image for given in segmentation_core.IMAGES.values()},
            segmentation_core.CAMERA_INFO.topic: topics.camera_info,
            SCOPE_TOPIC: topics.body_pose,
        }
        # As in the nodes: an exception rejects one message, and that core starts again.
        self._seam, self._second_seam = Seam(log_fault), Seam(log_fault)
        self._newest_stamp_ns: int | None = None
        # The estimator's clock: it follows the stamps, and stands still while they run backwards.
        self._now_ns = 0
        # In a bag, calibrations are published only if there is one.
        self._is_calibrated = any((segmentation.stream.calibration, tracking.tracker.calibration))
        self.estimated_types = {given.topic: given.msgtype for given in uncertainty.inputs}
        self._receivers = dict(self._received())
        # Among equal stamps, the camera model and the poses come before the image.
        driven = [name for name, (given, _) in self._receivers.items() if given.from_driver]
        self.inputs: Sequence[str] = (*(name for name in driven if name != topics.image), topics.image)
        self.outputs: Mapping[str, tuple[str, QosName]] = {
            self._name(one.topic): (one.msgtype, one.qos.in_bags) for one in self._published()
        }

    def feed(self, topic: str, message: Any, stamp_ns: int) -> Iterable[Output]:
        """Process an image, a camera model or a pose of the tracked body; return the messages published."""
        return self._both(self.observe(topic, message, stamp_ns))

    def finish(self) -> Iterable[Output]:
        """Return the edges and estimates of images that are still waiting for their lens pose."""
        return self._both(self.observe_end())

    def observe(self, topic: str, message: Any, stamp_ns: int) -> Iterator[Output | Request]:
        """The first stage: segmentation and tracking. Its requests are for `estimate`, in this order.

        It needs no answer, so that the second stage may run later or elsewhere.
        """
        if self._newest_stamp_ns is not None:
            self._now_ns += max(0, stamp_ns - self._newest_stamp_ns)
        elif self._is_calibrated:
            for core in (self.segmentation, self.tracking):
                yield from self._passed_on(core.begin(stamp_ns))
        self._newest_stamp_ns = stamp_ns
        # Before the message is processed: images whose wait is over go on without it, as live.
        yield from self._ready()
        yield Request("ready", "", "time", None, self._now_ns)
        yield from self._delivered(topic, message, f"message on {topic}")
        yield from self._ready()

    def observe_end(self) -> Iterator[Output | Request]:
        """The first stage of the images that are still waiting for their lens pose."""
        faults = -1
        while faults < self._seam.counts.total():
            # Repeated if an image raised, for the images after it.
            faults = self._seam.counts.total()
            waiting = self.segmentation.finish(self._now_ns)
            yield from self._passed_on(self._seam.each("image", self.segmentation.recover, waiting))
        yield Request("finish", "", "end", None, self._now_ns)

    def estimate(self, request: Request) -> Iterator[Output]:
        """The second stage: answer a request of the first."""
        outcomes = self._second_seam.each(request.what, self.uncertainty.recover, self._asked(request))
        for one in outcomes:
            if isinstance(one, Output):
                yield one._replace(topic=self._name(one.topic))

    def flaws(self) -> list[str]:
        """Faults, one line each: those of the calibration that make all results invalid, and exceptions."""
        return [*self.estimation_flaws(), *self.observation_flaws()]

    def observation_flaws(self) -> list[str]:
        """Faults of the first stage."""
        size = self.segmentation.stream.size_flaw
        return [*([size] if size else []), *_counted(self._seam)]

    def estimation_flaws(self) -> list[str]:
        """Faults of the second stage."""
        flaw = self.uncertainty.estimator.calibration_flaw
        return [*([flaw] if flaw else []), *_counted(self._second_seam)]

    def unread(self) -> str:
        """Why no image could be read; empty if one was."""
        stream = self.segmentation.stream
        return "" if stream.images_read else stream.unread_reason or "there is none"

    def _both(self, observed: Iterable[Output | Request]) -> Iterator[Output]:
        for item in observed:
            if isinstance(item, Output):
                yield item
            else:
                yield from self.estimate(item)

    def _ready(self) -> Iterator[Output | Request]:
        ready = self.segmentation.ready(self._now_ns)
        return self._passed_on(self._seam.each("image", self.segmentation.recover, ready))

    def _asked(self, request: Request) -> Iterator[Outcome]:
        """What the core of the second stage returns for a request."""
        if request.call == "take":
            yield from self.uncertainty.take(request.topic, request.message, request.now_ns)
        elif request.call == "ready":
            yield from self.uncertainty.ready(request.now_ns)
        else:
            yield from self.uncertainty.finish(request.now_ns)

    def _passed_on(self, outcomes: Iterable[Outcome]) -> Iterator[Output | Request]:
        """What the first stage publishes, and what follows from it in the cores that receive it."""
        for one in outcomes:
            if not isinstance(one, Output):
                continue
            name = self._name(one.topic)
            yield one._replace(topic=name)
            if one.topic == segmentation_core.GAP_EDGES.topic and self._with_mask:
                mask = self.segmentation.picture(segmentation_core.GAP_MASK)
                if mask is not None:
                    yield mask._replace(topic=self._name(mask.topic))
            if name in self._receivers:
                yield from self._delivered(name, one.message, one.topic)

    def _delivered(self, name: str, message: Any, what: str) -> Iterator[Output | Request]:
        """Hand a message to all cores that receive its topic."""
        given, cores = self._receivers[name]
        for core in cores:
            if core is self.uncertainty:
                yield Request("take", given.topic, what, message, self._now_ns)
            else:
                take = partial(core.take, given.topic, message, self._now_ns)
                yield from self._passed_on(self._seam.call(what, core.recover, take))

    def _received(self) -> Iterator[tuple[str, tuple[InputTopic, list[Any]]]]:
        """Topics in the bag with the cores that receive them, those of the second stage first."""
        found: dict[str, tuple[InputTopic, list[Any]]] = {}
        camera_info, *others = self.segmentation.inputs
        order = (
            (self.segmentation, [camera_info]),
            (self.uncertainty, self.uncertainty.inputs),
            (self.segmentation, others),
            (self.tracking, self.tracking.inputs),
        )
        for core, inputs in order:
            for given in inputs:
                _, cores = found.setdefault(self._name(given.topic), (given, []))
                if core not in cores:
                    cores.append(core)
        return iter(found.items())

    def _published(self) -> Iterator[OutputTopic]:
        """Topics to write: those of every run first."""
        cores = (self.segmentation, self.tracking, self.uncertainty)
        outputs = [one for core in cores for one in core.outputs]
        yield from (one for one in outputs if not one.optional)
        unwritten = () if self._is_calibrated else (segmentation_core.CALIBRATION,)
        yield from (one for one in outputs if one.optional and one not in unwritten)
        if self._with_mask:
            yield segmentation_core.GAP_MASK

    def _name(self, topic: str) -> str:
        return self._names.get(topic, f"{self._space}/{topic}")


def log_fault(fault: Fault) -> None:
    """Log the whole story of an exception at debug level."""
    _LOG.debug(fault.traceback)


def _counted(seam: Seam) -> list[str]:
    return [f"{count} times {fault}" for fault, count in seam.counts.items()]

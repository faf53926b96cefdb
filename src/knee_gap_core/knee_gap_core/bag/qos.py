"""Quality of service, as bags keep it."""

from collections.abc import Sequence
from typing import Literal

from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime
from rosbags.rosbag2.errors import ReaderError
from rosbags.rosbag2.metadata import parse_qos

from knee_gap_core.user_files import yaml_value

QosName = Literal["sensor", "reliable", "latched"]

_FOREVER = QosTime(9223372036, 854775807)


def _profile(reliability: QosReliability, durability: QosDurability, depth: int) -> Qos:
    return Qos(
        history=QosHistory.KEEP_LAST,
        depth=depth,
        reliability=reliability,
        durability=durability,
        deadline=_FOREVER,
        lifespan=_FOREVER,
        liveliness=QosLiveliness.AUTOMATIC,
        liveliness_lease_duration=_FOREVER,
        avoid_ros_namespace_conventions=False,
    )


PROFILES: dict[QosName, Qos] = {
    "sensor": _profile(QosReliability.BEST_EFFORT, QosDurability.VOLATILE, 10),
    "reliable": _profile(QosReliability.RELIABLE, QosDurability.VOLATILE, 10),
    "latched": _profile(QosReliability.RELIABLE, QosDurability.TRANSIENT_LOCAL, 1),
}


def parse(text: str) -> tuple[Qos, ...]:
    """Return the profiles that a channel's `offered_qos_profiles` lists; none where it is not understood."""
    try:
        yaml_value(text)  # refuses what the parser of rosbags would take too long for
        return tuple(parse_qos(text))
    except (ReaderError, KeyError, TypeError, AttributeError, ValueError):
        return ()


def is_latched(profiles: Sequence[Qos]) -> bool:
    """Return whether every publisher kept its last message for those who come later."""
    return bool(profiles) and all(qos.durability == QosDurability.TRANSIENT_LOCAL for qos in profiles)

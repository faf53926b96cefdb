"""Parameters of segmentation_node beside those of the edges: how images and lens poses reach it."""

from dataclasses import dataclass, field

from knee_gap_perception.camera.medium import CHOICES, Medium, medium_of
from knee_gap_perception.parameters import check_parameters


@dataclass(frozen=True)
class TransportParameters:
    """How images reach the node. Raises PerceptionError for a choice that there is not."""

    image_transport: str = field(
        default="auto",
        metadata={
            "description": "raw subscribes to image_raw, compressed to image_raw/compressed, auto to the one "
            "that is published, and to image_raw where both are",
            "choices": ("auto", "raw", "compressed"),
        },
    )
    max_image_lag: float = field(
        default=0.035,
        metadata={
            "description": "If images arrive faster than they are processed, those older than the newest by "
            "more than this are dropped; 0: none is dropped [s]",
            "range": (0.0, 1.0),
        },
    )
    picture_rate: float = field(
        default=15.0,
        metadata={
            "description": "Most masks and overlays a second, each made while no image waits [1/s]",
            "range": (0.1, 100.0),
        },
    )

    def __post_init__(self) -> None:
        check_parameters(self)


@dataclass(frozen=True)
class PoseParameters:
    """How the pose of the lens is waited for. Raises PerceptionError for values outside their range."""

    max_pose_wait: float = field(
        default=0.02,
        metadata={
            "description": "How long an image waits for the lens pose after it; 0: not at all [s]",
            "range": (0.0, 0.1),
        },
    )

    def __post_init__(self) -> None:
        check_parameters(self)


@dataclass(frozen=True)
class CameraInfoParameters:
    """The medium of camera_info. Raises PerceptionError for a medium that there is not."""

    camera_info_medium: str | float = field(
        default="air",
        metadata={
            "description": f"What the camera of camera_info was calibrated in: {CHOICES}; a calibration_file "
            "has its own"
        },
    )

    def __post_init__(self) -> None:
        check_parameters(self)
        medium_of(self.camera_info_medium, "camera_info_medium")

    @property
    def calibrated_in(self) -> Medium:
        """The medium that the camera of camera_info was calibrated in."""
        return medium_of(self.camera_info_medium, "camera_info_medium")

"""Parameters of segmentation_node that are not of its core: how images reach it."""

from dataclasses import dataclass, field

from knee_gap_perception.parameters import check_parameters


@dataclass(frozen=True)
class TransportParameters:
    """How images reach the node. Raises PerceptionError for a choice that there is not."""

    image_transport: str = field(
        default="raw",
        metadata={
            "description": "raw subscribes to image_raw, compressed to image_raw/compressed",
            "choices": ("raw", "compressed"),
        },
    )

    def __post_init__(self) -> None:
        check_parameters(self)

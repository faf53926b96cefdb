"""Parameters of the gap's edges, with meaning, default and range in one place."""

from dataclasses import dataclass, field
from math import nan

from knee_gap_perception.errors import PerceptionError
from knee_gap_perception.parameters import check_parameters
from knee_gap_perception.segmentation.choice import STRATEGIES


@dataclass(frozen=True)
class EdgeParameters:
    """How the gap is found and its two points are chosen and followed.

    Raises PerceptionError for values outside their range.
    """

    segmentation: str = field(
        default="watershed",
        metadata={"description": "How the dark gap is told from tissue", "choices": tuple(STRATEGIES)},
    )
    network_path: str = field(
        default="", metadata={"description": "ONNX file of the segmentation 'onnx': picture in, gap out"}
    )
    network_input_size: tuple[int, ...] = field(
        default=(256, 256),
        metadata={"description": "Width and height of the network's input [px]", "range": (8, 4096)},
    )
    network_mean: tuple[float, ...] = field(
        default=(0.0, 0.0, 0.0),
        metadata={
            "description": "Taken from red, green, blue before the network",
            "range": (-1000.0, 1000.0),
        },
    )
    network_scale: tuple[float, ...] = field(
        default=(1 / 255, 1 / 255, 1 / 255),
        metadata={"description": "Then multiplied to red, green, blue", "range": (0.0, 1000.0)},
    )
    working_rows: int = field(
        default=180, metadata={"description": "Rows at which the gap is segmented [px]", "range": (90, 2160)}
    )
    region_centre: tuple[float, ...] = field(
        default=(nan, nan),
        metadata={
            "description": "Column and row of the region of the section [px]; NaN: the field's centre",
            "range": (0.0, 16384.0),
            "nan": True,
        },
    )
    region_radius: float = field(
        default=0.55,
        metadata={"description": "Radius of that region, against the field of view's", "range": (0.02, 2.0)},
    )
    inset: float = field(
        default=0.035,
        metadata={
            "description": "Angle by which the points lie inside the edges, on the tissue [rad]",
            "range": (0.005, 0.2),
        },
    )
    minimum_confidence: float = field(
        default=0.4,
        metadata={
            "description": "Confidence that a dark part is a gap, below which it is taken for shade [-]",
            "range": (0.0, 1.0),
        },
    )
    minimum_width: float = field(
        default=0.08,
        metadata={
            "description": "Angle across the gap below which it is no gap [rad]",
            "range": (0.001, 1.0),
        },
    )
    field_margin: float = field(
        default=0.03,
        metadata={
            "description": "Part of the field's radius at its rim in which nothing is looked for [-]",
            "range": (0.0, 0.5),
        },
    )
    error_factor: float = field(
        default=3.0,
        metadata={
            "description": "angular_error in standard deviations along the worse direction [-]",
            "range": (1.0, 10.0),
        },
    )
    maximum_angular_error: float = field(
        default=0.12,
        metadata={
            "description": "angular_error above which the points are not valid [rad]",
            "range": (0.001, 1.0),
        },
    )
    maximum_unseen: float = field(
        default=0.7,
        metadata={
            "description": "Time for which a hidden point is carried on before the track ends [s]",
            "range": (0.0, 10.0),
        },
    )
    profile_period: float = field(
        default=0.2,
        metadata={
            "description": "Time between two looks at more sections along the opening [s]",
            "range": (0.0, 60.0),
        },
    )
    instrument_diameter: float = field(
        default=0.0,
        metadata={
            "description": "Diameter of the instrument that the overlay draws in the opening; 0: none [m]",
            "range": (0.0, 0.02),
        },
    )
    frozen_images: int = field(
        default=3,
        metadata={
            "description": "Identical images in a row from which the video counts as frozen [-]",
            "range": (2, 1000),
        },
    )

    def __post_init__(self) -> None:
        check_parameters(self)
        for name, length in (
            ("network_input_size", 2),
            ("network_mean", 3),
            ("network_scale", 3),
            ("region_centre", 2),
        ):
            if len(getattr(self, name)) != length:
                raise PerceptionError(f"{name} must have {length} numbers, not {len(getattr(self, name))}")
        if STRATEGIES[self.segmentation].needs_network and not self.network_path:
            raise PerceptionError(
                f"network_path must name an ONNX file for the segmentation '{self.segmentation}'"
            )

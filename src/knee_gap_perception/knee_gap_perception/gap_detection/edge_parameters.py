"""Parameters of the detection and tracking of the gap's edges."""

from dataclasses import dataclass, field
from math import nan

from knee_gap_perception.errors import PerceptionError
from knee_gap_perception.parameters import check_parameters
from knee_gap_perception.segmentation.choice import STRATEGIES


@dataclass(frozen=True)
class EdgeParameters:
    """Parameters of the detection of the gap and of the selection and tracking of its two points.

    Raises PerceptionError for values outside their range.
    """

    segmentation: str = field(
        default="watershed",
        metadata={"description": "Segmentation method for the dark gap", "choices": tuple(STRATEGIES)},
    )
    network_path: str = field(
        default="",
        metadata={
            "description": "ONNX file for the segmentation 'onnx': image in, gap out; or other "
            "weights of 'learned'"
        },
    )
    network_input_size: tuple[int, ...] = field(
        default=(256, 256),
        metadata={"description": "Width and height of the network's input [px]", "range": (8, 4096)},
    )
    network_mean: tuple[float, ...] = field(
        default=(0.0, 0.0, 0.0),
        metadata={
            "description": "Subtracted from red, green, blue before the network",
            "range": (-1000.0, 1000.0),
        },
    )
    network_scale: tuple[float, ...] = field(
        default=(1 / 255, 1 / 255, 1 / 255),
        metadata={"description": "Multiplied with red, green, blue after that", "range": (0.0, 1000.0)},
    )
    working_rows: int = field(
        default=180, metadata={"description": "Image rows of the segmentation [px]", "range": (90, 2160)}
    )
    region_centre: tuple[float, ...] = field(
        default=(nan, nan),
        metadata={
            "description": "Column and row of the region of interest's centre [px]; NaN: the field's centre",
            "range": (0.0, 16384.0),
            "nan": True,
        },
    )
    region_radius: float = field(
        default=0.55,
        metadata={"description": "Its radius relative to the field of view's [-]", "range": (0.02, 2.0)},
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
            "description": "Least confidence of a gap [-]; a dark part with less counts as shade",
            "range": (0.0, 1.0),
        },
    )
    minimum_width: float = field(
        default=0.08,
        metadata={
            "description": "Least angle across a gap [rad]",
            "range": (0.001, 1.0),
        },
    )
    field_margin: float = field(
        default=0.03,
        metadata={
            "description": "Width of the ignored rim of the field, relative to its radius [-]",
            "range": (0.0, 0.5),
        },
    )
    error_factor: float = field(
        default=3.0,
        metadata={
            "description": "Standard deviations, along the worst direction, that make angular_error [-]",
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
            "description": "Time for which a hidden point is predicted before the track ends [s]",
            "range": (0.0, 10.0),
        },
    )
    profile_period: float = field(
        default=0.2,
        metadata={
            "description": "Time between two searches for more sections along the opening [s]",
            "range": (0.0, 60.0),
        },
    )
    instrument_diameter: float = field(
        default=0.0,
        metadata={
            "description": "Diameter of the instrument drawn by the overlay in the opening [m]; 0: none",
            "range": (0.0, 0.02),
        },
    )
    frozen_images: int = field(
        default=3,
        metadata={
            "description": "Number of identical images in a row after which the video counts as frozen [-]",
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

"""The calibration that a node uses, and the medium that the scope is used in: named by parameters."""

from dataclasses import dataclass, field

from knee_gap_core.user_files import FileError, expanded
from knee_gap_perception.calibration.calibration import Calibration
from knee_gap_perception.calibration.calibration_file import load_calibration
from knee_gap_perception.camera.medium import CHOICES, Medium, medium_of
from knee_gap_perception.errors import PerceptionError
from knee_gap_perception.parameters import check_parameters


@dataclass(frozen=True)
class CalibrationParameters:
    """Which calibration is used, in which medium, and whether the scope is turned.

    Raises PerceptionError for a bad value.
    """

    calibration_file: str = field(
        default="",
        metadata={
            "description": "File that `calibrate` wrote: lens on the body, clock and camera; the same for "
            "segmentation_node and tracking_node; empty: none"
        },
    )
    medium: str | float = field(
        default="saline",
        metadata={
            "description": f"What the scope is used in: {CHOICES}; angles of a camera that was calibrated in "
            "another medium are converted; the same for segmentation_node and tracking_node"
        },
    )
    scope_rotation_notch: bool = field(
        default=False,
        metadata={
            "description": "Whether the notch in each image tells how far an oblique scope is turned in its "
            "camera head; the same for segmentation_node and tracking_node; needs a calibration_file of "
            "`calibrate oblique`"
        },
    )

    def __post_init__(self) -> None:
        check_parameters(self)
        if not isinstance(self.scope_rotation_notch, bool):
            raise PerceptionError(
                f"scope_rotation_notch must be true or false, not {self.scope_rotation_notch!r}"
            )
        medium_of(self.medium, "medium")

    @property
    def used_in(self) -> Medium:
        """The medium that the scope is used in."""
        return medium_of(self.medium, "medium")

    def load(self) -> Calibration | None:
        """The calibration, None where none is named. Raises PerceptionError where it cannot be used."""
        if not self.calibration_file:
            return None
        try:
            path = expanded(self.calibration_file)
        except FileError as error:
            raise PerceptionError(f"calibration_file: {error}") from None
        return load_calibration(path)


def hash_or_none(calibration: Calibration | None) -> str:
    """What diagnostics say of the calibration: its hash, or "none"."""
    return calibration.hash if calibration is not None else "none"

"""Parameters of the calibration in use: its file, the medium of use, and the scope's rotation."""

from dataclasses import dataclass, field

from knee_gap_core.user_files import FileError, expanded
from knee_gap_perception.calibration.calibration import Calibration
from knee_gap_perception.calibration.calibration_file import load_calibration
from knee_gap_perception.camera.medium import CHOICES, Medium, medium_of
from knee_gap_perception.errors import PerceptionError
from knee_gap_perception.parameters import check_parameters


@dataclass(frozen=True)
class CalibrationParameters:
    """Calibration file, medium of use, and whether the rotation of the scope is tracked.

    Raises PerceptionError for a bad value.
    """

    calibration_file: str = field(
        default="",
        metadata={
            "description": "File written by `calibrate`: lens on the body, clock and camera; the same for "
            "segmentation_node and tracking_node; empty: none"
        },
    )
    medium: str | float = field(
        default="saline",
        metadata={
            "description": f"Medium in which the scope is used: {CHOICES}; angles of a camera calibrated in "
            "another medium are converted; the same for segmentation_node and tracking_node"
        },
    )
    scope_rotation_notch: bool = field(
        default=False,
        metadata={
            "description": "Whether the rotation of an oblique scope in its camera head is measured by the "
            "notch in each image; the same for segmentation_node and tracking_node; needs a "
            "calibration_file of `calibrate oblique`"
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
        """The medium in which the scope is used."""
        return medium_of(self.medium, "medium")

    def load(self) -> Calibration | None:
        """The calibration, None if no file is named. Raises PerceptionError if it cannot be used."""
        if not self.calibration_file:
            return None
        try:
            path = expanded(self.calibration_file)
        except FileError as error:
            raise PerceptionError(f"calibration_file: {error}") from None
        return load_calibration(path)


def hash_or_none(calibration: Calibration | None) -> str:
    """Text for the diagnostics: the hash of the calibration, or "none"."""
    return calibration.hash if calibration is not None else "none"

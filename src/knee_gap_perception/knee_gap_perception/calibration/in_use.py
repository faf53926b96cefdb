"""The calibration that a node uses: named by a parameter, read once."""

from dataclasses import dataclass, field
from pathlib import Path

from knee_gap_perception.calibration.calibration_file import Calibration, load_calibration
from knee_gap_perception.parameters import check_parameters


@dataclass(frozen=True)
class CalibrationParameters:
    """Which calibration is used."""

    calibration_file: str = field(
        default="",
        metadata={
            "description": "File that `calibrate` wrote: lens on the body, clock and camera; the same for "
            "segmentation_node and tracking_node; empty: none"
        },
    )

    def __post_init__(self) -> None:
        check_parameters(self)

    def load(self) -> Calibration | None:
        """The calibration, None where none is named. Raises PerceptionError where it cannot be used."""
        if not self.calibration_file:
            return None
        return load_calibration(Path(self.calibration_file).expanduser())


def hash_or_none(calibration: Calibration | None) -> str:
    """What diagnostics say of the calibration: its hash, or "none"."""
    return calibration.hash if calibration is not None else "none"

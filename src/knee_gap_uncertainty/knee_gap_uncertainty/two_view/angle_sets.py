"""The angles of the triangle under admitted errors: equations (17)-(20).

(17) and (18) add +-psi to the angles at both lenses. Read literally that is every combination of signs,
`all`; Table 4 of the paper follows only without any, `none`. `same` and `opposite` are the two halves of
`all`.
"""

from typing import Literal, TypeAlias

import numpy as np
import numpy.typing as npt

from knee_gap_core.compiled import compiled

Signs: TypeAlias = Literal["none", "same", "opposite", "all"]
Interval: TypeAlias = Literal["worst_case", "paper"]

# Rows: factors of psi at the ray's own lens and at the other lens.
SIGNS: dict[str, npt.NDArray[np.float64]] = {
    "none": np.array([[0.0, 0.0]]),
    "same": np.array([[1.0, 1.0], [-1.0, -1.0]]),
    "opposite": np.array([[1.0, -1.0], [-1.0, 1.0]]),
    "all": np.array([[1.0, 1.0], [1.0, -1.0], [-1.0, 1.0], [-1.0, -1.0]]),
}
INTERVAL_SIGNS: dict[str, str] = {"worst_case": "all", "paper": "none"}


@compiled
def perturbed_angles(
    angles: tuple[float, float], signs: npt.NDArray[np.float64], angular_error: float
) -> tuple[float, float]:
    """Angles alpha' and beta' [rad], (17) and (18), from the angles to t' and one row of signs of psi."""
    return angles[0] + signs[0] * angular_error, angles[1] + signs[1] * angular_error


def angle_changes(
    angles: npt.NDArray[np.float64], perturbed: npt.NDArray[np.float64]
) -> npt.NDArray[np.float64]:
    """Changes Delta alpha or Delta beta [rad], (19) and (20), in the sense of (8): perturbed less measured.

    The paper prints measured minus perturbed, which would shorten a ray where the perturbed angles lengthen
    it.
    """
    return perturbed - angles

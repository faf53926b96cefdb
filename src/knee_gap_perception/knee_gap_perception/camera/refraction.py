"""Refraction at the flat window of a scope: a camera calibrated in one medium and used in another."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from knee_gap_core.values.arrays import Array
from knee_gap_perception.camera.camera import Camera, Coarseness
from knee_gap_perception.camera.window_kernel import refracted_rays
from knee_gap_perception.errors import PerceptionError


def refracted(bearings: npt.ArrayLike, index_ratio: float) -> Array:
    """Unit vectors (..., 3) after a window across the z axis of rays along directions (..., 3) of any length.

    `index_ratio` is the sine of the angle after the window to that before it. NaN for directions along or
    against the window and for rays that it reflects totally.
    """
    given = np.asarray(bearings, dtype=np.float64)
    flat = np.ascontiguousarray(given.reshape(-1, 3))
    return refracted_rays(flat, float(index_ratio)).reshape(given.shape)


@dataclass(frozen=True)
class RefractedCamera(Coarseness):
    """A camera of any model, calibrated in one medium and used in another, behind a flat window.

    The window is perpendicular to the view, and the pupil close behind it: a pixel keeps its azimuth about
    the z axis, and sin(angle in use) = `index_ratio` * sin(angle of `camera`), with the ratio of the
    refractive indices n_calibration / n_use. Rays that meet no window, or that it reflects totally, are
    outside the model. Raises PerceptionError for a ratio that is not a positive number.
    """

    camera: Camera
    index_ratio: float

    def __post_init__(self) -> None:
        if not 0.0 < self.index_ratio < np.inf:
            raise PerceptionError(
                f"the ratio of refractive indices must be above 0 and finite, not {self.index_ratio}"
            )

    @property
    def width_px(self) -> int:
        """Columns of the image."""
        return self.camera.width_px

    @property
    def height_px(self) -> int:
        """Rows of the image."""
        return self.camera.height_px

    def bearings(self, pixels: npt.ArrayLike) -> Array:
        """Unit vectors (..., 3) in use seen at pixels (..., 2); NaN outside the model."""
        return refracted(self.camera.bearings(pixels), self.index_ratio)

    def pixels(self, bearings: npt.ArrayLike) -> Array:
        """Pixels (..., 2) at which directions (..., 3) in use are seen; NaN outside the model."""
        return self.camera.pixels(refracted(bearings, 1.0 / self.index_ratio))


def camera_in_medium(camera: Camera, index_ratio: float) -> Camera:
    """The camera with the sines of all angles multiplied by `index_ratio`; itself for 1."""
    return camera if index_ratio == 1.0 else RefractedCamera(camera, index_ratio)

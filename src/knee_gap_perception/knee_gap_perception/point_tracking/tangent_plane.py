"""The tangent plane of the surface at a tracked point, learnt from how its picture moves and changes shape.

In the lens frame of the first image the plane is m . X = 1, so the inverse distance along a unit bearing b is
m . b. Another lens, moved by t and turned by R, sees the bearing b of the plane along R^T (I - t m^T) b: the
homography that a plane induces (Hartley and Zisserman, 13.1). m is a Gaussian with mean (3,) [1/m].
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from knee_gap_core.values.arrays import Array
from knee_gap_core.values.poses import LensPose
from knee_gap_perception.camera.camera import Camera
from knee_gap_perception.point_tracking.patch_registration import Warp
from knee_gap_perception.point_tracking.plane_kernel import directions_of, learnt_plane, prediction_of

TYPICAL_DISTANCE = 0.012  # [m] from lens to tissue in a joint
DISTANCE_SPREAD = 0.6  # [-] standard deviation of the inverse distance, against the typical one
SLOPE_SPREAD = 1.5  # [-] standard deviation of the tangent of the surface's slant
SHAPE_NOISE = 0.03  # [-] of a patch's shape: the surface is not a plane
MEMORY = 0.15  # [-] travel, against the distance, over which registrations are taken for one observation
LEAST_TRAVEL = 0.01  # [-] travel, against the distance, from which a registration adds information
FARTHEST_PX = 1e6  # [px] from the image, beyond which a prediction is not used
DIFFERENCE = 4.0  # [px] between the points whose images give the shape
CORNERS = DIFFERENCE * np.array([[0, 0], [1, 0], [-1, 0], [0, 1], [0, -1]], float)
STEP = 0.01 / TYPICAL_DISTANCE  # [1/m] between the planes whose images give the derivatives
PLANE_STEPS = STEP * np.concatenate([np.zeros((1, 3)), np.eye(3), -np.eye(3)])


@dataclass(frozen=True)
class View:
    """A lens: its pose in the world (4, 4), and deviations of position [m] and rotation [rad]."""

    T_world_lens: Array
    position_error: float
    rotation_error: float

    @classmethod
    def of(cls, pose: LensPose) -> "View":
        """The view of a tracked lens; its errors are those of the worst axis."""
        covariance = np.asarray(pose.covariance, dtype=np.float64)
        return cls(
            np.asarray(pose.matrix(), dtype=np.float64),
            float(np.sqrt(max(np.linalg.eigvalsh(covariance[:3, :3])[-1], 0.0))),
            float(np.sqrt(max(np.linalg.eigvalsh(covariance[3:, 3:])[-1], 0.0))),
        )


@dataclass(frozen=True)
class Prediction:
    """A patch in a new image: its warp, its parameters' covariance (6, 6) and change with m (6, 3).

    `parallax` (2,) [px]: how far it has moved because the lens did, and not by a turn of it.
    """

    warp: Warp
    covariance: Array
    jacobian: Array
    parallax: Array


class TangentPlane:
    """Gaussian estimate of the tangent plane at a point, in the lens frame of the first view."""

    def __init__(self, bearing: Array, view: View) -> None:
        """Start with a surface across the bearing (3,) at a typical distance."""
        self._first = view
        self._learnt_at = view.T_world_lens[:3, 3]
        self.mean = bearing / TYPICAL_DISTANCE
        along = np.outer(bearing, bearing)
        self.covariance = (
            DISTANCE_SPREAD**2 * along + SLOPE_SPREAD**2 * (np.eye(3) - along)
        ) / TYPICAL_DISTANCE**2
        self._prior_information = np.linalg.inv(self.covariance)

    def predict(self, camera: Camera, anchor: View, anchor_pixel: Array, view: View) -> Prediction | None:
        """Where a patch of an earlier view is seen from another; None outside the camera's model.

        None as well where the numbers lead to none, as with poses that no tracker gives.
        """
        with np.errstate(all="ignore"):
            prediction = self._predict(camera, anchor, anchor_pixel, view)
        if prediction is None or not np.isfinite(prediction.covariance).all():
            return None
        return prediction if np.abs(prediction.warp.position).max() < FARTHEST_PX else None

    def _predict(self, camera: Camera, anchor: View, anchor_pixel: Array, view: View) -> Prediction | None:
        bearings = _corner_bearings(camera, float(anchor_pixel[0]), float(anchor_pixel[1]))
        poses = (self._first.T_world_lens, anchor.T_world_lens, view.T_world_lens)
        pixels = camera.pixels(directions_of(self.mean + PLANE_STEPS, bearings, *poses))
        if not np.isfinite(pixels).all():
            return None
        noise = self._position_noise(camera, pixels[0], anchor, view)
        position, shape, covariance, jacobian, parallax = prediction_of(
            pixels, self.covariance, noise, SHAPE_NOISE, DIFFERENCE, STEP
        )
        return Prediction(Warp(position, shape), covariance, jacobian, parallax)

    def learn(self, prediction: Prediction, found: Array, covariance: Array, view: View) -> None:
        """Take registered parameters (6,) and their covariance (6, 6), whose prior was the prediction.

        Registrations of one patch are wrong in the same way: by the light that moved, by relief that is no
        plane. They are not independent observations, however many images there are. So the plane forgets as
        the lens travels, and takes in as much as it forgets: it knows what one registration from here
        measures.
        """
        lens = view.T_world_lens[:3, 3]
        moved = float(np.linalg.norm(lens - self._learnt_at) * np.linalg.norm(self.mean))
        if moved < LEAST_TRAVEL:
            return
        self._learnt_at = lens
        try:
            learnt = learnt_plane(
                self.mean,
                self.covariance,
                self._prior_information,
                prediction.jacobian,
                (prediction.warp.parameters, prediction.covariance),
                (found, covariance),
                float(np.exp(-moved / MEMORY)),
            )
        except np.linalg.LinAlgError:
            return  # nothing can be learnt from numbers that are singular to the last digit
        if all(np.isfinite(values).all() for values in learnt):
            self.mean, self.covariance = learnt

    def _position_noise(self, camera: Camera, pixel: Array, anchor: View, view: View) -> float:
        """Standard deviation of the position [px] by the errors of both poses."""
        inverse_distance = float(np.linalg.norm(self.mean))
        angle = np.hypot(
            inverse_distance * np.hypot(anchor.position_error, view.position_error),
            np.hypot(anchor.rotation_error, view.rotation_error),
        )
        return float(angle / camera.radians_per_pixel(pixel))


@lru_cache(maxsize=64)
def _corner_bearings(camera: Camera, column: float, row: float) -> Array:
    """Bearings (5, 3) at a pixel of an anchor, which stays the same, and around it."""
    return camera.bearings(np.array([column, row]) + CORNERS)

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
        seen = self._see(self.mean + PLANE_STEPS, bearings, anchor, view)
        turned = bearings[0] @ anchor.T_world_lens[:3, :3].T @ view.T_world_lens[:3, :3]
        every = camera.pixels(np.concatenate([seen.reshape(-1, 3), turned[None]]))
        if not np.isfinite(every).all():
            return None
        pixels = every[:-1].reshape(*seen.shape[:2], 2)
        parallax = pixels[0, 0] - every[-1]
        shape_x = (pixels[:, 1] - pixels[:, 2]) / (2 * DIFFERENCE)
        shape_y = (pixels[:, 3] - pixels[:, 4]) / (2 * DIFFERENCE)
        shapes = np.stack([shape_x, shape_y], axis=-1)
        parameters = np.concatenate([pixels[:, 0], shapes.reshape(-1, 4)], axis=1)
        jacobian = ((parameters[1:4] - parameters[4:7]) / (2 * STEP)).T
        noise = self._pose_noise(camera, parameters[0, :2], anchor, view)
        covariance = jacobian @ self.covariance @ jacobian.T + noise
        return Prediction(Warp(parameters[0, :2], shapes[0]), covariance, jacobian, parallax)

    def learn(self, prediction: Prediction, found: Array, covariance: Array, view: View) -> None:
        """Take registered parameters (6,) and their covariance (6, 6), whose prior was the prediction.

        Registrations of one patch are wrong in the same way: by the light that moved, by relief that is no
        plane. They are no independent observations, however many images there are. So the plane forgets as
        the lens travels, and takes in as much as it forgets: it knows what one registration from here
        measures.
        """
        lens = view.T_world_lens[:3, 3]
        moved = float(np.linalg.norm(lens - self._learnt_at) * np.linalg.norm(self.mean))
        if moved < LEAST_TRAVEL:
            return
        self._learnt_at = lens
        try:
            learnt = self._learnt(prediction, found, covariance, float(np.exp(-moved / MEMORY)))
        except np.linalg.LinAlgError:
            return  # nothing can be learnt from numbers that are singular to the last digit
        if all(np.isfinite(values).all() for values in learnt):
            self.mean, self.covariance = learnt

    def _learnt(
        self, prediction: Prediction, found: Array, covariance: Array, kept: float
    ) -> tuple[Array, Array]:
        """The mean and covariance of the plane after a registration, `kept` [0, 1] of what was known."""
        prior = np.linalg.inv(prediction.covariance)
        learned = (1.0 - kept) * (np.linalg.inv(covariance) - prior)
        predicted = np.concatenate([prediction.warp.position, prediction.warp.shape.reshape(-1)])
        posterior = np.linalg.inv(prior + learned)
        change = (1.0 - kept) * posterior @ np.linalg.solve(covariance, found - predicted)
        gain = self.covariance @ prediction.jacobian.T @ prior
        mean = self.mean + gain @ change
        updated = self.covariance - gain @ (prediction.covariance - posterior) @ gain.T
        information = kept * np.linalg.inv((updated + updated.T) / 2) + (1.0 - kept) * self._prior_information
        loosened = np.linalg.inv(information)
        return mean, (loosened + loosened.T) / 2

    def _see(self, planes: Array, bearings: Array, anchor: View, view: View) -> Array:
        """Directions (m, n, 3) from a view, to points of planes (m, 3) along bearings (n, 3) of an anchor."""
        T_first_anchor = _inverse(self._first.T_world_lens) @ anchor.T_world_lens
        R, t = T_first_anchor[:3, :3], T_first_anchor[:3, 3]
        local = planes @ R / (1.0 - planes @ t)[:, None]
        T_anchor_view = _inverse(anchor.T_world_lens) @ view.T_world_lens
        inverse_distances = local @ bearings.T
        moved = bearings - inverse_distances[..., None] * T_anchor_view[:3, 3]
        # Inverse distances below zero lie behind the lens.
        return np.where((inverse_distances > 0)[..., None], moved @ T_anchor_view[:3, :3], np.nan)

    def _pose_noise(self, camera: Camera, pixel: Array, anchor: View, view: View) -> Array:
        """What the errors of both poses do to the parameters (6, 6)."""
        inverse_distance = float(np.linalg.norm(self.mean))
        angle = np.hypot(
            inverse_distance * np.hypot(anchor.position_error, view.position_error),
            np.hypot(anchor.rotation_error, view.rotation_error),
        )
        error_px = angle / camera.radians_per_pixel(pixel)
        return np.diag([error_px**2] * 2 + [SHAPE_NOISE**2] * 4)


@lru_cache(maxsize=64)
def _corner_bearings(camera: Camera, column: float, row: float) -> Array:
    """Bearings (5, 3) at a pixel of an anchor, which stays the same, and around it."""
    return camera.bearings(np.array([column, row]) + CORNERS)


def _inverse(T: Array) -> Array:
    """Inverse of a rigid transform (4, 4)."""
    inverse = np.eye(4)
    inverse[:3, :3] = T[:3, :3].T
    inverse[:3, 3] = -T[:3, :3].T @ T[:3, 3]
    return inverse

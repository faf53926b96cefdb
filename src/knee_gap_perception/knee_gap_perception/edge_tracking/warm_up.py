"""Warm-up of the edge tracking: loads and compiles all of its code before the first real image."""

import cv2
import numpy as np
import numpy.typing as npt

from knee_gap_core.values import quaternions
from knee_gap_core.values.edges import EdgeStatus
from knee_gap_perception.camera.models import FisheyeCamera
from knee_gap_perception.edge_tracking.edge_tracker import GapEdgeTracker
from knee_gap_perception.point_tracking.tangent_plane import TangentPlane, View

HEIGHT, WIDTH = 720, 1280
RADIUS = 350
FOCAL = 458.0


def picture(shift: int) -> npt.NDArray[np.uint8]:
    """Image of speckled tissue around a dark gap in a round field of view, shifted by `shift` [px]."""
    rng = np.random.default_rng(1)
    speckle = cv2.GaussianBlur(rng.normal(0.0, 1.0, (HEIGHT, WIDTH)), (0, 0), 4.0)
    tissue = 150.0 + 25.0 * speckle / speckle.std()
    tissue[300:400] = 8.0
    tissue = np.roll(cv2.GaussianBlur(tissue, (0, 0), 1.5), shift, axis=1)
    rows, columns = np.ogrid[:HEIGHT, :WIDTH]
    outside = np.hypot(rows - HEIGHT / 2, columns - WIDTH / 2) > RADIUS
    tissue[outside] = 0.0
    return np.repeat(np.clip(tissue, 0, 255).astype(np.uint8)[..., None], 3, axis=2)


def warm_up() -> EdgeStatus:
    """Detect a gap and track its edges in a few images; return the last status, VALID if all code was run."""
    quaternions.warm_up()
    camera = FisheyeCamera(WIDTH, HEIGHT, FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2, (0.0, 0.0, 0.0, 0.0))
    detector = GapEdgeTracker()
    status = EdgeStatus.UNKNOWN
    for k in range(4):
        status = detector.process(1 + 16_666_667 * k, picture(2 * k), camera).status
    _follow_a_plane(camera)
    return status


def _follow_a_plane(camera: FisheyeCamera) -> None:
    """Run what is used once there are poses of the lens."""
    pixel, moved = np.array([WIDTH / 2, HEIGHT / 2 + 60.0]), np.eye(4)
    moved[0, 3] = 1e-3
    first, view = (View(pose, 1e-5, 1e-5) for pose in (np.eye(4), moved))
    plane = TangentPlane(camera.bearings(pixel), first)
    prediction = plane.predict(camera, first, pixel, view)
    assert prediction is not None
    plane.learn(prediction, prediction.warp.parameters, prediction.covariance, view)

"""Error of a gap in saline by a calibration in air, without and with the conversion of its angles.

    tools/env python bench/bench_medium.py --scenes 400 --tracks 2

First by two views, as the paper measures, the scope pivoting `arm` behind its tip: median and 5-95 % of the
error of points 4 mm apart, where the points stay in view. Then whole tracks through the estimator: without
and with the conversion; with it behind windows that are not perfect (index drawn from 1.330-1.340, tilt and
depth of the pupil as the camera's errors have them); and calibrated in saline. Ends with 1 where the median
error with the conversion at a perfect window is above 1 %, or a valid estimate does not hold the truth.
"""

import argparse
import sys
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from knee_gap_core.values.arrays import Array
from knee_gap_core.values.edges import GapEdges
from knee_gap_core.values.gap_estimate import GapEstimate, GapStatus
from knee_gap_core.values.poses import LensPose
from knee_gap_perception.camera.camera import Camera, bearing_jacobian
from knee_gap_perception.camera.camera_errors import WINDOW_TILT, CameraErrors, pupil_shift
from knee_gap_perception.camera.camera_info import camera_from_info
from knee_gap_perception.camera.medium import AIR, SALINE
from knee_gap_perception.camera.refraction import camera_in_medium
from knee_gap_simulation.recordings.recording import camera_info_message
from knee_gap_simulation.scope.lens import Lens
from knee_gap_uncertainty.estimation.estimator import GapEstimator
from knee_gap_uncertainty.scope_calibration.scope_calibration import ScopeCalibration

GAP = 0.004
ENDS = ("min", "max")
ARMS = (np.inf, 0.090, 0.060, 0.040)
TRAVELS = (0.004, 0.008)
DEPTHS = (0.008, 0.012, 0.016)
NOISE = np.radians(0.05)  # of a point in the picture, an axis
TRACKER = 0.0367e-3, np.radians(0.004)  # RMS [m], [rad]
RATE_HZ, IMAGES = 15.0, 40
LENS = Lens()
CAMERA = camera_from_info(camera_info_message(LENS))
IN_SALINE = camera_in_medium(CAMERA, AIR.ratio_to(SALINE))
# Before: the angles of the calibration as they are. After: those of saline.
CAMERAS = {"before": CAMERA, "after": IN_SALINE}


class Way(NamedTuple):
    """How tracks are measured: the camera, its errors, the lens's error along its view [m], the windows."""

    name: str
    camera: Camera
    errors: CameraErrors
    shift: float
    drawn_windows: bool


WAYS = (
    Way("before", CAMERA, CameraErrors(CAMERA, [], AIR, AIR), 0.0, False),
    Way("after", IN_SALINE, CameraErrors(CAMERA, [], AIR, SALINE), pupil_shift(AIR, SALINE), False),
    Way(
        "after, windows drawn",
        IN_SALINE,
        CameraErrors(CAMERA, [], AIR, SALINE),
        pupil_shift(AIR, SALINE),
        True,
    ),
    Way("calibrated in saline", IN_SALINE, CameraErrors(IN_SALINE, [], SALINE, SALINE), 0.0, False),
)
PIXEL_NOISE = NOISE / IN_SALINE.radians_per_pixel([640, 360])


class Window(NamedTuple):
    """A window before the lens: the index outside, its normal (3,), how far the pupil lies behind it [m]."""

    outside: float = 1.336
    normal: Array = np.array([0.0, 0.0, 1.0])
    depth: float = 0.0

    @staticmethod
    def drawn(rng: np.random.Generator) -> "Window":
        """A window as the camera's errors have them."""
        lean = np.append(WINDOW_TILT * rng.standard_normal(2), 1.0)
        return Window(rng.uniform(1.330, 1.340), lean / np.linalg.norm(lean), rng.uniform(0.0, 1.5e-3))

    def pixels(self, points: Array) -> Array:
        """Pixels (n, 2) of points (n, 3) in the frame of the pupil, as a calibration in air has it."""
        # The ray that leaves the pupil for a place of the window, bent there, has to meet the point.
        ray = points / points[:, 2:]
        for _ in range(40):
            origin = self.depth * ray / ray[:, 2:]
            towards = points - origin
            towards /= np.linalg.norm(towards, axis=1, keepdims=True)
            along = self.outside * (towards - (towards @ self.normal)[:, None] * self.normal)
            ahead = np.sqrt(1.0 - (along**2).sum(axis=1, keepdims=True))
            ray = along + ahead * self.normal
        return LENS.pixels(ray)


def scene(rng: np.random.Generator, depth: float) -> Array:
    """Two points (2, 3), GAP apart, about the middle of the view, across the travel within 40 degrees."""
    turn, tilt = rng.uniform(-0.7, 0.7, 2)
    half = 0.5 * GAP * np.array([np.sin(turn), np.cos(turn) * np.cos(tilt), np.cos(turn) * np.sin(tilt)])
    middle = np.append(rng.uniform(-1e-3, 1e-3, 2), depth)
    return np.array([middle - half, middle + half])


def pose(along: float, arm: float) -> tuple[Array, Array]:
    """Position (3,) and rotation (3, 3) of a lens that has come `along` [m], turned about its portal."""
    turn = 0.0 if np.isinf(arm) else np.arctan2(along, arm)
    return np.array([along, 0.0, 0.0]), Rotation.from_rotvec([0.0, turn, 0.0]).as_matrix()


def midpoint_gap(lenses: Array, bearings: Array) -> float:
    """Distance of two points by two views (2, 3), (2, 2, 3): the middles between the rays of each."""
    points = []
    for n in (0, 1):
        a, b = bearings[:, n]
        system = np.array([[a @ a, -a @ b], [a @ b, -b @ b]])
        s, t = np.linalg.solve(system, [(lenses[1] - lenses[0]) @ a, (lenses[1] - lenses[0]) @ b])
        points.append((lenses[0] + s * a + lenses[1] + t * b) / 2.0)
    return float(np.linalg.norm(points[1] - points[0]))


def two_views(rng: np.random.Generator, depth: float, travel: float, arm: float) -> dict[str, float]:
    """Relative error of the gap of one scene, by each camera."""
    points, window = scene(rng, depth), Window()
    poses = [pose(along, arm) for along in (-travel / 2, travel / 2)]
    lenses = np.array([position for position, _ in poses])
    pixels = np.array([window.pixels((points - position) @ turn) for position, turn in poses])
    pixels = pixels + PIXEL_NOISE * rng.standard_normal((2, 2, 2))
    reported = {}
    for name, camera in CAMERAS.items():
        bearings = np.array([camera.bearings(p) @ turn.T for p, (_, turn) in zip(pixels, poses, strict=True)])
        reported[name] = midpoint_gap(lenses, bearings) / GAP - 1.0
    return reported


def track(rng: np.random.Generator, way: Way, depth: float, travel: float, arm: float) -> list[GapEstimate]:
    """The estimates of a track, by a calibration with a lens known to 0.02 mm."""
    camera, window = way.camera, Window.drawn(rng) if way.drawn_windows else Window()
    estimator, points = GapEstimator(), scene(rng, depth)
    covariance = np.diag(np.repeat([(0.02e-3) ** 2 / 3, np.radians(0.015) ** 2 / 3], 3))
    covariance[2, 2] += way.shift**2
    estimator.add_calibration(ScopeCalibration("tracking_node", "a" * 64, covariance, 4e-5))
    pose_covariance = np.diag(np.repeat([TRACKER[0] ** 2 / 3, TRACKER[1] ** 2 / 3], 3))
    reported: list[GapEstimate] = []
    for k in range(IMAGES):
        stamp = 10**18 + round(k / RATE_HZ * 1e9)
        for late in (-2e-3, 2e-3):
            share = np.clip((k + late * RATE_HZ) / (IMAGES - 1), 0.0, 1.0)
            position, turn = pose(travel * (share - 0.5), arm)
            seen_from = position + TRACKER[0] / np.sqrt(3) * rng.standard_normal(3)
            turned = Rotation.from_rotvec(TRACKER[1] / np.sqrt(3) * rng.standard_normal(3)).as_matrix() @ turn
            quaternion = Rotation.from_matrix(turned).as_quat()
            at = stamp + round(late * 1e9)
            reported += estimator.add_pose(LensPose(at, "world", seen_from, quaternion, pose_covariance), at)
            if late > 0:
                continue
            position, turn = pose(travel * (k / (IMAGES - 1) - 0.5), arm)
            pixels = window.pixels((points - position) @ turn) + PIXEL_NOISE * rng.standard_normal((2, 2))
            bearings = camera.bearings(pixels)
            if not np.isfinite(bearings).all():
                continue
            jacobians = [bearing_jacobian(camera, pixel) for pixel in pixels]
            covariances = np.array([PIXEL_NOISE**2 * j @ j.T for j in jacobians])
            bound = 3.0 * PIXEL_NOISE * max(camera.radians_per_pixel(pixel) for pixel in pixels)
            edges = GapEdges.of_points(stamp, 1, bearings, covariances, bound)
            edges = replace(edges.with_rims_at_points(), camera_errors=way.errors.of(bearings))
            reported += estimator.add_edges(edges, stamp)
    return reported


def main(argv: Sequence[str] | None = None) -> int:
    """Print both tables."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--scenes", type=int, default=400, help="of each line by two views")
    parser.add_argument("--tracks", type=int, default=6, help="of each line through the estimator")
    parser.add_argument("--first", type=int, default=70500, help="first seed")
    arguments = parser.parse_args(argv)
    failed = False
    print("two views: error of the gap [%], median (5 .. 95)")
    for arm in ARMS:
        for travel in TRAVELS:
            line = f"arm {1e3 * arm:3.0f} mm, travel {1e3 * travel:.0f} mm:"
            for depth in DEPTHS:
                drawn = [
                    two_views(np.random.default_rng([seed, 1]), depth, travel, arm)
                    for seed in range(arguments.first, arguments.first + arguments.scenes)
                ]
                scenes = [one for one in drawn if np.isfinite(one["after"])]
                line += f" | {1e3 * depth:.0f} mm, {len(scenes)}"
                for name in CAMERAS if scenes else ():
                    low, middle, high = 100 * np.quantile([one[name] for one in scenes], [0.05, 0.5, 0.95])
                    line += f" {name} {middle:+.1f} ({low:+.1f} .. {high:+.1f})"
                    failed |= name == "after" and abs(middle) > 1.0
            print(line, flush=True)
    print("tracks: valid estimates, median error, bounds and 95 % interval held, their median widths")
    for arm in ARMS:
        for way in WAYS:
            found: list[GapEstimate] = []
            cells = [(travel, depth) for travel in TRAVELS for depth in DEPTHS]
            for number, (travel, depth) in enumerate(cells):
                for seed in range(arguments.first, arguments.first + arguments.tracks):
                    found += track(np.random.default_rng([seed, 2, number]), way, depth, travel, arm)
            valid = [one for one in found if one.status is GapStatus.VALID]
            # Of the two points, whose distance is known here.
            least, most = (np.array([getattr(one, f"point_distance_{end}") for one in valid]) for end in ENDS)
            lower, upper = (
                np.array([getattr(one, f"point_distance_confidence_{end}") for one in valid]) for end in ENDS
            )
            inside = int(((least <= GAP) & (most >= GAP)).sum())
            held = int(((lower <= GAP) & (upper >= GAP)).sum())
            failed |= not valid
            middle = 100 * float(np.median([one.point_distance / GAP - 1.0 for one in valid] or [np.nan]))
            interval = 1e3 * float(np.median(upper - lower)) if valid else np.nan
            bounds = 1e3 * float(np.median(most - least)) if valid else np.nan
            print(
                f"arm {1e3 * arm:3.0f} mm, {way.name}: {len(valid)} of {len(found)}, {middle:+.1f} %, "
                f"{inside} / {held} held, {bounds:.2f} / {interval:.2f} mm",
                flush=True,
            )
            failed |= way.name != "before" and inside < len(valid)
            failed |= way.name == "after" and abs(middle) > 1.0
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())

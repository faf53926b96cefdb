"""Points followed through real endoscope frames, against what others know of those frames.

Structure from motion: a rigid endoscope in a nose, whose poses and sparse points a reconstruction gives. Each
of these points is followed by its texture from the first image that shows it, with the poses, and compared
with where the reconstruction has it (reprojection), and with the line on which the poses alone put it
(epipolar). The reconstruction's own errors are in both. Its scale is not known: it is set to a usual depth.

Jitter: in the stretch of a laparoscope's video with the least motion points are followed by the images alone.
Their motion is smooth and much the same for neighbours, so what departs from the mean of the image before and
the image after, and from the median of all points in that, is jitter. Without the recordings nothing is done.
"""

import argparse
import sys
from collections.abc import Iterator, Sequence
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import numpy.typing as npt
from bench_real import RECORDINGS, pictures
from ruamel.yaml import YAML
from scipy.spatial.transform import Rotation

from knee_gap_core.values.arrays import Array, Image
from knee_gap_core.values.edges import EdgeStatus
from knee_gap_core.values.poses import LensPose, rigid_transform
from knee_gap_perception.camera.camera import Camera
from knee_gap_perception.camera.models import PinholeCamera
from knee_gap_perception.edge_tracking.edge_tracker import GapEdgeTracker
from knee_gap_perception.point_tracking.point_tracker import PointTracker
from knee_gap_perception.point_tracking.tangent_plane import View

DEPTH = 0.012  # [m] to which the median depth of the reconstruction is scaled
POSITION_ERROR, ROTATION_ERROR = 0.05e-3, np.radians(0.05)  # assumed of the reconstruction's poses [m], [rad]
DARK = 25.0  # [grey levels] below which a pixel shows no tissue
MARGIN = 80.0  # [px] from the border of the picture
LEAST_VIEWS = 4  # that show a point, its first included
STRETCH = 25  # images
FRAME_NS = 33_333_333


class Reconstruction(NamedTuple):
    """`poses` T_world_lens (n, 4, 4) [m], `points` (m, 3) [m], `seen` (n, m): which image shows which."""

    images: list[Image]
    camera: Camera
    poses: Array
    points: Array
    seen: npt.NDArray[np.bool_]


def main(argv: Sequence[str] | None = None) -> int:
    """Print the errors, and draw the tracks."""
    parser = argparse.ArgumentParser(prog="bench_real_tracks", description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--points", type=int, default=120, help="of the reconstruction, at most")
    parser.add_argument("--out", type=Path, default=Path("out/real_tracks.jpg"), help="picture to write")
    asked = parser.parse_args(argv)
    folder, video = RECORDINGS / "sinus_endoscope", RECORDINGS / "laparoscope_video" / "endo.mp4"
    if not (folder.exists() and video.exists()):
        print("bench_real_tracks: no real recordings here")
        return 0
    cv2.setNumThreads(1)
    scene = reconstruction(folder)
    against_reconstruction(scene, asked.points, asked.out)
    gap_points(scene)
    jitter(list(pictures(video)))
    return 0


def reconstruction(folder: Path) -> Reconstruction:
    """The images that are there, of a folder in the layout of EndoscopyDepthEstimation's examples."""
    numbers = [int(file.stem) for file in sorted(folder.glob("[0-9]*.jpg"))]
    images = list(pictures(folder))
    fx, fy, cx, cy = (float(word) for word in (folder / "camera_intrinsics_per_view").read_text().split())
    camera = PinholeCamera(images[0].shape[1], images[0].shape[0], fx, fy, cx, cy)
    visible = [int(word) for word in (folder / "visible_view_indexes").read_text().split()]
    # The file's "poses[]:" has no value of its own.
    text = (folder / "motion.yaml").read_text().replace("poses[]:", "poses:")
    formatted = YAML(typ="safe").load(text)["poses"]
    poses = []
    for number in numbers:
        pose = formatted[f"poses[{visible.index(number)}]"]
        position = [pose["position"][k] for k in "xyz"]
        poses.append(rigid_transform(position, [pose["orientation"][k] for k in "xyzw"]))
    lines = (folder / "structure.ply").read_text().split("end_header\n")[1].splitlines()
    views = np.array((folder / "view_indexes_per_point").read_text().split(), dtype=int)
    starts = np.flatnonzero(views == -1)
    points = np.array([[float(word) for word in line.split()] for line in lines[: len(starts)]])
    seen = np.zeros((len(numbers), len(points)), bool)
    for index, (begin, end) in enumerate(zip(starts, [*starts[1:], len(views)], strict=True)):
        seen[:, index] = np.isin(numbers, views[begin + 1 : end])
    T = np.stack(poses)
    scale = DEPTH / float(np.median((points - T[0, :3, 3]) @ T[0, :3, 2]))
    T[:, :3, 3] *= scale
    return Reconstruction(images, camera, T, points * scale, seen)


def projected(scene: Reconstruction, image: int, point: int) -> Array:
    """Pixel (2,) at which the reconstruction has a point."""
    T = scene.poses[image]
    ray = T[:3, :3].T @ (scene.points[point] - T[:3, 3])
    return scene.camera.pixels(ray / np.linalg.norm(ray))


def off_the_line(scene: Reconstruction, first: int, start: Array, image: int, pixel: Array) -> float:
    """Distance [px] of a pixel from the line on which the poses put a point of an earlier image."""
    T = np.linalg.inv(scene.poses[image]) @ scene.poses[first]
    ray = T[:3, :3] @ scene.camera.bearings(start)
    near, far = (T[:3, 3] + ray * depth for depth in (0.8 * DEPTH, 1.2 * DEPTH))
    a, b = (scene.camera.pixels(place / np.linalg.norm(place)) for place in (near, far))
    along = (b - a) / max(float(np.linalg.norm(b - a)), 1e-12)
    return float(abs(along[0] * (pixel - a)[1] - along[1] * (pixel - a)[0]))


def against_reconstruction(scene: Reconstruction, count: int, out: Path) -> None:
    """Follow the reconstruction's points; print the errors and draw the tracks."""
    greys = [np.asarray(cv2.extractChannel(image, 1), np.uint8) for image in scene.images]
    views = [View(pose, POSITION_ERROR, ROTATION_ERROR) for pose in scene.poses]
    usable = np.flatnonzero(scene.seen.sum(axis=0) >= LEAST_VIEWS)
    chosen = usable[np.unique(np.linspace(0, len(usable) - 1, count).astype(int))]
    drawn = scene.images[-1].copy()
    size = np.array([drawn.shape[1], drawn.shape[0]])
    errors, lines, held, nees, followed = [], [], [], [], 0
    for point in chosen:
        first = int(np.flatnonzero(scene.seen[:, point])[0])
        start = projected(scene, first, point)
        if (np.minimum(start, size - start) < MARGIN).any():
            continue
        followed += 1
        track = PointTracker(greys[first], start, DARK, scene.camera, views[first])
        path = [start]
        for image in range(first + 1, len(greys)):
            observation = track.follow(greys[image], scene.camera, views[image])
            if scene.seen[image, point]:
                held.append(observation.seen)
            if not observation.seen:
                continue
            path.append(observation.position)
            lines.append(off_the_line(scene, first, start, image, observation.position))
            if scene.seen[image, point]:
                away = observation.position - projected(scene, image, point)
                errors.append(float(np.linalg.norm(away)))
                nees.append(float(away @ np.linalg.solve(observation.covariance, away)) / 2)
        cv2.polylines(drawn, [np.rint(path).astype(np.int32)], False, (0, 255, 0), 2)
        cv2.circle(drawn, (round(path[-1][0]), round(path[-1][1])), 5, (0, 0, 255), 2)
    degrees = np.degrees(scene.camera.radians_per_pixel(size / 2))
    print(
        f"structure from motion: {followed} points through {len(greys)} images, seen in "
        f"{100 * np.mean(held):.0f} % of the images that show them\n"
        f"  reprojection {formatted(errors)} ({degrees:.3f} deg a pixel), NEES median {np.median(nees):.2f}\n"
        f"  epipolar     {formatted(lines)}"
    )
    out.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(out), drawn)
    print(f"{out}: the tracks, in the last image")


def gap_points(scene: Reconstruction) -> None:
    """The two points that are chosen beside the cleft, against the poses."""
    detector, lines, bounds, starts = GapEdgeTracker(), [], [], np.zeros((2, 2))
    begun: dict[int, int] = {}
    covariance = np.diag([POSITION_ERROR**2] * 3 + [ROTATION_ERROR**2] * 3)
    for index, image in enumerate(scene.images):
        T = scene.poses[index]
        quaternion = quaternion_of(T[:3, :3])
        pose = LensPose(index * FRAME_NS, "world", T[:3, 3], quaternion, covariance)
        edges = detector.process(index * FRAME_NS, image, scene.camera, pose)
        if edges.status is not EdgeStatus.VALID:
            continue
        if edges.track_id not in begun:
            begun[edges.track_id], starts = index, edges.pixels
            continue
        first = begun[edges.track_id]
        lines += [off_the_line(scene, first, starts[n], index, edges.pixels[n]) for n in range(2)]
        bounds += [edges.angular_error / scene.camera.radians_per_pixel(edges.pixels[n]) for n in range(2)]
    if lines:
        inside = 100 * np.mean(np.array(lines) <= np.array(bounds))
        print(
            f"beside the cleft: {len(begun)} tracks; epipolar {formatted(lines)}\n"
            f"  within angular_error, median {np.median(bounds):.1f} px, in {inside:.0f} %"
        )


def quaternion_of(rotation: Array) -> Array:
    """Quaternion x, y, z, w of a rotation matrix."""
    return np.asarray(Rotation.from_matrix(rotation).as_quat())


def jitter(images: list[Image]) -> None:
    """Print how much points jitter in the stretch with the least motion."""
    greys = [np.asarray(cv2.extractChannel(image, 1), np.uint8) for image in images]
    motion = np.array([moved(a, b) for a, b in pairwise(greys)])
    begin = int(np.argmin(np.convolve(motion, np.ones(STRETCH - 1), "valid")))
    stretch = greys[begin : begin + STRETCH]
    quiet = motion[begin : begin + STRETCH - 1]
    paths = np.stack(list(followed_alone(stretch)))
    bend = paths[:, 1:-1] - (paths[:, :-2] + paths[:, 2:]) / 2
    own = bend - np.nanmedian(bend, axis=0)
    # The mean of two neighbours has half of an image's variance.
    known = np.isfinite(own[..., 0]).any(axis=1)
    each = np.sqrt(np.nanmean((own[known] ** 2).sum(axis=-1), axis=1) / 1.5)
    seen = 100 * np.isfinite(paths[..., 0]).mean()
    print(
        f"laparoscope: least motion in images {begin} to {begin + STRETCH - 1}, {quiet.min():.1f} to "
        f"{quiet.max():.1f} px an image, never still\n"
        f"  {len(paths)} points by the images alone, seen in {seen:.0f} %; "
        f"jitter median {np.nanmedian(each):.2f} px, 90th percentile {np.nanpercentile(each, 90):.2f} px"
    )


def moved(before: Image, after: Image) -> float:
    """Median motion [px] of corners between two images."""
    corners = cv2.goodFeaturesToTrack(before, 200, 0.01, 15)
    found, known, _ = cv2.calcOpticalFlowPyrLK(before, after, corners, corners.copy())
    return float(np.median(np.linalg.norm((found - corners)[known[:, 0] == 1].reshape(-1, 2), axis=1)))


def followed_alone(greys: list[Image]) -> Iterator[Array]:
    """Paths (n, 2) [px] of textured places, NaN where they are not seen."""
    height, width = greys[0].shape
    camera = PinholeCamera(width, height, 0.8 * width, 0.8 * width, width / 2, height / 2)
    inside = np.zeros_like(greys[0])
    inside[round(MARGIN) : -round(MARGIN), round(MARGIN) : -round(MARGIN)] = 255
    inside[(greys[0] < 2 * DARK) | (greys[0] > 200)] = 0
    for corner in cv2.goodFeaturesToTrack(greys[0], 40, 0.02, 40, mask=inside)[:, 0]:
        start = np.asarray(corner, np.float64)
        track = PointTracker(greys[0], start, DARK, camera, None)
        path = [start]
        for grey in greys[1:]:
            observation = track.follow(grey, camera, None)
            path.append(observation.position if observation.seen else np.full(2, np.nan))
        yield np.stack(path)


def formatted(errors: Sequence[float]) -> str:
    """Median, root mean square of the better 95 %, and the worst twentieth."""
    values = np.sort(np.asarray(errors))
    kept = values[: max(1, int(0.95 * len(values)))]
    return (
        f"median {np.median(values):.2f} px, RMS {np.sqrt(np.mean(kept**2)):.2f} px of the better 95 %, "
        f"95th percentile {np.percentile(values, 95):.2f} px, {len(values)} sightings"
    )


if __name__ == "__main__":
    sys.exit(main())

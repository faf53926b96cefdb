"""Pictures of endoscopes with what is known of them: drawn here, and recorded by others.

Drawn are unevenly lit tissue on both sides of a dark cleft, glare, a soft circular border and a surround that
is not black; the picture is then compressed as JPEG or as a video.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
from recordings import BESIDE, RECORDED

from knee_gap_core.values.arrays import Image

RIGID_ENDOSCOPE = "images/sinus_endoscope/000*.jpg"
LAPAROSCOPE = "images/laparoscope_video/endo.mp4"


@dataclass(frozen=True)
class EndoscopeFrames:
    """Files of 1920x1080 frames in order, the disc that the scope shows [px], and fx, fy, cx, cy [px]."""

    files: Sequence[Path]
    centre: tuple[float, float]
    radius: float
    pinhole: tuple[float, float, float, float]


def rigid_endoscope(origin: str, folder: Path, count: int = 6) -> EndoscopeFrames:
    """`count` made or 16 recorded frames of a rigid endoscope whose whole disc is in the picture."""
    # The disc of the recorded ones by eye.
    centre, radius = (994.0, 544.5), 527.0
    if origin == RECORDED:
        files = sorted(BESIDE.glob(RIGID_ENDOSCOPE))
        words = (files[0].parent / "camera_intrinsics_per_view").read_text().split()
        fx, fy, cx, cy = (float(word) for word in words)
        return EndoscopeFrames(files, centre, radius, (fx, fy, cx, cy))
    texture, files = _texture(7), []
    for k in range(count):
        picture = _picture((1920, 1080), centre, radius, texture, seed=k)
        files.append(folder / f"{k:03}.jpg")
        cv2.imwrite(str(files[-1]), picture, [cv2.IMWRITE_JPEG_QUALITY, 92])
    return EndoscopeFrames(files, centre, radius, (1100.0, 1100.0, *centre))


def laparoscope_video(origin: str, folder: Path) -> tuple[Path, float]:
    """A video of 1280x720 whose disc is cut by the frame above and below, and the disc's radius [px]."""
    radius = 568.0
    if origin == RECORDED:
        return BESIDE / LAPAROSCOPE, radius
    path, texture = folder / "laparoscope.mp4", _texture(9)
    video = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), 25.0, (1280, 720))
    assert video.isOpened()
    for k in range(6):
        video.write(_picture((1280, 720), (642.0, 358.0), radius, texture, seed=k))
    video.release()
    return path, radius


def _texture(seed: int) -> npt.NDArray[np.float32]:
    """Brightness of tissue about 1, with vessels and grain of several sizes."""
    rng = np.random.default_rng(seed)
    texture = np.ones((1280, 2240), np.float32)
    for sigma, amplitude in ((2.0, 0.03), (6.0, 0.05), (25.0, 0.08)):
        noise = cv2.GaussianBlur(rng.standard_normal(texture.shape, np.float32), (0, 0), sigma)
        texture += amplitude * noise / noise.std()
    return texture


def _picture(
    size: tuple[int, int],
    centre: tuple[float, float],
    radius: float,
    texture: npt.NDArray[np.float32],
    *,
    seed: int,
) -> Image:
    """One frame; the tissue moves along the cleft by 9 px a seed."""
    rng = np.random.default_rng(seed)
    columns, rows = np.meshgrid(np.arange(size[0], dtype=np.float32), np.arange(size[1], dtype=np.float32))
    x, y = (columns - np.float32(centre[0])) / radius, (rows - np.float32(centre[1])) / radius
    from_centre = np.hypot(x, y)
    shift = 9 * seed
    tissue = texture[100 : 100 + size[1], shift : shift + size[0]]
    light = 205.0 * (1.0 - 0.45 * from_centre**2) * tissue
    # The cleft narrows to one side and has soft borders.
    depth = np.abs(y - 0.12 * np.sin(2.0 * x + 0.05 * seed)) - 0.11 - 0.04 * x
    glare = np.zeros_like(light)
    for _ in range(6):
        at = [int(c + radius * rng.uniform(-0.7, 0.7)) for c in centre]
        reach = [int(radius * rng.uniform(0.01, 0.03)) for _ in range(2)]
        cv2.ellipse(glare, at, reach, 0.0, 0.0, 360.0, (255.0,), -1)
    light = np.where(depth < 0.0, np.float32(14.0), np.maximum(light + glare, 8.0))
    # The field stop is not in focus: the light goes out within some pixels.
    light *= np.clip((1.0 - from_centre) * radius / 8.0, 0.0, 1.0)
    light = cv2.GaussianBlur(light + np.float32(4.0), (0, 0), 1.6)
    noise = 2.0 * rng.standard_normal(light.shape, np.float32)
    # The same noise a row further is as good as another one.
    colours = [share * light + np.roll(noise, k, axis=0) for k, share in enumerate((0.62, 0.68, 1.0))]
    return np.asarray(np.clip(np.stack(colours, axis=2), 0, 255), np.uint8)

"""Pictures of a folder: picture files, and chosen frames of video files."""

import hashlib
from collections.abc import Iterator, Sequence
from pathlib import Path

import cv2
import numpy as np

from knee_gap_core.user_files import FileError, open_file, reason_of, shown
from knee_gap_core.values.arrays import Image
from knee_gap_perception.errors import PerceptionError
from knee_gap_perception.marks.marked_picture import MarkedPicture

PICTURES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff")
VIDEOS = (".mp4", ".avi", ".mkv", ".mov", ".webm")
MOST_PICTURE_BYTES = 256 << 20


def sha256_of(path: Path) -> str:
    """SHA-256 of a file. Raises PerceptionError if it cannot be read."""
    try:
        digest = hashlib.sha256()
        with open_file(path) as file:
            while part := file.read(1 << 20):
                digest.update(part)
    except FileError as error:
        raise PerceptionError(str(error)) from None
    except OSError as error:
        raise PerceptionError(f"{shown(path)}: {reason_of(error)}") from None
    return digest.hexdigest()


def is_video(name: str) -> bool:
    """Whether a file of this name is a video."""
    return Path(name).suffix.lower() in VIDEOS


def picture_names(folder: Path) -> list[str]:
    """Names of all pictures and videos of a folder, sorted. Raises PerceptionError if there are none."""
    if not folder.is_dir():
        raise PerceptionError(f"{shown(folder)} is not a folder")
    names = sorted(
        path.name
        for path in folder.iterdir()
        if path.suffix.lower() in (*PICTURES, *VIDEOS) and path.is_file()
    )
    if not names:
        raise PerceptionError(f"{shown(folder)} holds no picture and no video")
    return names


def frame_count(path: Path) -> int:
    """Number of frames of a video. Raises PerceptionError if it has none that can be read."""
    video = cv2.VideoCapture(str(path))
    try:
        count = 0
        while video.grab():
            count += 1
    finally:
        video.release()
    if not count:
        raise PerceptionError(f"{shown(path)} is not a video that can be read")
    return count


def read_picture(path: Path) -> Image:
    """The image (h, w, 3) of a picture file. Raises PerceptionError if it cannot be read."""
    try:
        with open_file(path) as file:
            data = file.read(MOST_PICTURE_BYTES + 1)
    except FileError as error:
        raise PerceptionError(str(error)) from None
    if len(data) > MOST_PICTURE_BYTES:
        raise PerceptionError(f"{shown(path)} is longer than {MOST_PICTURE_BYTES >> 20} MiB")
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR) if data else None
    except cv2.error:
        image = None
    if image is None:
        raise PerceptionError(f"{shown(path)} is not an image that can be read")
    return np.asarray(image, np.uint8)


def read_frames(path: Path, frames: Sequence[int]) -> Iterator[tuple[int, Image]]:
    """Frames of a video by number, in ascending order. Raises PerceptionError for one that is not in it."""
    wanted = sorted(set(frames))
    video = cv2.VideoCapture(str(path))
    try:
        at = 0
        for frame in wanted:
            # Seeking lands on the wrong frame in some files: every frame is decoded in order.
            while at < frame and video.grab():
                at += 1
            read, image = video.read()
            if at < frame or not read:
                raise PerceptionError(f"{shown(path)} has no frame {frame}, it has {at}")
            at += 1
            yield frame, np.asarray(image, np.uint8)
    finally:
        video.release()


def marked_images(marks: Sequence[MarkedPicture], folder: Path) -> Iterator[tuple[MarkedPicture, Image]]:
    """Each marked picture and its image, by file and frame.

    Raises PerceptionError for a file that is missing, or that is not the one that was marked.
    """
    files: dict[str, list[MarkedPicture]] = {}
    for picture in marks:
        files.setdefault(picture.file, []).append(picture)
    for name, pictures in files.items():
        path = folder / name
        hashed = sha256_of(path)
        for picture in pictures:
            if hashed != picture.sha256:
                raise PerceptionError(
                    f"{shown(path)} is not the picture that was marked: its SHA-256 is {hashed[:12]}..., "
                    f"that of the marked one {picture.sha256[:12]}..."
                )
        stills = [picture for picture in pictures if picture.frame is None]
        frames = {picture.frame: picture for picture in pictures if picture.frame is not None}
        for picture in stills:
            yield picture, _of_size(read_picture(path), picture)
        for frame, image in read_frames(path, list(frames)):
            yield frames[frame], _of_size(image, frames[frame])


def _of_size(image: Image, picture: MarkedPicture) -> Image:
    if image.shape[:2] != picture.shape:
        raise PerceptionError(
            f"{picture.name} has {image.shape[1]}x{image.shape[0]} px, "
            f"it was marked with {picture.width}x{picture.height} px"
        )
    return image

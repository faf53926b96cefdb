"""The pictures of a folder that are being marked, and the file that their marks are kept in."""

import threading
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np

from knee_gap_core.values.arrays import Image
from knee_gap_perception.errors import PerceptionError
from knee_gap_perception.marks.marked_picture import Decision, MarkedPicture, Region
from knee_gap_perception.marks.marks_file import FORMAT, marks_of, read_marks, value_of, write_marks
from knee_gap_perception.marks.picture_files import (
    frame_count,
    is_video,
    picture_names,
    read_frames,
    read_picture,
    sha256_of,
)


class _Item(NamedTuple):
    """A picture file, or one frame of a video file."""

    file: str
    frame: int | None
    sha256: str

    @property
    def key(self) -> tuple[str, int]:
        return self.file, -1 if self.frame is None else self.frame


class MarkingSession:
    """Takes the marks of one picture after another; the file holds all that were taken.

    Of each video, `frames` frames are shown, evenly spread, and those that are marked already. Threads may
    share it.
    """

    def __init__(self, folder: Path, marks: Path, frames: int) -> None:
        """Raise PerceptionError for a folder without pictures and for marks of other pictures."""
        self.folder, self.marks = folder, marks
        self._lock = threading.Lock()
        self._shown: tuple[int, Image] | None = None
        known = read_marks(marks) if marks.exists() else []
        self._known = {(picture.file, _number(picture)): picture for picture in known}
        names = picture_names(folder)
        if missing := sorted({picture.file for picture in known} - set(names)):
            raise PerceptionError(f"{marks} has marks of {missing[0]}, which is not in {folder}")
        self._items: list[_Item] = []
        for name in names:
            self._add(name, frames)

    def _add(self, name: str, frames: int) -> None:
        sha256 = sha256_of(self.folder / name)
        marked = [number for file, number in self._known if file == name]
        for number in marked:
            if self._known[name, number].sha256 != sha256:
                raise PerceptionError(
                    f"{self.folder / name} is not the picture that was marked in {self.marks}: "
                    f"its SHA-256 is {sha256[:12]}..., that of the marked one "
                    f"{self._known[name, number].sha256[:12]}..."
                )
        if not is_video(name):
            self._items.append(_Item(name, None, sha256))
            return
        count = frame_count(self.folder / name)
        spread = np.linspace(0, count - 1, min(frames, count)).astype(int).tolist()
        self._items += [_Item(name, frame, sha256) for frame in sorted({*spread, *marked} - {-1})]

    def state(self) -> dict[str, Any]:
        """What the page needs: the choices, and each picture with its marks or without."""
        with self._lock:
            return {
                "folder": self.folder.name,
                "regions": list(Region),
                "decisions": list(Decision),
                "pictures": [
                    value_of(self._known[item.key])
                    if item.key in self._known
                    else {"file": item.file, "frame": item.frame}
                    for item in self._items
                ],
            }

    def png(self, index: int) -> bytes:
        """The picture of an index as PNG. Raises PerceptionError if there is none."""
        return cv2.imencode(".png", self._image(index))[1].tobytes()

    def save(self, index: int, entry: Any) -> None:
        """Keep the marks of a picture. Raises PerceptionError for marks that break a rule."""
        if not isinstance(entry, dict):
            raise PerceptionError("the marks must be an object")
        item, image = self._item(index), self._image(index)
        height, width = image.shape[:2]
        own = {"file": item.file, "frame": item.frame, "sha256": item.sha256}
        (picture,) = marks_of(
            {"format": FORMAT, "pictures": [{**entry, **own, "width": width, "height": height}]}
        )
        with self._lock:
            self._known[item.key] = picture
            order = [one.key for one in self._items]
            write_marks(self.marks, [self._known[key] for key in order if key in self._known])

    def _item(self, index: int) -> _Item:
        if not 0 <= index < len(self._items):
            raise PerceptionError(f"there is no picture {index}, there are {len(self._items)}")
        return self._items[index]

    def _image(self, index: int) -> Image:
        item = self._item(index)
        with self._lock:
            if self._shown is None or self._shown[0] != index:
                path = self.folder / item.file
                if item.frame is None:
                    image = read_picture(path)
                else:
                    image = next(image for _, image in read_frames(path, [item.frame]))
                self._shown = index, image
            return self._shown[1]


def _number(picture: MarkedPicture) -> int:
    return -1 if picture.frame is None else picture.frame

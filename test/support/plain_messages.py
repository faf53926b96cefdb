"""Messages without ROS: objects with the fields of those of ROS, for cores that take either."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import numpy.typing as npt


def header(stamp_ns: int, frame_id: str = "arthroscope_optical") -> Any:
    """A Header."""
    seconds, nanoseconds = divmod(stamp_ns, 10**9)
    return SimpleNamespace(stamp=SimpleNamespace(sec=seconds, nanosec=nanoseconds), frame_id=frame_id)


def pose(position: npt.ArrayLike, quaternion_xyzw: npt.ArrayLike = (0.0, 0.0, 0.0, 1.0)) -> Any:
    """A Pose."""
    return SimpleNamespace(
        position=SimpleNamespace(**dict(zip("xyz", np.asarray(position, dtype=float), strict=True))),
        orientation=SimpleNamespace(
            **dict(zip("xyzw", np.asarray(quaternion_xyzw, dtype=float), strict=True))
        ),
    )


def bgr_image(picture: npt.NDArray[np.uint8], stamp_ns: int) -> Any:
    """An Image (h, w, 3) of the scope's camera."""
    height, width = picture.shape[:2]
    return SimpleNamespace(
        header=header(stamp_ns),
        height=height,
        width=width,
        step=3 * width,
        encoding="bgr8",
        data=picture.tobytes(),
    )

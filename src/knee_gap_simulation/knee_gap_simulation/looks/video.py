"""The camera head of a look: white balance, cast, exposure that clips, sharpening."""

from dataclasses import replace

import numpy as np
import numpy.typing as npt

from knee_gap_simulation.knee.camera_head import CameraHead
from knee_gap_simulation.knee.difficulty import Conditions
from knee_gap_simulation.looks.look import Head
from knee_gap_simulation.scope.imaging import ByteImage, FloatImage

_MIDDLE = 0.3  # linear light that keeps its colour


class GradedHead(CameraHead):
    """Converts linear light to the display images of one look, frame by frame."""

    def __init__(
        self,
        conditions: Conditions,
        head: Head,
        stop: FloatImage,
        fringe: FloatImage,
        radius: npt.NDArray[np.float32],
        seed: int,
    ) -> None:
        """As `CameraHead`; ``fringe`` (h, w, 3) is the light of each channel relative to the stop."""
        size = stop.shape[0] / 720.0
        self._warmth = head.warmth
        super().__init__(
            replace(conditions, bloom=head.bloom, softness_px=head.softness * conditions.softness_px * size),
            stop,
            radius,
            seed,
            target=head.target,
            tone=tone(head.shoulder, head.black),
            sharpening=head.sharpening,
        )
        self._colours = head.colours.astype(np.float32).T.copy()
        self._fringe = None if (fringe == 1.0).all() else fringe

    def develop(self, light: FloatImage, frame: int, step_s: float) -> ByteImage:
        """Display image (h, w, 3) bgr8 of linear light (h, w, 3)."""
        coloured = np.maximum(light @ self._colours, 0.0)
        if self._warmth != 0.0:
            level = np.clip(coloured.mean(axis=-1) / _MIDDLE, 0.03, 2.0) ** np.float32(-self._warmth)
            coloured[..., 2] *= level
            coloured[..., 0] /= level
        if self._fringe is not None:
            coloured *= self._fringe
        return super().develop(coloured, frame, step_s)


def tone(shoulder: float, black: float) -> ByteImage:
    """Display values (4096,) of linear light in [0, 2): a gamma that rolls off to white above a shoulder."""
    linear = np.maximum(np.arange(4096) / 2048.0 - black, 0.0) / (1.0 - black)
    room = 1.0 - shoulder
    rolled = np.where(linear < shoulder, linear, shoulder + room * np.tanh((linear - shoulder) / room))
    return np.asarray(np.round(255.0 * np.clip(rolled, 0.0, 1.0) ** (1.0 / 2.2)), dtype=np.uint8)

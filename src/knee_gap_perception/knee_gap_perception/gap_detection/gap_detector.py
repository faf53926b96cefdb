"""Gap detector for one image: segmentation, section, and the decision whether it is a gap."""

from collections.abc import Iterator
from math import ceil, floor
from typing import NamedTuple

import cv2
import numpy as np

from knee_gap_core.values.arrays import Array, Image, Mask
from knee_gap_core.values.edges import EdgeStatus
from knee_gap_perception.camera.camera import Camera
from knee_gap_perception.gap_detection.confidence import gap_confidence
from knee_gap_perception.gap_detection.confidence_filter import ConfidenceFilter
from knee_gap_perception.gap_detection.cross_section import Section, find_section
from knee_gap_perception.gap_detection.edge_parameters import EdgeParameters
from knee_gap_perception.gap_detection.learned_gap import WIDER, learned_gap, learned_sections
from knee_gap_perception.image.field_of_view import FieldOfView, brightness
from knee_gap_perception.image.instruments_and_glare import (
    USUAL_LIMIT,
    foreign_bodies,
    least_warmth,
    metal_and_glare,
)
from knee_gap_perception.image.shafts import find_shafts
from knee_gap_perception.segmentation.choice import LEARNED, STRATEGIES, segmentation_named
from knee_gap_perception.segmentation.learned import Learned

DARK_PICTURE = 40  # [grey levels] brightest twentieth of the field; below, the image is too dark
BRIGHT_PICTURE = 250  # [grey levels] at or above which a pixel is overexposed
BRIGHT_QUANTILE = 0.95  # of the values, below that of the brightest twentieth
OVEREXPOSED_SHARE = 0.7  # of the field
POINTED_AT_SHARE = 0.25  # of `minimum_confidence`, which suffices where a person has clicked
REFRESH_EVERY = 30  # images of a track between measurements of the tissue's warmth: white balance drifts


class NoPointsError(Exception):
    """No points in an image: the status, and the reason in words."""

    def __init__(self, status: EdgeStatus, reason: str) -> None:
        super().__init__(reason)
        self.status = status


class Found(NamedTuple):
    """A section, and what is not tissue in the image reduced by `scale`.

    `foreign` (h, w) are instruments and glare, `instruments` (h, w) those alone. `opening` (h, w) is the gap
    where a network drew its edges, which need not be steps of brightness; `others` are more sections of it.
    """

    section: Section
    foreign: Mask
    instruments: Mask
    scale: float
    opening: Mask | None = None
    others: Iterator[Section] = iter(())


class GapSearch:
    """Finds the gap in images of one scope.

    `confidence` [0, 1] is that of the dark part found last; NaN if none was found.
    """

    def __init__(self, parameters: EdgeParameters) -> None:
        """Raises PerceptionError if the segmentation cannot be loaded (such as an unreadable network)."""
        self.parameters = parameters
        self.confidence = float("nan")
        self._segmentation = segmentation_named(parameters.segmentation, **_settings(parameters))
        self._evidence = ConfidenceFilter()
        self._warmth = USUAL_LIMIT
        self._warmth_age = 0

    def forget(self) -> None:
        """Forget all images."""
        self._evidence.forget()

    def mask(self, picture: Image, field: FieldOfView) -> Image:
        """Mask (h, w) of the gap in an image (h, w, 3): 255 in the gap, 0 elsewhere."""
        small, scale = self._smaller(picture)
        inside = field.mask((small.shape[0], small.shape[1]), scale)
        if isinstance(self._segmentation, Learned):
            foreign_now = metal_and_glare(small, least_warmth(picture))
            dark = learned_gap(self._segmentation.classes(small, inside), inside, foreign_now).opening
        else:
            foreign, *_ = self._foreign(picture, small, brightness(small), field, scale)
            dark = self._segmentation(small, inside & ~foreign)
        size = (picture.shape[1], picture.shape[0])
        full = cv2.resize(dark.astype(np.uint8) * 255, size, interpolation=cv2.INTER_LINEAR)
        return np.where(full > 127, 255, 0).astype(np.uint8)

    def foreign(self, picture: Image, around: Array, margin: float) -> tuple[Mask, float, Array]:
        """Instruments and glare in the reduced part of an image around points (n, 2) [px].

        Returns the mask (h, w), its scale relative to the full image, and the first pixel (2,) of the part.
        The part reaches `margin` [px] beyond the points.
        """
        height, width = picture.shape[:2]
        scale = min(1.0, self.parameters.working_rows / min(height, width))
        left, top = around.min(axis=0).tolist()
        right, bottom = around.max(axis=0).tolist()
        x0, x1 = _within(left - margin, right + margin, width)
        y0, y1 = _within(top - margin, bottom + margin, height)
        size = max(1, round((x1 - x0) * scale)), max(1, round((y1 - y0) * scale))
        part = np.asarray(cv2.resize(picture[y0:y1, x0:x1], size, interpolation=cv2.INTER_AREA), np.uint8)
        if self._warmth_age % REFRESH_EVERY == 0:
            self._warmth = least_warmth(picture)
        self._warmth_age += 1
        return foreign_bodies(part, self._warmth), scale, np.array([x0, y0], np.float64)

    def agreed_section(
        self, stamp_ns: int, picture: Image, camera: Camera, field: FieldOfView, clicked: Array | None
    ) -> Found:
        """As `section`, unless the images just before that of a stamp [ns] contradict it."""
        try:
            found = self.section(picture, camera, field, clicked)
        except NoPointsError as refusal:
            if refusal.status is EdgeStatus.NO_GAP:
                self._evidence.add(stamp_ns, np.nan_to_num(self.confidence))
            raise
        if clicked is not None:
            return found
        confidence = self._evidence.add(stamp_ns, self.confidence)
        if confidence < self.parameters.minimum_confidence:
            raise NoPointsError(
                EdgeStatus.NO_GAP,
                f"no gap in the images just before: their joint confidence is {confidence:.2f}, needed is "
                f"{self.parameters.minimum_confidence:.2f}",
            )
        return found

    def section(self, picture: Image, camera: Camera, field: FieldOfView, clicked: Array | None) -> Found:
        """Section of the gap in an image (h, w, 3), or of the gap at a clicked pixel (2,).

        Raises NoPointsError if there is none.
        """
        self.confidence = float("nan")
        small, scale = self._smaller(picture)
        inside = field.mask(
            (small.shape[0], small.shape[1]), scale, self.parameters.field_margin * field.extent
        )
        value = brightness(small)
        light = check_light(value[inside])
        if isinstance(self._segmentation, Learned):
            return self._learned(self._segmentation, picture, small, camera, field, clicked)
        foreign, instruments, shafts = self._foreign(picture, small, value, field, scale)
        dark = self._segmentation(small, inside & ~foreign)
        section = find_section(dark, value, foreign, field, scale, self._region(field, clicked), shafts)
        if section is None:
            raise NoPointsError(
                EdgeStatus.NO_GAP, "no dark gap with tissue on both sides in the region of interest"
            )
        self._check_width(section, camera, "dark part")
        confidence = self.confidence = gap_confidence(
            section, field.extent, light, small, dark, scale, pointed_at=clicked is not None
        )
        needed = self.parameters.minimum_confidence * (1.0 if clicked is None else POINTED_AT_SHARE)
        if confidence < needed:
            raise NoPointsError(
                EdgeStatus.NO_GAP,
                f"the dark part is shaded tissue rather than a gap: confidence {confidence:.2f}, needed is "
                f"{needed:.2f}",
            )
        return Found(section, foreign, instruments, scale)

    def _learned(
        self,
        network: Learned,
        picture: Image,
        small: Image,
        camera: Camera,
        field: FieldOfView,
        clicked: Array | None,
    ) -> Found:
        """As `section`, where a network of the project decides what is a gap and what an instrument."""
        shape, value = (small.shape[0], small.shape[1]), brightness(small)
        scale = min(1.0, self.parameters.working_rows / min(picture.shape[:2]))
        whole = field.mask(shape, scale)
        seen = learned_gap(
            network.classes(small, whole), whole, metal_and_glare(small, least_warmth(picture))
        )
        centre, radius = self._region(field, clicked)
        if clicked is None:
            radius *= WIDER
        sections = learned_sections(seen, value, field, scale, (centre, radius))
        first = next(sections, None)
        if first is None:
            raise NoPointsError(EdgeStatus.NO_GAP, "no opening with tissue on both sides is seen")
        section, self.confidence = first
        self._check_width(section, camera, "opening")
        least = self.parameters.minimum_confidence
        if self.confidence < least:
            raise NoPointsError(
                EdgeStatus.NO_GAP,
                f"the opening has a confidence of {self.confidence:.2f}, needed is {least:.2f}",
            )
        others = (
            other
            for other, confidence in sections
            if confidence >= least and _width(other, camera) >= self.parameters.minimum_width
        )
        foreign = seen.instruments | seen.glare
        return Found(section, foreign, seen.instruments, scale, seen.opening, others)

    def _check_width(self, section: Section, camera: Camera, what: str) -> None:
        """Raises NoPointsError if a section is too narrow."""
        width = _width(section, camera)
        if not width >= self.parameters.minimum_width:
            raise NoPointsError(
                EdgeStatus.NO_GAP,
                f"the {what} is {np.degrees(width):.1f} deg wide, a gap is at least "
                f"{np.degrees(self.parameters.minimum_width):.1f} deg",
            )

    def _foreign(
        self, picture: Image, small: Image, value: Image, field: FieldOfView, scale: float
    ) -> tuple[Mask, Mask, Mask]:
        """Instruments and glare, instruments alone, and the shafts among them, at working size (h, w).

        `small` (h, w, 3) is the image reduced by `scale`, `value` (h, w) its brightness.
        """
        warmth = least_warmth(picture)
        shafts = find_shafts(small, value, field, scale, warmth)
        metal, glare = metal_and_glare(small, warmth)
        instruments = metal | shafts
        return instruments | glare, instruments, shafts

    def _smaller(self, picture: Image) -> tuple[Image, float]:
        """An image (h, w, 3) at working size, and its scale relative to the full image."""
        scale = min(1.0, self.parameters.working_rows / min(picture.shape[:2]))
        size = (round(picture.shape[1] * scale), round(picture.shape[0] * scale))
        return np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), np.uint8), scale

    def _region(self, field: FieldOfView, clicked: Array | None) -> tuple[Array, float]:
        """Centre and radius [px] of the region of interest."""
        radius = self.parameters.region_radius * field.extent
        if clicked is not None:
            return clicked, min(radius, 0.2 * field.extent)
        centre = np.array(self.parameters.region_centre)
        return np.where(np.isnan(centre), np.array(field.centre), centre), radius


def _width(section: Section, camera: Camera) -> float:
    """Angle across a section [rad]; NaN if the camera model does not describe it."""
    return float(np.arccos(np.clip(np.prod(camera.bearings(section.edges), axis=0).sum(), -1.0, 1.0)))


def _within(first: float, last: float, size: int) -> tuple[int, int]:
    """First pixel and the one behind the last of an interval, inside an image of a size; at least two."""
    begin = min(max(floor(first), 0), size - 2)
    return begin, min(max(ceil(last), begin + 2), size)


def check_light(values: Image) -> float:
    """Brightness [grey levels] that a twentieth of the values exceeds.

    Raises NoPointsError if the image is too dark or overexposed.
    """
    light = _level_exceeded(values) if values.size else 0.0
    if light < DARK_PICTURE:
        raise NoPointsError(EdgeStatus.LOW_CONTRAST, "the image is too dark")
    if (values >= BRIGHT_PICTURE).mean() > OVEREXPOSED_SHARE:
        raise NoPointsError(EdgeStatus.LOW_CONTRAST, "the image is overexposed")
    return light


def _level_exceeded(values: Image) -> float:
    """The 95th percentile, as numpy's, which takes five times as long for so few."""
    ordered = np.sort(values, axis=None)
    place = BRIGHT_QUANTILE * (ordered.size - 1)
    below = int(place)
    lower, upper = float(ordered[below]), float(ordered[min(below + 1, ordered.size - 1)])
    share, step = place - below, upper - lower
    return lower + step * share if share < 0.5 else upper - step * (1.0 - share)


def _settings(parameters: EdgeParameters) -> dict[str, object]:
    """Settings of the segmentation that the parameters name."""
    if parameters.segmentation == LEARNED:
        return {"path": parameters.network_path}
    if not STRATEGIES[parameters.segmentation].needs_network:
        return {}
    return {
        "path": parameters.network_path,
        "input_size": parameters.network_input_size,
        "mean": parameters.network_mean,
        "scale": parameters.network_scale,
    }

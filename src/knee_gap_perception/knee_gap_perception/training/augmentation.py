"""Augmentation: the same scene turned, zoomed and cut, through another camera head."""

import cv2
import numpy as np
import numpy.typing as npt

from knee_gap_core.values.arrays import Image, Mask
from knee_gap_core.values.pixel_classes import UNKNOWN_CLASS, PixelClass
from knee_gap_perception.segmentation.network_input import SIDE, network_input
from knee_gap_perception.training.examples import STORED_SIDE, Example

Plane = npt.NDArray[np.float32]

OUTPUT_SIDE = SIDE // 2  # [px] of the network's output
CLIPPED = 250  # [grey levels] from which all channels are clipped
LEAST_FIELD = 0.25  # of the input, that an augmented field must fill
_ROWS, _COLUMNS = np.mgrid[0:SIDE, 0:SIDE].astype(np.float32)
_MIDDLE = (SIDE - 1) / 2.0


def augmented(rng: np.random.Generator, example: Example) -> tuple[Plane, Image]:
    """The network's input (5, side, side) and the classes (side / 2, side / 2) of a changed example."""
    image, labels = _moved(rng, example)
    image = through_camera(rng, image)
    labels[(image.min(axis=2) >= CLIPPED) & (labels == PixelClass.TISSUE)] = PixelClass.GLARE
    field = _found_field(rng, labels != PixelClass.OUTSIDE)
    labels[~field] = UNKNOWN_CLASS
    return network_input(image, field), labels[::2, ::2].copy()


def plain(example: Example) -> tuple[Plane, Image]:
    """As `augmented`, but unchanged."""
    image = np.asarray(cv2.resize(example.image, (SIDE, SIDE), interpolation=cv2.INTER_AREA), np.uint8)
    labels = np.asarray(cv2.resize(example.labels, (SIDE, SIDE), interpolation=cv2.INTER_NEAREST), np.uint8)
    field = labels != PixelClass.OUTSIDE
    labels = np.where(field, labels, np.uint8(UNKNOWN_CLASS))
    return network_input(image, field), labels[::2, ::2].copy()


def _moved(rng: np.random.Generator, example: Example) -> tuple[Image, Image]:
    """Image (side, side, 3) and labels (side, side), turned, mirrored, zoomed, in another field."""
    for _ in range(4):
        zoom = 1.0 if rng.random() < 0.4 else float(np.exp(rng.uniform(0.0, np.log(1.9))))
        scale = SIDE / STORED_SIDE * zoom
        angle = rng.uniform(0.0, 2.0 * np.pi)
        turn = scale * np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        stretch = np.diag([1.0, float(np.exp(rng.uniform(-0.12, 0.12)))])
        if rng.random() < 0.5:
            stretch[0, 0] = -1.0
        linear = turn @ stretch
        free = 0.5 * STORED_SIDE * (1.0 - 1.0 / zoom)
        seen = STORED_SIDE / 2.0 + rng.uniform(-free, free, 2)
        matrix = np.column_stack([linear, SIDE / 2.0 - linear @ seen]).astype(np.float64)
        labels = _warped(example.labels, matrix, cv2.INTER_NEAREST)
        labels[~_field(rng, zoom)] = PixelClass.OUTSIDE
        if (labels != PixelClass.OUTSIDE).mean() >= LEAST_FIELD:
            break
    image = _warped(example.image, matrix, cv2.INTER_AREA if scale < 0.8 else cv2.INTER_LINEAR)
    return image, labels


def _warped(image: Image, matrix: npt.NDArray[np.float64], how: int) -> Image:
    flags = cv2.INTER_LINEAR if how == cv2.INTER_AREA else how
    return np.asarray(cv2.warpAffine(image, matrix, (SIDE, SIDE), flags=flags), np.uint8)


def _field(rng: np.random.Generator, zoom: float) -> Mask:
    """The field of another scope (side, side): a disc, a disc cut above and below, or the whole picture."""
    kind = rng.random()
    if zoom > 1.0 and kind < 0.2:
        return np.ones((SIDE, SIDE), bool)
    radius = SIDE / 2.0 * (1.0 if kind < 0.7 else rng.uniform(1.02, 1.4))
    shift = rng.normal(0.0, 0.01, 2) * SIDE
    inside = np.hypot(_COLUMNS - _MIDDLE - shift[0], _ROWS - _MIDDLE - shift[1]) < radius
    if kind > 0.85:
        cut = rng.uniform(0.0, 0.22) * SIDE
        inside &= np.abs(_ROWS - _MIDDLE) < SIDE / 2.0 - cut
    return np.asarray(inside)


def _found_field(rng: np.random.Generator, field: Mask) -> Mask:
    """The field as it is found: a pixel or two wider or narrower than it is."""
    off = int(rng.integers(-2, 3))
    if off == 0:
        return field
    kernel = np.ones((2 * abs(off) + 1,) * 2, np.uint8)
    changed = (cv2.dilate if off > 0 else cv2.erode)(field.astype(np.uint8), kernel)
    return np.asarray(changed > 0)


def through_camera(rng: np.random.Generator, image: Image) -> Image:
    """An image (h, w, 3) as another lamp, lens and camera head would show it."""
    value = np.asarray(image / 255.0, np.float32)
    if rng.random() < 0.3:
        value = np.asarray(cv2.GaussianBlur(value, (0, 0), float(rng.uniform(0.4, 1.8))), np.float32)
    if rng.random() < 0.15:
        value = _motion_blur(rng, value)
    value = np.asarray(value ** float(np.exp(rng.uniform(-0.45, 0.45))), np.float32)
    value *= float(np.exp(rng.uniform(-0.5, 0.45)))
    blue, green = float(np.exp(rng.uniform(-0.25, 0.33))), float(np.exp(rng.uniform(-0.1, 0.1)))
    value *= np.array([blue, green, 1.0], np.float32)
    grey = value.mean(axis=2, keepdims=True)
    value = grey + (value - grey) * np.float32(0.0 if rng.random() < 0.02 else rng.uniform(0.4, 1.5))
    value *= _uneven_light(rng)[..., None]
    if rng.random() < 0.2:  # a veil of fluid
        veil = rng.uniform(0.02, 0.22) * np.array([rng.uniform(0.7, 1.0), rng.uniform(0.8, 1.0), 1.0])
        value = value * np.float32(1.0 - veil.max()) + veil.astype(np.float32)
    if rng.random() < 0.3:  # sharpening
        value += np.float32(rng.uniform(0.2, 1.2)) * (value - cv2.GaussianBlur(value, (0, 0), 1.5))
    value += rng.normal(0.0, float(rng.uniform(0.0, 0.025)), value.shape).astype(np.float32)
    shown = np.asarray(np.clip(value * 255.0, 0.0, 255.0), np.uint8)
    if rng.random() < 0.5:
        quality = int(rng.integers(25, 95))
        shown = np.asarray(
            cv2.imdecode(cv2.imencode(".jpg", shown, [cv2.IMWRITE_JPEG_QUALITY, quality])[1], 1), np.uint8
        )
    return shown


def _uneven_light(rng: np.random.Generator) -> Plane:
    """Factors (side, side) of a lamp that lights one side more, and of a lens that loses light to its rim."""
    x, y = (_COLUMNS - _MIDDLE) / _MIDDLE, (_ROWS - _MIDDLE) / _MIDDLE
    slope = rng.normal(0.0, 0.2, 2)
    away = np.minimum(x * x + y * y, 1.0)
    light = 1.0 + slope[0] * x + slope[1] * y - rng.uniform(-0.1, 0.4) * away
    return np.asarray(np.clip(light, 0.25, 2.0), np.float32)


def _motion_blur(rng: np.random.Generator, value: Plane) -> Plane:
    size, angle = int(rng.integers(2, 5)), rng.uniform(0.0, np.pi)
    kernel = np.zeros((2 * size + 1,) * 2, np.float32)
    reach = size * np.array([np.cos(angle), np.sin(angle)])
    first, last = np.rint(size - reach).astype(int), np.rint(size + reach).astype(int)
    cv2.line(kernel, (int(first[0]), int(first[1])), (int(last[0]), int(last[1])), (1.0,), 1)
    return np.asarray(cv2.filter2D(value, -1, kernel / kernel.sum()), np.float32)

"""Overlay of the gap, its points and its edges on the image, for people to look at."""

import cv2
import numpy as np

from knee_gap_core.values.arrays import Array, Image
from knee_gap_core.values.edges import EdgeKind, EdgeStatus, GapEdges
from knee_gap_perception.camera.camera import Camera, bearing_jacobian

POINT_COLOURS = ((80, 200, 255), (255, 170, 60))  # blue, green, red of G0 and G1
SECTION_COLOUR = (240, 240, 240)
OUTLINE_COLOUR = (90, 220, 90)
WORD_COLOURS = {EdgeStatus.VALID: (90, 220, 90), EdgeStatus.UNKNOWN: (160, 160, 160)}
REFUSED_COLOUR = (60, 90, 255)
ELLIPSE_DEVIATIONS = 3.0  # standard deviations, times ELLIPSE_ZOOM so that a fraction of a pixel can be seen
ELLIPSE_ZOOM = 5.0


def draw_overlay(
    image: Image,
    edges: GapEdges,
    mask: Image,
    reason: str,
    camera: Camera | None = None,
    instrument: float = float("nan"),
) -> Image:
    """A copy of an image (h, w, 3) with the outline of the gap, points, kinds, errors and status on it.

    `mask` (h, w) is 255 in the gap, or empty. The circle between the edges is the thickest that touches no
    tissue; a second one, green if it fits and red if not, has the angle `instrument` [rad] that an instrument
    spans at the section, NaN for none. The ellipses are drawn five times as large as three standard
    deviations; the words give the bound in degrees. Nothing is drawn of points that are not known.
    """
    drawn = image.copy()
    # Sizes follow the image, so that words can be read at 480 and at 2160 rows.
    unit = max(1.0, image.shape[0] / 720)
    if mask.shape == image.shape[:2]:
        outlines, _ = cv2.findContours(mask, cv2.RETR_LIST, cv2.CHAIN_APPROX_SIMPLE)
        cv2.drawContours(drawn, outlines, -1, OUTLINE_COLOUR, round(unit), cv2.LINE_AA)
    if np.isfinite(edges.pixels).all():
        ends = [tuple(int(v) for v in np.rint(pixel)) for pixel in edges.pixels]
        cv2.line(drawn, ends[0], ends[1], (255, 255, 255), round(unit), cv2.LINE_AA)
        for index in (0, 1):
            _draw_point(drawn, edges, index, camera, unit)
    if edges.section.seen:
        _draw_section(drawn, edges, camera, instrument, unit)
    _write(
        drawn, words(edges, reason), (round(14 * unit), round(28 * unit)), _word_colour(edges.status), unit
    )
    return drawn


def words(edges: GapEdges, reason: str) -> str:
    """The status in words."""
    if edges.status is EdgeStatus.VALID:
        return f"valid, track {edges.track_id}, within {np.degrees(edges.angular_error):.2f} deg"
    name = edges.status.name.lower().replace("_", " ")
    return f"{name}: {reason}" if reason else name


def _word_colour(status: EdgeStatus) -> tuple[int, int, int]:
    return WORD_COLOURS.get(status, REFUSED_COLOUR)


def _draw_section(
    drawn: Image, edges: GapEdges, camera: Camera | None, instrument: float, unit: float
) -> None:
    """The thickest circle between the edges, and the instrument beside it."""
    first, second = edges.section.pixels
    middle = (first + second) / 2
    centre = (round(float(middle[0])), round(float(middle[1])))
    radius = float(np.linalg.norm(second - first)) / 2
    cv2.circle(drawn, centre, round(radius), SECTION_COLOUR, round(unit), cv2.LINE_AA)
    if camera is None or not np.isfinite(instrument):
        return
    half = instrument / camera.radians_per_pixel(middle) / 2
    if np.isfinite(half) and half < 4.0 * max(drawn.shape[:2]):
        colour = OUTLINE_COLOUR if half <= radius else REFUSED_COLOUR
        cv2.circle(drawn, centre, round(half), colour, round(2 * unit), cv2.LINE_AA)


def _draw_point(drawn: Image, edges: GapEdges, index: int, camera: Camera | None, unit: float) -> None:
    pixel, colour = edges.pixels[index], POINT_COLOURS[index]
    centre = (round(float(pixel[0])), round(float(pixel[1])))
    cv2.drawMarker(drawn, centre, colour, cv2.MARKER_CROSS, round(12 * unit), round(unit), cv2.LINE_AA)
    if camera is not None:
        covariance = _pixel_covariance(edges.covariances[index], bearing_jacobian(camera, pixel))
        if np.isfinite(covariance).all():
            _draw_ellipse(drawn, centre, covariance, colour, unit)
    kind = edges.kinds[index]
    name = f"G{index}" if kind is EdgeKind.UNKNOWN else f"G{index} {kind.name.lower()}"
    if edges.hidden[index]:
        name += ", hidden"
    _write(drawn, name, (centre[0] + round(12 * unit), centre[1] - round(8 * unit)), colour, unit)


def _pixel_covariance(covariance: Array, jacobian: Array) -> Array:
    """Covariance (2, 2) [px^2] of a pixel from that of its bearing (3, 3)."""
    if not np.isfinite(jacobian).all() or not np.isfinite(covariance).all():
        return np.full((2, 2), np.nan)
    inverse = np.linalg.pinv(jacobian)
    return np.asarray(inverse @ covariance @ inverse.T)


def _draw_ellipse(
    drawn: Image, centre: tuple[int, int], covariance: Array, colour: tuple[int, int, int], unit: float
) -> None:
    values, vectors = np.linalg.eigh(covariance)
    half = ELLIPSE_ZOOM * ELLIPSE_DEVIATIONS * np.sqrt(np.maximum(values, 0.0))
    axes = (int(min(half[1], 2000)), int(min(half[0], 2000)))
    angle = float(np.degrees(np.arctan2(vectors[1, 1], vectors[0, 1])))
    cv2.ellipse(drawn, centre, axes, angle, 0, 360, colour, round(unit), cv2.LINE_AA)


def _write(
    drawn: Image, text: str, place: tuple[int, int], colour: tuple[int, int, int], unit: float
) -> None:
    """Text with a dark rim, which can be read on any tissue."""
    for thickness, ink in ((4, (0, 0, 0)), (1, colour)):
        cv2.putText(
            drawn,
            text,
            place,
            cv2.FONT_HERSHEY_SIMPLEX,
            0.6 * unit,
            ink,
            round(thickness * unit),
            cv2.LINE_AA,
        )

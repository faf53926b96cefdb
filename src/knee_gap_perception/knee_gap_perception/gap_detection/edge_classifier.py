"""Classification of the gap's edges from the brightness profile across them, in one image."""

import cv2
import numpy as np

from knee_gap_core.values.arrays import Array, Image
from knee_gap_core.values.edges import EdgeKind

ALONG = np.arange(-12, 13, 2)  # [px] parallel lines over which the profile is averaged
INTO_GAP = 14  # [px] of the profile on the gap's side
ONTO_TISSUE = 48  # [px] on the tissue's side
SHADING_WIDTH = 14.0  # [px] between a fifth and four fifths of the step: a wider step is shading
TURNING_AWAY = 0.78  # ratio of brightness just inside the edge to farther in: below, the surface turns away


def edge_kind(grey: Image, edge: Array, outward: Array) -> EdgeKind:
    """Kind of the edge at a pixel (2,) of an image (h, w), whose tissue lies along a unit vector (2,).

    With the light at the lens, a surface that turns away towards an occluding contour darkens before it, with
    the cosine of incidence. A surface that ends in a rim stays bright up to it. If brightness falls off
    slowly without a step, no surface ends there: it is shading.
    """
    steps = np.arange(-INTO_GAP, ONTO_TISSUE + 1)
    sideways = np.array([-outward[1], outward[0]])
    points = edge + steps[None, :, None] * outward + ALONG[:, None, None] * sideways
    points = points.astype(np.float32)
    lines = cv2.remap(grey, points[..., 0], points[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    # The edge is not quite straight: the lines are aligned at their steps before they are averaged.
    profile = np.median(_aligned(lines.astype(np.float64)), axis=0)
    gap = float(profile[: INTO_GAP - 6].mean())
    near = float(profile[INTO_GAP + 5 : INTO_GAP + 11].mean())
    far = float(profile[INTO_GAP + 28 : INTO_GAP + 41].mean())
    top = max(near, far)
    if top - gap < 8.0:
        return EdgeKind.UNKNOWN
    rising = profile[: INTO_GAP + 28]
    width = float(((rising > gap + 0.2 * (top - gap)) & (rising < gap + 0.8 * (top - gap))).sum())
    turning = near < gap + TURNING_AWAY * (far - gap)
    if turning:
        # Grazing light darkens a contour too; a step within a few pixels distinguishes it from shading.
        step = float(np.max(profile[INTO_GAP : INTO_GAP + 8]) - np.min(profile[INTO_GAP - 8 : INTO_GAP + 1]))
        return EdgeKind.CONTOUR if step > 0.2 * (top - gap) else EdgeKind.SHADING
    return EdgeKind.SHADING if width > SHADING_WIDTH else EdgeKind.RIM


def _aligned(lines: Array) -> Array:
    """Lines (n, m) shifted by whole pixels so that their steepest rises coincide."""
    rise = lines[:, 4:] - lines[:, :-4]
    place = rise[:, : 2 * INTO_GAP].argmax(axis=1) + 2 - INTO_GAP
    shift = np.clip(place, -5, 5)
    columns = np.clip(np.arange(lines.shape[1])[None, :] + shift[:, None], 0, lines.shape[1] - 1)
    return np.take_along_axis(lines, columns, axis=1)

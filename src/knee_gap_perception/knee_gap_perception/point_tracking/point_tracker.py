"""One surface point, followed from image to image by the texture around it.

The point is defined by the first image. Every later image is registered against a patch of an earlier one:
the first image's as long as the surface looks alike, then a patch taken at a later image, whose own error
it inherits. So the error grows with the number of patches handed on (a few over a travel), not with the
number of images.

If the pose of the lens is known it predicts, with the surface's tangent plane, where the patch will be
and what shape it will have; otherwise the last image and even motion do.
"""

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np

from knee_gap_core.values.arrays import Array, Image
from knee_gap_core.values.edges import EdgeKind
from knee_gap_perception.camera.camera import Camera
from knee_gap_perception.point_tracking.patch_registration import (
    Patch,
    Registration,
    Surface,
    Warp,
    surface_around,
)
from knee_gap_perception.point_tracking.plane_kernel import strain_of, worst_deviation
from knee_gap_perception.point_tracking.tangent_plane import Prediction, TangentPlane, View

PATCH_HALF = 48  # [px] half side of a patch
SEARCH = 16  # [px] how far the point may be from its prediction
CROP_HALF = int(1.5 * PATCH_HALF) + SEARCH
MILD = (
    0.35  # change of shape, as logarithm of stretch or turn [rad], up to which an earlier patch still serves
)
FRESH = 0.80  # correlation above which a patch needs no successor
GOOD = 0.70  # correlation from which a new patch may be taken
CLEAR = 0.85  # share of the patch that must be seen, free of highlights, to take a new one
FAIR = 0.42  # correlation below which the point is not seen, if the pose predicts where it must be
FAIR_WIDE = 0.52  # the same if the pose predicts little, and the point is searched all around
WIDE = 6.0  # [px] standard deviation of the predicted place, from which the prediction is weak
FAIR_ALONE = 0.62  # the same without a pose: a highlight may carry the patch away
REST = 8  # images for which a patch that was not found is not tried
MINIMUM_SEEN = 0.35  # share of the patch
HANDOVER_ERROR = 0.05  # [px] error that a patch adds when it is taken from a later image
REGISTRATION_FLOOR = 0.06  # [px] below which no registration is believed
# Errors that grow with the parallax since the first image: light that moves, relief that is no plane. They
# stretch or shrink the parallax more than they turn it. Towards a contour the surface bends away; beside
# mere shading the light carries what is seen.
PARALLAX_ERROR = {  # [-] of the parallax, along it and across it
    EdgeKind.RIM: (0.0025, 0.0005),
    EdgeKind.CONTOUR: (0.0062, 0.001),
    EdgeKind.SHADING: (0.2, 0.02),
    EdgeKind.UNKNOWN: (0.0062, 0.001),
}
MOTION_ERROR = 4.0  # [px] by which a hand departs from even motion within an image, without a pose
SHAPE_ERROR = 0.06  # [-] by which the shape changes within an image, without a pose
MAXIMUM_PATCHES = 24
MOST_STRAIN = 2.5  # change of a predicted shape beyond which no patch is looked for
MOST_STRETCH = 1.8  # [-] of the window of the local mean and contrast with the patch


@dataclass(frozen=True)
class PointObservation:
    """The point in one image: position (2,) [px], its covariance (2, 2) [px^2], and whether it was seen."""

    position: Array
    covariance: Array
    seen: bool
    correlation: float


@dataclass
class _Anchor:
    """A patch and the image it came from: pixel (2,), view, shape (2, 2) against the first patch.

    `covariance` (2, 2) [px^2] is that of the point in that image, but for what grows with the `parallax` (2,)
    [px] since the first; `rest` counts images until it is tried again.
    """

    patch: Patch
    pixel: Array
    view: View | None
    shape: Array
    covariance: Array
    parallax: Array
    rest: int = 0


class PointTracker:
    """Follows one surface point through a stream of grey images."""

    def __init__(
        self,
        grey: Image,
        pixel: Array,
        dark_below: float,
        camera: Camera,
        view: View | None,
        kind: EdgeKind = EdgeKind.UNKNOWN,
    ) -> None:
        """Start at a pixel (2,) of an image (h, w); grey levels below `dark_below` are the gap.

        `kind` is that of the edge beside it.
        """
        self._parallax_error = PARALLAX_ERROR[kind]
        surface = surface_around(grey, pixel, CROP_HALF, dark_below)
        patch = Patch(surface, pixel, PATCH_HALF)
        self._anchors = [_Anchor(patch, pixel, view, np.eye(2), np.zeros((2, 2)), np.zeros(2))]
        self._plane = TangentPlane(camera.bearings(pixel), view) if view is not None else None
        self._warp = Warp(pixel, np.eye(2))
        self._velocity = np.zeros(2)
        self._darkness = dark_below / max(_level(grey, pixel), 1.0)
        self._covariance = np.zeros((2, 2))
        self._unseen = 0

    @property
    def first(self) -> PointObservation:
        """The point in the image that defines it."""
        return PointObservation(self._anchors[0].pixel, REGISTRATION_FLOOR**2 * np.eye(2), True, 1.0)

    @property
    def distance(self) -> float:
        """Distance [m] of the point from the lens of the first image, by the lens poses; NaN without any."""
        return float("nan") if self._plane is None else 1.0 / float(np.linalg.norm(self._plane.mean))

    @property
    def unseen(self) -> int:
        """Images since the point was last seen."""
        return self._unseen

    @property
    def patches(self) -> int:
        """Patches taken so far."""
        return len(self._anchors)

    def follow(self, grey: Image, camera: Camera, view: View | None) -> PointObservation:
        """The point in the next image (h, w), and the view it was taken from where that is known."""
        for index in self._candidates():
            anchor = self._anchors[index]
            prediction = self._predict(index, camera, view)
            found = self._find(anchor.patch, prediction, grey)
            believed = found is not None and _believable(found, prediction, self._fair(view, prediction))
            anchor.rest = 0 if believed else REST
            if found is not None and believed:
                return self._accept(index, found, prediction, grey, view)
        # The last one that was tried is that of the newest patch.
        return self._coast(prediction)

    def _find(self, patch: Patch, prediction: Prediction, grey: Image) -> Registration | None:
        """The patch where it is predicted; None if nothing can be seen of it there.

        Each prediction has a crop of its own: those of two patches may lie far apart, as after poses that
        were wrong, or that came back elsewhere.
        """
        if not _can_be_seen(prediction, grey):
            return None
        surface = self._surface(grey, prediction.warp.position, prediction.warp.shape)
        try:
            start = self._coarse(patch, surface, prediction)
            return patch.find(surface, start, prediction.covariance)
        except np.linalg.LinAlgError:
            return None  # a covariance or shape that is singular to the last digit

    def _surface(self, grey: Image, centre: Array, shape: Array) -> Surface:
        """Texture around a pixel, taken through a window of the patch's shape (2, 2) there.

        Shading leaves a band in the texture beside an edge, as wide as the window. Through a window that did
        not grow with the picture it would lag behind it, and the patch with it.
        """
        stretch = np.clip(np.linalg.norm(shape, axis=1), 1.0 / MOST_STRETCH, MOST_STRETCH)
        dark_below = self._darkness * _level(grey, centre)
        return surface_around(grey, centre, CROP_HALF, dark_below, stretch=(stretch[0], stretch[1]))

    def _candidates(self) -> list[int]:
        """Patches to try: the earliest that should look alike, then the newest."""
        mild: int | None = None
        for index, anchor in enumerate(self._anchors):
            anchor.rest = max(0, anchor.rest - 1)
            if mild is not None or anchor.rest:
                continue
            if strain_of(self._warp.shape @ np.linalg.inv(anchor.shape)) < MILD:
                mild = index
        newest = len(self._anchors) - 1
        return [newest] if mild is None or mild == newest else [mild, newest]

    def _fair(self, view: View | None, prediction: Prediction) -> float:
        """Correlation below which a patch was not found: in a wide search mere noise finds a likeness."""
        if self._plane is None or view is None:
            return FAIR_ALONE
        width = min(worst_deviation(prediction.covariance) / WIDE, 1.0)
        return FAIR + (FAIR_WIDE - FAIR) * width

    def _predict(self, index: int, camera: Camera, view: View | None) -> Prediction:
        anchor = self._anchors[index]
        if self._plane is not None and view is not None and anchor.view is not None:
            prediction = self._plane.predict(camera, anchor.view, anchor.pixel, view)
            if prediction is not None:
                return prediction
        growth = 1.0 + self._unseen
        warp = Warp(self._warp.position + self._velocity, self._warp.shape @ np.linalg.inv(anchor.shape))
        covariance = np.diag([(MOTION_ERROR * growth) ** 2] * 2 + [(SHAPE_ERROR * growth) ** 2] * 4)
        # What the last image did not measure of the point, this one has to.
        known = anchor.covariance + self._drift(anchor.parallax)
        excess = float(np.linalg.eigvalsh(self._covariance - known)[-1])
        covariance[:2, :2] += max(excess, 0.0) * np.eye(2)
        return Prediction(warp, covariance, np.zeros((6, 3)), warp.position - anchor.pixel)

    def _coarse(self, patch: Patch, surface: Surface, prediction: Prediction) -> Warp:
        """Best whole-pixel position around the prediction, the patch drawn as it should look there."""
        side = 2 * PATCH_HALF + 1
        warp = prediction.warp
        inverse = np.linalg.inv(warp.shape)
        centre = np.array([PATCH_HALF, PATCH_HALF], float)
        matrix = np.concatenate([inverse, (centre - inverse @ centre)[:, None]], axis=1)
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        drawn = cv2.warpAffine(patch.texture * patch.weight, matrix, (side, side), flags=flags)
        reach = int(np.clip(np.ceil(3.0 * worst_deviation(prediction.covariance)), 3, SEARCH))
        first = np.rint(warp.position - np.array(surface.origin)).astype(int) - PATCH_HALF - reach
        window = np.s_[first[1] : first[1] + side + 2 * reach, first[0] : first[0] + side + 2 * reach]
        score = cv2.matchTemplate(
            surface.texture[window] * surface.weight[window], drawn, cv2.TM_CCORR_NORMED
        )
        row, column = np.unravel_index(int((score - _penalty_of_place(reach)).argmax()), score.shape)
        return Warp(warp.position + np.array([column - reach, row - reach], float), warp.shape)

    def _coast(self, prediction: Prediction) -> PointObservation:
        """The prediction alone, while the point is not seen."""
        self._unseen += 1
        self._velocity = 0.8 * self._velocity
        newest = self._anchors[-1]
        self._warp = Warp(prediction.warp.position, prediction.warp.shape @ newest.shape)
        drift = self._drift(newest.parallax + prediction.parallax)
        self._covariance = newest.covariance + drift + prediction.covariance[:2, :2]
        return PointObservation(prediction.warp.position, self._covariance, False, 0.0)

    def _accept(
        self, index: int, found: Registration, prediction: Prediction, grey: Image, view: View | None
    ) -> PointObservation:
        anchor = self._anchors[index]
        parallax = anchor.parallax + prediction.parallax
        own = anchor.covariance + found.covariance[:2, :2] + REGISTRATION_FLOOR**2 * np.eye(2)
        covariance = own + self._drift(parallax)
        moved = found.warp.position - self._warp.position
        self._velocity = np.zeros(2) if self._unseen else 0.5 * self._velocity + 0.5 * moved
        self._unseen = 0
        self._warp = Warp(found.warp.position, found.warp.shape @ anchor.shape)
        self._covariance = covariance
        if self._plane is not None and view is not None:
            self._plane.learn(prediction, found.warp.parameters, found.covariance, view)
        newest = index == len(self._anchors) - 1
        strained = strain_of(found.warp.shape) > MILD or found.correlation < FRESH
        clear = found.correlation > GOOD and found.seen > CLEAR
        if newest and strained and clear and index < MAXIMUM_PATCHES:
            grown = own + HANDOVER_ERROR**2 * np.eye(2)
            surface = self._surface(grey, found.warp.position, np.eye(2))
            patch = Patch(surface, found.warp.position, PATCH_HALF)
            self._anchors.append(_Anchor(patch, found.warp.position, view, self._warp.shape, grown, parallax))
        return PointObservation(found.warp.position, covariance, True, found.correlation)

    def _drift(self, parallax: Array) -> Array:
        """Covariance (2, 2) [px^2] of the errors that grow with a parallax (2,) [px]."""
        along, across = np.square(self._parallax_error)
        size = float(parallax @ parallax)
        return np.asarray((along - across) * np.outer(parallax, parallax) + across * size * np.eye(2))


@lru_cache(maxsize=SEARCH)
def _penalty_of_place(reach: int) -> Array:
    """What is taken from the score (2 reach + 1, ...) of places away from the middle."""
    rows, columns = np.mgrid[0 : 2 * reach + 1, 0 : 2 * reach + 1]
    away = np.hypot(rows - reach, columns - reach) / reach
    return np.asarray(0.3 * away**2)


def _level(grey: Image, position: Array) -> float:
    """Brightness of the tissue around a pixel: the upper quartile of a sparse neighbourhood."""
    row, column = round(float(position[1])), round(float(position[0]))
    patch = grey[max(0, row - 24) : row + 25 : 4, max(0, column - 24) : column + 25 : 4]
    # Sorted: numpy's percentile costs ten times as much on so few.
    ordered = np.sort(patch, axis=None)
    return float(ordered[(3 * (ordered.size - 1)) // 4]) if ordered.size else 0.0


def _can_be_seen(prediction: Prediction, grey: Image) -> bool:
    """Whether a patch may be looked for where it is predicted: near the image, and not squeezed to a line."""
    position, shape = prediction.warp.position, prediction.warp.shape
    numbers = (position, shape, prediction.covariance)
    if not all(np.isfinite(values).all() for values in numbers):
        return False
    size = np.array([grey.shape[1], grey.shape[0]])
    near = bool((position > -CROP_HALF).all() and (position < size + CROP_HALF).all())
    return near and strain_of(shape) < MOST_STRAIN


def _believable(found: Registration, prediction: Prediction, fair: float) -> bool:
    away = found.warp.position - prediction.warp.position
    distance = float(away @ np.linalg.solve(prediction.covariance[:2, :2], away))
    return (
        found.correlation > fair
        and found.seen > MINIMUM_SEEN
        and distance < 25.0
        and strain_of(found.warp.shape) < 1.2
        and bool(np.isfinite(found.covariance).all())
    )

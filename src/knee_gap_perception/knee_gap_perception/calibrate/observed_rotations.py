"""Rotation of an oblique scope in its camera head in each view, by its notch or a second tracked body."""

from collections.abc import Sequence

import numpy as np

from knee_gap_core.values.arrays import Array
from knee_gap_core.values.rigid_transforms import inverse
from knee_gap_perception.calibrate.observations import Observations, common_angle, tracked_views, wrapped
from knee_gap_perception.calibrate.recording import Recording
from knee_gap_perception.calibrate.solvers.hand_eye import closed_form
from knee_gap_perception.camera.intrinsics import Intrinsics
from knee_gap_perception.camera.projection import LensModel
from knee_gap_perception.errors import PerceptionError
from knee_gap_perception.scope_rotation.shaft_axis import Mount, rotation_between, shaft_axis

FIXED_TURN = np.radians(2.0)  # smaller rotations count as none


def turns_by_notch(parts: Sequence[Observations]) -> list[Array]:
    """Rotation of the scope in each view of each part, by the notch."""
    angles = [np.array([view.notch_angle for view in seen.views]) for seen in parts]
    reference = common_angle(np.concatenate(angles), FIXED_TURN)
    if not np.isfinite(reference):
        raise PerceptionError(
            "the notch was not detected in any view: is the whole round field in the image, and lit?"
        )
    return [_held(wrapped(angle - reference)) for angle in angles]


def turns_by_body(
    recording: Recording, parts: Sequence[Observations], camera: Intrinsics, offset: float
) -> tuple[list[Array], Array]:
    """Rotation of the scope in each view of each part, by a second body, and its pose at rotation 0."""
    request = recording.request
    if request.mount is not Mount.CAMERA_HEAD or request.scope_pose_topic is None:
        raise PerceptionError(
            "a second body on the scope needs the first on the camera head: set --mount camera_head"
        )
    head, scope = recording.track(), recording.second_track(request.scope_pose_topic)
    views = [view.board for seen in parts for view in seen.views]
    stamps = np.array([view.stamp_ns for view in views], dtype=np.int64)
    stamps = stamps + round(offset * 1e9)
    both = head.covers(stamps) & scope.covers(stamps)
    if not both.any():
        raise PerceptionError("the two bodies are not tracked together in any view")
    relative = inverse(head.at(stamps)) @ scope.at(stamps)
    direction = shaft_axis(relative[both])[0].direction
    first = relative[both][0]
    turns = np.array([rotation_between(first, T, direction) for T in relative])
    reference = common_angle(turns[both], FIXED_TURN)
    nearest = np.flatnonzero(both)[np.abs(wrapped(turns[both] - reference)).argmin()]
    turns = np.where(both, wrapped(turns - turns[nearest]), np.nan)
    # The sign of the axis is chosen so that it points along the view, not back.
    tracked = tracked_views(views, turns, np.zeros(len(views)), head, offset)
    model = LensModel(camera.distortion_model, request.model.high_order)
    rough = min(closed_form(tracked, camera, model), key=lambda solver: solver.rms_px)
    if direction @ rough.T_body_lens[:3, 2] < 0:
        turns = -turns
    ends = np.cumsum([len(seen.views) for seen in parts])[:-1]
    return [_held(part) for part in np.split(turns, ends)], relative[nearest]


def _held(turns: Array) -> Array:
    """Rotations of a part of the bag; exactly 0 if the scope was held still according to the notch."""
    seen = turns[np.isfinite(turns)]
    return np.zeros_like(turns) if len(seen) and np.abs(seen).max() < FIXED_TURN else turns

"""Conversion of a tracked body to the pose of the lens that is fixed to it, with its error."""

from collections.abc import Iterable

import numpy as np

from knee_gap_core.values.arrays import Array
from knee_gap_core.values.poses import BodyPose, LensPose, rigid_transform
from knee_gap_core.values.quaternions import canonical, matrix, product, unit_quaternion
from knee_gap_core.values.rigid_transforms import quaternion_xyzw, skew
from knee_gap_perception.calibration.calibration import Calibration
from knee_gap_perception.scope_pose.pose_validity import (
    PoseValidity,
    Refusal,
    RefusalReason,
    ValidityParameters,
)
from knee_gap_perception.scope_pose.reference_body import relative_to
from knee_gap_perception.scope_pose.tracking_parameters import TrackingParameters, refuse_contradictions
from knee_gap_perception.scope_rotation.notch_tracker import NotchObservation
from knee_gap_perception.scope_rotation.rotated_poses import RotatedPoses, Tracked

NO_NOTCH_YET = (
    "no scope_notch received: is scope_rotation_notch set for segmentation_node, and do images arrive?"
)


class ScopeTracker:
    """Turns the poses of the tracked body, in the order in which they come, into poses of the lens."""

    def __init__(
        self,
        parameters: TrackingParameters | None = None,
        validity: ValidityParameters | None = None,
        calibration: Calibration | None = None,
        *,
        by_notch: bool = False,
    ) -> None:
        """`by_notch`: the notch in each image shows how far the scope is turned in its camera head.

        Raises PerceptionError for settings that contradict each other, or the calibration.
        """
        self.parameters = parameters or TrackingParameters()
        self.calibration = calibration
        refuse_contradictions(self.parameters, calibration, by_notch=by_notch)
        self.validity = PoseValidity(validity)
        self.reference_validity = PoseValidity(validity)
        self.turn_validity = PoseValidity(validity)
        self.accepted_count = 0
        # The bodies of the latest frame that was accepted.
        self.latest: Tracked | None = None
        T_body_lens = calibration.body_to_lens() if calibration else self.parameters.body_to_lens()
        self._T_body_lens = T_body_lens
        self._q_body_lens = quaternion_xyzw(T_body_lens)
        self._body_covariance = self._covariance_of_body()
        # An image's stamp plus this is the tracker's clock.
        clock = calibration.clock if calibration else None
        self._clock_offset_ns = round(clock.offset * 1e9) if clock else 0
        self.turn = 0.0
        self._by_notch = RotatedPoses(self._lens_by_notch) if by_notch else None
        # Why the latest image had no pose, if its notch is needed for it; empty if it had one.
        self.notch_flaw = NO_NOTCH_YET if by_notch else ""

    @property
    def by_notch(self) -> bool:
        """Whether the rotation of the scope is taken from the notch in each image."""
        return self._by_notch is not None

    @property
    def follows_rotation(self) -> bool:
        """Whether it is followed how far the scope is turned, by the notch or a second body."""
        return self.by_notch or bool(self.parameters.scope_rotation_body)

    def take(self, body: BodyPose, others: Iterable[BodyPose] = ()) -> list[LensPose | Refusal]:
        """Take a frame of the tracker, as `update`; return all that follows from it."""
        result = self.update(body, others)
        return [*([] if result is None else [result]), *self._at_images()]

    def take_notch(self, observation: NotchObservation) -> list[LensPose | Refusal]:
        """Take where the notch is in an image; return the poses of the lens that it made possible."""
        if self._by_notch is None:
            return []
        self._by_notch.add_observation(observation)
        return self._at_images()

    def update(self, body: BodyPose, others: Iterable[BodyPose] = ()) -> LensPose | Refusal | None:
        """Return the pose of the lens at the stamp of `body`, or why there is none.

        None where the body is sound and the pose waits for the notch of an image.

        `others` are the other bodies of the same frame of the tracker, if it has any: a body that has
        swapped its label with one of them is refused. The reference body, if there is to be one, must be
        among them and as sound as the scope.
        """
        bodies = tuple(others)
        name = self.parameters.reference_body
        reference = next((other for other in bodies if name and other.name == name), None)
        # Both are looked at in every frame, whatever the other one's fault: their history must have no holes.
        refusal = self.validity.check(body, bodies)
        if name and (fault := self._reference_fault(body, reference, bodies)) and refusal is None:
            refusal = self.validity.refuse(body, RefusalReason.NO_REFERENCE, fault)
        turn_name = self.parameters.scope_rotation_body
        second = next((other for other in bodies if turn_name and other.name == turn_name), None)
        if turn_name and (fault := self._rotation_fault(body, second, bodies)) and refusal is None:
            refusal = self.validity.refuse(body, RefusalReason.NO_TURN, fault)
        if refusal is not None:
            return refusal
        self.latest = tracked = Tracked(body.stamp_ns - self._clock_offset_ns, body, reference)
        if self._by_notch is not None:
            self._by_notch.add_tracked(tracked)
            return None
        self.accepted_count += 1
        if second is not None:
            self._note_rotation(body, second)
        return self._lens_pose(tracked, self.turn, 0.0)

    def reset(self) -> None:
        """Forget all poses, as after a change of the set-up; the counts go on."""
        self.validity.reset()
        self.reference_validity.reset()
        self.turn_validity.reset()
        if self._by_notch is not None:
            self._by_notch.clear()

    def body_to_lens(self, turn: float) -> Array:
        """`T_body_lens` (4, 4) at a turn [rad] of the scope in its camera head."""
        if self.calibration is not None and turn:
            return self.calibration.body_to_lens(turn)
        return self._T_body_lens

    def _at_images(self) -> list[LensPose | Refusal]:
        if self._by_notch is None:
            return []
        reported: list[LensPose | Refusal] = []
        for lens in self._by_notch.ready():
            if isinstance(lens, LensPose):
                self.accepted_count += 1
                self.notch_flaw = ""
                reported.append(lens)
            else:
                self.notch_flaw = lens.reason
                refusal = Refusal(lens.stamp_ns, RefusalReason.NO_TURN, lens.reason)
                self.validity.counts[refusal.reason] += 1
                reported.append(refusal)
        return reported

    def _lens_by_notch(self, tracked: Tracked, angle: float, angle_error: float) -> LensPose:
        assert self.calibration is not None  # by_notch is refused without one
        self.turn = self.calibration.scope_rotation(angle)
        return self._lens_pose(tracked, self.turn, angle_error)

    def _reference_fault(
        self, body: BodyPose, reference: BodyPose | None, bodies: tuple[BodyPose, ...]
    ) -> str | None:
        what = f"the reference body '{self.parameters.reference_body}'"
        return _fault(self.reference_validity, what, reference, body, bodies)

    def _rotation_fault(
        self, body: BodyPose, second: BodyPose | None, bodies: tuple[BodyPose, ...]
    ) -> str | None:
        what = f"the body '{self.parameters.scope_rotation_body}' on the scope"
        return _fault(self.turn_validity, what, second, body, bodies)

    def _note_rotation(self, body: BodyPose, second: BodyPose) -> None:
        assert self.calibration is not None  # scope_rotation_body is refused without one
        head = rigid_transform(body.position, body.quaternion_xyzw)
        scope = rigid_transform(second.position, second.quaternion_xyzw)
        self.turn = self.calibration.scope_rotation_of_body(np.linalg.inv(head) @ scope)

    def _lens_pose(self, tracked: Tracked, turn: float, turn_error: float) -> LensPose:
        """Pose of the lens at a turn [rad] of the scope, with its standard error."""
        parameters, body = self.parameters, tracked.body
        q_world_body = unit_quaternion(body.quaternion_xyzw)
        T_body_lens, q_body_lens = self._T_body_lens, self._q_body_lens
        if turn:
            T_body_lens = self.body_to_lens(turn)
            q_body_lens = quaternion_xyzw(T_body_lens)
        R_world_body = matrix(q_world_body)
        lever = R_world_body @ T_body_lens[:3, 3].copy()
        quaternion = canonical(product(q_world_body, q_body_lens))
        covariance = self._covariance(lever)
        if turn:
            covariance = covariance + self._axis_covariance(turn)
        if turn_error and self.calibration is not None:
            moved = np.kron(np.eye(2), R_world_body) @ self.calibration.motion_by_rotation(T_body_lens)
            covariance = covariance + turn_error**2 * np.outer(moved, moved)
        lens = LensPose(
            stamp_ns=tracked.stamp_ns,
            frame_id=parameters.frame_id,
            child_frame_id=parameters.child_frame_id,
            position=body.position + lever,
            quaternion_xyzw=quaternion,
            covariance=covariance,
            scope_rotation=turn,
        )
        if tracked.reference is None:
            return lens
        return relative_to(lens, tracked.reference, self._body_covariance)

    def _covariance(self, lever: Array) -> Array:
        """Covariance (6, 6) of the lens pose; a small rotation r moves the lens by r x lever."""
        covariance = self._body_covariance
        if self.parameters.translation_error_at == "lens":
            return covariance
        J = np.eye(6)
        J[:3, 3:] = -skew(lever)
        return np.asarray(J @ covariance @ J.T)

    def _axis_covariance(self, turn: float) -> Array:
        """What the error of the shaft's axis adds at a turn: nothing at the calibrated one."""
        oblique = self.calibration.oblique if self.calibration else None
        if oblique is None or oblique.axis is None:
            return np.zeros((6, 6))
        chord = 2.0 * np.sin(0.5 * turn)
        return np.diag(
            np.repeat([(chord * oblique.axis_shift_sigma) ** 2, (chord * oblique.axis_tilt_sigma) ** 2], 3)
        )

    def _covariance_of_body(self) -> Array:
        translation, rotation = self.parameters.translation_error, self.parameters.rotation_error
        return np.diag(np.repeat([translation**2 / 3.0, rotation**2 / 3.0], 3))


def _fault(
    validity: PoseValidity, what: str, other: BodyPose | None, body: BodyPose, bodies: tuple[BodyPose, ...]
) -> str | None:
    """Why another body that the lens pose needs cannot be used with the scope's; None where it can."""
    if other is None:
        return f"{what} is not in the frame"
    if other.stamp_ns != body.stamp_ns:
        return f"{what} has another stamp than the scope"
    refusal = validity.check(other, (body, *(rest for rest in bodies if rest is not other)))
    return None if refusal is None else f"{what}: {refusal.detail}"

"""Conversion of a tracked body to the pose of the lens that is fixed to it, with its error."""

from collections.abc import Iterable
from dataclasses import dataclass, field, fields
from math import isnan, nan, pi, radians

import numpy as np
from scipy.spatial.transform import Rotation

from knee_gap_core.values.arrays import Array
from knee_gap_core.values.poses import BodyPose, LensPose, rigid_transform
from knee_gap_core.values.quaternions import canonical, matrix, product, unit_quaternion
from knee_gap_core.values.rigid_transforms import quaternion_xyzw, skew
from knee_gap_perception.calibration.calibration import Calibration
from knee_gap_perception.errors import PerceptionError
from knee_gap_perception.parameters import check_parameters
from knee_gap_perception.scope_pose.pose_validity import (
    PoseValidity,
    Refusal,
    RefusalReason,
    ValidityParameters,
)
from knee_gap_perception.scope_pose.reference_body import relative_to
from knee_gap_perception.scope_rotation.notch_tracker import NotchObservation
from knee_gap_perception.scope_rotation.rotated_poses import RotatedPoses, Tracked
from knee_gap_perception.scope_rotation.shaft_axis import Mount

# Parameters of the place of the lens, unless a calibration has it.
NO_NOTCH_YET = (
    "no scope_notch received: is scope_rotation_notch set for segmentation_node, and do images arrive?"
)
PLACE_OF_LENS = ("body_to_shaft_translation", "body_to_shaft_quaternion_xyzw", "oblique_angle")


@dataclass(frozen=True)
class TrackingParameters:
    """Where the lens sits on the tracked body, and how well the tracker knows it.

    T_body_lens = translate(body_to_shaft_translation) rotate(body_to_shaft_quaternion_xyzw)
    rotate_x(oblique_angle): the shaft frame has its origin at the lens, z along the shaft to the tip, x to
    the right and y down in the picture of a straight (0 degree) scope; the oblique tip then turns the view
    about x, so that a positive angle looks up, to the side of the picture's top. A calibration that gives the
    lens frame itself goes in with oblique_angle 0.

    Raises PerceptionError for values outside their range and for a quaternion that is not of unit length.
    """

    frame_id: str = field(
        default="world", metadata={"description": "Name of the tracker's frame in what is published"}
    )
    child_frame_id: str = field(
        default="arthroscope_optical",
        metadata={"description": "Name of the optical frame of the lens: z along the view, x right, y down"},
    )
    body_to_shaft_translation: tuple[float, ...] = field(
        default=(nan, nan, nan),
        metadata={
            "description": "Position of the lens in the tracked body, x y z [m]; NaN is not known, and then "
            "a calibration_file has to give it",
            "range": (-2.0, 2.0),
            "nan": True,
        },
    )
    body_to_shaft_quaternion_xyzw: tuple[float, ...] = field(
        default=(0.0, 0.0, 0.0, 1.0),
        metadata={
            "description": "Rotation that maps shaft coordinates (z to the tip, x right, y down) to the "
            "tracked body, x y z w",
            "range": (-1.0, 1.0),
        },
    )
    oblique_angle: float = field(
        default=radians(30.0),
        metadata={
            "description": "Angle of the view against the shaft [rad], positive to the top of the picture: "
            "0.5236 is the usual 30 degree scope",
            "range": (-pi / 2, pi / 2),
        },
    )
    translation_error: float = field(
        default=0.0367e-3,
        metadata={
            "description": "RMS length of the error vector of the tracked position [m] (the paper's DT)",
            "range": (0.0, 0.1),
        },
    )
    rotation_error: float = field(
        default=radians(0.004),
        metadata={
            "description": "RMS length of the error vector of the tracked rotation [rad] (the paper's omega)",
            "range": (0.0, 0.5),
        },
    )
    translation_error_at: str = field(
        default="lens",
        metadata={
            "description": "Point whose error translation_error is: lens, as in the paper, or body, to which "
            "the rotation error on the lever from body to lens is added",
            "choices": ("lens", "body"),
        },
    )

    reference_body: str = field(
        default="",
        metadata={
            "description": "Tracked body of the leg in whose frame the lens pose is given, with that "
            "name as frame; empty gives it in frame_id"
        },
    )
    scope_rotation_body: str = field(
        default="",
        metadata={
            "description": "Second tracked body, on an oblique scope whose camera head carries the first: it "
            "shows how far the scope is turned; needs a calibration_file made with it; empty: not turned"
        },
    )

    def __post_init__(self) -> None:
        for name, length in (("body_to_shaft_translation", 3), ("body_to_shaft_quaternion_xyzw", 4)):
            # ROS hands lists as arrays.
            value = tuple(float(number) for number in getattr(self, name))
            object.__setattr__(self, name, value)
            if len(value) != length:
                raise PerceptionError(f"{name} must have {length} numbers, not {len(value)}")
        check_parameters(self)
        norm = float(np.linalg.norm(self.body_to_shaft_quaternion_xyzw))
        if abs(norm - 1.0) > 1e-3:
            raise PerceptionError(
                f"body_to_shaft_quaternion_xyzw must be of length 1 within 0.001, not {norm:.6g}"
            )

    @property
    def other_bodies(self) -> dict[str, str]:
        """Topics of the bodies that are needed beside the scope's, by the names of the bodies."""
        topics = {
            self.reference_body: "reference_body/pose",
            self.scope_rotation_body: "scope_rotation_body/pose",
        }
        return {name: topic for name, topic in topics.items() if name}

    def body_to_lens(self) -> Array:
        """Return `T_body_lens` (4, 4), which maps lens coordinates to body coordinates."""
        T_body_shaft = rigid_transform(self.body_to_shaft_translation, self.body_to_shaft_quaternion_xyzw)
        tip = Rotation.from_rotvec([self.oblique_angle, 0.0, 0.0]).as_quat()
        return T_body_shaft @ rigid_transform(np.zeros(3), tip)


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
        _refuse_contradictions(self.parameters, calibration, by_notch=by_notch)
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


def _refuse_contradictions(
    parameters: TrackingParameters, calibration: Calibration | None, *, by_notch: bool
) -> None:
    """Raise PerceptionError if two settings contradict each other, or one needs another."""
    placed = not any(isnan(number) for number in parameters.body_to_shaft_translation)
    if by_notch and parameters.scope_rotation_body:
        raise PerceptionError(
            "scope_rotation_notch and scope_rotation_body both measure the scope's rotation: leave one "
            "of them out"
        )
    if calibration is None:
        if by_notch:
            raise PerceptionError("scope_rotation_notch needs a calibration_file of calibrate oblique")
        if parameters.scope_rotation_body:
            raise PerceptionError("scope_rotation_body needs a calibration_file that was made with that body")
        if not placed:
            raise PerceptionError(
                "where the lens sits on the tracked body is not known: give calibration_file, or "
                "body_to_shaft_translation and body_to_shaft_quaternion_xyzw"
            )
        return
    calibration.require_lens()
    if by_notch:
        calibration.require_notch()
    defaults = {field.name: field.default for field in fields(TrackingParameters)}
    # NaN, which is not given, is unlike itself.
    others = [name for name in PLACE_OF_LENS[1:] if getattr(parameters, name) != defaults[name]]
    given = [PLACE_OF_LENS[0], *others] if placed else others
    if given:
        raise PerceptionError(
            f"the place of the lens is in calibration_file and in {', '.join(given)}: leave one of them out"
        )
    oblique = calibration.oblique
    by_body = oblique is not None and oblique.T_head_scope is not None and oblique.axis is not None
    if parameters.scope_rotation_body and not by_body:
        raise PerceptionError(
            f"scope_rotation_body is '{parameters.scope_rotation_body}', and the calibration knows no second "
            f"body on "
            "the scope: run calibrate oblique --scope-pose-topic"
        )
    if (
        by_body
        and not by_notch
        and not parameters.scope_rotation_body
        and calibration.require_lens().mount is Mount.CAMERA_HEAD
    ):
        raise PerceptionError(
            "the calibration was made with a second body on the scope: name it in scope_rotation_body, or "
            "the "
            "turn of the scope is not known"
        )

"""Where the lens is: a tracked body, and the scope fixed to it, to the pose of the lens with its error."""

from collections.abc import Iterable
from dataclasses import dataclass, field
from math import pi, radians

import numpy as np
from scipy.spatial.transform import Rotation

from knee_gap_perception.errors import PerceptionError
from knee_gap_perception.parameters import check_parameters
from knee_gap_perception.pose_validity import PoseValidity, Refusal, RefusalReason, ValidityParameters
from knee_gap_perception.poses import Array, BodyPose, LensPose, cross_matrix, rigid_transform
from knee_gap_perception.reference_body import relative_to


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
        default=(0.0, 0.0, 0.0),
        metadata={"description": "Position of the lens in the tracked body, x y z [m]", "range": (-2.0, 2.0)},
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

    def body_to_lens(self) -> Array:
        """Return `T_body_lens` (4, 4), which maps lens coordinates to body coordinates."""
        T_body_shaft = rigid_transform(self.body_to_shaft_translation, self.body_to_shaft_quaternion_xyzw)
        tip = Rotation.from_rotvec([self.oblique_angle, 0.0, 0.0]).as_quat()
        return T_body_shaft @ rigid_transform(np.zeros(3), tip)


class ScopeTracker:
    """Turns the poses of the tracked body, in the order in which they come, into poses of the lens."""

    def __init__(
        self, parameters: TrackingParameters | None = None, validity: ValidityParameters | None = None
    ) -> None:
        self.parameters = parameters or TrackingParameters()
        self.validity = PoseValidity(validity)
        self.reference_validity = PoseValidity(validity)
        self.accepted_count = 0
        T_body_lens = self.parameters.body_to_lens()
        self._R_body_lens = Rotation.from_matrix(T_body_lens[:3, :3])
        self._lever = T_body_lens[:3, 3]

    def update(self, body: BodyPose, others: Iterable[BodyPose] = ()) -> LensPose | Refusal:
        """Return the pose of the lens at the stamp of `body`, or why there is none.

        `others` are the other bodies of the same frame of the tracker, if it tells them: a body that has
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
        if refusal is not None:
            return refusal
        self.accepted_count += 1
        lens = self._lens_pose(body)
        return lens if reference is None else relative_to(lens, reference, self._body_covariance())

    def reset(self) -> None:
        """Start afresh, as after a change of the set-up; the counts go on."""
        self.validity.reset()
        self.reference_validity.reset()

    def _reference_fault(
        self, body: BodyPose, reference: BodyPose | None, bodies: tuple[BodyPose, ...]
    ) -> str | None:
        name = self.parameters.reference_body
        if reference is None:
            return f"the reference body '{name}' is not in the frame"
        if reference.stamp_ns != body.stamp_ns:
            return f"the reference body '{name}' has another stamp than the scope"
        rest = tuple(other for other in bodies if other is not reference)
        refusal = self.reference_validity.check(reference, (body, *rest))
        return None if refusal is None else f"reference body '{name}': {refusal.detail}"

    def _lens_pose(self, body: BodyPose) -> LensPose:
        parameters = self.parameters
        R_world_body = Rotation.from_quat(body.quaternion_xyzw)
        lever = R_world_body.apply(self._lever)
        quaternion = (R_world_body * self._R_body_lens).as_quat(canonical=True)
        return LensPose(
            stamp_ns=body.stamp_ns,
            frame_id=parameters.frame_id,
            child_frame_id=parameters.child_frame_id,
            position=body.position + lever,
            quaternion_xyzw=quaternion,
            covariance=self._covariance(lever),
        )

    def _covariance(self, lever: Array) -> Array:
        """Covariance (6, 6) of the lens pose; a small rotation r moves the lens by r x lever."""
        covariance = self._body_covariance()
        if self.parameters.translation_error_at == "lens":
            return covariance
        J = np.eye(6)
        J[:3, 3:] = -cross_matrix(lever)
        return np.asarray(J @ covariance @ J.T)

    def _body_covariance(self) -> Array:
        translation, rotation = self.parameters.translation_error, self.parameters.rotation_error
        return np.diag(np.repeat([translation**2 / 3.0, rotation**2 / 3.0], 3))

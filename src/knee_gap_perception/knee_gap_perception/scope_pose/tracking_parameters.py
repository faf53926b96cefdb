"""Parameters of the tracking: where the lens sits on the tracked body, and which bodies are needed."""

from dataclasses import dataclass, field, fields
from math import isnan, nan, pi, radians

import numpy as np
from scipy.spatial.transform import Rotation

from knee_gap_core.values.arrays import Array
from knee_gap_core.values.poses import rigid_transform
from knee_gap_perception.calibration.calibration import Calibration
from knee_gap_perception.errors import PerceptionError
from knee_gap_perception.parameters import check_parameters
from knee_gap_perception.scope_rotation.shaft_axis import Mount

# Parameters of the place of the lens, unless a calibration has it.
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


def refuse_contradictions(
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
            "body on the scope: run calibrate oblique --scope-pose-topic"
        )
    if (
        by_body
        and not by_notch
        and not parameters.scope_rotation_body
        and calibration.require_lens().mount is Mount.CAMERA_HEAD
    ):
        raise PerceptionError(
            "the calibration was made with a second body on the scope: name it in scope_rotation_body, or "
            "the rotation of the scope is not known"
        )

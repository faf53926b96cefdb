"""The calibration of one scope: camera, lens on the tracked body, rotation in the camera head, tip, clock."""

import hashlib
import json
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from knee_gap_core.values.arrays import Array
from knee_gap_core.values.rigid_transforms import rigid
from knee_gap_perception.camera.intrinsics import Intrinsics
from knee_gap_perception.camera.medium import AIR, Medium
from knee_gap_perception.errors import PerceptionError
from knee_gap_perception.scope_rotation.notch import NotchShape
from knee_gap_perception.scope_rotation.shaft_axis import Mount, ShaftAxis, rotated_lens, rotation_between


@dataclass(frozen=True)
class LensOnBody:
    """The pose of the lens on the tracked body, estimated by `hand_eye`.

    `covariance` (6, 6) is that of the twist (rotation [rad], translation [m]) of `T_body_lens` in the lens
    frame; all views share this error. `rotation_error` [rad] and `translation_error` [m] are RMS errors of
    the tracked body.
    """

    translation: Array
    quaternion_xyzw: Array
    covariance: Array
    mount: Mount
    rotation_error: float
    translation_error: float
    left_out_rms_px: float
    view_count: int

    @property
    def T_body_lens(self) -> Array:  # noqa: N802 - frames are in the name
        """The lens on the body (4, 4), at the calibrated rotation of the scope."""
        return rigid(Rotation.from_quat(self.quaternion_xyzw).as_matrix(), self.translation)


@dataclass(frozen=True)
class Oblique:
    """Reference of the scope's rotation in its camera head: the shaft's axis and the calibrated rotation.

    `notch_angle` [rad] is the direction of the notch, NaN if it was not detected. `T_head_scope` (4, 4) is
    the pose of a second tracked body on the scope relative to the one on the camera head, None without one.
    `notch_shape` is the shape of the notch, None if it was not detected or if an older file does not have it.
    """

    notch_angle: float
    axis: ShaftAxis | None
    axis_tilt_sigma: float
    axis_shift_sigma: float
    T_head_scope: Array | None = None
    notch_shape: NotchShape | None = None


@dataclass(frozen=True)
class Tip:
    """The scope's tip on the body (3,) [m], its covariance (3, 3) [m^2] and the RMS of the pivoting [m]."""

    position: Array
    covariance: Array
    rms: float


@dataclass(frozen=True)
class Clock:
    """Time offset from an image's stamp to the tracker's clock [s], its standard error, and its source."""

    offset: float
    sigma: float
    source: str


@dataclass(frozen=True)
class Calibration:
    """The calibration of one scope, for images of one size. Parts that were not calibrated are None.

    `medium` is the medium around the board.
    """

    width_px: int
    height_px: int
    camera: Intrinsics | None = None
    lens: LensOnBody | None = None
    oblique: Oblique | None = None
    tip: Tip | None = None
    clock: Clock | None = None
    medium: Medium = AIR

    @property
    def hash(self) -> str:
        """SHA-256 of the content, the same wherever and whenever the file is written."""
        text = json.dumps(content_of(self), sort_keys=True, separators=(",", ":"))
        return hashlib.sha256(text.encode()).hexdigest()

    def require_image_size(self, width_px: int, height_px: int) -> None:
        """Raise PerceptionError for images of another size than the calibration's."""
        if (width_px, height_px) != (self.width_px, self.height_px):
            raise PerceptionError(
                f"the calibration was made for images of {self.width_px}x{self.height_px} px, not "
                f"{width_px}x{height_px} px: calibrate again at this size"
            )

    def require_camera(self) -> Intrinsics:
        """The intrinsics. Raises PerceptionError if they were not calibrated."""
        if self.camera is None:
            raise PerceptionError("the calibration has no camera: run calibrate intrinsics")
        return self.camera

    def require_lens(self) -> LensOnBody:
        """The lens on the body. Raises PerceptionError if it was not calibrated."""
        if self.lens is None:
            raise PerceptionError("the calibration has no pose of the lens: run calibrate hand_eye")
        return self.lens

    def require_notch(self) -> NotchShape:
        """The shape of the notch, if all values are known that are needed to use its angle.

        Raises PerceptionError if one is not.
        """
        oblique = self.oblique
        if oblique is None or oblique.notch_shape is None or not np.isfinite(oblique.notch_angle):
            raise PerceptionError("the calibration does not know the notch: run calibrate oblique")
        if oblique.axis is None and self.require_lens().mount is Mount.CAMERA_HEAD:
            raise PerceptionError("the calibration has no rotation axis of the scope: run calibrate oblique")
        return oblique.notch_shape

    def body_to_lens(self, scope_rotation: float = 0.0) -> Array:
        """`T_body_lens` (4, 4) at a rotation [rad] of the scope in its camera head since the calibration.

        Raises PerceptionError if the lens, or for a rotated scope its axis, was not calibrated.
        """
        lens = self.require_lens()
        return rotated_lens(
            lens.T_body_lens, scope_rotation, lens.mount, self.oblique.axis if self.oblique else None
        )

    def motion_by_rotation(self, T_body_lens: Array) -> Array:
        """Derivative (6,) of the lens pose (4, 4) on the body by the scope's rotation, in the body frame.

        Position [m/rad], rotation [-]. Raises PerceptionError if the lens was not calibrated.
        """
        position, rotation = np.zeros(3), -T_body_lens[:3, 2]
        axis = self.oblique.axis if self.oblique else None
        if self.require_lens().mount is Mount.CAMERA_HEAD and axis is not None:
            position = np.cross(axis.direction, T_body_lens[:3, 3] - axis.point)
            rotation = rotation + axis.direction
        return np.concatenate([position, rotation])

    def tracking_parameters(self) -> dict[str, list[float] | float]:
        """Parameters of `tracking_node` from this calibration, by name.

        Raises PerceptionError if the lens was not calibrated.
        """
        lens = self.require_lens()
        return {
            "body_to_shaft_translation": _numbers(lens.translation),
            "body_to_shaft_quaternion_xyzw": _numbers(lens.quaternion_xyzw),
            "oblique_angle": 0.0,
        }

    def scope_rotation(self, notch_angle: float) -> float:
        """Rotation [rad], in (-pi, pi], for a notch at an angle [rad].

        Raises PerceptionError if the notch was not calibrated.
        """
        if self.oblique is None or not np.isfinite(self.oblique.notch_angle):
            raise PerceptionError("the calibration does not know the notch: run calibrate oblique")
        turn = (notch_angle - self.oblique.notch_angle + np.pi) % (2 * np.pi) - np.pi
        return float(turn)

    def scope_rotation_of_body(self, T_head_scope: Array) -> float:
        """Rotation [rad] by a second body on the scope, from its pose (4, 4) in the frame of the first.

        Raises PerceptionError if the second body was not calibrated.
        """
        if self.oblique is None or self.oblique.T_head_scope is None or self.oblique.axis is None:
            raise PerceptionError(
                "the calibration has no second body on the scope: run calibrate oblique --scope-pose-topic"
            )
        return rotation_between(self.oblique.T_head_scope, T_head_scope, self.oblique.axis.direction)

    def with_parts(self, width_px: int, height_px: int, **parts: Any) -> "Calibration":
        """The calibration with some parts replaced. Raises PerceptionError for another image size."""
        self.require_image_size(width_px, height_px)
        return replace(self, **parts)


def content_of(calibration: Calibration) -> dict[str, Any]:
    """Content of a calibration file, which its hash is computed from."""
    camera, lens, oblique = calibration.camera, calibration.lens, calibration.oblique
    tip, clock = calibration.tip, calibration.clock
    content: dict[str, Any] = {
        "image": {"width_px": calibration.width_px, "height_px": calibration.height_px}
    }
    # Left out for air, so that older files, which do not have it, keep their hash.
    if calibration.medium != AIR:
        content["medium"] = calibration.medium.value
    if camera is not None:
        content["camera"] = {
            "distortion_model": camera.distortion_model,
            "k": list(camera.k),
            "d": list(camera.d),
            "covariance": _numbers(camera.covariance),
            "rms_px": camera.rms_px,
            "sigma_px": camera.sigma_px,
            "design_effect": camera.design_effect,
            "view_count": camera.view_count,
            "point_count": camera.point_count,
        }
    if lens is not None:
        content["lens"] = {
            "mount": str(lens.mount),
            "translation": _numbers(lens.translation),
            "quaternion_xyzw": _numbers(lens.quaternion_xyzw),
            "covariance": _numbers(lens.covariance),
            "rotation_error": lens.rotation_error,
            "translation_error": lens.translation_error,
            "left_out_rms_px": lens.left_out_rms_px,
            "view_count": lens.view_count,
        }
    if oblique is not None:
        content["oblique"] = {
            "notch_angle": oblique.notch_angle,
            "axis_direction": _numbers(oblique.axis.direction) if oblique.axis else None,
            "axis_point": _numbers(oblique.axis.point) if oblique.axis else None,
            "axis_tilt_sigma": oblique.axis_tilt_sigma,
            "axis_shift_sigma": oblique.axis_shift_sigma,
            # Conversion of a rotation matrix to a quaternion and back would change the hash by rounding.
            "T_head_scope": _numbers(oblique.T_head_scope) if oblique.T_head_scope is not None else None,
        }
        # Left out if it is unknown, so that older files keep their hash.
        if oblique.notch_shape is not None:
            content["oblique"]["notch_depth"] = oblique.notch_shape.depth
            content["oblique"]["notch_width"] = oblique.notch_shape.width
    if tip is not None:
        content["tip"] = {
            "position": _numbers(tip.position),
            "covariance": _numbers(tip.covariance),
            "rms": tip.rms,
        }
    if clock is not None:
        content["clock"] = {"time_offset": clock.offset, "sigma": clock.sigma, "source": clock.source}
    return content


def _numbers(array: Array) -> list[float]:
    return [float(value) for value in np.ravel(array)]

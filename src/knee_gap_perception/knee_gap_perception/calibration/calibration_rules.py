"""Validation rules for a calibration, since a file with a correct hash can still contain invalid values."""

import numpy as np

from knee_gap_core.values.arrays import Array
from knee_gap_perception.calibration.calibration import Calibration, LensOnBody, Oblique
from knee_gap_perception.camera.camera_info import MODELS
from knee_gap_perception.camera.intrinsics import Intrinsics

# The largest image that is read [px], and the largest offset that calibration looks for [s].
MOST_PX = 16_384
MOST_CLOCK_OFFSET = 10.0
# Tolerance for rounding in the file, and of inverted covariances.
UNIT_TOLERANCE = 1e-6
CORRELATION_TOLERANCE = 1e-6


def broken_rule(calibration: "Calibration") -> str:
    """Return the first rule that a calibration breaks, in words; empty if it breaks none."""
    for size in (calibration.width_px, calibration.height_px):
        if not 1 <= size <= MOST_PX:
            return f"the image's size must lie in [1, {MOST_PX}] px, not {size}"
    return (
        _camera_flaw(calibration.camera)
        or _lens_flaw(calibration.lens)
        or _oblique_flaw(calibration.oblique)
        or _tip_flaw(calibration)
        or _clock_flaw(calibration)
    )


def covariance_flaw(covariance: Array, *, may_be_fixed: int = 0) -> str:
    """Return why a matrix (n, n) is not a covariance of n unknowns; empty if it is.

    Only the last `may_be_fixed` unknowns may have no variance; others would be treated as exact.
    """
    if not np.isfinite(covariance).all():
        return "has entries that are not finite"
    variances = np.diagonal(covariance)
    free = variances != 0.0
    if (variances < 0.0).any() or not free[: len(variances) - may_be_fixed].all():
        return "has a variance that is not above 0"
    if covariance[~free].any() or covariance[:, ~free].any():
        return "has a covariance with an unknown of no variance"
    sigma = np.sqrt(variances[free])
    correlation = covariance[np.ix_(free, free)] / np.outer(sigma, sigma)
    if not np.isfinite(correlation).all():
        return "has entries that are too large or too small"
    if not np.allclose(correlation, correlation.T, rtol=0.0, atol=CORRELATION_TOLERANCE):
        return "is not symmetric"
    if np.linalg.eigvalsh(correlation).min() < -CORRELATION_TOLERANCE:
        return "is not positive semidefinite"
    return ""


def _camera_flaw(camera: Intrinsics | None) -> str:
    if camera is None:
        return ""
    if camera.distortion_model not in MODELS:
        return f"camera: the distortion model must be one of {', '.join(MODELS)}"
    if len(camera.k) != 9 or not np.isfinite(camera.k).all() or not np.isfinite(camera.d).all():
        return "camera: k must be 9 finite numbers, and d finite"
    if not (camera.k[0] > 0.0 and camera.k[4] > 0.0):
        return "camera: focal lengths must be above 0 px"
    if flaw := covariance_flaw(camera.covariance, may_be_fixed=len(camera.d)):
        return f"camera: the covariance {flaw}"
    if not _all_above_or_zero(camera.rms_px, camera.sigma_px, camera.design_effect):
        return "camera: rms_px, sigma_px and design_effect must be finite and not negative"
    try:
        camera.camera()
    except (ValueError, ArithmeticError) as error:
        return f"camera: {error}"
    return ""


def _lens_flaw(lens: "LensOnBody | None") -> str:
    if lens is None:
        return ""
    if not np.isfinite(lens.translation).all():
        return "lens: the translation must be finite"
    length = float(np.linalg.norm(lens.quaternion_xyzw))
    if not abs(length - 1.0) <= UNIT_TOLERANCE:
        return f"lens: the quaternion must have length 1, not {length:g}"
    if flaw := covariance_flaw(lens.covariance):
        return f"lens: the covariance {flaw}"
    if not _all_above_or_zero(lens.rotation_error, lens.translation_error, lens.left_out_rms_px):
        return "lens: errors must be finite and not negative"
    return ""


def _oblique_flaw(oblique: "Oblique | None") -> str:
    if oblique is None:
        return ""
    if np.isinf(oblique.notch_angle):
        return "oblique: the notch's angle must be finite, or NaN if it was not detected"
    if oblique.axis is not None:
        if not np.isfinite(oblique.axis.point).all():
            return "oblique: the axis must be finite"
        sigmas = (oblique.axis_tilt_sigma, oblique.axis_shift_sigma)
        if not all(np.isfinite(sigma) and sigma > 0.0 for sigma in sigmas):
            return "oblique: the errors of the axis must be finite and above 0"
    if oblique.T_head_scope is not None and not _is_rigid(oblique.T_head_scope):
        return "oblique: T_head_scope is not a rotation and a translation"
    shape = oblique.notch_shape
    if shape is not None and not (np.isfinite(shape).all() and shape.depth != 0.0 and shape.width > 0.0):
        return "oblique: the notch's depth and width must be finite and not 0"
    return ""


def _tip_flaw(calibration: "Calibration") -> str:
    tip = calibration.tip
    if tip is None:
        return ""
    if not np.isfinite(tip.position).all() or not _all_above_or_zero(tip.rms):
        return "tip: position and rms must be finite"
    flaw = covariance_flaw(tip.covariance)
    return f"tip: the covariance {flaw}" if flaw else ""


def _clock_flaw(calibration: "Calibration") -> str:
    clock = calibration.clock
    if clock is None:
        return ""
    if not abs(clock.offset) <= MOST_CLOCK_OFFSET:
        return f"clock: the offset must lie within {MOST_CLOCK_OFFSET:g} s, not {clock.offset:g} s"
    if not 0.0 < clock.sigma < np.inf:
        return f"clock: the standard error must be finite and above 0 s, not {clock.sigma:g} s"
    return ""


def _all_above_or_zero(*values: float) -> bool:
    return all(np.isfinite(value) and value >= 0.0 for value in values)


def _is_rigid(T: Array) -> bool:
    R = T[:3, :3]
    is_rotation = np.allclose(R.T @ R, np.eye(3), atol=UNIT_TOLERANCE) and np.linalg.det(R) > 0.0
    return bool(np.isfinite(T).all() and is_rotation and np.array_equal(T[3], [0.0, 0.0, 0.0, 1.0]))

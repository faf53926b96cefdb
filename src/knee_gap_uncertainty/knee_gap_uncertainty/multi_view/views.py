"""The views of a track: lens positions and bearings in one frame, with their errors."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields

import numpy as np

from knee_gap_core.compiled import compiled
from knee_gap_core.values.arrays import Array
from knee_gap_core.values.errors import BadInputError
from knee_gap_uncertainty.multi_view.likelihood import complete_frame

LONGEST_UNIT_VECTOR_DEVIATION = 1e-3
# Beyond this standard deviation [rad] a bearing is useless and the error model of small angles is void.
LARGEST_BEARING_DEVIATION = 0.5
# Relative to the largest variance: what rounding may leave of an element that ought to be zero.
ROUNDING = 1e-6


@dataclass(frozen=True)
class Views:
    """N views, validated: values finite, bearings of unit length, covariances symmetric and not negative.

    `lens_positions` (N, 3) [m]; `bearings` (N, 2, 3) unit vectors from the lens to both points; both in the
    frame of the points. `bearing_covariances` (N, 2, 3, 3) [rad^2] of the image error, null along the
    bearing; `lens_covariances` (N, 3, 3) [m^2]; `rotation_covariances` (N, 3, 3) [rad^2] of the rotation that
    brought the bearings into this frame: an error common to the two bearings of a view. `common_share` [-]:
    share of the bearings' variance that is one and the same offset in all images, in the axes of the image.
    `lens_rotations` (N, 3, 3) takes lens coordinates (z optical axis, x right, y down) to the frame of the
    points and so defines those axes; without it the lens is taken to look at the middle of the gap
    and not to roll. `lens_motions` (N, 6) are its velocity [m/s] and turning [rad/s] in the frame of the
    points, by which the error of a clock moves it, from two poses `motion_times` (N,) [s] apart; None where
    they are not known. `camera_errors` (N, 2, 3, k) are displacements of the bearings [rad], one for each
    error of the camera's own numbers, which all views share; None if there are none.
    `scope_rotations` (N,) [rad] are how far the scope was turned in its camera head; None where it was not.
    `times` (N,) [s] are the stamps of the images; None if they are not known.

    Raises BadInputError for the first value that breaks a rule.
    """

    lens_positions: Array
    bearings: Array
    bearing_covariances: Array
    lens_covariances: Array
    rotation_covariances: Array
    common_share: float = 0.5
    lens_rotations: Array | None = None
    lens_motions: Array | None = None
    motion_times: Array | None = None
    camera_errors: Array | None = None
    scope_rotations: Array | None = None
    times: Array | None = None

    def __post_init__(self) -> None:
        """Bring the arrays into contiguous float64 and check them."""
        for name in (
            "lens_positions",
            "bearings",
            "bearing_covariances",
            "lens_covariances",
            "rotation_covariances",
        ):
            object.__setattr__(self, name, np.ascontiguousarray(getattr(self, name), dtype=np.float64))
        if not 0.0 <= self.common_share <= 1.0:
            raise BadInputError(f"common_share must lie in [0, 1], not {self.common_share!r}")
        count = len(self.lens_positions) if self.lens_positions.ndim else 0
        if not self._are_arrays_sound(count):
            self._check_arrays(count)
        if count == 0:
            return
        lengths = np.linalg.norm(self.bearings, axis=-1)
        object.__setattr__(self, "bearings", self.bearings / lengths[..., None])
        if self.lens_rotations is not None:
            object.__setattr__(
                self, "lens_rotations", np.ascontiguousarray(self.lens_rotations, dtype=np.float64)
            )
            _check_rotations(self.lens_rotations, count)
        if self.lens_motions is not None:
            _check_shape("lens_motions", self.lens_motions, (count, 6))
        if self.motion_times is not None and not (
            self.motion_times.shape == (count,) and np.all(self.motion_times > 0.0)
        ):
            raise BadInputError(f"motion_times must be {count} times above 0 s, not {self.motion_times}")
        if self.camera_errors is not None:
            _check_shape("camera_errors", self.camera_errors, (count, 2, 3, self.camera_errors.shape[-1]))

    def _are_arrays_sound(self, count: int) -> bool:
        """Whether the five arrays that are always there keep the rules: quick, without a reason."""
        return (
            self.lens_positions.shape == (count, 3)
            and self.bearings.shape == (count, 2, 3)
            and self.bearing_covariances.shape == (count, 2, 3, 3)
            and self.lens_covariances.shape == self.rotation_covariances.shape == (count, 3, 3)
            and _are_bearings_sound(self.lens_positions, self.bearings, self.bearing_covariances)
            and _are_covariances(self.bearing_covariances.reshape(-1, 3, 3))
            and _are_covariances(self.lens_covariances)
            and _are_covariances(self.rotation_covariances)
        )

    def _check_arrays(self, count: int) -> None:
        """Raise BadInputError for the first of the five arrays that breaks a rule."""
        _check_shape("lens_positions", self.lens_positions, (count, 3))
        _check_shape("bearings", self.bearings, (count, 2, 3))
        _check_shape("bearing_covariances", self.bearing_covariances, (count, 2, 3, 3))
        _check_shape("lens_covariances", self.lens_covariances, (count, 3, 3))
        _check_shape("rotation_covariances", self.rotation_covariances, (count, 3, 3))
        lengths = np.linalg.norm(self.bearings, axis=-1)
        worst = np.unravel_index(np.argmax(np.abs(lengths - 1.0)), lengths.shape)
        if abs(lengths[worst] - 1.0) > LONGEST_UNIT_VECTOR_DEVIATION:
            raise BadInputError(
                f"bearing {worst[1]} of view {worst[0]} must have length 1, not {lengths[worst]:.6g}"
            )
        _check_covariance("bearing_covariances", self.bearing_covariances)
        _check_covariance("lens_covariances", self.lens_covariances)
        _check_covariance("rotation_covariances", self.rotation_covariances)
        deviations = np.sqrt(np.trace(self.bearing_covariances, axis1=-2, axis2=-1) / 2.0)
        if not deviations.min() > 0.0:
            raise BadInputError("the standard deviation of a bearing must be above 0 rad, and one is 0")
        if deviations.max() > LARGEST_BEARING_DEVIATION:
            raise BadInputError(
                f"the standard deviation of a bearing must be at most {LARGEST_BEARING_DEVIATION} rad, "
                f"not {deviations.max():.3g}"
            )

    def with_arrays(self, changed: Mapping[str, Array]) -> "Views":
        """These views with other arrays of the same shapes in some fields, known to keep the rules."""
        views = object.__new__(Views)
        views.__dict__.update(self.__dict__, **changed)
        return views

    def joined(self, other: "Views") -> "Views":
        """These views and then `other`'s, with the common share of these."""
        return joined([self, other], self.common_share)

    def __len__(self) -> int:
        """Number of views."""
        return len(self.lens_positions)

    @property
    def calibrated_rotations(self) -> Array:
        """(N, 3, 3): what takes an error of the calibrated lens, in its own axes, to the frame of the points.

        The picture of a scope that is turned in its camera head turns on the sensor, T_body_lens(turn) =
        S(turn) T_body_lens(0) Rz(-turn): an error e of T_body_lens(0) is the error Rz(turn) e of the lens.
        """
        rotations = _steady_rotations(self.bearings) if self.lens_rotations is None else self.lens_rotations
        if self.scope_rotations is None or not self.scope_rotations.any():
            return rotations
        cosine, sine = np.cos(self.scope_rotations), np.sin(self.scope_rotations)
        by_turn = np.tile(np.eye(3), (len(self), 1, 1))
        by_turn[:, 0, 0], by_turn[:, 0, 1] = cosine, -sine
        by_turn[:, 1, 0], by_turn[:, 1, 1] = sine, cosine
        return np.asarray(rotations @ by_turn)

    @property
    def lens_axes(self) -> Array:
        """(N, 3, 3): rows x, y and optical axis z of the lens in the frame of the points."""
        rotations = _steady_rotations(self.bearings) if self.lens_rotations is None else self.lens_rotations
        return np.ascontiguousarray(np.swapaxes(rotations, -1, -2))


def joined(parts: Sequence[Views], common_share: float) -> Views:
    """All views of the parts, one after the other; None for what is not known in every part.

    The camera's errors are known if they are those of one camera. Raises BadInputError for no parts.
    """
    if not parts:
        raise BadInputError("there are no views to be joined")
    arrays: dict[str, Array | None] = {}
    for field in fields(Views):
        if field.name == "common_share":
            continue
        values = [getattr(part, field.name) for part in parts]
        known = [value for value in values if value is not None]
        if len(known) < len(parts) or not _alike(known):
            arrays[field.name] = None
        else:
            arrays[field.name] = np.concatenate(known) if len(known) > 1 else known[0]
    return _checked_before(arrays, common_share)


def _checked_before(arrays: dict[str, Array | None], common_share: float) -> Views:
    """Views of arrays that were checked in the views they come from: a live track joins views every image."""
    if not 0.0 <= common_share <= 1.0:
        raise BadInputError(f"common_share must lie in [0, 1], not {common_share!r}")
    views = object.__new__(Views)
    for name, value in arrays.items():
        object.__setattr__(views, name, value)
    object.__setattr__(views, "common_share", common_share)
    return views


def _alike(values: Sequence[Array]) -> bool:
    """Whether arrays differ in the number of views alone."""
    return len({value.shape[1:] for value in values}) == 1


def _check_shape(name: str, value: Array, shape: tuple[int, ...]) -> None:
    if value.shape != shape:
        raise BadInputError(f"{name} must have shape {shape}, not {value.shape}")
    if not np.all(np.isfinite(value)):
        where = tuple(int(k) for k in np.argwhere(~np.isfinite(value))[0])
        raise BadInputError(f"{name} must be finite, and element {where} is {value[where]}")


def _steady_rotations(bearings: Array) -> Array:
    """(N, 3, 3) of a lens that looks along the mean of all bearings and does not turn."""
    mean = bearings.mean(axis=(0, 1))
    length = float(np.linalg.norm(mean))
    frame = np.zeros((3, 3))
    frame[0] = mean / length if length > ROUNDING else bearings[0, 0]
    complete_frame(frame)
    return np.tile(np.column_stack([frame[1], frame[2], frame[0]]), (len(bearings), 1, 1))


def _check_rotations(rotations: Array, count: int) -> None:
    _check_shape("lens_rotations", rotations, (count, 3, 3))
    if np.max(np.abs(rotations @ np.swapaxes(rotations, -1, -2) - np.eye(3))) > LONGEST_UNIT_VECTOR_DEVIATION:
        raise BadInputError(
            "lens_rotations must be rotation matrices, and the rows of one are not orthonormal"
        )


def _check_covariance(name: str, value: Array) -> None:
    scale = max(float(np.max(np.abs(value))), 1e-300)
    unit = value / scale
    if np.max(np.abs(unit - np.swapaxes(unit, -1, -2))) > ROUNDING:
        raise BadInputError(f"{name} must be symmetric")
    xx, yy, zz = unit[..., 0, 0], unit[..., 1, 1], unit[..., 2, 2]
    xy, xz, yz = unit[..., 0, 1], unit[..., 0, 2], unit[..., 1, 2]
    minors = (
        *(xx, yy, zz, xx * yy - xy**2, xx * zz - xz**2, yy * zz - yz**2),
        xx * (yy * zz - yz**2) - xy * (xy * zz - yz * xz) + xz * (xy * yz - yy * xz),
    )
    if min(float(minor.min()) for minor in minors) < -ROUNDING:
        raise BadInputError(f"{name} must be positive semi-definite: a variance below 0 was found")


@compiled
def _are_bearings_sound(lens: Array, bearings: Array, covariances: Array) -> bool:
    """Whether positions are finite, bearings of unit length, and their deviations in range."""
    for i in range(lens.shape[0]):
        if not np.isfinite(lens[i, 0] + lens[i, 1] + lens[i, 2]):
            return False
        for n in range(2):
            length = np.sqrt(bearings[i, n, 0] ** 2 + bearings[i, n, 1] ** 2 + bearings[i, n, 2] ** 2)
            variance = (covariances[i, n, 0, 0] + covariances[i, n, 1, 1] + covariances[i, n, 2, 2]) / 2.0
            if not (abs(length - 1.0) <= LONGEST_UNIT_VECTOR_DEVIATION and variance > 0.0):
                return False
            if not np.sqrt(variance) <= LARGEST_BEARING_DEVIATION:
                return False
    return True


@compiled
def _are_covariances(matrices: Array) -> bool:
    """Whether matrices (N, 3, 3) are finite, symmetric and positive semi-definite, as `_check_covariance`."""
    scale = 1e-300
    for value in matrices.flat:
        if not np.isfinite(value):
            return False
        scale = max(scale, float(abs(value)))
    for i in range(matrices.shape[0]):
        m = matrices[i] / scale
        for k in range(3):
            ahead = (k + 1) % 3
            if not abs(m[k, ahead] - m[ahead, k]) <= ROUNDING:
                return False
            if not min(m[k, k], m[k, k] * m[ahead, ahead] - m[k, ahead] ** 2) >= -ROUNDING:
                return False
        determinant = (
            m[0, 0] * (m[1, 1] * m[2, 2] - m[1, 2] ** 2)
            - m[0, 1] * (m[0, 1] * m[2, 2] - m[1, 2] * m[0, 2])
            + m[0, 2] * (m[0, 1] * m[1, 2] - m[1, 1] * m[0, 2])
        )
        if not determinant >= -ROUNDING:
            return False
    return True


def bearing_covariances(bearings: Array, deviation: float | Array) -> Array:
    """(..., 3, 3) covariances [rad^2] of unit vectors (..., 3), `deviation` [rad] in both image axes."""
    outer = bearings[..., :, None] * bearings[..., None, :]
    variance = np.asarray(deviation, dtype=np.float64)[..., None, None] ** 2
    return np.asarray(variance * (np.eye(3) - outer))


def isotropic_covariances(count: int, rms: float) -> Array:
    """(count, 3, 3) covariances of a vector whose error has the root-mean-square length `rms`."""
    return np.tile(np.eye(3) * (rms * rms / 3.0), (count, 1, 1))

"""Tracked poses as one smooth curve over time, for the calibration, which has the whole recording."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.interpolate import make_smoothing_spline
from scipy.spatial.transform import Rotation

from knee_gap_core.values.arrays import Array
from knee_gap_core.values.rigid_transforms import inverse, rigid
from knee_gap_perception.errors import PerceptionError

MIN_SAMPLES = 20
CUTOFF_HZ = 20.0  # a hand's tremor ends at 12 Hz; beyond is the tracker's noise
MAX_GAP_PERIODS = 3.0  # largest gap between samples that is interpolated


@dataclass(frozen=True)
class PoseTrack:
    """A smoothing spline through poses `T_world_body`: half the gain at 20 Hz, and no delay."""

    stamps_ns: npt.NDArray[np.int64]
    _quaternion: Any
    _position: Any

    @classmethod
    def of(cls, stamps_ns: npt.ArrayLike, T_world_body: npt.ArrayLike) -> "PoseTrack":
        """Fit poses (n, 4, 4) at stamps (n,) [ns]; repeated stamps and non-finite poses are left out.

        Raises PerceptionError for fewer than 20 usable poses.
        """
        stamps, poses = np.asarray(stamps_ns, dtype=np.int64), np.asarray(T_world_body, dtype=np.float64)
        order = np.argsort(stamps, kind="stable")
        stamps, poses = stamps[order], poses[order].reshape(-1, 4, 4)
        good = (
            np.isfinite(poses).all(axis=(1, 2)) & np.concatenate([[True], np.diff(stamps) > 0])[: len(stamps)]
        )
        stamps, poses = stamps[good], poses[good]
        if len(stamps) < MIN_SAMPLES:
            raise PerceptionError(
                f"{len(stamps)} tracked poses of the body were read; at least {MIN_SAMPLES} are needed: "
                "is the pose topic right, and did the tracker see the body?"
            )
        quaternion = Rotation.from_matrix(poses[:, :3, :3]).as_quat()
        # Of the two quaternions of each rotation, use the one that continues the curve.
        flips = np.sign(np.sum(quaternion[1:] * quaternion[:-1], axis=1))
        quaternion[1:] *= np.cumprod(np.where(flips == 0, 1, flips))[:, None]
        time = (stamps - stamps[0]) * 1e-9
        weight = 1 / (np.median(np.diff(time)) * (2 * np.pi * CUTOFF_HZ) ** 4)
        return cls(
            stamps,
            make_smoothing_spline(time, quaternion, lam=weight),
            make_smoothing_spline(time, poses[:, :3, 3], lam=weight),
        )

    @property
    def period(self) -> float:
        """Median time between samples [s]."""
        return float(np.median(np.diff(self.stamps_ns))) * 1e-9

    def covers(self, stamps_ns: npt.ArrayLike) -> npt.NDArray[np.bool_]:
        """Whether each stamp (...,) [ns] lies between samples that are close enough to each other."""
        stamps = np.asarray(stamps_ns, dtype=np.int64)
        after = np.searchsorted(self.stamps_ns, stamps)
        inside = (after > 0) & (after < len(self.stamps_ns))
        after = np.clip(after, 1, len(self.stamps_ns) - 1)
        gap = (self.stamps_ns[after] - self.stamps_ns[after - 1]) * 1e-9
        return np.asarray(inside & (gap <= MAX_GAP_PERIODS * self.period))

    def at(self, stamps_ns: npt.ArrayLike) -> Array:
        """Poses (..., 4, 4) at stamps (...,) [ns]."""
        # A double does not resolve a nanosecond of a stamp, but it does for the difference to the first.
        time = np.asarray(np.asarray(stamps_ns) - self.stamps_ns[0], dtype=np.float64) * 1e-9
        quaternion = self._quaternion(time)
        R = Rotation.from_quat(quaternion.reshape(-1, 4)).as_matrix().reshape(*time.shape, 3, 3)
        return rigid(R, self._position(time))

    def increments(self, start_ns: npt.ArrayLike, end_ns: npt.ArrayLike) -> Array:
        """Motion (n, 6) between stamps: rotation vector [rad] and translation [m] in the first body frame."""
        moved = inverse(self.at(start_ns)) @ self.at(end_ns)
        return np.concatenate([Rotation.from_matrix(moved[:, :3, :3]).as_rotvec(), moved[:, :3, 3]], axis=1)

    def twist_rates(self, stamps_ns: npt.ArrayLike) -> Array:
        """Velocity (n, 6) in the body's frame [rad/s, m/s]."""
        stamps, half_ns = np.asarray(stamps_ns, dtype=np.int64), 2_000_000
        back = self.increments(stamps, stamps - half_ns)
        return np.asarray((self.increments(stamps, stamps + half_ns) - back) / (2e-9 * half_ns))

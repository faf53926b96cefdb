"""Exposure times of the images and of the tracker, and stamps."""

import numpy as np

from knee_gap_core.values.arrays import Array

EPOCH_NS = 1_700_000_000_000_000_000
TRACKER_HZ = 120.0
POSE_MARGIN_S = 0.05
# The tracker is not synchronised with the camera: its samples fall between the images.
TRACKER_PHASE_S = 0.0017


def image_times(duration_s: float, fps: float) -> Array:
    """Exposure times (n,) [s] of the images."""
    return np.arange(round(duration_s * fps)) / fps


def tracker_times(duration_s: float, fps: float) -> Array:
    """Times (n,) [s] of the tracker: from 50 ms before the first image to 50 ms after the last."""
    last = image_times(duration_s, fps)[-1] + POSE_MARGIN_S
    return np.arange(-POSE_MARGIN_S + TRACKER_PHASE_S, last, 1.0 / TRACKER_HZ)


def stamp_ns(time_s: float) -> int:
    """The stamp [ns] of a time [s] of the simulation."""
    return EPOCH_NS + round(time_s * 1e9)


def seconds(stamp: int) -> float:
    """The time [s] of a stamp [ns]."""
    return (stamp - EPOCH_NS) / 1e9

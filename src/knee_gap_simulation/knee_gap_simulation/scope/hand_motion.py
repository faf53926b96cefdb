"""Motion of the scope in a hand: smooth travel, physiological tremor, slow drift and small rotations."""

from dataclasses import dataclass
from enum import StrEnum

import numpy as np
import numpy.typing as npt

from knee_gap_core.values.arrays import Array
from knee_gap_core.values.rigid_transforms import from_rotation_vectors, rigid
from knee_gap_simulation.errors import SimulationError


class TravelDirection(StrEnum):
    """Direction of the scope's travel relative to the gap: along it, across it, or towards it."""

    ALONG = "along"
    ACROSS = "across"
    FORWARD = "forward"

    @property
    def axis(self) -> int:
        """Axis of the scene frame (x along the gap, y across it, z away from the lens)."""
        return {TravelDirection.ALONG: 0, TravelDirection.ACROSS: 1, TravelDirection.FORWARD: 2}[self]


def minimum_jerk(phase: npt.ArrayLike) -> Array:
    """Position in [0, 1] of a minimum-jerk reach at a phase, clipped to [0, 1] (Flash and Hogan, 1985)."""
    s = np.clip(np.asarray(phase, dtype=np.float64), 0.0, 1.0)
    return s**3 * (10.0 - 15.0 * s + 6.0 * s**2)


@dataclass(frozen=True)
class Hand:
    """Amplitudes of a hand's movements. Lengths [m] and angles [rad] are RMS lengths of the vectors."""

    still_s: float = 0.3
    reach_s: float = 2.5
    rest_s: float = 0.2
    tremor: float = 0.05e-3
    tremor_turn: float = np.radians(0.03)
    drift: float = 0.12e-3
    drift_turn: float = np.radians(0.5)
    pivot_turn: float = np.radians(2.5)  # rotation of the scope about the portal over the whole travel


class HandMotion:
    """Lens poses over time: ``T_scene_lens`` as a smooth function, exact at any time.

    The lens looks along the scene's z from ``depth`` in front of the gap, with its image rotated by ``roll``.
    It starts at rest, then moves over ``travel`` and back repeatedly. The same seed gives the same motion.
    """

    def __init__(
        self,
        *,
        travel: float,
        depth: float,
        direction: TravelDirection = TravelDirection.ALONG,
        roll: float = np.radians(9.0),
        pitch: float = 0.0,
        offset: tuple[float, float, float] = (0.0, 0.0, 0.0),
        hand: Hand | None = None,
        seed: int = 0,
        portal: float | None = None,
        shaft: tuple[float, float, float] = (0.0, 0.0, 1.0),
    ) -> None:
        """Lengths [m]. `portal` is the distance from the tip back to the skin, where the shaft pivots.

        The `shaft` points to the tip, in the frame of the lens. Without a portal, the hand rotates the view
        back to the gap by `Hand.pivot_turn`.
        """
        if not 0.0 <= travel <= 0.05:
            raise SimulationError(f"travel must lie in [0, 0.05] m, not {travel}")
        if not 0.002 <= depth <= 0.05:
            raise SimulationError(f"depth must lie in [0.002, 0.05] m, not {depth}")
        self._travel, self._depth, self._axis = travel, depth, direction.axis
        if portal is not None and not 0.01 <= portal <= 1.0:
            raise SimulationError(f"the portal must lie in [0.01, 1] m behind the tip, not {portal}")
        self._hand = hand or Hand()
        self._offset = np.asarray(offset, dtype=np.float64)
        view = from_rotation_vectors([pitch, 0.0, 0.0], np.zeros(3)) @ from_rotation_vectors(
            [0.0, 0.0, roll], np.zeros(3)
        )
        self._base_rotation = view[:3, :3]
        self._arm = None if portal is None else portal * self._base_rotation @ np.asarray(shaft, dtype=float)
        rng = np.random.default_rng([seed, 0x4841])
        self._tremor = _Wander(rng, self._hand.tremor, (8.0, 12.0), waves=5)
        self._tremor_turn = _Wander(rng, self._hand.tremor_turn, (8.0, 12.0), waves=5)
        self._drift = _Wander(rng, self._hand.drift, (0.05, 0.35), waves=3)
        self._drift_turn = _Wander(rng, self._hand.drift_turn, (0.05, 0.35), waves=3)

    def travelled(self, time_s: npt.ArrayLike) -> Array:
        """Fraction of the travel, in [0, 1], covered by the reach alone at times [s]."""
        hand = self._hand
        stroke = hand.reach_s + hand.rest_s
        since = np.maximum(np.asarray(time_s, dtype=np.float64) - hand.still_s, 0.0)
        strokes = np.floor(since / stroke)
        reach = minimum_jerk((since - strokes * stroke) / hand.reach_s)
        return np.where(strokes % 2 == 0, reach, 1.0 - reach)

    def poses(self, time_s: npt.ArrayLike) -> Array:
        """``T_scene_lens`` (..., 4, 4) at times (...) [s]."""
        time = np.asarray(time_s, dtype=np.float64)
        reached = self.travelled(time) - (1.0 if self._axis == 2 else 0.5)
        position = self._tremor(time) + self._drift(time) + self._offset
        position[..., 2] -= self._depth
        position[..., self._axis] += self._travel * reached
        turn = self._tremor_turn(time) + self._drift_turn(time)
        if self._arm is not None:
            wobble = from_rotation_vectors(turn, np.zeros(3))[..., :3, :3]
            return rigid(wobble @ self._about_portal(reached) @ self._base_rotation, position)
        # A scope pivots about its portal: moving the lens to one side turns the view to the other.
        if self._axis == 0:
            turn[..., 1] -= self._hand.pivot_turn * reached
        elif self._axis == 1:
            turn[..., 0] += self._hand.pivot_turn * reached
        rotation = from_rotation_vectors(turn, np.zeros(3))[..., :3, :3] @ self._base_rotation
        return rigid(rotation, position)

    def _about_portal(self, reached: Array) -> Array:
        """Rotations (..., 3, 3) of a shaft through the portal, for fractions (...) of the travel."""
        assert self._arm is not None
        before = self._arm / np.linalg.norm(self._arm)
        after = self._arm + self._travel * reached[..., None] * np.eye(3)[self._axis]
        after = after / np.linalg.norm(after, axis=-1, keepdims=True)
        # The shortest rotation from one direction to the other: the hand does not twist the shaft.
        across = np.cross(before, after)
        sine = np.linalg.norm(across, axis=-1, keepdims=True)
        angle = np.arctan2(sine, (after @ before)[..., None])
        axis = np.divide(across, sine, out=np.zeros_like(across), where=sine > 0)
        return np.asarray(from_rotation_vectors(axis * angle, np.zeros(3))[..., :3, :3])


class _Wander:
    """A smooth vector process: a few sine waves per axis, zero at time 0."""

    def __init__(
        self, rng: np.random.Generator, rms: float, band_hz: tuple[float, float], waves: int
    ) -> None:
        self._frequency = 2.0 * np.pi * rng.uniform(*band_hz, size=(waves, 3))
        self._phase = rng.uniform(0.0, 2.0 * np.pi, size=(waves, 3))
        self._amplitude = rms * np.sqrt(2.0 / (3.0 * waves))

    def __call__(self, time: Array) -> Array:
        angle = time[..., None, None] * self._frequency + self._phase
        wave: Array = self._amplitude * (np.sin(angle) - np.sin(self._phase)).sum(axis=-2)
        return wave

"""Rigid bodies of a simulated tracker: smooth paths, and the faults of a real room."""

from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import Rotation

from knee_gap_core.values.arrays import Array
from knee_gap_simulation.errors import SimulationError
from knee_gap_simulation.natnet.packets import BodyInFrame, BodyModel

# The position of the clock body encodes the time of exposure, so that a client's stamps can be checked: x
# runs from 0 to 1 m in this time [s]. Single precision resolves it to better than a microsecond.
CLOCK_SECONDS = 10.0
CLOCK_NAME = "clock"
PERIODIC = ("occlusion", "swap", "freeze", "jump")
# Error of a body's reported position during a jump [m]: more than a hand moves in a frame.
JUMP = (0.06, 0.0, 0.02)


@dataclass(frozen=True)
class Faults:
    """Faults, each by its fraction of frames or by its period [s] and length [s]; 0 is never."""

    lost_share: float = 0.0
    invalid_share: float = 0.0
    occlusion_period: float = 0.0
    occlusion_length: float = 0.3
    swap_period: float = 0.0
    swap_length: float = 0.5
    freeze_period: float = 0.0
    freeze_length: float = 0.5
    jump_period: float = 0.0
    jump_length: float = 0.5

    def __post_init__(self) -> None:
        for name in ("lost_share", "invalid_share"):
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise SimulationError(f"{name} must lie in [0, 1], not {getattr(self, name)}")
        for name in (f"{fault}_{part}" for fault in PERIODIC for part in ("period", "length")):
            if getattr(self, name) < 0.0:
                raise SimulationError(f"{name} must not be negative, not {getattr(self, name)} s")


@dataclass
class TrackedScene:
    """Bodies with streaming ids from 1, swaying as in hands, each about its own position; Y up, as in Motive.

    Periods of faults count from the first frame, which has none. A body that is not tracked keeps its last
    pose with the valid bit cleared, as in Motive.
    """

    names: tuple[str, ...]
    faults: Faults = field(default_factory=Faults)
    noise: float = 0.03e-3
    seed: int = 0

    def __post_init__(self) -> None:
        if not self.names or len(set(self.names)) != len(self.names):
            raise SimulationError(f"bodies must have different names, not {', '.join(self.names) or 'none'}")
        self._rng = np.random.default_rng(self.seed)
        self._last: dict[int, BodyInFrame] = {}
        self._start_s = float("nan")

    def models(self) -> list[BodyModel]:
        """Definitions of the bodies."""
        corners = ((0.05, 0.0, 0.0), (-0.05, 0.0, 0.0), (0.0, 0.07, 0.0), (0.0, 0.0, 0.03))
        return [BodyModel(number, name, corners) for number, name in enumerate(self.names, start=1)]

    def frame_is_lost(self) -> bool:
        """Whether the next frame is lost."""
        return bool(self._rng.random() < self.faults.lost_share)

    def bodies(self, time_s: float) -> list[BodyInFrame]:
        """The bodies at a time of exposure [s], with the faults at that time."""
        if np.isnan(self._start_s):
            self._start_s = time_s
        seen = [self._body(number, time_s) for number in range(1, len(self.names) + 1)]
        since = time_s - self._start_s
        if len(seen) > 1 and _within(since, self.faults.swap_period, self.faults.swap_length):
            seen[0], seen[1] = _relabeled(seen[0], 2), _relabeled(seen[1], 1)
            seen[0], seen[1] = seen[1], seen[0]
        return seen

    def true_pose(self, number: int, time_s: float) -> tuple[Array, Rotation]:
        """Position (3,) [m] and rotation of a body, without noise, at a time [s]."""
        if self.names[number - 1] == CLOCK_NAME:
            return np.array([time_s / CLOCK_SECONDS % 1.0, 0.0, 0.0]), Rotation.identity()
        phase = 1.7 * number
        sway = np.array(
            [
                np.sin(2.1 * time_s + phase),
                0.4 * np.sin(3.3 * time_s),
                np.cos(1.3 * time_s + 2 * phase),
            ]
        )
        place = np.array([0.25 * (number - 1), 1.0, 0.1 * (number % 3)])
        turn = 0.15 * np.array([np.sin(1.1 * time_s), np.sin(0.7 * time_s + phase), np.cos(0.9 * time_s)])
        return place + 0.015 * sway, Rotation.from_rotvec(turn)

    def _body(self, number: int, time_s: float) -> BodyInFrame:
        position, rotation = self.true_pose(number, time_s)
        is_clock = self.names[number - 1] == CLOCK_NAME
        frozen = self._at_fault(number, time_s, self.faults.freeze_period, self.faults.freeze_length)
        if frozen and number in self._last:
            # Like a driver that lost its connection: the valid bit is still set.
            return self._last[number]
        if not is_clock and self._hidden(number, time_s) and number in self._last:
            last = self._last[number]
            return BodyInFrame(number, last.position, last.quaternion_xyzw, 0.0, tracking_valid=False)
        if not is_clock:
            position = position + self._rng.normal(0.0, self.noise / 3**0.5, 3)
            if self._at_fault(number, time_s, self.faults.jump_period, self.faults.jump_length):
                position = position + JUMP
            rotation = Rotation.from_rotvec(self._rng.normal(0.0, 4e-5, 3)) * rotation
        body = BodyInFrame(number, tuple(position), tuple(rotation.as_quat()), mean_error=2e-4)
        self._last[number] = body
        return body

    def _hidden(self, number: int, time_s: float) -> bool:
        if self._rng.random() < self.faults.invalid_share:
            return True
        faults = self.faults
        return self._at_fault(number, time_s, faults.occlusion_period, faults.occlusion_length)

    def _at_fault(self, number: int, time_s: float, period: float, length: float) -> bool:
        """Whether a periodic fault of the first body is active."""
        return number == 1 and _within(time_s - self._start_s, period, length)


def _relabeled(body: BodyInFrame, number: int) -> BodyInFrame:
    return BodyInFrame(number, body.position, body.quaternion_xyzw, body.mean_error, body.tracking_valid)


def _within(time_s: float, period: float, length: float) -> bool:
    """Whether a time falls into the last part of its period."""
    return period > 0.0 and time_s % period > period - length

"""Knee simulator: images of a knee at a chosen difficulty, frame by frame, with ground truth.

    bench = KneeSimulator(level=2, seed=5, travel_direction="along")
    for frame in bench.frames():              # rendered one by one; the same arguments give the same bytes
        frame.image, frame.stamp_ns           # (720, 1280, 3) bgr8; nanoseconds
        frame.T_world_lens_tracked            # as reported by the tracker, interpolated to the stamp
        frame.T_world_lens, frame.gap_mask    # ground truth
        if frame.index == 0:
            points = bench.points(frame, pixels)      # the surface points behind any pixels (n, 2)
        sightings = bench.follow(points, frame)       # where those same points are now: visibility, pixels,
        ...
        bench.instrument_gap(frame, edges)    # the instrument gap between edges (2, 3) of the frame

Each setting can be given: ``KneeSimulator(level=1, difficulty={"debris": 3}, gap=0.004, depth=0.010)``;
``gap=None`` gives a closed joint without a gap. Settings that are not given are drawn from the seed: the gap
from 3-8 mm, the depth from 8-15 mm. ``bench.lens`` is the lens (an equidistant fisheye),
``bench.nearest_distance`` the smallest distance between condyle and meniscus where an instrument passes,
``bench.tracked_body_poses()`` the raw poses at 120 Hz.
"""

from collections import deque
from collections.abc import Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import asdict, dataclass, replace
from enum import Enum
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation, Slerp

from knee_gap_core.values.arrays import Array
from knee_gap_core.values.rigid_transforms import rigid
from knee_gap_simulation.anatomy.mapping import MeshMapper
from knee_gap_simulation.anatomy.mesh_knee import MeshKnee
from knee_gap_simulation.anatomy.posing import Compartment
from knee_gap_simulation.errors import SimulationError
from knee_gap_simulation.knee.difficulty import Conditions, Difficulty, conditions
from knee_gap_simulation.knee.ground_truth import PointObservations, SurfacePoints, follow, surface_points
from knee_gap_simulation.knee.knee_camera import Dressing, KneeCamera, KneeLight
from knee_gap_simulation.knee.probe import Probe
from knee_gap_simulation.knee.scene import KneeScene
from knee_gap_simulation.knee.shape import KneeShape
from knee_gap_simulation.looks.dressing import dressing
from knee_gap_simulation.looks.look import Appearance, Look
from knee_gap_simulation.recordings.scene_truth import SceneTruth
from knee_gap_simulation.scope.arthroscope import Scope
from knee_gap_simulation.scope.clocks import stamp_ns, tracker_times
from knee_gap_simulation.scope.hand_motion import Hand, HandMotion, TravelDirection
from knee_gap_simulation.scope.imaging import ByteImage, FloatImage, decoded, jpeg
from knee_gap_simulation.scope.lens import Lens
from knee_gap_simulation.scope.media import IN_SALINE, Media, Medium, RefractedLens
from knee_gap_simulation.scope.tracker import track_lens, world_from_scene
from knee_gap_simulation.surfaces.instrument_gap import InstrumentGap

# Least distance of the scope from any surface [m].
LEAST_CLEARANCE = 0.0006
# Flexion at which a compartment is looked into, if none is given [rad].
DEFAULT_FLEXION = float(np.radians(25.0))


class Draw(Enum):
    """Marks a value that is drawn from the seed."""

    FROM_SEED = "from the seed"


FROM_SEED = Draw.FROM_SEED


@dataclass(frozen=True, eq=False)
class SimulatorFrame:
    """One frame and its ground truth. Poses are (4, 4), lengths in metres.

    ``gap_mask`` (height, width): the pixels that look into the gap, past condyle, meniscus and probe.
    ``debris_cover`` (height, width) in [0, 1]: fraction of each pixel covered by debris. ``probe`` (k, 4):
    the rods of the probe in the scene, empty while it is away. ``instrument_mask`` (height, width):
    the pixels that show it.
    """

    index: int
    stamp_ns: int
    jpeg: bytes
    image: ByteImage
    T_world_lens: Array
    T_world_lens_tracked: Array
    gap_mask: npt.NDArray[np.bool_]
    debris_cover: FloatImage
    probe: Array
    instrument_mask: npt.NDArray[np.bool_]


@dataclass(frozen=True)
class Anatomy:
    """A knee of meshes: their folder and unit, the compartment looked into, and the flexion [rad]."""

    folder: Path
    unit: str = "m"
    compartment: str = Compartment.MEDIAL
    flexion: float = DEFAULT_FLEXION


@dataclass(frozen=True)
class SimulatorSettings:
    """Settings of a simulation. Lengths [m], times [s]. ``gap`` None: a closed joint."""

    difficulty: Difficulty
    seed: int
    travel_direction: TravelDirection
    gap: float | None
    depth: float
    travel: float
    duration_s: float
    fps: float
    media: Media = IN_SALINE
    portal: float | None = None
    appearance: Appearance = Appearance.PLAIN
    anatomy: Anatomy | None = None

    def as_dict(self) -> dict[str, Any]:
        """Settings as plain values for JSON; those that were not given are left out."""
        values = asdict(self)
        if self.media == IN_SALINE:
            del values["media"]
        if self.portal is None:
            del values["portal"]
        if self.appearance is Appearance.PLAIN:
            del values["appearance"]
        if self.anatomy is None:
            del values["anatomy"]
        else:
            values["anatomy"]["folder"] = str(self.anatomy.folder)
        return values


class KneeSimulator:
    """A knee, a hand that moves the scope in it, the images and the ground truth."""

    def __init__(
        self,
        level: int = 0,
        seed: int = 0,
        travel_direction: str = "along",
        *,
        gap: float | Draw | None = FROM_SEED,
        depth: float | Draw = FROM_SEED,
        travel: float = 0.008,
        duration_s: float = 4.0,
        fps: float = 60.0,
        difficulty: Mapping[str, int] | None = None,
        workers: int = 2,
        medium: Medium = "saline",
        calibrated_in: Medium | None = None,
        portal: float | None = None,
        appearance: str = Appearance.PLAIN,
        anatomy: Anatomy | None = None,
        reduction: float = 1.0,
    ) -> None:
        """Lengths [m]. ``difficulty`` sets single levels by name; the result is the same for any ``workers``.

        The knee is filled with ``medium``; ``bench.lens`` is the lens in it, ``Lens()`` the lens in
        ``calibrated_in`` (the same by default). ``portal``: distance from the tip back to the pivot of the
        scope, as in `HandMotion`. ``appearance`` "real" draws the look from the seed.
        ``anatomy`` is a knee of meshes instead of a drawn one. ``reduction``: the picture has this many times
        fewer rows and columns, and shows the same.

        Raises SimulationError for levels, directions and lengths that are not possible, and for a travel
        that does not fit into the joint.
        """
        if seed < 0:
            raise SimulationError(f"the seed must not be negative, but is {seed}")
        if travel_direction not in list(TravelDirection):
            choices = ", ".join(TravelDirection)
            raise SimulationError(f"the travel direction must be one of {choices}, not '{travel_direction}'")
        if not 0.05 <= duration_s <= 600.0:
            raise SimulationError(f"the duration must lie in [0.05, 600] s, not {duration_s:g} s")
        if not 1.0 <= fps <= 240.0:
            raise SimulationError(f"fps must lie in [1, 240] frames a second, not {fps:g}")
        if appearance not in list(Appearance):
            choices = ", ".join(Appearance)
            raise SimulationError(f"the appearance must be one of {choices}, not '{appearance}'")
        rng = np.random.default_rng([seed, 0x4245])
        drawn_gap, drawn_depth = float(rng.uniform(0.003, 0.008)), float(rng.uniform(0.008, 0.015))
        levels = Difficulty.at(level, difficulty)
        self.conditions: Conditions = conditions(levels)
        self.look, lens = None, Lens()
        if Appearance(appearance) is Appearance.REAL:
            self.look = Look.drawn(seed, self.conditions)
            drawn_gap, lens = self.look.gap, self.look.lens
        if reduction != 1.0:
            lens = lens.reduced(reduction)
            self.look = None if self.look is None else replace(self.look, lens=lens)
        self.settings = SimulatorSettings(
            difficulty=levels,
            seed=seed,
            travel_direction=TravelDirection(travel_direction),
            gap=drawn_gap if isinstance(gap, Draw) else gap,
            depth=drawn_depth if isinstance(depth, Draw) else depth,
            travel=travel,
            duration_s=duration_s,
            fps=fps,
            media=Media(medium if calibrated_in is None else calibrated_in, medium),
            portal=portal,
            appearance=Appearance(appearance),
            anatomy=anatomy,
        )
        self.scene: KneeShape = self._shape()
        self.lens, self.scope = RefractedLens.of(lens, self.settings.media.ratio), Scope()
        self.T_world_scene = world_from_scene(seed)
        self._workers = workers
        self._motion = self._place_hand(rng)
        self.probe = self._place_probe(rng)
        self._body_times = tracker_times(duration_s, fps)
        self._bodies = track_lens(self._true_lenses(), self.scope.body_to_lens(), seed)

    @property
    def nearest_distance(self) -> float:
        """Smallest distance [m] between the condyle and the tissue below it, negative in a closed joint."""
        return self.scene.nearest_distance()[0]

    @property
    def frame_count(self) -> int:
        """Number of frames."""
        return round(self.settings.duration_s * self.settings.fps)

    def frames(self, start: int = 0, stop: int | None = None, step: int = 1) -> Iterator[SimulatorFrame]:
        """Render the frames of a range, lazily and in order, a few ahead on other threads.

        A frame's geometry, noise and debris do not depend on the range. Its exposure does, since it is
        controlled from frame to frame.
        """
        scene = self.scene
        mapper = partial(MeshMapper, scene) if isinstance(scene, MeshKnee) else None
        camera = KneeCamera(scene, self.lens, self.conditions, self.settings.seed, self._dressing(), mapper)
        indices = range(start, self.frame_count if stop is None else min(stop, self.frame_count), step)
        with ThreadPoolExecutor(self._workers) as pool:
            ahead: deque[tuple[int, Future[KneeLight]]] = deque()
            for index in indices:
                ahead.append((index, pool.submit(self._light, camera, index)))
                if len(ahead) > self._workers:
                    yield self._frame(camera, *ahead.popleft(), step)
            while ahead:
                yield self._frame(camera, *ahead.popleft(), step)

    def points(self, frame: SimulatorFrame, pixels: npt.ArrayLike) -> SurfacePoints:
        """Surface points behind pixels (n, 2) [px] of a frame; NaN if there is none."""
        return surface_points(
            self.scene, self.lens, self.T_world_scene, frame.T_world_lens, frame.probe, pixels
        )

    def instrument_gap(self, frame: SimulatorFrame, edge_bearings: npt.ArrayLike) -> InstrumentGap:
        """The instrument gap between two edges (2, 3) of a frame, unit vectors of the lens, in the world."""
        return self.truth.instrument_gap(frame.T_world_lens, edge_bearings)

    def edges_at_section(
        self, frame: SimulatorFrame, pixel: npt.ArrayLike, across_direction: npt.ArrayLike | None = None
    ) -> Array:
        """True bearings (2, 3) of the edges of a frame at the section through a pixel, as in `SceneTruth`."""
        return self.truth.edges_at_section(frame.T_world_lens, pixel, across_direction)

    def follow(
        self, points: SurfacePoints, frame: SimulatorFrame, *, edges: bool = True
    ) -> PointObservations:
        """Positions and visibility of surface points in a frame, and the nearest edge of the gap.

        Without ``edges`` it is about a hundred times faster.
        """
        return follow(
            self.scene,
            self.lens,
            self.T_world_scene,
            frame.T_world_lens,
            frame.probe,
            frame.debris_cover,
            points,
            edges=edges,
        )

    def pose(self, time_s: float) -> Array:
        """``T_scene_lens`` (4, 4), the true pose of the lens in the scene, at a time [s]."""
        return self._motion.poses(np.array(time_s))

    @property
    def truth(self) -> SceneTruth:
        """Ground truth of the knee for any true lens pose, including sections and instrument gaps."""
        return SceneTruth(self.scene, self.T_world_scene, self.lens, self.scope, self.probe)

    def tracked_body_poses(self) -> tuple[Array, Array, Array]:
        """Times (n,) [s] at 120 Hz, reported body poses and true lens poses (n, 4, 4) in the world."""
        return self._body_times, self._bodies, self._true_lenses()

    def _shape(self) -> KneeShape:
        settings = self.settings
        if (anatomy := settings.anatomy) is not None:
            return MeshKnee(
                anatomy.folder, anatomy.unit, Compartment(anatomy.compartment), anatomy.flexion, settings.gap
            )
        scene = KneeScene.random(settings.gap, settings.seed, self.conditions.roughness)
        return scene if self.look is None else self.look.shaped(scene, settings.travel)

    def _dressing(self) -> Dressing | None:
        if self.look is None:
            return None
        poses = self._motion.poses(np.linspace(0.0, min(self.settings.duration_s, 3.6), 3))
        return dressing(self.look, self.scene, self.lens, self.conditions, poses)

    def _light(self, camera: KneeCamera, index: int) -> KneeLight:
        time = index / self.settings.fps
        T_scene_lens = self._motion.poses(np.array(time))
        return camera.light(T_scene_lens, time, self._shift(time), self.probe.joints(time))

    def _frame(self, camera: KneeCamera, index: int, light: "Future[KneeLight]", step: int) -> SimulatorFrame:
        time, seen = index / self.settings.fps, light.result()
        picture = camera.develop(seen, index, step / self.settings.fps)
        data = jpeg(picture, self.conditions.jpeg_quality)
        return SimulatorFrame(
            index=index,
            stamp_ns=stamp_ns(time),
            jpeg=data,
            image=decoded(data),
            T_world_lens=self.T_world_scene @ self._motion.poses(np.array(time)),
            T_world_lens_tracked=self._tracked_lens(time),
            gap_mask=seen.gap_mask,
            debris_cover=seen.debris_cover,
            probe=self.probe.joints(time),
            instrument_mask=seen.instrument_mask,
        )

    def _true_lenses(self) -> Array:
        return self.T_world_scene @ self._motion.poses(np.maximum(self._body_times, 0.0))

    def _tracked_lens(self, time: float) -> Array:
        """Lens pose interpolated between the two tracker samples around a time."""
        after = int(np.searchsorted(self._body_times, time))
        before = max(0, after - 1)
        pair = self._bodies[[before, after]] @ self.scope.body_to_lens()
        begin, end = self._body_times[[before, after]]
        share = (time - begin) / (end - begin)
        turn = Slerp([0.0, 1.0], Rotation.from_matrix(pair[:, :3, :3]))(share).as_matrix()
        return rigid(turn, (1.0 - share) * pair[0, :3, 3] + share * pair[1, :3, 3])

    def _shift(self, time: float) -> Array:
        """Shift of the centre of the image [px] while the shutter is open around a time."""
        half = 0.5 * self.conditions.shutter_s
        begin, end = self._motion.poses(np.array([time - half, time + half]))
        place = begin[:3, 3] + self.settings.depth * begin[:3, 2]
        pixels = [self.lens.pixels(pose[:3, :3].T @ (place - pose[:3, 3])) for pose in (begin, end)]
        return np.asarray(pixels[1] - pixels[0])

    def _place_hand(self, rng: np.random.Generator) -> HandMotion:
        """Hand motion that keeps clear of the tissue over its whole travel, as near the draw as possible."""
        settings = self.settings
        hand = Hand(reach_s=3.3, tremor=self.conditions.tremor)
        roll, pitch = rng.uniform(-0.35, 0.35), rng.uniform(-0.10, 0.12)
        if self.look is not None:
            roll = self.look.roll
        side, up = rng.uniform(-1.0e-3, 1.0e-3), rng.uniform(-0.8e-3, 0.8e-3)
        times = np.linspace(0.0, min(settings.duration_s, 8.0), 41)
        best, most = None, -np.inf
        for shift in sorted(np.arange(-5.0e-3, 5.01e-3, 0.5e-3), key=abs):
            motion = HandMotion(
                travel=settings.travel,
                depth=settings.depth,
                direction=settings.travel_direction,
                roll=roll,
                pitch=pitch,
                offset=(side, up + shift, 0.0),
                hand=hand,
                seed=settings.seed,
                portal=settings.portal,
                shaft=self.scope.shaft_in_lens(),
            )
            clearance = float(self.scene.distance(motion.poses(times)[:, :3, 3]).min())
            if clearance >= LEAST_CLEARANCE:
                return motion
            if clearance > most:
                best, most = shift, clearance
        raise SimulationError(
            f"a travel of {1e3 * settings.travel:g} mm {settings.travel_direction} the gap from a depth of "
            f"{1e3 * settings.depth:g} mm does not fit: the scope would come within {1e3 * most:.2f} mm "
            f"of tissue (least {1e3 * LEAST_CLEARANCE:g} mm), shifted by {1e3 * (best or 0.0):g} mm"
        )

    def _place_probe(self, rng: np.random.Generator) -> Probe:
        places = []
        for lower in (bool(rng.integers(2)), bool(rng.integers(2)), True, False):
            x, y, z = (float(value) for value in self.scene.ridge(rng.uniform(-0.0025, 0.0025))[0])
            opening = self.settings.gap or 0.0
            places.append((x, y + 0.0003, z - 0.0012) if lower else (x, y - 0.85 * opening, z - 0.0015))
        probe = Probe(self.conditions.probe_visits, tuple(places), float(rng.choice([-1.0, 1.0])))
        return probe if self.look is None else self.look.with_instrument(probe)

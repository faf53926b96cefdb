"""The bench: levels, seeds, travel, probe, debris, and its bag."""

from dataclasses import asdict

import cv2
import numpy as np
import pytest

from knee_gap_core.bag.bag import BagReader
from knee_gap_core.user_files import FileError
from knee_gap_core.values.rigid_transforms import inverse
from knee_gap_simulation.errors import SimulationError
from knee_gap_simulation.knee.difficulty import Difficulty, conditions
from knee_gap_simulation.knee.ground_truth import Visibility
from knee_gap_simulation.knee_simulator import LEAST_CLEARANCE, KneeSimulator
from knee_gap_simulation.look_checks.contact_sheet import contact_sheet, read_frames
from knee_gap_simulation.make_bag.command import main
from knee_gap_simulation.recordings.recording import IMAGE, LENS_POSE_TRUE
from knee_gap_simulation.recordings.scene_truth import scene_from_metadata

# One seed and one texture level for most, as textures take longest to make.
SEED = 17
NAMES = list(Difficulty.__dataclass_fields__)
# A clearer picture has a larger value of these.
RICH = {"texture": 0}
FALLING = {"contrast", "jpeg_quality"}


@pytest.mark.parametrize("name", NAMES)
def test_every_difficulty_grows_with_its_level_and_touches_nothing_else(name):
    levels = [asdict(conditions(Difficulty.at(1, {name: level}))) for level in range(4)]
    changing = {key for key in levels[0] if any(step[key] != levels[0][key] for step in levels)}
    assert changing
    for key in changing:
        values = [
            sum(end - begin for begin, end in step[key]) if key == "probe_visits" else step[key]
            for step in levels
        ]
        ordered = values[::-1] if key in FALLING else values
        assert ordered == sorted(set(ordered)), key
    for other in set(NAMES) - {name}:
        alone = asdict(conditions(Difficulty.at(1, {other: 3})))
        assert all(alone[key] == levels[1][key] for key in changing)


def test_a_hard_picture_is_harder_than_an_easy_one():
    """Tissue stands out from the gap less, against the noise, as a person would say it looks."""
    stands_out = []
    for level in (0, 3):
        simulator = KneeSimulator(
            level, SEED, gap=0.005, depth=0.010, difficulty={"probe": 0, "debris": 0, "texture": 0}
        )
        frame = next(simulator.frames(20, 21))
        grey = frame.image.mean(axis=-1)
        tissue = np.isfinite(simulator.lens.bearings(simulator.lens.pixel_grid())[..., 0]) & ~frame.gap_mask
        noise = np.diff(grey, axis=1)[frame.gap_mask[:, 1:] & frame.gap_mask[:, :-1]].std()
        stands_out.append((np.median(grey[tissue]) - np.median(grey[frame.gap_mask])) / noise)
    assert stands_out[1] < 0.5 * stands_out[0]


def test_the_same_arguments_give_the_same_bytes_whatever_the_threads():
    first, second = (
        [frame.jpeg for frame in KneeSimulator(3, 6, duration_s=0.5, workers=workers).frames(0, 2)]
        for workers in (1, 2)
    )
    assert first == second
    assert first[0] != next(KneeSimulator(3, 7, duration_s=0.5).frames()).jpeg


def test_geometry_does_not_depend_on_where_rendering_starts():
    simulator = KneeSimulator(2, SEED, duration_s=0.5, difficulty=RICH)
    whole, part = list(simulator.frames(0, 21, 10))[2], next(simulator.frames(20, 21))
    assert whole.stamp_ns == part.stamp_ns
    assert (whole.gap_mask == part.gap_mask).all()
    assert (whole.debris_cover == part.debris_cover).all()
    assert (whole.T_world_lens == part.T_world_lens).all()


@pytest.mark.parametrize("direction", ["along", "across", "forward"])
@pytest.mark.parametrize("depth", [0.008, 0.015])
def test_the_scope_travels_as_asked_and_keeps_clear_of_the_tissue(direction, depth):
    axis = {"along": 0, "across": 1, "forward": 2}[direction]
    for seed in range(8):
        simulator = KneeSimulator(3, seed, direction, depth=depth)
        _, _, lenses = simulator.tracked_body_poses()
        path = (inverse(simulator.T_world_scene) @ lenses)[:, :3, 3]
        spread = np.ptp(path, axis=0)
        assert spread[axis] == pytest.approx(0.008, abs=1.2e-3)
        assert simulator.scene.distance(path).min() > 0.7 * LEAST_CLEARANCE
        if direction == "along":
            assert spread[1] < 2e-3


def test_what_does_not_fit_is_refused():
    with pytest.raises(SimulationError, match="does not fit"):
        KneeSimulator(0, 1, "across", travel=0.03)
    with pytest.raises(SimulationError, match="along, across, forward, not 'up'"):
        KneeSimulator(0, 1, "up")
    with pytest.raises(SimulationError, match="level of texture must be 0, 1, 2 or 3, not 7"):
        KneeSimulator(7, 1)
    with pytest.raises(SimulationError, match="no difficulty 'fog'"):
        KneeSimulator(0, 1, difficulty={"fog": 1})


def test_the_probe_comes_covers_points_and_goes():
    simulator = KneeSimulator(0, SEED, gap=0.005, depth=0.010, difficulty={"probe": 3})
    rods = [simulator.probe.joints(time) for time in np.arange(0.0, 4.0, 0.05)]
    there = np.array([len(rod) > 0 for rod in rods])
    assert 0.3 < there.mean() < 0.7
    assert not there[0]
    before, during = next(simulator.frames(30, 31)), next(simulator.frames(85, 86))
    assert len(before.probe) == 0
    assert len(during.probe) > 0
    grid = np.stack(np.meshgrid(np.arange(320.0, 970.0, 25.0), np.arange(40.0, 690.0, 25.0)), axis=-1)
    points = simulator.points(before, grid.reshape(-1, 2))
    assert not (simulator.follow(points, before, edges=False).visibility == Visibility.BEHIND_PROBE).any()
    hidden = simulator.follow(points, during, edges=False).visibility == Visibility.BEHIND_PROBE
    assert hidden.sum() > 5


def test_debris_hides_what_it_covers():
    simulator = KneeSimulator(0, SEED, depth=0.010, difficulty={"debris": 3})
    frame = next(simulator.frames(60, 61))
    rows, columns = np.nonzero(frame.debris_cover > 0.6)
    assert len(rows) > 20
    pixels = np.stack([columns, rows], axis=-1)[:: max(1, len(rows) // 20)]
    observations = simulator.follow(simulator.points(frame, pixels), frame, edges=False)
    assert (observations.visibility == Visibility.BEHIND_DEBRIS).mean() > 0.9


def test_tracked_lens_poses_have_the_trackers_error():
    simulator = KneeSimulator(0, 21, duration_s=4.0)
    times = np.arange(simulator.frame_count) / simulator.settings.fps
    true = simulator.T_world_scene @ simulator._motion.poses(times)
    tracked = np.array([simulator._tracked_lens(time) for time in times])
    error = np.sqrt(((tracked - true)[:, :3, 3] ** 2).sum(axis=1).mean())
    # Interpolation between two samples averages their errors, by up to the square root of a half.
    assert 0.0367e-3 * 0.70 < error < 0.0367e-3


def test_a_bag_of_a_knee_reads_back_with_its_truth(tmp_path, capsys):
    arguments = ["--level", "2", "--difficulty", "texture=0", "--travel-direction", "across"]
    assert main([str(tmp_path / "bag"), *arguments, "--duration-s", "0.05", "--seed", str(SEED)]) == 0
    simulator = KneeSimulator(2, SEED, "across", duration_s=0.05, difficulty=RICH)
    frame = next(simulator.frames())
    with BagReader(tmp_path / "bag") as bag:
        truth = scene_from_metadata(bag.metadata)
        first = {m.topic: bag.deserialize(m) for m in reversed(list(bag.messages([IMAGE, LENS_POSE_TRUE])))}
    assert truth.scene == simulator.scene
    assert truth.probe == simulator.probe
    assert bytes(first[IMAGE].data) == frame.jpeg
    pixels = np.array([[600.0, 200.0], [700.0, 500.0]])
    points = truth.surface_points(frame.T_world_lens, pixels, frame.stamp_ns)
    assert np.abs(points - simulator.points(frame, pixels).points).max() < 1e-12
    assert (
        truth.gap_mask(frame.T_world_lens, frame.stamp_ns) != frame.gap_mask
    ).mean() < 2e-3  # the soft border of the field stop


@pytest.mark.parametrize(
    "arguments",
    [
        ["--no-gap", "--gap-mm", "4"],
        ["--level", "1", "--quality", "50"],
        ["--level", "1", "--travel-mm", "40"],
        ["--level", "0", "--seed", "-1"],
    ],
)
def test_a_mistake_with_a_knee_gets_one_line(tmp_path, capsys, arguments):
    assert main([str(tmp_path / "bag"), *arguments]) != 0
    assert capsys.readouterr().err.strip().count("\n") == 0
    assert not (tmp_path / "bag").exists()


def test_a_contact_sheet_takes_real_frames(tmp_path):
    noise = np.random.default_rng(1).integers(0, 255, (90, 160, 3), dtype=np.uint8)
    cv2.imwrite(str(tmp_path / "a.png"), noise)
    assert contact_sheet([], read_frames(tmp_path)).shape == (2 * 34 + 400, 1600, 3)
    with pytest.raises(FileError, match="No such file"):
        read_frames(tmp_path / "b.png")

"""The simple scene: its truth, its pictures and its bag."""

import re

import cv2
import mcap_doctor
import numpy as np
import pytest

from knee_gap_core.bag.bag import BagReader
from knee_gap_core.values.rigid_transforms import from_rotation_vectors, inverse
from knee_gap_core.values.stamps import stamp_ns
from knee_gap_simulation.errors import SimulationError
from knee_gap_simulation.make_bag.command import Recording, main, make_bag
from knee_gap_simulation.recordings.recording import BODY_POSE, CAMERA_INFO, IMAGE, LENS_POSE_TRUE
from knee_gap_simulation.recordings.scene_truth import SceneTruth, scene_from_metadata
from knee_gap_simulation.rims.render import ScopeCamera
from knee_gap_simulation.rims.scene import LOWER, UPPER, WALL, RimScene
from knee_gap_simulation.scope.arthroscope import Scope
from knee_gap_simulation.scope.hand_motion import HandMotion
from knee_gap_simulation.scope.imaging import tone_table
from knee_gap_simulation.scope.lens import Lens


@pytest.fixture(scope="module")
def truth() -> SceneTruth:
    T_world_scene = from_rotation_vectors([0.3, -0.8, 0.2], [0.1, 0.9, -0.4])
    return SceneTruth(RimScene.random(0.004, 21), T_world_scene, Lens(), Scope())


@pytest.fixture(scope="module")
def lens_poses(truth) -> np.ndarray:
    motion = HandMotion(travel=0.008, depth=0.010, seed=21)
    return truth.T_world_scene @ motion.poses(np.array([0.0, 0.9, 1.6, 2.8]))


def test_points_lie_on_the_ray_of_their_pixel(truth, lens_poses):
    pixels = np.random.default_rng(1).uniform([300.0, 20.0], [980.0, 700.0], (400, 2))
    for T_world_lens in lens_poses:
        points = truth.surface_points(T_world_lens, pixels)
        seen = np.isfinite(points[:, 0])
        assert seen.sum() > 300
        T_lens_world = inverse(T_world_lens)
        projected = truth.lens.pixels(points[seen] @ T_lens_world[:3, :3].T + T_lens_world[:3, 3])
        assert np.abs(projected - pixels[seen]).max() < 1e-8


def test_views_from_elsewhere_see_the_same_surface(truth, lens_poses):
    """A point seen in one view is what another view sees at the pixel where that point is projected."""
    pixels = np.array([[680.0, 180.0], [500.0, 620.0], [640.0, 100.0], [760.0, 560.0]])
    points = truth.surface_points(lens_poses[0], pixels)
    T_lens_world = inverse(lens_poses[1])
    there = truth.lens.pixels(points @ T_lens_world[:3, :3].T + T_lens_world[:3, 3])
    assert np.abs(truth.surface_points(lens_poses[1], there) - points).max() < 1e-10


def test_first_hit_agrees_with_a_dense_walk_along_the_ray(truth):
    """No surface is crossed before the hit: march each ray in small steps and look for a change of side."""
    scene = truth.scene
    T_scene_lens = from_rotation_vectors([0.05, 0.1, 0.3], [0.001, 0.0008, -0.009])
    pixels = np.random.default_rng(2).uniform([300.0, 20.0], [980.0, 700.0], (60, 2))
    bearings = truth.lens.bearings(pixels)
    bearings = bearings[np.isfinite(bearings[:, 0])]
    directions = bearings @ T_scene_lens[:3, :3].T
    points, _, _, surfaces = scene.cast(T_scene_lens[:3, 3].copy(), np.ascontiguousarray(directions))
    for direction, point, surface in zip(directions, points, surfaces, strict=True):
        reach = np.linalg.norm(point - T_scene_lens[:3, 3])
        steps = np.linspace(0.0, reach - 2e-6, 800)
        walk = T_scene_lens[:3, 3] + steps[:, None] * direction
        upper, lower = scene.rim(walk[:, 0])
        straight_down = np.tile([0.0, 0.0, 1.0], (len(walk), 1))
        below = [scene.cast(p, d[None])[0][0, 2] for p, d in zip(walk, straight_down, strict=True)]
        over_leaf = (walk[:, 1] < upper[:, 1]) | (walk[:, 1] > lower[:, 1])
        if surface != WALL:
            assert (np.array(below) - walk[:, 2])[over_leaf].min() > 0.0


def test_rims_are_as_far_apart_as_asked_for():
    for seed in range(20):
        upper, lower = RimScene.random(0.005, seed).rim(np.linspace(-1e-3, 1e-3, 50))
        assert np.linalg.norm(lower - upper, axis=1).mean() == pytest.approx(0.005, abs=0.5e-3)


def test_the_rendered_edge_is_where_the_truth_has_it(truth, lens_poses):
    """Light steps up within a pixel of the true border of the gap, all along both rims.

    In light, not in display values: the softness of the lens is symmetric there, while the display curve
    lifts the dark side.
    """
    camera = ScopeCamera(truth.scene, truth.lens, seed=1)
    T_scene_lens = inverse(truth.T_world_scene) @ lens_poses[0]
    display = cv2.cvtColor(camera.frame(T_scene_lens), cv2.COLOR_BGR2GRAY)
    light = np.interp(display, tone_table().astype(float), np.arange(4096) / 2048.0)
    mask = truth.gap_mask(lens_poses[0])
    assert 0.05 < mask.mean() < 0.4
    for column in range(400, 900, 25):
        rows = np.flatnonzero(mask[:, column])
        for edge, side in ((rows[0], -1), (rows[-1], 1)):
            outside, inside = light[edge + side * 4, column], light[edge - side * 4, column]
            assert outside > 4.0 * inside
            profile = light[edge - 6 : edge + 7, column]
            step = np.abs(np.diff(profile)).argmax() - 6
            # diff k lies between rows edge-6+k and edge-5+k; the border lies beside the last gap pixel
            assert abs(step + 0.5 - (-0.5 if side < 0 else 0.5)) <= 1.0


def test_surfaces_have_their_names(truth, lens_poses):
    pixels = np.array([[642.0, 60.0], [642.0, 357.0], [642.0, 660.0]])
    T_scene_lens = inverse(truth.T_world_scene) @ lens_poses[1]
    directions = truth.lens.bearings(pixels) @ T_scene_lens[:3, :3].T
    surfaces = truth.scene.cast(T_scene_lens[:3, 3].copy(), np.ascontiguousarray(directions))[3]
    assert surfaces.tolist() == [UPPER, WALL, LOWER]


def test_a_bag_reads_back_with_its_truth(tmp_path):
    recording = Recording(gap=0.0045, duration_s=0.1, seed=9)
    written = make_bag(tmp_path / "bag", recording, progress=False)
    with BagReader(tmp_path / "bag") as bag:
        truth = scene_from_metadata(bag.metadata)
        messages = [(message, bag.deserialize(message)) for message in bag.messages()]
    assert truth.scene == written.scene
    assert (truth.T_world_scene == written.T_world_scene).all()
    assert truth.lens == written.lens
    assert truth.scope == written.scope
    stamps = {
        topic: [stamp_ns(m.header) for b, m in messages if b.topic == topic]
        for topic in (IMAGE, CAMERA_INFO, BODY_POSE, LENS_POSE_TRUE)
    }
    assert len(stamps[IMAGE]) == 6
    assert stamps[IMAGE] == stamps[CAMERA_INFO] == stamps[LENS_POSE_TRUE]
    assert stamps[BODY_POSE][0] < stamps[IMAGE][0] - 45e6
    assert stamps[BODY_POSE][-1] > stamps[IMAGE][-1] + 40e6
    assert all(message.time_ns > 0 for message, _ in messages)
    times = [message.time_ns for message, _ in messages]
    assert times == sorted(times)
    image = next(m for b, m in messages if b.topic == IMAGE)
    assert cv2.imdecode(np.asarray(image.data), cv2.IMREAD_COLOR).shape == (720, 1280, 3)


def test_the_same_seed_gives_the_same_bytes(tmp_path):
    recording = Recording(duration_s=0.1, seed=13)
    for name in ("a", "b"):
        make_bag(tmp_path / name / "bag", recording, progress=False)
    other = Recording(duration_s=0.1, seed=14)
    make_bag(tmp_path / "c" / "bag", other, progress=False)
    a, b, c = ((tmp_path / name / "bag" / "bag_0.mcap").read_bytes() for name in "abc")
    assert mcap_doctor.examine(tmp_path / "a" / "bag" / "bag_0.mcap")
    assert a == b
    assert a != c


@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        (["--gap-mm", "40"], r"\[1, 15\] mm"),
        (["--gap-mm", "nan"], "finite"),
        (["--depth-mm", "0"], "depth"),
        (["--travel-mm", "-1"], "travel"),
        (["--fps", "0"], "fps"),
        (["--seed", "-3"], "seed"),
        (["--duration-s", "0"], "duration"),
        (["--quality", "0"], "quality"),
    ],
)
def test_a_mistake_gets_one_line_and_leaves_no_bag(tmp_path, capsys, arguments, reason):
    try:
        code = main([str(tmp_path / "bag"), *arguments])
    except SystemExit as refused:
        code = int(refused.code or 0)
    assert code != 0
    reported = capsys.readouterr().err.strip()
    assert "\n" not in reported
    assert re.search(reason, reported)
    assert not (tmp_path / "bag").exists()


def test_an_existing_folder_is_not_overwritten(tmp_path, capsys):
    (tmp_path / "bag").mkdir()
    assert main([str(tmp_path / "bag")]) != 0
    assert "exists already" in capsys.readouterr().err


def test_a_bag_without_scene_is_told():
    with pytest.raises(SimulationError, match="not simulated"):
        scene_from_metadata({"other": "1"})
    with pytest.raises(SimulationError, match="'lake'"):
        scene_from_metadata({"knee_gap_simulation": '{"format": 1, "scene": {"kind": "lake"}}'})

"""Estimates beside the truth: each at its own image's section, read by the names of the fields."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from knee_gap_core.bag.bag import BagReader, BagWriter
from knee_gap_core.bag.message_types import blank
from knee_gap_core.conversions.edge_messages import fill_gap_edges
from knee_gap_core.values.edges import EdgeKind, EdgeState, EdgeStatus, GapEdges, SectionEdges
from knee_gap_core.values.gap_estimate import GapEstimate, GapStatus
from knee_gap_core.values.rigid_transforms import from_rotation_vectors, inverse, rigid
from knee_gap_core.values.stamps import stamp_ns
from knee_gap_replay.report.comparison import EDGES, GAP, Comparison, compare
from knee_gap_simulation.make_bag.command import Recording, make_bag
from knee_gap_simulation.recordings.recording import LENS_POSE_TRUE
from knee_gap_simulation.recordings.scene_truth import SceneTruth
from knee_gap_uncertainty.estimation.messages import fill_gap_estimate

TRACK = 4


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, SceneTruth, dict[int, np.ndarray]]:
    """A short bag of the rims, its truth, and its true lens poses by stamp."""
    bag = tmp_path_factory.mktemp("recording") / "bag"
    truth = make_bag(bag, Recording(duration_s=0.1, seed=21), progress=False)
    poses = {}
    with BagReader(bag) as reader:
        for entry in reader.messages([LENS_POSE_TRUE]):
            message = reader.deserialize(entry)
            q, p = message.pose.orientation, message.pose.position
            x, y, z, w = q.x, q.y, q.z, q.w
            turn = np.array(
                [
                    [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
                    [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
                    [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
                ]
            )
            poses[stamp_ns(message.header)] = rigid(turn, [p.x, p.y, p.z])
    return bag, truth, poses


def seen(stamp: int, pixels: np.ndarray, bearings: np.ndarray, state: EdgeState) -> GapEdges:
    """What an image gave: two tracked points at pixels (2, 2), and edges (2, 3)."""
    return GapEdges(
        stamp_ns=stamp,
        frame_id="arthroscope_optical",
        status=EdgeStatus.VALID,
        track_id=TRACK,
        pixels=pixels,
        bearings=np.tile([0.0, 0.0, 1.0], (2, 1)),
        kinds=(EdgeKind.RIM, EdgeKind.RIM),
        covariances=np.zeros((2, 3, 3)),
        angular_error=0.01,
        section=SectionEdges(states=(state, state), bearings=bearings),
    )


def written(path: Path, edges: list[GapEdges], estimates: list[GapEstimate]) -> Path:
    """A bag of what was looked at and what was estimated."""
    with BagWriter(path) as bag:
        bag.add_topic(EDGES, "knee_gap_msgs/msg/GapEdges")
        bag.add_topic(GAP, "knee_gap_msgs/msg/GapEstimate")
        for one in edges:
            message = fill_gap_edges(
                blank("knee_gap_msgs/msg/GapEdges"), one, lambda: blank("knee_gap_msgs/msg/GapSection")
            )
            bag.write(EDGES, message, one.stamp_ns)
        for estimate in estimates:
            message = fill_gap_estimate(blank("knee_gap_msgs/msg/GapEstimate"), estimate)
            bag.write(GAP, message, estimate.stamp_ns)
    return path


def test_each_estimate_meets_the_truth_of_its_own_image(recording, tmp_path):
    bag, truth, poses = recording
    stamps = sorted(poses)[:5]
    T_lens_world = inverse(poses[stamps[0]])
    edges, gaps, points = [], [], []
    for index, stamp in enumerate(stamps):
        # Another section in each image: what is true of it is not what is true of the others.
        place = truth.T_world_scene @ [(index - 2) * 1.2e-3, 0.0, 0.0, 1.0]
        T_lens_world = inverse(poses[stamp])
        pixel = truth.lens.pixels(T_lens_world[:3, :3] @ place[:3] + T_lens_world[:3, 3])
        bearings = truth.edges_at_section(poses[stamp], pixel)
        ends = truth.lens.pixels(bearings)
        tissue = ends + 0.15 * np.array([ends[0] - ends[1], ends[1] - ends[0]])
        points.append(np.linalg.norm(np.diff(truth.surface_points(poses[stamp], tissue), axis=0)))
        gaps.append(truth.instrument_gap(poses[stamp], bearings).diameter)
        edges.append(seen(stamp, tissue, bearings, EdgeState.SEEN))
    # Without edges the section lies between the points; at the picture's border an edge is none.
    edges[3] = replace(edges[3], section=SectionEdges())
    edges[4] = replace(
        edges[4], section=replace(edges[4].section, states=(EdgeState.SEEN, EdgeState.AT_BORDER))
    )
    valid = GapEstimate(0, "world", GapStatus.VALID, track_id=TRACK, point_distance=9e-3, baseline=2e-3)
    estimates = [
        replace(valid, stamp_ns=stamp, gap=gap + 1e-4, gap_min=gap - 2e-4, gap_max=gap + 3e-4, snr=7.0)
        for stamp, gap in zip(stamps, gaps, strict=True)
    ]
    # Two that do not hold it, one below and one above, and a statement of silence.
    estimates[1] = replace(estimates[1], gap_min=gaps[1] + 1e-6)
    estimates[2] = replace(estimates[2], gap_max=gaps[2] - 1e-6)
    estimates.append(GapEstimate(stamps[-1] + 5, "world", GapStatus.NO_EDGES))
    found = compare(bag, written(tmp_path / "out", edges, estimates))
    assert np.ptp(gaps) > 5e-5
    assert found.truth[:3] == pytest.approx(gaps[:3], abs=1e-9)
    # The line between the points is the same section, but for the lens's bent lines.
    assert found.truth[3:5] == pytest.approx(gaps[3:], abs=2e-5)
    assert np.isnan(found.truth[5])
    assert found.point_truth[:5] == pytest.approx(points[0], abs=1e-9)
    assert found.valid.tolist() == [True] * 5 + [False]
    assert (found.snr[:5] == 7.0).all()
    assert (found.point_distance[:5] == 9e-3).all()
    assert (found.baseline[:5] == 2e-3).all()
    assert found.time[:5] == pytest.approx((np.array(stamps) - stamps[0]) * 1e-9)
    assert found.above_minimum == pytest.approx(0.8)
    assert found.below_maximum == pytest.approx(0.8)
    assert found.inside == pytest.approx(0.6)
    assert found.median_error == pytest.approx(1e-4, abs=1e-6)
    assert found.median_point_error == pytest.approx(9e-3 - points[0], abs=1e-9)
    assert "5 valid" in found.summary()


def test_edges_that_bound_nothing_have_no_truth(recording, tmp_path):
    """A valid estimate of which the truth is not known counts as one that does not hold it."""
    bag, _, poses = recording
    stamp = min(poses)
    same = np.tile([0.0, 0.0, 1.0], (2, 1))
    edges = seen(stamp, np.full((2, 2), np.nan), same, EdgeState.SEEN)
    estimate = GapEstimate(
        stamp, "world", GapStatus.VALID, track_id=TRACK, gap=4e-3, gap_min=1e-3, gap_max=9e-3
    )
    found = compare(bag, written(tmp_path / "out", [edges], [estimate]))
    assert np.isnan(found.truth[0])
    assert found.inside == 0.0


def test_nothing_estimated_is_no_failure(recording, tmp_path):
    bag, _, _ = recording
    found = compare(bag, written(tmp_path / "out", [], []))
    assert isinstance(found, Comparison)
    assert len(found.time) == 0
    assert np.isnan(found.median_error)
    assert "0 estimates, 0 valid" in found.summary()


def test_a_turned_world_does_not_change_the_truth(recording):
    _, truth, poses = recording
    T_world_lens = poses[min(poses)]
    bearings = truth.edges_at_section(T_world_lens, truth.lens.pixels([0.0, 0.0, 1.0]))
    here = truth.instrument_gap(T_world_lens, bearings).diameter
    move = from_rotation_vectors([0.2, 0.9, -0.4], [1.0, -2.0, 0.5])
    moved = replace(truth, T_world_scene=move @ truth.T_world_scene)
    assert moved.instrument_gap(move @ T_world_lens, bearings).diameter == pytest.approx(here, abs=1e-9)

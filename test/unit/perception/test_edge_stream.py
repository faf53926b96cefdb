"""Images that wait for the pose after them, and what is reported of poses used and points hidden."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from plain_messages import bgr_image, header, pose
from scipy.spatial.transform import Rotation

from knee_gap_core.values.edges import EdgeStatus, GapEdges
from knee_gap_perception.camera.medium import AIR
from knee_gap_perception.edge_tracking.edge_stream import MOST_WAITING, EdgeStream
from knee_gap_perception.edge_tracking.parameters import PoseParameters
from knee_gap_perception.errors import PerceptionError

FRAME_NS = 33_333_333
POSE_NS = 8_333_333
MS = 1_000_000


def pose_message(T: np.ndarray, stamp: int, frame_id: str = "world") -> Any:
    place = pose(T[:3, 3], Rotation.from_matrix(T[:3, :3]).as_quat())
    covariance = np.diag([4e-10] * 3 + [1e-10] * 3).ravel()
    return SimpleNamespace(
        header=header(stamp, frame_id), pose=SimpleNamespace(pose=place, covariance=covariance)
    )


def info_message(joint: Any) -> Any:
    c = joint.camera
    return SimpleNamespace(
        header=header(0, "arthroscope_optical"),
        width=c.width_px,
        height=c.height_px,
        distortion_model="equidistant",
        d=[0.0] * 4,
        k=[c.fx, 0.0, c.cx, 0.0, c.fy, c.cy, 0.0, 0.0, 1.0],
        r=np.eye(3).ravel(),
        p=[c.fx, 0.0, c.cx, 0.0, 0.0, c.fy, c.cy, 0.0, 0.0, 0.0, 1.0, 0.0],
        binning_x=0,
        binning_y=0,
        roi=SimpleNamespace(x_offset=0, y_offset=0, height=0, width=0, do_rectify=False),
    )


def stream(joint: Any, wait: float = 0.03) -> EdgeStream:
    made = EdgeStream(poses=PoseParameters(max_pose_wait=wait), medium=AIR)
    made.on_camera_info(info_message(joint))
    return made


def still_poses(made: EdgeStream, until: int, frame_id: str = "world") -> None:
    """Poses of a lens at rest up to and with a stamp."""
    for stamp in range(0, until + 1, POSE_NS):
        made.on_lens_pose(pose_message(np.eye(4), stamp, frame_id))


def test_an_image_waits_for_the_pose_after_it_and_no_longer(joint: Any, travel: Any) -> None:
    made = stream(joint)
    still_poses(made, 4 * POSE_NS)
    made.on_image(bgr_image(travel[1][0], 4 * POSE_NS + 1 * MS), now_ns=0)
    assert list(made.ready(5 * MS)) == []
    made.on_lens_pose(pose_message(np.eye(4), 5 * POSE_NS))
    (edges,) = made.ready(6 * MS)
    assert (edges.status, edges.pose_used) == (EdgeStatus.VALID, True)
    assert not made.waiting

    made.on_image(bgr_image(travel[1][1], 6 * POSE_NS), now_ns=10 * MS)
    assert list(made.ready(39 * MS)) == []
    (edges,) = made.ready(40 * MS)  # by then the pose is predicted
    assert (edges.status, edges.pose_used) == (EdgeStatus.VALID, True)


def test_what_is_interpolated_does_not_depend_on_when_the_image_came(joint: Any, travel: Any) -> None:
    answers = []
    for poses_first in (True, False):
        made = stream(joint)
        found: list[GapEdges] = []
        for k, (T, picture) in enumerate(zip(*travel, strict=True)):
            stamp = 10 * POSE_NS * (k + 1)
            before, after = pose_message(T, stamp - POSE_NS // 2), pose_message(T, stamp + POSE_NS // 2)
            made.on_lens_pose(before)
            if poses_first:
                made.on_lens_pose(after)
            made.on_image(bgr_image(picture, stamp), stamp)
            found += made.ready(stamp)
            if not poses_first:
                made.on_lens_pose(after)
                found += made.ready(stamp + MS)
        answers.append([(edges.pixels.tobytes(), edges.track_id, edges.pose_used) for edges in found])
    assert len(answers[0]) == len(travel[1])
    assert answers[0] == answers[1]
    assert all(used for _, _, used in answers[0])


@pytest.mark.parametrize("case", ["no poses", "does not wait", "the tracker fell silent", "clock back"])
def test_an_image_does_not_wait_in_vain(joint: Any, travel: Any, case: str) -> None:
    made = stream(joint, wait=0.0 if case == "does not wait" else 0.03)
    stamp = 10 * POSE_NS
    if case != "no poses":
        still_poses(made, 9 * POSE_NS if case != "the tracker fell silent" else 2 * POSE_NS)
    made.on_image(bgr_image(travel[1][0], stamp), now_ns=100)
    assert len(list(made.ready(50 if case == "clock back" else 100))) == 1


def test_waiting_images_are_few_and_keep_their_order(joint: Any, travel: Any) -> None:
    made = stream(joint, wait=0.1)
    still_poses(made, 9 * POSE_NS)
    stamps = [9 * POSE_NS + MS * (k + 1) for k in range(MOST_WAITING + 4)]
    found: list[GapEdges] = []
    for stamp in stamps:
        made.on_image(bgr_image(travel[1][0], stamp), now_ns=0)
        found += made.ready(0)
        assert made.waiting <= MOST_WAITING
    found += made.finish()
    assert [edges.stamp_ns for edges in found] == stamps


def test_of_images_that_lag_behind_only_the_newest_is_kept(joint: Any, travel: Any) -> None:
    made = stream(joint, wait=0.0)
    stamps = [k * 16 * MS for k in range(1, 5)]
    for stamp in stamps:
        made.on_image(bgr_image(travel[1][0], stamp), stamp)
    assert made.drop_old(100 * MS) == 0
    assert made.drop_old(35 * MS) == 3
    (edges,) = made.ready(stamps[-1])
    assert edges.stamp_ns == stamps[-1]
    assert made.drop_old(35 * MS) == 0


def test_images_that_wait_for_their_pose_are_not_dropped(joint: Any, travel: Any) -> None:
    made = stream(joint)
    still_poses(made, 4 * POSE_NS)
    for k in range(1, 5):
        made.on_image(bgr_image(travel[1][0], 4 * POSE_NS + k * MS), now_ns=0)
    assert made.drop_old(1 * MS, now_ns=MS) == 0
    assert made.waiting == 4


def test_a_track_begun_without_poses_is_begun_anew_with_them_once(joint: Any, travel: Any) -> None:
    made = stream(joint, wait=0.0)
    ids, used = [], []
    for k in range(6):
        stamp = (k + 1) * 4 * POSE_NS
        if k >= 2:
            made.on_lens_pose(pose_message(np.eye(4), stamp - POSE_NS))
            made.on_lens_pose(pose_message(np.eye(4), stamp))
        made.on_image(bgr_image(joint.picture(np.eye(4), k), stamp), stamp)
        (edges,) = made.ready(stamp)
        ids.append(edges.track_id)
        used.append(edges.pose_used)
    assert used == [False, False, True, True, True, True]
    assert ids == [1, 1, 2, 2, 2, 2]


def test_poses_in_another_frame_begin_another_track(joint: Any, travel: Any) -> None:
    made = stream(joint, wait=0.0)
    ids = []
    for k, frame in enumerate(["world", "world", "femur", "femur"]):
        stamp = (k + 1) * 4 * POSE_NS
        made.on_lens_pose(pose_message(np.eye(4), stamp - POSE_NS, frame))
        made.on_lens_pose(pose_message(np.eye(4), stamp, frame))
        made.on_image(bgr_image(joint.picture(np.eye(4), k), stamp), stamp)
        ids += [edges.track_id for edges in made.ready(stamp)]
    assert ids == [1, 1, 2, 2]


def test_a_point_behind_a_probe_is_called_hidden(joint: Any, travel: Any) -> None:
    made = stream(joint, wait=0.0)
    found: list[GapEdges] = []
    for k in range(8):
        picture = joint.picture(np.eye(4), k)
        if 3 <= k < 6:
            column, row = np.rint(found[0].pixels[1]).astype(int)
            picture[row - 70 : row + 70, column - 70 : column + 70] = (90, 100, 120)
        made.on_image(bgr_image(picture, k * FRAME_NS), 0)
        found += made.ready(0)
    assert [edges.hidden for edges in found if edges.status is EdgeStatus.VALID][:3] == [(False, False)] * 3
    covered = found[3]
    assert covered.track_id == found[0].track_id
    assert covered.hidden == (False, True)
    assert covered.angular_error > found[2].angular_error
    assert made.counts["VALID, a point hidden"] >= 1


def test_a_bad_pose_is_counted_and_left_out(joint: Any, travel: Any) -> None:
    made = stream(joint)
    bad = np.eye(4)
    bad[0, 3] = np.nan
    for k in range(3):
        made.on_lens_pose(pose_message(bad, k * POSE_NS))
    made.on_image(bgr_image(travel[1][0], 3 * POSE_NS), 0)
    (edges,) = made.ready(0)
    assert (edges.status, edges.pose_used) == (EdgeStatus.VALID, False)
    assert made.counts["lens poses refused"] == 3


def test_a_point_is_chosen_where_there_is_a_gap_and_refused_elsewhere(joint: Any, travel: Any) -> None:
    made = EdgeStream()
    assert "camera_info" in made.choose(640.0, 360.0)
    made.on_camera_info(info_message(joint))
    assert "no image" in made.choose(640.0, 360.0)
    made.on_image(bgr_image(travel[1][0], 0))
    (first,) = made.ready()
    for column, row, reason in (
        (5000.0, 360.0, "1280x720"),
        (float("nan"), 360.0, "1280x720"),
        (20.0, 20.0, "field of view"),
        (640.0, 90.0, "no dark gap"),
    ):
        assert reason in made.choose(column, row)
    made.on_image(bgr_image(joint.picture(np.eye(4), 50), FRAME_NS))
    (same,) = made.ready()
    assert same.track_id == first.track_id
    assert made.choose(820.0, 360.0) == ""
    made.on_image(bgr_image(joint.picture(np.eye(4), 51), 2 * FRAME_NS))
    (chosen,) = made.ready()
    assert chosen.track_id == first.track_id + 1
    np.testing.assert_allclose(chosen.pixels[:, 0], 820.0, atol=110.0)


def test_what_cannot_be_read_gives_no_picture_of_an_earlier_image(joint: Any, travel: Any) -> None:
    made = stream(joint)
    assert made.mask() is None
    assert made.overlay() is None
    made.on_image(bgr_image(travel[1][0], 0))
    assert len(list(made.ready())) == 1
    mask = made.mask()
    assert mask is not None
    assert 0.02 < (mask == 255).mean() < 0.5
    assert made.overlay() is not None
    cut = bgr_image(travel[1][1], FRAME_NS)
    cut.data = cut.data[:1000]
    made.on_image(cut)
    (edges,) = made.ready()
    assert edges.status is EdgeStatus.UNKNOWN
    assert made.mask() is None
    assert made.overlay() is None
    made.on_image(bgr_image(travel[1][2], 2 * FRAME_NS))
    assert next(iter(made.ready())).status is EdgeStatus.VALID
    assert (made.reason, "bytes" in made.last_refusal) == ("", True)


def test_the_wait_is_checked() -> None:
    with pytest.raises(PerceptionError, match="max_pose_wait"):
        PoseParameters(max_pose_wait=5.0)

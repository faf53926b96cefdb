import numpy as np
import pytest
from motive_takes import THREE_BODIES, three_body_take
from recordings import origins

from knee_gap_core.bag.bag import BagReader, BagWriter
from knee_gap_core.bag.message_types import blank
from knee_gap_replay.import_motive import main

HEADER = """Format Version,1.23,Take Name,t,Capture Start Time,{start},Total Exported Frames,3,\
Rotation Type,Quaternion,Length Units,Millimeters,Coordinate Space,Global

,Type,Rigid Body,Rigid Body,Rigid Body,Rigid Body,Rigid Body,Rigid Body,Rigid Body
,Name,scope,scope,scope,scope,scope,scope,scope
,ID,7,7,7,7,7,7,7
,,Rotation,Rotation,Rotation,Rotation,Position,Position,Position
Frame,Time (Seconds),X,Y,Z,W,X,Y,Z
"""
ROWS = "0,0.0,0,0,0,1,100,200,300\n1,0.01,,,,,,,\n2,0.02,0,0,0,1,101,200,300\n"


def take(tmp_path, *, start="2024-05-06 07.08.09.250 PM", rows=ROWS):
    path = tmp_path / "take.csv"
    path.write_text(HEADER.format(start=start) + rows)
    return str(path)


def poses(bag, topic="/knee_gap/scope_body/pose"):
    with BagReader(bag) as reader:
        return [(message.time_ns, reader.deserialize(message)) for message in reader.messages([topic])]


def test_a_take_becomes_a_bag_without_the_frames_in_which_the_body_was_not_seen(tmp_path, capsys):
    out = tmp_path / "bag"
    assert main([take(tmp_path), "scope", str(out)]) == 0
    assert "3 frames, poses: 2 of 'scope'" in capsys.readouterr().out
    (first_ns, first), (second_ns, second) = poses(out)
    assert first_ns == 1_715_022_489_250_000_000
    assert second_ns - first_ns == 20_000_000
    assert (first.header.stamp.sec, first.header.stamp.nanosec) == (1_715_022_489, 250_000_000)
    assert first.header.frame_id == "world"
    place = second.pose.position
    np.testing.assert_allclose([place.x, place.y, place.z], [0.101, -0.3, 0.2])
    assert second.pose.orientation.w == 1.0


def test_it_is_aligned_to_another_bag_by_an_offset(tmp_path):
    video = tmp_path / "video"
    with BagWriter(video) as writer:
        writer.add_topic("/tick", "geometry_msgs/msg/PoseStamped")
        writer.add_topic("/image", "sensor_msgs/msg/CompressedImage")
        writer.write("/tick", blank("geometry_msgs/msg/PoseStamped"), 90_000_000_000)
        image = blank("sensor_msgs/msg/CompressedImage")
        image.header.stamp.sec = 100
        writer.write("/image", image, 100_040_000_000)
    out = tmp_path / "bag"
    arguments = ["--align", str(video), "--align-topic", "/image", "--offset", "-0.5", "--up-axis", "z"]
    assert main([take(tmp_path), "7", str(out), *arguments]) == 0
    (first_ns, first), _ = poses(out)
    assert first_ns == 99_500_000_000
    assert first.pose.position.z == pytest.approx(0.3)


def test_a_start_that_cannot_be_read_must_be_told(tmp_path, capsys):
    path = take(tmp_path, start="wann auch immer")
    assert main([path, "scope", str(tmp_path / "bag")]) == 1
    assert "'wann auch immer' cannot be read; set it with --start" in capsys.readouterr().err
    assert main([path, "scope", str(tmp_path / "bag"), "--start", "12.5"]) == 0
    assert poses(tmp_path / "bag")[0][0] == 12_500_000_000


@pytest.mark.parametrize(
    ("arguments", "rows", "message"),
    [
        (["femur"], ROWS, "no rigid body 'femur'; it has: 'scope'"),
        (["scope"], ROWS[:-8], "the file ends in the middle of it"),
        (["scope"], "0,0.0,,,,,,,\n", "is not tracked in any frame"),
        (["scope", "--start", "1", "--offset", "-5"], ROWS, "before 1970"),
    ],
)
def test_mistakes_are_one_line_and_leave_no_bag(tmp_path, capsys, arguments, rows, message):
    body, *options = arguments
    out = tmp_path / "bag"
    assert main([take(tmp_path, rows=rows), body, str(out), *options]) == 1
    error = capsys.readouterr().err.strip()
    assert message in error
    assert len(error.splitlines()) == 1
    assert not out.exists()


@pytest.mark.parametrize("origin", origins(THREE_BODIES))
def test_a_recorded_take(origin, tmp_path, capsys):
    known = three_body_take(origin, tmp_path)
    _, body, leg_body = known.names
    out = tmp_path / "bag"
    assert main([str(known.path), body, str(out), "--reference", leg_body]) == 0
    assert f"{known.exported} frames by the header, {known.frames} in the file" in capsys.readouterr().err
    scope, leg = poses(out), poses(out, "/knee_gap/reference_body/pose")
    assert known.frames - 10 < len(scope) <= known.frames
    assert known.seen[0] <= len(leg) <= known.seen[1]
    assert (np.diff([time_ns for time_ns, _ in scope]) > 0).all()

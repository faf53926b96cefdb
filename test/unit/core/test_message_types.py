"""Message types without ROS are those of ROS."""

import json
from importlib import import_module
from pathlib import Path

import pytest

from knee_gap_core.bag.errors import BagError
from knee_gap_core.bag.message_types import blank, check_type_hash, known_type, typestore

ROOT = Path(__file__).parents[3]
USED = [
    "builtin_interfaces/msg/Time",
    "diagnostic_msgs/msg/DiagnosticArray",
    "geometry_msgs/msg/PoseStamped",
    "geometry_msgs/msg/PoseWithCovarianceStamped",
    "geometry_msgs/msg/TransformStamped",
    "knee_gap_msgs/msg/GapEdges",
    "knee_gap_msgs/msg/GapEstimate",
    "knee_gap_msgs/msg/MotionAdvice",
    "sensor_msgs/msg/CameraInfo",
    "sensor_msgs/msg/CompressedImage",
    "sensor_msgs/msg/Image",
    "std_msgs/msg/Float64",
    "tf2_msgs/msg/TFMessage",
]


@pytest.mark.parametrize("msgtype", USED)
def test_a_blank_message_survives_its_bytes(msgtype: str) -> None:
    store = typestore()
    data = bytes(store.serialize_cdr(blank(msgtype), msgtype))
    assert bytes(store.serialize_cdr(store.deserialize_cdr(data, msgtype), msgtype)) == data


@pytest.mark.parametrize("msgtype", USED)
def test_a_blank_message_is_what_rclpy_constructs(msgtype: str) -> None:
    serialization = pytest.importorskip("rclpy.serialization", reason="needs ROS")
    package, _, name = msgtype.partition("/msg/")
    module = pytest.importorskip(f"{package}.msg", reason="needs the built messages")
    by_ros = serialization.serialize_message(getattr(module, name)())
    # Not byte by byte: ROS leaves whatever was in memory between aligned fields.
    read = typestore().deserialize_cdr(by_ros, msgtype)
    ours = bytes(typestore().serialize_cdr(blank(msgtype), msgtype))
    assert bytes(typestore().serialize_cdr(read, msgtype)) == ours
    assert 0 <= len(by_ros) - len(ours) < 4


@pytest.mark.parametrize(
    "msgtype",
    [
        *(f"knee_gap_msgs/msg/{name}" for name in ("GapEdges", "GapEstimate", "MotionAdvice")),
        "tf2_msgs/msg/TFMessage",  # built by set-up where ROS does not bring it
    ],
)
def test_type_hashes_are_those_of_rosidl(msgtype: str) -> None:
    package, name = msgtype.split("/msg/")
    generated = ROOT / f"install/{package}/share/{package}/msg/{name}.json"
    if not generated.exists():
        pytest.skip("the messages are not built")
    hashes = {h["type_name"]: h["hash_string"] for h in json.loads(generated.read_text())["type_hashes"]}
    assert hashes[msgtype] == typestore().hash_rihs01(msgtype)


def test_a_definition_is_found_in_the_ament_index(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path / "share/lab_msgs/msg"
    folder.mkdir(parents=True)
    (folder / "Probe.msg").write_text("std_msgs/Header header\nTip[2] tips\nstring<=9 name\n")
    (folder / "Tip.msg").write_text("geometry_msgs/Quaternion turn\nbool on\n")
    monkeypatch.setenv("AMENT_PREFIX_PATH", f"{tmp_path / 'other'}:{tmp_path}")
    probe = blank("lab_msgs/Probe")
    assert known_type("lab_msgs/Probe") == "lab_msgs/msg/Probe"
    assert [tip.turn.w for tip in probe.tips] == [1.0, 1.0]
    assert probe.name == ""


def test_another_version_of_a_type_is_refused() -> None:
    here = typestore().hash_rihs01("std_msgs/msg/Float64")
    check_type_hash("std_msgs/msg/Float64", here)
    check_type_hash("std_msgs/msg/Float64", "")
    with pytest.raises(BagError, match="of another version"):
        check_type_hash("std_msgs/msg/Float64", here[:-1] + "x")


def test_constants_stand_on_the_message() -> None:
    assert blank("knee_gap_msgs/msg/GapEdges").STATUS_OUT_OF_VIEW == 4
    assert import_module("knee_gap_core.values.edges").EdgeStatus.OUT_OF_VIEW == 4

"""Bags and parameter files made under former names."""

import shutil
from pathlib import Path
from typing import Any

import pytest
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from knee_gap_core.bag import former_names
from knee_gap_core.bag.bag import BagReader, BagWriter
from knee_gap_core.bag.errors import BagError
from knee_gap_core.bag.message_types import blank, check_type_hash, known_type
from knee_gap_core.node.parameters_file import ParametersFile
from knee_gap_perception.calibration.in_use import CalibrationParameters
from knee_gap_replay import check, process
from knee_gap_uncertainty.estimator_parameters import EstimatorParameters

ROOT = Path(__file__).parents[3]
FORMER = "knee_gap_msgs/msg/ScopeTurn"
MESSAGES = ROOT / "src/knee_gap_msgs/msg"
STAMPS = [1_000_000_000, 1_016_666_667, 1_033_333_333]


def former_message(store: Any, stamp_ns: int) -> Any:
    """A knee_gap_msgs/ScopeTurn, as it was."""
    header = store.types["std_msgs/msg/Header"](
        stamp=store.types["builtin_interfaces/msg/Time"](*divmod(stamp_ns, 1_000_000_000)), frame_id="lens"
    )
    return store.types[FORMER](header=header, turn=stamp_ns * 1e-9)


@pytest.fixture
def former_bag(tmp_path: Path) -> Path:
    """A bag with the turn of the scope under its former topic and type."""
    store = get_typestore(Stores.ROS2_JAZZY)
    text = (MESSAGES / "ScopeRotation.msg").read_text()
    store.register(get_types_from_msg(text, FORMER))
    path = tmp_path / "old"
    with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as bag:
        turns = bag.add_connection("/left/scope_turn", FORMER, typestore=store)
        for name, msgtype in (
            ("camera_info", "sensor_msgs/msg/CameraInfo"),
            ("image_raw/compressed", "sensor_msgs/msg/CompressedImage"),
            ("scope_body/pose", "geometry_msgs/msg/PoseStamped"),
            ("scope_turn_body/pose", "geometry_msgs/msg/PoseStamped"),
        ):
            bag.add_connection(f"/left/{name}", msgtype, typestore=store)
        for stamp_ns in STAMPS:
            message = former_message(store, stamp_ns)
            bag.write(turns, stamp_ns, store.serialize_cdr(message, turns.msgtype))
    shutil.copy(ROOT / "bags/sample/scope.yaml", path / "scope.yaml")
    return path


def test_topics_and_types_appear_under_their_names_of_today(former_bag: Path) -> None:
    with BagReader(former_bag) as reader:
        assert reader.topics["/left/scope_rotation"] == "knee_gap_msgs/msg/ScopeRotation"
        assert reader.topics["/left/scope_rotation_body/pose"] == "geometry_msgs/msg/PoseStamped"
        assert not [name for name in reader.topics if "turn" in name]
        messages = list(reader.messages(["/left/scope_rotation"]))
        assert reader.count(["/left/scope_rotation"]) == 3
        assert [reader.stamp_ns(message) for message in messages] == STAMPS
        assert [reader.deserialize(m).turn for m in messages] == [stamp * 1e-9 for stamp in STAMPS]
        assert {message.msgtype for message in messages} == {"knee_gap_msgs/msg/ScopeRotation"}


def test_the_bytes_are_those_of_today_and_may_be_played() -> None:
    store = get_typestore(Stores.ROS2_JAZZY)
    store.register(get_types_from_msg((MESSAGES / "ScopeRotation.msg").read_text(), FORMER))
    check_type_hash("knee_gap_msgs/msg/ScopeRotation", store.hash_rihs01(FORMER))
    with pytest.raises(BagError, match="another version"):
        check_type_hash("knee_gap_msgs/msg/ScopeRotation", store.hash_rihs01("std_msgs/msg/Header"))
    with pytest.raises(BagError, match="another version"):
        check_type_hash("knee_gap_msgs/msg/ScopeNotch", store.hash_rihs01(FORMER))


def test_a_type_with_a_renamed_field_is_another_name_for_the_same_bytes() -> None:
    msgtype = "knee_gap_msgs/msg/ScopeCalibration"
    name, text = former_names.former_definition(msgtype, (MESSAGES / "ScopeCalibration.msg").read_text())
    store = get_typestore(Stores.ROS2_JAZZY)
    store.register(get_types_from_msg(text, name))
    assert "turn_followed" in [field for field, _ in store.fielddefs[name][1]]
    check_type_hash(msgtype, store.hash_rihs01(name))


def test_every_name_of_today_exists() -> None:
    for msgtype in (*former_names.TYPES.values(), *former_names.FIELDS):
        assert known_type(msgtype)
        fields = vars(blank(msgtype))
        assert set(former_names.FIELDS.get(msgtype, {}).values()) <= fields.keys()


@pytest.mark.parametrize("command", [process, check])
def test_commands_print_in_one_line_what_was_renamed(former_bag, tmp_path, capsys, command) -> None:
    out = [str(tmp_path / "out")] if command is process else []
    command.main([str(former_bag), *out, "--namespace", "left"])
    lines = [line for line in capsys.readouterr().out.splitlines() if "former names" in line]
    assert len(lines) == 1
    assert "/left/scope_turn is /left/scope_rotation" in lines[0]
    assert "/left/scope_turn_body/pose is /left/scope_rotation_body/pose" in lines[0]


def test_a_bag_of_today_has_nothing_renamed(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "bag") as bag:
        bag.add_topic("/knee_gap/scope_rotation", "knee_gap_msgs/msg/ScopeRotation")
        bag.add_topic("/knee_gap/scope_turn", "knee_gap_msgs/msg/ScopeRotation")
    with BagReader(tmp_path / "bag") as reader:
        assert reader.renamed == ""
        assert set(reader.topics) == {"/knee_gap/scope_rotation", "/knee_gap/scope_turn"}


@pytest.mark.parametrize(
    ("node", "kind", "former", "today"),
    [
        ("uncertainty_node", EstimatorParameters, "lasting_share", "correlated_error_share"),
        ("uncertainty_node", EstimatorParameters, "depth_drift", "scale_drift"),
        ("tracking_node", CalibrationParameters, "scope_turn_notch", "scope_rotation_notch"),
    ],
)
def test_a_former_parameter_is_refused_with_its_name_of_today(tmp_path, node, kind, former, today) -> None:
    file = tmp_path / "parameters.yaml"
    file.write_text(f"{node}:\n  ros__parameters:\n    {former}: 0.0\n")
    with pytest.raises(BagError, match=f"{former} is called {today} today"):
        ParametersFile(file).build(node, [kind])
    assert today in kind.__dataclass_fields__

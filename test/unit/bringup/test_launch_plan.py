"""What launch files decide, without launch: what is refused, what is started, what an end means."""

import itertools

import pytest

from knee_gap_bringup import simulated_calibration
from knee_gap_bringup.launching.plan import (
    CALIBRATION_FILE,
    NODES,
    Next,
    PlannedProcess,
    Role,
    exit_code_of,
    live_plan,
    live_problem,
    reaction,
    replay_plan,
    replay_problem,
)
from knee_gap_core.bag.bag import BagWriter

NODE = PlannedProcess("knee_gap_perception", "segmentation_node")
AGAIN = PlannedProcess("knee_gap_perception", "segmentation_node", respawn=True)
PLAYER = PlannedProcess("knee_gap_replay", "play", Role.PLAYER)
RECORDER = PlannedProcess("knee_gap_replay", "record", Role.RECORDER)


@pytest.fixture
def bag(tmp_path):
    folder = tmp_path / "bag"
    folder.mkdir()
    (folder / "bag_0.mcap").write_bytes(b"something")
    return folder


def test_a_bag_and_an_output_that_is_free_are_no_problem(bag, tmp_path):
    assert replay_problem(str(bag), str(tmp_path / "out")) == ""
    assert replay_problem(str(bag), "") == ""


def test_what_is_wrong_is_one_line_before_anything_is_started(bag, tmp_path):
    there, link = tmp_path / "there", tmp_path / "link"
    there.touch()
    link.symlink_to(tmp_path / "nowhere")
    assert replay_problem(str(tmp_path / "none"), "") == f"bag: {tmp_path / 'none'} does not exist"
    assert "holds no .mcap or .db3 file" in replay_problem(str(tmp_path / "bag" / ".."), "")
    for out in (there, link, bag):
        problem = replay_problem(str(bag), str(out))
        assert problem == f"out: {out} exists already; choose another name or remove it"
    assert "rate: 'fast' is not a number" in replay_problem(str(bag), "", rate="fast")
    for rate in ("0", "-1", "nan", "inf"):
        assert replay_problem(str(bag), "", rate=rate).startswith("rate: must be a finite number")
    assert replay_problem(str(bag), "", params=str(tmp_path / "no.yaml")).endswith("no.yaml does not exist")
    assert replay_problem(str(bag), "", params=str(bag)).endswith("is not a file")
    assert live_problem(str(tmp_path / "no.yaml")).startswith("params: ")
    assert live_problem(str(there)) == ""
    assert live_problem(str(there), "0").startswith("respawn_delay: ")
    assert live_problem(str(there), "soon").startswith("respawn_delay: ")


def test_a_replay_is_three_nodes_a_recorder_and_the_player_last(bag):
    plan = replay_plan(str(bag), "out", rate="0.5", namespace="left")
    assert [process.executable for process in plan] == [*NODES, "record", "play"]
    assert not any(process.respawn for process in plan)
    assert plan[3].arguments[0] == "out"
    assert "/left/gap" in plan[3].arguments
    assert plan[4].arguments[:3] == (str(bag), "--rate", "0.5")
    assert {"/left/image_raw/compressed"} < set(plan[4].arguments)
    assert [process.executable for process in replay_plan(str(bag), "")] == [*NODES, "play"]


def test_what_stands_beside_a_bag_is_for_the_two_nodes_that_use_the_scope(bag):
    beside = bag / "scope.yaml"
    beside.touch()
    segmentation, tracking, uncertainty, _ = replay_plan(str(bag), "")
    assert tracking.parameters == (str(beside),)
    assert segmentation.parameters == (str(beside), {"image_transport": "compressed", "max_image_lag": 0.0})
    assert uncertainty.parameters == ()
    plan = replay_plan(str(bag), "", params="mine.yaml")
    assert all("mine.yaml" in process.parameters for process in plan if process.role is Role.NODE)
    assert not any(str(beside) in process.parameters for process in plan)


def test_a_bare_file_has_the_scope_beside_it(bag):
    beside = bag / "scope.yaml"
    beside.touch()
    segmentation, tracking, *_ = replay_plan(str(bag / "bag_0.mcap"), "")
    assert tracking.parameters == (str(beside),)
    assert segmentation.parameters[0] == str(beside)


@pytest.mark.parametrize(
    ("topics", "transport", "played"),
    [
        (["image_raw"], "raw", "image_raw"),
        (["image_raw/compressed"], "compressed", "image_raw/compressed"),
        (["image_raw", "image_raw/compressed"], "compressed", "image_raw/compressed"),
    ],
)
def test_the_images_that_a_bag_has_are_played(topics, transport, played, tmp_path):
    kinds = {"image_raw": "sensor_msgs/msg/Image", "image_raw/compressed": "sensor_msgs/msg/CompressedImage"}
    with BagWriter(tmp_path / "bag") as writer:
        for topic in topics:
            writer.add_topic(f"/left/{topic}", kinds[topic])
    segmentation, *_, player = replay_plan(str(tmp_path / "bag"), "", namespace="left")
    assert segmentation.parameters == ({"image_transport": transport, "max_image_lag": 0.0},)
    inputs = [f"/left/{name}" for name in (played, "camera_info", "scope_body/pose")]
    assert list(player.arguments)[4:7] == inputs


def test_a_calibration_beside_a_bag_is_for_both_nodes_that_use_one(bag):
    (bag / "scope.yaml").touch()
    (bag / CALIBRATION_FILE).touch()
    segmentation, tracking, uncertainty, _ = replay_plan(str(bag), "")
    given = {"calibration_file": str(bag / CALIBRATION_FILE)}
    assert tracking.parameters == (given,)
    assert segmentation.parameters[0] == given
    assert uncertainty.parameters == ()
    assert CALIBRATION_FILE == simulated_calibration.CALIBRATION_FILE


@pytest.mark.parametrize("namespace", ["knee_gap", "/knee_gap", "/knee_gap/"])
def test_a_node_s_command_line_carries_namespace_and_parameters(namespace):
    segmentation, *_ = replay_plan("bag", "", params="mine.yaml", namespace=namespace)
    given = " ".join(segmentation.ros_arguments)
    assert given == (
        "--ros-args -r __ns:=/knee_gap --params-file mine.yaml -p image_transport:=compressed "
        "-p max_image_lag:=0.0"
    )
    assert PLAYER.ros_arguments == ()


@pytest.mark.parametrize("respawn", [True, False])
def test_live_nodes_are_started_again_as_asked(respawn):
    plan = live_plan("mine.yaml", "knee_gap", respawn=respawn)
    assert [process.executable for process in plan] == list(NODES)
    assert {process.respawn for process in plan} == {respawn}


def test_one_process_is_the_suite_with_the_same_parameters():
    (suite,) = live_plan("mine.yaml", "left", one_process=True)
    assert (suite.package, suite.executable) == ("knee_gap_bringup", "suite_node")
    assert " ".join(suite.ros_arguments) == "--ros-args -r __ns:=/left --params-file mine.yaml"


@pytest.mark.parametrize(
    ("process", "code", "follows", "exit_code"),
    [
        (NODE, 1, Next.END, 1),
        (NODE, 2, Next.END, 2),
        (NODE, 0, Next.END, 0),
        (NODE, -9, Next.END, 137),
        (AGAIN, 1, Next.START_AGAIN, 0),
        (AGAIN, 0, Next.START_AGAIN, 0),
        (AGAIN, -11, Next.START_AGAIN, 0),
        # It refused its settings, and would again.
        (AGAIN, 2, Next.END, 2),
        (PLAYER, 0, Next.END_AFTER_DRAIN, 0),
        (PLAYER, 1, Next.END, 1),
        (PLAYER, -15, Next.END, 143),
        (RECORDER, 1, Next.END, 1),
        (RECORDER, 0, Next.END, 0),
    ],
)
def test_what_follows_the_end_of_a_process(process, code, follows, exit_code):
    answer = reaction(process, code)
    assert (answer.next, answer.code) == (follows, exit_code)


def test_no_failure_ends_with_zero_and_nothing_is_started_again_at_the_end():
    for process, code in itertools.product((NODE, AGAIN, PLAYER, RECORDER), range(-64, 256)):
        answer = reaction(process, code)
        assert answer.next is Next.START_AGAIN or (answer.code == 0) == (code == 0)
        assert 0 <= answer.code < 256
        ending = reaction(process, code, ending=True)
        assert ending.next is Next.NOTHING
        assert ending.code == (exit_code_of(code) if process is RECORDER else 0)

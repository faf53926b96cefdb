"""The wiring of the three nodes: what one receives another publishes, in a bag as live."""

import ast
from array import array
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import numpy as np

from knee_gap_core.bag.message_types import blank
from knee_gap_core.node.parameters_file import ParametersFile
from knee_gap_core.node.wiring import InputTopic, NodeCore, OutputTopic
from knee_gap_core.values.edges import EdgeStatus, GapEdges
from knee_gap_perception.edge_tracking.edge_stream import EdgeStream
from knee_gap_perception.edge_tracking.segmentation_core import GAP_MASK, SegmentationCore
from knee_gap_replay.pipeline import GapPipeline
from knee_gap_replay.topics import InputTopics

SPACE = "/space"
TOPICS = InputTopics("/image", "/info", "/body")
SOURCES = Path(__file__).parents[3] / "src"


def pipeline(tmp_path: Path, text: str = "") -> GapPipeline:
    """A pipeline with these parameters beside a lens on the body, `name: value` separated by commas."""
    path = tmp_path / "parameters.yaml"
    path.write_text(f'"**": {{ros__parameters: {{body_to_shaft_translation: [0.0, 0.0, 0.2], {text}}}}}\n')
    return GapPipeline.from_parameters(ParametersFile(path), TOPICS, SPACE)


def cores(given: GapPipeline) -> tuple[NodeCore, ...]:
    return (given.segmentation, given.tracking, given.uncertainty)


def test_what_no_driver_publishes_another_node_does(tmp_path: Path) -> None:
    made = pipeline(tmp_path)
    published = {one.topic: one.msgtype for core in cores(made) for one in core.outputs}
    optional = {"scope_rotation": "knee_gap_msgs/msg/ScopeRotation"}
    for core in cores(made):
        for given in core.inputs:
            if not given.from_driver:
                assert {**optional, **published}[given.topic] == given.msgtype


def test_a_bag_must_hold_what_drivers_publish_the_image_last(tmp_path: Path) -> None:
    assert pipeline(tmp_path).inputs == ("/info", "/body", "/image")
    with_leg = pipeline(tmp_path, "leg_motion: 0.001")
    assert with_leg.inputs == ("/info", "/space/leg_body/pose", "/body", "/image")


def test_topics_of_every_run_are_announced_first(tmp_path: Path) -> None:
    announced = pipeline(tmp_path).outputs
    assert list(announced)[:3] == ["/space/gap_edges", "/space/scope_pose", "/space/gap"]
    assert announced["/space/gap"] == ("knee_gap_msgs/msg/GapEstimate", "reliable")
    # Without a calibration there is none to publish.
    assert "/space/scope_calibration" not in announced


def test_a_picture_is_made_for_the_kind_of_message_that_it_goes_into() -> None:
    picture = np.arange(12, dtype=np.uint8).reshape(3, 4)
    edges = GapEdges.without_points(5, "optical", EdgeStatus.NO_GAP)
    stream = cast(EdgeStream, SimpleNamespace(latest=edges, mask=lambda: picture))

    def of_ros(_: str) -> SimpleNamespace:
        stamp = SimpleNamespace(sec=0, nanosec=0)
        return SimpleNamespace(header=SimpleNamespace(stamp=stamp), data=array("B"))

    for make in (blank, of_ros):
        made = SegmentationCore(stream, make).picture(GAP_MASK)
        assert made is not None
        assert bytes(made.message.data) == bytes(range(12))
        assert (made.message.height, made.message.width, made.message.step) == (3, 4, 4)
        assert (made.topic, made.stamp_ns, made.message.header.frame_id) == ("gap_mask", 5, "optical")
    assert isinstance(SegmentationCore(stream, of_ros).picture(GAP_MASK).message.data, bytes)  # type: ignore


def test_no_shell_names_a_topic_of_a_core(tmp_path: Path) -> None:
    """Nodes and pipeline take topics from the cores; only an operator's topics are a node's own."""
    declared: list[InputTopic | OutputTopic] = [
        one for core in cores(pipeline(tmp_path)) for one in (*core.inputs, *core.outputs)
    ]
    names = {one.topic for one in declared} | {one.msgtype for one in declared}
    shells = [
        *SOURCES.glob("knee_gap_perception/*/*_node.py"),
        *SOURCES.glob("knee_gap_uncertainty/*/*_node.py"),
        SOURCES / "knee_gap_replay/knee_gap_replay/pipeline.py",
    ]
    assert len(shells) == 4
    for shell in shells:
        texts = {
            node.value for node in ast.walk(ast.parse(shell.read_text())) if isinstance(node, ast.Constant)
        }
        assert not texts & names, shell.name

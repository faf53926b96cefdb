"""Masks of a bag against its truth: as a recorded topic, and as the simulation knows it."""

import csv
from pathlib import Path

import cv2
import numpy as np
import pytest

from knee_gap_core.bag.bag import BagReader, BagWriter
from knee_gap_core.bag.message_types import blank
from knee_gap_replay.evaluation.command import main
from knee_gap_replay.process import main as process
from knee_gap_simulation.make_bag.command import Recording, make_bag

MASK, TRUTH = "/knee_gap/gap_mask", "/knee_gap/gap_mask_true"


@pytest.fixture(scope="module")
def simulated(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("bags") / "simulated"
    make_bag(path, Recording(duration_s=0.1, seed=3), progress=False)
    return path


def rows(out: Path, name: str) -> list[dict[str, str]]:
    with (out / name).open(encoding="utf-8") as file:
        return list(csv.DictReader(file))


def masks(path: Path, stamps: dict[str, list[int]], shift: int) -> Path:
    """A bag of masks of a band, those on MASK shifted down."""
    with BagWriter(path) as bag:
        for topic, times in stamps.items():
            bag.add_topic(topic, "sensor_msgs/msg/Image", "sensor")
            picture = np.zeros((120, 160), np.uint8)
            picture[40:80] = 255
            picture = np.roll(picture, shift if topic == MASK else 0, axis=0)
            for stamp in times:
                message = blank("sensor_msgs/msg/Image")
                message.header.stamp.sec = stamp
                message.height, message.width, message.step, message.encoding = 120, 160, 160, "mono8"
                message.data = picture.ravel()
                bag.write(topic, message, stamp * 10**9)
    return path


def test_masks_of_the_same_stamp_are_compared(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bag = masks(tmp_path / "masks", {MASK: [1, 2, 3, 4, 5], TRUTH: [1, 2, 3, 4, 9]}, shift=4)
    assert main([str(bag), "--out", str(tmp_path / "out")]) == 0
    images = rows(tmp_path / "out", "images.csv")
    assert [int(row["name"]) for row in images] == [k * 10**9 for k in (1, 2, 3, 4)]
    assert [float(row["g0_px"]) for row in images] == pytest.approx([4.0] * 4)
    assert [float(row["dice_mean"]) for row in images] == pytest.approx([0.9] * 4)
    assert main([str(bag), "--every", "2", "--out", str(tmp_path / "half")]) == 0
    assert len(rows(tmp_path / "half", "images.csv")) == 2
    assert "0.9000" in capsys.readouterr().out


def test_a_simulated_bag_is_judged_by_what_its_scene_is(simulated: Path, tmp_path: Path) -> None:
    assert main([str(simulated), "--every", "3", "--out", str(tmp_path / "out")]) == 0
    table = rows(tmp_path / "out", "table.csv")
    assert [row["images"] for row in table] == ["2"]
    assert float(table[0]["dice_mean"]) > 0.97
    assert 0.0 < float(table[0]["average_deg"]) < 1.0
    # The angle is by the camera of the bag, 0.125 deg a pixel, and not by the paper's.
    assert float(table[0]["average_deg"]) / float(table[0]["average_px"]) == pytest.approx(0.125, rel=0.1)
    sheet = cv2.imread(str(tmp_path / "out" / "sheet.png"))
    assert sheet.shape[0] == 2 * 244


def test_what_process_says_of_the_gap_is_judged_by_the_bag_it_came_from(
    simulated: Path, tmp_path: Path
) -> None:
    results, plain = tmp_path / "results", tmp_path / "plain"
    assert process([str(simulated), str(results), "--gap-mask"]) == 0
    assert process([str(simulated), str(plain)]) == 0
    with BagReader(results) as with_masks, BagReader(plain) as without:
        assert with_masks.count([MASK]) == 6
        assert MASK not in without.topics
    assert main([str(results), str(simulated), "--every", "2", "--out", str(tmp_path / "a")]) == 0
    assert main([str(simulated), "--every", "2", "--out", str(tmp_path / "b")]) == 0
    dice = [float(rows(tmp_path / name, "table.csv")[0]["dice_mean"]) for name in "ab"]
    assert dice[0] == pytest.approx(dice[1], abs=2e-3)
    paper = [str(simulated), "--every", "2", "--segmentation", "otsu", "--out", str(tmp_path / "c")]
    assert main(paper) == 0
    assert float(rows(tmp_path / "c", "table.csv")[0]["dice_mean"]) != pytest.approx(dice[1], abs=1e-6)


def test_mistakes_are_one_line(simulated: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    untrue = masks(tmp_path / "untrue", {MASK: [1]}, shift=0)
    elsewhere = masks(tmp_path / "elsewhere", {MASK: [1], TRUTH: [2]}, shift=0)
    for arguments, reason in (
        ([str(untrue)], "has no ground truth"),
        ([str(elsewhere)], "has the stamp"),
        ([str(simulated), "--every", "0"], "--every must"),
        ([str(simulated), "--image-topic", "/nowhere"], "/nowhere is not in"),
        ([str(tmp_path)], "is not a bag"),
    ):
        assert main([*arguments, "--out", str(tmp_path / "out")]) == 1
        lines = [line for line in capsys.readouterr().err.splitlines() if "evaluating" not in line]
        assert len(lines) == 1, lines
        assert reason in lines[0]

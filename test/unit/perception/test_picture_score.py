"""Scores of marked pictures, on drawn ones whose answer is known."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from bench_real_pictures import main, network_without
from drawn_joint import Joint

from knee_gap_core.values.arrays import Array, Image
from knee_gap_perception.errors import PerceptionError
from knee_gap_perception.evaluation.picture_score import field_errors, mean, score_picture
from knee_gap_perception.image.field_of_view import FieldOfView
from knee_gap_perception.marks.marked_picture import Decision, MarkedField, MarkedPicture, Region
from knee_gap_perception.marks.marks_file import write_marks
from knee_gap_perception.marks.picture_files import sha256_of

ROUND = MarkedField(disc=(640.0, 360.0, 355.0))
PICTURE = MarkedPicture("a.png", "0" * 64, 1280, 720, "drawn", "knee", Decision.NO_GAP, field=ROUND)
HALF = np.array([[0, 0], [1279, 0], [1279, 360], [0, 360]])


@pytest.fixture(scope="module")
def drawn(joint: Joint) -> tuple[Image, Array]:
    """A picture of the joint, and the outline of its gap."""
    inside, bearings = joint.rays
    gap = np.zeros(inside.shape, np.uint8)
    gap[inside] = joint.cast(np.eye(4), bearings)[1]
    outlines, _ = cv2.findContours(gap, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
    outline = max(outlines, key=cv2.contourArea)[:, 0].astype(np.float64)
    return joint.picture(np.eye(4), seed=1), outline


def test_points_across_the_marked_gap_are_a_find(drawn: tuple[Image, Array]) -> None:
    image, outline = drawn
    marked = replace(PICTURE, decision=Decision.GAP, regions={Region.GAP: (outline,)})
    score, points = score_picture(marked, image)
    assert points is not None
    assert (score.found, score.false, score.on_instrument) == (True, False, 0)
    assert score.dice > 0.95
    assert score.field_right
    assert score.rim_error < 0.01
    assert not score.notch_seen
    assert not score.notch_false
    # The same points, where the gap is marked elsewhere, or an instrument is.
    elsewhere = replace(marked, regions={Region.GAP: (HALF / 4,), Region.INSTRUMENT: (HALF,)})
    score, _ = score_picture(elsewhere, image)
    assert (score.found, score.false, score.on_instrument) == (False, True, 1)


def test_points_in_a_picture_without_a_gap_are_false_unless_it_is_unclear(drawn: tuple[Image, Array]) -> None:
    image, outline = drawn
    for decision, regions, false in (
        (Decision.NO_GAP, {}, True),
        (Decision.NO_GAP, {Region.UNCLEAR: (outline,)}, False),
        (Decision.UNCLEAR, {}, False),
    ):
        score, points = score_picture(replace(PICTURE, decision=decision, regions=regions), image)
        assert points is not None
        assert (score.found, score.false) == (False, false)
        assert np.isnan(score.dice)


def test_a_field_is_right_where_it_is_the_marked_one() -> None:
    shape = (720, 1280)
    box = (0.0, 0.0, 1279.0, 719.0)
    overlap, rim = field_errors(ROUND, FieldOfView((643.0, 360.0), 355.0, box), shape)
    assert 0.98 < overlap < 0.995
    assert rim == pytest.approx(3.0 / 355.0, rel=0.02)
    assert field_errors(ROUND, None, shape)[0] == 0.0
    assert field_errors(ROUND, FieldOfView((640.0, 360.0), np.inf, box), shape)[0] < 0.5
    assert np.isnan(field_errors(None, None, shape)).all()
    full = field_errors(MarkedField(box=box), FieldOfView((640.0, 360.0), np.inf, box), shape)
    assert full[0] == 1.0
    assert np.isnan(full[1])


def test_a_source_is_scored_by_the_network_that_has_not_seen_it(tmp_path: Path) -> None:
    for name in ("learned", "without_a", "without_b+c"):
        (tmp_path / f"{name}.onnx").touch()
    assert network_without(tmp_path, "a").name == "without_a.onnx"
    assert network_without(tmp_path, "c").name == "without_b+c.onnx"
    with pytest.raises(PerceptionError, match="no network that was trained without the source 'learned'"):
        network_without(tmp_path, "learned")


def test_the_mean_leaves_out_what_is_not_known() -> None:
    assert mean([1.0, np.nan, 3.0]) == 2.0
    assert np.isnan(mean([np.nan]))


def test_the_bench_scores_what_is_there_and_says_what_is_not(
    drawn: tuple[Image, Array], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    image, outline = drawn
    arguments = [str(tmp_path), "--marks", str(tmp_path / "here.json"), "--out", str(tmp_path / "out")]
    (tmp_path / "images").mkdir()
    cv2.imwrite(str(tmp_path / "images" / "a.png"), image)
    marked = replace(
        PICTURE,
        sha256=sha256_of(tmp_path / "images" / "a.png"),
        decision=Decision.GAP,
        regions={Region.GAP: (outline,)},
    )
    write_marks(tmp_path / "here.json", [marked])
    assert main(arguments) == 0
    assert "its pictures are skipped" in capsys.readouterr().out
    (tmp_path / "images").rename(tmp_path / "here")
    assert main(arguments) == 0
    assert "| kind knee | 1 | 1 of 1 | 0 of 1 |" in capsys.readouterr().out
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == [
        "pictures.csv",
        "sheet.jpg",
        "table.md",
    ]
    cv2.imwrite(str(tmp_path / "here" / "a.png"), image // 2)
    assert main(arguments) == 1
    assert "is not the picture that was marked" in capsys.readouterr().err

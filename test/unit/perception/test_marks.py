"""Marks of real pictures: what a file may hold, and that marks go with the picture that was marked."""

import copy
import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from knee_gap_perception.errors import PerceptionError
from knee_gap_perception.marks.marked_picture import Decision, MarkedField, MarkedPicture, Region, filled
from knee_gap_perception.marks.marks_file import FORMAT, marks_of, read_marks, write_marks
from knee_gap_perception.marks.picture_files import frame_count, marked_images, picture_names, sha256_of

KEPT = Path(__file__).parents[2] / "data" / "marks"
ENTRY = {
    "file": "a.png",
    "sha256": "0" * 64,
    "source": "drawn",
    "kind": "knee",
    "decision": "gap",
    "width": 64,
    "height": 48,
    "frame": 3,
    "field": {"disc": [32, 24, 30], "box": [0, 4, 63, 43]},
    "notch_deg": -21.8,
    "gap": [[[10, 20], [50, 20], [50, 28], [10, 28]]],
    "unclear": [[[40, 20], [50, 20], [50, 28], [40, 28]]],
    "note": "a note",
}


def file_of(*entries: Any) -> dict[str, Any]:
    return {"format": FORMAT, "pictures": list(entries)}


def test_marks_survive_their_file(tmp_path: Path) -> None:
    other = {**ENTRY, "frame": None, "field": {"polygon": [[0, 0], [60, 1.5], [30, 47]]}, "notch_deg": None}
    marks = marks_of(file_of(ENTRY, other))
    write_marks(tmp_path / "marks.json", marks)
    again = read_marks(tmp_path / "marks.json")
    assert json.loads((tmp_path / "marks.json").read_text())["pictures"][0] == ENTRY
    for one, two in zip(marks, again, strict=True):
        assert (one.name, one.sha256, one.notch, one.note) == (two.name, two.sha256, two.notch, two.note)
        assert one.field is not None
        assert two.field is not None
        np.testing.assert_array_equal(one.field.mask(one.shape), two.field.mask(two.shape))
        for region in Region:
            np.testing.assert_array_equal(one.mask(region), two.mask(region))


def test_masks_are_cut_by_the_field_and_what_is_unclear_is_not_scored() -> None:
    (picture,) = marks_of(file_of(ENTRY))
    gap = picture.mask(Region.GAP)
    assert gap[24, 30]
    assert not gap[19, 30]
    assert gap.sum() == pytest.approx(41 * 9, abs=2)
    scored = picture.scored()
    assert scored[24, 30]
    assert not scored[24, 45]
    assert not scored[2, 32]  # beyond the box
    assert not scored[24, 0]  # beyond the disc


def test_the_rim_shows_only_inside_the_picture_and_the_box() -> None:
    field = MarkedField(disc=(32.0, 24.0, 30.0), box=(0.0, 4.0, 63.0, 43.0))
    rim = field.rim((48, 64))
    assert 0 < len(rim) < 360
    np.testing.assert_allclose(np.hypot(*(rim - [32.0, 24.0]).T), 30.0)
    assert (rim[:, 1] > 4.0).all()
    assert (rim[:, 1] < 43.0).all()
    assert len(MarkedField(box=(0.0, 0.0, 63.0, 47.0)).rim((48, 64))) == 0


def changed(key: str, value: Any) -> dict[str, Any]:
    entry = copy.deepcopy(ENTRY)
    entry[key] = value
    return entry


@pytest.mark.parametrize(
    ("entry", "words"),
    [
        ("a.png", "must be an object"),
        (changed("sha256", "12"), "64 digits"),
        (changed("file", "../a.png"), "name without a folder"),
        (changed("source", ""), '"source" must be a line of text'),
        (changed("decision", "maybe"), "must be one of gap, no gap, unclear, not maybe"),
        (changed("decision", "no gap"), 'the decision is "no gap", but there are polygons of a gap'),
        (changed("gap", []), 'the decision is "gap", but there are no polygon of a gap'),
        (changed("gap", [[[1, 2], [3, 4]]]), 'polygon 0 of "gap" has 2 points, a polygon has at least 3'),
        (changed("gap", [[[1, 2], [3, 4], [5]]]), "must be 2 numbers"),
        (changed("gap", [[[1, 2], [3, 4], [5, float("nan")]]]), "finite number"),
        (changed("gap", [[[1, 2], [3, 4], [500, 4]]]), "leaves the picture of 64x48 px at 500, 4"),
        (changed("gap", 7), "must be a list of polygons"),
        (changed("width", 0), "whole number"),
        (changed("frame", -1), "whole number"),
        (changed("frame", True), "whole number"),
        (changed("field", {"disc": [1, 2, 0]}), "radius above 0"),
        (changed("field", {"disc": [1, 2, 3], "polygon": [[0, 0], [1, 1], [0, 1]]}), "not both"),
        (changed("field", {"box": [5, 0, 4, 9]}), "first column, first row"),
        (changed("field", {}), "must have a disc"),
        (changed("instruments", []), '"instruments" is not known'),
        (changed("notch_deg", "left"), "finite number"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_a_broken_rule_is_one_line(entry: Any, words: str) -> None:
    with pytest.raises(PerceptionError) as caught:
        marks_of(file_of(entry))
    assert words in str(caught.value)
    assert str(caught.value).startswith("picture 0")
    assert "\n" not in str(caught.value)


def test_a_file_that_is_none_is_one_line(tmp_path: Path) -> None:
    path = tmp_path / "marks.json"
    for text, words in (
        ("", "not a JSON file"),
        ("{}", "not a file of marks"),
        ('{"format": "knee_gap_marks 1"}', '"pictures" must be a list'),
        ("[" * 50, "not a JSON file"),
    ):
        path.write_text(text)
        with pytest.raises(PerceptionError, match=words):
            read_marks(path)
    with pytest.raises(PerceptionError, match="marked twice"):
        marks_of(file_of(ENTRY, ENTRY))
    with pytest.raises(PerceptionError, match="No such file"):
        read_marks(tmp_path / "none.json")


def still(path: Path, seed: int = 1) -> MarkedPicture:
    image = np.random.default_rng(seed).integers(0, 255, (48, 64, 3), np.uint8)
    cv2.imwrite(str(path), image)
    return MarkedPicture(path.name, sha256_of(path), 64, 48, "drawn", "knee", Decision.NO_GAP)


def test_marks_of_another_picture_are_refused(tmp_path: Path) -> None:
    marks = [still(tmp_path / "a.png")]
    ((picture, image),) = marked_images(marks, tmp_path)
    assert picture is marks[0]
    assert image.shape == (48, 64, 3)
    still(tmp_path / "a.png", seed=2)
    with pytest.raises(PerceptionError, match=r"a\.png is not the picture that was marked: its SHA-256"):
        list(marked_images(marks, tmp_path))
    (tmp_path / "a.png").unlink()
    with pytest.raises(PerceptionError, match="No such file"):
        list(marked_images(marks, tmp_path))


def test_frames_of_a_video_are_those_of_their_number(tmp_path: Path) -> None:
    path = tmp_path / "b.avi"
    video = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 25.0, (64, 48))
    for level in range(0, 100, 10):
        video.write(np.full((48, 64, 3), level, np.uint8))
    video.release()
    assert frame_count(path) == 10
    assert picture_names(tmp_path) == ["b.avi"]
    marks = [
        MarkedPicture("b.avi", sha256_of(path), 64, 48, "drawn", "knee", Decision.NO_GAP, frame=frame)
        for frame in (7, 0, 4)
    ]
    found = {picture.frame: int(image.mean()) for picture, image in marked_images(marks, tmp_path)}
    assert {frame: round(level / 10) for frame, level in found.items()} == {0: 0, 4: 4, 7: 7}
    far = MarkedPicture("b.avi", sha256_of(path), 64, 48, "drawn", "knee", Decision.NO_GAP, frame=10)
    with pytest.raises(PerceptionError, match=r"b\.avi has no frame 10, it has 10"):
        list(marked_images([far], tmp_path))


@pytest.mark.parametrize("path", sorted(KEPT.glob("*.json")), ids=lambda path: path.stem)
def test_the_kept_marks_are_whole(path: Path) -> None:
    for picture in read_marks(path):
        for region in Region:
            for polygon in picture.polygons(region):
                assert cv2.contourArea(polygon.astype(np.float32)) > 4.0, picture.name
        gap, instrument = (
            filled(picture.polygons(region), picture.shape) for region in (Region.GAP, Region.INSTRUMENT)
        )
        assert (gap & instrument).sum() <= 0.05 * max(instrument.sum(), 1), picture.name
        if picture.decision is Decision.GAP:
            unclear = filled(picture.polygons(Region.UNCLEAR), picture.shape)
            assert (gap & ~unclear).sum() > 50, picture.name

"""Image errors between masks: overlap, edges at the gap points, the paper's table, files and refusals."""

import csv
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
import pytest

from knee_gap_core.values.arrays import Mask
from knee_gap_perception.camera.models import EquiangularCamera, FisheyeCamera
from knee_gap_perception.errors import PerceptionError
from knee_gap_perception.evaluation.difference_picture import FN, FP, TN, TP, difference_picture
from knee_gap_perception.evaluation.image_error import edge_error, overlap
from knee_gap_perception.evaluation.presets import PRESETS, image_error_preset
from knee_gap_perception.marks.marked_picture import Decision, MarkedPicture, Region
from knee_gap_perception.marks.marks_file import write_marks
from knee_gap_perception.marks.picture_files import sha256_of
from knee_gap_replay.evaluation.command import main

PAPER = EquiangularCamera(1280, 720)


def band(top: float, bottom: float, tilt: float = 0.0, shape: tuple[int, int] = (720, 1280)) -> Mask:
    """A gap across the picture between two rows (measured across it), widest in the middle."""
    rows, columns = np.indices(shape, dtype=float)
    x, y = columns - shape[1] / 2, rows - shape[0] / 2
    across, along = -x * np.sin(tilt) + y * np.cos(tilt), x * np.cos(tilt) + y * np.sin(tilt)
    taper = 6e-5 * along**2
    return (across >= top + taper) & (across < bottom - taper) & (np.abs(along) < 300)


def test_equal_masks_have_no_error() -> None:
    marked = band(-40, 40)
    error = edge_error(marked, marked, PAPER)
    assert error is not None
    assert error.rms_px == pytest.approx(0, abs=1e-9)
    assert overlap(marked, marked).dice == 1.0


@pytest.mark.parametrize("tilt", [0.0, 0.3, -0.7])
def test_a_shifted_edge_is_measured_across_the_gap(tilt: float) -> None:
    error = edge_error(band(-46, 43, tilt), band(-40, 40, tilt), PAPER)
    assert error is not None
    assert error.rms_px == pytest.approx([6, 3], abs=0.5)
    assert error.missed == pytest.approx(0)


def test_degrees_are_the_papers_for_vertical_edges() -> None:
    """Across the picture's rows a pixel is 90 / 720 = 0.125 degrees (the paper's DPP_y)."""
    error = edge_error(band(-50, 44), band(-40, 40), PAPER)
    assert error is not None
    assert np.degrees(error.rms) == pytest.approx(error.rms_px * 0.125, rel=1e-3)
    # A lens with twice the pixels per degree halves the angle.
    wide, narrow = (FisheyeCamera(1280, 720, f, f, 640, 360) for f in (400.0, 800.0))
    angles = [edge_error(band(-50, 44), band(-40, 40), camera) for camera in (wide, narrow)]
    assert angles[0].rms == pytest.approx(2 * angles[1].rms, rel=0.02)  # type: ignore[union-attr]


def test_points_are_named_from_above() -> None:
    error = edge_error(band(-46, 43), band(-40, 40), PAPER)
    assert error is not None
    assert error.points[0, 1] < error.points[1, 1]
    assert error.points[:, 1] == pytest.approx([320, 399], abs=1)


def test_rms_follows_a_wavy_edge() -> None:
    marked = band(-40, 40)
    columns = np.arange(1280)
    waves = np.rint(8 * np.sin(columns * 2 * np.pi / 20)).astype(int)
    predicted = marked.copy()
    for column, wave in enumerate(waves):
        edge = np.flatnonzero(marked[:, column])
        if len(edge):
            predicted[edge[0] - 20 : edge[0] + 20, column] = (
                np.arange(edge[0] - 20, edge[0] + 20) >= edge[0] + wave
            )
    error = edge_error(predicted, marked, PAPER)
    assert error is not None
    assert error.rms_px[0] == pytest.approx(8 / np.sqrt(2), rel=0.1)
    assert error.rms_px[1] == pytest.approx(0, abs=0.3)


def test_a_hole_inside_is_no_error_of_the_edge() -> None:
    marked = band(-40, 40)
    predicted = marked.copy()
    predicted[355:362, 600:700] = False
    error = edge_error(predicted, marked, PAPER)
    assert error is not None
    assert error.rms_px == pytest.approx(0, abs=1e-9)


def test_nothing_predicted_is_missed_not_zero() -> None:
    error = edge_error(np.zeros((720, 1280), bool), band(-40, 40), PAPER)
    assert error is not None
    assert np.isnan(error.rms_px).all()
    assert error.missed == pytest.approx(1)
    assert edge_error(band(-40, 40), np.zeros((720, 1280), bool), PAPER) is None


def test_overlap_counts() -> None:
    predicted, marked = np.zeros((2, 10, 10), bool)
    predicted[:4], marked[2:6] = True, True
    assert overlap(predicted, marked) == (20, 20, 20, 40)
    assert overlap(predicted, marked).dice == pytest.approx(0.5)
    with pytest.raises(PerceptionError, match="one size"):
        overlap(predicted, marked[:5])


def test_the_papers_colours() -> None:
    predicted, marked = np.array([[True, True, False, False]]), np.array([[True, False, True, False]])
    assert [tuple(c) for c in difference_picture(predicted, marked)[0].tolist()] == [TP, FP, FN, TN]
    assert TP[1] == max(TP)
    assert FP[2] == max(FP)
    assert FN[0] == max(FN)
    assert len(set(TN)) == 1


@pytest.mark.parametrize(("name", "row"), [("medial", 4.302), ("patellofemoral", 2.367), ("lateral", 5.586)])
def test_presets_are_table_2(name: str, row: float) -> None:
    preset = image_error_preset(name)
    assert np.degrees(preset.average) == pytest.approx(row)
    # The average column is the mean of the two, to the paper's rounding.
    assert np.degrees([preset.error_0, preset.error_1]).mean() == pytest.approx(row, abs=1e-3)
    with pytest.raises(PerceptionError, match="medial, patellofemoral, lateral"):
        image_error_preset("elbow")
    assert len(PRESETS) == 3


def save(folder: Path, name: str, mask: Mask) -> None:
    (folder / name).parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(folder / name), mask.astype(np.uint8) * 255)


def test_folders_to_table_and_pictures(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    predicted, marked, out = tmp_path / "predicted", tmp_path / "marked", tmp_path / "out"
    for image_set, shift in (("medial", 4), ("lateral", 8)):
        for index in range(2):
            save(marked, f"{image_set}/{index}.png", band(-40, 40))
            save(predicted, f"{image_set}/{index}.png", band(-40 - shift, 40))
    assert main([str(predicted), str(marked), "--out", str(out)]) == 0
    assert "medial" in capsys.readouterr().out
    with (out / "table.csv").open() as file:
        rows = {row["set"]: row for row in csv.DictReader(file)}
    assert float(rows["medial"]["g0_px"]) == pytest.approx(4, abs=0.5)
    assert float(rows["lateral"]["g0_deg"]) == pytest.approx(8 * 0.125, abs=0.07)
    pooled = np.sqrt((float(rows["medial"]["g0_px"]) ** 2 + float(rows["lateral"]["g0_px"]) ** 2) / 2)
    assert float(rows["all sets"]["g0_px"]) == pytest.approx(pooled)
    with (out / "images.csv").open() as file:
        assert len(list(csv.DictReader(file))) == 4
    assert cv2.imread(str(out / "difference" / "medial" / "0.png")).shape == (720, 1280, 3)
    assert (out / "sheet.png").is_file()


def test_mistakes_are_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "empty").mkdir()
    save(tmp_path / "marked", "a.png", band(-40, 40))
    save(tmp_path / "small", "a.png", band(-40, 40)[:300, :300])
    (tmp_path / "broken").mkdir()
    (tmp_path / "broken" / "a.png").write_bytes(b"no image")
    for folder, reason in (
        ("nowhere", "is not a folder"),
        ("empty", "has the name"),
        ("small", "one size"),
        ("broken", "cannot be read as an image"),
    ):
        assert main([str(tmp_path / folder), str(tmp_path / "marked"), "--out", str(tmp_path / "out")]) == 1
        lines = [line for line in capsys.readouterr().err.splitlines() if "evaluating" not in line]
        assert len(lines) == 1
        assert reason in lines[0]
    assert main([str(tmp_path / "empty"), "--out", str(tmp_path / "out")]) == 1
    assert "it holds no MCAP file" in capsys.readouterr().err


def marked_folder(folder: Path) -> tuple[Path, Path]:
    """Folders of pictures and of masks, with marks of a gap, of no gap and of an unclear picture."""
    pictures, masks, marks = folder / "pictures", folder / "masks", []
    pictures.mkdir()
    masks.mkdir()
    for name, decision in (("a", Decision.GAP), ("b", Decision.NO_GAP), ("c", Decision.UNCLEAR)):
        image = np.random.default_rng(1).integers(90, 120, (96, 128, 3), np.uint8)
        image[40:56, 20:108] = 8 if decision is Decision.GAP else 100
        cv2.imwrite(str(pictures / f"{name}.png"), image)
        regions = {Region.UNCLEAR: (box(90, 0, 127, 95),)}
        if decision is Decision.GAP:
            regions[Region.GAP] = (box(20, 40, 107, 55),)
        marks.append(
            MarkedPicture(
                f"{name}.png", sha256_of(pictures / f"{name}.png"), 128, 96, f"site {name}", "knee", decision,
                regions=regions,
            )
        )  # fmt: skip
        predicted = np.zeros((96, 128), bool)
        predicted[44:56, 20:128] = decision is Decision.GAP
        save(masks, f"{name}.png", predicted)
    write_marks(folder / "marks.json", marks)
    return pictures, masks


def box(left: float, top: float, right: float, bottom: float) -> npt.NDArray[np.float64]:
    return np.array([[left, top], [right, top], [right, bottom], [left, bottom]])


def test_masks_against_marks(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pictures, masks = marked_folder(tmp_path)
    arguments = [str(masks), str(tmp_path / "marks.json"), "--pictures", str(pictures)]
    assert main([*arguments, "--out", str(tmp_path / "out")]) == 0
    rows = {row["set"]: row for row in csv.DictReader((tmp_path / "out" / "table.csv").open())}
    assert set(rows) == {"site a", "site b", "all sets"}
    # 12 of the 16 marked rows; what lies in the unclear part counts on neither side.
    assert float(rows["site a"]["dice_mean"]) == pytest.approx(2 * 12 / (12 + 16), abs=0.001)
    assert float(rows["site a"]["g0_px"]) == pytest.approx(4.0, abs=0.5)
    assert float(rows["site b"]["dice_mean"]) == 1.0
    save(masks, "a.png", np.zeros((10, 10), bool))
    assert main([*arguments, "--out", str(tmp_path / "again")]) == 1
    assert "a.png has 10x10 px, a.png was marked with 128x96 px" in capsys.readouterr().err


def test_marked_pictures_are_segmented_here_and_must_be_those(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pictures, masks = marked_folder(tmp_path)
    arguments = [str(pictures), str(tmp_path / "marks.json"), "--out", str(tmp_path / "out")]
    assert main([*arguments, "--segmentation", "otsu"]) == 0
    rows = {row["set"]: row for row in csv.DictReader((tmp_path / "out" / "table.csv").open())}
    assert float(rows["site a"]["dice_mean"]) > 0.9
    capsys.readouterr()
    (pictures / "b.png").write_bytes((pictures / "a.png").read_bytes())
    assert main(arguments) == 1
    assert main([str(masks), str(tmp_path / "none.json")]) == 1
    assert main([str(tmp_path), str(tmp_path / "marks.json"), "--pictures", str(pictures)]) == 1
    lines = [line for line in capsys.readouterr().err.splitlines() if line.startswith("evaluate: ")]
    assert len(lines) == 3
    assert "b.png is not the picture that was marked" in lines[0]
    assert "No such file" in lines[1]
    assert "no mask in" in lines[2]

"""The study of coverage: its simulated errors, its bound, its rows, and the command's refusals."""

import csv
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from knee_gap_uncertainty.studies.coverage import command
from knee_gap_uncertainty.studies.coverage.bound import bound
from knee_gap_uncertainty.studies.coverage.cells import ERROR_SETS, SHARES, Cell, Scene, cells
from knee_gap_uncertainty.studies.coverage.intervals import intervals
from knee_gap_uncertainty.studies.coverage.measure import Batch, batches, measure
from knee_gap_uncertainty.studies.coverage.plot import save_plot
from knee_gap_uncertainty.studies.coverage.table import summary, write_csv
from knee_gap_uncertainty.studies.coverage.tracks import simulate, true_bearings, true_track
from knee_gap_uncertainty.studies.coverage.unfinished import Unfinished

CELL = Cell(Scene(0.008, 0.004, 0.003, 45), ERROR_SETS[0], 2, "half", "bounded", "right")


def angles(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    return np.arctan2(np.linalg.norm(np.cross(first, second), axis=-1), np.sum(first * second, axis=-1))


@pytest.mark.parametrize("share", SHARES)
def test_bounded_errors_keep_their_bounds_and_have_the_stated_variance(share: str) -> None:
    cell = replace(CELL, share=share)
    lens, points = true_track(cell.scene, cell.view_count)
    truth = true_bearings(lens, points)
    tracks = simulate(cell, 4000, np.random.default_rng(1))
    error = angles(tracks.bearings, truth)
    assert error.max() <= cell.errors.image_error + cell.errors.rotation_error
    assert np.sqrt(np.mean(error**2) / 2.0) == pytest.approx(tracks.deviation, rel=0.03)
    shift = tracks.lens - lens
    assert np.linalg.norm(shift, axis=-1).max() <= cell.errors.translation_error
    assert shift.var() == pytest.approx(tracks.lens_variance, rel=0.05)


@pytest.mark.parametrize("share", SHARES)
def test_gaussian_errors_have_the_variances_of_the_bounded_ones(share: str) -> None:
    cell = replace(CELL, share=share, noise="gaussian")
    lens, points = true_track(cell.scene, cell.view_count)
    tracks = simulate(cell, 4000, np.random.default_rng(2))
    error = angles(tracks.bearings, true_bearings(lens, points))
    assert np.sqrt(np.mean(error**2) / 2.0) == pytest.approx(tracks.deviation, rel=0.03)
    assert (tracks.lens - lens).var() == pytest.approx(tracks.lens_variance, rel=0.05)


def test_the_common_part_is_the_same_in_all_views_of_a_track() -> None:
    still = replace(ERROR_SETS[0], translation_error=0.0, rotation_error=0.0)
    cell = replace(CELL, share="common", errors=still, scene=Scene(0.02, 0.004, 1e-6, 0), view_count=10)
    tracks = simulate(cell, 20, np.random.default_rng(3))
    assert angles(tracks.bearings[:, :1], tracks.bearings).max() < 1e-3
    assert angles(tracks.bearings[0], tracks.bearings[1]).min() > 1e-3


def test_the_bound_falls_with_the_root_of_the_views_where_errors_are_independent() -> None:
    few, many = (
        bound(replace(CELL, share="independent", view_count=count)).gap_considered for count in (30, 120)
    )
    assert few / many == pytest.approx(2.0, rel=0.04)


def test_an_offset_known_to_be_constant_can_only_help() -> None:
    for share in ("independent", "half"):
        least = bound(replace(CELL, share=share, view_count=20))
        assert least.gap_offset_known_constant <= least.gap_considered * (1.0 + 1e-9)
    assert np.isnan(bound(replace(CELL, share="common")).gap_offset_known_constant)


def test_every_cell_is_in_one_batch_and_all_that_the_study_asks_for_is_there() -> None:
    everything = list(cells())
    listed = [cell for batch in batches() for cell in batch.cells]
    assert listed == everything
    assert len(set(everything)) == len(everything)
    assert {cell.view_count for cell in everything} == {2, 10, 60}
    assert {cell.errors.name for cell in everything} == {"set 1", "set 2", "0.5 deg"}
    assert min(cell.scene.depth for cell in everything) == 0.004
    assert max(cell.scene.travel for cell in everything) == 0.010


def test_rows_follow_the_seed_and_are_written(tmp_path: Path) -> None:
    batch = Batch(3, (CELL, replace(CELL, model="sigma half")))
    rows = measure(batch, 200, seed=5)
    assert str(measure(batch, 200, seed=5)) == str(rows)
    assert str(measure(batch, 200, seed=6)) != str(rows)
    right, too_sure = rows
    assert right.coverage == pytest.approx(0.95, abs=0.06)
    assert right.worst_case_coverage == 1.0
    assert right.missed_below + right.missed_above + right.coverage == pytest.approx(1.0)
    assert too_sure.coverage < right.coverage - 0.1
    write_csv(tmp_path / "table.csv", rows)
    with (tmp_path / "table.csv").open() as file:
        read = list(csv.DictReader(file))
    assert [row["model"] for row in read] == ["right", "sigma half"]
    assert float(read[0]["coverage"]) == pytest.approx(right.coverage, abs=1e-5)
    save_plot(tmp_path / "plot.png", rows)
    assert (tmp_path / "plot.png").stat().st_size > 10_000


def test_the_summary_counts_and_names_cells_outside_the_promise() -> None:
    row = measure(Batch(1, (CELL,)), 50, seed=1)[0]
    lines = summary([replace(row, accepted=1.0, coverage=0.95), replace(row, accepted=1.0, coverage=0.5)])
    assert "  outside 93-97 %: 1" in lines[1]
    assert "50.00 %: depth 8, gap 4, travel 3 mm at 45 deg, set 1, N = 2, half, bounded" in lines[1]


def test_ranges_stand_beside_all_rows_of_the_same_tracks() -> None:
    two = measure(Batch(1, (CELL,)), 20, seed=1)[0]
    ten = measure(Batch(2, (replace(CELL, view_count=10),)), 20, seed=1)[0]
    assert np.isnan(ten.paper_width_mm)
    assert command.with_ranges([two, ten])[1].paper_width_mm == two.paper_width_mm


@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        (["--runs", "3"], "--runs must be from 10 to 100000, got 3"),
        (["--seed", "-1"], "--seed must not be negative, got -1"),
        (["--processes", "0"], "--processes must be at least 1, got 0"),
    ],
)
def test_a_mistake_is_one_line(arguments: list[str], reason: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert command.main(arguments) == 2
    assert capsys.readouterr().err == f"coverage: {reason}\n"


def test_a_place_that_cannot_be_written_is_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file").write_text("")
    assert command.main(["--out", str(tmp_path / "file" / "below")]) == 2
    assert "coverage: cannot write to" in capsys.readouterr().err


def test_an_interrupted_study_goes_on_to_the_same_rows(tmp_path: Path) -> None:
    batch = next(iter(batches()))
    rows = measure(batch, 10, 5)
    begun = Unfinished(tmp_path, 10, 5)
    assert begun.read() == {}
    begun.add(batch.number, rows)
    with begun.path.open("a") as file:
        file.write('[7, [{"depth_mm": 4')
    (number, again), *more = Unfinished(tmp_path, 10, 5).read().items()
    assert not more
    assert number == batch.number
    assert repr(again) == repr(rows)
    assert Unfinished(tmp_path, 11, 5).read() == {}
    reported = ["--out", str(tmp_path), "--seed", "5", "--so-far", "--runs"]
    assert command.main([*reported, "10"]) == 0
    assert (tmp_path / "coverage.csv").exists()
    assert command.main([*reported, "11"]) == 2
    begun.remove()
    assert begun.read() == {}


@pytest.mark.parametrize("noise", ["bounded", "gaussian"])
def test_errors_that_are_all_common_do_not_widen_the_interval(noise: str) -> None:
    """2 views over a short travel: what of a common error is taken for each bearing's own goes into depth."""
    scene = Scene(depth=8e-3, gap=12e-3, travel=1e-3, direction_deg=90)
    cell = Cell(scene, ERROR_SETS[0], view_count=2, share="common", noise=noise, model="right")
    tracks = simulate(cell, 1000, np.random.default_rng(8))
    found = intervals(tracks, cell)
    covered = np.mean((found.lower <= tracks.gap) & (tracks.gap <= found.upper))
    assert found.accepted.all()
    assert 0.93 < covered < 0.975

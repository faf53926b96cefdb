"""The study: what it writes, that its stored geometry is what it claims, and its simulated runs."""

import csv
import math
from html.parser import HTMLParser

import numpy as np
import pytest

from knee_gap_uncertainty.studies.paper.command import main
from knee_gap_uncertainty.studies.paper.geometry import GapPlace, exact_views
from knee_gap_uncertainty.studies.paper.geometry_fit import FITTED, READINGS, rms_mm
from knee_gap_uncertainty.studies.paper.monte_carlo import shaken, simulate
from knee_gap_uncertainty.studies.paper.scenarios import SCENARIOS, TABLE_4, TABLE_4_AVERAGE

FIGURES = ("figure_9a", "figure_9b", "figure_10", "figure_11", "figure_12", "table_4", "runs", "sensitivity")
TABLES = ("table_3", "table_4", "runs", "geometry", "consistency", "figure_12")


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    out = tmp_path_factory.mktemp("study")
    assert main(["--out", str(out), "--runs", "3"]) == 0
    return out


def test_every_figure_and_table_is_written(written):
    for name in FIGURES:
        assert (written / f"{name}.png").read_bytes().startswith(b"\x89PNG")
        assert "</svg>" in (written / f"{name}.svg").read_text()
    for name in TABLES:
        with (written / f"{name}.csv").open() as file:
            assert len({len(line) for line in csv.reader(file)}) == 1


def test_every_cell_of_table_4_has_paper_ours_and_difference(written):
    with (written / "table_4.csv").open() as file:
        lines = list(csv.DictReader(file))
    assert len(lines) == 7 * 4
    for line in lines:
        ours, published = float(line["paper_mm"]), float(line["published_mm"])
        assert float(line["difference_mm"]) == pytest.approx(ours - published, abs=1e-4)
        if line["column"] == "minimum":
            assert float(line["worst_case_mm"]) < ours
        if line["column"] == "maximum":
            assert float(line["worst_case_mm"]) > ours


class Sources(HTMLParser):
    def __init__(self):
        super().__init__()
        self.found = []

    def handle_starttag(self, tag, attrs):
        self.found += [value for name, value in attrs if name in ("src", "href")]


def test_the_page_needs_no_other_file(written):
    sources = Sources()
    sources.feed((written / "study.html").read_text())
    assert len(sources.found) == len(FIGURES)
    assert all(source.startswith("data:image/png;base64,") for source in sources.found)


@pytest.mark.parametrize("reading", READINGS, ids=lambda reading: reading.name)
def test_a_stored_geometry_fits_as_well_as_it_says(reading):
    fit = FITTED[reading.name]
    assert rms_mm(fit.place, fit.apex, reading.rows) == pytest.approx(fit.rms_mm, abs=1e-4)
    assert fit.place.turn_deg == 0 or reading.turned


def test_the_published_averages_are_those_of_the_published_rows():
    for i, average in enumerate(TABLE_4_AVERAGE):
        assert np.mean([TABLE_4[number][i] for number in range(1, 5)]) == pytest.approx(average, abs=1e-3)


@pytest.mark.parametrize("scenario", SCENARIOS, ids=lambda scenario: scenario.name)
def test_scenarios_are_the_printed_geometry(scenario):
    """The lens ends at the origin after the stated travel, at the stated angle to the gap's perpendicular."""
    place = GapPlace(-2.0, 4.0, 3.0, 25.0)
    views = exact_views(place, scenario)
    points = place.points(scenario.gap_mm)
    assert np.linalg.norm(points[1] - points[0]) == pytest.approx(scenario.gap_mm / 1e3)
    assert views.lens_1.tolist() == [0, 0, 0]
    assert views.baseline == pytest.approx(scenario.travel_mm / 1e3)
    flat = (points[1] - points[0]) * [1, 1, 0]
    sine = abs(flat @ views.travel) / np.linalg.norm(flat) / views.baseline
    assert sine == pytest.approx(math.sin(math.radians(scenario.angle_deg)), abs=1e-12)


def test_simulated_errors_stay_within_their_bounds_and_reach_them():
    rng = np.random.default_rng(1)
    scenario = SCENARIOS[4]
    exact = exact_views(GapPlace(-2.0, 4.0, 3.0, 25.0), scenario)
    moves, turns = [], []
    for _ in range(500):
        views = shaken(exact, scenario, rng)
        moves.append(np.linalg.norm(views.lens_0 - exact.lens_0))
        turns.append(math.acos(min(1.0, float(views.bearings_1[1] @ exact.bearings_1[1]))))
    assert 0.95 * scenario.translation_error < max(moves) <= scenario.translation_error
    assert 0.95 * scenario.angular_error < max(turns) <= scenario.angular_error * (1 + 1e-9)


def test_runs_are_repeatable_and_the_worst_case_holds_them_all():
    fit = FITTED[READINGS[0].name]
    one, other = (simulate(fit, SCENARIOS[3], 100, np.random.default_rng(7)) for _ in range(2))
    np.testing.assert_array_equal(one.errors_mm, other.errors_mm)
    assert one.held_worst_case == 1
    assert one.held_paper < 1


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--runs", "1"], "--runs must be from 2 to 1000000, got 1"),
        (["--seed", "-1"], "--seed must not be negative, got -1"),
        (["--out", "/dev/null/study"], "cannot write to /dev/null/study"),
    ],
)
def test_a_mistake_gets_one_line(arguments, words, capsys):
    assert main(arguments) == 2
    assert words in capsys.readouterr().err

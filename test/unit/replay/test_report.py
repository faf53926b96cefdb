"""Pages of bags: they show what the bag holds, nothing is fetched, a bad bag costs only itself."""

import base64
import csv
import re
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from knee_gap_core.bag.bag import BagWriter
from knee_gap_core.bag.message_types import blank
from knee_gap_core.conversions.edge_messages import fill_gap_edges
from knee_gap_core.values.edges import EdgeKind, EdgeState, EdgeStatus, GapEdges, SectionEdges
from knee_gap_core.values.gap_estimate import GapEstimate, GapStatus
from knee_gap_core.values.rejection import Rejection
from knee_gap_replay.report import command
from knee_gap_replay.report.command import _names
from knee_gap_replay.report.figures import STATUS_COLOURS
from knee_gap_replay.report.results import read_results
from knee_gap_simulation.recordings.recording import Sample, write_recording
from knee_gap_simulation.recordings.scene_truth import SceneTruth
from knee_gap_simulation.rims.scene import RimScene
from knee_gap_simulation.scope.arthroscope import Scope
from knee_gap_simulation.scope.lens import Lens
from knee_gap_uncertainty.estimation.acceptance import Reason
from knee_gap_uncertainty.estimation.messages import fill_gap_estimate

BEGIN, PERIOD = 5_000_000_000, 20_000_000
COUNT = 40
# Images without a VALID estimate: at the start, and four in the middle.
SHORT, LOST = range(10), range(20, 24)
HOSTILE = "no pose within 12.5 ms of <script>alert(1)</script>"
DEPTH = 0.010
TOPICS = {
    "gap_edges": "knee_gap_msgs/msg/GapEdges",
    "gap": "knee_gap_msgs/msg/GapEstimate",
    "scope_calibration": "knee_gap_msgs/msg/ScopeCalibration",
}


@pytest.fixture(scope="module")
def truth() -> SceneTruth:
    """Two rims in front of a lens at the origin."""
    T_world_scene = np.eye(4)
    T_world_scene[2, 3] = DEPTH
    return SceneTruth(RimScene.random(0.004, 3), T_world_scene, Lens(), Scope())


@pytest.fixture(scope="module")
def recording(truth: SceneTruth, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Images of a grey disc with the true pose of the lens, as a simulated bag; one of them is no JPEG."""
    picture = np.zeros((truth.lens.height_px, truth.lens.width_px, 3), np.uint8)
    centre = round(truth.lens.centre_x_px), round(truth.lens.centre_y_px)
    cv2.circle(picture, centre, 340, (120, 120, 120), -1)
    good = cv2.imencode(".jpg", picture)[1].tobytes()
    path = tmp_path_factory.mktemp("recording") / "inputs"
    samples = (
        Sample(BEGIN + index * PERIOD, jpeg=b"none" if index == 22 else good, T_world_lens=np.eye(4))
        for index in range(COUNT)
    )
    write_recording(path, samples, truth.lens, truth.as_metadata())
    return path


@pytest.fixture(scope="module")
def estimates(truth: SceneTruth) -> list[GapEstimate]:
    """Estimates of every image, 0.1 mm above the truth; some are not VALID."""
    bearings = truth.edges_at_section(np.eye(4), truth.lens.pixels([0.0, 0.0, 1.0]))
    gap = truth.instrument_gap(np.eye(4), bearings).diameter
    valid = GapEstimate(
        0,
        "world",
        GapStatus.VALID,
        track_id=1,
        gap=gap + 1e-4,
        gap_min=gap - 5e-4,
        gap_max=gap + 7e-4,
        snr=3.25,
        baseline=2e-3,
        shares=np.array([0.1, 0.2, 0.1, 0.1, 0.2, 0.3]),
    )
    short = replace(
        valid,
        status=GapStatus.INSUFFICIENT_PARALLAX,
        gap=np.nan,
        rejection=Rejection(Reason.HARDLY_MOVED),
    )
    found = []
    for index in range(COUNT):
        one = short if index in SHORT else valid
        if index in LOST:
            rejection = Rejection(Reason.NO_POSE, HOSTILE.replace("12.5", f"{index}.5"))
            one = GapEstimate(0, "world", GapStatus.OUT_OF_SYNC, track_id=1, rejection=rejection)
        found.append(replace(one, stamp_ns=BEGIN + index * PERIOD))
    return found


@pytest.fixture(scope="module")
def results(
    truth: SceneTruth, estimates: list[GapEstimate], tmp_path_factory: pytest.TempPathFactory
) -> Path:
    """The estimates as a bag, with edges and a calibration, begun by a node that had no image yet."""
    path = tmp_path_factory.mktemp("results") / "results"
    bearings = truth.edges_at_section(np.eye(4), truth.lens.pixels([0.0, 0.0, 1.0]))
    pixels = truth.lens.pixels(bearings)
    edges = GapEdges(
        stamp_ns=0,
        frame_id="arthroscope_optical",
        status=EdgeStatus.VALID,
        track_id=1,
        pixels=pixels,
        bearings=bearings,
        kinds=(EdgeKind.RIM, EdgeKind.RIM),
        covariances=np.zeros((2, 3, 3)),
        angular_error=0.01,
        section=SectionEdges((EdgeState.SEEN, EdgeState.SEEN), bearings, pixels=pixels),
    )
    with BagWriter(path) as bag:
        for name, msgtype in TOPICS.items():
            bag.add_topic(f"/knee_gap/{name}", msgtype)
        used = blank(TOPICS["scope_calibration"])
        used.node, used.hash, used.lens_covariance = "tracking_node", "abcdef0123456789ff", 1e-8 * np.eye(6)
        used.lens_covariance = used.lens_covariance.ravel()
        bag.write("/knee_gap/scope_calibration", used, BEGIN)
        waiting = GapEstimate(0, "", GapStatus.UNKNOWN, rejection=Rejection(Reason.NOTHING_YET))
        for one in [replace(waiting, stamp_ns=BEGIN + 10**18), *estimates]:
            bag.write("/knee_gap/gap", fill_gap_estimate(blank(TOPICS["gap"]), one), BEGIN)
        for one in estimates:
            message = fill_gap_edges(
                blank(TOPICS["gap_edges"]),
                replace(edges, stamp_ns=one.stamp_ns),
                lambda: blank("knee_gap_msgs/msg/GapSection"),
            )
            bag.write("/knee_gap/gap_edges", message, one.stamp_ns)
    return path


@pytest.fixture(scope="module")
def pages(results: Path, recording: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The report of the results."""
    out = tmp_path_factory.mktemp("report") / "out"
    arguments = [str(results), "--input", str(recording), "--output", str(out), "--truth", "5"]
    assert command.main(arguments) == 0
    return out


def cell(text: str) -> str:
    return rf"<td[^>]*>{re.escape(text)}</td>"


def test_what_a_page_says_is_what_the_bag_holds(pages: Path) -> None:
    page = (pages / "results.html").read_text()
    assert "26 (63.4 %)" in page  # of 41
    rows = [
        ("VALID", "-", "26"),
        ("INSUFFICIENT_PARALLAX", "the scope has hardly moved", "10"),
        ("UNKNOWN", "no edges received yet", "1"),
    ]
    for row in rows:
        assert re.search("".join(cell(text) for text in row), page), row
    # Reasons that differ in their numbers are one reason.
    assert re.search(cell("OUT_OF_SYNC") + r"<td>no pose within # ms of[^<]*</td>" + cell("4"), page)
    # From 0.4 s, four images of 20 ms each.
    assert re.search(cell("0.40") + cell("0.08") + cell("4") + cell("OUT_OF_SYNC"), page)
    assert re.search(cell("shape") + cell("30.0 %"), page)
    assert "inside the bounds 100.0 %" in page
    assert "median |gap - truth| 0.10 mm" in page
    # sqrt(3e-8) m.
    assert re.search(cell("tracking_node") + cell("abcdef0123456789") + cell("0 x 0") + cell("0.1732"), page)
    assert "1 estimates have stamps of another clock" in page


def test_a_page_needs_nothing_else_and_runs_nothing(pages: Path) -> None:
    for path in pages.glob("*.html"):
        page = path.read_text()
        assert not re.findall(r"<(?:script|link|iframe|object)", page), path
        targets = re.findall(r'(?:src|href)="([^"]*)"', page)
        assert all(t.startswith(("data:", "#")) or (pages / t).is_file() for t in targets), targets
        assert "@import" not in page
        # Names of a format, which a browser does not fetch.
        assert set(re.findall(r'https?://[^\s"<]*', page)) <= {
            "http://www.w3.org/1999/xlink",
            "http://www.w3.org/2000/svg",
        }
    assert "&lt;script&gt;" in (pages / "results.html").read_text()


def test_frames_are_drawn_on_the_images(pages: Path) -> None:
    page = (pages / "results.html").read_text()
    found = [base64.b64decode(text) for text in re.findall(r"data:image/jpeg;base64,([\w+/=]+)", page)]
    pictures = [cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR) for data in found]
    assert len(pictures) == 5
    # Six chosen; one cannot be decoded, which is reported.
    assert "cannot be decoded" in page
    for picture in pictures:
        # Only the disc is shown, and the circle between the edges is drawn on it.
        assert picture.shape[:2] == (640, 640)
        middle = picture[160:480, 160:480].astype(int)
        assert (middle.min(axis=2) > 200).sum() > 100


def test_csv_holds_every_number(pages: Path, estimates: list[GapEstimate]) -> None:
    with (pages / "results.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 41
    for row, one in zip(rows[1:], estimates, strict=True):
        assert int(row["stamp_ns"]) == one.stamp_ns
        assert row["status"] == one.status.name
        assert row["reason"] == one.reason
        for name in ("gap", "gap_min", "snr", "baseline"):
            value = getattr(one, name)
            assert row[name] == ("" if np.isnan(value) else repr(value))
    assert rows[1]["gap"] == ""
    known = [row for row in rows if row["gap_true"]]
    assert len(known) == 5
    assert float(known[2]["gap_true"]) == pytest.approx(estimates[-1].gap - 1e-4, abs=1e-9)


def test_parquet_holds_the_same_numbers(results: Path, tmp_path: Path) -> None:
    parquet = pytest.importorskip("pyarrow.parquet")
    out = tmp_path / "out"
    assert command.main([str(results), "--output", str(out), "--parquet", "--frames", "0"]) == 0
    table = parquet.read_table(out / "results.parquet").to_pydict()
    with (out / "results.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert list(table) == list(rows[0])
    for name, column in table.items():
        assert ["" if value is None else str(value) for value in column] == [row[name] for row in rows], name


def test_without_the_library_parquet_is_refused_in_one_line(
    results: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    out = tmp_path / "out"
    assert command.main([str(results), "--output", str(out), "--parquet"]) == 1
    said = capsys.readouterr().err
    assert said.startswith("report: --parquet needs pyarrow: tools/env uv pip install")
    assert said.count("\n") == 1
    assert not out.exists()


def test_a_bad_bag_is_one_line_and_the_others_are_reported(
    results: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    empty = tmp_path / "results"
    with BagWriter(empty) as bag:
        bag.add_topic("/knee_gap/gap", TOPICS["gap"])
    out = tmp_path / "out"
    bags = [str(empty), str(tmp_path / "none"), str(results)]
    assert command.main([*bags, "--output", str(out)]) == 1
    said = capsys.readouterr()
    assert said.err.splitlines() == [
        f"report: {empty} has no message on /knee_gap/gap",
        f"report: {tmp_path / 'none'} does not exist",
    ]
    assert "1 of 3 bags" in said.out
    index = (out / "index.html").read_text()
    assert f"{tmp_path / 'none'} does not exist" in index
    assert 'href="results-2.html"' in index
    # Without the bag of inputs there is neither truth nor picture, and that is reported.
    page = (out / "results-2.html").read_text()
    assert "it is not simulated" in page
    assert "name the bag of inputs with --input" in page


def test_a_folder_that_is_not_empty_is_replaced_only_if_forced(
    pages: Path, results: Path, recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    shutil.copytree(pages, out)
    (out / "results.html").write_text("old")
    arguments = [str(results), "--input", str(recording), "--output", str(out), "--truth", "5"]
    assert command.main(arguments) == 1
    assert "choose another folder or replace it with --force" in capsys.readouterr().err
    assert (out / "results.html").read_text() == "old"
    assert command.main([*arguments, "--force"]) == 0
    for path in pages.iterdir():
        # The same bag gives the same bytes.
        assert (out / path.name).read_bytes() == path.read_bytes(), path.name


def test_mistakes_are_one_line(results: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "file"
    file.write_text("")
    new = str(tmp_path / "new")
    for arguments in (
        ["--output", str(file)],
        ["--output", new, "--input", "a", "b"],
        ["--output", new, "--namespace", "/other"],
    ):
        assert command.main([str(results), *arguments]) == 1
        said = capsys.readouterr().err
        assert said.startswith("report: ")
        assert said.count("\n") == 1


def test_names_of_pages_are_of_one_bag_each_and_safe() -> None:
    paths = [Path("a/out"), Path("b/out"), Path("b/out-2.mcap"), Path("c/index"), Path("d/x y<.mcap")]
    assert _names(paths) == ["out", "out-2", "out-2-2", "index-2", "x_y_"]


def test_a_message_that_cannot_be_read_costs_only_itself(
    estimates: list[GapEstimate], tmp_path: Path
) -> None:
    with BagWriter(tmp_path / "bag") as bag:
        bag.add_topic("/knee_gap/gap", TOPICS["gap"])
        bag.write_raw("/knee_gap/gap", bytes.fromhex("00010000ffffffff"), BEGIN)
        strange = fill_gap_estimate(blank(TOPICS["gap"]), estimates[0])
        strange.status, strange.reason = 200, "a\nb"
        bag.write("/knee_gap/gap", strange, BEGIN)
    found = read_results(tmp_path / "bag", "/knee_gap")
    assert found.causes() == [("number 200", "a\nb", 1)]
    assert len(found.remarks) == 1
    assert found.remarks[0].startswith("1 times: a knee_gap_msgs/msg/GapEstimate on /knee_gap/gap")
    assert command.main([str(tmp_path / "bag"), "--output", str(tmp_path / "out")]) == 0


def test_drop_outs_end_with_the_next_valid_estimate(results: Path) -> None:
    found = read_results(results, "/knee_gap").dropouts()
    assert [(round(one.begin, 6), round(one.end, 6), one.images) for one in found] == [
        (0.0, 0.2, 10),
        (0.4, 0.48, 4),
    ]


@pytest.mark.skipif(shutil.which("chromium") is None, reason="Chromium is not installed")
def test_a_browser_shows_the_page(pages: Path, tmp_path: Path) -> None:
    shot = tmp_path / "page.png"
    subprocess.run(
        [
            *("chromium", "--headless", "--no-sandbox", "--disable-gpu", "--hide-scrollbars"),
            *("--host-resolver-rules=MAP * ~NOTFOUND", "--window-size=1100,2600"),
            *(f"--user-data-dir={tmp_path / 'profile'}", f"--screenshot={shot}"),
            (pages / "results.html").as_uri(),
        ],
        check=True,
        capture_output=True,
        timeout=120,
    )
    picture = cv2.imread(str(shot))
    assert picture.shape == (2600, 1100, 3)
    for status in (GapStatus.VALID, GapStatus.INSUFFICIENT_PARALLAX, GapStatus.OUT_OF_SYNC):
        # The strip of statuses: its colours are on the page, each in proportion to its time.
        colour = tuple(int(STATUS_COLOURS[status][k : k + 2], 16) for k in (5, 3, 1))
        assert (np.abs(picture.astype(int) - colour).max(axis=2) < 12).sum() > 300, status

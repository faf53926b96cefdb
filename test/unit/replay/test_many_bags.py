"""Many bags at once: each has its results, one that fails is reported, and a run that was stopped goes on."""

import csv
from pathlib import Path
from typing import Any

import pytest

from knee_gap_core.bag.bag import BagReader, BagWriter
from knee_gap_core.bag.errors import BagError
from knee_gap_replay.whole_bags import many_bags, pools
from knee_gap_replay.whole_bags.one_bag import Job, Result

TYPE = "std_msgs/msg/Float64"


def do(job: Job, workers: int | None = None) -> Result:
    """Take the place of `process_one`: write a bag, fail, or die, as the name of the bag requests."""
    assert workers == 1
    name = Path(job.bag).name
    if name.startswith("dies"):
        raise SystemExit(9)
    if name.startswith("fails"):
        raise BagError(f"{name} is no bag")
    with BagWriter(job.out, replace=job.replace) as writer:
        writer.add_topic("/space/gap_edges", TYPE)
        writer.write_raw("/space/gap_edges", bytes(12), 1)
    return Result(["all well"], 1 if name.startswith("dark") else 0, dict(writer.counts), 0)


@pytest.fixture(autouse=True)
def _without_the_pipeline(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pools, "process_one", do)


def job(bag: str, out: str, *, replace: bool) -> Job:
    return Job(bag, out, replace)


def run(bags: list[str], folder: Path, **options: Any) -> tuple[int, dict[str, dict[str, str]]]:
    code = many_bags.process_many(bags, folder, job, pools.ProcessPool(2), **options)
    with (folder / "summary.csv").open() as file:
        return code, {row["bag"]: row for row in csv.DictReader(file)}


def test_a_bag_that_fails_or_takes_its_process_down_does_not_stop_the_others(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bags = ["a/good", "b/good", "fails", "dies", "dark", "x/last.mcap"]
    code, rows = run(bags, tmp_path / "results")
    assert code == 1
    assert list(rows) == bags
    assert {bag: row["result"] for bag, row in rows.items()} == {
        "a/good": "done", "b/good": "done", "fails": "failed", "dies": "failed", "dark": "failed",
        "x/last.mcap": "done",
    }  # fmt: skip
    assert rows["fails"]["remark"] == "fails is no bag"
    assert rows["dies"]["remark"] == "its process ended with 9"
    assert rows["a/good"]["images"] == "1"
    for name in ("good", "good_2", "last"):
        with BagReader(tmp_path / "results" / name) as reader:
            assert reader.count() == 1
    lines = capsys.readouterr().out.splitlines()
    assert lines[-1] == f"process: 3 bags done, 3 failed; results in {tmp_path / 'results'}"
    assert lines[-1 - len(bags) - 1].split()[:2] == ["bag", "result"]


def test_a_run_that_was_stopped_goes_on_with_what_is_not_done(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "results"
    assert run(["one", "fails"], folder)[0] == 1
    # Of a bag that was begun a part is there; a stranger's folder is not touched.
    (folder / "two").mkdir()
    (folder / "two" / "two_0.mcap").write_bytes(b"half")
    (folder / "mine").mkdir()
    (folder / "mine" / "mine_0.mcap").write_bytes(b"of somebody")
    state = (folder / "process.json").read_text()
    begun = state.replace('"bag": "fails", "name": "fails", "result": "failed"',
                          '"bag": "two", "name": "two", "result": "begun"')  # fmt: skip
    assert begun != state
    (folder / "process.json").write_text(begun)
    before = (folder / "one" / "one_0.mcap").stat().st_mtime_ns
    code, rows = run(["one", "two", "mine"], folder)
    assert code == 1
    assert [row["result"] for row in rows.values()] == ["done", "done", "failed"]
    assert "exists already" in rows["mine"]["remark"]
    assert (folder / "one" / "one_0.mcap").stat().st_mtime_ns == before
    assert "1 bags are done already" in capsys.readouterr().out
    # However often it is tried.
    assert run(["mine"], folder)[1]["mine"]["result"] == "failed"
    assert (folder / "mine" / "mine_0.mcap").read_bytes() == b"of somebody"
    assert run(["one"], folder, force=True)[0] == 0
    assert (folder / "one" / "one_0.mcap").stat().st_mtime_ns > before


def test_a_damaged_state_is_refused(tmp_path: Path) -> None:
    (tmp_path / "process.json").write_text("{")
    with pytest.raises(BagError, match="is damaged: remove it, or use --force"):
        run(["one"], tmp_path)

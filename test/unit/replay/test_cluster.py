"""Bags on a cluster of Dask: as on this machine, with a worker that dies and without the library."""

import csv
import filecmp
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from knee_gap_core.bag.bag import BagReader, BagWriter
from knee_gap_core.bag.errors import BagError
from knee_gap_replay import process
from knee_gap_replay.whole_bags import pools
from knee_gap_replay.whole_bags.cluster_pool import ClusterPool
from knee_gap_replay.whole_bags.many_bags import process_many
from knee_gap_replay.whole_bags.one_bag import Job, Result

TYPE = "std_msgs/msg/Float64"
SKIPPED = "Dask is not installed: tools/requirements/cluster.lock"


def do(job: Job, workers: int | None = None) -> Result:
    """Take the place of `process_one`: write a bag or fail, as the name of the bag says."""
    assert Path(job.bag).is_absolute()
    assert Path(job.out).is_absolute()
    name = Path(job.bag).name
    if name.startswith("fails"):
        raise BagError(f"{name} is no bag")
    if name.startswith("raises"):
        raise RuntimeError(f"{name} is\na mistake")
    with BagWriter(job.out, replace=job.replace) as writer:
        writer.add_topic("/space/gap_edges", TYPE)
        writer.write_raw("/space/gap_edges", bytes(12), 1)
    return Result(["all well"], 0, dict(writer.counts), 0)


@pytest.fixture
def cluster() -> Iterator[Any]:
    """Two workers in threads of this process."""
    distributed = pytest.importorskip("distributed", reason=SKIPPED)
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, processes=False, dashboard_address=None
    ) as started:
        yield started


def job(bag: str, out: str, *, replace: bool) -> Job:
    return Job(bag, out, replace)


def rows(folder: Path) -> dict[str, dict[str, str]]:
    with (folder / "summary.csv").open() as file:
        return {row["bag"]: row for row in csv.DictReader(file)}


def test_a_bag_that_fails_does_not_stop_the_others_and_a_run_goes_on(
    cluster: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(pools, "process_one", do)
    bags = ["a/good", "b/good", "fails", "raises", "last"]
    address, folder = cluster.scheduler_address, tmp_path / "results"
    assert process_many(bags, folder, job, ClusterPool(address)) == 1
    found = rows(folder)
    assert [row["result"] for row in found.values()] == ["done", "done", "failed", "failed", "done"]
    assert found["fails"]["remark"] == "fails is no bag"
    assert found["raises"]["remark"] == "on the cluster: raises is a mistake"
    assert found["last"]["images"] == "1"
    for name in ("good", "good_2", "last"):
        with BagReader(folder / name) as reader:
            assert reader.count() == 1
    assert capsys.readouterr().out.splitlines()[-1].startswith("process: 3 bags done, 2 failed;")
    before = (folder / "last" / "last_0.mcap").stat().st_mtime_ns
    assert process_many(["last", "new"], folder, job, ClusterPool(address)) == 0
    assert (folder / "last" / "last_0.mcap").stat().st_mtime_ns == before
    assert "1 bags are done already" in capsys.readouterr().out


def test_no_more_bags_are_begun_than_there_are_threads_and_a_stop_waits_for_them(
    cluster: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    begun, go = [], threading.Event()

    def slow(job: Job, workers: int | None = None) -> Result:
        begun.append(job.bag)
        go.wait(30.0)
        return do(job)

    monkeypatch.setattr(pools, "process_one", slow)

    class Stopped(ClusterPool):
        """A pool whose user stops the command once two bags are begun."""

        def ended(self) -> Any:
            if not go.is_set():
                while len(begun) < 2:
                    pass
                go.set()
                raise KeyboardInterrupt
            return super().ended()

    with pytest.raises(KeyboardInterrupt):
        process_many(["a", "b", "c"], tmp_path, job, Stopped(cluster.scheduler_address))
    assert len(begun) == 2
    assert "2 bags are being processed on the cluster; waiting for them" in capsys.readouterr().err
    assert process_many(["a", "b", "c"], tmp_path, job, ClusterPool(cluster.scheduler_address)) == 0
    assert len(begun) == 3


def test_a_scheduler_without_workers_is_refused() -> None:
    distributed = pytest.importorskip("distributed", reason=SKIPPED)
    with (
        distributed.LocalCluster(n_workers=0, processes=False, dashboard_address=None) as empty,
        pytest.raises(BagError, match="has no worker: tools/env dask worker"),
    ):
        ClusterPool(empty.scheduler_address)


@pytest.mark.parametrize("address", ["tcp://127.0.0.1:1", "nonsense://x", "tcp://127.0.0.1:port"])
def test_a_scheduler_that_does_not_answer_is_one_line(
    address: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("distributed", reason=SKIPPED)
    monkeypatch.setattr("knee_gap_replay.whole_bags.cluster_pool._CONNECT_SECONDS", 1)
    assert process.main(["bag", str(tmp_path / "out"), "--scheduler", address]) == 1
    said = capsys.readouterr().err
    assert said.startswith(f"process: the scheduler {address} cannot be reached: ")
    assert said.count("\n") == 1, said
    assert not (tmp_path / "out").exists()


def test_without_the_library_a_scheduler_is_refused_in_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    out = tmp_path / "out"
    assert process.main(["bag", "bag2", str(out), "--scheduler", "tcp://127.0.0.1:8786"]) == 1
    said = capsys.readouterr().err
    assert said.startswith("process: --scheduler needs Dask distributed, here and on the workers: tools/env")
    assert said.count("\n") == 1
    assert not out.exists()


def test_results_of_real_workers_have_the_same_bytes(tmp_path: Path) -> None:
    distributed = pytest.importorskip("distributed", reason=SKIPPED)
    sample, short = Path(__file__).parents[3] / "bags" / "sample", tmp_path / "short"
    with BagReader(sample) as reader, BagWriter(short, metadata=reader.metadata) as writer:
        for topic, kind in reader.topics.items():
            writer.add_topic(topic, kind)
        for message in reader.messages():
            if message.time_ns < reader.start_ns + 400_000_000:
                writer.write_raw(message.topic, message.data, message.time_ns)
    (short / "scope.yaml").write_bytes((sample / "scope.yaml").read_bytes())
    assert process.main([str(short), str(tmp_path / "here"), "--workers", "1"]) == 0
    out = tmp_path / "cluster"
    with distributed.LocalCluster(n_workers=1, threads_per_worker=1, dashboard_address=None) as started:
        bags = [str(short), str(tmp_path / "none")]
        assert process.main([*bags, str(out), "--scheduler", started.scheduler_address]) == 1
    assert [row["result"] for row in rows(out).values()] == ["done", "failed"]
    assert filecmp.cmp(out / "short" / "short_0.mcap", tmp_path / "here" / "here_0.mcap", shallow=False)

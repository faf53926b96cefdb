"""The command `mark`: what its page receives, what it may write, and who may ask."""

import http.client
import json
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from knee_gap_perception.errors import PerceptionError
from knee_gap_perception.marks.command import main
from knee_gap_perception.marks.marked_picture import Decision, Region
from knee_gap_perception.marks.marking_server import MarkingServer
from knee_gap_perception.marks.marking_session import MarkingSession
from knee_gap_perception.marks.marks_file import read_marks

MARKS = {
    "source": "drawn",
    "kind": "knee",
    "decision": "gap",
    "field": {"disc": [32, 24, 20]},
    "gap": [[[10, 20], [50, 20], [50, 28]]],
}


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A picture and a video of ten frames."""
    image = np.random.default_rng(1).integers(0, 255, (48, 64, 3), np.uint8)
    cv2.imwrite(str(tmp_path / "a.png"), image)
    video = cv2.VideoWriter(str(tmp_path / "b.avi"), cv2.VideoWriter.fourcc(*"MJPG"), 25.0, (64, 48))
    for level in range(0, 100, 10):
        video.write(np.full((48, 64, 3), level, np.uint8))
    video.release()
    return tmp_path


@pytest.fixture
def server(folder: Path) -> Iterator[MarkingServer]:
    with MarkingServer(MarkingSession(folder, folder / "marks.json", frames=3), port=0) as server:
        thread = threading.Thread(target=server.serve_forever, args=(0.02,))
        thread.start()
        yield server
        server.shutdown()
        thread.join()


def ask(server: MarkingServer, method: str, path: str, body: Any = None, **headers: str) -> tuple[int, bytes]:
    connection = http.client.HTTPConnection("127.0.0.1", server.server_port, timeout=10)
    text = body if isinstance(body, str) or body is None else json.dumps(body)
    connection.request(method, path, text, headers)
    response = connection.getresponse()
    answer = response.status, response.read()
    connection.close()
    return answer


def test_the_page_shows_every_picture_and_keeps_its_marks(server: MarkingServer, folder: Path) -> None:
    status, page = ask(server, "GET", "/")
    assert status == 200
    assert b"<canvas" in page
    state = json.loads(ask(server, "GET", "/state")[1])
    assert [(one["file"], one["frame"]) for one in state["pictures"]] == [
        ("a.png", None), ("b.avi", 0), ("b.avi", 4), ("b.avi", 9),
    ]  # fmt: skip
    assert state["regions"] == list(Region)
    shown = cv2.imdecode(np.frombuffer(ask(server, "GET", "/picture/2")[1], np.uint8), cv2.IMREAD_COLOR)
    assert shown.shape == (48, 64, 3)
    assert round(shown.mean() / 10) == 4

    assert ask(server, "PUT", "/picture/2", MARKS) == (200, b"{}")
    assert ask(server, "PUT", "/picture/0", {**MARKS, "decision": "no gap", "gap": []}) == (200, b"{}")
    still, frame = read_marks(folder / "marks.json")
    assert (still.name, still.decision) == ("a.png", Decision.NO_GAP)
    assert (frame.name, frame.width, frame.height) == ("b.avi frame 4", 64, 48)
    assert json.loads(ask(server, "GET", "/state")[1])["pictures"][2]["gap"] == MARKS["gap"]
    # Begun again, it shows them, and takes no other picture for the marked one.
    again = MarkingSession(folder, folder / "marks.json", frames=2).state()["pictures"]
    assert [one.get("frame") for one in again] == [None, 0, 4, 9]
    cv2.imwrite(str(folder / "a.png"), np.zeros((48, 64, 3), np.uint8))
    with pytest.raises(PerceptionError, match=r"a\.png is not the picture that was marked"):
        MarkingSession(folder, folder / "marks.json", frames=2)


@pytest.mark.parametrize(
    ("method", "path", "body", "status", "words"),
    [
        ("PUT", "/picture/0", {**MARKS, "decision": "no gap"}, 400, "there are polygons of a gap"),
        ("PUT", "/picture/0", {**MARKS, "gap": [[[0, 0], [900, 0], [0, 9]]]}, 400, "leaves the picture"),
        ("PUT", "/picture/0", "{", 400, "not JSON"),
        ("PUT", "/picture/0", [], 400, "must be an object"),
        ("PUT", "/picture/9", MARKS, 400, "there is no picture 9"),
        ("PUT", "/state", MARKS, 404, "no such page"),
        ("GET", "/picture/-1", None, 404, "no such page"),
        ("GET", "/../marks.json", None, 404, "no such page"),
    ],
)
def test_what_cannot_be_is_one_line_and_writes_nothing(
    server: MarkingServer, folder: Path, method: str, path: str, body: Any, status: int, words: str
) -> None:
    got, answer = ask(server, method, path, body)
    error = json.loads(answer)["error"]
    assert got == status
    assert words in error
    assert "\n" not in error
    assert not (folder / "marks.json").exists()


@pytest.mark.parametrize("headers", [{"Host": "elsewhere.example"}, {"Origin": "http://elsewhere.example"}])
def test_a_foreign_page_may_not_ask(server: MarkingServer, folder: Path, headers: dict[str, str]) -> None:
    assert ask(server, "PUT", "/picture/0", MARKS, **headers)[0] == 403
    assert ask(server, "GET", "/state", **headers)[0] == 403
    assert not (folder / "marks.json").exists()


def test_check_counts_the_marks_or_says_what_is_wrong(folder: Path, capsys: pytest.CaptureFixture) -> None:
    marks = folder / "marks.json"
    MarkingSession(folder, marks, frames=3).save(0, MARKS)
    assert main([str(folder), "--check"]) == 0
    assert "drawn                    knee         gap              1" in capsys.readouterr().out
    (folder / "a.png").unlink()
    assert main([str(folder), "--check"]) == 1
    assert main([str(folder)]) == 1
    assert main([str(folder / "none")]) == 1
    (folder / "empty").mkdir()
    assert main([str(folder / "empty")]) == 1
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 4
    assert all(line.startswith("mark: ") for line in lines)
    with pytest.raises(SystemExit, match="2"):
        main([str(folder), "--port", "70000"])

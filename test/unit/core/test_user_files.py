"""What a user names is opened without waiting, within bounds, and refused in one line."""

import os
import time
from pathlib import Path

import pytest

from knee_gap_core import user_files
from knee_gap_core.bag.bag_paths import missing_bag
from knee_gap_core.user_files import (
    FileError,
    expanded,
    flaw_of_new,
    json_value,
    open_file,
    read_bytes,
    read_yaml,
    yaml_value,
)


def refused(path: Path) -> str:
    """Why `open_file` refuses a path; one line that names it."""
    begin = time.monotonic()
    with pytest.raises(FileError) as refusal:
        open_file(path)
    assert time.monotonic() - begin < 5.0
    assert "\n" not in str(refusal.value)
    assert str(path).split("\n")[0][:200] in str(refusal.value)
    return str(refusal.value)


def test_only_regular_files_are_opened(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "fifo")
    (tmp_path / "link").symlink_to("nowhere")
    (tmp_path / "loop").symlink_to("loop")
    (tmp_path / "to_fifo").symlink_to("fifo")
    assert "is a FIFO, not a file" in refused(tmp_path / "fifo")
    assert "is a FIFO, not a file" in refused(tmp_path / "to_fifo")
    assert "is a folder, not a file" in refused(tmp_path)
    assert "is a device, not a file" in refused(Path("/dev/zero"))
    assert "No such file" in refused(tmp_path / "link")
    assert "No such file" in refused(tmp_path / "two\nlines")
    assert "symbolic links" in refused(tmp_path / "loop")
    assert "too long" in refused(tmp_path / ("x" * 300))
    (tmp_path / "file").write_bytes(b"abc")
    with open_file(tmp_path / "file") as file:
        assert file.read() == b"abc"


def test_a_file_without_permission_is_refused(tmp_path: Path) -> None:
    if os.geteuid() == 0:
        pytest.skip("root may read everything")
    path = tmp_path / "secret"
    path.write_text("x")
    path.chmod(0)
    assert "Permission denied" in refused(path)


def test_a_file_is_read_up_to_its_bound(tmp_path: Path) -> None:
    (tmp_path / "file").write_bytes(bytes(2048))
    assert len(read_bytes(tmp_path / "file", 2048)) == 2048
    with pytest.raises(FileError, match="longer than 1 KiB"):
        read_bytes(tmp_path / "file", 1024)


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("[" * 100_000, "nested more than 32 deep in line 1"),
        ("- " * 100_000, "nested more than 32 deep in line 1"),
        ("\n".join(" " * depth + "a:" for depth in range(300)), "nested more than 32 deep in line 33"),
        ("{a: " * 50_000, "nested more than 32 deep"),
        ("a: &x [1]\nb: [*x, *x]", "aliases are not read \\(\\*x in line 2"),
        ("a: &x [*x]", "aliases are not read"),
        ("a: [" + "1, " * 11_000 + "]", "more than 10000 values"),
        ("a: " + "x" * 600_000, "longer than 512 KiB"),
        ("a: [", "in line 1"),
        ("a: 1\na: 2", "duplicate key"),
        ("a: \x00", "special characters are not allowed"),
        ("a: 2026-13-45", "month must be in 1..12"),
        ("a: !!int abc", "invalid literal"),
        ("a: " + "9" * 10_000, "4300 digits"),
        ("a: !!python/object:os.system x", "could not determine a constructor"),
        ("a: 1\n---\nb: 2", "another document"),
    ],
)
def test_yaml_is_bounded_in_depth_length_and_references(tmp_path: Path, text: str, reason: str) -> None:
    begin = time.monotonic()
    with pytest.raises(ValueError, match=reason) as refusal:
        yaml_value(text)
    assert "\n" not in str(refusal.value)
    (tmp_path / "file.yaml").write_text(text)
    with pytest.raises(FileError, match=r"file\.yaml"):
        read_yaml(tmp_path / "file.yaml")
    # Seconds, not minutes, on whatever machine runs this beside other tests.
    assert time.monotonic() - begin < 60.0


def test_yaml_of_this_suite_is_read(tmp_path: Path) -> None:
    path = tmp_path / "file.yaml"
    path.write_text("/**/tracking_node:\n  ros__parameters:\n    a: [1.0e-05, 2e-5, .nan]\n    b: true\n")
    values = read_yaml(path)["/**/tracking_node"]["ros__parameters"]
    assert values["a"][:2] == [1e-5, 2e-5]
    assert values["b"] is True
    path.write_bytes(b"a: \xff")
    with pytest.raises(FileError, match="it is not UTF-8"):
        read_yaml(path)


def test_json_is_bounded_in_depth() -> None:
    assert json_value('{"a": [1, {"b": 2}]}') == {"a": [1, {"b": 2}]}
    for text in ("[" * 100_000, "[" * 100_000 + "]" * 100_000, "{", "nothing"):
        with pytest.raises(ValueError, match=r".") as refusal:
            json_value(text)
        assert "\n" not in str(refusal.value)


def test_the_home_of_nobody_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(FileError, match=r"~nosuchuser_at_all/scope\.yaml: there is no such user"):
        expanded("~nosuchuser_at_all/scope.yaml")
    monkeypatch.setenv("HOME", str(tmp_path))
    assert expanded("~/scope.yaml") == tmp_path / "scope.yaml"
    assert expanded("a~b") == Path("a~b")


def test_a_dangling_link_is_no_place_for_a_new_file(tmp_path: Path) -> None:
    (tmp_path / "link").symlink_to("nowhere")
    (tmp_path / "file").write_text("")
    assert "is a link that leads nowhere" in flaw_of_new(tmp_path / "link")
    assert "exists already" in flaw_of_new(tmp_path / "file")
    assert flaw_of_new(tmp_path / "new") == ""


def test_why_there_is_no_bag_is_told_by_kind(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "fifo")
    (tmp_path / "empty.mcap").write_bytes(b"")
    (tmp_path / "some.mcap").write_bytes(b"x")
    (tmp_path / "folder").mkdir()
    assert "is a FIFO, not a file" in missing_bag(tmp_path / "fifo")
    assert "is a device, not a file" in missing_bag(Path("/dev/zero"))
    assert "is empty" in missing_bag(tmp_path / "empty.mcap")
    assert "holds no .mcap or .db3 file" in missing_bag(tmp_path / "folder")
    assert "does not exist" in missing_bag(tmp_path / "nothing")
    assert "too long" in missing_bag(tmp_path / ("x" * 300))
    assert missing_bag(tmp_path / "some.mcap") == missing_bag(tmp_path) == ""


def test_the_bounds_leave_room_for_what_recorders_write() -> None:
    """The metadata of a bag of 100 topics that was split into 500 files."""
    topics = "".join(
        f"  - topic_metadata:\n      name: /topic_{index}\n      type: a/msg/B\n"
        "      serialization_format: cdr\n      offered_qos_profiles:\n        - history: keep_last\n"
        "          depth: 10\n          reliability: x\n"
        f"    message_count: {index}\n"
        for index in range(100)
    )
    files = "".join(f"    - path: bag_{index}.mcap\n      message_count: 1\n" for index in range(500))
    text = f"rosbag2_bagfile_information:\n  topics:\n{topics}  files:\n{files}"
    assert len(text) < user_files.MOST_YAML_BYTES / 4
    information = yaml_value(text)["rosbag2_bagfile_information"]
    assert (len(information["topics"]), len(information["files"])) == (100, 500)

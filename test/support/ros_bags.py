"""Small bags of the kinds that ROS 2 and its tools write, made with MCAP's writer and known byte for byte.

They are split, rewritten, compressed, with types that this suite does not know, with service events, with an
empty topic, without index, or of a middleware that does not serialise to CDR.
"""

import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from mcap.writer import CompressionType, IndexType, Writer
from recordings import BESIDE

RECORDED_BAGS = "mcap/rosbag2"
BEGIN_NS = 1_700_000_000_000_000_000
CDR = bytes([0, 1, 0, 0])

STRING = ("std_msgs/msg/String", "string data\n")
NUMBERS = ("test_kinds/msg/Numbers", "bool bool_value\nfloat64 float64_value\nint32 int32_value\n")
NOTHING = ("test_kinds/msg/Nothing", "uint8 structure_needs_at_least_one_member\n")
SERVICE = ("test_kinds/srv/Add_Event", "uint8 kind\nint64 sequence\n")
FORMER_NUMBERS = (
    "test_kinds/Numbers",
    NUMBERS[1],
)  # the type's name without `msg`, as older recorders wrote it

# (topic, time [ns], serialised message)
Record = tuple[str, int, bytes]


@dataclass(frozen=True)
class File:
    """One file of a bag: its topics with their types, and its records in the order of writing."""

    topics: dict[str, tuple[str, str]]
    records: Sequence[Record]
    compression: CompressionType = CompressionType.NONE
    indexed: bool = True
    summed_up: bool = True
    chunked: bool = True
    encoding: str = "cdr"


@dataclass(frozen=True)
class MadeBag:
    """A bag to be written: `version` of its metadata.yaml, None for a bare file."""

    files: Sequence[File]
    version: int | None = 8
    qos: str = field(default="- history: 3\n  depth: 0\n  reliability: 1\n  durability: 2\n", repr=False)

    def write(self, path: Path) -> Path:
        """Write the bag as a folder, or as one file if it has no metadata."""
        if self.version is None:
            (file,) = self.files
            _write_file(path, file, self.qos)
            return path
        path.mkdir(parents=True)
        names = [f"{path.name}_{index}.mcap" for index in range(len(self.files))]
        for name, file in zip(names, self.files, strict=True):
            _write_file(path / name, file, self.qos)
        (path / "metadata.yaml").write_text(self._metadata(names))
        return path

    @property
    def records(self) -> list[Record]:
        """All records, in the order of writing."""
        return [record for file in self.files for record in file.records]

    def _metadata(self, names: Sequence[str]) -> str:
        times = [time_ns for _, time_ns, _ in self.records]
        lines = [
            "rosbag2_bagfile_information:",
            f"  version: {self.version}",
            "  storage_identifier: mcap",
            f"  duration:\n    nanoseconds: {max(times) - min(times)}",
            f"  starting_time:\n    nanoseconds_since_epoch: {min(times)}",
            f"  message_count: {len(times)}",
            "  topics_with_message_count:",
        ]
        for topic, (msgtype, _) in {
            name: t for file in self.files for name, t in file.topics.items()
        }.items():
            lines += [
                "    - topic_metadata:",
                f"        name: {topic}",
                f"        type: {msgtype}",
                f"        serialization_format: {self.files[0].encoding}",
                f'        offered_qos_profiles: "{self.qos.encode("unicode_escape").decode()}"',
                f"      message_count: {sum(name == topic for name, _, _ in self.records)}",
            ]
        lines += ['  compression_format: ""', '  compression_mode: ""', "  relative_file_paths:"]
        lines += [f"    - {name}" for name in names]
        return "\n".join(lines) + "\n"


def _write_file(path: Path, file: File, qos: str) -> None:
    with path.open("wb") as stream:
        writer = Writer(
            stream,
            chunk_size=2_000,
            compression=file.compression,
            index_types=IndexType.ALL if file.indexed else IndexType.NONE,
            use_chunking=file.chunked,
            use_statistics=file.indexed,
            use_summary_offsets=file.indexed,
            repeat_channels=file.summed_up,
            repeat_schemas=file.summed_up,
        )
        writer.start("ros2", "made by a test")
        channels = {}
        for topic, (msgtype, definition) in file.topics.items():
            schema = writer.register_schema(msgtype, "ros2msg", definition.encode())
            channels[topic] = writer.register_channel(
                topic, file.encoding, schema, {"offered_qos_profiles": qos}
            )
        for sequence, (topic, time_ns, data) in enumerate(file.records):
            writer.add_message(channels[topic], time_ns, data, time_ns, sequence)
        writer.finish()  # type: ignore[no-untyped-call]


def _text(text: str) -> bytes:
    data = text.encode() + b"\0"
    return CDR + struct.pack("<I", len(data)) + data


def _numbers(value: int) -> bytes:
    # Aligned to the size of each value, from behind the header of 4 bytes on.
    return CDR + struct.pack("<?7xdi", True, 0.5 * value, value)


def _series(
    topic: str, count: int, data: Callable[[int], bytes], begin: int = 0, step: int = 1
) -> list[Record]:
    return [(topic, BEGIN_NS + 1_000_000 * (begin + step * k), data(k)) for k in range(count)]


def _chatter(begin: int, step: int = 1) -> File:
    records = _series("/chatter", 200, lambda k: _text(f"Hello World: {k}"), begin, step)
    return File({"/chatter": STRING}, records, CompressionType.ZSTD)


def _many_topics(part: int) -> File:
    """Eight topics in turn; the files of the bag overlap in time, as those of a recorder with a cache do."""
    topics = [name * 3 for name in "ABCDEFGH"]
    records = [
        (topics[k % 8], BEGIN_NS + 1_000_000 * (90 * part + k), _text(f"{part}:{k}")) for k in range(100)
    ]
    return File(dict.fromkeys(topics, STRING), records, CompressionType.ZSTD)


_EVENTS = _series("/add/_service_event", 12, lambda k: CDR + struct.pack("<B7xq", k % 4, k // 4), 3, 5)
_TICKS = _series("/ticks", 7, _numbers, 0, 10)
_BASIC = {"/test_topic": NUMBERS, "/text": STRING}
_BASIC_RECORDS = sorted(
    [*_series("/test_topic", 3, _numbers, 1, 50), *_series("/text", 4, lambda k: _text("é" * k), 0, 40)],
    key=lambda record: record[1],
)
_NOTHINGS = _series("a_empty", 100, lambda _: CDR + b"\0")

MADE_BAGS: dict[str, MadeBag] = {
    "cdr_test": MadeBag([File(_BASIC, _BASIC_RECORDS)], version=7),
    "wrong_rmw_test": MadeBag([File(_BASIC, _BASIC_RECORDS, encoding="wrong_format")], version=6),
    "multiple_files": MadeBag([_chatter(0), _chatter(200), _chatter(400)], version=5),
    "overlapping_files": MadeBag([_many_topics(part) for part in range(5)], version=5),
    # Two messages of one time, and a clock that was set back while recording.
    "out_of_order": MadeBag([_chatter(300, -1), _chatter(101, 0)], version=4),
    "with_service_events": MadeBag(
        [
            File(
                {"/ticks": NUMBERS, "/add/_service_event": SERVICE, "/events/write_split": NOTHING},
                sorted([*_EVENTS, *_TICKS], key=lambda record: record[1]),
            )
        ]
    ),
    "rewritten": MadeBag([File({"a_empty": NOTHING}, _NOTHINGS, CompressionType.LZ4)], version=5),
    "former_type_name": MadeBag(
        [File({"topic1": FORMER_NUMBERS}, _series("topic1", 5, _numbers))], version=4
    ),
    "without_index": MadeBag([File({"/ticks": NUMBERS}, _TICKS, indexed=False)], version=5),
    "without_summary": MadeBag(
        [File({"/ticks": NUMBERS}, _TICKS, indexed=False, summed_up=False)], version=5
    ),
    "without_chunks": MadeBag([File({"/ticks": NUMBERS}, _TICKS, chunked=False)], version=5),
    "only_bags/only_services.mcap": MadeBag([File({"/add/_service_event": SERVICE}, _EVENTS)], version=None),
    "only_bags/only_topics.mcap": MadeBag([File({"/ticks": NUMBERS}, _TICKS)], version=None),
}


def recorded_bags() -> list[str]:
    """Return the names of the bags beside the checkout; none if there are none."""
    folder = BESIDE / RECORDED_BAGS
    return [
        str(path.relative_to(folder))
        for path in sorted([*folder.glob("*"), *folder.glob("only_bags/*.mcap")])
    ]

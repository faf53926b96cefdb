"""One SQLite file of a bag, as rosbag2's former default storage wrote it, in order of time."""

import logging
import sqlite3
from collections import Counter
from pathlib import Path
from urllib.parse import quote

from mcap.records import Channel, Schema

from knee_gap_core.bag.errors import BagError
from knee_gap_core.bag.mcap_file import Block, Entry
from knee_gap_core.user_files import FileError, open_file, shown

_LOG = logging.getLogger(__name__)
MAGIC = b"SQLite format 3\x00"
# Messages that are read together, and the longest message or definition that is read.
_BLOCK = 64
_MOST_BYTES = 256 << 20


class SqliteFile:
    """The readable part of one file, in the form of `McapFile`. Raises BagError if it is not one."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.losses: list[str] = []
        self.schemas: dict[int, Schema] = {}
        self.channels: dict[int, Channel] = {}
        self.metadata: dict[str, dict[str, str]] = {}
        self.blocks: list[Block] = []
        self.counts: Counter[str] | None = Counter()
        self._ends: list[int] = []
        try:
            with open_file(path) as file:
                if file.read(len(MAGIC)) != MAGIC:
                    raise BagError(f"{shown(path)} is not an SQLite file")
        except FileError as error:
            raise BagError(str(error)) from None
        # Without locks and journal: the file may lie where nothing can be written.
        alone = "" if path.with_name(f"{path.name}-wal").exists() else "&immutable=1"
        try:
            self._file = sqlite3.connect(f"file:{quote(str(path.absolute()))}?mode=ro{alone}", uri=True)
        except sqlite3.Error as error:
            raise BagError(f"{shown(path)}: {error}") from None
        self._file.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, _MOST_BYTES)
        try:
            self._read_topics()
            self._find_blocks()
        except (sqlite3.Error, ValueError, TypeError, OverflowError) as error:
            self._file.close()
            raise BagError(f"{shown(path)} is not a bag that can be read: {error}") from None

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def read(self, block: Block) -> list[Entry]:
        """Return the messages of a block, by time; where it is damaged those before, and note the loss."""
        entries: list[Entry] = []
        try:
            for number, time_ns, data in self._file.execute(
                "SELECT topic_id, timestamp, data FROM messages WHERE timestamp >= ? AND timestamp < ? "
                "ORDER BY timestamp, id",
                (block.start_ns, self._ends[block.offset]),
            ):
                channel = self.channels[number]
                entries.append(
                    Entry(time_ns, channel.topic, self.schemas[channel.schema_id].name, bytes(data))
                )
        except (sqlite3.Error, KeyError, TypeError, ValueError) as error:
            lost = block.message_count - len(entries)
            line = f"{self.path.name}: {lost} messages lost: {error}"
            if line not in self.losses:
                self.losses.append(line)
                _LOG.warning(line)
        return entries

    def _columns(self, table: str) -> set[str]:
        return {row[1] for row in self._file.execute(f"PRAGMA table_info({table})")}

    def _read_topics(self) -> None:
        columns = self._columns("topics")
        if not {"id", "name", "type", "serialization_format"} <= columns:
            raise ValueError("it has no table of topics")
        qos = "offered_qos_profiles" if "offered_qos_profiles" in columns else "''"
        type_hash = "type_description_hash" if "type_description_hash" in columns else "''"
        definitions: dict[str, tuple[str, str]] = {}
        if self._columns("message_definitions"):
            for name, encoding, text in self._file.execute(
                "SELECT topic_type, encoding, encoded_message_definition FROM message_definitions"
            ):
                definitions[str(name)] = (str(encoding), str(text))
        rows = self._file.execute(
            f"SELECT id, name, type, serialization_format, {qos}, {type_hash} FROM topics ORDER BY id"
        )
        for number, name, msgtype, serialization, profiles, digest in rows:
            encoding, text = definitions.get(msgtype, ("", ""))
            self.schemas[number] = Schema(id=number, name=str(msgtype), encoding=encoding, data=text.encode())
            self.channels[number] = Channel(
                id=number,
                topic=str(name),
                message_encoding=str(serialization),
                schema_id=number,
                metadata={"offered_qos_profiles": str(profiles), "topic_type_hash": str(digest)},
            )

    def _find_blocks(self) -> None:
        """Divide the messages into blocks by their times; messages of one time stay together."""
        assert self.counts is not None
        starts: list[tuple[int, int]] = []
        last_ns, count = -1, 0
        for number, time_ns in self._file.execute(
            "SELECT topic_id, timestamp FROM messages ORDER BY timestamp, id"
        ):
            if (channel := self.channels.get(number)) is not None:
                self.counts[channel.topic] += 1
            if not starts or (count >= _BLOCK and time_ns != last_ns):
                starts.append((time_ns, 0))
                count = 0
            count += 1
            starts[-1] = (starts[-1][0], count)
            last_ns = time_ns
        self._ends = [*(start for start, _ in starts[1:]), last_ns + 1]
        self.blocks = [
            Block(start, k, 0, False, count, self._ends[k] - 1) for k, (start, count) in enumerate(starts)
        ]

"""Bags of ROS 2, read without ROS.

A bag is a folder with `metadata.yaml` and MCAP or SQLite files, as `ros2 bag` opens it; a bare `.mcap` or
`.db3` is read too. Times are integer nanoseconds.
"""

import os
import struct
from collections.abc import Collection, Iterator
from os import PathLike
from pathlib import Path
from typing import Any, NamedTuple, Self

from rosbags.interfaces import Nodetype, Qos
from rosbags.typesys import Stores, TypesysError, get_types_from_idl, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from knee_gap_core.bag import qos as qos_profiles
from knee_gap_core.bag import sqlite_file
from knee_gap_core.bag.bag_paths import missing_bag
from knee_gap_core.bag.errors import BagError
from knee_gap_core.bag.former_names import topic_today, type_today
from knee_gap_core.bag.mcap_file import BagFile, McapFile, Since, in_time_order, storage_files
from knee_gap_core.bag.message_types import full_name, known_type, typestore
from knee_gap_core.bag.writing.bag_writer import BagWriter as BagWriter
from knee_gap_core.bag.writing.mcap_storage import METADATA_RECORD
from knee_gap_core.user_files import FileError, open_file, read_yaml

_CONVERT = "convert it first: rosbags-convert --src IN --dst OUT --dst-storage mcap"
_CDR_HEAD, _STAMP_END = 4, 12
_HEADER_FIELD = ("header", (Nodetype.NAME, "std_msgs/msg/Header"))


class BagMessage(NamedTuple):
    """One message of a bag, serialised; `time_ns` is when it was recorded."""

    topic: str
    msgtype: str
    time_ns: int
    data: bytes


class Topic(NamedTuple):
    """What a bag records of one of its topics."""

    msgtype: str
    qos: tuple[Qos, ...]
    encoding: str
    definition: str
    type_hash: str
    schema_encoding: str = "ros2msg"
    definition_bytes: bytes = b""


class BagReader:
    """Reads a bag folder or a bare `.mcap`, whole, cut or damaged; a context manager.

    `topics` maps names to types, `details` to types, quality of service and definitions, `metadata` is the
    bag's own (custom data). Topics and types recorded under former names appear under those of today, and
    `renamed` reports it in one line. What is damaged is left out and named, one line each, in the log and in
    `losses`. Raises BagError where there is not a bag, or not one that can be read.
    To `salvage` is to keep all names as recorded, and to read what is complete in a chunk that is cut, too.
    """

    def __init__(self, path: str | PathLike[str], *, salvage: bool = False) -> None:
        self.path = Path(path)
        self._salvage = salvage
        self.metadata: dict[str, str] = {}
        self._stores: dict[str, Typestore] = {}
        self._has_header: dict[str, bool] = {}
        self._files: list[BagFile] = []
        self._missing: list[str] = []
        # Names as recorded, by names of today.
        self._recorded: dict[str, str] = {}
        try:
            for file in self._locate():
                self._files.append(self._opened(file))
        except BaseException:
            self.close()
            raise
        self._note_metadata()
        self.details = self._read_details()
        self.topics = {name: topic.msgtype for name, topic in self.details.items()}

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the files of the bag."""
        for file in self._files:
            file.close()

    def count(self, topics: Collection[str] | None = None) -> int | None:
        """Return the number of messages of `topics`, from the index; None if there is no index."""
        counts = [file.counts for file in self._files]
        if any(count is None for count in counts):
            return None
        wanted = self.topics if topics is None else topics
        recorded = [self._recorded.get(topic, topic) for topic in wanted]
        return sum(count[topic] for count in counts if count is not None for topic in recorded)

    @property
    def start_ns(self) -> int:
        """Time of the first message, 0 without any."""
        return min((block.start_ns for file in self._files for block in file.blocks), default=0)

    @property
    def renamed(self) -> str:
        """One line with the former names that are read under those of today; empty if there are none."""
        pairs = [f"{former} is {today}" for today, former in self._recorded.items() if former != today]
        return f"{self.path} was recorded under former names: {', '.join(pairs)}" if pairs else ""

    @property
    def losses(self) -> tuple[str, ...]:
        """One line for each part that could not be read so far; complete once all messages have been read."""
        return (*self._missing, *(line for file in self._files for line in file.losses))

    def messages(
        self,
        topics: Collection[str] | None = None,
        *,
        begin_ns: int | None = None,
        before: Collection[str] = (),
    ) -> Iterator[BagMessage]:
        """Yield the messages of `topics` (all by default), by recorded time.

        With `begin_ns`, what the index shows to be before that time is not read: messages before it may be
        missing, except those of the topics `before`. Raises BagError for a topic that the bag does not have.
        """
        if unknown := sorted({*(topics or ()), *before} - set(self.topics)):
            names = ", ".join(sorted(self.topics)) or "none"
            raise BagError(f"{self.path} has no topic {', '.join(unknown)}; it has {names}")
        since = None
        if begin_ns is not None:
            since = Since(begin_ns, frozenset(self._recorded[name] for name in before))
        return self._messages(None if topics is None else frozenset(topics), since)

    def deserialize(self, message: BagMessage) -> Any:
        """Return a message of this bag as an object with the message's fields.

        Raises BagError where its encoding or definition is unknown, or the bytes do not fit the definition.
        """
        topic = self.details[message.topic]
        if topic.encoding != "cdr":
            raise BagError(f"{message.topic} is serialised as '{topic.encoding}'; only cdr can be read")
        store = self._store(topic)
        # Some middlewares send nothing but the head of a message without fields.
        data = message.data if len(message.data) != _CDR_HEAD else message.data + bytes(1)
        try:
            return store.deserialize_cdr(data, message.msgtype)
        except Exception as error:  # rosbags' generated code fails in many ways on bytes that do not fit
            reason = str(error) or type(error).__name__
            raise BagError(f"a {message.msgtype} on {message.topic} cannot be read: {reason}") from None

    def stamp_ns(self, message: BagMessage) -> int | None:
        """Return the stamp [ns] of the message's header, without reading the rest; None where it has none."""
        topic = self.details[message.topic]
        if topic.encoding != "cdr" or len(message.data) < _STAMP_END:
            return None
        if message.msgtype not in self._has_header:
            fields = self._store(topic).fielddefs[message.msgtype][1]
            self._has_header[message.msgtype] = fields[:1] == [_HEADER_FIELD]
        if not self._has_header[message.msgtype]:
            return None
        # CDR: one byte, then the order of bytes (odd: little endian), options, and the message itself.
        seconds, nanoseconds = struct.unpack_from("<iI" if message.data[1] & 1 else ">iI", message.data, 4)
        return int(seconds) * 1_000_000_000 + int(nanoseconds)

    def _messages(self, topics: frozenset[str] | None, since: Since | None) -> Iterator[BagMessage]:
        today = {recorded: name for name, recorded in self._recorded.items()}
        recorded_topics = None if topics is None else frozenset(self._recorded[name] for name in topics)
        for entry in in_time_order(self._files, recorded_topics, since):
            msgtype = self._type_today(entry.schema_name)
            yield BagMessage(today.get(entry.topic, entry.topic), msgtype, entry.time_ns, entry.data)

    def _opened(self, path: Path) -> BagFile:
        try:
            with open_file(path) as file:
                is_sqlite = file.read(len(sqlite_file.MAGIC)) == sqlite_file.MAGIC
        except (FileError, OSError):
            is_sqlite = False
        if is_sqlite or path.suffix == ".db3":
            return sqlite_file.SqliteFile(path)
        return McapFile(path, salvage=self._salvage)

    def _topic_today(self, name: str) -> str:
        return name if self._salvage else topic_today(name)

    def _type_today(self, name: str) -> str:
        return full_name(name) if self._salvage else type_today(full_name(name))

    def _locate(self) -> list[Path]:
        if not self.path.is_dir():
            if flaw := missing_bag(self.path):
                raise BagError(flaw)
            return [self.path]
        information = self._information()
        named = information.get("relative_file_paths")
        names = [Path(str(name)).name for name in named] if isinstance(named, list) else []
        files = [self.path / name for name in dict.fromkeys(names)]
        self._missing += [f"{file.name} is missing" for file in files if not file.exists()]
        files = [file for file in files if file.exists()] or storage_files(self.path)
        if not files:
            raise BagError(missing_bag(self.path) or f"{self.path} holds no file of its bag")
        custom = information.get("custom_data")
        if isinstance(custom, dict):
            self.metadata.update({str(key): str(value) for key, value in custom.items()})
        return files

    def _information(self) -> dict[str, Any]:
        """Return the contents of metadata.yaml; nothing if a recorder was killed before it wrote any."""
        path = self.path / "metadata.yaml"
        if not os.path.lexists(path):
            return {}
        try:
            information = read_yaml(path)["rosbag2_bagfile_information"]
            storage, mode = information["storage_identifier"], information.get("compression_mode") or "none"
            mode = mode.lower()
        except (FileError, LookupError, TypeError, AttributeError):
            self._missing.append("metadata.yaml is damaged; read without it")
            return {}
        if storage not in ("mcap", "sqlite3"):
            raise BagError(f"{self.path} is stored as {storage}; {_CONVERT}")
        if mode != "none":
            raise BagError(f"{self.path} is compressed by {mode}; {_CONVERT}")
        return dict(information)

    def _note_metadata(self) -> None:
        for file in self._files:
            for key, value in file.metadata.get(METADATA_RECORD, {}).items():
                self.metadata.setdefault(key, value)

    def _read_details(self) -> dict[str, Topic]:
        details: dict[str, Topic] = {}
        names = {channel.topic for file in self._files for channel in file.channels.values()}
        for file in self._files:
            for channel in file.channels.values():
                schema = file.schemas.get(channel.schema_id)
                offered = qos_profiles.parse(channel.metadata.get("offered_qos_profiles", ""))
                # A bag that has both was recorded in a time of change: each stays what it is.
                today = self._topic_today(channel.topic)
                name = channel.topic if today in names else today
                self._recorded[name] = channel.topic
                known = details.get(name) or Topic(
                    msgtype=self._type_today(schema.name) if schema else "",
                    qos=(),
                    encoding=channel.message_encoding,
                    definition=schema.data.decode(errors="replace") if schema else "",
                    type_hash=channel.metadata.get("topic_type_hash", ""),
                    schema_encoding=schema.encoding if schema else "",
                    definition_bytes=schema.data if schema else b"",
                )
                details[name] = known._replace(qos=tuple(dict.fromkeys((*known.qos, *offered))))
        return details

    def _store(self, topic: Topic) -> Typestore:
        """Return a store with the type as the bag defines it, or as Jazzy does where the bag does not."""
        msgtype, definition, schema_encoding = topic.msgtype, topic.definition, topic.schema_encoding
        if not definition:
            try:
                known_type(msgtype)
            except BagError:
                if schema_encoding != "ros2msg":
                    raise
                definition = "\n"  # a message without fields is defined by no text
            else:
                return typestore()
        if msgtype not in self._stores:
            store = get_typestore(Stores.EMPTY)
            is_idl = definition.startswith("=" * 80 + "\nIDL: ")
            try:
                store.register(
                    get_types_from_idl(definition) if is_idl else get_types_from_msg(definition, msgtype)
                )
            except TypesysError as error:
                reason = str(error).partition("\n")[0]
                raise BagError(f"{self.path}: the definition of {msgtype} cannot be read: {reason}") from None
            self._stores[msgtype] = store
        return self._stores[msgtype]

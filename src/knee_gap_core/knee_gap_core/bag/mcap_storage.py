"""MCAP storage for rosbags' writer, with a checksum on every chunk.

rosbags' own storage leaves the checksum out, so that a byte flipped on disk in an uncompressed chunk would
change a pose in silence. This one hands the records to the reference writer of MCAP, which checks them.
"""

from pathlib import Path

from mcap.writer import CompressionType, Writer
from rosbags.interfaces import Connection, ConnectionExtRosbag2, MessageDefinitionFormat
from rosbags.rosbag2.enums import CompressionMode

METADATA_RECORD = "knee_gap"
_CHUNK_SIZE = 1024 * 1024


class ChecksummedMcap:
    """Storage behind `rosbags.rosbag2.Writer` (its StorageWriter protocol)."""

    def __init__(self, path: Path, compression: CompressionMode) -> None:
        self.path = path / f"{path.name}.mcap"
        self._file = self.path.open("xb")
        self._writer = Writer(
            self._file,
            chunk_size=_CHUNK_SIZE,
            compression=CompressionType.ZSTD
            if compression == CompressionMode.STORAGE
            else CompressionType.NONE,
        )
        self._writer.start(profile="ros2", library="knee_gap_replay")
        self._schemas: dict[str, int] = {}
        self._channels: dict[int, int] = {}

    def add_msgtype(self, connection: Connection) -> None:
        """Write the schema of the connection's type."""
        encoding = "ros2msg" if connection.msgdef.format == MessageDefinitionFormat.MSG else "ros2idl"
        self._schemas[connection.msgtype] = self._writer.register_schema(
            connection.msgtype, encoding, connection.msgdef.data.encode()
        )

    def add_connection(self, connection: Connection, offered_qos_profiles: str) -> None:
        """Write the channel of the connection, with the metadata that rosbag2 puts there."""
        assert isinstance(connection.ext, ConnectionExtRosbag2)
        self._channels[connection.id] = self._writer.register_channel(
            connection.topic,
            connection.ext.serialization_format,
            self._schemas[connection.msgtype],
            {"offered_qos_profiles": offered_qos_profiles, "topic_type_hash": connection.digest},
        )

    def add_metadata(self, metadata: dict[str, str]) -> None:
        """Write free metadata at once, so that a recording that is cut short still has it."""
        self._writer.add_metadata(METADATA_RECORD, metadata)

    def write(self, connection: Connection, timestamp: int, data: bytes | memoryview) -> None:
        """Write one serialised message with its time [ns]."""
        self._writer.add_message(self._channels[connection.id], timestamp, bytes(data), timestamp)

    def flush(self) -> None:
        """End the chunk begun and hand it to the operating system: it survives the end of this process."""
        self._writer.flush()  # type: ignore[no-untyped-call]  # mcap leaves it so

    def close(self, version: int, metadata: str) -> None:
        """Write rosbag2's metadata, the index and the end of the file."""
        self._writer.add_metadata("rosbag2", {"serialized_metadata": metadata})
        self._writer.finish()  # type: ignore[no-untyped-call]  # mcap leaves it so
        self._file.close()

    def abort(self) -> None:
        """Close without the index; complete chunks stay readable."""
        self._file.close()

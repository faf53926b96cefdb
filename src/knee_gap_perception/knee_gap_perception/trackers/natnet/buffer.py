"""Bytes of one NatNet packet, read front to back and never beyond the end.

The message classes of the `natnet` package read through its buffer, which believes every length in a packet:
a damaged one makes it ask for gigabytes, or loop for hours over empty names. This buffer refuses at the first
read that the packet cannot hold, so that the work is bounded by the packet's own size.
"""

import struct
from typing import Any

from natnet.packet_buffer import PacketBuffer

from knee_gap_perception.errors import PerceptionError


class PacketError(PerceptionError):
    """A packet that is not what its header or the protocol's version says."""


class BoundedBuffer(PacketBuffer):
    """The reading side of `natnet`'s message classes, little-endian and within the packet."""

    @property
    def remaining(self) -> int:
        """Bytes that are left to read."""
        return len(self.data) - int(self.pointer)

    def skip(self, count: int) -> None:
        """Pass over some bytes."""
        if not 0 <= count <= self.remaining:
            raise PacketError(f"the packet ends {count - self.remaining} bytes too early")
        self.pointer += count

    def read(self, data_type: struct.Struct | str) -> tuple[Any, ...]:
        """Read what a struct format says."""
        layout = struct.Struct("<" + data_type) if isinstance(data_type, str) else data_type
        start = self.pointer
        self.skip(layout.size)
        return layout.unpack_from(self.data, start)

    def read_uint64(self) -> int:
        """Read 8 bytes; the package's own width depends on the machine."""
        return int(self.read("Q")[0])

    def read_float32_array(self, count: int) -> tuple[float, ...]:
        """Read `count` numbers, refused before anything of that size is made."""
        if 4 * count > self.remaining:
            raise PacketError(f"the packet says {count} numbers follow, and {self.remaining} bytes are left")
        return self.read(f"{count}f")

    def read_string(self, max_length: int | None = None, static_length: bool = False) -> str:
        """Read text up to its end mark; with `static_length`, a field of `max_length` bytes."""
        start = self.pointer
        stop = len(self.data) if max_length is None else min(len(self.data), start + max_length)
        text, mark, _ = bytes(self.data[start:stop]).partition(b"\0")
        if not mark:
            raise PacketError("a name in the packet has no end")
        self.skip(max_length if static_length and max_length is not None else len(text) + 1)
        return text.decode("utf-8", errors="replace")

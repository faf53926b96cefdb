"""Bounds-checked buffer of one NatNet packet, for reading from front to back.

The message classes of the `natnet` package read through its own buffer, which trusts every length in a
packet: a damaged one makes it allocate gigabytes, or loop for hours over empty names. This buffer raises at
the first read beyond the packet's end, so that the work is bounded by the packet's size.
"""

import struct
from typing import Any

from natnet.packet_buffer import PacketBuffer

from knee_gap_perception.errors import PerceptionError


class PacketError(PerceptionError):
    """A packet that does not match its header or the protocol's version."""


class BoundedBuffer(PacketBuffer):
    """The reading interface of `natnet`'s message classes, little-endian and bounds-checked."""

    @property
    def remaining(self) -> int:
        """Number of bytes left to read."""
        return len(self.data) - int(self.pointer)

    def skip(self, count: int) -> None:
        """Skip some bytes."""
        if not 0 <= count <= self.remaining:
            raise PacketError(f"the packet ends {count - self.remaining} bytes too early")
        self.pointer += count

    def read(self, data_type: struct.Struct | str) -> tuple[Any, ...]:
        """Read the values of a struct format."""
        layout = struct.Struct("<" + data_type) if isinstance(data_type, str) else data_type
        start = self.pointer
        self.skip(layout.size)
        return layout.unpack_from(self.data, start)

    def read_uint64(self) -> int:
        """Read 8 bytes; the package's own width depends on the machine."""
        return int(self.read("Q")[0])

    def read_float32_array(self, count: int) -> tuple[float, ...]:
        """Read `count` numbers; the size is checked before the memory is allocated."""
        if 4 * count > self.remaining:
            raise PacketError(f"{count} numbers are announced, but only {self.remaining} bytes are left")
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

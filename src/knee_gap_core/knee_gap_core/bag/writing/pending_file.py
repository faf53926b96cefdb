"""A file that is written in whole steps, so that a full disk leaves it at the end of one."""

import os
from pathlib import Path


class PendingFile:
    """Collects bytes in memory until `flush` writes them all, or none of them.

    A `flush` that failed may be repeated once there is space again.
    """

    def __init__(self, path: Path) -> None:
        self._descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o644)
        self._size = 0
        self._pending = bytearray()

    @property
    def pending_bytes(self) -> int:
        """Number of bytes that are not on disk yet."""
        return len(self._pending)

    def tell(self) -> int:
        """Return the size of the file, the bytes that wait included."""
        return self._size + len(self._pending)

    def write(self, data: bytes) -> int:
        """Take bytes; they wait for `flush`."""
        self._pending += data
        return len(data)

    def flush(self) -> None:
        """Hand the bytes to the operating system. Raises OSError where they do not fit; they then wait on."""
        written, data = 0, memoryview(bytes(self._pending))
        try:
            while written < len(data):
                written += os.pwrite(self._descriptor, data[written:], self._size + written)
        except OSError:
            os.ftruncate(self._descriptor, self._size)
            raise
        self._size += written
        self._pending.clear()

    def close(self) -> None:
        """Close the file; bytes that still wait are lost."""
        os.close(self._descriptor)

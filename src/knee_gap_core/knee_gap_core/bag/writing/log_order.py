"""Messages put in the order of their times before they are written."""

import heapq
from collections.abc import Iterator
from typing import Generic, NamedTuple, TypeVar

Item = TypeVar("Item")


class Logged(NamedTuple, Generic[Item]):
    """An item with the time at which it is logged and the time that it was given with [ns]."""

    log_ns: int
    time_ns: int
    item: Item


class LogOrder(Generic[Item]):
    """Sorts items whose times differ from the order of their arrival by at most `span_ns`.

    An item that comes later than that is logged at the time of the last one that was let go, so that the
    log time never runs backwards. Items of equal times keep their order.
    """

    def __init__(self, span_ns: int) -> None:
        self._span_ns = span_ns
        self._waiting: list[tuple[int, int, int, Item]] = []
        self._count = 0
        self._newest_ns = self._last_ns = 0

    def push(self, time_ns: int, item: Item) -> Iterator[Logged[Item]]:
        """Take an item; yield those that no other item can precede any more."""
        heapq.heappush(self._waiting, (max(time_ns, self._last_ns), self._count, time_ns, item))
        self._count += 1
        self._newest_ns = max(self._newest_ns, time_ns)
        yield from self._until(self._newest_ns - self._span_ns)

    def flush(self) -> Iterator[Logged[Item]]:
        """Yield all items that wait."""
        yield from self._until(self._newest_ns)

    def _until(self, end_ns: int) -> Iterator[Logged[Item]]:
        while self._waiting and self._waiting[0][0] <= end_ns:
            self._last_ns, _, time_ns, item = heapq.heappop(self._waiting)
            yield Logged(self._last_ns, time_ns, item)

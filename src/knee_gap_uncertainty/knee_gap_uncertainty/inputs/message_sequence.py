"""Whether the messages of a topic come from one publisher, by their sequence numbers."""

# A queue that overflows loses messages. It holds half a second of them, so that this takes a stall [s].
STALL = 0.3


class MessageSequence:
    """Compares the sequence number of each message with that of the one before.

    A publisher numbers its messages without a hole. After a stall of the subscriber messages may be missing.
    Otherwise any number but the next is that of a second publisher, or of one that was started again: what
    comes does not continue what came before.
    """

    def __init__(self) -> None:
        self._last: int | None = None
        self._taken = 0.0

    def continues(self, number: int | None, now: float) -> bool:
        """Take the next message: its number, None if the middleware has none, and a monotonic time [s]."""
        last, self._last = self._last, number
        stalled = now - self._taken > STALL
        self._taken = now
        return last is None or number is None or number == last + 1 or (stalled and number > last)

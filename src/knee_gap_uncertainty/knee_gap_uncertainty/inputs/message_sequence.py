"""Whether the messages of a topic come from one publisher, without a hole, by their sequence numbers."""


class MessageSequence:
    """Compares the sequence number of each message with that of the one before.

    A publisher numbers its messages without a hole. Any number but the next is that of a second publisher, of
    one that was started again, or one after lost messages: what comes does not continue what came before.
    """

    def __init__(self) -> None:
        self._last: int | None = None

    def continues(self, number: int | None) -> bool:
        """Take the number of the next message, None if the middleware has none; True for the first."""
        last, self._last = self._last, number
        return last is None or number is None or number == last + 1

"""Topics between the nodes of one process: messages pass as they are, in the order of their publication."""

import inspect
import threading
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from typing import Any, NamedTuple

# What is known of a message that no middleware carried.
NOTHING_KNOWN: Mapping[str, int | None] = {}


class LocalSubscription(NamedTuple):
    """A subscription to a local topic; `callback` takes a message."""

    topic: str
    callback: Callable[[Any], None]


class LocalTopics:
    """Hands messages of some topics, given by their full names, to the subscriptions of this process.

    A message that is published while another is handed over waits for its turn, so that no callback runs
    inside of another. `lock` is held meanwhile; a thread that calls into a node from elsewhere holds it too.
    """

    def __init__(self, names: Iterable[str]) -> None:
        self.names = frozenset(names)
        self.lock = threading.RLock()
        self._subscriptions: list[LocalSubscription] = []
        self._waiting: deque[tuple[LocalSubscription, Any]] = deque()
        self._is_busy = False

    def subscribe(self, topic: str, callback: Callable[..., None]) -> LocalSubscription:
        """Subscribe to a topic; the callback takes a message, or a message and what is known of it."""
        takes_two = len(inspect.signature(callback).parameters) > 1
        subscription = LocalSubscription(
            topic, (lambda message: callback(message, NOTHING_KNOWN)) if takes_two else callback
        )
        self._subscriptions.append(subscription)
        return subscription

    def publish(self, topic: str, message: Any) -> None:
        """Hand a message to all subscriptions of a topic, after those that were published before."""
        with self.lock:
            self._waiting.extend((one, message) for one in self._subscriptions if one.topic == topic)
            if self._is_busy:
                return
            self._is_busy = True
            try:
                while self._waiting:
                    subscription, waiting = self._waiting.popleft()
                    subscription.callback(waiting)
            finally:
                self._is_busy = False
                self._waiting.clear()


class LocalPublisher:
    """A publisher of a local topic: the middleware gets a message only if another process listens."""

    def __init__(self, publisher: Any, local: LocalTopics, topic: str) -> None:
        self._publisher, self._local, self._topic = publisher, local, topic

    def publish(self, message: Any) -> None:
        """Publish a message."""
        if self._publisher.get_subscription_count():
            self._publisher.publish(message)
        self._local.publish(self._topic, message)

"""Messages pass between the nodes of one process in the order of their publication, one at a time."""

import threading

from knee_gap_core.live.local_topics import LocalPublisher, LocalTopics


class Middleware:
    """A publisher that counts its subscriptions."""

    def __init__(self, listeners):
        self.listeners, self.published = listeners, []

    def get_subscription_count(self):
        return self.listeners

    def publish(self, message):
        self.published.append(message)


def test_every_subscription_of_the_topic_receives_a_message():
    local = LocalTopics(["a", "b"])
    received: list[object] = []
    local.subscribe("a", lambda message: received.append(("first", message)))
    local.subscribe("b", lambda message: received.append(("other", message)))
    local.subscribe("a", lambda message, info: received.append(("second", message, dict(info))))
    local.publish("a", 1)
    assert received == [("first", 1), ("second", 1, {})]


def test_what_is_published_in_a_callback_waits_for_its_turn():
    local = LocalTopics(["a", "b"])
    received: list[object] = []

    def answer(message):
        local.publish("b", message + 10)
        received.append(message)

    local.subscribe("a", answer)
    local.subscribe("a", received.append)
    local.subscribe("b", received.append)
    local.publish("a", 1)
    assert received == [1, 1, 11]


def test_after_a_callback_that_raises_the_next_message_is_received():
    local = LocalTopics(["a"])
    received: list[object] = []

    def fail(message):
        received.append(message)
        if message == 1:
            raise ValueError

    local.subscribe("a", fail)
    for message in (1, 2):
        try:
            local.publish("a", message)
        except ValueError:
            received.append("raised")
    assert received == [1, "raised", 2]


def test_a_thread_waits_for_the_other():
    local = LocalTopics(["a"])
    received: list[object] = []
    local.subscribe("a", received.append)
    with local.lock:
        thread = threading.Thread(target=local.publish, args=("a", 1))
        thread.start()
        thread.join(0.2)
        assert thread.is_alive()
        assert received == []
    thread.join(10.0)
    assert received == [1]


def test_the_middleware_gets_only_what_somebody_listens_to():
    for listeners, published in ((0, []), (2, [1])):
        middleware, local = Middleware(listeners), LocalTopics(["a"])
        received: list[object] = []
        local.subscribe("a", received.append)
        LocalPublisher(middleware, local, "a").publish(1)
        assert received == [1]
        assert middleware.published == published

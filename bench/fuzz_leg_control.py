"""Random conversations with the leg controller: it never moves on an estimate that the rules refuse.

    tools/env python bench/fuzz_leg_control.py --sequences 100000 --seed 1

A simulated leg obeys the commands, and must never be further than one step beyond its limit. Its node is
honest most of the time. Forged are messages, orders of messages, publishers and silences. The rule by which a
leg may move is written here, apart from the controller's. Ends with 1 if a rule was broken.
"""

import argparse
import math
import time
from collections import Counter
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from knee_gap_bringup.leg_control import Action, Command, Estimate, LegControl, LegParameters

PARAMETERS = LegParameters(
    instrument_diameter=0.0055, largest_gap=0.006, opening_step=0.35, settling=0.1, narrowing_time=0.02
)
STEP = PARAMETERS.opening_step * PARAMETERS.opening_rate
# What a step may take longer than planned: one look at the clock.
LATE = 0.02 * PARAMETERS.opening_rate


class Message(NamedTuple):
    """What a publisher sends, and what only the simulation knows of it: when its track began [s]."""

    estimate: Estimate
    began: float


def may_act(message: Message, largest_ahead: float = 0.05) -> bool:
    """The rule, in its own words: of one message by itself."""
    valid, track, age, gap, low, high, interval, *_ = message.estimate
    if not valid or track <= 0 or interval != "worst_case":
        return False
    if math.isnan(age) or age > 0.5 or age < -largest_ahead:
        return False
    if any(math.isnan(number) or math.isinf(number) for number in (gap, low, high)):
        return False
    return low > 0 and gap >= low and high >= gap


class Fuzz:
    """One conversation; `play` raises AssertionError where the leg moved or passed when it must not."""

    def __init__(self, rng: np.random.Generator, messages: int, counts: Counter[str]) -> None:
        self.random = iter(rng.random(24 * messages + 64).tolist())
        self.messages, self.counts = messages, counts
        self.now, self.clock = 100.0, 5000.0
        self.control = LegControl(PARAMETERS, self.now)
        self.gap = self.start = 0.002 + 0.006 * next(self.random)
        # Until the controller started, another one may have moved the leg.
        self.rate, self.moved_until = 0.0, self.now
        # For how long the leg has opened in this step, and since the last word [s].
        self.in_step = self.since_word = 0.0
        self.last_word = -math.inf
        self.track, self.track_began = 1, 99.0
        self.old: list[Message] = []
        self.heard: dict[int, float] = {}
        # What the rule remembers: the greatest stamp, the messages by stamp, whether a person must come.
        self.greatest_ns = self.of_image_ns = -1
        self.stated: dict[int, Estimate] = {}
        self.latched = False
        self.acceptable: Message | None = None
        if next(self.random) < 0.7:
            self.start_at_rest()
        self.kinds: list[Callable[[Message], Message]] = [
            lambda m: m._replace(estimate=m.estimate._replace(gap=math.nan)),
            lambda m: m._replace(estimate=m.estimate._replace(gap_min=-0.001)),
            lambda m: m._replace(estimate=m.estimate._replace(gap=0.0, gap_min=0.0, gap_max=0.0)),
            lambda m: m._replace(estimate=m.estimate._replace(gap=m.estimate.gap_max * 1.1)),
            lambda m: m._replace(estimate=m.estimate._replace(gap_min=m.estimate.gap_max * 1.2)),
            lambda m: m._replace(estimate=m.estimate._replace(gap_max=math.inf)),
            lambda m: m._replace(estimate=m.estimate._replace(track_id=0)),
            lambda m: m._replace(estimate=m.estimate._replace(interval="paper")),
            lambda m: self.shifted(m, 0.06 + next(self.random)),
            lambda m: self.shifted(m, -0.51 - next(self.random)),
            lambda m: m._replace(estimate=m.estimate._replace(age=math.nan)),
            lambda m: m._replace(estimate=m.estimate._replace(is_valid=False)),
            lambda m: m._replace(estimate=m.estimate._replace(is_valid=False, track_id=0, gap=math.nan)),
            lambda m: self.old[int(next(self.random) * len(self.old))] if self.old else m,
            lambda m: m._replace(
                estimate=m.estimate._replace(track_id=max(1, self.track - 1 - int(3 * next(self.random))))
            ),
        ]

    def start_at_rest(self) -> None:
        """The controller started long ago, and was informed before the first track that there is none."""
        self.control = LegControl(PARAMETERS, self.now - 2.0)
        assert self.control.on_time(self.now - 0.2).measure_again  # type: ignore[union-attr]
        lost = Estimate(False, 0, 0.02, math.nan, math.nan, math.nan, stamp_ns=-1)
        self.control.on_estimate(lost, self.now - 0.02)
        self.moved_until, self.last_word, self.track_began = self.now - 1.0, self.now - 0.02, self.now - 0.5

    def play(self) -> None:
        """Let messages, silences, publishers and persons come in any order."""
        for _ in range(self.messages):
            dice = next(self.random)
            self.wait((0.01, 0.016, 0.05, 0.3)[int(next(self.random) ** 3 * 4)])
            if dice < 0.03:
                self.look_at_publishers()
            elif dice < 0.05:
                self.latched = True
                self.obey(self.control.on_fault("a fault", self.now), None)
            elif dice < 0.09:
                self.person()
            else:
                self.send(self.message(dice))
        self.wait(0.3)
        overrun = self.gap - max(self.start, PARAMETERS.largest_gap)
        assert overrun <= STEP + LATE, f"{overrun} m beyond the limit"

    def message(self, dice: float) -> Message:
        """An honest message, or a forged one."""
        age = 0.02 + 0.1 * next(self.random)
        width = 0.0002 + 0.0008 * next(self.random)
        low = self.gap - width * next(self.random)
        # The image is of a moment ago: a joint that opened since was narrower then.
        low -= PARAMETERS.opening_rate * age
        high = self.gap + width * next(self.random)
        gap = low + (high - low) * next(self.random)
        stamp_ns = round((self.clock - age) * 1e9)
        honest = Estimate(True, self.track, age, gap, low, high, "worst_case", stamp_ns)
        honest = self.in_order(honest)
        message = Message(honest, self.track_began)
        if dice < 0.8:
            return message
        message = self.kinds[int(next(self.random) * len(self.kinds))](message)
        if dice > 0.95 and self.old:
            # The stamp of one that was sent before, and other words.
            return message._replace(
                estimate=message.estimate._replace(stamp_ns=self.old[-1].estimate.stamp_ns)
            )
        return message

    def in_order(self, honest: Estimate) -> Estimate:
        """The estimate with a stamp after those of all before it."""
        if honest.stamp_ns > self.greatest_ns:
            return honest
        # As an honest node would: a moment after its last one, or now where that lies in the future.
        stamp_ns = min(self.greatest_ns + 1000, round(self.clock * 1e9))
        return honest._replace(stamp_ns=stamp_ns, age=self.clock - stamp_ns / 1e9)

    def shifted(self, message: Message, seconds: float) -> Message:
        """The message with a stamp that is later by some seconds."""
        estimate = message.estimate
        return message._replace(
            estimate=estimate._replace(
                age=estimate.age - seconds, stamp_ns=estimate.stamp_ns + round(seconds * 1e9)
            )
        )

    def send(self, message: Message) -> None:
        """One message, judged by the rule before the controller sees it."""
        estimate = message.estimate
        age = estimate.age
        if not math.isnan(age):
            # One that is sent once more is older by now.
            estimate = estimate._replace(age=self.clock - estimate.stamp_ns / 1e9)
            message = message._replace(estimate=estimate)
        acceptable = may_act(message)
        if estimate.stamp_ns < self.greatest_ns:
            acceptable = False
            # Back behind an image: no honest node does that.
            self.latched = self.latched or estimate.stamp_ns < self.of_image_ns
        before = self.stated.setdefault(estimate.stamp_ns, estimate._replace(age=0.0))
        if repr(before) != repr(estimate._replace(age=0.0)):
            acceptable = False
            claims = before.track_id or estimate.track_id
            self.latched = self.latched or bool(claims and estimate.stamp_ns == self.greatest_ns)
        self.greatest_ns = max(self.greatest_ns, estimate.stamp_ns)
        if estimate.track_id and estimate.stamp_ns == self.greatest_ns:
            self.of_image_ns = estimate.stamp_ns
        silent = self.now - self.last_word > PARAMETERS.deadline
        self.since_word, self.last_word = 0.0, self.now
        # A track from before the leg moved measures a joint that is no more; inside its step it goes on.
        moving = self.rate > 0.0
        if not moving and message.began < self.moved_until:
            acceptable = False
        if moving and self.acceptable and self.acceptable.estimate.track_id != estimate.track_id:
            acceptable = False
        # A number that was made up is as old as when it was first heard of; after silence its age is unknown.
        heard = self.heard.setdefault(estimate.track_id, -math.inf if silent else self.now)
        if (
            not moving
            and (estimate.track_id != self.track or heard == -math.inf)
            and heard < self.moved_until
        ):
            acceptable = False
        self.old.append(message)
        self.acceptable = message if acceptable else None
        self.obey(self.control.on_estimate(estimate, self.now), message)

    def look_at_publishers(self) -> None:
        """One publisher is there, or two."""
        several = next(self.random) < 0.5
        names = frozenset({"a", "b"}) if several else frozenset({"a"})
        if several:
            self.latched = True
            self.acceptable = None
        command = self.control.on_publishers(names, self.now)
        if command is not None:
            self.obey(command, None)

    def person(self) -> None:
        """A person resets, once one publisher is left."""
        self.control.on_publishers(frozenset({"a"}), self.now)
        assert not self.control.reset(self.now)
        self.latched, self.acceptable = False, None
        self.rate = 0.0
        self.greatest_ns, self.of_image_ns, self.stated = -1, -1, {}
        self.moved_until = self.now

    def obey(self, command: Command, message: Message | None) -> None:
        """The leg follows its commands; the commands are judged."""
        self.counts[command.action.value] += 1
        if command.opening_rate != 0.0 or command.action is not Action.HOLD:
            assert not self.latched, (command, message)
            assert self.acceptable is not None, (command, message)
            assert 0.0 <= command.opening_rate <= PARAMETERS.opening_rate
        if command.opening_rate > 0.0 and self.acceptable is not None:
            assert self.acceptable.estimate.gap_max < PARAMETERS.largest_gap
            assert self.acceptable.estimate.gap_min < PARAMETERS.instrument_diameter
        if command.action is Action.PASS:
            assert command.opening_rate == 0.0
            assert self.gap >= PARAMETERS.instrument_diameter
        self.in_step = self.in_step if self.rate > 0.0 else 0.0
        self.rate = command.opening_rate
        if command.measure_again:
            self.track, self.track_began = self.track + 1, self.now

    def wait(self, seconds: float) -> None:
        """Time passes, in steps of a tick while the leg moves."""
        end = self.now + seconds
        while self.now < end - 1e-9:
            step = min(0.02 if self.rate > 0.0 else 0.1, end - self.now)
            self.now += step
            self.clock += step
            if self.rate > 0.0:
                self.gap += self.rate * step
                self.in_step += step
                self.since_word += step
                self.moved_until = self.now
                assert self.since_word <= PARAMETERS.deadline + 0.021, "it opens on without a word"
                assert self.in_step <= PARAMETERS.opening_step + 0.021, "it opens on after the step"
            command = self.control.on_time(self.now)
            if command is not None:
                if command.action is not Action.OPEN:
                    self.acceptable = None
                self.obey(command, None)


def run(sequences: int, seed: int, messages: int = 14) -> Counter[str]:
    """Play so many conversations; return how often each action was commanded."""
    rng, counts = np.random.default_rng(seed), Counter[str]()
    for _ in range(sequences):
        Fuzz(rng, messages, counts).play()
    return counts


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--sequences", type=int, default=100_000)
    parser.add_argument("--seed", type=int, default=1)
    arguments = parser.parse_args(argv)
    began = time.monotonic()
    try:
        counts = run(arguments.sequences, arguments.seed)
    except AssertionError as error:
        print(f"a rule was broken: {error}")
        return 1
    reported = ", ".join(f"{number} x {action}" for action, number in counts.most_common())
    print(f"{arguments.sequences} sequences in {time.monotonic() - began:.0f} s, no rule broken: {reported}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())

"""The seam between a node and its core: an exception of one message ends at that message.

Whatever a message is, a core answers it with a status or a reason. An exception is therefore a mistake of the
program; but a node that dies of it leaves a controller without an answer, so it is refused and counted like a
bad message, and the node goes on with its core reset. With `KNEE_GAP_STRICT` set, as tests do, it is raised.
"""

import functools
import os
import traceback
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Concatenate, ParamSpec, TypeVar

Parameters = ParamSpec("Parameters")
Result = TypeVar("Result")
Item = TypeVar("Item")

STRICT = "KNEE_GAP_STRICT"  # environment variable: anything but empty and 0
OWN_FILES = "knee_gap_"  # what the suite's own paths contain


@dataclass(frozen=True)
class Fault:
    """An exception that ended at the seam.

    `what` is the message or timer in whose course it came, `place` the suite's innermost line that it passed
    through, `kind` the exception's class and `traceback` its whole story.
    """

    what: str
    kind: str
    words: str
    place: str
    traceback: str

    @property
    def reason(self) -> str:
        """What to count it by: without values, so that the same fault stays the same."""
        return f"{self.kind} in {self.place}"

    @property
    def line(self) -> str:
        """What a log holds of it."""
        return (
            f"{self.what} refused: {self.reason}: {self.words} (a bug in knee_gap; the log at debug "
            "level has the traceback)"
        )

    @classmethod
    def of(cls, what: str, error: Exception) -> "Fault":
        """The fault of an exception that was caught."""
        frames = traceback.extract_tb(error.__traceback__)
        # The seam's own frames do not help to find the fault; those of libraries little.
        own = [frame for frame in frames if OWN_FILES in frame.filename and frame.filename != __file__]
        frame = (own or frames)[-1]
        place = f"{os.path.basename(frame.filename)}:{frame.lineno}"
        words = " ".join(str(error).split())
        return cls(what, type(error).__name__, words, place, "".join(traceback.format_exception(error)))


class Seam:
    """Calls into a core, and catches what it raises.

    `on_fault` is called with each fault, for the log; `counts` holds how often each came, by what was
    refused and its reason. `passes` is whether an exception is not of a message, such as that of a shutdown.
    `strict` raises all of them; by default as the environment has it.
    """

    def __init__(
        self,
        on_fault: Callable[[Fault], None] | None = None,
        *,
        passes: Callable[[Exception], bool] | None = None,
        strict: bool | None = None,
    ) -> None:
        self.counts: Counter[str] = Counter()
        self.strict = os.environ.get(STRICT, "") not in ("", "0") if strict is None else strict
        self._on_fault = on_fault
        self._passes = passes

    def call(self, what: str, otherwise: Callable[[Fault], Result], function: Callable[[], Result]) -> Result:
        """What `function` returns; if it raises, what `otherwise` returns, which resets the core."""
        try:
            return function()
        except Exception as error:
            fault = self._caught(what, error)
        return otherwise(fault)

    def each(
        self, what: str, otherwise: Callable[[Fault], Iterable[Item]], items: Iterable[Item]
    ) -> Iterator[Item]:
        """The items of an iterator of a core; if it raises, the items that `otherwise` returns end it."""
        iterator = iter(items)
        while True:
            try:
                item = next(iterator)
            except StopIteration:
                return
            except Exception as error:
                fault = self._caught(what, error)
                break
            yield item
        yield from otherwise(fault)

    def guarded(
        self,
        what: str,
        otherwise: Callable[Concatenate[Fault, Parameters], Result],
        function: Callable[Parameters, Result],
    ) -> Callable[Parameters, Result]:
        """`function` with its signature, and with `otherwise(fault, *arguments)` if it raises."""

        @functools.wraps(function)
        def guarded(*arguments: Parameters.args, **named: Parameters.kwargs) -> Result:
            return self.call(
                what,
                lambda fault: otherwise(fault, *arguments, **named),
                lambda: function(*arguments, **named),
            )

        return guarded

    def _caught(self, what: str, error: Exception) -> Fault:
        if self.strict or (self._passes is not None and self._passes(error)):
            raise error
        fault = Fault.of(what, error)
        self.counts[f"{what} refused: {fault.reason}"] += 1
        if self._on_fault is not None:
            self._on_fault(fault)
        return fault

"""Start of every executable: it can be stopped, in silence, while its modules are still being imported.

Importing takes seconds. A Ctrl-C meanwhile would print the traceback of whatever was being imported, or be
taken for its failure. So an entry point imports nothing but this module, which sets the signals first.
"""

import os
import signal
from collections.abc import Callable
from importlib import import_module

STOPS = (signal.SIGINT, signal.SIGTERM)


def entry(module: str, *, node: bool = False) -> Callable[[], int]:
    """Return an entry point that imports `module` and runs its `main`.

    Stopped before its end, a node returns 0, as it does once it runs; a command 128 and the signal's number.
    """

    def start() -> int:
        """Import and run."""
        return run_main(module, node=node)

    return start


def run_main(module: str, *, node: bool = False) -> int:
    """Import `module` and run its `main`; return its exit code."""
    for number in STOPS:
        # Nothing is open yet that would have to be closed; an exception would run through foreign imports.
        signal.signal(number, lambda stop, _frame: os._exit(0 if node else 128 + stop))
    # Blocked by the process that started this one, so that a signal waits until it can be handled.
    signal.pthread_sigmask(signal.SIG_UNBLOCK, STOPS)
    main: Callable[[], int] = import_module(module).main
    signal.signal(signal.SIGINT, signal.default_int_handler)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    try:
        return main()
    except KeyboardInterrupt:
        return 0 if node else 128 + signal.SIGINT
    finally:
        # All is closed. What is left is the end of the interpreter, which an exception would fill with
        # tracebacks, and which must be ended from outside if it hangs.
        for number in STOPS:
            signal.signal(number, signal.SIG_DFL)

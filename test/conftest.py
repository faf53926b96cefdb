"""What all tests share."""

import os
from collections import Counter

import pytest
from recordings import BESIDE

# A fault in the program is raised where it is, in the tests and in all processes that they start.
os.environ.setdefault("KNEE_GAP_STRICT", "1")


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """Close with what was not tested: a line for each reason, with the number of tests skipped for it."""
    counts: Counter[str] = Counter()
    for report in terminalreporter.stats.get("skipped", []):
        # A skipped test or file: its place in the code, and why.
        _, _, reason = report.longrepr
        counts[reason.removeprefix("Skipped: ")] += 1
    terminalreporter.section("not tested")
    for reason, count in counts.most_common():
        terminalreporter.line(f"{count} skipped: {reason}")
    if not BESIDE.is_dir():
        terminalreporter.line(
            "recordings of others: not at ../shared/data, so only input that the tests made"
        )
    terminalreporter.line(f"{counts.total()} skipped in all")

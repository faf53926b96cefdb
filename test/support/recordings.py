"""Where the input of a test comes from: made by the tests, or recorded by others and beside the checkout.

The recordings belong to others and are not part of this repository: they are looked for in `../shared/data`.
A test of real input runs on input of the same kind that a module of this folder makes, and on the recording
too if it is there.
"""

from pathlib import Path

MADE, RECORDED = "made", "recorded"
BESIDE = Path(__file__).parents[3] / "shared" / "data"


def origins(*patterns: str) -> list[str]:
    """Return what to run a test on: MADE, and RECORDED if each pattern has a file in `../shared/data`."""
    found = all(any(BESIDE.glob(pattern)) for pattern in patterns)
    return [MADE, RECORDED] if found else [MADE]

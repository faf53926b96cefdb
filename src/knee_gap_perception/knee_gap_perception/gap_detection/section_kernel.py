"""The loops over the lines across an opening, compiled."""

from collections.abc import Callable

import numpy as np

from knee_gap_core.compiled import compiled
from knee_gap_core.values.arrays import Array, Image

COARSE = 40  # steps of the search for the centre of the largest circle, refined three times


def _room(rows: Array, border: Array, at: float, offset: float) -> tuple[float, int]:
    """Squared distance [px^2] of a border (n,) from a place on the line at `at`, and the line where it is."""
    least, contact = np.inf, 0
    for k in range(rows.size):
        across = max(border[k] + offset, 0.0)
        along = rows[k] - at
        distance = across * across + along * along
        if distance < least:
            least, contact = distance, k
    return least, contact


def _circle_between(rows: Array, first: Array, second: Array, at: float) -> tuple[float, float, int, int]:
    """Offset and radius [px] of the largest circle, and the lines on which it touches either border."""
    reach = min(first.max(), second.max())
    offset, radius, contacts = 0.0, 0.0, (0, 0)
    half = reach
    for _ in range(3):
        start, best = offset, -np.inf
        for k in range(COARSE + 1):
            here = start - half + 2.0 * half * k / COARSE
            one, line_one = room(rows, first, at, here)
            # A border that is nowhere nearer cannot make the circle larger.
            if one <= best:
                continue
            other, line_other = room(rows, second, at, -here)
            if min(one, other) > best:
                best, offset, contacts = min(one, other), here, (line_one, line_other)
        radius = np.sqrt(best)
        half *= 2.0 / COARSE
    return offset, radius, contacts[0], contacts[1]


def _last_below(lines: Image, start: int, step: int, length: int, threshold: float) -> Array:
    """Distance (n,) [px] along each line (n, m) of the last crossing of a threshold, from dark to bright.

    The lines are followed from column `start` on, by `step`, over `length` pixels. 0 if a line is bright from
    its start, its length less one if it ends dark.
    """
    found = np.zeros(lines.shape[0])
    for i in range(lines.shape[0]):
        for k in range(length - 1, -1, -1):
            before = lines[i, start + step * k]
            if before <= threshold:
                if k == length - 1:
                    found[i] = length - 1.0
                else:
                    found[i] = k + (threshold - before) / (
                        lines[i, start + step * (k + 1)] - np.float64(before)
                    )
                break
    return found


# No fast arithmetic: the same pixels must give the same bits.
room: Callable[[Array, Array, float, float], tuple[float, int]] = compiled(_room)
circle_between: Callable[[Array, Array, Array, float], tuple[float, float, int, int]] = compiled(
    _circle_between
)
last_below: Callable[[Image, int, int, int, float], Array] = compiled(_last_below)

"""Detection of an interval that still narrows: while it does, the leg waits before it opens further."""

# By which fraction an interval must be narrower than the narrowest before it, to count.
NARROWER = 0.05


class IntervalWatch:
    """Follows the width of the intervals of one track, [m], on a monotonic clock [s].

    The first VALID interval of a track is its widest: bounds narrow as the scope moves on. A track is waited
    for until its interval has not become narrower for `narrowing_time`, and no longer than `longest_wait`.
    """

    def __init__(self, narrowing_time: float, longest_wait: float) -> None:
        self._narrowing_time, self._longest_wait = narrowing_time, longest_wait
        self._track_id = 0
        self._begun = self._narrowed = self._narrowest = 0.0

    def narrows(self, track_id: int, width: float, now: float) -> bool:
        """Take the width of a valid interval; whether a narrower one may still come in time."""
        if track_id != self._track_id:
            self._track_id, self._begun = track_id, now
            self._narrowest, self._narrowed = width, now
        elif width < (1.0 - NARROWER) * self._narrowest:
            self._narrowest, self._narrowed = width, now
        return now - self._narrowed < self._narrowing_time and now - self._begun < self._longest_wait

"""What the last images say together about a gap, so that one noisy image begins no track."""

from collections import deque

import numpy as np

SPAN = 0.1  # [s] over which images are heard: at 60 Hz six of them
SUREST = 0.98  # [-]: a surer image weighs no more


class ConfidenceFilter:
    """The mean of the log odds of the images of the last tenth of a second.

    The mean, and not the sum that independent images would earn: what looks like a gap in one image looks
    like it in the next, and only noise differs between them. An image by itself decides by itself.
    """

    def __init__(self) -> None:
        self._heard: deque[tuple[int, float]] = deque()

    def add(self, stamp_ns: int, confidence: float) -> float:
        """Confidence [0, 1] of the images up to a stamp [ns], of which the last has `confidence` [0, 1]."""
        since = stamp_ns - round(1e9 * SPAN)
        # Stamps that run backwards are another recording, of which nothing was heard.
        self._heard = deque(heard for heard in self._heard if since < heard[0] < stamp_ns)
        share = min(max(confidence, 1.0 - SUREST), SUREST)
        self._heard.append((stamp_ns, float(np.log(share / (1.0 - share)))))
        if len(self._heard) == 1:
            return confidence
        return float(1.0 / (1.0 + np.exp(-np.mean([odds for _, odds in self._heard]))))

    def forget(self) -> None:
        """As if no image had been seen."""
        self._heard.clear()

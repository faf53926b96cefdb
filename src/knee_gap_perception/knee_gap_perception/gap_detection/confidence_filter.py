"""Filter of the confidence over the last images, so that one noisy image does not start a track."""

from collections import deque

import numpy as np

SPAN = 0.1  # [s] length of the filter: six images at 60 Hz
SUREST = 0.98  # [-] upper limit of the confidence of one image


class ConfidenceFilter:
    """Mean of the log odds of the images of the last tenth of a second.

    It is not the sum, which would hold for independent images: a false gap in one image looks the same in the
    next, and only the noise differs. A single image counts by itself.
    """

    def __init__(self) -> None:
        self._heard: deque[tuple[int, float]] = deque()

    def add(self, stamp_ns: int, confidence: float) -> float:
        """Confidence [0, 1] of all images up to a stamp [ns]; that of the last one alone is `confidence`."""
        since = stamp_ns - round(1e9 * SPAN)
        # Stamps that run backwards belong to another recording: start again.
        self._heard = deque(heard for heard in self._heard if since < heard[0] < stamp_ns)
        share = min(max(confidence, 1.0 - SUREST), SUREST)
        self._heard.append((stamp_ns, float(np.log(share / (1.0 - share)))))
        if len(self._heard) == 1:
            return confidence
        return float(1.0 / (1.0 + np.exp(-np.mean([odds for _, odds in self._heard]))))

    def forget(self) -> None:
        """Forget all images."""
        self._heard.clear()

"""The segmentation strategies by their names: one table."""

from collections.abc import Callable
from typing import Any, NamedTuple

from knee_gap_perception.errors import PerceptionError
from knee_gap_perception.segmentation.learned import Learned
from knee_gap_perception.segmentation.network import Network
from knee_gap_perception.segmentation.strategy import Segmentation
from knee_gap_perception.segmentation.thresholds import Adaptive, Otsu, Otsu3


class Strategy(NamedTuple):
    """How a segmentation is made from its settings; `needs_network`: from a file of a network."""

    make: Callable[..., Segmentation]
    needs_network: bool = False


def _watershed(**settings: Any) -> Segmentation:
    # Imported by need, as the library behind it takes a second to load; the next one as well.
    from knee_gap_perception.segmentation.flooding import Watershed

    return Watershed(**settings)


def _chan_vese(**settings: Any) -> Segmentation:
    from knee_gap_perception.segmentation.active_contour import ChanVese

    return ChanVese(**settings)


LEARNED = "learned"
# A new strategy is a module with a Segmentation, and a row here.
STRATEGIES: dict[str, Strategy] = {
    "otsu": Strategy(Otsu),
    "otsu3": Strategy(Otsu3),
    "adaptive": Strategy(Adaptive),
    "watershed": Strategy(_watershed),
    "chan_vese": Strategy(_chan_vese),
    LEARNED: Strategy(Learned),
    "onnx": Strategy(Network, needs_network=True),
}
# What works without a file of the user's.
WITHOUT_NETWORK = tuple(name for name, strategy in STRATEGIES.items() if not strategy.needs_network)


def segmentation_named(name: str, **settings: Any) -> Segmentation:
    """Return the strategy of a name in STRATEGIES, with the settings of its class.

    Raises PerceptionError for an unknown name and for settings that the strategy refuses.
    """
    if name not in STRATEGIES:
        raise PerceptionError(f"segmentation must be one of {', '.join(STRATEGIES)}, not '{name}'")
    return STRATEGIES[name].make(**settings)

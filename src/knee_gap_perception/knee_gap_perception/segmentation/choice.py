"""Factory of segmentation strategies by name."""

from collections.abc import Callable
from typing import Any

from knee_gap_perception.errors import PerceptionError
from knee_gap_perception.segmentation.network import Network
from knee_gap_perception.segmentation.strategy import Segmentation
from knee_gap_perception.segmentation.thresholds import Adaptive, Otsu, Otsu3

STRATEGIES = ("otsu", "otsu3", "adaptive", "watershed", "chan_vese", "onnx")


def segmentation_named(name: str, **settings: Any) -> Segmentation:
    """Return the strategy of a name in STRATEGIES, with the settings of its class.

    Raises PerceptionError for an unknown name and for settings that the strategy refuses.
    """
    simple: dict[str, Callable[..., Segmentation]] = {
        "otsu": Otsu,
        "otsu3": Otsu3,
        "adaptive": Adaptive,
    }
    if name in simple:
        return simple[name](**settings)
    # Imported only if needed: their library takes a second to load.
    if name == "watershed":
        from knee_gap_perception.segmentation.flooding import Watershed

        return Watershed(**settings)
    if name == "chan_vese":
        from knee_gap_perception.segmentation.active_contour import ChanVese

        return ChanVese(**settings)
    if name == "onnx":
        return Network(**settings)
    raise PerceptionError(f"segmentation must be one of {', '.join(STRATEGIES)}, not '{name}'")

"""A segmentation strategy by its name."""

from collections.abc import Callable
from typing import Any

from knee_gap_perception.errors import PerceptionError
from knee_gap_perception.segmentation.strategy import Segmentation

STRATEGIES = ("otsu", "otsu3", "adaptive", "watershed", "chan_vese", "onnx")


def segmentation_named(name: str, **settings: Any) -> Segmentation:
    """The strategy of a name in STRATEGIES, with the settings of its class.

    Raises PerceptionError for an unknown name and for what the strategy itself refuses.
    """
    # Imported by need: the libraries behind some of them take a second to load.
    if name in ("otsu", "otsu3", "adaptive"):
        from knee_gap_perception.segmentation import thresholds

        thresholding: dict[str, Callable[..., Segmentation]] = {
            "otsu": thresholds.Otsu,
            "otsu3": thresholds.Otsu3,
            "adaptive": thresholds.Adaptive,
        }
        return thresholding[name](**settings)
    if name in ("watershed", "chan_vese"):
        from knee_gap_perception.segmentation import regions

        return regions.Watershed(**settings) if name == "watershed" else regions.ChanVese(**settings)
    if name == "onnx":
        from knee_gap_perception.segmentation.network import Network

        return Network(**settings)
    raise PerceptionError(f"segmentation must be one of {', '.join(STRATEGIES)}, not '{name}'")

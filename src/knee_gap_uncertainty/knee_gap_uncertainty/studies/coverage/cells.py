"""The cells of the study: what the knee, the travel, the true errors and the assumed errors are in each."""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product
from math import radians

DEPTHS = (4e-3, 8e-3, 20e-3)
GAPS = (1e-3, 4e-3, 12e-3)
TRAVELS = (1e-3, 3e-3, 10e-3)
# Angle between travel and the line that joins the two points, seen from the lens: 0 is perpendicular, as in
# the paper.
DIRECTIONS_DEG = (0, 45, 90)
VIEW_COUNTS = (2, 10, 60)
# The share of the bearings' variance that is common to a track.
SHARES = {"independent": 0.0, "half": 0.5, "common": 1.0}
NOISES = ("bounded", "gaussian")
# What the estimator assumes: everything as it is; half of the variance common although it is not; half the
# standard deviation of the bearings, or twice.
MODELS = ("right", "share half", "sigma half", "sigma twice")


@dataclass(frozen=True)
class ErrorSet:
    """Errors of one set of the paper's Table 3: bounds theta [rad], DT [m] and omega [rad]."""

    name: str
    image_error: float
    translation_error: float
    rotation_error: float


ERROR_SETS = (
    ErrorSet("set 1", radians(2.36), 0.0367e-3, radians(0.004)),
    ErrorSet("set 2", radians(5.586), 0.0698e-3, radians(0.177)),
    ErrorSet("0.5 deg", radians(0.5), 0.0367e-3, radians(0.004)),
)


@dataclass(frozen=True)
class Scene:
    """Where the gap is and how the lens travels; lengths in metres."""

    depth: float
    gap: float
    travel: float
    direction_deg: int


@dataclass(frozen=True)
class Cell:
    """One row of the table."""

    scene: Scene
    errors: ErrorSet
    view_count: int
    share: str
    noise: str
    model: str

    @property
    def assumed_share(self) -> float:
        """Common share that is stated to the estimator."""
        return 0.5 if self.model == "share half" else SHARES[self.share]

    @property
    def assumed_scale(self) -> float:
        """Factor of the standard deviation of the bearings that is stated to the estimator."""
        return {"sigma half": 0.5, "sigma twice": 2.0}.get(self.model, 1.0)


def scenes() -> Iterator[Scene]:
    """Every scene of the study."""
    for depth, gap, travel, direction in product(DEPTHS, GAPS, TRAVELS, DIRECTIONS_DEG):
        yield Scene(depth, gap, travel, direction)


def cells() -> Iterator[Cell]:
    """Every cell: the right model everywhere, wrong ones where travel is oblique and noise Gaussian."""
    for scene, errors, count, share, noise in product(scenes(), ERROR_SETS, VIEW_COUNTS, SHARES, NOISES):
        for model in MODELS:
            wrong_here = scene.direction_deg == 45 and noise == "gaussian"
            if model != "right" and not wrong_here:
                continue
            if model == "share half" and share == "half":
                continue
            yield Cell(scene, errors, count, share, noise, model)

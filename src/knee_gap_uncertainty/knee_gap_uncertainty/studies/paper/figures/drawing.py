"""Common style of the study's figures: colours, sizes, and the plane in which a measurement is seen."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import numpy.typing as npt
from scipy.spatial import ConvexHull, cKDTree

matplotlib.use("Agg")
import matplotlib.pyplot as plt

POINT_COLOURS = ("#0b7a8c", "#c8453f")
POINT_TINTS = ("#b9dde2", "#f3cdc9")
LENS_COLOUR = "#2f3440"
GAP_COLOUR = "#1d1f24"
MUTED = "#7a808c"
ACCENT = "#e0a030"

STYLE: dict[Any, Any] = {
    "font.family": "DejaVu Sans",
    "font.size": 9.5,
    "axes.titlesize": 10.5,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": "#9aa0ab",
    "axes.labelcolor": "#3a3f4a",
    "xtick.color": "#5a606c",
    "ytick.color": "#5a606c",
    "axes.grid": True,
    "grid.color": "#e6e8ec",
    "grid.linewidth": 0.8,
    "axes.axisbelow": True,
    "legend.frameon": False,
    "svg.hashsalt": "knee_gap",
    "figure.dpi": 100,
    "savefig.dpi": 160,
}


def figure(columns: int, rows: int, width: float, height: float, **settings: Any) -> tuple[Any, Any]:
    """A figure [inch] and its axes, always a (rows, columns) array, in the study's style."""
    plt.rcParams.update(STYLE)
    return plt.subplots(
        rows, columns, figsize=(width, height), squeeze=False, layout="constrained", **settings
    )


def save(drawn: Any, path: Path) -> Path:
    """Write PNG and SVG beside each other and close the figure; returns the PNG's path."""
    image = path.with_suffix(".png")
    drawn.savefig(image, facecolor="white")
    # The places found for the first file serve for the second: laying out again is most of the work.
    drawn.set_layout_engine("none")
    drawn.savefig(path.with_suffix(".svg"), facecolor="white", metadata={"Date": None})
    plt.close(drawn)
    return image


@dataclass(frozen=True)
class Plane:
    """The plane through lens and gap: the first axis across the view, the second away from the lens [mm]."""

    origin: npt.NDArray[np.float64]
    across: npt.NDArray[np.float64]
    depth: npt.NDArray[np.float64]

    def project(self, points: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        """Points (..., 3) [m] as (..., 2) [mm]."""
        seen = points - self.origin
        return np.asarray(1e3 * np.stack([seen @ self.across, seen @ self.depth], axis=-1))


def measurement_plane(lens: npt.NDArray[np.float64], points: npt.NDArray[np.float64]) -> Plane:
    """Plane of a lens and two points, the origin in the lens, depth towards the middle of the gap."""
    depth = points.mean(axis=0) - lens
    depth = depth / np.linalg.norm(depth)
    across = points[1] - points[0]
    across = across - (across @ depth) * depth
    return Plane(lens, across / np.linalg.norm(across), depth)


Pair = tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]


def nearest_pair(one: npt.NDArray[np.float64], other: npt.NDArray[np.float64]) -> Pair:
    """The two points that are closest to each other."""
    distances, indices = cKDTree(one).query(other)
    chosen = int(distances.argmin())
    return one[indices[chosen]], other[chosen]


def farthest_pair(one: npt.NDArray[np.float64], other: npt.NDArray[np.float64]) -> Pair:
    """The two points that are farthest from each other."""
    corners, others = one[ConvexHull(one).vertices], other[ConvexHull(other).vertices]
    squared = ((corners[:, None] - others) ** 2).sum(axis=2)
    i, j = np.unravel_index(squared.argmax(), squared.shape)
    return corners[i], others[j]

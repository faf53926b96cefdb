"""The drawing of the instrument gap in docs/glossary.md: a cut through the section and what is measured.

tools/env python bench/draw_instrument_gap.py docs/instrument_gap.png
"""

import sys
from collections.abc import Sequence
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.patches import Circle, Polygon

# All in millimetres; the lens is at the origin and looks to the right.
BONE, RADIUS = np.array([14.5, 16.2]), 13.0
RIM = np.array([10.5, -2.3])
SLOPE = np.radians(48.0)
REACH = 10.0
TISSUE, LINE, BLUE, ORANGE, GREEN = "#e8d8c4", "#5b4a3a", "#1f6fb4", "#d9731a", "#2f8f46"


def tangent() -> npt.NDArray[np.float64]:
    """Where the line of sight from the lens touches the bone (2,)."""
    distance = float(np.linalg.norm(BONE))
    angle = np.arctan2(BONE[1], BONE[0]) - np.arcsin(RADIUS / distance)
    length = float(np.sqrt(distance**2 - RADIUS**2))
    return np.array([length * np.cos(angle), length * np.sin(angle)])


def draw(axes: Axes) -> None:
    """Draw the section."""
    contact = tangent()
    axes.add_patch(Circle(tuple(BONE), RADIUS, facecolor=TISSUE, edgecolor=LINE))
    face = RIM - 7.0 * np.array([np.cos(SLOPE), np.sin(SLOPE)])
    back = RIM + np.array([1.6, -5.2])
    axes.add_patch(Polygon([RIM, back, face - np.array([0.0, 0.4]), face], facecolor=TISSUE, edgecolor=LINE))
    for end in (contact, RIM):
        ray = 27.0 * end / np.linalg.norm(end)
        axes.plot([0.0, ray[0]], [0.0, ray[1]], color=BLUE, lw=1.0, ls="--")
    middle = contact / np.linalg.norm(contact) + RIM / np.linalg.norm(RIM)
    middle /= np.linalg.norm(middle)
    axes.annotate("", 26.0 * middle, 19.5 * middle, arrowprops={"arrowstyle": "->", "color": BLUE})
    x, y = 26.3 * middle
    axes.text(x, y, "view through\nthe middle", color=BLUE, va="center", fontsize=9)
    best, normal, low, high = 0.0, np.zeros(2), 0.0, 0.0
    about = np.arctan2(middle[1], middle[0])
    for tilt in about + np.radians(np.linspace(-10.0, 10.0, 201)):
        n = np.array([-np.sin(tilt), np.cos(tilt)])
        if BONE @ n - RADIUS - RIM @ n > best:
            best, normal, low, high = BONE @ n - RADIUS - RIM @ n, n, float(RIM @ n), float(BONE @ n - RADIUS)
    along = np.array([normal[1], -normal[0]])
    centre = 0.5 * (RIM @ along + contact @ along)
    corners = [
        (centre + s * REACH) * along + h * normal for s, h in ((-1, low), (1, low), (1, high), (-1, high))
    ]
    axes.add_patch(Polygon(corners, facecolor=GREEN, alpha=0.25, edgecolor=GREEN))
    at = (centre + 7.6) * along
    axes.annotate("", at + low * normal, at + high * normal, arrowprops={"arrowstyle": "<->", "color": GREEN})
    x, y = at + 0.5 * (low + high) * normal
    axes.text(x + 0.3, y, "gap", color=GREEN, weight="bold", va="center")
    back_along = np.radians(-21.0)
    turn = np.array([[np.cos(back_along), -np.sin(back_along)], [np.sin(back_along), np.cos(back_along)]])
    face_point = RIM - 0.9 * np.array([np.cos(SLOPE), np.sin(SLOPE)])
    points = [face_point, BONE + turn @ (contact - BONE)]
    axes.plot(*np.array(points).T, "x", color=ORANGE, ms=8, mew=2)
    axes.plot(*np.array(points).T, color=ORANGE, lw=1.0)
    axes.text(points[1][0] - 0.2, points[1][1] + 0.5, "G1", color=ORANGE, ha="right", weight="bold")
    axes.text(points[0][0] - 0.5, points[0][1] - 0.2, "G0", color=ORANGE, ha="right", va="top", weight="bold")
    axes.text(8.1, 1.1, "point_distance", color=ORANGE, ha="right", fontsize=9)
    for place, name, shift in ((contact, "edge 1", (0.5, 0.45)), (RIM, "edge 0", (0.7, -0.25))):
        axes.plot(*place, "o", color=BLUE, ms=5)
        axes.text(place[0] + shift[0], place[1] + shift[1], name, color=BLUE, fontsize=9)
    axes.plot(0.0, 0.0, "o", color="black", ms=7)
    axes.text(-0.4, 0.7, "lens", ha="right")
    axes.text(15.0, 7.2, "femoral condyle", color=LINE, ha="center")
    axes.text(7.6, -6.6, "meniscus", color=LINE, ha="center")
    axes.set_xlim(-2.5, 30.0)
    axes.set_ylim(-8.2, 9.0)
    axes.set_aspect("equal")
    axes.axis("off")


def main(argv: Sequence[str]) -> int:
    """Write the drawing to the file named."""
    if len(argv) != 1:
        print("usage: draw_instrument_gap.py PNG", file=sys.stderr)
        return 2
    figure, axes = plt.subplots(figsize=(9.0, 4.8), layout="constrained")
    draw(axes)
    figure.savefig(Path(argv[0]), dpi=110, metadata={"Software": None})
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))

"""The picture in docs/architecture.md: the way of an image and of a pose through the three nodes.

tools/env python bench/draw_architecture.py docs/architecture.png
"""

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
from matplotlib.axes import Axes
from matplotlib.patches import FancyBboxPatch

WIDTH, HEIGHT = 1.62, 0.86  # of a box, in the units of the picture
INK, GREY, IMAGE, POSE, RING, GAP = "#222222", "#6b6b6b", "#1f6fb4", "#2f8f46", "#c2410c", "#6d3fa8"


class Box(NamedTuple):
    """A stage: its middle, what happens there, and the room or module where it stands."""

    x: float
    y: float
    text: str
    room: str
    color: str
    only_with_notch: bool = False


SEGMENTATION = (
    Box(2.9, 8.2, "message to array", "messages", IMAGE),
    Box(4.9, 8.2, "find the notch", "scope_rotation/\nnotch_tracker", RING, True),
    Box(6.9, 8.2, "wait for the\nlens pose", "edge_tracking/\nedge_stream", IMAGE),
    Box(8.9, 8.2, "field of view,\ninstruments, glare", "image", IMAGE),
    Box(10.9, 9.35, "dark pixels", "segmentation", IMAGE),
    Box(12.9, 9.35, "gap? section,\nconfidence", "gap_detection", IMAGE),
    Box(12.9, 8.2, "choose, then follow\nthe two points", "point_tracking", IMAGE),
    Box(14.9, 8.2, "edges beside\nthe points", "gap_detection/\nsection_edges", IMAGE),
)
TRACKING = (
    Box(2.9, 5.4, "topics or NatNet", "trackers", POSE),
    Box(2.9, 4.1, "reject outliers", "scope_pose/\npose_validity", POSE),
    Box(4.9, 4.1, "body to lens", "scope_pose/\nscope_tracker", POSE),
    Box(4.9, 5.4, "pose at the image,\nturned", "scope_rotation/\nrotated_poses", RING, True),
)
UNCERTAINTY = (
    Box(8.9, 5.4, "pose and rotation\nat the image", "inputs", GAP),
    Box(10.9, 5.4, "rules for image,\npose, leg", "estimation/\nacceptance", GAP),
    Box(12.9, 5.4, "one view, with the\ncalibration's error", "scope_calibration", GAP),
    Box(14.9, 5.4, "fit over all views", "multi_view", GAP),
    Box(14.9, 4.1, "has the joint\nmoved?", "joint_motion", GAP),
    Box(12.9, 4.1, "bounds (two views),\ninterval (all views)", "two_view\nmulti_view", GAP),
    Box(10.9, 4.1, "instrument gap,\nits bounds", "instrument_gap", GAP),
    Box(8.9, 4.1, "rules for the\nnumbers", "estimation/\nacceptance", GAP),
)


class Panel(NamedTuple):
    """A node: left, bottom, width and height of its panel, and its title at a place (x, y)."""

    frame: tuple[float, float, float, float]
    title: str
    core: str
    at: tuple[float, float]


PANELS = (
    Panel(
        (1.9, 7.35, 14.0, 2.85),
        "segmentation_node",
        "SegmentationCore, EdgeStream, GapEdgeTracker (edge_tracking)",
        (2.1, 9.95),
    ),
    Panel((1.9, 3.1, 4.2, 2.95), "tracking_node", "TrackingCore (scope_pose)", (2.1, 3.35)),
    Panel(
        (7.9, 3.1, 8.0, 2.95),
        "uncertainty_node",
        "UncertaintyCore, GapEstimator, Track (estimation)",
        (9.3, 3.35),
    ),
)


def draw_box(axes: Axes, box: Box) -> None:
    """Draw a stage; dashed if it is there only while the notch is followed."""
    corner = (box.x - WIDTH / 2, box.y - HEIGHT / 2)
    style = "--" if box.only_with_notch else "-"
    axes.add_patch(
        FancyBboxPatch(
            corner,
            WIDTH,
            HEIGHT,
            boxstyle="round,pad=0,rounding_size=0.08",
            facecolor="white",
            edgecolor=box.color,
            lw=1.5,
            ls=style,
        )
    )
    axes.text(box.x, box.y + 0.17, box.text, ha="center", va="center", fontsize=8, color=INK)
    axes.text(
        box.x, box.y - 0.24, box.room, ha="center", va="center", fontsize=6.6, color=GREY, family="monospace"
    )


def arrow(axes: Axes, way: Sequence[tuple[float, float]], color: str, *, dashed: bool = False) -> None:
    """Draw straight pieces (x, y) one after the other, with a head at the last."""
    style = "--" if dashed else "-"
    if len(way) > 2:
        axes.plot(*zip(*way[:-1], strict=True), color=color, lw=1.5, ls=style, solid_capstyle="round")
    properties = {"arrowstyle": "-|>", "color": color, "lw": 1.5, "ls": style, "shrinkA": 0, "shrinkB": 0}
    axes.annotate("", way[-1], way[-2], arrowprops=properties)


def topic(axes: Axes, x: float, y: float, name: str, color: str, side: str = "center") -> None:
    """Write the name of a topic."""
    axes.text(x, y, name, ha=side, va="center", fontsize=8, color=color, weight="bold", family="monospace")


def draw_arrows(axes: Axes) -> None:
    """Draw what passes from stage to stage, and the topics between the nodes."""
    w, h = WIDTH / 2, HEIGHT / 2
    # The image.
    for left, right in ((2.9, 4.9), (4.9, 6.9), (6.9, 8.9), (12.9, 14.9)):
        arrow(axes, ((left + w, 8.2), (right - w, 8.2)), IMAGE)
    arrow(axes, ((8.9 + w, 8.2), (12.9 - w, 8.2)), IMAGE)
    axes.text(10.9, 8.06, "later images of a track", ha="center", va="top", fontsize=7, color=IMAGE)
    arrow(axes, ((8.9, 8.2 + h), (8.9, 9.35), (10.9 - w, 9.35)), IMAGE)
    axes.text(9.0, 9.47, "first image", ha="left", va="bottom", fontsize=7, color=IMAGE)
    arrow(axes, ((10.9 + w, 9.35), (12.9 - w, 9.35)), IMAGE)
    arrow(axes, ((12.9, 9.35 - h), (12.9, 8.2 + h)), IMAGE)
    topic(axes, 0.1, 8.55, "image_raw", IMAGE, "left")
    arrow(axes, ((0.1, 8.2), (2.9 - w, 8.2)), IMAGE)
    # The tracked body.
    topic(axes, 0.1, 5.75, "scope_body/pose", POSE, "left")
    arrow(axes, ((0.1, 5.4), (2.9 - w, 5.4)), POSE)
    arrow(axes, ((2.9, 5.4 - h), (2.9, 4.1 + h)), POSE)
    arrow(axes, ((2.9 + w, 4.1), (4.9 - w, 4.1)), POSE)
    # The ring: image, notch, pose, image.
    arrow(axes, ((4.9, 8.2 - h), (4.9, 5.4 + h)), RING, dashed=True)
    topic(axes, 4.78, 6.9, "scope_notch", RING, "right")
    arrow(axes, ((4.9, 4.1 + h), (4.9, 5.4 - h)), RING, dashed=True)
    axes.plot((4.9 + w, 6.9), (5.4, 5.4), color=RING, lw=1.5, ls="--")
    # The pose of the lens, to both other nodes.
    axes.plot((4.9 + w, 6.9, 6.9), (4.1, 4.1, 5.4), color=POSE, lw=1.5)
    arrow(axes, ((6.9, 5.4), (6.9, 8.2 - h)), POSE)
    arrow(axes, ((6.9, 5.4), (8.9 - w, 5.4)), POSE)
    topic(axes, 6.78, 6.9, "scope_pose", POSE, "right")
    topic(axes, 6.78, 6.7, "(scope_rotation)", POSE, "right")
    # The edges.
    arrow(axes, ((14.9, 8.2 - h), (14.9, 6.9), (8.9, 6.9), (8.9, 5.4 + h)), IMAGE)
    topic(axes, 11.9, 7.08, "gap_edges", IMAGE)
    # The gap.
    for left, right in ((8.9, 10.9), (10.9, 12.9), (12.9, 14.9)):
        arrow(axes, ((left + w, 5.4), (right - w, 5.4)), GAP)
        arrow(axes, ((right - w, 4.1), (left + w, 4.1)), GAP)
    arrow(axes, ((14.9, 5.4 - h), (14.9, 4.1 + h)), GAP)
    arrow(axes, ((8.9, 4.1 - h), (8.9, 2.8)), GAP)
    topic(axes, 9.0, 2.85, "gap, gap/min, gap/max, gap/snr, gap_profile, motion_advice", GAP, "left")


def draw(axes: Axes) -> None:
    """Draw the three nodes and the ways through them."""
    for panel in PANELS:
        left, bottom, width, height = panel.frame
        axes.add_patch(
            FancyBboxPatch(
                (left, bottom),
                width,
                height,
                boxstyle="round,pad=0,rounding_size=0.12",
                facecolor="#f4f4f2",
                edgecolor="#cccccc",
            )
        )
        title = axes.text(*panel.at, panel.title, va="center", fontsize=9, weight="bold")
        axes.annotate(
            f"   core: {panel.core}", (1.0, 0.5), xycoords=title, va="center", fontsize=8, color=GREY
        )
    draw_arrows(axes)
    for box in (*SEGMENTATION, *TRACKING, *UNCERTAINTY):
        draw_box(axes, box)
    axes.text(
        1.9,
        2.85,
        "blue: image   green: pose   violet: gap   orange, dashed: if the notch is followed",
        fontsize=8,
        color=GREY,
        va="center",
    )
    axes.set_xlim(0.0, 16.0)
    axes.set_ylim(2.65, 10.3)
    axes.set_aspect("equal")
    axes.axis("off")


def main(argv: Sequence[str]) -> int:
    """Write the picture to the file named."""
    if len(argv) != 1:
        print("usage: draw_architecture.py PNG", file=sys.stderr)
        return 2
    figure, axes = plt.subplots(figsize=(14.0, 6.85), layout="constrained")
    draw(axes)
    figure.savefig(Path(argv[0]), dpi=110, metadata={"Software": None})
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))

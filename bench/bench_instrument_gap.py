"""The instrument gap of simulated knees, beside other quantities that could be measured there.

Truth only: nothing is rendered. Each knee is seen from the middle of its hand's travel, at the section
through the middle of the gap. The first table holds what the lines of sight give, the nearest distance and
the instrument gap [mm]. The second holds, for each side (0 the condyle, 1 the meniscus), how far the edge and
the point 2 degrees inside it lie from the lens, the depth between them, the angle of the line between them
with the line of sight along the edge, and the radius of a circle through the surface around the edge, in the
plane of the section.
"""

import argparse
import sys
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from knee_gap_core.values.arrays import Array
from knee_gap_simulation.errors import SimulationError
from knee_gap_simulation.knee_simulator import KneeSimulator
from knee_gap_simulation.recordings.section_truth import SectionTruth, edges_at_section, section_truth
from knee_gap_simulation.surfaces.tissue_samples import LOWER_SIDE, UPPER_SIDE

INSET = float(np.radians(2.0))  # of the tracked points from their edges
CURVE_REACH = 2.0e-3  # [m] around an edge point: its side's curve in the plane of the section
CURVE_SLAB = 0.06e-3  # half thickness [m] of that plane


class Knee(NamedTuple):
    """One knee's section: its truth, the half angle between its edges [rad], its inset points (2, 3) [m]."""

    seed: int
    truth: SectionTruth
    half_angle: float
    ranges: Array
    inset_ranges: Array
    inset_distance: float
    chord_angles: Array
    radii: Array
    bones: float


def knee(level: int, seed: int, time: float, inset: float) -> Knee:
    """The truth of a knee at a time [s] of its hand's travel."""
    simulator = KneeSimulator(level, seed)
    T_scene_lens = simulator.pose(time)
    lens, scene = T_scene_lens[:3, 3], simulator.scene
    middle = scene.ridge(0.0)[0] - (0.0, 0.5 * (simulator.settings.gap or 0.0), 0.0)
    pixel = simulator.lens.pixels(T_scene_lens[:3, :3].T @ (middle - lens))
    edges = edges_at_section(scene, simulator.lens, T_scene_lens, pixel)
    truth = section_truth(scene, T_scene_lens, edges)
    half = 0.5 * float(np.arccos(np.clip(edges[0] @ edges[1], -1.0, 1.0)))
    # The tracked points: outward from the edges within the plane of the section.
    view = (edges[0] + edges[1]) / np.linalg.norm(edges[0] + edges[1])
    across = (edges[1] - edges[0]) / np.linalg.norm(edges[1] - edges[0])
    angles = np.array([-half - inset, half + inset])[:, None]
    bearings = np.cos(angles) * view + np.sin(angles) * across
    points = scene.surface_points(T_scene_lens, bearings)
    rays = edges @ T_scene_lens[:3, :3].T
    chords = truth.edge_points - points
    cosines = (chords * rays).sum(axis=1) / np.linalg.norm(chords, axis=1)
    samples = scene.tissue_samples(truth.edge_points.mean(axis=0), 0.012)
    normal = T_scene_lens[:3, :3] @ np.cross(view, across)
    radii = [
        section_radius(samples.points[samples.sides == side], point, normal, T_scene_lens[:3, :3] @ view)
        for side, point in zip((UPPER_SIDE, LOWER_SIDE), truth.edge_points, strict=True)
    ]
    return Knee(
        seed,
        truth,
        half,
        np.linalg.norm(truth.edge_points - lens, axis=1),
        np.linalg.norm(points - lens, axis=1),
        float(np.linalg.norm(points[1] - points[0])),
        np.arccos(np.clip(cosines, -1.0, 1.0)),
        np.array(radii),
        simulator.nearest_distance,
    )


def section_radius(points: Array, at: Array, normal: Array, view: Array) -> float:
    """Radius [m] of a circle fitted to points (n, 3) near the plane of the section, around an edge point."""
    away = points - at
    near = (np.abs(away @ normal) < CURVE_SLAB) & (np.linalg.norm(away, axis=1) < CURVE_REACH)
    flat = np.stack([away[near] @ view, away[near] @ np.cross(normal, view)], axis=-1)
    design = np.column_stack([2.0 * flat, np.ones(len(flat))])
    x, y, c = np.linalg.lstsq(design, (flat**2).sum(axis=1), rcond=None)[0]
    return float(np.sqrt(c + x * x + y * y))


def table(knees: Sequence[Knee]) -> str:
    """Both tables, and the medians and extremes against the instrument gap."""
    names = ("inset", "edges", "across", "nearest", "bones", "cone 0", "cone 10")
    lines = ["seed   " + "".join(f"{name:>9s}" for name in names) + "   half [deg]  axis tilt [deg]"]
    rows = []
    for one in knees:
        truth = one.truth
        row = (
            one.inset_distance,
            truth.edge_distance,
            truth.across_view,
            truth.nearest_distance,
            one.bones,
            truth.along_view.diameter,
            truth.instrument.diameter,
        )
        cosine = float(truth.instrument.axis_direction @ truth.along_view.axis_direction)
        tilt = np.degrees(np.arccos(min(1.0, cosine)))
        lines.append(
            f"{one.seed:6d} "
            + "".join(f"{1e3 * value:9.3f}" for value in row)
            + f"{np.degrees(one.half_angle):13.2f}{tilt:15.1f}"
        )
        rows.append(row)
    against = 1e3 * (np.array(rows) - np.array(rows)[:, -1:])
    for name, values in (
        ("median", np.median(against, axis=0)),
        ("least", against.min(axis=0)),
        ("most", against.max(axis=0)),
    ):
        lines.append(f"{name:6s} " + "".join(f"{value:+9.3f}" for value in values) + "   against cone 10")
    lines.append("")
    lines.append(
        "seed   side  range inset  range edge  edge behind inset [mm]  chord to sight [deg]  radius [mm]"
    )
    for one in knees:
        for side in (0, 1):
            near, far = 1e3 * one.inset_ranges[side], 1e3 * one.ranges[side]
            lines.append(
                f"{one.seed:6d} {side:4d}{near:13.3f}{far:12.3f}{far - near:24.3f}"
                f"{np.degrees(one.chord_angles[side]):22.1f}{1e3 * one.radii[side]:13.2f}"
            )
    return "\n".join(lines)


def main(argv: Sequence[str] | None = None) -> int:
    """Print the tables of the seeds asked for."""
    parser = argparse.ArgumentParser(prog="bench_instrument_gap", description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--truth", action="store_true", help="print the truth of simulated knees")
    parser.add_argument("--seed", type=int, nargs="+", default=list(range(70100, 70125)))
    parser.add_argument("--level", type=int, default=0)
    parser.add_argument("--time", type=float, default=1.95, help="[s]; the middle of the travel is 1.95")
    parser.add_argument("--inset", type=float, default=2.0, help="[deg] of the points from their edges")
    asked = parser.parse_args(argv)
    if not asked.truth:
        parser.error("give --truth")
    knees = []
    for seed in asked.seed:
        try:
            knees.append(knee(asked.level, seed, asked.time, np.radians(asked.inset)))
        except SimulationError as error:
            print(f"bench_instrument_gap: seed {seed}: {error}", file=sys.stderr)
    if not knees:
        return 1
    print(table(knees))
    return 0


if __name__ == "__main__":
    sys.exit(main())

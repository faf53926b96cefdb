"""The page docs/how/parameters.md, every parameter of every node; run as a module, it prints the page."""

import sys
from collections.abc import Iterator
from dataclasses import Field, fields
from math import isnan
from typing import Any

from knee_gap_bringup.leg_control import LegParameters
from knee_gap_core.live.lifecycle_parameters import LifecycleParameters
from knee_gap_perception.edge_tracking.parameters import TransportParameters
from knee_gap_perception.scope_pose.frame_tree import FrameParameters
from knee_gap_replay.pipeline import PARAMETERS

NODES: dict[str, tuple[type, ...]] = {
    "segmentation_node": (LifecycleParameters, TransportParameters, *PARAMETERS["segmentation_node"]),
    "tracking_node": (LifecycleParameters, FrameParameters, *PARAMETERS["tracking_node"]),
    "uncertainty_node": (LifecycleParameters, *PARAMETERS["uncertainty_node"]),
    "leg_controller_node": (LegParameters,),
}


def page() -> Iterator[str]:
    """Yield the lines of the page."""
    yield "# Parameters"
    yield ""
    yield "Printed by `tools/env python -m knee_gap_bringup.parameters_page`. All are read-only; SI units."
    for node, kinds in NODES.items():
        yield ""
        yield f"## {node}"
        yield "| parameter | default | values | meaning |"
        yield "|---|---|---|---|"
        for kind in kinds:
            for field in fields(kind):
                yield row(field)


def row(field: "Field[Any]") -> str:
    """One row of the table."""
    meaning = str(field.metadata.get("description", "")).replace("|", "\\|")
    return f"| `{field.name}` | {shown(field.default)} | {allowed(field)} | {meaning} |"


def allowed(field: "Field[Any]") -> str:
    """Allowed values of a parameter."""
    if choices := field.metadata.get("choices"):
        return ", ".join(choices)
    if limits := field.metadata.get("range"):
        text = f"{limits[0]:g} to {limits[1]:g}"
        return f"{text}, NaN" if field.metadata.get("nan") else text
    return ""


def shown(value: object) -> str:
    """A default value in readable form."""
    if isinstance(value, tuple):
        return ", ".join(shown(item) for item in value)
    if isinstance(value, float):
        return "NaN" if isnan(value) else f"{value:.6g}"
    return f"`{value}`" if isinstance(value, str) and value else str(value)


if __name__ == "__main__":
    sys.stdout.write("\n".join(page()) + "\n")

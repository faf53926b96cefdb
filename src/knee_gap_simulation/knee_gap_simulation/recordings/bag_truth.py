"""True gap masks of the images of a simulated bag, for the evaluation of segmentations."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from knee_gap_core.bag.bag import BagReader
from knee_gap_core.bag.errors import BagError
from knee_gap_core.values.arrays import Array
from knee_gap_core.values.rigid_transforms import rigid
from knee_gap_simulation.errors import SimulationError
from knee_gap_simulation.recordings.recording import LENS_POSE_TRUE
from knee_gap_simulation.recordings.scene_truth import scene_from_metadata

MaskAt = Callable[[int], npt.NDArray[np.bool_] | None]


def gap_masks(bag: Path) -> MaskAt | None:
    """Return the true gap mask by stamp [ns], None without a true lens pose; None for other bags."""
    poses: dict[int, Array] = {}
    try:
        with BagReader(bag) as reader:
            truth = scene_from_metadata(reader.metadata)
            for entry in reader.messages([LENS_POSE_TRUE]):
                message, stamp_ns = reader.deserialize(entry), reader.stamp_ns(entry)
                p, q = message.pose.position, message.pose.orientation
                turn = Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix()
                poses[stamp_ns or 0] = rigid(turn, [p.x, p.y, p.z])
    except (SimulationError, BagError):
        return None

    def mask(stamp_ns: int) -> npt.NDArray[np.bool_] | None:
        pose = poses.get(stamp_ns)
        return None if pose is None else truth.gap_mask(pose, stamp_ns)

    return mask

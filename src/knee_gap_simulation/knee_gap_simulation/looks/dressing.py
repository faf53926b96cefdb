"""Changes by a look in the camera of a scene."""

import numpy as np
import numpy.typing as npt

from knee_gap_core.values.arrays import Array
from knee_gap_simulation.knee.camera_head import CameraHead
from knee_gap_simulation.knee.difficulty import Conditions
from knee_gap_simulation.knee.knee_camera import Dressing
from knee_gap_simulation.knee.shape import KneeShape
from knee_gap_simulation.looks.border import Surround, field_border
from knee_gap_simulation.looks.clutter import Clutter
from knee_gap_simulation.looks.look import Look
from knee_gap_simulation.looks.materials import look_textures
from knee_gap_simulation.looks.video import GradedHead
from knee_gap_simulation.scope.imaging import FloatImage
from knee_gap_simulation.scope.lens import Lens


def dressing(look: Look, scene: KneeShape, lens: Lens, conditions: Conditions, poses: Array) -> Dressing:
    """The look's part of the camera; ``poses`` (n, 4, 4) are lens poses in the scene along its travel."""
    border = field_border(lens, look)
    surround = Surround(lens, look, border.stop)
    clutter = Clutter(look, scene.cast, lens, poses)

    def head(box: tuple[slice, slice], stop: FloatImage, radius: npt.NDArray[np.float32]) -> CameraHead:
        fringe = np.ascontiguousarray(border.fringe[box])
        return GradedHead(conditions, look.head, stop, fringe, radius, look.seed)

    return Dressing(
        textures=look_textures(look.seed, look.tissues),
        light=look.light,
        stop=border.stop,
        field=border.field,
        over=clutter.over,
        finish=surround.around,
        written=surround.written,
        fibres=look.clutter.fibres,
        head=head,
    )

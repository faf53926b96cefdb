"""The part of a track's residuals that the calibration's error explains, and that is not joint motion.

The error is the same in all views, so it leaves a pattern in them: a lens that sits elsewhere on its body
shows as points that move when the scope turns. Points and error are fitted together, the error held to what
is stated of it, and the views are given back as they would be without it.
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from knee_gap_core.values.arrays import Array
from knee_gap_uncertainty.multi_view.views import Views
from knee_gap_uncertainty.scope_calibration.scope_calibration import CalibrationError
from knee_gap_uncertainty.scope_calibration.shared_error_kernel import explain, shared_views, take_error


class SharedError(NamedTuple):
    """One value of the error: `parts` (7 + k,) are shift [m], turn [rad], clock [s] and camera [-].

    Shifts are counted from `rotation` (3, 3), `motion` (6,) of one view, at which they are 0: what moves all
    lenses alike moves the points with them.
    """

    parts: Array
    rotation: Array
    motion: Array

    def taken_from(self, views: Views) -> Views:
        """The views as they would be without it.

        Taking a clock's error from a lens puts the errors of the two poses that give its velocity in.
        """
        assert views.lens_rotations is not None
        lens, bearings = np.empty_like(views.lens_positions), np.empty_like(views.bearings)
        backs = np.empty_like(views.lens_rotations)
        take_error(shared_views(views, self.rotation, self.motion), self.parts, lens, bearings, backs)
        times = np.full(len(views), np.inf) if views.motion_times is None else views.motion_times
        larger = 1.0 + 2.0 * (self.parts[6] / times[:, None, None]) ** 2
        changed = {
            "lens_positions": lens,
            "bearings": bearings,
            "lens_covariances": larger * views.lens_covariances,
            "rotation_covariances": larger * views.rotation_covariances,
            "lens_rotations": backs @ views.lens_rotations,
        }
        if all(np.isfinite(values.sum()) for values in changed.values()):
            return views.with_arrays(changed)
        # Says what is wrong with them.
        return replace(views, **changed)


def explained_by(error: CalibrationError, views: Views) -> SharedError | None:
    """The most likely value of the error by the views; None where it is too small to matter.

    Bearings and positions have the variances that the views state, the error that of `error`.
    """
    if len(views) < 2 or views.lens_rotations is None:
        return None
    shared = shared_views(views)
    parts, matters = explain(shared, error.root(7 + shared.camera_errors.shape[-1]))
    return SharedError(parts, shared.rotation, shared.motion) if matters else None

"""A simulated calibration of the scope of a simulated bag, with the errors of a real calibration.

    tools/env python -m knee_gap_bringup.simulated_calibration bags/sample

writes calibration.yaml to the bag's folder. Its standard errors are those of `calibrate all` on a simulated
calibration bag (docs/how/calibration.md). Its values deviate from the true ones by errors drawn from them, so
that the stated accuracy is tested.
"""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from knee_gap_core.bag.bag import BagReader
from knee_gap_core.values.errors import KneeGapError
from knee_gap_perception.calibration.calibration import Calibration, Clock, LensOnBody
from knee_gap_perception.calibration.calibration_file import save_calibration
from knee_gap_perception.camera.intrinsics import Intrinsics
from knee_gap_perception.camera.medium import medium_of
from knee_gap_perception.scope_rotation.shaft_axis import Mount
from knee_gap_simulation.recordings.scene_truth import SceneTruth, scene_from_metadata
from knee_gap_simulation.scope.media import calibrated

CALIBRATION_FILE = "calibration.yaml"
# Standard errors; of the lens RMS lengths [rad], [m]; of fx, fy, cx, cy [px] and four of the distortion.
ROTATION, SHIFT, CLOCK = np.radians(0.003), 0.006e-3, 0.03e-3
CAMERA = np.array([0.048, 0.048, 0.031, 0.029, 1.5e-4, 2.6e-4, 0.0, 0.0])
# Of the tracked body, as a simulated tracker has them.
BODY_ROTATION, BODY_SHIFT = np.radians(0.004), 0.0367e-3
REPROJECTION_PX = 0.057


def simulated_calibration(truth: SceneTruth, seed: int) -> Calibration:
    """A calibration of the scope and lens of a scene, with errors drawn from its own standard errors."""
    rng = np.random.default_rng([seed, 12])
    # In the medium of its calibration, to which the file's angles refer.
    lens, T_body_lens = calibrated(truth.lens), truth.scope.body_to_lens()
    focal, x, y = lens.focal_px, lens.centre_x_px, lens.centre_y_px
    camera = np.array([focal, focal, x, y, 0.0, 0.0, 0.0, 0.0]) + CAMERA * rng.standard_normal(8)
    twist = np.repeat([ROTATION, SHIFT], 3) / np.sqrt(3.0)
    error = twist * rng.standard_normal(6)
    rotation = Rotation.from_matrix(T_body_lens[:3, :3]) * Rotation.from_rotvec(error[:3])
    fx, fy, cx, cy = (float(value) for value in camera[:4])
    return Calibration(
        lens.width_px,
        lens.height_px,
        camera=Intrinsics(
            width=lens.width_px,
            height=lens.height_px,
            distortion_model="equidistant",
            k=(fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0),
            d=tuple(float(value) for value in camera[4:]),
            covariance=np.diag(CAMERA**2),
            rms_px=REPROJECTION_PX,
            sigma_px=float(REPROJECTION_PX / np.sqrt(2.0)),
            design_effect=1.0,
            view_count=48,
            point_count=3401,
        ),
        lens=LensOnBody(
            translation=T_body_lens[:3, 3] + T_body_lens[:3, :3] @ error[3:],
            quaternion_xyzw=rotation.as_quat(canonical=True),
            covariance=np.diag(twist**2),
            mount=Mount.SCOPE,
            rotation_error=float(BODY_ROTATION),
            translation_error=BODY_SHIFT,
            left_out_rms_px=0.3,
            view_count=96,
        ),
        clock=Clock(float(CLOCK * rng.standard_normal()), CLOCK, "simulated"),
        medium=medium_of(truth.media.calibrated_in, "calibrated_in"),
    )


def main(argv: Sequence[str] | None = None) -> int:
    """Write the calibration; return 1 if the bag is not a bag or not simulated."""
    parser = argparse.ArgumentParser(prog="simulated_calibration", description=(__doc__ or "").split("\n")[0])
    parser.add_argument("bag", type=Path)
    parser.add_argument("--seed", type=int, default=7)
    asked = parser.parse_args(argv)
    try:
        with BagReader(asked.bag) as reader:
            truth = scene_from_metadata(reader.metadata)
        save_calibration(simulated_calibration(truth, asked.seed), asked.bag / CALIBRATION_FILE)
    except KneeGapError as error:
        print(f"simulated_calibration: {error}", file=sys.stderr)
        return 1
    print(f"simulated_calibration: {asked.bag / CALIBRATION_FILE} written")
    return 0


if __name__ == "__main__":
    sys.exit(main())

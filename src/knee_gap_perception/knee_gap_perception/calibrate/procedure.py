"""Steps of a calibration: each estimates one part of the calibration from a recorded bag and reports it."""

from collections.abc import Callable, Iterable
from dataclasses import replace

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from knee_gap_core.values.arrays import Array
from knee_gap_perception.calibrate.measurements.boards import DotGrid
from knee_gap_perception.calibrate.measurements.image_motion import image_motion
from knee_gap_perception.calibrate.observations import Observations, common_angle, tracked_views, wrapped
from knee_gap_perception.calibrate.observed_rotations import FIXED_TURN, turns_by_body, turns_by_notch
from knee_gap_perception.calibrate.recording import Recording
from knee_gap_perception.calibrate.solvers.hand_eye import HandEye, HandEyeSettings, calibrate_hand_eye
from knee_gap_perception.calibrate.solvers.intrinsics import IntrinsicsFit, fit_intrinsics
from knee_gap_perception.calibrate.solvers.pivot import calibrate_pivot
from knee_gap_perception.calibrate.solvers.time_offset import estimate_time_offset
from knee_gap_perception.calibration.calibration import Calibration, Clock, LensOnBody, Oblique, Tip
from knee_gap_perception.camera.projection import LensModel
from knee_gap_perception.errors import PerceptionError
from knee_gap_perception.scope_rotation.notch import NOTCH_SIGMA, common_shape

BODY_SIGMA = np.radians(0.02)  # standard error of a rotation from two tracked bodies
MAX_PASSES = 5  # of hand-eye, each with a better time offset and without outlying views
DISAGREEMENT = 4.0  # standard errors between two estimates of the clock, above which a warning is given

Report = Callable[[str], None]


class Procedure:
    """Calibration steps on one recording; data read by one step are used by the next."""

    def __init__(self, recording: Recording, report: Report) -> None:
        self._recording, self._request, self._report = recording, recording.request, report

    def intrinsics(self, calibration: Calibration | None) -> Calibration:
        """Camera intrinsics and distortion."""
        seen = self._recording.observe("board", calibration)
        fit = self._fit(seen)
        camera = fit.intrinsics
        sigma = np.sqrt(np.diag(camera.covariance))
        names = self._request.model.names
        values = ", ".join(
            f"{name} {value:.6g} ± {s:.2g}"
            for name, value, s in zip(names, camera.parameters, sigma, strict=True)
        )
        self._report(f"{camera.distortion_model}: {values}")
        self._report(
            f"reprojection {camera.rms_px:.3f} px RMS, {camera.point_count} points in {camera.view_count} of "
            f"{seen.image_count} images, {fit.outlier_count} left out, design effect "
            f"{camera.design_effect:.1f}"
        )
        return _kept(calibration, seen, camera=camera)

    def time_offset(self, calibration: Calibration | None) -> Calibration:
        """Time between video and tracker."""
        track = self._recording.track()
        size: list[tuple[int, int]] = []

        def images() -> Iterable[tuple[int, npt.NDArray[np.uint8]]]:
            for stamp, image in self._recording.images("board"):
                size[:] = [(image.shape[1], image.shape[0])]
                yield stamp, image

        found = estimate_time_offset(image_motion(images()), track, max_offset=self._request.max_offset)
        self._report(
            f"the tracker's clock reads stamp {1e3 * found.offset:+.2f} ± {1e3 * found.sigma:.2f} ms "
            f"({100 * found.explained:.1f} % of the image motion explained, {found.window_count} windows)"
        )
        clock = Clock(found.offset, found.sigma, "image motion")
        base = calibration or Calibration(*size[0])
        return base.with_parts(*size[0], clock=clock)

    def hand_eye(self, calibration: Calibration | None) -> Calibration:
        """Lens on the tracked body, without rotation of the scope in its camera head."""
        seen = self._recording.observe("board", calibration)
        angles = np.array([view.notch_angle for view in seen.views])
        reference = common_angle(angles, FIXED_TURN)
        away = np.abs(wrapped(angles - reference))
        turned = int((away[np.isfinite(away)] > FIXED_TURN).sum())
        if turned > 0.2 * len(angles):
            raise PerceptionError(
                f"by the notch, the scope is rotated in its camera head in {turned} of {len(angles)} views: "
                "hold it fixed, or use calibrate oblique"
            )
        known = self._with_camera(calibration)
        found = self._lens(known, [seen], [np.zeros(len(seen.views))], self._recording.offset(known))
        oblique = None
        if np.isfinite(reference):
            self._report(
                f"notch at {np.degrees(reference):.2f} deg; do not rotate the scope before calibrate oblique"
            )
            shape = common_shape([view.notch for view in seen.views])
            oblique = Oblique(reference, None, float("nan"), float("nan"), notch_shape=shape)
        return _kept(known, seen, **self._parts(known, found), oblique=oblique)

    def oblique(self, calibration: Calibration | None) -> Calibration:
        """Lens on the tracked body, and the rotation axis of an oblique scope in its camera head."""
        marked = [name for name in ("board", "oblique") if name in self._recording.steps]
        parts = [self._recording.observe(name, calibration) for name in marked or ["oblique"]]
        angles = np.concatenate([[view.notch_angle for view in seen.views] for seen in parts])
        notch = common_angle(angles, FIXED_TURN)
        known = self._with_camera(calibration)
        offset, T_head_scope = self._recording.offset(known), None
        if self._request.scope_pose_topic is None:
            turns = turns_by_notch(parts)
        else:
            # The rotation by a body at an image depends on the clock, which the same fit improves.
            for _ in range(MAX_PASSES):
                turns, T_head_scope = turns_by_body(self._recording, parts, known.require_camera(), offset)
                better = self._hand_eye(known, parts, turns, offset)[0].time_offset
                if abs(better - offset) < 5e-4:
                    break
                offset = better
        together = np.concatenate(turns)
        self._report(
            f"rotation known in {np.isfinite(together).sum()} of {len(together)} views, "
            f"{np.degrees(np.nanmin(together)):+.1f} to {np.degrees(np.nanmax(together)):+.1f} deg; notch at "
            f"{np.degrees(notch):.2f} deg"
        )
        found = self._lens(known, parts, turns, offset)
        tilt, shift = found.axis_sigma or (float("nan"), float("nan"))
        if found.axis is not None:
            self._report(
                f"shaft's axis known to {np.degrees(tilt):.3f} deg and {1e3 * shift:.3f} mm; the view is "
                f"{np.degrees(np.arccos(found.axis.direction @ found.T_body_lens[:3, 2])):.2f} deg oblique "
                "to it"
            )
        shape = common_shape([view.notch for seen in parts for view in seen.views])
        oblique = Oblique(notch, found.axis, tilt, shift, T_head_scope, shape)
        return _kept(known, parts[0], **self._parts(known, found), oblique=oblique)

    def pivot(self, calibration: Calibration | None) -> Calibration:
        """Tip of the scope on the tracked body."""
        if calibration is None:
            raise PerceptionError("the tip needs a calibration of the camera: run calibrate intrinsics first")
        found = calibrate_pivot(self._recording.raw_poses("pivot"))
        sigma = np.sqrt(np.diag(found.covariance))
        self._report(
            f"tip at {_mm(found.tip)} ± {_mm(sigma, 3)} mm on the body, {1e3 * found.rms:.3f} mm RMS over "
            f"{found.pose_count} poses, {found.outlier_count} left out"
        )
        if calibration.lens is not None:
            apart = np.linalg.norm(found.tip - calibration.lens.T_body_lens[:3, 3])
            self._report(f"the lens is {1e3 * apart:.2f} mm from the tip")
        return replace(calibration, tip=Tip(found.tip, found.covariance, found.rms))

    def _fit(self, seen: Observations) -> IntrinsicsFit:
        views = [view.board for view in seen.views]
        if not views:
            raise PerceptionError(
                f"the board was found in none of {seen.image_count} images: check --board, light and focus, "
                "and keep most of the board in the image"
            )
        return fit_intrinsics(views, seen.width_px, seen.height_px, self._request.model)

    def _with_camera(self, calibration: Calibration | None) -> Calibration:
        """The calibration, with a camera from this bag if it has none."""
        if isinstance(self._request.board, DotGrid) and not self._request.board.has_orientation:
            raise PerceptionError(
                "a symmetric dot grid looks the same if rotated by half a turn: use asymmetric dots or "
                "ChArUco"
            )
        if calibration is None or calibration.camera is None:
            return self.intrinsics(calibration)
        return calibration

    def _lens(
        self, known: Calibration, parts: list[Observations], turns: list[Array], offset: float
    ) -> HandEye:
        """Hand-eye over parts, each view at its rotation, with a report."""
        found, count, offered = self._hand_eye(known, parts, turns, offset)
        if count < offered:
            self._report(f"{offered - count} of {offered} views left out: not consistent with the others")
        self._tell(found, count)
        return found

    def _hand_eye(
        self, known: Calibration, parts: list[Observations], turns: list[Array], offset: float
    ) -> tuple[HandEye, int, int]:
        """Hand-eye at the best time offset, without outlying views; numbers of views used and given."""
        request, camera = self._request, known.require_camera()
        model = LensModel(camera.distortion_model, request.model.high_order)
        # Outlying points are found with the lens alone, before they can be attributed to the tracker.
        board_views = [view.board for seen in parts for view in seen.views]
        fit = fit_intrinsics(board_views, parts[0].width_px, parts[0].height_px, model)
        stamps = [view.stamp_ns for view in board_views]
        turn_of = dict(zip(stamps, np.concatenate(turns), strict=True))
        kept_turns = np.array([turn_of[view.stamp_ns] for view in fit.views])
        sigma = BODY_SIGMA if request.scope_pose_topic else NOTCH_SIGMA
        sigmas = np.where(kept_turns == 0.0, 0.0, sigma)
        if request.free_intrinsics:
            camera = fit.intrinsics
        settings = HandEyeSettings(free_intrinsics=request.free_intrinsics, mount=request.mount)
        keep = np.ones(len(fit.views), dtype=bool)
        for _ in range(MAX_PASSES):
            chosen = [view for view, good in zip(fit.views, keep, strict=True) if good]
            views = tracked_views(chosen, kept_turns[keep], sigmas[keep], self._recording.track(), offset)
            found = calibrate_hand_eye(views, camera, model, settings)
            offset += found.time_offset
            bad = {view.board.stamp_ns for view, out in zip(views, found.outlying, strict=True) if out}
            keep &= np.array([view.stamp_ns not in bad for view in fit.views])
            # Poses are evaluated again at the better time, until the change is negligible.
            if abs(found.time_offset) < 5e-4 and not bad:
                break
        return replace(found, time_offset=offset), len(views), len(fit.views)

    def _tell(self, found: HandEye, count: int) -> None:
        self._report("solvers, RMS px: " + ", ".join(f"{s.name} {s.rms_px:.1f}" for s in found.solvers))
        rotation = np.degrees(np.sqrt(np.trace(found.covariance[:3, :3])))
        position = 1e3 * np.sqrt(np.trace(found.covariance[3:, 3:]))
        self._report(
            f"lens at {_mm(found.T_body_lens[:3, 3])} mm on the body, ± {position:.3f} mm and ± "
            f"{rotation:.3f} deg (RMS length), "
            f"{count} views"
        )
        self._report(
            f"reprojection as tracked {found.rms_px:.2f} px RMS; each view left out in turn: median "
            f"{np.median(found.left_out_rms_px):.2f}, worst {found.left_out_rms_px.max():.2f} px"
        )
        self._report(
            f"the views show a tracker error of {1e3 * found.translation_error:.3f} mm and "
            f"{np.degrees(found.rotation_error):.4f} deg RMS"
        )

    def _parts(self, known: Calibration, found: HandEye) -> dict[str, object]:
        lens = LensOnBody(
            translation=found.T_body_lens[:3, 3],
            quaternion_xyzw=Rotation.from_matrix(found.T_body_lens[:3, :3]).as_quat(canonical=True),
            covariance=found.covariance,
            mount=self._request.mount,
            rotation_error=found.rotation_error,
            translation_error=found.translation_error,
            left_out_rms_px=float(np.median(found.left_out_rms_px)),
            view_count=len(found.left_out_rms_px),
        )
        parts: dict[str, object] = {"lens": lens, "camera": found.intrinsics}
        if np.isfinite(found.time_offset_sigma):
            parts["clock"] = self._clock(
                known.clock, Clock(found.time_offset, found.time_offset_sigma, "board")
            )
        return parts

    def _clock(self, motion: Clock | None, board: Clock) -> Clock:
        """The more accurate of two estimates of the clock, with a warning if they disagree."""
        self._report(f"time offset from the board {1e3 * board.offset:+.2f} ± {1e3 * board.sigma:.2f} ms")
        if motion is None or motion.source == board.source:
            return board
        apart = abs(motion.offset - board.offset) / np.hypot(motion.sigma, board.sigma)
        if apart > DISAGREEMENT:
            self._report(
                f"warning: image motion gives {1e3 * motion.offset:+.2f} ± {1e3 * motion.sigma:.2f} ms, "
                f"{apart:.1f} "
                "standard errors away: are the stamps regular?"
            )
        return board if board.sigma <= motion.sigma else motion


def _kept(calibration: Calibration | None, seen: Observations, **parts: object) -> Calibration:
    base = calibration or Calibration(seen.width_px, seen.height_px)
    return base.with_parts(seen.width_px, seen.height_px, **{k: v for k, v in parts.items() if v is not None})


def _mm(lengths: Array, digits: int = 2) -> str:
    return "(" + ", ".join(f"{1e3 * value:.{digits}f}" for value in lengths) + ")"

"""The steps of a calibration: each from a recorded bag to its part of the calibration, told in words."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from knee_gap_perception.calibration.bag_input import CalibrationBag
from knee_gap_perception.calibration.boards import Board, DotGrid
from knee_gap_perception.calibration.calibration_file import Calibration, Clock, LensOnBody, Oblique, Tip
from knee_gap_perception.calibration.hand_eye import HandEye, HandEyeSettings, calibrate_hand_eye
from knee_gap_perception.calibration.image_motion import image_motion
from knee_gap_perception.calibration.intrinsics import IntrinsicsFit, fit_intrinsics
from knee_gap_perception.calibration.lens_model import LensModel
from knee_gap_perception.calibration.notch import NOTCH_SIGMA
from knee_gap_perception.calibration.observations import (
    Observations,
    common_angle,
    observe,
    still_stamps,
    tracked_views,
    wrapped,
)
from knee_gap_perception.calibration.pivot import calibrate_pivot
from knee_gap_perception.calibration.pose_track import PoseTrack
from knee_gap_perception.calibration.rigid import Array
from knee_gap_perception.calibration.scope_turn import Mount
from knee_gap_perception.calibration.time_offset import estimate_time_offset
from knee_gap_perception.errors import PerceptionError

FIXED_TURN = np.radians(2.0)  # turns of the scope that `hand_eye`, which takes it as fixed, lets pass
MAX_PASSES = 5  # of hand-eye, for a better time and without views that do not fit
DISAGREEMENT = 4.0  # standard errors between two estimates of the clock, from which they are called different

Progress = Callable[[Iterable[int], str], Iterable[int]]
Report = Callable[[str], None]


@dataclass(frozen=True)
class Request:
    """What is calibrated from where."""

    bag: Path
    board: Board | None = None
    image_topic: str = "/knee_gap/image_raw/compressed"
    pose_topic: str = "/knee_gap/scope_body/pose"
    model: LensModel = field(default_factory=lambda: LensModel("equidistant"))
    mount: Mount = Mount.CAMERA_HEAD
    views: int = 48
    free_intrinsics: bool = True
    time_offset: float | None = None
    max_offset: float = 0.25
    begin: float = 0.0
    end: float = float("inf")

    def __post_init__(self) -> None:
        if not 4 <= self.views <= 500:
            raise PerceptionError(f"--views must lie in [4, 500], not {self.views}")
        if not 0.0 < self.max_offset <= 2.0:
            raise PerceptionError(f"--max-offset must lie in (0, 2] s, not {self.max_offset}")


class Procedure:
    """Calibration steps over one bag; what one step read serves the next."""

    def __init__(self, request: Request, report: Report, progress: Progress) -> None:
        self._request, self._report, self._progress = request, report, progress
        self._bag = CalibrationBag(request.bag, request.begin, request.end)
        self._track: PoseTrack | None = None
        self._seen: dict[str, Observations] = {}

    @property
    def steps(self) -> dict[str, tuple[float, float]]:
        """Parts that the bag marks, by name."""
        return self._bag.steps()

    def intrinsics(self, calibration: Calibration | None) -> Calibration:
        """Camera intrinsics and distortion."""
        seen = self._observe("board", calibration)
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
        track = self._poses()
        part = self._bag.part("board")
        self._report("following the picture's motion")
        size: list[tuple[int, int]] = []

        def images() -> Iterable[tuple[int, npt.NDArray[np.uint8]]]:
            total = len(part.image_stamps(self._request.image_topic))
            pictures = part.images(self._request.image_topic)
            for _, (stamp, image) in zip(
                self._progress(range(total), "image motion"), pictures, strict=False
            ):
                size[:] = [(image.shape[1], image.shape[0])]
                yield stamp, image

        found = estimate_time_offset(image_motion(images()), track, max_offset=self._request.max_offset)
        self._report(
            f"the tracker's clock reads stamp {1e3 * found.offset:+.2f} ± {1e3 * found.sigma:.2f} ms "
            f"({100 * found.explained:.1f} % of the picture's motion explained, {found.window_count} windows)"
        )
        clock = Clock(found.offset, found.sigma, "image motion")
        base = calibration or Calibration(*size[0])
        return base.with_parts(*size[0], clock=clock)

    def hand_eye(self, calibration: Calibration | None) -> Calibration:
        """Lens on the tracked body, the scope not turned in its camera head."""
        seen = self._observe("board", calibration)
        angles = np.array([view.notch_angle for view in seen.views])
        reference = common_angle(angles, FIXED_TURN)
        away = np.abs(wrapped(angles - reference))
        turned = int((away[np.isfinite(away)] > FIXED_TURN).sum())
        if turned > 0.2 * len(angles):
            raise PerceptionError(
                f"the notch says that the scope is turned in its camera head in {turned} of {len(angles)} "
                "views: hold it "
                "fixed, or use calibrate oblique"
            )
        found, known = self._lens(calibration, [seen], [np.zeros(len(seen.views))])
        oblique = None
        if np.isfinite(reference):
            self._report(
                f"notch at {np.degrees(reference):.2f} deg; until calibrate oblique, do not turn the scope"
            )
            oblique = Oblique(reference, None, float("nan"), float("nan"))
        return _kept(known, seen, **self._parts(known, found), oblique=oblique)

    def oblique(self, calibration: Calibration | None) -> Calibration:
        """Lens on the tracked body and the axis about which an oblique scope turns in its camera head."""
        marked = [name for name in ("board", "oblique") if name in self.steps]
        parts = [self._observe(name, calibration) for name in marked or ["oblique"]]
        angles = [np.array([view.notch_angle for view in seen.views]) for seen in parts]
        reference = common_angle(np.concatenate(angles), FIXED_TURN)
        if not np.isfinite(reference):
            raise PerceptionError(
                "the notch is seen in none of the views: is the whole round picture in the image, and lit?"
            )
        turns = [_held(wrapped(angle - reference)) for angle in angles]
        together = np.concatenate(turns)
        seen_count = int(np.isfinite(together).sum())
        self._report(
            f"notch seen in {seen_count} of {len(together)} views, turned by "
            f"{np.degrees(np.nanmin(together)):+.1f} to "
            f"{np.degrees(np.nanmax(together)):+.1f} deg from {np.degrees(reference):.2f} deg"
        )
        found, known = self._lens(calibration, parts, turns)
        tilt, shift = found.axis_sigma or (float("nan"), float("nan"))
        if found.axis is not None:
            self._report(
                f"shaft's axis known to {np.degrees(tilt):.3f} deg and {1e3 * shift:.3f} mm; the view is "
                f"{np.degrees(np.arccos(found.axis.direction @ found.T_body_lens[:3, 2])):.2f} deg oblique "
                "to it"
            )
        oblique = Oblique(reference, found.axis, tilt, shift)
        return _kept(known, parts[0], **self._parts(known, found), oblique=oblique)

    def pivot(self, calibration: Calibration | None) -> Calibration:
        """Tip of the scope on the tracked body."""
        if calibration is None:
            raise PerceptionError(
                "the tip is added to a calibration of the camera: run calibrate intrinsics first"
            )
        part = self._bag.part("pivot")
        found = calibrate_pivot(part.poses(self._request.pose_topic)[1])
        sigma = np.sqrt(np.diag(found.covariance))
        self._report(
            f"tip at {_mm(found.tip)} ± {_mm(sigma, 3)} mm on the body, {1e3 * found.rms:.3f} mm RMS over "
            f"{found.pose_count} poses, {found.outlier_count} left out"
        )
        if calibration.lens is not None:
            apart = np.linalg.norm(found.tip - calibration.lens.T_body_lens[:3, 3])
            self._report(f"the lens is {1e3 * apart:.2f} mm from the tip")
        return replace(calibration, tip=Tip(found.tip, found.covariance, found.rms))

    def _poses(self) -> PoseTrack:
        if self._track is None:
            whole = CalibrationBag(self._request.bag, self._request.begin, self._request.end)
            self._track = PoseTrack.of(*whole.poses(self._request.pose_topic))
        return self._track

    def _observe(self, part: str, calibration: Calibration | None) -> Observations:
        request = self._request
        if request.board is None:
            raise PerceptionError("which board is in the picture? Say --board")
        if part not in self._seen:
            bag = self._bag.part(part)
            try:
                track: PoseTrack | None = self._poses()
            except PerceptionError:
                track = None
            stamps = bag.image_stamps(request.image_topic)
            chosen = still_stamps(stamps, request.views, track, self._offset(calibration))
            if len(chosen) == 0:
                raise PerceptionError(
                    f"none of the {len(stamps)} images was taken while the body was tracked"
                )
            self._seen[part] = observe(bag, request.image_topic, request.board, chosen, self._progress)
        seen = self._seen[part]
        if calibration is not None:
            calibration.require_image_size(seen.width_px, seen.height_px)
        return seen

    def _offset(self, calibration: Calibration | None) -> float:
        """Time offset to start from: asked for, calibrated before, or none."""
        if self._request.time_offset is not None:
            return self._request.time_offset
        return calibration.clock.offset if calibration and calibration.clock else 0.0

    def _fit(self, seen: Observations) -> IntrinsicsFit:
        views = [view.board for view in seen.views]
        if not views:
            raise PerceptionError(
                f"the board was found in none of {seen.image_count} images: check --board, light, focus, "
                "and that much of "
                "the board is in the picture"
            )
        return fit_intrinsics(views, seen.width_px, seen.height_px, self._request.model)

    def _lens(
        self, calibration: Calibration | None, parts: list[Observations], turns: list[Array]
    ) -> tuple[HandEye, Calibration]:
        """Hand-eye over parts, each view at its turn; and the calibration with a camera in it."""
        request = self._request
        if isinstance(request.board, DotGrid) and not request.board.has_orientation:
            raise PerceptionError(
                "a symmetric dot grid looks the same when turned by half a turn: use asymmetric dots or "
                "ChArUco"
            )
        known = calibration
        if known is None or known.camera is None:
            known = self.intrinsics(calibration)
        camera = known.require_camera()
        model = LensModel(camera.distortion_model, request.model.high_order)
        board_views = [view.board for seen in parts for view in seen.views]
        # Outliers among the points are told by the lens alone, before the tracker can be blamed for them.
        fit = fit_intrinsics(board_views, parts[0].width_px, parts[0].height_px, model)
        turn_of = {
            view.board.stamp_ns: turn
            for seen, angles in zip(parts, turns, strict=True)
            for view, turn in zip(seen.views, angles, strict=True)
        }
        kept_turns = np.array([turn_of[view.stamp_ns] for view in fit.views])
        sigmas = np.where(kept_turns == 0.0, 0.0, NOTCH_SIGMA)
        if request.free_intrinsics:
            camera = fit.intrinsics
        settings = HandEyeSettings(free_intrinsics=request.free_intrinsics, mount=request.mount)
        offset, keep = self._offset(known), np.ones(len(fit.views), dtype=bool)
        for _ in range(MAX_PASSES):
            chosen = [view for view, good in zip(fit.views, keep, strict=True) if good]
            views = tracked_views(chosen, kept_turns[keep], sigmas[keep], self._poses(), offset)
            found = calibrate_hand_eye(views, camera, model, settings)
            offset += found.time_offset
            bad = {view.board.stamp_ns for view, out in zip(views, found.outlying, strict=True) if out}
            keep &= np.array([view.stamp_ns not in bad for view in fit.views])
            # Poses are read again at the better time, until what is left is too short to matter.
            if abs(found.time_offset) < 5e-4 and not bad:
                break
        if left_out := int((~keep).sum()):
            self._report(f"{left_out} of {len(keep)} views left out: the others do not explain them")
        found = replace(found, time_offset=offset)
        self._tell(found, len(views))
        return found, known

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
        """The surer of two estimates of the clock; that they disagree is said."""
        self._report(f"time offset from the board {1e3 * board.offset:+.2f} ± {1e3 * board.sigma:.2f} ms")
        if motion is None or motion.source == board.source:
            return board
        apart = abs(motion.offset - board.offset) / np.hypot(motion.sigma, board.sigma)
        if apart > DISAGREEMENT:
            self._report(
                f"warning: image motion says {1e3 * motion.offset:+.2f} ± {1e3 * motion.sigma:.2f} ms, "
                f"{apart:.1f} "
                "standard errors away: are the stamps regular?"
            )
        return board if board.sigma <= motion.sigma else motion


def _kept(calibration: Calibration | None, seen: Observations, **parts: object) -> Calibration:
    base = calibration or Calibration(seen.width_px, seen.height_px)
    return base.with_parts(seen.width_px, seen.height_px, **{k: v for k, v in parts.items() if v is not None})


def _mm(lengths: Array, digits: int = 2) -> str:
    return "(" + ", ".join(f"{1e3 * value:.{digits}f}" for value in lengths) + ")"


def _held(turns: Array) -> Array:
    """Turns of a part of the bag; exactly 0 where the notch says that the scope was held still."""
    seen = turns[np.isfinite(turns)]
    return np.zeros_like(turns) if len(seen) and np.abs(seen).max() < FIXED_TURN else turns

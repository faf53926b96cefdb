"""The medium before the simulated lens, and the hand that turns the scope about its portal."""

import json
from pathlib import Path

import numpy as np
import pytest
from ruamel.yaml import YAML

from knee_gap_core.bag.bag import BagReader
from knee_gap_simulation.calibration.bag import CalibrationRecording, calibration_truth
from knee_gap_simulation.errors import SimulationError
from knee_gap_simulation.knee_simulator import KneeSimulator
from knee_gap_simulation.make_bag.command import Recording, main, make_bag
from knee_gap_simulation.recordings.scene_truth import METADATA_KEY, scene_from_metadata
from knee_gap_simulation.scope.hand_motion import HandMotion, TravelDirection
from knee_gap_simulation.scope.lens import Lens
from knee_gap_simulation.scope.media import Media, RefractedLens, index_of
from knee_gap_simulation.scope.pinhole import PinholeLens

RATIO = 1 / 1.336


@pytest.mark.parametrize("lens", [Lens(), PinholeLens(field_of_view=1.4)])
def test_a_lens_in_saline_bends_rays_by_snell(lens: Lens) -> None:
    wet = RefractedLens.of(lens, RATIO)
    rng = np.random.default_rng(3)
    angle, radius = rng.uniform(-np.pi, np.pi, 200), 0.99 * lens.radius_px * np.sqrt(rng.random(200))
    offset = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=-1)
    pixels = offset + np.array([lens.centre_x_px, lens.centre_y_px])
    dry, seen = lens.bearings(pixels), wet.bearings(pixels)
    # Along the window the wave's phase is the same on both sides.
    np.testing.assert_allclose(1.336 * seen[:, :2], dry[:, :2], atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(seen, axis=1), 1.0, atol=1e-12)
    np.testing.assert_allclose(wet.pixels(4.0 * seen), pixels, atol=1e-9)
    assert wet.radius_px == lens.radius_px
    assert np.isnan(wet.bearings([lens.centre_x_px + lens.radius_px + 1.0, lens.centre_y_px])).all()
    assert RefractedLens.of(lens, 1.0) is lens


def test_ninety_degrees_become_64() -> None:
    wet = RefractedLens.of(Lens(), RATIO)
    assert np.degrees(wet.field_of_view) == pytest.approx(63.9, abs=0.05)
    edge = np.array([np.sin(np.radians(31.9)), 0.0, np.cos(np.radians(31.9))])
    assert np.isfinite(wet.pixels(edge)).all()
    assert np.isnan(wet.pixels([np.sin(0.56), 0.0, np.cos(0.56)])).all()


@pytest.mark.parametrize("medium", ["beer", "nan", 0.5, "1.7"])
def test_a_medium_that_there_is_not_is_refused(medium: str | float) -> None:
    with pytest.raises(SimulationError, match="air, saline, water or an index"):
        index_of(medium)


def test_a_window_that_reflects_the_whole_border_is_refused() -> None:
    with pytest.raises(SimulationError, match="choose another medium"):
        RefractedLens.of(Lens(field_of_view=2.0), 1.336)


@pytest.mark.parametrize("direction", list(TravelDirection))
@pytest.mark.parametrize("oblique", [0.0, 0.5])
def test_the_shaft_passes_through_its_portal(direction: TravelDirection, oblique: float) -> None:
    shaft = (0.0, float(np.sin(oblique)), float(np.cos(oblique)))
    motion = HandMotion(
        travel=0.008, depth=0.010, direction=direction, hand=None, portal=0.05, shaft=shaft, seed=4
    )
    still = HandMotion(travel=0.008, depth=0.010, direction=direction, seed=4)
    times = np.linspace(0.0, 3.0, 25)
    poses, before = motion.poses(times), still.poses(times)
    # The tip goes the same way, with the same tremor.
    np.testing.assert_array_equal(poses[:, :3, 3], before[:, :3, 3])
    portals = poses[:, :3, 3] - 0.05 * poses[:, :3, :3] @ shaft
    # Tremor and drift, 0.5 degrees RMS, move it by less than 2 mm; along the shaft it slides.
    across = (portals - portals.mean(axis=0)) @ (
        np.eye(3) - np.outer(*2 * [motion.poses(0.0)[:3, :3] @ shaft])
    )
    assert np.linalg.norm(across, axis=1).max() < 2e-3
    turned = np.degrees(np.arccos(np.clip(np.trace(poses[-1, :3, :3].T @ poses[0, :3, :3]) / 2 - 0.5, -1, 1)))
    if direction is TravelDirection.ALONG:
        assert turned == pytest.approx(9.1, abs=1.2)
        # It turns to the side to which its tip goes.
        assert (poses[-1, :3, 2] - poses[0, :3, 2])[0] > 0.1
    if direction is TravelDirection.FORWARD and not oblique:
        assert turned < 1.5


def test_a_portal_in_the_joint_is_refused() -> None:
    with pytest.raises(SimulationError, match="portal must lie in"):
        HandMotion(travel=0.008, depth=0.010, portal=0.001)


def test_a_bag_says_its_media_and_keeps_the_calibrated_camera(tmp_path: Path) -> None:
    shown = Recording(duration_s=0.1, fps=10.0, medium="saline", calibrated_in="air", portal=0.05)
    truth = make_bag(tmp_path / "bag", shown, progress=False)
    parameters = YAML(typ="safe").load(tmp_path / "bag" / "scope.yaml")
    eyes = parameters["/**/segmentation_node"]["ros__parameters"]
    assert eyes == {"camera_info_medium": "air", "medium": "saline"}
    assert parameters["/**/tracking_node"]["ros__parameters"]["medium"] == "saline"
    with BagReader(tmp_path / "bag") as bag:
        info = bag.deserialize(next(iter(bag.messages(["/knee_gap/camera_info"]))))
        back = scene_from_metadata(bag.metadata)
        reported = json.loads(bag.metadata[METADATA_KEY])["recording"]
    assert info.k[0] == Lens().focal_px
    assert back.lens == truth.lens == RefractedLens.of(Lens(), RATIO)
    assert back.media == truth.media == Media("air", "saline")
    assert (reported["medium"], reported["portal"]) == ("saline", 0.05)


def test_what_is_not_asked_for_changes_nothing() -> None:
    assert Recording().media == Media("saline", "saline")
    assert Recording(scope_of=3).media == Media("air", "saline")
    assert not {"medium", "calibrated_in", "portal"} & set(Recording().as_dict())
    assert not {"media", "portal"} & set(KneeSimulator(0, 5).settings.as_dict())
    assert KneeSimulator(0, 5).lens == Lens()
    assert "medium" not in CalibrationRecording().as_dict()


def test_a_knee_and_a_board_lie_in_the_medium_too() -> None:
    wet = KneeSimulator(0, 5, medium="saline", calibrated_in="air", portal=0.05, travel=0.006)
    assert wet.lens == RefractedLens.of(Lens(), RATIO)
    assert wet.settings.as_dict()["media"] == ("air", "saline")
    dry, bath = (calibration_truth(CalibrationRecording(seed=9, medium=m)).lens for m in ("air", "saline"))
    assert bath == RefractedLens.of(dry, RATIO)
    poses = wet.tracked_body_poses()[2]
    turns = np.degrees(
        np.arccos(np.clip(np.einsum("nij,ij->n", poses[:, :3, :3], poses[0, :3, :3]) / 2 - 0.5, -1, 1))
    )
    assert turns.max() > 5.0


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--medium", "beer"], "a medium must be"),
        (["--calibration", "--portal-mm", "50"], "do not apply"),
        (["--portal-mm", "1"], "portal must lie in"),
    ],
)
def test_mistakes_end_in_a_line(
    arguments: list[str], words: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    code: object
    try:
        code = main([str(tmp_path / "bag"), *arguments])
    except SystemExit as end:
        code = end.code
    assert code in (1, 2)
    assert words in capsys.readouterr().err

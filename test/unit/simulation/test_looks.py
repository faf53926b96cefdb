"""Looks: drawn from the seed, plain unless asked for, with exact truth."""

import numpy as np
import pytest

from knee_gap_core.bag.bag import BagReader
from knee_gap_simulation.errors import SimulationError
from knee_gap_simulation.knee.difficulty import Difficulty, conditions
from knee_gap_simulation.knee_simulator import KneeSimulator
from knee_gap_simulation.look_checks.compare_looks import main as compare
from knee_gap_simulation.looks.border import field_border
from knee_gap_simulation.looks.look import Appearance, Look
from knee_gap_simulation.looks.statistics import FEATURES, features, separability
from knee_gap_simulation.looks.video import tone
from knee_gap_simulation.make_bag.command import main
from knee_gap_simulation.recordings.scene_truth import scene_from_metadata
from knee_gap_simulation.scope.lens import Lens

EASY = conditions(Difficulty.at(0))
LOOKS = [Look.drawn(seed, EASY) for seed in range(150)]


def test_plain_is_the_default_and_leaves_no_trace():
    simulator = KneeSimulator(1, 17)
    assert simulator.look is None
    assert simulator.lens == Lens()
    assert "appearance" not in simulator.settings.as_dict()
    metadata = simulator.truth.as_metadata()["knee_gap_simulation"]
    assert not any(word in metadata for word in ("cut_", "rods", "heading"))


def test_the_same_seed_has_the_same_look_and_another_seed_another():
    again = Look.drawn(5, EASY)
    assert (again.head.colours == LOOKS[5].head.colours).all()
    assert again.border == LOOKS[5].border
    assert again.lens == LOOKS[5].lens
    assert len({look.tissues for look in LOOKS}) == len(LOOKS)


def test_looks_spread_over_what_scopes_show():
    blue = np.array([look.head.colours[0].sum() / look.head.colours[2].sum() for look in LOOKS])
    assert np.percentile(blue, 5) < 0.88
    assert np.percentile(blue, 95) > 1.12
    heights = np.array([look.border.notch_height for look in LOOKS])
    assert (heights > 0).any()
    assert (heights == 0).any()
    assert heights.min() < -0.10
    lenses = [look.lens for look in LOOKS]
    assert {lens.width_px / lens.height_px for lens in lenses} == {4 / 3, 16 / 9}
    cut = [lens.radius_px > 0.51 * lens.height_px for lens in lenses]
    zoomed = [lens.radius_px > 0.75 * lens.height_px for lens in lenses]
    assert 0.3 < np.mean(cut) < 0.6
    assert 0.05 < np.mean(zoomed) < 0.3
    assert any(lens.cut_top_px > 0 for lens in lenses)
    assert any(look.border.lines for look in LOOKS)


def test_a_cut_lens_shows_nothing_in_the_cut():
    lens = Lens(cut_top_px=40.0, cut_bottom_px=60.0)
    assert np.isnan(lens.bearings([[640.0, 39.0], [640.0, 660.0]])).all()
    rows = np.array([[640.0, 40.0], [640.0, 659.0]])
    np.testing.assert_allclose(lens.pixels(lens.bearings(rows)), rows, atol=1e-9)
    assert np.isnan(lens.pixels(Lens().bearings([640.0, 20.0]))).all()
    shown = lens.field_stop()[:, 640]
    assert (shown[:40] == 0).all()
    assert (shown[41:659] == 1).all()
    assert (shown[660:] == 0).all()


def test_notches_point_to_their_side_of_the_rim():
    for look in LOOKS[:14]:
        border, lens = field_border(look.lens, look), look.lens
        height = look.border.notch_height
        outside = border.stop[lens.field_stop() == 0.0]
        lost = lens.field_stop() - border.field
        assert (outside.max() > 0.0) <= (height < 0.0)
        assert (lost.max() > 0.5) <= (height > 0.0)
        assert (border.field <= border.stop).all()


def test_tone_clips_above_a_hard_shoulder_and_swallows_the_black():
    hard, soft = tone(0.95, 0.0), tone(0.5, 0.0)
    assert hard[2200] == 255
    assert soft[1500] < hard[1500]
    assert tone(0.5, 0.012)[20] == 0 < soft[20]
    assert (np.diff(hard.astype(int)) >= 0).all()


@pytest.fixture(scope="module")
def bag(tmp_path_factory):
    path = tmp_path_factory.mktemp("looks") / "bag"
    arguments = "--level 1 --seed 29 --appearance real --duration-s 0.1 --fps 10 --travel-mm 2"
    assert main([str(path), *arguments.split()]) == 0
    return path


def test_a_real_bag_restores_its_truth(bag):
    simulator = KneeSimulator(1, 29, appearance="real", duration_s=0.1, fps=10.0, travel=0.002)
    frame = next(simulator.frames(0, 1))
    with BagReader(bag) as reader:
        truth = scene_from_metadata(reader.metadata)
    assert truth.lens == simulator.lens
    assert truth.scene == simulator.scene
    mask = truth.gap_mask(frame.T_world_lens, frame.stamp_ns)
    # They may differ by the soft rim, the notch, and pixels that graze.
    assert mask.sum() > 1000
    assert (mask != frame.gap_mask).sum() < 0.02 * mask.sum()
    pixels = np.argwhere(frame.gap_mask)[::997, ::-1]
    points = simulator.points(frame, pixels)
    seen = simulator.follow(points, frame, edges=False)
    np.testing.assert_allclose(seen.pixels, pixels, atol=1e-6)
    assert simulator.nearest_distance == pytest.approx(simulator.settings.gap, abs=1e-8)
    assert features(frame.image).shape == (len(FEATURES),)


def test_appearances_are_named():
    with pytest.raises(SimulationError, match="appearance must be one of plain, real, not 'nice'"):
        KneeSimulator(0, 1, appearance="nice")


def test_a_board_has_no_look(tmp_path, capsys):
    assert main([str(tmp_path / "board"), "--calibration", "--appearance", "real"]) == 1
    assert "--calibration shows a board" in capsys.readouterr().err


def test_the_classifier_tells_different_pictures_apart_and_equal_ones_not():
    rng = np.random.default_rng(3)
    a, b = rng.standard_normal((2, 60, 5))
    assert abs(separability(a, b) - 0.5) < 0.12
    assert separability(a, b + 3.0) > 0.95


def test_features_follow_colour_and_light():
    picture = np.zeros((200, 300, 3), np.uint8)
    picture[20:180, 60:240] = (90, 120, 200)
    warm, bluish = features(picture), features(picture[..., ::-1])
    assert warm[0] == pytest.approx(0.55)
    assert bluish[0] == pytest.approx(-0.55)
    assert warm[7] == 0.0
    assert np.isnan(features(np.zeros((50, 50, 3), np.uint8))).all()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--count", "2"], "at least 8 renders"),
        (["--pictures", "{folder}"], "0 pictures with a field are too few"),
        (["--pictures", "{folder}/none.png"], "none.png"),
    ],
)
def test_bad_input_of_the_comparison_is_one_line(tmp_path, capsys, arguments, message):
    assert compare([argument.format(folder=tmp_path) for argument in arguments]) == 1
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1
    assert message in lines[0]


def test_appearance_is_a_plain_word():
    assert [str(appearance) for appearance in Appearance] == ["plain", "real"]

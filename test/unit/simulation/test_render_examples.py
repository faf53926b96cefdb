"""Rendered examples: pictures of reduced size whose labels say what each pixel shows."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from knee_gap_core.values.pixel_classes import UNKNOWN_CLASS, PixelClass
from knee_gap_simulation.knee_simulator import KneeSimulator
from knee_gap_simulation.render_examples import POSES, examples, labels_of, main
from knee_gap_simulation.scope.lens import Lens


def test_a_reduced_lens_shows_the_same_field() -> None:
    lens = Lens(cut_top_px=40.0)
    small = lens.reduced(2.0)
    assert (small.width_px, small.height_px) == (640, 360)
    assert small.field_of_view == lens.field_of_view
    bearings = lens.bearings([[640.5, 100.5], [900.5, 400.5]])
    np.testing.assert_allclose(small.bearings([[320.0, 50.0], [450.0, 200.0]]), bearings, atol=1e-9)
    assert np.isnan(small.bearings([[320.0, 19.0]])).all()


def test_labels_are_the_truth_of_the_frame() -> None:
    simulator = KneeSimulator(3, 21, appearance="real", reduction=3.0, workers=1)
    frame = next(simulator.frames(80, 81))
    labels = labels_of(frame, simulator.lens)
    assert labels.shape == frame.gap_mask.shape == frame.image.shape[:2]
    outside = labels == PixelClass.OUTSIDE
    assert (labels[frame.gap_mask & ~outside] != PixelClass.TISSUE).all()
    assert (labels[frame.instrument_mask & (frame.debris_cover <= 0.5) & ~outside] != PixelClass.TISSUE).all()
    assert set(np.unique(labels)) <= {*map(int, PixelClass), UNKNOWN_CLASS}
    assert (labels == PixelClass.TISSUE).mean() > 0.1


def test_the_same_seed_gives_the_same_examples() -> None:
    first, second = (list(examples([7], reduction=6.0)) for _ in range(2))
    assert len(first) == POSES
    for one, two in zip(first, second, strict=True):
        assert one.name == two.name
        assert (one.image == two.image).all()
        assert (one.labels == two.labels).all()


def test_the_command_writes_pictures_beside_their_labels(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    out = tmp_path / "renders"
    assert main([str(out), "--first-seed", "30", "--knees", "1"]) == 0
    pictures = sorted(out.glob("*.jpg"))
    assert len(pictures) == POSES
    for path in pictures:
        labels = cv2.imread(str(path.with_suffix(".png")), cv2.IMREAD_UNCHANGED)
        assert labels.shape == cv2.imread(str(path)).shape[:2]
    assert main([str(out)]) == 1
    assert "exists already" in capsys.readouterr().err
    assert main([str(tmp_path / "other"), "--knees", "0"]) == 1
    assert "at least one knee" in capsys.readouterr().err

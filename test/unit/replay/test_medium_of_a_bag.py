"""A simulated scope, calibrated in air, measures in saline and turns about its portal: bounds hold."""

from pathlib import Path

import numpy as np
import pytest

from knee_gap_replay import process
from knee_gap_replay.report.comparison import Comparison, compare
from knee_gap_simulation.make_bag.command import Recording, make_bag

pytestmark = pytest.mark.timeout(900)  # 67 images are rendered


@pytest.fixture(scope="module")
def wet(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Rims in saline, seen by a scope whose camera_info has the angles in air."""
    bag = tmp_path_factory.mktemp("wet") / "bag"
    recording = Recording(
        seed=21, duration_s=2.8, fps=24.0, travel=0.006, depth=0.011, calibrated_in="air", portal=0.040
    )
    make_bag(bag, recording, progress=False)
    return bag


def measured(bag: Path, out: Path, old: str = "", new: str = "") -> Comparison:
    """What `process` makes of the bag, with a change in its parameters."""
    text = (bag / "scope.yaml").read_text()
    assert old in text
    out.with_suffix(".yaml").write_text(text.replace(old, new) if old else text)
    assert process.main([str(bag), str(out), "--params-file", str(out.with_suffix(".yaml"))]) == 0
    return compare(bag, out)


def bias(found: Comparison) -> float:
    """Median error of the points' distance in valid estimates, relative to the truth [-]."""
    return float(np.median((found.point_distance / found.point_truth - 1.0)[found.valid]))


def test_the_conversion_takes_the_bias_and_its_bounds_hold(wet: Path, tmp_path: Path) -> None:
    with_it = measured(wet, tmp_path / "with")
    assert with_it.valid.sum() > 10
    assert abs(bias(with_it)) < 0.015
    assert with_it.inside == 1.0
    held = (with_it.confidence_min <= with_it.truth) & (with_it.truth <= with_it.confidence_max)
    assert held[with_it.valid].mean() > 0.9
    # As if the angles were those of saline already.
    without = measured(wet, tmp_path / "without", "camera_info_medium: air", "camera_info_medium: saline")
    assert bias(without) < -0.04


def test_nodes_that_disagree_and_unknown_media_are_refused(
    wet: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text = (wet / "scope.yaml").read_text()
    for changed, words in (
        (text.replace("medium: saline", "medium: water", 1), "medium must be the same"),
        (text.replace("medium: saline", "medium: beer"), "medium must be air, saline, water"),
    ):
        (tmp_path / "wrong.yaml").write_text(changed)
        assert (
            process.main([str(wet), str(tmp_path / "o"), "--params-file", str(tmp_path / "wrong.yaml")]) == 1
        )
        error = capsys.readouterr().err
        assert error.count("\n") == 1
        assert words in error

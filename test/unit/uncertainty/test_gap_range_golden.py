"""gap_range and the error clouds against values of an independent program (in millimetres)."""

import json
from pathlib import Path

import numpy as np
import pytest

from knee_gap_uncertainty.two_view.error_cloud import error_clouds
from knee_gap_uncertainty.two_view.gap_range import gap_range
from knee_gap_uncertainty.two_view.triangulation import triangulate
from knee_gap_uncertainty.two_view.two_views import two_views

GOLDEN = Path(__file__).parents[2] / "data" / "error_cloud.json"
APEX = {"first": "b_from_A0", "second": "a_from_A1"}
SIGNS = {"paper": "none", "worst_case": "all"}


def golden():
    return json.loads(GOLDEN.read_text())["configs"]


def views_of(config):
    lenses = (np.array(config[name]) / 1e3 for name in ("A0", "A1"))
    return *lenses, config["b_hat"], config["a_hat"]


def errors_of(config):
    return {
        "angular_error": config["psi_rad"],
        "translation_error": config["dT_mm"] / 1e3,
        "radii": len(config["radii_mm"]),
    }


@pytest.mark.parametrize("interval", SIGNS)
@pytest.mark.parametrize("apex", APEX)
def test_every_config_to_a_nanometre(interval, apex):
    for config in golden():
        expected = config["cloud"][SIGNS[interval]][APEX[apex]]
        found = gap_range(*views_of(config), **errors_of(config), interval=interval, apex=apex)
        assert found.gap == pytest.approx(config["d"] / 1e3, abs=1e-9)
        assert found.gap_min == pytest.approx(expected["d_min"] / 1e3, abs=1e-9)
        assert found.gap_max == pytest.approx(expected["d_max"] / 1e3, abs=1e-9)
        assert found.snr == pytest.approx(expected["snr"], abs=1e-8)


@pytest.mark.parametrize("interval", SIGNS)
def test_best_takes_the_apex_with_the_higher_ratio(interval):
    for config in golden():
        expected = max(config["cloud"][SIGNS[interval]].values(), key=lambda apex: apex["snr"])
        found = gap_range(*views_of(config), **errors_of(config), interval=interval, apex="best")
        assert found.gap_min == pytest.approx(expected["d_min"] / 1e3, abs=1e-9)
        assert found.gap_max == pytest.approx(expected["d_max"] / 1e3, abs=1e-9)


@pytest.mark.parametrize("signs", ["none", "same", "opposite", "all"])
@pytest.mark.parametrize("apex", APEX)
def test_clouds_of_every_choice_of_signs(signs, apex):
    for config in golden():
        if len(config["radii_mm"]) > 1:
            continue
        one, other = error_clouds(two_views(*views_of(config)), **errors_of(config), signs=signs, apex=apex)
        squared = (one**2).sum(1)[:, None] + (other**2).sum(1) - 2 * one @ other.T
        expected = config["cloud"][signs][APEX[apex]]
        assert np.sqrt(squared.min()) == pytest.approx(expected["d_min"] / 1e3, abs=1e-9)
        assert np.sqrt(squared.max()) == pytest.approx(expected["d_max"] / 1e3, abs=1e-9)


def test_triangulation_of_rays_that_do_not_meet():
    for config in golden():
        noisy = config["noisy_triangulation"]
        lens_0, lens_1, _, _ = views_of(config)
        found = triangulate(
            two_views(lens_0, lens_1, [p["b_hat"] for p in noisy], [p["a_hat"] for p in noisy])
        )
        for n, point in enumerate(noisy):
            assert found.alpha[n] == pytest.approx(point["alpha"], abs=1e-12)
            assert found.beta[n] == pytest.approx(point["beta"], abs=1e-12)
            assert found.gamma[n] == pytest.approx(point["gamma"], abs=1e-12)
            np.testing.assert_allclose(found.points_first[n], np.array(point["G_eq2"]) / 1e3, atol=1e-12)
            np.testing.assert_allclose(found.points_second[n], np.array(point["G_eq1"]) / 1e3, atol=1e-12)

"""Where no honest range exists: each case refused by its name, with the value in the message."""

import math

import numpy as np
import pytest
from vectors import unit

from knee_gap_core.values.errors import (
    BadInputError,
    BaselineTooShortError,
    CheiralityError,
    EpipoleError,
    MeasurementError,
    UnderconstrainedError,
)
from knee_gap_uncertainty.two_view.error_cloud import error_clouds
from knee_gap_uncertainty.two_view.gap_range import gap_range
from knee_gap_uncertainty.two_view.two_views import two_views

DEPTH = 0.010
ERRORS = {"angular_error": math.radians(2.364), "translation_error": 0.0367e-3}


def look(points, travel):
    """Views of the points from the origin and from `travel`."""
    travel = np.asarray(travel, dtype=float)
    points = np.asarray(points, dtype=float)
    return {
        "lens_0": np.zeros(3),
        "lens_1": travel,
        "bearings_0": unit(points),
        "bearings_1": unit(points - travel),
    }


def across(gap, depth=DEPTH):
    return [[0.0, -gap / 2, depth], [0.0, gap / 2, depth]]


GOOD = look(across(0.004), [0.005, 0.0, 0.0])


def test_the_good_case_is_good():
    found = gap_range(**GOOD, **ERRORS)
    assert 0 < found.gap_min < 0.004 < found.gap_max < 0.01


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"lens_0": [0.0, math.nan, 0.0]}, r"lens_0 must be finite"),
        ({"lens_1": [math.inf, 0.0, 0.0]}, r"lens_1 must be finite"),
        ({"lens_0": [1e300, 0.0, 0.0], "lens_1": [-1e300, 0.0, 0.0]}, r"finite distance apart"),
        ({"lens_0": [0.0, 0.0]}, r"lens_0 must have shape \(3,\), got \(2,\)"),
        ({"bearings_0": np.zeros((2, 3))}, r"bearings_0\[0\] must be a unit vector.*length is 0"),
        ({"bearings_1": 1.01 * GOOD["bearings_1"]}, r"bearings_1\[0\] must be a unit vector.*1\.01"),
        ({"bearings_1": [GOOD["bearings_1"][0], [math.nan] * 3]}, r"bearings_1 must be finite"),
        ({"bearings_0": GOOD["bearings_0"][:1]}, r"bearings_0 must have shape \(2, 3\)"),
        ({"bearings_0": "straight ahead"}, r"bearings_0 must be numbers"),
        ({"bearings_0": None}, r"bearings_0 must"),
        ({"angular_error": -0.01}, r"angular_error must be finite and not negative \[rad\], got -0.01"),
        ({"angular_error": math.nan}, r"angular_error must be finite"),
        ({"angular_error": 2.36}, r"angular_error must be below pi/2 rad, got 2.36"),
        ({"angular_error": "wide"}, r"angular_error must be a number"),
        ({"translation_error": -1e-5}, r"translation_error must be finite and not negative \[m\]"),
        ({"translation_error": math.inf}, r"translation_error must be finite"),
        ({"translation_error": None}, r"translation_error must be a number"),
        ({"interval": "narrow"}, r"interval must be one of worst_case, paper, got 'narrow'"),
        ({"apex": "third"}, r"apex must be one of first, second, best, got 'third'"),
        ({"radii": 0}, r"radii must be a whole number from 1 to 30, got 0"),
        ({"radii": 31}, r"radii must be a whole number from 1 to 30, got 31"),
        ({"radii": 1.5}, r"radii must be a whole number"),
        ({"radii": True}, r"radii must be a whole number"),
    ],
)
def test_bad_input_says_which_value_and_which_rule(changes, words):
    with pytest.raises(BadInputError, match=words):
        gap_range(**GOOD | ERRORS | changes)


def test_rounding_of_single_precision_is_not_bad_input():
    single = {name: np.asarray(value, dtype=np.float32) for name, value in GOOD.items()}
    assert gap_range(**single, **ERRORS) == pytest.approx(gap_range(**GOOD, **ERRORS), rel=1e-5)


def test_equal_lens_positions():
    with pytest.raises(BaselineTooShortError, match="lens_0 and lens_1 are equal"):
        gap_range(**GOOD | {"lens_1": GOOD["lens_0"]}, **ERRORS)


@pytest.mark.parametrize("interval", ["paper", "worst_case"])
def test_travel_within_twice_the_translation_error(interval):
    with pytest.raises(BaselineTooShortError, match=r"\|t\| = 0\.005 m, 2 DT = 0\.005 m"):
        gap_range(**GOOD | ERRORS | {"translation_error": 0.0025}, interval=interval)
    with pytest.raises(BaselineTooShortError):
        gap_range(**GOOD | ERRORS | {"translation_error": 1e6}, interval=interval)


@pytest.mark.parametrize("interval", ["paper", "worst_case"])
@pytest.mark.parametrize("apex", ["first", "second", "best"])
def test_a_point_on_the_line_of_travel(interval, apex):
    ahead = look([[0.0, 0.0, DEPTH], [0.0, 0.004, DEPTH]], [0.0, 0.0, 0.005])
    with pytest.raises(EpipoleError, match="point 0 lies along the travel"):
        gap_range(**ahead, **ERRORS, interval=interval, apex=apex)


@pytest.mark.parametrize("apex", ["first", "second"])
def test_a_bearing_that_the_error_turns_into_the_travel(apex):
    """One degree beside the travel, an error of two: refused, unless no sign of psi is admitted."""
    beside = DEPTH * math.tan(math.radians(1))
    nearly = look([[0.0, beside, DEPTH], [0.0, 0.004, DEPTH]], [0.0, 0.0, 0.0099])
    with pytest.raises(EpipoleError, match="less the angular error"):
        gap_range(**nearly, **ERRORS, apex=apex)
    assert math.isfinite(gap_range(**nearly, **ERRORS, apex=apex, interval="paper").gap_max)
    with pytest.raises(EpipoleError):
        error_clouds(two_views(**nearly), **ERRORS, signs="opposite", apex=apex)


def test_a_bearing_at_exactly_the_error_beside_the_travel():
    """The perturbed angle is zero, and so is the ray: refused before anything is divided by it."""
    nearly = look([[0.0, 0.001, DEPTH], [0.0, 0.004, DEPTH]], [0.0, 0.0, 0.009])
    alpha = math.atan2(0.001, DEPTH)
    for error in (alpha, np.nextafter(alpha, 0), np.nextafter(alpha, 1), alpha - 1e-12, alpha + 1e-12):
        with pytest.raises(EpipoleError):
            gap_range(**nearly, angular_error=error, translation_error=0.0, apex="best")


def test_a_choice_of_signs_that_is_none():
    with pytest.raises(BadInputError, match="signs must be one of none, same, opposite, all"):
        error_clouds(two_views(**GOOD), **ERRORS, signs="both")


@pytest.mark.parametrize("interval", ["paper", "worst_case"])
def test_rays_that_meet_behind(interval):
    swapped = GOOD | {"lens_0": GOOD["lens_1"], "lens_1": GOOD["lens_0"]}
    with pytest.raises(CheiralityError, match="point 0 must meet in front of both lenses"):
        gap_range(**swapped, **ERRORS, interval=interval)


def test_rays_on_opposite_sides_of_the_travel():
    """Their angles to the travel make a fair triangle, but the rays lead away from each other."""
    mirrored = GOOD | {"bearings_1": GOOD["bearings_1"] * [1.0, 1.0, -1.0]}
    with pytest.raises(CheiralityError):
        gap_range(**mirrored, **ERRORS)


def test_points_at_infinity():
    with pytest.raises(UnderconstrainedError, match="point 0 are parallel: the point is at infinity"):
        gap_range(**GOOD | {"bearings_1": GOOD["bearings_0"]}, **ERRORS)


def test_every_refusal_is_a_measurement_error():
    for name in (
        BadInputError,
        BaselineTooShortError,
        EpipoleError,
        CheiralityError,
        UnderconstrainedError,
    ):
        assert issubclass(name, MeasurementError)
        assert issubclass(name, ValueError)


@pytest.mark.parametrize("apex", ["first", "second", "best"])
def test_parallax_within_twice_the_error_is_unbounded(apex):
    """2 psi is 4.73 deg: at 0.6 mm of travel 10 mm away the parallax is 3.4 deg, at 2 mm 11."""
    short = gap_range(**look(across(0.004), [0.0006, 0.0, 0.0]), **ERRORS, apex=apex)
    assert short.gap_max == math.inf
    assert short.snr == 0
    assert 0 < short.gap_min < 0.004
    longer = gap_range(**look(across(0.004), [0.002, 0.0, 0.0]), **ERRORS, apex=apex)
    assert math.isfinite(longer.gap_max)
    assert longer.snr > 0
    assert longer.gap_min > short.gap_min


def test_the_paper_s_interval_does_not_see_it():
    short = look(across(0.004), [0.0006, 0.0, 0.0])
    assert math.isfinite(gap_range(**short, **ERRORS, interval="paper").gap_max)


@pytest.mark.parametrize("interval", ["paper", "worst_case"])
@pytest.mark.parametrize("apex", ["first", "second", "best"])
def test_clouds_that_overlap_leave_no_gap(interval, apex):
    """Half a millimetre at 10 mm, each point known to 0.4 mm: the two may be one."""
    found = gap_range(**look(across(0.0005), [0.005, 0.0, 0.0]), **ERRORS, interval=interval, apex=apex)
    assert found.gap_min == 0
    assert found.gap_max > 0.0005
    assert found.snr == pytest.approx(found.gap / found.gap_max)


def test_one_point_behind_the_other_within_its_error_leaves_no_gap():
    found = gap_range(**look([[0, 0, DEPTH], [0, 0, DEPTH + 0.002]], [0.005, 0.0, 0.0]), **ERRORS)
    assert found.gap_min == 0


def test_unbounded_clouds_that_meet_far_away_leave_no_gap():
    """Only the nearer parts are drawn, and they are apart; the cones of both rays meet beyond them."""
    view = look([[0.0, 0.0, 0.010], [0.0, 0.0005, 0.030]], [0.0008, 0.0, 0.0])
    found = gap_range(**view, **ERRORS)
    assert (found.gap_min, found.gap_max, found.snr) == (0, math.inf, 0)


def test_the_same_point_twice():
    found = gap_range(**look([[0, 0, DEPTH]] * 2, [0.005, 0.0, 0.0]), **ERRORS)
    assert found.gap == 0
    assert found.gap_min == 0
    assert found.snr == 0

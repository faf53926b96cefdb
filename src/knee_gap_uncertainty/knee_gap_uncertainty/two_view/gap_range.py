"""The gap from two views, the least and greatest value that admitted errors allow, and the ratio (26)."""

import math
from typing import Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from knee_gap_core.compiled import compiled
from knee_gap_core.values.errors import BadInputError, BaselineTooShortError
from knee_gap_uncertainty.numerics.vectors import norm, row, subtract, vector
from knee_gap_uncertainty.two_view.angle_sets import INTERVAL_SIGNS, SIGNS, Interval
from knee_gap_uncertainty.two_view.cone_volume import ConeVolume, volume_distance
from knee_gap_uncertainty.two_view.convex_distance import hulls_meet
from knee_gap_uncertainty.two_view.error_cloud import refuse_parallel, trace_cloud
from knee_gap_uncertainty.two_view.extremes import extremes
from knee_gap_uncertainty.two_view.slices import slice_spokes
from knee_gap_uncertainty.two_view.translation_volume import displacements
from knee_gap_uncertainty.two_view.triangulation import SMALLEST_ANGLE, Triangulation, triangulate
from knee_gap_uncertainty.two_view.two_views import TwoViews, two_views

LARGEST_ANGULAR_ERROR = math.pi / 2
# The clouds grow with the square of the radii: 30 hold four million points each.
MOST_RADII = 30
# Where the volumes that worst-case clouds sample come nearer than this share of the least distance of the
# samples, the rings are too wide beside the gap for eight points each to bound it from below, and the
# distance of the volumes does. Above it no simulated error passes between the samples
# (`docs/results/coverage.md`), and they stand, so that the number is the one that the paper's equations give.
SPARSE = 0.82
# The same between the clouds of one lens and of the other.
FAR_NEARER = 0.5


class GapRange(NamedTuple):
    """A gap [m] with its bounds [m] and its signal-to-noise ratio gap / (gap_max - gap_min), (26).

    `gap_max` is infinite, and `snr` zero, where the admitted errors let a point lie at infinity; `gap_min` is
    zero where the clouds of the two points overlap, and in the worst case the distance of the volumes that
    they sample where that is less than 0.82 of the least distance of the samples. Without any error the
    bounds are the gap and `snr` is infinite.
    """

    gap: float
    gap_min: float
    gap_max: float
    snr: float


def gap_range(
    lens_0: npt.ArrayLike,
    lens_1: npt.ArrayLike,
    bearings_0: npt.ArrayLike,
    bearings_1: npt.ArrayLike,
    *,
    angular_error: float,
    translation_error: float,
    interval: Interval = "worst_case",
    apex: Literal["first", "second", "best"] = "first",
    radii: int = 1,
) -> GapRange:
    """Gap between two points seen from two lens positions, with bounds.

    `lens_0`, `lens_1`: positions (3,) [m]; `bearings_0`, `bearings_1`: unit vectors (2, 3) from each to G0
    and G1, all in one frame. `angular_error` psi = theta + omega [rad] and `translation_error` Delta T [m]
    bound the errors of each bearing and of each position. `interval`: "worst_case" admits every sign in (17)
    and (18), "paper" none, as Table 4. `apex`: clouds of the rays of the "first" lens, the "second", or the
    "best" of both, which has the higher ratio; in the worst case the other still bounds the gap from below
    where it comes far lower. `radii`: displacements of the lens in so many equal steps up to the translation
    error; 1 is the outer shell.

    Raises BadInputError, BaselineTooShortError, EpipoleError, CheiralityError or UnderconstrainedError,
    all of them MeasurementError, where no honest range exists.
    """
    return gap_range_and_points(
        (lens_0, lens_1),
        (bearings_0, bearings_1),
        angular_error=angular_error,
        translation_error=translation_error,
        interval=interval,
        apex=apex,
        radii=radii,
    )[0]


def gap_range_and_points(
    lenses: tuple[npt.ArrayLike, npt.ArrayLike],
    bearings: tuple[npt.ArrayLike, npt.ArrayLike],
    *,
    angular_error: float,
    translation_error: float,
    interval: Interval = "worst_case",
    apex: Literal["first", "second", "best"] = "first",
    radii: int = 1,
) -> tuple[GapRange, Triangulation]:
    """As `gap_range`, with the points that it is about."""
    signs = checked_choices(interval, apex, radii)
    psi = checked_error("angular_error", angular_error, "rad")
    if psi >= LARGEST_ANGULAR_ERROR:
        raise BadInputError(f"angular_error must be below pi/2 rad, got {psi:g}: a wider cone is no bearing")
    shift = checked_error("translation_error", translation_error, "m")
    views = two_views(*lenses, *bearings)
    if 2 * shift >= views.baseline:
        raise BaselineTooShortError(
            f"the travel must exceed twice the translation error: "
            f"|t| = {views.baseline:.6g} m, 2 DT = {2 * shift:.6g} m"
        )
    points = triangulate(views)
    shifts = displacements(shift, radii)
    ranges = []
    if apex != "second":
        ranges.append(range_from_apex(points.points_first, views, psi, shifts, signs))
    if apex != "first":
        ranges.append(range_from_apex(points.points_second, reversed_views(views), psi, shifts, signs))
    best = max(ranges, key=lambda found: (found.snr, found.gap_min))
    lowest = min(found.gap_min for found in ranges)
    if interval == "worst_case" and lowest < FAR_NEARER * best.gap_min:
        best = ranged(best.gap, lowest, best.gap_max)
    return best, points


def range_from_apex(
    points: npt.NDArray[np.float64],
    views: TwoViews,
    angular_error: float,
    shifts: npt.NDArray[np.float64],
    signs: npt.NDArray[np.float64],
) -> GapRange:
    """Range of the gap between `points` (2, 3) [m] by the clouds of the rays of the first lens of `views`."""
    gap = float(np.linalg.norm(points[1] - points[0]))
    if angular_error == 0 and not shifts.any():
        return GapRange(gap, gap, gap, math.inf)
    # With axes along the gap a box reaches along it no farther than its points: more boxes are skipped.
    turn = axes_along(points[1] - points[0])
    gap_min, gap_max, smallest_angle = cloud_range(
        turn @ views.travel,
        views.bearings_0 @ turn.T,
        views.bearings_1 @ turn.T,
        angular_error,
        shifts @ turn.T,
        signs,
    )
    refuse_parallel(smallest_angle)
    return ranged(gap, gap_min, gap_max)


def axes_along(direction: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Right-handed axes (3, 3), in rows, the first along `direction` (3,); any axes where it is zero."""
    length = float(np.linalg.norm(direction))
    if not length > 0:
        return np.eye(3)
    first = direction / length
    second = np.cross(np.eye(3)[np.argmin(np.abs(first))], first)
    second /= np.linalg.norm(second)
    return np.stack([first, second, np.cross(first, second)])


def ranged(gap: float, gap_min: float, gap_max: float) -> GapRange:
    """The range with its signal-to-noise ratio (26)."""
    width = gap_max - gap_min
    return GapRange(gap, gap_min, gap_max, gap / width if width > 0 else math.inf)


@compiled
def cloud_range(
    travel: npt.NDArray[np.float64],
    own: npt.NDArray[np.float64],
    other: npt.NDArray[np.float64],
    angular_error: float,
    shifts: npt.NDArray[np.float64],
    signs: npt.NDArray[np.float64],
) -> tuple[float, float, float]:
    """Least and greatest distance of the clouds of both points [m], least angle of all triangles [rad].

    `travel` (3,) leads from the lens with the bearings `own` (2, 3) to the one with `other` (2, 3).
    """
    t = vector(travel)
    cloud_0 = trace_cloud(t, row(own, 0), row(other, 0), angular_error, shifts, signs)
    cloud_1 = trace_cloud(t, row(own, 1), row(other, 1), angular_error, shifts, signs)
    smallest_angle = min(cloud_0.smallest_angle, cloud_1.smallest_angle)
    if not smallest_angle > SMALLEST_ANGLE:
        return math.nan, math.nan, smallest_angle
    sliced_0 = slice_spokes(cloud_0.points, cloud_0.starts)
    sliced_1 = slice_spokes(cloud_1.points, cloud_1.starts)
    nearest, farthest = extremes(sliced_0, sliced_1)
    if signs.shape[0] > 1:
        # All lenses of a cloud's shifts are as far from the middle, up to the outer shell.
        blur = norm(row(shifts, shifts.shape[0] - 1))
        between = volume_distance(
            ConeVolume(row(own, 0), cloud_0.shortest, cloud_0.longest, angular_error, blur),
            ConeVolume(row(own, 1), cloud_1.shortest, cloud_1.longest, angular_error, blur),
        )
        if between < SPARSE * nearest:
            nearest = between
    elif hulls_meet(sliced_0, cloud_0.far, sliced_1, cloud_1.far, subtract(row(own, 0), row(own, 1))):
        nearest = 0.0
    if cloud_0.far.size + cloud_1.far.size > 0:
        farthest = math.inf
    return nearest, farthest, smallest_angle


def reversed_views(views: TwoViews) -> TwoViews:
    """The same views, the second first."""
    return TwoViews(views.lens_1, views.lens_0, views.bearings_1, views.bearings_0)


def checked_error(name: str, value: float, unit: str) -> float:
    """The error as a float that is finite and not negative; raises BadInputError with the value otherwise."""
    try:
        number = float(value)
    except (TypeError, ValueError):
        raise BadInputError(f"{name} must be a number [{unit}], got {value!r}") from None
    if not (math.isfinite(number) and number >= 0):
        raise BadInputError(f"{name} must be finite and not negative [{unit}], got {number!r}")
    return number


def checked_choices(interval: str, apex: str, radii: int) -> npt.NDArray[np.float64]:
    """Rows of signs of the interval; BadInputError for a name or number that is not a choice."""
    if interval not in INTERVAL_SIGNS:
        raise BadInputError(f"interval must be one of {', '.join(INTERVAL_SIGNS)}, got {interval!r}")
    if apex not in ("first", "second", "best"):
        raise BadInputError(f"apex must be one of first, second, best, got {apex!r}")
    if isinstance(radii, bool) or not isinstance(radii, int | np.integer) or not 1 <= radii <= MOST_RADII:
        raise BadInputError(f"radii must be a whole number from 1 to {MOST_RADII}, got {radii!r}")
    return SIGNS[INTERVAL_SIGNS[interval]]


def warm_up() -> None:
    """Compile, or load from disk, all that `gap_range` runs, so that the first image is not late."""
    gap_range(
        (0.0, 0.0, 0.0),
        (0.003, 0.0, 0.0),
        ((0.0, 0.0, 1.0), (0.0, 0.6, 0.8)),
        (
            (-0.28734788556634544, 0.0, 0.9578262852211514),
            (-0.28734788556634544, 0.574695771132691, 0.7662610281769211),
        ),
        angular_error=0.01,
        translation_error=1e-5,
        apex="best",
    )

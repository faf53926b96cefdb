"""Sensitivity of the length of a ray to errors: exactly (8), linearised (11), and against the truth (12).

L is the length of the ray from one lens: |t| sin(other angle) / sin(own angle + other angle). The paper's
(7)-(11) write sin alpha for |b|; by (2) it is sin beta, the angle at the other lens, and that is what stands
here. The error clouds use (8); (11) is there for comparison.
"""

import math

from knee_gap_uncertainty.two_view.triangulation import ray_length


def length_change(
    travel: float,
    own_angle: float,
    other_angle: float,
    *,
    travel_change: float = 0.0,
    own_change: float = 0.0,
    other_change: float = 0.0,
) -> float:
    """Exact Delta L = L' - L [m] for changes of the travel [m] and of the two angles [rad], (8)."""
    changed: float = ray_length(travel + travel_change, own_angle + own_change, other_angle + other_change)
    return changed - float(ray_length(travel, own_angle, other_angle))


def length_change_linear(
    travel: float,
    own_angle: float,
    other_angle: float,
    *,
    travel_change: float = 0.0,
    own_change: float = 0.0,
    other_change: float = 0.0,
) -> float:
    """Linearised Delta L [m], (11) with Delta gamma = -(Delta alpha + Delta beta) and the cosines kept.

    (9) replaces Delta alpha cos alpha by Delta alpha and cos gamma by 1 for a bound; with them it is the
    derivative of (8), so that the two agree to first order.
    """
    gamma = math.pi - own_angle - other_angle
    gamma_change = -(own_change + other_change)
    by_angles = (
        math.cos(other_angle) * other_change / math.sin(gamma)
        - math.sin(other_angle) * math.cos(gamma) * gamma_change / math.sin(gamma) ** 2
    )
    return travel * by_angles + travel_change * math.sin(other_angle) / math.sin(gamma)


def length_bound_linear(
    travel: float,
    own_angle: float,
    other_angle: float,
    *,
    travel_change: float = 0.0,
    own_change: float = 0.0,
    other_change: float = 0.0,
) -> float:
    """The paper's own (11) [m], cosines set to 1: meant as a bound of Delta L for small changes."""
    gamma = math.pi - own_angle - other_angle
    gamma_change = -(own_change + other_change)
    by_angles = other_change / math.sin(gamma) - gamma_change * math.sin(other_angle) / math.sin(gamma) ** 2
    return travel * by_angles + travel_change * math.sin(other_angle) / math.sin(gamma)


def length_error(true_length: float, length: float, change: float) -> float:
    """What is left of the truth: L_error = L_GT - (L + Delta L) [m], (12)."""
    return true_length - (length + change)

"""Messages as nobody should send them: numbers of every kind, in every field, in any order of stamps."""

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st

# The same examples in every run, and no data base beside the tests.
SETTINGS = settings(
    max_examples=40,
    derandomize=True,
    deadline=None,
    database=None,
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large, HealthCheck.filter_too_much],
)

BEGIN = 1_000_000_000  # [s]
EXTREME = [
    0.0, -0.0, 5e-324, -1e-310, 2.2e-308, 1e-160, 1e-20, 1e8, 1e20, 1e155, -1e160, 1.7976931348623157e308,
    -1.7976931348623157e308, float("nan"), float("inf"), float("-inf"),
]  # fmt: skip
extremes = st.sampled_from(EXTREME)
numbers = st.one_of(extremes, st.floats(width=64), st.floats(-1.0, 1.0))
names = st.sampled_from(["world", "arthroscope_optical", "femur", "", "ü" * 40, "/a b"])
# Mostly in order, some repeated, some long ago or far ahead, some no time at all.
ODD_STEPS = [0, 1, 40_000_000, 700_000_000, -8_333_333, -(10**12), 10**13, -2 * 10**18]
steps_ns = st.sampled_from([8_333_333] * 6 + ODD_STEPS)


def stamps(steps: list[int]) -> list[int]:
    """Stamps [ns] from their steps."""
    return [BEGIN * 10**9 + int(total) for total in np.cumsum(steps)]


def header(stamp_ns: int, frame_id: str = "world", excess: int = 0) -> Any:
    seconds, nanoseconds = divmod(stamp_ns, 10**9)
    seconds = min(max(seconds, -(2**31)), 2**31 - 1)
    stamp = SimpleNamespace(sec=seconds, nanosec=min(nanoseconds + excess, 2**32 - 1))
    return SimpleNamespace(stamp=stamp, frame_id=frame_id)


def vector(values: Any, names: str = "xyz") -> Any:
    return SimpleNamespace(**{name: float(value) for name, value in zip(names, values, strict=True)})


def hurt(draw: Callable[..., Any], values: Any, share: int = 4) -> np.ndarray:
    """The values, in one of `share` cases with one or all of them replaced by any number."""
    hurt = np.array(values, dtype=np.float64)
    how = draw(st.integers(0, 2 * share))
    if how == 0:
        hurt.flat[draw(st.integers(0, hurt.size - 1))] = draw(numbers)
    elif how == 1:
        hurt.flat[:] = draw(extremes)
    elif how == 2 and hurt.size:
        hurt.flat[:] = hurt.flat[:] * draw(st.sampled_from([1e-200, 1e-3, 1e3, 1e200]))
    return hurt


@st.composite
def poses(draw: Any, stamp_ns: int, covered: bool = True) -> Any:
    """A PoseWithCovarianceStamped, or a PoseStamped, most often of a scope in a hand."""
    position = hurt(draw, np.array([1e-5, 0.0, 0.0]) * (stamp_ns % 10**9) / 1e7)
    angle = draw(st.sampled_from([0.0, 0.01, 3.0]))
    quaternion = hurt(draw, [np.sin(angle / 2), 0.0, 0.0, np.cos(angle / 2)])
    excess = draw(st.sampled_from([0] * 9 + [3 * 10**9]))
    frame = draw(st.sampled_from(["world"] * 8 + ["femur", ""]))
    pose = SimpleNamespace(position=vector(position), orientation=vector(quaternion, "xyzw"))
    if not covered:
        return SimpleNamespace(header=header(stamp_ns, frame, excess), pose=pose)
    covariance = hurt(draw, np.diag([4.5e-10] * 3 + [1.6e-9] * 3).ravel())
    return SimpleNamespace(
        header=header(stamp_ns, frame, excess), pose=SimpleNamespace(pose=pose, covariance=covariance)
    )


@st.composite
def sequences(draw: Any, kind: Any, longest: int = 30) -> list[tuple[int, Any]]:
    """Stamps [ns] and what `kind(stamp_ns)` draws at each."""
    steps = draw(st.lists(steps_ns, min_size=1, max_size=longest))
    return [(stamp, draw(kind(stamp))) for stamp in stamps(steps)]

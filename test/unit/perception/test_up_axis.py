import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from knee_gap_perception.errors import PerceptionError
from knee_gap_perception.trackers.up_axis import position_z_up, quaternion_z_up

rng = np.random.default_rng(8)


def test_up_becomes_up_and_the_ground_stays_the_ground():
    np.testing.assert_array_equal(position_z_up([0.0, 1.0, 0.0], "y"), [0.0, 0.0, 1.0])
    x, y, z = (position_z_up(axis, "y") for axis in np.eye(3))
    np.testing.assert_array_equal(np.cross(x, y), z)  # still right-handed


def test_rotations_turn_with_the_positions():
    """Points that a body carries come to the same place, whether turned before or after."""
    body, place, turn = rng.normal(size=(5, 3)), rng.normal(size=3), Rotation.random(random_state=1)
    carried = position_z_up(turn.apply(body) + place, "y")
    turned = Rotation.from_quat(quaternion_z_up(turn.as_quat(), "y"))
    np.testing.assert_allclose(turned.apply(position_z_up(body, "y")) + position_z_up(place, "y"), carried)


def test_a_turn_about_up_stays_one():
    about_y = Rotation.from_rotvec([0.0, 0.3, 0.0]).as_quat()
    rotvec = Rotation.from_quat(quaternion_z_up(about_y, "y")).as_rotvec()
    np.testing.assert_allclose(rotvec, [0.0, 0.0, 0.3])


def test_z_up_is_left_alone():
    positions, quaternions = rng.normal(size=(4, 3)), Rotation.random(4, random_state=2).as_quat()
    np.testing.assert_array_equal(position_z_up(positions, "z"), positions)
    np.testing.assert_array_equal(quaternion_z_up(quaternions, "z"), quaternions)


def test_another_axis_is_refused():
    with pytest.raises(PerceptionError, match="must be one of y, z, not 'x'"):
        position_z_up([0.0, 0.0, 0.0], "x")

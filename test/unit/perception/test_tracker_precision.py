from math import radians

import numpy as np
import pytest
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore
from scipy.spatial.transform import Rotation

from knee_gap_perception.errors import PerceptionError
from knee_gap_perception.tracker_precision.command import main
from knee_gap_perception.tracker_precision.precision import PoseSeries, pooled, tracker_precision

RATE = 120.0
DT, OMEGA = 0.0367e-3, radians(0.004)


def recording(seed, *, rest=4.0, motion=8.0, correlation=0.0, scale=1.0, tremor=0.05e-3):
    """A body put down, carried about by a hand, and put down again, as a tracker of known error sees it."""
    rng = np.random.default_rng(seed)
    count = int((2 * rest + motion) * RATE)
    time = np.arange(count) / RATE
    carried = (time > rest) & (time < rest + motion)
    grip = np.where(carried, np.sin(np.pi * np.clip((time - rest) / motion, 0, 1)) ** 2, 0.0)[:, None]
    path = grip * np.stack([0.05 * np.sin(2 * time), 0.03 * np.cos(1.3 * time), 0.02 + 0 * time], axis=1)
    turn = grip * np.stack([0.5 * np.sin(1.1 * time), 0.3 + 0 * time, 0.2 * np.cos(time)], axis=1)
    waves = np.sin(2 * np.pi * rng.uniform(8, 12, (3, 4)) * time[:, None, None] + rng.uniform(0, 6, (3, 4)))
    path = path + np.where(carried[:, None], tremor / np.sqrt(6) * waves.sum(axis=2), 0.0)

    def noise(rms):
        errors = rng.normal(0, rms / np.sqrt(3), (count, 3))
        for index in range(1, count if correlation else 0):
            errors[index] = correlation * errors[index - 1] + np.sqrt(1 - correlation**2) * errors[index]
        return errors

    rotation = Rotation.from_rotvec(noise(scale * OMEGA)) * Rotation.from_rotvec(turn)
    return PoseSeries(f"recording {seed}", time, path + noise(scale * DT), rotation.as_quat())


class TestKnownErrors:
    @pytest.mark.parametrize("correlation", [0.0, 0.5, 0.9])
    def test_they_are_found_at_rest_and_in_motion(self, correlation):
        """Whether neighbouring errors are independent or not; correlated ones leave fewer to average over."""
        position, rotation = pooled(
            [tracker_precision(recording(seed, correlation=correlation)) for seed in (3, 4)]
        )
        tolerance = 0.03 if correlation < 0.9 else 0.08
        assert position.rest.rms == pytest.approx(DT, rel=tolerance)
        assert rotation.rest.rms == pytest.approx(OMEGA, rel=tolerance)
        # The tremor of the hand leaves a few per cent, which is on the safe side.
        assert 1.0 - tolerance < position.motion / DT < 1.05 + tolerance
        assert rotation.motion == pytest.approx(OMEGA, rel=0.04 + tolerance)
        assert position.worse == max(position.rest.rms, position.motion)

    def test_they_scale(self):
        once, twice = (tracker_precision(recording(5, scale=scale, tremor=0.0)) for scale in (1.0, 2.0))
        assert twice.position.rest.rms == pytest.approx(2 * once.position.rest.rms, rel=0.02)
        assert twice.rotation.motion == pytest.approx(2 * once.rotation.motion, rel=0.05)

    def test_segments_are_where_the_body_was_put_down_and_carried(self):
        found = tracker_precision(recording(6))
        assert [segment.at_rest for segment in found.segments] == [True, False, True]
        first, carried, last = found.segments
        assert carried.start / RATE == pytest.approx(4.0, abs=0.3)
        assert carried.stop / RATE == pytest.approx(12.0, abs=0.3)
        assert (first.start, last.stop) == (0, len(found.series.time))

    def test_without_rest_the_slow_part_is_not_known(self):
        found = tracker_precision(recording(7, rest=0.0))
        assert np.isnan(found.position.rest.rms)
        assert np.isnan(found.position.slow)
        assert found.position.worse == found.position.motion

    def test_a_creep_is_no_rest(self):
        series = recording(8, rest=10.0, motion=0.001)
        creeping = PoseSeries(
            "creep",
            series.time,
            series.position + series.time[:, None] * [0.4e-3, 0, 0],
            series.quaternion_xyzw,
        )
        found = tracker_precision(creeping)
        assert [segment.at_rest for segment in found.segments] == [False]
        assert found.position.motion == pytest.approx(DT, rel=0.05)

    def test_it_does_not_depend_on_the_frame(self):
        series = recording(9)
        turn, place = Rotation.from_euler("xyz", [50, -80, 10], degrees=True), np.array([3.0, -2.0, 1.0])
        moved = PoseSeries(
            series.name,
            series.time,
            turn.apply(series.position) + place,
            (turn * Rotation.from_quat(series.quaternion_xyzw)).as_quat(),
        )
        here, there = tracker_precision(series), tracker_precision(moved)
        assert there.position.rest.rms == pytest.approx(here.position.rest.rms, rel=1e-6)
        assert there.rotation.motion == pytest.approx(here.rotation.motion, rel=1e-6)

    def test_at_the_lens_the_rotation_error_adds_over_the_lever(self):
        series = recording(10, tremor=0.0)
        at_lens = tracker_precision(series.at_point([0.0, 0.0, 1.0]))
        # Of the three components of the rotation error, two move a point along the lever's end.
        expected = np.hypot(DT, OMEGA * np.sqrt(2 / 3) * 1.0)
        assert at_lens.position.rest.rms == pytest.approx(expected, rel=0.03)

    def test_lost_frames_and_short_stretches_are_left_out(self):
        series = recording(11)
        kept = np.ones(len(series.time), dtype=bool)
        kept[200:260] = kept[900] = kept[910:1000:7] = False
        holed = PoseSeries(
            series.name, series.time[kept], series.position[kept], series.quaternion_xyzw[kept]
        )
        assert tracker_precision(holed).position.rest.rms == pytest.approx(DT, rel=0.05)


class TestRefusals:
    def test_too_short(self):
        series = recording(1)
        short = PoseSeries("short", series.time[:15], series.position[:15], series.quaternion_xyzw[:15])
        with pytest.raises(PerceptionError, match="short: no sequence of poses"):
            tracker_precision(short)

    def test_poses_that_do_not_vary(self):
        count = 500
        same = PoseSeries(
            "frozen", np.arange(count) / RATE, np.zeros((count, 3)), np.tile([0.0, 0.0, 0.0, 1.0], (count, 1))
        )
        with pytest.raises(PerceptionError, match="all poses are equal"):
            tracker_precision(same)


def write_bag(path, series, topic="/knee_gap/scope_body/pose"):
    store = get_typestore(Stores.ROS2_JAZZY)
    types = store.types
    header, stamp = types["std_msgs/msg/Header"], types["builtin_interfaces/msg/Time"]
    kind = types["geometry_msgs/msg/PoseStamped"]
    with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        connection = writer.add_connection(topic, kind.__msgtype__, typestore=store)
        for time, position, quaternion in zip(
            series.time, series.position, series.quaternion_xyzw, strict=True
        ):
            stamp_ns = 1_700_000_000_000_000_000 + round(time * 1e9)
            message = kind(
                header(stamp(*divmod(stamp_ns, 10**9)), "world"),
                types["geometry_msgs/msg/Pose"](
                    types["geometry_msgs/msg/Point"](*position),
                    types["geometry_msgs/msg/Quaternion"](*quaternion),
                ),
            )
            writer.write(connection, stamp_ns, store.serialize_cdr(message, kind.__msgtype__))


class TestCommand:
    def test_two_bags_give_parameters_to_paste_and_a_plot(self, tmp_path, capsys):
        for seed in (1, 2):
            write_bag(tmp_path / f"bag{seed}", recording(seed, rest=2.0, motion=3.0))
        out = tmp_path / "out"
        assert main([str(tmp_path / "bag1"), str(tmp_path / "bag2"), "--out", str(out)]) == 0
        shown = capsys.readouterr().out
        assert "bag1" in shown
        assert "all" in shown
        yaml = (out / "tracker_precision.yaml").read_text()
        values = dict(line.split("#")[0].split(":") for line in yaml.splitlines() if line.startswith("    "))
        values = {name.strip(): value.strip() for name, value in values.items()}
        assert float(values["translation_error"]) == pytest.approx(DT, rel=0.1)
        assert float(values["rotation_error"]) == pytest.approx(OMEGA, rel=0.1)
        assert values["translation_error_at"] == "body"
        assert (out / "tracker_precision.png").stat().st_size > 10_000

    def test_what_it_prints_is_taken_by_the_tracker(self, tmp_path):
        from ruamel.yaml import YAML

        from knee_gap_perception.scope_pose.tracking_parameters import TrackingParameters

        write_bag(tmp_path / "bag", recording(1, rest=2.0, motion=3.0))
        assert main([str(tmp_path / "bag"), "--out", str(tmp_path), "--lever", "0", "0", "0.2"]) == 0
        yaml = YAML(typ="safe").load((tmp_path / "tracker_precision.yaml").read_text())
        parameters = TrackingParameters(**yaml["tracking_node"]["ros__parameters"])
        assert parameters.translation_error_at == "lens"
        assert parameters.translation_error > 0

    @pytest.mark.parametrize(
        ("arguments", "message"),
        [
            (["{0}/none"], "does not exist"),
            (
                ["{0}/bag", "--topic", "/wrong"],
                "no poses on /wrong; topics with poses: /knee_gap/scope_body/pose",
            ),
            (["{0}/no_take.csv"], "must start with 'Format Version'"),
            (["{0}/empty"], "no poses on scope_body/pose; topics with poses: none"),
        ],
    )
    def test_mistakes_are_one_line(self, tmp_path, capsys, arguments, message):
        write_bag(tmp_path / "bag", recording(1, rest=0.5, motion=1.0))
        (tmp_path / "no_take.csv").write_text("a,b\n")
        with Writer(tmp_path / "empty", version=9, storage_plugin=StoragePlugin.MCAP):
            pass
        assert main([*(item.format(tmp_path) for item in arguments), "--out", str(tmp_path / "out")]) == 1
        error = capsys.readouterr().err.strip()
        assert message in error
        assert len(error.splitlines()) == 1

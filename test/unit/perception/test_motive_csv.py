import os
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest
from motive_takes import (
    NO_BODY,
    SINGLE_BODY,
    THREE_BODIES,
    Export,
    single_body_take,
    take_without_body,
    three_body_take,
)
from recordings import origins
from scipy.spatial.transform import Rotation

from knee_gap_perception.trackers.body_source import UnknownBodyError
from knee_gap_perception.trackers.motive_csv import TakeError, _start_time, read_take


def written(tmp_path, text, encoding="utf-8"):
    path = tmp_path / "take.csv"
    path.write_bytes(text.encode(encoding))
    return path


TURN = Rotation.from_euler("XYZ", [20.0, -35.0, 110.0], degrees=True)
SEEN = (*TURN.as_quat(), 0.1, 0.2, 0.3, 0.0004)
EULER = (20.0, -35.0, 110.0, 0.1, 0.2, 0.3, 0.0004)
ROWS = [[SEEN, SEEN], [SEEN, None], [SEEN, SEEN]]


class TestVarieties:
    @pytest.mark.parametrize(
        "export",
        [
            Export(version="1.21", labels=False),
            Export(version="1.22"),
            Export(version="1.23"),
            Export(version="1.24", timecode=True),
            Export(version="1.25", parent=True, timecode=True),
            Export(version="1.25", parent=True),
            Export(delimiter=";", decimal=","),
            Export(delimiter="\t"),
            Export(newline="\n"),
        ],
        ids=[
            "1.21 without labels",
            "1.22",
            "1.23",
            "1.24 with timecode",
            "1.25 with parents and timecode",
            "1.25 with parents",
            "semicolons",
            "tabs",
            "line feeds",
        ],
    )
    @pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16"])
    def test_every_form_of_the_file_gives_the_same(self, tmp_path, export, encoding):
        take = read_take(written(tmp_path, export.text(ROWS, first_frame=7), encoding), up_axis="z")
        assert take.version == export.keys["Format Version"]
        assert [body.name for body in take.bodies] == ["scope", "tibia"]
        np.testing.assert_allclose(take.time, [0.07, 0.08, 0.09])
        np.testing.assert_array_equal(take.frame, [7, 8, 9])
        scope = take.body("scope")
        np.testing.assert_allclose(scope.position, [[0.1, 0.2, 0.3]] * 3)
        np.testing.assert_allclose(scope.mean_error, [0.0004] * 3)
        error = Rotation.from_quat(scope.quaternion_xyzw) * TURN.inv()
        assert error.magnitude().max() < 2e-6
        assert take.body("IDtibia").seen.tolist() == [True, False, True]

    @pytest.mark.parametrize(
        ("unit", "scale"), [("Meters", 1.0), ("Centimeters", 0.01), ("Millimeters", 0.001)]
    )
    def test_lengths_come_in_metres(self, tmp_path, unit, scale):
        take = read_take(written(tmp_path, Export(unit=unit).text(ROWS)), up_axis="z")
        np.testing.assert_allclose(take.bodies[0].position[0], np.array([0.1, 0.2, 0.3]) * scale)
        np.testing.assert_allclose(take.bodies[0].mean_error[0], 0.0004 * scale)

    def test_euler_angles_are_about_the_axes_of_the_body(self, tmp_path):
        take = read_take(written(tmp_path, Export(rotation="XYZ").text([[EULER, None]])), up_axis="z")
        by_hand = (
            Rotation.from_rotvec([np.radians(20.0), 0, 0])
            * Rotation.from_rotvec([0, np.radians(-35.0), 0])
            * Rotation.from_rotvec([0, 0, np.radians(110.0)])
        )
        read = Rotation.from_quat(take.bodies[0].quaternion_xyzw[0])
        assert (read * by_hand.inv()).magnitude() < 1e-6

    def test_the_order_of_turning_is_not_the_order_of_the_columns(self, tmp_path):
        take = read_take(written(tmp_path, Export(rotation="ZYX").text([[EULER, None]])), up_axis="z")
        by_hand = (
            Rotation.from_rotvec([0, 0, np.radians(110.0)])
            * Rotation.from_rotvec([0, np.radians(-35.0), 0])
            * Rotation.from_rotvec([np.radians(20.0), 0, 0])
        )
        read = Rotation.from_quat(take.bodies[0].quaternion_xyzw[0])
        assert (read * by_hand.inv()).magnitude() < 1e-6

    @pytest.mark.parametrize(
        ("text", "hour"),
        [
            ("2018-10-05 12.05.03.445 P.M.", 12),
            ("2018-10-05 12.05.03.445 AM", 0),
            ("2018-10-05 01.05.03.445 p. m.", 13),
            ("2018-10-05 下午 01.05.03.445", 13),
            ("2018-10-05 오전 09.05.03.445", 9),
            ("2018-10-05 21.05.03.445", 21),
            ("2018/10/05 21:05:03", 21),
        ],
    )
    def test_start_times_of_several_languages(self, text, hour):
        start = _start_time(text)
        assert start.replace(microsecond=0) == datetime(2018, 10, 5, hour, 5, 3, tzinfo=UTC)

    @pytest.mark.parametrize("text", ["", "yesterday", "2018-13-05 01.05.03 PM", "2018-10-05 01.05.03 qqq"])
    def test_start_times_that_nobody_can_read_are_none(self, text):
        assert _start_time(text) is None


class TestResaved:
    """What comes out of a spreadsheet, a script or an old version, and still holds all that is needed."""

    def check(self, tmp_path, text):
        take = read_take(written(tmp_path, text), up_axis="z")
        assert [body.name for body in take.bodies] == ["scope", "tibia"]
        np.testing.assert_allclose(take.body("scope").position, [[0.1, 0.2, 0.3]] * 3)
        assert take.body("tibia").seen.tolist() == [True, False, True]
        assert np.isnan(take.body("tibia").position[1]).all()

    def test_without_the_row_of_types(self, tmp_path):
        lines = Export().text(ROWS).split("\r\n")
        self.check(tmp_path, "\r\n".join(line for line in lines if not line.startswith(",Type")))

    def test_without_ids(self, tmp_path):
        lines = Export().text(ROWS).split("\r\n")
        self.check(tmp_path, "\r\n".join(line for line in lines if not line.startswith(",ID")))

    def test_without_names_nothing_is_guessed(self, tmp_path):
        lines = Export().text(ROWS).split("\r\n")
        text = "\r\n".join(line for line in lines if not line.startswith(",Name"))
        with pytest.raises(TakeError, match="the row with the names is missing"):
            read_take(written(tmp_path, text))

    def test_with_a_separator_at_the_end_of_every_line(self, tmp_path):
        self.check(tmp_path, "".join(f"{line},,\r\n" for line in Export().text(ROWS).split("\r\n")[:-1]))

    def test_with_old_line_ends(self, tmp_path):
        self.check(tmp_path, Export(newline="\r").text(ROWS))

    def test_with_quoted_decimal_commas(self, tmp_path):
        lines = Export().text(ROWS).split("\r\n")
        quoted = [
            ",".join(f'"{cell.replace(".", ",")}"' if "." in cell else cell for cell in line.split(","))
            for line in lines[7:]
        ]
        self.check(tmp_path, "\r\n".join([*lines[:7], *quoted]))

    def test_quaternions_that_are_not_called_so(self, tmp_path):
        self.check(tmp_path, Export().text(ROWS).replace("Rotation Type,Quaternion,", ""))

    def test_markers_only_is_a_take_without_bodies(self, tmp_path):
        text = Export(bodies=()).text([[], [], []]).replace("Rotation Type,Quaternion,", "")
        take = read_take(written(tmp_path, text))
        assert len(take.time) == 3
        with pytest.raises(UnknownBodyError, match="it has: none"):
            take.body("scope")

    @pytest.mark.parametrize("rate", [360.0, 1500.0])
    def test_times_rounded_to_milliseconds_are_made_exact_again(self, tmp_path, rate):
        export = Export()
        export.keys["Export Frame Rate"] = f"{rate:.6f}"
        lines = export.text([[SEEN, SEEN]] * 30, first_frame=40).split("\r\n")
        for row in range(7, 37):
            number, _, *rest = lines[row].split(",")
            lines[row] = ",".join([number, f"{round(int(number) / rate, 3):.6f}", *rest])
        take = read_take(written(tmp_path, "\r\n".join(lines)))
        np.testing.assert_allclose(take.time, np.arange(40, 70) / rate, atol=1e-9)

    def test_frames_that_were_dropped_leave_a_hole_in_time(self, tmp_path):
        lines = Export().text([[SEEN, SEEN]] * 6).split("\r\n")
        take = read_take(written(tmp_path, "\r\n".join([*lines[:9], *lines[11:]])))
        np.testing.assert_allclose(np.diff(take.time), [0.01, 0.03, 0.01])


class TestMissing:
    def test_empty_cells_are_no_numbers(self, tmp_path):
        body = read_take(written(tmp_path, Export().text(ROWS))).body("tibia")
        assert np.isnan(body.position[1]).all()
        assert np.isnan(body.quaternion_xyzw[1]).all()
        assert np.isnan(body.mean_error[1])

    @pytest.mark.parametrize("missing", range(7))
    def test_one_empty_cell_is_enough(self, tmp_path, missing):
        partly = [None if index == missing else value for index, value in enumerate(SEEN)]
        body = read_take(written(tmp_path, Export().text([[partly, SEEN]]))).body("scope")
        assert not body.seen.any()

    def test_what_is_no_rotation_is_not_seen(self, tmp_path):
        zero = (0.0, 0.0, 0.0, 0.0, *SEEN[4:])
        body = read_take(written(tmp_path, Export().text([[zero, SEEN]]))).body("scope")
        assert not body.seen.any()

    def test_frames_say_which_body_was_not_seen(self, tmp_path):
        frames = list(read_take(written(tmp_path, Export().text(ROWS))).frames(5_000_000_000))
        assert [frame.stamp_ns for frame in frames] == [5_000_000_000, 5_010_000_000, 5_020_000_000]
        assert [pose.tracking_valid for pose in frames[1].bodies] == [True, False]


class TestRefusals:
    def check(self, tmp_path, text, message, **options):
        with pytest.raises(TakeError, match=message) as raised:
            read_take(written(tmp_path, text), **options)
        assert "\n" not in str(raised.value)

    def test_a_body_that_is_not_there(self, tmp_path):
        take = read_take(written(tmp_path, Export().text(ROWS)))
        with pytest.raises(UnknownBodyError, match="no rigid body 'femur'; it has: 'scope', 'tibia'"):
            take.body("femur")

    def test_no_take_at_all(self, tmp_path):
        self.check(tmp_path, "a,b\n1,2\n", "must start with 'Format Version'")
        self.check(tmp_path, "", "must start with 'Format Version'")
        with pytest.raises(TakeError, match="No such file"):
            read_take(tmp_path / "none.csv")

    def test_a_file_cut_anywhere_is_never_read_as_a_whole_one(self, tmp_path):
        text = Export(newline="\n").text(ROWS)
        whole = read_take(written(tmp_path, text))
        for length in range(0, len(text) - 1, 3):
            try:
                cut = read_take(written(tmp_path, text[:length]))
            except TakeError:
                continue
            # At the end of a line only the header's count distinguishes a shorter take from a whole one.
            assert text[:length].endswith("\n")
            assert len(cut.time) < cut.exported_count == len(whole.time)

    def test_a_file_cut_in_a_quoted_cell_is_cut(self, tmp_path):
        text = Export().text([[SEEN, SEEN]] * 5)
        lines = text.splitlines(keepends=True)
        # A line break inside the quotes is no end of a line, whatever the last byte is.
        for end in ('"0.1\r\n', '"0.1', '4,0.04,"0.1\r\n', '4,0.04,"\r\n\r\n'):
            cut = "".join(lines[:-1]) + end
            with pytest.raises(TakeError, match="the file ends in the middle of it, after 4 whole frames"):
                read_take(written(tmp_path, cut))
            assert len(read_take(written(tmp_path, cut), partial=True).time) == 4
        with pytest.raises(TakeError, match=r"first line must start with|no row that starts with"):
            read_take(written(tmp_path, '"Format Version,1.23\r\n' + text))
        with pytest.raises(TakeError, match="field larger than field limit"):
            read_take(written(tmp_path, text + '"' + "0,\r\n" * 60_000))
        quoted = text.replace("a take", '"a, take"')
        assert len(read_take(written(tmp_path, quoted)).time) == 5

    def test_what_is_no_file_is_refused_and_not_waited_for(self, tmp_path):
        os.mkfifo(tmp_path / "take.csv")
        with pytest.raises(TakeError, match="is a FIFO, not a file"):
            read_take(tmp_path / "take.csv")
        with pytest.raises(TakeError, match="is a device, not a file"):
            read_take(Path("/dev/zero"))

    @pytest.mark.parametrize(("old", "new"), [("0,0.000000", "1e300,0"), ("0,0.000000", "0,1e300")])
    def test_numbers_beyond_any_take_are_refused(self, tmp_path, old, new):
        text = Export().text([[SEEN, SEEN]] * 2)
        with pytest.raises(TakeError, match="are not a frame number and a time"):
            read_take(written(tmp_path, text.replace(old, new, 1)))

    def test_what_is_whole_of_a_cut_file_on_request(self, tmp_path):
        text = Export().text(ROWS)[:-20]
        self.check(tmp_path, text, "line 10: the file ends in the middle of it, after 2 whole frames")
        take = read_take(written(tmp_path, text), partial=True)
        assert len(take.time) == 2

    def test_decimal_commas_between_commas(self, tmp_path):
        text = Export(decimal=",").text(ROWS)
        self.check(tmp_path, text, "decimal comma in a file that is separated by commas")

    def test_units_and_rotations_that_are_not_known(self, tmp_path):
        self.check(tmp_path, Export(unit="Furlongs").text(ROWS), "must be Meters, .* not 'Furlongs'")
        text = Export().text(ROWS)
        self.check(tmp_path, text.replace("Quaternion", "Axis"), "rotation type must be one of .* not 'Axis'")
        self.check(
            tmp_path, text.replace("Quaternion", "XYZ"), "4 numbers of rotation, which is not the stated type"
        )
        self.check(tmp_path, text.replace("Global", "Local"), "coordinate space must be Global")

    def test_times_that_do_not_rise(self, tmp_path):
        text = Export().text(ROWS).replace("\r\n2,0.020000", "\r\n2,0.010000")
        self.check(tmp_path, text, "line 10: its time does not follow")

    def test_two_bodies_of_one_name(self, tmp_path):
        self.check(tmp_path, Export(bodies=("scope", "scope")).text(ROWS), "two columns are named")

    def test_without_header(self, tmp_path):
        rows = Export().text(ROWS).split("\r\n")
        self.check(tmp_path, "\r\n".join([rows[0], *rows[6:]]), "export with header information")
        self.check(tmp_path, "\r\n".join(rows[:6]), "no row that starts with 'Frame'")
        self.check(tmp_path, "\r\n".join(rows[:7]) + "\r\n", "the take has no frames")


def test_damaged_files_are_refused_in_one_line_or_read(tmp_path):
    rng = np.random.default_rng(17)
    original = Export(version="1.25", parent=True, timecode=True).text(ROWS).encode()
    pieces = [
        b",",
        b"\n",
        b'"',
        b"\0",
        b"nan",
        b"1e400",
        b";",
        b"\xff\xfe",
        b"9" * 30,
        b"Rigid Body",
        b"Frame",
    ]
    for _ in range(500):
        data = bytearray(original)
        for _ in range(int(rng.integers(1, 8))):
            at = int(rng.integers(len(data) + 1))
            cut = int(rng.integers(0, 40)) * int(rng.integers(2))
            data[at : at + cut] = pieces[rng.integers(len(pieces))]
        path = tmp_path / "damaged.csv"
        path.write_bytes(data)
        message = ""
        try:
            take = read_take(path)
            assert (np.diff(take.time) > 0).all()
        except TakeError as error:
            message = str(error)
        assert "\n" not in message


class TestRecordedTakes:
    @pytest.mark.parametrize("origin", origins(SINGLE_BODY))
    def test_version_1_21(self, origin, tmp_path):
        known = single_body_take(origin, tmp_path)
        take = read_take(known.path)
        (body,) = take.bodies
        assert body.name == known.names[0]
        assert (take.version, take.rate) == ("1.21", known.rate)
        assert (len(take.time), take.exported_count) == (known.frames, known.exported)
        assert take.start == known.start
        assert body.seen.all()
        x, y, z = known.first_position
        np.testing.assert_allclose(body.position[0], [x, -z, y])
        assert np.median(body.mean_error) < 1e-4

    @pytest.mark.parametrize("origin", origins(THREE_BODIES))
    def test_version_1_23_with_three_bodies_and_drop_outs(self, origin, tmp_path):
        known = three_body_take(origin, tmp_path)
        take = read_take(known.path)
        assert tuple(body.name for body in take.bodies) == known.names
        assert (len(take.time), take.exported_count) == (known.frames, known.exported)
        assert take.start == known.start
        assert (np.diff(take.frame) > 1).sum() == known.gaps
        np.testing.assert_allclose(take.time, take.frame / known.rate)
        fewest, most = known.seen
        assert fewest <= take.body(known.names[2]).seen.sum() <= most < known.frames
        x, y, z = known.first_position
        np.testing.assert_allclose(take.bodies[0].position[0], [x, -z, y])
        for body in take.bodies:
            assert np.isnan(body.position[~body.seen]).any(axis=1).all() or body.seen.all()
            assert (np.abs(body.position[body.seen]).max(axis=1) > 1e-3).all()

    @pytest.mark.parametrize("origin", origins(NO_BODY))
    def test_a_take_without_a_body(self, origin, tmp_path):
        known = take_without_body(origin, tmp_path)
        take = read_take(known.path)
        assert take.bodies == ()
        assert len(take.time) == known.frames
        with pytest.raises(UnknownBodyError, match="it has: none"):
            take.body("scope")

import struct
from contextlib import suppress

import pytest
from natnet.data_descriptions import DataDescriptions
from natnet.data_frame import DataFrame
from natnet.packet_buffer import PacketBuffer
from natnet.version import Version
from natnet_captures import V2_CAPTURES, V3_CAPTURES, natnet_2, natnet_3
from recordings import origins

from knee_gap_perception.errors import PerceptionError
from knee_gap_perception.trackers.natnet.buffer import PacketError
from knee_gap_perception.trackers.natnet.packets import (
    EchoResponse,
    Frame,
    ModelDefinitions,
    NatNetVersion,
    ServerInfo,
    connect_request,
    decode_packet,
    echo_request,
)
from knee_gap_simulation.natnet import packets as server

V3 = NatNetVersion(3, 0)
BODIES = [
    server.BodyInFrame(1, (0.5, 1.25, -0.75), (0.5, -0.5, 0.5, 0.5), 0.25, True),
    server.BodyInFrame(7, (8.0, 0.125, 3.0), (0.0, 0.0, 0.0, 1.0), 0.5, False),
]
FULL = server.FrameContent(
    number=4_000_000_000,
    bodies=BODIES,
    marker_sets=[("scope", [(0.0, 1.0, 2.0)] * 3), ("", [])],
    other_markers=[(1.0, 2.0, 3.0)],
    skeletons=[(5, BODIES)],
    labeled_markers=[server.LabeledMarker(65537, (0.0, 1.0, 2.0), 0.014, 2, 1e-4)],
    force_plates=[(1, [[1.0, 2.0], []])],
    devices=[(2, [[3.0]])],
    timestamp=12.5,
    mid_exposure_ticks=2**60 + 1,
    received_ticks=2**60 + 2,
    transmit_ticks=2**60 + 3,
    flags=server.MODELS_CHANGED,
)


@pytest.mark.parametrize("version", server.VERSIONS)
class TestEveryVersion:
    def test_a_frame_with_everything_in_it(self, version):
        frame = decode_packet(server.frame(version, FULL), NatNetVersion(*version))
        assert isinstance(frame, Frame)
        assert (frame.number, frame.models_changed) == (4_000_000_000, True)
        assert (frame.mid_exposure_ticks, frame.transmit_ticks) == (2**60 + 1, 2**60 + 3)
        for body, sent in zip(frame.bodies, BODIES, strict=True):
            assert body.id == sent.id
            assert body.position == sent.position
            assert body.quaternion_xyzw == sent.quaternion_xyzw
            assert body.mean_error == sent.mean_error
            assert body.tracking_valid is sent.tracking_valid

    def test_names_of_bodies_among_other_models(self, version):
        models = server.Models(
            bodies=[server.BodyModel(3, "Skope-Ä", [(0.0, 0.1, 0.2)] * 4), server.BodyModel(4, "tibia")],
            marker_sets=[("all", ["a", "b"])],
            force_plates=[(1, "AMTI-1")],
            cameras=["Prime 13"],
        )
        data = server.model_definitions(version, models)
        assert decode_packet(data, NatNetVersion(*version)) == ModelDefinitions({3: "Skope-Ä", 4: "tibia"})

    def test_the_server_and_its_clock(self, version):
        data = server.server_info(
            version, frequency=3_312_787, data_port=1512, multicast_address="239.1.2.3", motive=(2, 2)
        )
        assert decode_packet(data, None) == ServerInfo(
            "Motive", "2.2", NatNetVersion(*version), 3_312_787, 1512, True, "239.1.2.3"
        )

    def test_a_packet_cut_anywhere_is_refused(self, version):
        models = server.Models(bodies=[server.BodyModel(3, "scope", [(0.0, 0.1, 0.2)] * 2)])
        for data in (server.frame(version, FULL), server.model_definitions(version, models)):
            for length in range(len(data)):
                with pytest.raises(PacketError):
                    decode_packet(data[:length], NatNetVersion(*version))
                cut = data[: max(length, 4)]
                cut = struct.pack("<HH", struct.unpack_from("<H", data)[0], len(cut) - 4) + cut[4:]
                # An end mark and the hardware clock's time may be missing.
                if len(data) - len(cut) > 12:
                    with pytest.raises(PacketError):
                        decode_packet(cut, NatNetVersion(*version))

    def test_a_frame_read_as_another_layout_is_refused(self, version):
        data = server.frame(version, FULL)
        for other in ((2, 7), (2, 11), *server.VERSIONS):
            if (other >= (4, 1)) == (version >= (4, 1)) and other >= (3, 0):
                continue
            with pytest.raises(PacketError):
                decode_packet(data, NatNetVersion(*other))


class TestHostilePackets:
    @pytest.mark.parametrize("version", server.VERSIONS)
    def test_huge_counts_cost_nothing(self, version):
        data = bytearray(server.frame(version, FULL))
        for at in range(4, len(data) - 4):
            broken = data[:]
            struct.pack_into("<I", broken, at, 0xFFFFFFFF)
            with suppress(PacketError):
                decode_packet(bytes(broken), NatNetVersion(*version))

    def test_versions_that_are_not_known(self):
        with pytest.raises(PacketError, match=r"NatNet 5.0; 2.x to 4.x are supported"):
            decode_packet(server.frame((4, 1), FULL), NatNetVersion(5, 0))

    def test_data_before_the_version_is_known(self):
        with pytest.raises(PacketError, match="before the server's version"):
            decode_packet(server.frame((4, 1), FULL), None)

    def test_a_length_that_is_not_true(self):
        with pytest.raises(PacketError, match="announces 8 bytes, but contains 9"):
            decode_packet(struct.pack("<HH9x", 13, 8), None)

    def test_a_clock_that_stands_still(self):
        data = server.server_info((3, 0), frequency=0, data_port=1511, multicast_address=None)
        with pytest.raises(PacketError, match="clock frequency is 0 Hz"):
            decode_packet(data, None)

    def test_errors_are_of_the_package_s_family(self):
        assert issubclass(PacketError, PerceptionError)


@pytest.mark.parametrize("origin", origins(V3_CAPTURES))
class TestCapturedPackets:
    def test_frame(self, origin):
        captured = natnet_3(origin)
        frame, truth = decode_packet(captured.frame, V3), captured.truth
        (body,) = frame.bodies
        assert (frame.number, body.id, body.tracking_valid) == (truth.number, truth.body_id, True)
        assert body.position == pytest.approx(truth.position)
        assert body.quaternion_xyzw == pytest.approx(truth.quaternion_xyzw, abs=1e-6)
        assert body.mean_error == pytest.approx(truth.mean_error, rel=1e-4)
        assert (frame.mid_exposure_ticks, frame.transmit_ticks) == (
            truth.mid_exposure_ticks,
            truth.transmit_ticks,
        )

    def test_names_server_and_echo(self, origin):
        captured = natnet_3(origin)
        names = decode_packet(captured.model_definitions, V3).bodies
        assert names == {captured.truth.body_id: captured.body_name}
        info = decode_packet(captured.server_info, None)
        assert info == ServerInfo("Motive", "2.1", V3, 3312787, 1511, True, "239.255.42.99")
        echo = decode_packet(captured.echo_response, None)
        assert echo == EchoResponse(captured.echo_stamp, captured.echo_ticks)

    def test_requests_are_as_captured(self, origin):
        # The sender's name and version are its own affair; the layout is not.
        captured = natnet_3(origin)
        ours = connect_request()
        assert ours[:2] == captured.connect[:2]
        assert len(ours) == len(captured.connect) + 5  # connection options, from NatNet 4.0 on
        assert struct.unpack_from("<H", ours, 2)[0] == len(ours) - 4
        assert echo_request(captured.echo_stamp) == captured.echo_request


@pytest.mark.parametrize("origin", origins(V2_CAPTURES))
@pytest.mark.parametrize(("motive", "version"), [("1.5.0", (2, 5)), ("1.7.2", (2, 7))])
def test_captured_frames_of_natnet_2(origin, motive, version):
    greeting, *frames = natnet_2(origin, motive)
    info = decode_packet(greeting, None)
    assert info.natnet_version == version
    assert info.clock_frequency is None
    first, second = (decode_packet(data, info.natnet_version) for data in frames)
    assert second.number == first.number + 1
    assert first.mid_exposure_ticks is None
    for frame in (first, second):
        (body,) = frame.bodies
        assert sum(value**2 for value in body.quaternion_xyzw) == pytest.approx(1.0, abs=1e-5)
        assert body.mean_error < 1e-4
    assert first.bodies[0].position == pytest.approx(second.bodies[0].position, abs=1e-4)


@pytest.mark.parametrize("origin", origins(V3_CAPTURES))
class TestServerAgainstCaptures:
    """The simulated server writes byte for byte what Motive wrote."""

    def test_server_info(self, origin):
        data = natnet_3(origin).server_info
        ours = server.server_info(
            (3, 0),
            frequency=3312787,
            data_port=1511,
            multicast_address="239.255.42.99",
            motive=(2, 1),
        )
        assert ours[:11] == data[:11]  # Motive leaves rubbish behind its name's end
        assert ours[260:] == data[260:]

    def test_model_definitions(self, origin):
        data = natnet_3(origin).model_definitions
        read = DataDescriptions.read_from_buffer(payload(data), Version(3, 0))
        (body,) = read.rigid_bodies
        markers = [marker.pos for marker in body.markers]
        models = server.Models(
            bodies=[server.BodyModel(body.id_num, body.name, markers)],
            marker_sets=[(item.name, item.marker_names) for item in read.marker_sets],
        )
        ours = server.model_definitions((3, 0), models)
        assert sorted(ours) == sorted(data)  # Motive sends the body between its marker sets
        assert server.model_definitions((3, 0), server.Models(bodies=models.bodies))[8:] in data

    def test_frame(self, origin):
        data = natnet_3(origin).frame
        read = DataFrame.read_from_buffer(payload(data), Version(3, 0))
        content = server.FrameContent(
            number=read.prefix.frame_number,
            bodies=[
                server.BodyInFrame(body.id_num, body.pos, body.rot, body.marker_error, body.tracking_valid)
                for body in read.rigid_bodies
            ],
            marker_sets=[(item.model_name, item.marker_pos_list) for item in read.marker_sets],
            other_markers=read.unlabeled_marker_pos,
            labeled_markers=[
                server.LabeledMarker(item.id_num, item.pos, item.size, item.param, item.residual)
                for item in read.labeled_markers
            ],
            timecode=read.suffix.timecode,
            timecode_subframe=read.suffix.timecode_sub,
            timestamp=read.suffix.timestamp,
            mid_exposure_ticks=read.suffix.stamp_camera_mid_exposure,
            received_ticks=read.suffix.stamp_data_received,
            transmit_ticks=read.suffix.stamp_transmit,
            flags=read.suffix.param,
        )
        assert server.frame((3, 0), content) == data


def payload(data):
    buffer = PacketBuffer(data)
    buffer.pointer = 4
    return buffer

"""Images out of messages, edges into them."""

from types import SimpleNamespace

import cv2
import numpy as np
import numpy.typing as npt
import pytest
from plain_messages import header

from knee_gap_core.conversions.edge_messages import fill_gap_edges
from knee_gap_core.values.arrays import Image
from knee_gap_core.values.edges import EdgeKind, EdgeStatus, GapEdges
from knee_gap_core.values.stamps import stamp_ns
from knee_gap_perception.errors import PerceptionError
from knee_gap_perception.messages import image_from_compressed, image_from_message


@pytest.fixture
def picture() -> Image:
    return np.random.default_rng(0).integers(0, 256, (12, 16, 3)).astype(np.uint8)


def message(image: npt.NDArray[np.generic], encoding: str, padding: int = 0) -> SimpleNamespace:
    rows = image.reshape(image.shape[0], -1).view(np.uint8)
    padded = np.pad(rows, ((0, 0), (0, padding)))
    return SimpleNamespace(
        height=image.shape[0],
        width=image.shape[1],
        encoding=encoding,
        step=padded.shape[1],
        data=padded.tobytes(),
    )


@pytest.mark.parametrize("padding", [0, 5])
def test_colour_orders_give_the_same_image(picture: Image, padding: int) -> None:
    alpha = np.full((12, 16, 1), 255, np.uint8)
    for encoding, data in (
        ("bgr8", picture),
        ("8UC3", picture),
        ("rgb8", picture[..., ::-1]),
        ("bgra8", np.concatenate([picture, alpha], axis=2)),
        ("rgba8", np.concatenate([picture[..., ::-1], alpha], axis=2)),
    ):
        given = message(np.ascontiguousarray(data), encoding, padding)
        np.testing.assert_array_equal(image_from_message(given), picture)


def test_mono_becomes_grey(picture: Image) -> None:
    grey = np.ascontiguousarray(picture[..., 0])
    image = image_from_message(message(grey, "mono8"))
    assert image.shape == (12, 16, 3)
    for channel in range(3):
        np.testing.assert_array_equal(image[..., channel], grey)


YUV = (40, 120, 180)  # one colour, as brightness and two colour differences
BLUE_GREEN_RED = (12, 0, 111)  # the same by ITU-R BT.601


@pytest.mark.parametrize(
    ("encoding", "data"),
    [
        ("yuv422", np.tile(np.array([YUV[1], YUV[0], YUV[2], YUV[0]], np.uint8), (4, 4))),
        ("uyvy", np.tile(np.array([YUV[1], YUV[0], YUV[2], YUV[0]], np.uint8), (4, 4))),
        ("yuv422_yuy2", np.tile(np.array([YUV[0], YUV[1], YUV[0], YUV[2]], np.uint8), (4, 4))),
        ("yuyv", np.tile(np.array([YUV[0], YUV[1], YUV[0], YUV[2]], np.uint8), (4, 4))),
        ("nv12", np.array([[YUV[0]] * 8] * 4 + [[YUV[1], YUV[2]] * 4] * 2, np.uint8)),
        ("nv21", np.array([[YUV[0]] * 8] * 4 + [[YUV[2], YUV[1]] * 4] * 2, np.uint8)),
    ],
)
@pytest.mark.parametrize("padding", [0, 3])
def test_colour_of_capture_cards(encoding: str, data: Image, padding: int) -> None:
    given = message(data, encoding, padding)
    given.height, given.width = 4, 8
    image = image_from_message(given)
    assert image.shape == (4, 8, 3)
    np.testing.assert_allclose(image.astype(int), np.broadcast_to(BLUE_GREEN_RED, image.shape), atol=3)


@pytest.mark.parametrize("pattern", ["rggb", "bggr", "gbrg", "grbg"])
@pytest.mark.parametrize("bits", [8, 16])
def test_bayer_patterns_give_the_colour_of_their_filters(pattern: str, bits: int) -> None:
    colour = {"b": 30, "g": 90, "r": 200}
    tile = np.array([colour[one] for one in pattern]).reshape(2, 2)
    pixels = np.tile(tile, (6, 6))
    data = pixels.astype(np.uint8) if bits == 8 else (pixels << 8).astype("<u2")
    image = image_from_message(message(np.ascontiguousarray(data), f"bayer_{pattern}{bits}"))
    np.testing.assert_array_equal(image[2:-2, 2:-2], np.broadcast_to((30, 90, 200), (8, 8, 3)))


def test_of_16_bits_the_upper_eight_are_kept_in_either_order(picture: Image) -> None:
    grey = picture[..., 0]
    for order, big_endian in (("<u2", False), (">u2", True)):
        given = message((grey.astype(np.uint16) << 8 | 7).astype(order), "mono16")
        given.is_bigendian = big_endian
        np.testing.assert_array_equal(image_from_message(given)[..., 1], grey)


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"encoding": "16UC1"}, "depth"),
        ({"encoding": "16UC3"}, "one of bgr8"),
        ({"encoding": "32FC1"}, "one of bgr8"),
        ({"encoding": ""}, "one of bgr8"),
        ({"encoding": "yuv422", "width": 15}, "multiple of 2x1"),
        ({"encoding": "nv12", "height": 11}, "multiple of 2x2"),
        ({"encoding": "nv12", "height": 12, "data": bytes(12 * 48)}, "18 rows"),
        ({"height": 0}, "1x1"),
        ({"width": 0}, "1x1"),
        ({"step": 10}, "step"),
        ({"data": b""}, "bytes"),
        ({"data": b"abc"}, "bytes"),
    ],
)
def test_images_that_cannot_be_used_are_refused(
    picture: Image, changes: dict[str, object], reason: str
) -> None:
    given = SimpleNamespace(**{**vars(message(picture, "bgr8")), **changes})
    with pytest.raises(PerceptionError, match=reason):
        image_from_message(given)


def compressed(data: bytes, description: str = "jpeg") -> SimpleNamespace:
    return SimpleNamespace(format=description, data=data)


def encoded(image: npt.NDArray[np.generic], extension: str) -> bytes:
    return bytes(cv2.imencode(extension, image)[1])


def test_compressed_images(picture: Image) -> None:
    np.testing.assert_array_equal(image_from_compressed(compressed(encoded(picture, ".png"), "png")), picture)
    smooth = np.full((32, 32, 3), (40, 90, 200), np.uint8)
    decoded = image_from_compressed(compressed(encoded(smooth, ".jpg"), "bgr8; jpeg compressed bgr8"))
    np.testing.assert_allclose(decoded.astype(int), smooth, atol=4)
    grey = image_from_compressed(compressed(encoded(smooth[..., 1], ".jpg")))
    assert grey.shape == (32, 32, 3)


@pytest.mark.parametrize(
    ("data", "description", "reason"),
    [
        (b"", "jpeg", "empty"),
        (b"no picture at all", "jpeg", "decoded"),
        (b"\xff\xd8\xff\xe0 cut", "jpeg", "decoded"),
        (encoded(np.zeros((8, 8), np.uint16), ".png"), "png", "8 bits"),
        (encoded(np.zeros((8, 8), np.uint8), ".png"), "bayer_rggb8; png compressed", "Bayer"),
        (encoded(np.zeros((8, 8), np.uint8), ".png"), "16UC1; compressedDepth", "depth"),
    ],
)
def test_compressed_images_that_cannot_be_used_are_refused(
    data: bytes, description: str, reason: str
) -> None:
    with pytest.raises(PerceptionError, match=reason):
        image_from_compressed(compressed(data, description))


def blank_vector() -> SimpleNamespace:
    return SimpleNamespace(x=0.0, y=0.0, z=0.0)


def blank_section() -> SimpleNamespace:
    return SimpleNamespace(edge_0=blank_vector(), edge_1=blank_vector(), edge_error=0.0)


def blank_edges() -> SimpleNamespace:
    return SimpleNamespace(
        header=header(0, ""),
        **{f"{name}_{index}": blank_vector() for name in ("bearing", "edge") for index in (0, 1)},
    )


def test_edges_fill_every_field_of_the_message() -> None:
    covariances = np.arange(18, dtype=float).reshape(2, 3, 3)
    edges = GapEdges(
        stamp_ns=1_700_000_000_123_456_789,
        frame_id="lens",
        status=EdgeStatus.VALID,
        track_id=7,
        bearings=np.array([[0.0, 0.0, 1.0], [0.6, 0.0, 0.8]]),
        pixels=np.array([[1.0, 2.0], [3.0, 4.0]]),
        kinds=(EdgeKind.RIM, EdgeKind.CONTOUR),
        covariances=covariances,
        angular_error=0.01,
        hidden=(False, True),
        pose_used=True,
    )
    filled = fill_gap_edges(blank_edges(), edges, blank_section)
    assert stamp_ns(filled.header) == edges.stamp_ns
    assert filled.header.frame_id == "lens"
    assert (filled.status, filled.track_id) == (1, 7)
    assert (filled.bearing_1.x, filled.bearing_1.z) == (0.6, 0.8)
    np.testing.assert_array_equal(filled.pixel_1, [3.0, 4.0])
    assert (filled.kind_0, filled.kind_1) == (1, 2)
    np.testing.assert_array_equal(filled.covariance_1, np.arange(9.0, 18.0))
    assert (filled.hidden_0, filled.hidden_1, filled.pose_used) == (False, True, True)
    assert filled.angular_error == 0.01


def test_unknown_points_are_nan_in_the_message() -> None:
    filled = fill_gap_edges(
        blank_edges(), GapEdges.without_points(5, "lens", EdgeStatus.NO_GAP), blank_section
    )
    assert (filled.status, filled.track_id, filled.kind_0) == (2, 0, 0)
    assert np.isnan([filled.bearing_0.x, *filled.pixel_0, *filled.covariance_1, filled.angular_error]).all()

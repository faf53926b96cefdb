"""Every strategy on drawn gaps, and a network made here, byte by byte."""

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import pytest

from knee_gap_core.values.arrays import Image, Mask
from knee_gap_perception.errors import PerceptionError
from knee_gap_perception.segmentation.choice import LEARNED, STRATEGIES, WITHOUT_NETWORK, segmentation_named
from knee_gap_perception.segmentation.learned import Learned
from knee_gap_perception.segmentation.network import Network
from knee_gap_perception.segmentation.three_classes import otsu3
from knee_gap_perception.segmentation.thresholds import otsu_threshold


@pytest.fixture(scope="module")
def drawn() -> tuple[Image, Mask, Mask]:
    """A picture (180, 320, 3) of lit and shaded tissue with a reddish gap, the field, and the gap."""
    rows, columns = np.mgrid[0:180, 0:320].astype(float)
    field = np.hypot(columns - 160, rows - 90) < 86
    gap = field & (np.abs(rows - 90 - 8 * np.sin(columns / 30)) < 16)
    tissue = 185 - 0.9 * np.hypot(columns - 160, rows - 90)
    tissue[rows > 130] *= 0.72
    image = np.where(gap[..., None], [9, 11, 30], tissue[..., None] * np.array([0.75, 0.85, 1.0]))
    image = cv2.GaussianBlur(image, (0, 0), 0.8) + np.random.default_rng(5).normal(0, 3, image.shape)
    image[~field] = 2
    return np.clip(image, 0, 255).astype(np.uint8), field, gap


# The network was trained on tissue, and knows no drawn bands.
CLASSICAL = [name for name in WITHOUT_NETWORK if name != LEARNED]


@pytest.mark.parametrize("name", CLASSICAL)
def test_strategies_find_the_gap(name: str, drawn: tuple[Image, Mask, Mask]) -> None:
    image, field, gap = drawn
    dark = segmentation_named(name)(image, field)
    assert dark.dtype == np.bool_
    assert not (dark & ~field).any()
    assert 2 * (dark & gap).sum() / (dark.sum() + gap.sum()) > 0.93
    assert (segmentation_named(name)(image, field) == dark).all()


@pytest.mark.parametrize("name", WITHOUT_NETWORK)
def test_an_empty_field_has_no_gap(name: str, drawn: tuple[Image, Mask, Mask]) -> None:
    image, field, _ = drawn
    assert not segmentation_named(name)(image, np.zeros_like(field)).any()


@pytest.mark.parametrize("name", WITHOUT_NETWORK)
@pytest.mark.parametrize("level", [0, 130, 255])
def test_an_even_picture_does_no_harm(name: str, level: int, drawn: tuple[Image, Mask, Mask]) -> None:
    _, field, _ = drawn
    even = np.full((*field.shape, 3), level, np.uint8)
    assert segmentation_named(name)(even, field).shape == field.shape


def test_otsu_parts_two_and_three_groups() -> None:
    rng = np.random.default_rng(2)
    low, middle, high = (
        np.clip(rng.normal(mean, 5, 4000), 0, 255).astype(np.uint8) for mean in (20, 110, 210)
    )
    assert 35 < otsu_threshold(np.concatenate([low, high])) < 195
    dark, between, clearness = otsu3(np.concatenate([low, middle, high]))
    assert 35 < dark < 95
    assert 125 < between < 195
    assert 0.98 < clearness < 1.0
    assert otsu3(np.repeat(np.array([10, 200], np.uint8), 50)).dark == 10
    assert otsu3(np.full(9, 7, np.uint8)) == (7, 7, 0)
    even = rng.integers(0, 256, 4000).astype(np.uint8)
    assert otsu3(even).clearness < clearness


def test_light_that_falls_to_the_rim_is_evened(drawn: tuple[Image, Mask, Mask]) -> None:
    """A veiled gap whose middle is as bright as tissue at the rim: no threshold parts them as they are."""
    _, field, gap = drawn
    rows, columns = np.mgrid[0:180, 0:320].astype(float)
    lit = np.where(gap, 75.0, 150.0) * np.exp(-0.9 * ((rows - 90) ** 2 + (columns - 160) ** 2) / 86**2)
    noise = np.random.default_rng(6).normal(0, 2, (180, 320, 3))
    image = np.clip(lit[..., None] + noise, 0, 255).astype(np.uint8)
    dice = {}
    for name in ("otsu", "otsu3", "watershed"):
        dark = segmentation_named(name)(image, field)
        dice[name] = 2 * (dark & gap).sum() / (dark.sum() + gap.sum())
    assert dice["otsu"] < 0.8
    assert dice["otsu3"] > 0.95
    assert dice["watershed"] > 0.95


def test_unknown_names_are_refused_with_the_choices() -> None:
    with pytest.raises(PerceptionError, match=", ".join(STRATEGIES)):
        segmentation_named("unet")


# A protobuf message is a row of fields, each a number with a wire type: 0 a varint, 2 a length and bytes. The
# numbers are those of onnx.proto.


def varint(value: int) -> bytes:
    out = b""
    while value > 127:
        out += bytes([value & 127 | 128])
        value >>= 7
    return out + bytes([value])


def number(field: int, value: int) -> bytes:
    return varint(field << 3) + varint(value)


def chunk(field: int, content: bytes | str) -> bytes:
    data = content.encode() if isinstance(content, str) else content
    return varint(field << 3 | 2) + varint(len(data)) + data


def value_info(name: str, dimensions: tuple[int, ...]) -> bytes:
    shape = b"".join(chunk(1, number(1, size)) for size in dimensions)
    return chunk(1, name) + chunk(2, chunk(1, number(1, 1) + chunk(2, shape)))


def tensor(name: str, values: npt.NDArray[np.float32]) -> bytes:
    dimensions = b"".join(number(1, size) for size in values.shape)
    return dimensions + number(2, 1) + chunk(8, name) + chunk(9, values.astype("<f4").tobytes())


def one_by_one_network(
    weight: npt.NDArray[np.float32], bias: npt.NDArray[np.float32], size: tuple[int, int]
) -> bytes:
    """An ONNX model of a single 1x1 convolution, weight (out, in, 1, 1) and bias (out,)."""
    shape = chunk(5, chunk(1, "kernel_shape") + number(8, 1) + number(8, 1) + number(20, 7))
    node = (
        chunk(1, "picture")
        + chunk(1, "weight")
        + chunk(1, "bias")
        + chunk(2, "gap")
        + chunk(4, "Conv")
        + shape
    )
    graph = (
        chunk(1, node)
        + chunk(2, "one")
        + chunk(5, tensor("weight", weight))
        + chunk(5, tensor("bias", bias))
        + chunk(11, value_info("picture", (1, weight.shape[1], size[1], size[0])))
        + chunk(12, value_info("gap", (1, weight.shape[0], size[1], size[0])))
    )
    return number(1, 7) + chunk(7, graph) + chunk(8, chunk(1, "") + number(2, 11))


@pytest.fixture
def network_file(tmp_path: Path) -> Any:
    def write(weight: list[list[float]], bias: list[float]) -> str:
        path = tmp_path / "network.onnx"
        values = np.array(weight, np.float32)[..., None, None]
        path.write_bytes(one_by_one_network(values, np.array(bias, np.float32), (128, 96)))
        return str(path)

    return write


def test_a_network_with_one_channel(network_file: Any, drawn: tuple[Image, Mask, Mask]) -> None:
    image, field, gap = drawn
    # 1 - 2 red is above one half where red, in [0, 1], is below a quarter.
    path = network_file([[-2.0, 0.0, 0.0]], [1.0])
    dark = Network(path, input_size=(128, 96), threshold=0.5)(image, field)
    assert 2 * (dark & gap).sum() / (dark.sum() + gap.sum()) > 0.9
    assert not (dark & ~field).any()


def test_normalisation_is_per_channel_in_red_green_blue(
    network_file: Any, drawn: tuple[Image, Mask, Mask]
) -> None:
    image, field, gap = drawn
    # With the mean of red taken off, red below 64 is negative; the other channels weigh nothing.
    path = network_file([[-1.0, 0.0, 0.0]], [0.0])
    network = Network(path, input_size=(128, 96), mean=(64, 0, 0), scale=(1, 0, 0), threshold=0.0)
    dark = network(image, field)
    assert 2 * (dark & gap).sum() / (dark.sum() + gap.sum()) > 0.9


def test_a_network_with_two_classes(network_file: Any, drawn: tuple[Image, Mask, Mask]) -> None:
    image, field, gap = drawn
    path = network_file([[1.0, 0.0, 0.0], [0.0, 0.0, 0.0]], [0.0, 0.25])
    dark = Network(path, input_size=(128, 96), gap_channel=1)(image, field)
    assert 2 * (dark & gap).sum() / (dark.sum() + gap.sum()) > 0.9
    with pytest.raises(PerceptionError, match="channel 2"):
        Network(path, input_size=(128, 96), gap_channel=2)(image, field)


@pytest.mark.parametrize("channels", [3, 5])
def test_a_network_of_another_shape_is_not_the_projects_own(channels: int, network_file: Any) -> None:
    with pytest.raises(PerceptionError, match="not one of the segmentation 'learned'") as refusal:
        Learned(network_file([[1.0] * channels, [0.0] * channels], [0.0, 1.0]))
    assert "\n" not in str(refusal.value).strip()


def test_files_that_are_no_network_are_refused(tmp_path: Path) -> None:
    rubbish = tmp_path / "rubbish.onnx"
    rubbish.write_bytes(b"not a network")
    with pytest.raises(PerceptionError, match="cannot read"):
        Network(str(rubbish))
    with pytest.raises(PerceptionError, match="must be an ONNX file"):
        Network(str(tmp_path / "missing.onnx"))

"""Training of the project's own network: examples, what is drawn into them, and the file that results."""

import builtins
import importlib.util
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from knee_gap_core.values.errors import KneeGapError
from knee_gap_core.values.pixel_classes import UNKNOWN_CLASS, PixelClass
from knee_gap_perception.marks.marked_picture import Decision, MarkedField, MarkedPicture, Region
from knee_gap_perception.marks.marks_file import write_marks
from knee_gap_perception.marks.picture_files import sha256_of
from knee_gap_perception.segmentation.network_input import CHANNELS, SIDE
from knee_gap_perception.training.augmentation import OUTPUT_SIDE, augmented, plain
from knee_gap_perception.training.card import data_card
from knee_gap_perception.training.command import Plan, main
from knee_gap_perception.training.compositions import (
    with_instrument,
    with_lit_gap,
    with_opening,
    with_shade,
)
from knee_gap_perception.training.examples import (
    STORED_SIDE,
    Example,
    labels_of,
    read_marked,
    read_renders,
)
from knee_gap_perception.training.mixture import BATCH, Mixture
from knee_gap_perception.training.model import drawn

needs_jax = pytest.mark.skipif(
    any(importlib.util.find_spec(name) is None for name in ("jax", "optax", "onnx")),
    reason="the extra for training is not installed (make training)",
)


def _example(seed: int = 1, source: str = "drawn", level: float = 150.0) -> Example:
    rng = np.random.default_rng(seed)
    grey = level + 15.0 * cv2.GaussianBlur(rng.standard_normal((STORED_SIDE, STORED_SIDE)), (0, 0), 2.0)
    image = np.clip(grey[..., None] * [0.8, 0.9, 1.0], 0, 255).astype(np.uint8)
    labels = np.full((STORED_SIDE, STORED_SIDE), PixelClass.TISSUE, np.uint8)
    rows, columns = np.mgrid[0:STORED_SIDE, 0:STORED_SIDE]
    labels[np.hypot(rows - 111.5, columns - 111.5) > 111] = PixelClass.OUTSIDE
    return Example(f"{source} {seed}", source, image, labels, f"{seed:064x}")


def test_labels_of_marks_put_instruments_and_what_is_unclear_on_top() -> None:
    def box(x: int) -> np.ndarray:
        return np.array([[x, 40], [x + 20, 40], [x + 20, 60], [x, 60]], float)

    picture = MarkedPicture(
        "a.png",
        "0" * 64,
        200,
        100,
        "a",
        "knee",
        Decision.GAP,
        field=MarkedField(box=(10.0, 0.0, 189.0, 99.0)),
        regions={
            Region.GAP: (box(20), box(60)),
            Region.INSTRUMENT: (box(70),),
            Region.UNCLEAR: (box(110),),
            Region.GLARE: (box(150),),
        },
    )
    labels = labels_of(picture)
    seen = [int(labels[50, column]) for column in (5, 15, 30, 65, 80, 120, 160)]
    assert seen == [
        PixelClass.OUTSIDE,
        PixelClass.TISSUE,
        PixelClass.GAP,
        PixelClass.GAP,
        PixelClass.INSTRUMENT,
        UNKNOWN_CLASS,
        PixelClass.GLARE,
    ]


def test_an_opening_is_drawn_where_it_is_labelled_and_an_instrument_stays_before_it() -> None:
    rng = np.random.default_rng(4)
    before = _example()
    before.labels[100:120] = np.where(
        before.labels[100:120] == PixelClass.OUTSIDE, before.labels[100:120], PixelClass.INSTRUMENT
    )
    seen = 0
    for seed in range(12):
        after = with_opening(rng, before, _example(seed + 10))
        gap = after.labels == PixelClass.GAP
        changed = np.abs(after.image.astype(int) - before.image).max(axis=2)
        seen += gap.sum() > 100
        assert (after.labels[before.labels == PixelClass.INSTRUMENT] == PixelClass.INSTRUMENT).all()
        assert (after.labels[before.labels == PixelClass.OUTSIDE] == PixelClass.OUTSIDE).all()
        if gap.sum() > 100:
            assert changed[gap].mean() > 10
    assert seen >= 6


def test_a_shade_changes_no_label_and_an_instrument_changes_those_that_it_covers() -> None:
    rng = np.random.default_rng(5)
    before = _example()
    shaded = with_shade(rng, before)
    assert (shaded.labels == before.labels).all()
    assert (shaded.image <= before.image).all()
    assert (shaded.image < before.image).any()
    seen = 0
    for _ in range(8):
        after = with_instrument(rng, before, [])
        made = after.labels == PixelClass.INSTRUMENT
        seen += made.any()
        assert (after.labels[~made] == before.labels[~made]).all()
        assert not made[before.labels == PixelClass.OUTSIDE].any()
    assert seen >= 6


def test_a_gap_that_is_lit_keeps_its_labels() -> None:
    before = _example()
    before.labels[100:140, 60:160] = PixelClass.GAP
    before.image[100:140, 60:160] = 10
    after = with_lit_gap(np.random.default_rng(6), before)
    assert (after.labels == before.labels).all()
    assert after.image[110:130, 70:150].mean() > 2 * before.image[110:130, 70:150].mean()
    nothing = _example()
    assert with_lit_gap(np.random.default_rng(6), nothing) is nothing


def test_an_augmented_example_has_the_networks_shape_and_labels_inside_the_field_alone() -> None:
    rng = np.random.default_rng(7)
    for example in (_example(), _example(2, level=252.0)):
        for inputs, labels in (augmented(rng, example), plain(example)):
            assert inputs.shape == (CHANNELS, SIDE, SIDE)
            assert labels.shape == (OUTPUT_SIDE, OUTPUT_SIDE)
            assert np.isfinite(inputs).all()
            field = inputs[4, ::2, ::2] > 0
            assert (labels[~field] == UNKNOWN_CLASS).all()
            assert field.mean() > 0.2


def test_the_same_seed_draws_the_same_batches_and_sources_share_them() -> None:
    examples = [_example(seed, "one") for seed in range(9)] + [_example(20, "two")]
    first, second = (next(Mixture(examples, 3).batches()) for _ in range(2))
    other = next(Mixture(examples, 4).batches())
    assert first.inputs.shape == (BATCH, SIDE, SIDE, CHANNELS)
    assert (first.inputs == second.inputs).all()
    assert (first.labels == second.labels).all()
    assert (first.inputs != other.inputs).any()
    np.testing.assert_allclose(Mixture(examples, 3)._shares, [0.75, 0.25])


def test_the_parameters_fit_into_two_megabytes() -> None:
    parameters = drawn(1)
    assert 4 * sum(value.size for value in parameters.values()) < 1_900_000
    assert (parameters["one.kernel"] == drawn(1)["one.kernel"]).all()
    assert (parameters["one.kernel"] != drawn(2)["one.kernel"]).any()


def test_the_card_names_each_file_by_source_and_hash() -> None:
    card = data_card([_example(1, "renders")], [_example(2, "a"), _example(3, "b")], Plan(5, 10, 20))
    assert "Seed 5; 10 steps on renders, 20 on renders and pictures." in card
    for seed, source in ((2, "a"), (3, "b")):
        assert f"| {source} | {source} {seed} | `{seed:064x}` |" in card


@pytest.fixture
def folders(tmp_path: Path) -> tuple[Path, Path, Path]:
    """Renders, pictures and marks of a few drawn examples."""
    renders, pictures = tmp_path / "renders", tmp_path / "pictures"
    renders.mkdir()
    (pictures / "few").mkdir(parents=True)
    for seed in range(3):
        example = _example(seed)
        cv2.imwrite(str(renders / f"{seed}.jpg"), example.image)
        cv2.imwrite(str(renders / f"{seed}.png"), example.labels)
    marked = []
    for seed in range(2):
        path = pictures / "few" / f"{seed}.png"
        cv2.imwrite(str(path), _example(seed + 5).image)
        marked.append(
            MarkedPicture(
                path.name,
                sha256_of(path),
                STORED_SIDE,
                STORED_SIDE,
                "ab"[seed],
                "knee",
                Decision.GAP,
                regions={Region.GAP: (np.array([[60.0, 60], [120, 60], [120, 90], [60, 90]]),)},
            )
        )
    marks = tmp_path / "few.json"
    write_marks(marks, marked)
    return renders, pictures, marks


def test_renders_and_marked_pictures_become_examples(folders: tuple[Path, Path, Path]) -> None:
    renders, pictures, marks = folders
    assert [example.source for example in read_renders(renders)] == ["renders"] * 3
    found = read_marked([marks], pictures)
    assert [example.source for example in found] == ["a", "b"]
    assert all(example.shows(PixelClass.GAP) for example in found)
    assert all(example.image.shape == (STORED_SIDE, STORED_SIDE, 3) for example in found)


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ("empty", "holds no rendered examples"),
        ("unlabelled", "is not a file|cannot be read|No such file"),
        ("other size", "differ in size"),
    ],
)
def test_renders_that_cannot_be_used_are_refused(
    changed: str, message: str, folders: tuple[Path, Path, Path]
) -> None:
    renders, _, _ = folders
    for path in renders.glob("*.jpg" if changed == "empty" else "*.png"):
        if changed == "other size":
            cv2.imwrite(str(path), np.ones((10, 10), np.uint8))
        else:
            path.unlink()
    with pytest.raises(KneeGapError, match=message):
        read_renders(renders)


def test_without_the_extra_training_is_refused_in_one_line(
    folders: tuple[Path, Path, Path],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    renders, pictures, marks = folders
    real = builtins.__import__

    def without(name, *arguments, **settings):
        if name.split(".")[0] == "jax":
            raise ImportError(name)
        return real(name, *arguments, **settings)

    monkeypatch.setattr(builtins, "__import__", without)
    out = tmp_path / "out"
    assert (
        main([str(out), "--renders", str(renders), "--pictures", str(pictures), "--marks", str(marks)]) == 1
    )
    assert (
        capsys.readouterr().err
        == "train_segmentation: training needs JAX, optax and onnx: run make training\n"
    )
    assert not out.exists()


@needs_jax
def test_the_written_network_computes_what_was_fitted(
    folders: tuple[Path, Path, Path], tmp_path: Path
) -> None:
    from knee_gap_perception.training.model import logits, statistics
    from knee_gap_perception.training.onnx_file import write_network

    parameters = drawn(3)
    x = np.random.default_rng(1).normal(0, 1, (1, SIDE, SIDE, CHANNELS)).astype(np.float32)
    found: dict[str, np.ndarray] = {}
    for name, (mean, variance) in statistics(parameters, x).items():
        found |= {f"{name}.mean": np.asarray(mean), f"{name}.variance": np.asarray(variance)}
    path = tmp_path / "network.onnx"
    write_network({**parameters, **found}, path)
    network = cv2.dnn.readNetFromONNX(str(path))
    network.setInput(np.ascontiguousarray(x.transpose(0, 3, 1, 2)))
    expected = np.asarray(logits(parameters, x)).transpose(0, 3, 1, 2)
    np.testing.assert_allclose(network.forward(), expected, atol=2e-3)


@needs_jax
@pytest.mark.timeout(1200)  # JAX compiles a step for 15 s of a free core
def test_training_writes_a_network_for_all_and_one_without_each_source(
    folders: tuple[Path, Path, Path],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    renders, pictures, marks = folders
    monkeypatch.setattr("knee_gap_perception.training.mixture.BATCH", 2)
    monkeypatch.setattr("knee_gap_perception.training.command.STATISTICS_BATCHES", 1)
    out = tmp_path / "out"
    asked = [str(out), "--renders", str(renders), "--pictures", str(pictures), "--marks", str(marks)]
    assert main([*asked, "--steps", "2", "1", "--without", "a"]) == 0
    assert {path.name for path in out.iterdir()} == {
        "data_card.md",
        "first_stage.npz",
        "learned.onnx",
        "without_a.onnx",
    }
    assert main([*asked, "--without", "c"]) == 1
    assert "no picture is of the source 'c'; sources are a, b" in capsys.readouterr().err


def test_examples_are_not_changed_in_place() -> None:
    example = _example()
    kept = replace(example, image=example.image.copy(), labels=example.labels.copy())
    rng = np.random.default_rng(9)
    for _ in range(3):
        augmented(rng, example)
        with_opening(rng, example, _example(2))
        with_instrument(rng, example, [example])
    assert (example.image == kept.image).all()
    assert (example.labels == kept.labels).all()

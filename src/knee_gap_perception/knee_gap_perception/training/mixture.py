"""Batches drawn from examples of several sources, each changed at random."""

from collections.abc import Iterator, Sequence

import numpy as np
import numpy.typing as npt

from knee_gap_core.values.arrays import Image
from knee_gap_core.values.pixel_classes import PixelClass
from knee_gap_perception.training.augmentation import augmented
from knee_gap_perception.training.compositions import (
    with_instrument,
    with_lit_gap,
    with_opening,
    with_shade,
)
from knee_gap_perception.training.examples import RENDERED, Example, sources_of
from knee_gap_perception.training.fitting import Batch

Inputs = npt.NDArray[np.float32]

BATCH = 16
NEW = 6  # examples of a batch that are new; to make one takes as long as to learn from it
KEPT = 256  # from which the others are drawn
RENDERED_SHARE = 0.4  # of a batch that is mixed
OPENING_SHARE, LIT_SHARE, SHADE_SHARE, INSTRUMENT_SHARE = 0.3, 0.2, 0.25, 0.3  # of the examples


class Mixture:
    """Draws batches from a seed: the same examples and seed give the same batches."""

    def __init__(self, examples: Sequence[Example], seed: int) -> None:
        """Sources of pictures share what is not rendered by the square root of their number of files."""
        self._rng = np.random.default_rng([seed, 0x4D49])
        self._groups = [
            [example for example in examples if example.source == source] for source in sources_of(examples)
        ]
        weights = np.array([_weight(group) for group in self._groups])
        rendered = np.array([group[0].source == RENDERED for group in self._groups])
        if rendered.any() and not rendered.all():
            weights[rendered] = RENDERED_SHARE
            weights[~rendered] *= (1.0 - RENDERED_SHARE) / weights[~rendered].sum()
        self._shares = weights / weights.sum()
        self._kept: list[tuple[Inputs, Image]] = []
        self._with_instruments = [example for example in examples if example.shows(PixelClass.INSTRUMENT)]

    def batches(self) -> Iterator[Batch]:
        """Batches without end."""
        while True:
            made = [
                self._made() if index < NEW or len(self._kept) < BATCH else self._again()
                for index in range(BATCH)
            ]
            yield Batch(np.stack([inputs for inputs, _ in made]), np.stack([labels for _, labels in made]))

    def _made(self) -> tuple[Inputs, Image]:
        """A new example: input (side, side, channels) and classes."""
        inputs, labels = augmented(self._rng, self._composed())
        made = np.ascontiguousarray(inputs.transpose(1, 2, 0)), labels
        if len(self._kept) < KEPT:
            self._kept.append(made)
        else:
            self._kept[self._rng.integers(KEPT)] = made
        return made

    def _again(self) -> tuple[Inputs, Image]:
        """One that was made before, turned by quarters and mirrored."""
        inputs, labels = self._kept[self._rng.integers(len(self._kept))]
        quarters = int(self._rng.integers(4))
        inputs, labels = np.rot90(inputs, quarters), np.rot90(labels, quarters)
        return (inputs[:, ::-1], labels[:, ::-1]) if self._rng.random() < 0.5 else (inputs, labels)

    def _drawn(self) -> Example:
        group = self._groups[self._rng.choice(len(self._groups), p=self._shares)]
        return group[self._rng.integers(len(group))]

    def _composed(self) -> Example:
        rng, example = self._rng, self._drawn()
        if rng.random() < LIT_SHARE:
            example = with_lit_gap(rng, example)
        if rng.random() < SHADE_SHARE:
            example = with_shade(rng, example)
        if rng.random() < OPENING_SHARE:
            example = with_opening(rng, example, self._drawn())
        if rng.random() < INSTRUMENT_SHARE:
            example = with_instrument(rng, example, self._with_instruments)
        return example


def _weight(group: Sequence[Example]) -> float:
    return float(np.sqrt(len({example.sha256 for example in group})))

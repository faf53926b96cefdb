"""The data card: what a network was trained on, by source and SHA-256."""

from collections.abc import Sequence
from typing import Protocol

from knee_gap_core.values.pixel_classes import PixelClass
from knee_gap_perception.training.examples import Example, sources_of


class Steps(Protocol):
    """How long and from which seed."""

    @property
    def seed(self) -> int:
        """Of parameters and batches."""

    @property
    def first(self) -> int:
        """Steps on renders."""

    @property
    def second(self) -> int:
        """Steps on the mixture."""


def data_card(renders: Sequence[Example], pictures: Sequence[Example], plan: Steps) -> str:
    """The card, in Markdown: counts by source, and the hash of each file."""
    lines = [
        f"Seed {plan.seed}; {plan.first} steps on renders, {plan.second} on renders and pictures.",
        "",
        "| source | examples | files | with a gap | with an instrument |",
        "|---|---|---|---|---|",
        _row("renders", renders, str(len(renders))),
    ]
    for source in sources_of(pictures):
        group = [picture for picture in pictures if picture.source == source]
        lines.append(_row(source, group, str(len({picture.sha256 for picture in group}))))
    lines += ["", "| source | file | SHA-256 |", "|---|---|---|"]
    files = {(p.source, p.name.partition(" frame ")[0], p.sha256): None for p in pictures}
    lines += [f"| {source} | {name} | `{sha256}` |" for source, name, sha256 in files]
    return "\n".join(lines) + "\n"


def _row(name: str, group: Sequence[Example], files: str) -> str:
    gaps, made = (
        sum(example.shows(which) for example in group) for which in (PixelClass.GAP, PixelClass.INSTRUMENT)
    )
    return f"| {name} | {len(group)} | {files} | {gaps} | {made} |"

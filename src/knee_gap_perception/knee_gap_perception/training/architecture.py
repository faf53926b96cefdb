"""The network, written once for everything that is done with it: training, folding and export.

A small encoder and decoder: five channels in, the logits of the pixel classes at half the size out.
"""

from typing import Protocol, TypeVar

from knee_gap_core.values.pixel_classes import PixelClass

T = TypeVar("T")
WIDTHS = (12, 24, 48, 80)  # channels at 1/2, 1/4, 1/8 and 1/16 of the input's side


class Operations(Protocol[T]):
    """What the network is made of. `layer` is a convolution, normalised and rectified."""

    def layer(self, name: str, x: T, width: int, size: int = 3, stride: int = 1) -> T:
        """Convolution to `width` channels by a kernel of some size, normalisation, rectification."""

    def linear(self, name: str, x: T, width: int) -> T:
        """Convolution of size 1 with an offset, and nothing after it."""

    def add(self, x: T, y: T) -> T:
        """Sum; `y` may have one value for each channel."""

    def twice(self, x: T) -> T:
        """Each pixel as two by two."""

    def mean(self, x: T) -> T:
        """One value for each channel."""


def network(do: Operations[T], x: T) -> T:
    """Logits of the classes at half the size of an input."""
    half, quarter, eighth, deepest = WIDTHS
    one = do.layer("one", x, half, stride=2)
    two = do.layer("two.down", one, quarter, stride=2)
    two = do.add(two, do.layer("two", two, quarter))
    three = do.layer("three.down", two, eighth, stride=2)
    three = do.add(three, do.layer("three", three, eighth))
    four = do.layer("four.down", three, deepest, stride=2)
    four = do.add(four, do.layer("four.a", four, deepest))
    four = do.add(four, do.layer("context", do.mean(four), deepest, size=1))
    four = do.add(four, do.layer("four.b", four, deepest))
    back = do.add(
        do.twice(do.linear("three.up", four, eighth)), do.layer("three.skip", three, eighth, size=1)
    )
    back = do.add(back, do.layer("three.back", back, eighth))
    back = do.add(do.twice(do.linear("two.up", back, quarter)), do.layer("two.skip", two, quarter, size=1))
    back = do.add(back, do.layer("two.back", back, quarter))
    back = do.add(do.twice(do.linear("one.up", back, half)), do.layer("one.skip", one, half, size=1))
    back = do.add(back, do.layer("one.back", back, half))
    return do.linear("classes", back, len(PixelClass))

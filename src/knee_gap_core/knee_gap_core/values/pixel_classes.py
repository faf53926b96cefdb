"""What a pixel of a picture shows, as numbered in label pictures and in the channels of a segmentation."""

from enum import IntEnum


class PixelClass(IntEnum):
    """Class of a pixel; its value is the grey level in a label picture and the channel of a network."""

    OUTSIDE = 0  # of the field of view
    TISSUE = 1
    GAP = 2  # an opening through which one looks, past two edges, to something farther
    INSTRUMENT = 3  # all that is made: instruments, cannulas, sutures, anchors, drawn labels
    GLARE = 4  # clipped: the lamp's reflection, or tissue that is overexposed


UNKNOWN_CLASS = 255  # grey level in a label picture of a pixel that is neither trained on nor scored

"""Types of arrays: numbers, images and masks."""

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
Float32 = npt.NDArray[np.float32]
# Grey (h, w) or blue, green, red (h, w, 3).
Image = npt.NDArray[np.uint8]
Mask = npt.NDArray[np.bool_]

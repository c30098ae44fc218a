"""The labels of a segmentation."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Labels:
    """The label of the segmentation where a MuJoCo object is seen: 0 background, i + 1 object i."""

    geoms: NDArray[np.uint8]  # (model.ngeom,)
    flexes: NDArray[np.uint8]  # (model.nflex,)

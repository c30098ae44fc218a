"""Writing pictures of data whole or not at all."""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from vpd_lightning.errors import DataError
from vpd_lightning.files import AtomicPath

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def write_png(path: Path, image: NDArray[np.uint8]) -> Path:
    """Write an image (height, width, 3), sRGB, as PNG; the file is complete or not there."""
    import cv2

    is_encoded, encoded = cv2.imencode(".png", np.ascontiguousarray(image[..., ::-1]))
    if not is_encoded:
        raise DataError(f"{path}: a picture of {image.shape[1]}x{image.shape[0]} pixels cannot be encoded as PNG.")
    path.parent.mkdir(parents=True, exist_ok=True)
    with AtomicPath(path) as partial:
        partial.write_bytes(encoded.tobytes())
    return path


def write_figure(path: Path, figure: "Figure") -> Path:
    """Write a matplotlib figure as PNG; the file is complete or not there."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with AtomicPath(path) as partial, partial.open("wb") as stream:
        figure.savefig(stream, format="png", dpi=110)
    return path

"""From the source's images to the data set's: undistort, crop, rescale; the intrinsics follow exactly."""

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from data_gen.importers.depth_cleanup import smoothed, without_flying_pixels
from data_gen.importers.depth_registration import DepthRegistration
from data_gen.importers.images import MEAN_FROM, mean_depth, pixel_centers, sample_depth
from data_gen.importers.lens import distort
from data_gen.importers.recording import Recording
from data_gen.importers.settings import ImportSettings
from vpd_lightning.errors import ConfigError
from vpd_lightning.geometry.noisy_planes import relative_noise

Array = NDArray[np.float64]


class ImageGeometry:
    """One recording's way from read images to written ones.

    Undistortion keeps each view's intrinsics; colour is interpolated, depth takes the nearest pixel, and what the lens
    did not see becomes black with depth 0. Then ``crop`` is cut out and scaled to ``height`` x ``width``: colour by
    area (by interpolation where it grows), depth by the mean over the pixels that show the same surface, because an
    average over an edge lies in the air. Depth is cleaned before, as ``flying_pixels`` and ``smooth`` say, and then
    registered to the colour camera, where a sensor of its own took it.

    Raises:
        ConfigError: at construction, when the crop leaves the image or the pixels would no longer be square.
    """

    def __init__(self, recording: Recording, settings: ImportSettings) -> None:
        self.recording = recording
        left, top, width, height = settings.crop or (0, 0, recording.width, recording.height)
        if left + width > recording.width or top + height > recording.height:
            raise ConfigError(
                f"crop=[{left},{top},{width},{height}] leaves the images of {recording.name}, which are "
                f"{recording.width}x{recording.height} pixels."
            )
        self.left, self.top, self.crop_width, self.crop_height = left, top, width, height
        self.height = settings.height or (_proportional(settings.width, height, width) if settings.width else height)
        self.width = settings.width or (_proportional(settings.height, width, height) if settings.height else width)
        self._flying_jump, self._smoothing_radius = settings.flying_pixels, settings.smooth
        self._maps: dict[int, tuple[bytes, tuple[Array, Array]]] = {}
        self._registrations: dict[int, tuple[bytes, DepthRegistration]] = {}

    def intrinsics(self) -> Array:
        """Return the recording's intrinsics, (view, 3, 3) or (time, view, 3, 3), for the written images."""
        matrices = self.recording.intrinsics.copy()
        matrices[..., 0, 2] -= self.left
        matrices[..., 1, 2] -= self.top
        matrices[..., 0, :] *= self.width / self.crop_width  # pixel centres at +0.5: scaling is about the corner
        matrices[..., 1, :] *= self.height / self.crop_height
        return matrices

    def rgb(self, frame: int, view: int) -> NDArray[np.uint8]:
        """Read and convert one colour image (height, width, 3)."""
        image = self._checked("rgb", frame, view, self.recording.read_rgb(frame, view), np.uint8, 3)
        maps = self._undistortion(frame, view)
        if maps is not None:
            columns, rows = (values.astype(np.float32) for values in maps)
            image = cv2.remap(image, columns, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=0)
        image = image[self.top : self.top + self.crop_height, self.left : self.left + self.crop_width]
        if (self.height, self.width) == (self.crop_height, self.crop_width):
            return image
        grows = self.height > self.crop_height or self.width > self.crop_width
        return cv2.resize(image, (self.width, self.height), interpolation=cv2.INTER_LINEAR if grows else cv2.INTER_AREA)

    def depth(self, frame: int, view: int) -> NDArray[np.float32]:
        """Read, clean and convert one depth image (height, width); nothing is averaged over edges."""
        image = self._checked("depth", frame, view, self.recording.read_depth(frame, view), np.float32, 1)
        image = np.where(np.isfinite(image) & (image > 0), image, np.float32(0))
        sensor = self.recording.depth_camera(view)
        if self._flying_jump is not None:
            matrix = self.recording.intrinsics_at(frame)[view] if sensor is None else sensor.intrinsics
            image = without_flying_pixels(image, float(matrix[0, 0]), self._flying_jump)
        if self._smoothing_radius is not None:
            image = smoothed(image, self._smoothing_radius)
        maps = None
        if sensor is None:
            maps = self._undistortion(frame, view)
        else:
            image = self._registration(frame, view)(image)

        def sample(down: float, right: float) -> NDArray[np.float32]:
            """Return depth at the centres of the written pixels, shifted by so much of their sides."""
            rows, columns = np.meshgrid(
                self.top + pixel_centers(self.height, self.crop_height) + down * self.crop_height / self.height,
                self.left + pixel_centers(self.width, self.crop_width) + right * self.crop_width / self.width,
                indexing="ij",
            )
            if maps is not None:
                columns, rows = (map_coordinates(values, [rows, columns], order=1, mode="nearest") for values in maps)
            return sample_depth(image, rows, columns)

        rows_each, columns_each = self.crop_height / self.height, self.crop_width / self.width
        if max(rows_each, columns_each) < MEAN_FROM:
            return sample(0.0, 0.0)
        noise = float(relative_noise(image[None].astype(np.float64), image[None] > 0)[0])
        return mean_depth(sample, rows_each, columns_each, noise)

    def _undistortion(self, frame: int, view: int) -> tuple[Array, Array] | None:
        """Return where each undistorted pixel lies in the read image (column, row; pixel centres at integers)."""
        if self.recording.distortion is None or not np.any(self.recording.distortion[view]):
            return None
        matrix = self.recording.intrinsics_at(frame)[view]
        key = matrix.tobytes()
        cached = self._maps.get(view)
        if cached is None or cached[0] != key:
            maps = _distorted_pixels(matrix, self.recording.distortion[view], self.recording)
            self._maps[view] = cached = (key, maps)
        return cached[1]

    def _registration(self, frame: int, view: int) -> DepthRegistration:
        """Return what takes a view's depth to its colour image without distortion."""
        sensor, matrix = self.recording.depth_camera(view), self.recording.intrinsics_at(frame)[view]
        assert sensor is not None
        cached = self._registrations.get(view)
        if cached is None or cached[0] != matrix.tobytes():
            made = DepthRegistration(sensor, matrix, self.recording.height, self.recording.width)
            self._registrations[view] = cached = (matrix.tobytes(), made)
        return cached[1]

    def _checked(self, name: str, frame: int, view: int, image: NDArray[Any], dtype: type, channels: int) -> Any:
        taken_by = (self.recording.depth_camera(view) if name == "depth" else None) or self.recording
        shape = (taken_by.height, taken_by.width, 3)[: 3 if channels == 3 else 2]
        if image.dtype != dtype or image.shape != shape:
            raise ValueError(f"{name}({frame}, {view}) is {image.dtype} {image.shape}; it must be {dtype} {shape}")
        return image


def _distorted_pixels(matrix: Array, distortion: Array, recording: Recording) -> tuple[Array, Array]:
    v, u = np.meshgrid(np.arange(recording.height) + 0.5, np.arange(recording.width) + 0.5, indexing="ij")
    y = (v - matrix[1, 2]) / matrix[1, 1]
    x = (u - matrix[0, 2] - matrix[0, 1] * y) / matrix[0, 0]
    x, y = distort(x, y, distortion)
    columns = matrix[0, 0] * x + matrix[0, 1] * y + matrix[0, 2]
    return columns - 0.5, matrix[1, 1] * y + matrix[1, 2] - 0.5


def _proportional(given: int, side: int, other: int) -> int:
    return max(1, round(given * side / other))

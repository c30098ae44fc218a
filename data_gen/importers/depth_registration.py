"""Depth images of a sensor that is not the colour camera, registered to the colour camera's pixels.

Each pixel of the result is where the colour camera's ray meets the surface that the depth sensor measured. The points
of the depth image, projected onto the colour image with the nearest in front, give a first guess; it is refined by
going back along the ray into the depth image, which is exact on planes. What only the depth sensor sees is hidden, what
only the colour camera sees has no depth.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from data_gen.importers.images import pixel_centers, sample_depth
from data_gen.importers.lens import distort, undistort

Array = NDArray[np.float64]

_SAMPLES_PER_PIXEL = 1.5  # of the depth image along each side of a colour pixel: none on a surface is missed
_NUM_REFINEMENTS = 3
_CONVERGED = 1e-3  # share of depth by which the last refinement may still change it


@dataclass(frozen=True, eq=False)
class DepthCamera:
    """The sensor that took the depth images of one view.

    Attributes:
        height: of its images, pixels.
        width: of its images, pixels.
        intrinsics: (3, 3), pixels, pixel centres at +0.5.
        to_color: (4, 4), takes points of its frame to the colour camera's (x right, y down, z forward; metres).
        distortion: (5,) or (8,), OpenCV's k1 k2 p1 p2 k3 [k4 k5 k6]; ``None`` means none.
    """

    height: int
    width: int
    intrinsics: Array
    to_color: Array
    distortion: Array | None = None

    def __post_init__(self) -> None:
        for name, shape in (("intrinsics", (3, 3)), ("to_color", (4, 4))):
            array = getattr(self, name)
            if array.dtype != np.float64 or array.shape != shape:
                raise ValueError(f"{name} is {array.dtype} {array.shape}; it must be float64 {shape}")
        if self.distortion is not None and self.distortion.shape not in ((5,), (8,)):
            raise ValueError(f"distortion is {self.distortion.shape}; it must be (5,) or (8,)")

    def arrays(self) -> tuple[Array, Array, Array | None]:
        """Return what decides where points lie."""
        return self.intrinsics, self.to_color, self.distortion


class DepthRegistration:
    """Registers the depth images of one sensor to one colour camera without lens distortion; rays are kept.

    Args:
        camera: the depth sensor.
        color_intrinsics: (3, 3) of the colour image without distortion, pixels, pixel centres at +0.5.
        height: of the colour image.
        width: of the colour image.
    """

    def __init__(self, camera: DepthCamera, color_intrinsics: Array, height: int, width: int) -> None:
        self._camera, self._matrix, self._shape = camera, color_intrinsics, (height, width)
        self._rotation, self._shift = camera.to_color[:3, :3], camera.to_color[:3, 3]
        enlarged = _SAMPLES_PER_PIXEL * np.diag(color_intrinsics)[:2] / np.diag(camera.intrinsics)[:2]
        self._num_rows = camera.height * max(1, math.ceil(enlarged[1]))
        self._num_columns = camera.width * max(1, math.ceil(enlarged[0]))
        rows, columns = pixel_centers(self._num_rows, camera.height), pixel_centers(self._num_columns, camera.width)
        self._places = np.meshgrid(rows, columns, indexing="ij")
        x, y = _on_plane(camera.intrinsics, self._places[1] + 0.5, self._places[0] + 0.5)
        if camera.distortion is not None and np.any(camera.distortion):
            x, y = undistort(x, y, camera.distortion)
        self._depth_rays = np.stack([x, y, np.ones_like(x)], axis=-1)  # NaN where the lens model cannot be inverted
        v, u = np.meshgrid(np.arange(height) + 0.5, np.arange(width) + 0.5, indexing="ij")
        x, y = _on_plane(color_intrinsics, u, v)
        self._color_rays = np.stack([x, y, np.ones_like(x)], axis=-1).reshape(-1, 3)

    def __call__(self, depth: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return z-depth (height, width) in the colour camera's frame, metres, from the sensor's; 0: not measured."""
        guess, is_hit = self._nearest(depth)
        found = np.flatnonzero(guess > 0)
        refined, is_sure = self._refined(depth, guess[found], self._color_rays[found])
        # Where going back does not settle (at outlines, on very steep surfaces) what was thrown there counts.
        registered = np.zeros(guess.shape)
        registered[found] = np.where(is_sure, refined, np.where(is_hit[found], guess[found], 0.0))
        return registered.reshape(self._shape).astype(np.float32)

    def _nearest(self, depth: NDArray[np.float32]) -> tuple[Array, NDArray[np.bool_]]:
        """Return the depth of the nearest point on each colour pixel, or beside it, and whether it lies on it."""
        height, width = self._shape
        sampled = sample_depth(depth, *self._places).astype(np.float64)
        rays, z = self._depth_rays[sampled > 0], sampled[sampled > 0]
        points = (rays * z[:, None]) @ self._rotation.T + self._shift
        points = points[points[:, 2] > 1e-6]  # not of NaN either
        column, row = np.floor(points @ self._matrix.T / points[:, 2:])[:, :2].T
        is_in = (row >= 0) & (row < height) & (column >= 0) & (column < width)
        pixel = (row[is_in] * width + column[is_in]).astype(np.intp)
        nearest = np.full(height * width, np.inf)
        np.minimum.at(nearest, pixel, points[is_in, 2])
        padded = np.pad(nearest.reshape(height, width), 1, constant_values=np.inf)
        around = np.min([padded[i : i + height, j : j + width] for i in range(3) for j in range(3)], axis=0).ravel()
        guess = np.where(np.isinf(nearest), around, nearest)
        return np.where(np.isinf(guess), 0.0, guess), ~np.isinf(nearest)

    def _refined(self, depth: NDArray[np.float32], z: Array, rays: Array) -> tuple[Array, NDArray[np.bool_]]:
        """Return z along rays of the colour camera (pixel, 3) where they meet the surface, and whether they do."""
        camera = self._camera
        for _ in range(_NUM_REFINEMENTS):
            before = z
            seen = (rays * z[:, None] - self._shift) @ self._rotation
            in_front = seen[:, 2] > 1e-6
            plane = seen[:, :2] / np.where(in_front, seen[:, 2], 1.0)[:, None]
            x, y = plane.T
            if camera.distortion is not None and np.any(camera.distortion):
                x, y = distort(x, y, camera.distortion)
            matrix = camera.intrinsics
            columns = matrix[0, 0] * x + matrix[0, 1] * y + matrix[0, 2] - 0.5
            rows = matrix[1, 1] * y + matrix[1, 2] - 0.5
            is_inside = in_front & (rows > -0.5) & (rows < camera.height - 0.5)
            is_inside &= (columns > -0.5) & (columns < camera.width - 0.5)
            measured = sample_depth(depth, np.where(is_inside, rows, -9.0), np.where(is_inside, columns, -9.0))
            is_seen = measured > 0
            points = np.concatenate([plane, np.ones((len(plane), 1))], axis=1) * measured[:, None]
            z = np.where(is_seen, points @ self._rotation[2] + self._shift[2], before)
        return z, is_seen & (np.abs(z - before) <= _CONVERGED * before) & (z > 0)


def _on_plane(matrix: Array, u: Array, v: Array) -> tuple[Array, Array]:
    """Return the rays x/z, y/z of pixels (column ``u``, row ``v``)."""
    y = (v - matrix[1, 2]) / matrix[1, 1]
    return (u - matrix[0, 2] - matrix[0, 1] * y) / matrix[0, 0], y

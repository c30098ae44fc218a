"""A depth camera that errs as real ones do: noise, holes, edges, grazing angles, steps, exposure, poses."""

import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, maximum_filter, minimum_filter

from vpd_lightning.data.sensors.settings import SensorSettings
from vpd_lightning.randomness import numpy_generator

_STATIC_SHARE = 0.8
"""Share of a hole's shape that stays from frame to frame; the other part, 0.6, is drawn anew (squares add to 1)."""

_MAX_TANGENT = 4.0
"""Tangent of the angle between normal and ray beyond the grazing one where the bias no longer grows."""


class Sensor:
    """Errors of all cameras of one trajectory; depends on the seed, the trajectory's name, frame and view alone.

    With ``percent_at_median`` distances are read as if the scene were scaled to lie where the sensor's noise has that
    percentage at ``median_depth`` (metres): bias, steps and noise keep their proportions. Poses err in metres.
    """

    def __init__(self, settings: SensorSettings, *, seed: int, trajectory: str, median_depth: float) -> None:
        self.settings, self.seed, self.trajectory = settings, seed, trajectory
        self.scale = 1.0
        if settings.percent_at_median is not None and median_depth > 0:
            self.scale = self._distance_of(settings.percent_at_median) / median_depth

    def noise(self, depth: Float[NDArray[np.floating], "..."]) -> Float[NDArray[np.float64], "..."]:
        """Return the standard deviation in metres at distances in metres.

        The percentage is linear between the measured distances, and proportional to distance outside of them, as
        that of triangulation is.
        """
        settings, scaled = self.settings, np.asarray(depth, np.float64) * self.scale
        distances, percents = np.asarray(settings.distances), np.asarray(settings.noise_percent)
        inside = np.interp(scaled, distances, percents)
        outside = scaled / np.clip(scaled, distances[0], distances[-1])
        return inside * outside * np.asarray(depth, np.float64) / 100

    def measure_depth(
        self,
        depth: Float32[NDArray[np.float32], "height width"],
        intrinsics: Float[NDArray[np.float64], "3 3"],
        frame: int,
        view: int,
    ) -> Float32[NDArray[np.float32], "height width"]:
        """Return what is measured of a true depth image (metres along the optical axis; 0 where nothing is)."""
        settings = self.settings
        generator = self._generator("depth", frame, view)
        true = np.where(np.isfinite(depth) & (depth > 0), depth, 0.0).astype(np.float64)
        seen = true > 0
        # Drawn whatever is seen: the stream must not depend on the picture.
        noise = _smooth(generator.standard_normal(true.shape), settings.correlation_length)
        patches = _STATIC_SHARE * self._patches("hole", 0, view, true.shape)
        patches += (1 - _STATIC_SHARE**2) ** 0.5 * self._patches("hole in a frame", frame, view, true.shape)
        chance, mixture = generator.random(true.shape), generator.random(true.shape)

        edge, near, far = _edges(true, settings.edge_step)
        # The normal of a pixel beside a jump is a mixture of two surfaces'.
        measured = true + np.where(edge, 0.0, self._bias(true, intrinsics, view))
        measured = measured + self.noise(true) * noise
        flying = edge & (chance >= settings.edge_dropout) & (chance < settings.edge_dropout + settings.flying_share)
        measured = np.where(flying, near + mixture * (far - near), measured)
        lost = (edge & (chance < settings.edge_dropout)) | (patches < _quantile_of(settings.hole_share))
        measured = self._in_steps(measured)
        return np.where(seen & ~lost & (measured > 0), measured, 0.0).astype(np.float32)

    def measure_rgb(
        self, rgb: UInt8[NDArray[np.uint8], "height width 3"], frame: int, view: int
    ) -> UInt8[NDArray[np.uint8], "height width 3"]:
        """Return a picture with this camera's exposure and noise."""
        settings = self.settings
        generator = self._generator("colour", frame, view)
        always = self._generator("exposure", 0, view).standard_normal()
        exposure = 1 + settings.exposure_percent / 100 * (always + 0.5 * generator.standard_normal())
        noisy = rgb * exposure + 255 * settings.color_noise * generator.standard_normal(rgb.shape)
        return np.clip(np.rint(noisy), 0, 255).astype(np.uint8)

    def measure_pose(
        self, cam_to_world: Float[NDArray[np.float64], "*time 4 4"], view: int
    ) -> Float[NDArray[np.float64], "*time 4 4"]:
        """Return poses with the one error that this camera has throughout the trajectory, in its own axes."""
        settings = self.settings
        draws = self._generator("pose", 0, view).standard_normal(6)
        turn, angle = np.radians(settings.pose_degrees) * draws[3:], np.eye(4)
        size = float(np.linalg.norm(turn))
        if size > 0:
            x, y, z = turn / size
            cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
            angle[:3, :3] += np.sin(size) * cross + (1 - np.cos(size)) * cross @ cross  # Rodrigues
        angle[:3, 3] = settings.pose_offset * draws[:3]
        return cam_to_world @ angle if settings.pose_offset or settings.pose_degrees else cam_to_world

    def trigger_step(self, view: int, frame_time: float) -> int:
        """Return by how many ``trigger_steps``-ths of a frame time this camera is late."""
        steps, late = self.settings.trigger_steps, self._generator("trigger", 0, view).random()
        return round(late * self.settings.trigger_offset / frame_time * steps)

    def _generator(self, purpose: str, frame: int, view: int) -> np.random.Generator:
        return numpy_generator(self.seed, self.trajectory, frame, view, f"sensor/{purpose}")

    def _patches(self, purpose: str, frame: int, view: int, shape: tuple[int, ...]) -> NDArray[np.float64]:
        return _smooth(self._generator(purpose, frame, view).standard_normal(shape), self.settings.hole_size)

    def _bias(
        self, depth: NDArray[np.float64], intrinsics: NDArray[np.float64], view: int
    ) -> Float[NDArray[np.float64], "height width"]:
        settings = self.settings
        sign = 1.0 if self._generator("grazing", 0, view).random() < 0.5 else -1.0
        over = _tangent(depth, intrinsics) - np.tan(np.radians(settings.grazing_degrees))
        return sign * settings.grazing_bias * self.scale * depth**2 * np.clip(over, 0, _MAX_TANGENT)

    def _in_steps(self, depth: NDArray[np.float64]) -> NDArray[np.float64]:
        scaled = np.maximum(depth, 1e-9) * self.scale
        if self.settings.disparity_step > 0:
            nearness = np.rint(1 / scaled / self.settings.disparity_step) * self.settings.disparity_step
            scaled = np.where(nearness > 0, 1 / np.maximum(nearness, 1e-12), 0.0)
        if self.settings.depth_step > 0:
            scaled = np.rint(scaled / self.settings.depth_step) * self.settings.depth_step
        return scaled / self.scale

    def _distance_of(self, percent: float) -> float:
        distances, percents = np.asarray(self.settings.distances), np.asarray(self.settings.noise_percent)
        inside = float(np.interp(percent, percents, distances))
        return inside * percent / float(np.clip(percent, percents[0], percents[-1]))


def median_depth(depth: Float32[NDArray[np.float32], "..."], far: float) -> float:
    """Return the median of the depths nearer than ``far``, in metres; 0 where nothing is."""
    known = depth[np.isfinite(depth) & (depth > 0) & (depth <= far)]
    return float(np.median(known)) if known.size else 0.0


def _smooth(white: NDArray[np.float64], length: float) -> NDArray[np.float64]:
    """Return white noise of variance one, smoothed, with variance one again."""
    if length <= 0:
        return white
    impulse = np.zeros(white.shape)
    impulse[0, 0] = 1.0
    return gaussian_filter(white, length, mode="wrap") / np.sqrt(
        (gaussian_filter(impulse, length, mode="wrap") ** 2).sum()
    )


def _quantile_of(share: float) -> float:
    """Return the value below which this share of a standard normal lies."""
    from scipy.special import ndtri

    return float(ndtri(share)) if share > 0 else -np.inf


def _edges(
    depth: NDArray[np.float64], step: float
) -> tuple[Bool[NDArray[np.bool_], "height width"], NDArray[np.float64], NDArray[np.float64]]:
    """Return the pixels beside a jump in depth that a plane does not explain, and the depths on both sides of it."""
    far = maximum_filter(depth, 3)
    near = minimum_filter(np.where(depth > 0, depth, np.inf), 3)
    near = np.where(np.isfinite(near), near, 0.0)
    nearness = np.where(depth > 0, 1 / np.maximum(depth, 1e-9), 0.0)  # linear across the picture of a plane
    bend = np.zeros(depth.shape)
    for axis in (0, 1):
        along = np.moveaxis(nearness, axis, 0)
        found = np.moveaxis(bend, axis, 0)
        found[1:-1] = np.maximum(found[1:-1], np.abs(along[2:] - 2 * along[1:-1] + along[:-2]))
    return (depth > 0) & (bend * depth > step) & (far > near), near, far


def _tangent(depth: NDArray[np.float64], intrinsics: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the tangent of the angle between each pixel's ray and its surface's normal."""
    height, width = depth.shape
    if min(height, width) < 3:
        return np.zeros(depth.shape)
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    rays = np.stack([x, y, np.ones_like(x)], axis=-1) @ np.linalg.inv(intrinsics).T
    points = rays * depth[..., None]
    normals = np.cross(np.gradient(points, axis=1), np.gradient(points, axis=0))
    lengths = np.linalg.norm(normals, axis=-1) * np.linalg.norm(rays, axis=-1)
    cosine = np.abs((normals * rays).sum(axis=-1)) / np.maximum(lengths, 1e-30)
    cosine = np.where(lengths > 0, np.clip(cosine, 1e-3, 1.0), 1.0)
    return np.sqrt(1 - cosine**2) / cosine

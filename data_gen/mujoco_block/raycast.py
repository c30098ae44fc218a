"""Pictures without GL: MuJoCo's own ray casting, with antialiasing, diffuse shading and a soft shadow.

Depth and segmentation come from the ray through each pixel's centre, in double precision. The floor and the background
never change, so each camera's empty picture is computed once, and only the rectangle that the block and its shadow can
reach is cast again. Same machine and versions: same bytes.
"""

import math
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from data_gen.mujoco_block.settings import MujocoBlockSettings

_NUM_LIGHTS = 9  # directions that sample the light's disc
_FLOOR, _BLOCK = 0, 1


def floor_color(points: NDArray[np.float64], settings: MujocoBlockSettings) -> NDArray[np.float64]:
    """Return the floor's colour (..., 3) at world points (..., >= 2): a checker with soft borders."""
    floor = settings.floor
    wave = np.sin(np.pi * points[..., 0] / floor.tile) * np.sin(np.pi * points[..., 1] / floor.tile)
    return np.asarray(floor.color) + floor.contrast * np.tanh(3.0 * wave)[..., None]


@dataclass
class _View:
    """One camera: rays, and the empty scene through it."""

    origin: NDArray[np.float64]
    directions: NDArray[np.float64]  # (height * s, width * s, 3), one unit along the optical axis
    centers: NDArray[np.float64]  # (height, width, 3)
    world_to_pixel: NDArray[np.float64]  # (3, 4)
    colors: NDArray[np.float64]  # (height * s, width * s, 3), lit floor without shadow
    floor_share: NDArray[np.float64]  # (height * s, width * s), what the light adds there (0 off the floor)
    rgb: NDArray[np.uint8]
    depth: NDArray[np.float32]


class RaycastRenderer:
    """Renders the block scene; pixels, depth (metres along the optical axis, 0 = nothing) and segmentation."""

    name = "raycast"

    def __init__(
        self,
        settings: MujocoBlockSettings,
        model: Any,
        intrinsics: NDArray[np.float64],
        cam_to_world: NDArray[np.float64],
    ) -> None:
        self.settings, self.model = settings, model
        self.face_colors = np.asarray(settings.block.face_colors)
        self.half = np.full(3, settings.block.side / 2)
        self.lights = _light_directions(settings.light.direction, settings.light.softness)
        corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float)
        self.corners = corners * self.half
        data = mujoco.MjData(model)
        data.qpos[2] = 1e6  # the empty scene
        mujoco.mj_forward(model, data)
        self.views = [self._view(data, k, pose) for k, pose in zip(intrinsics, cam_to_world, strict=True)]

    def close(self) -> None:
        """Nothing to free."""

    def render(
        self, data: Any, rgb: NDArray[np.uint8], depth: NDArray[np.float32], segmentation: NDArray[np.uint8]
    ) -> None:
        """Fill ``rgb`` (view, height, width, 3), ``depth`` and ``segmentation`` (view, height, width)."""
        position, rotation = data.geom_xpos[_BLOCK].copy(), data.geom_xmat[_BLOCK].reshape(3, 3).copy()
        corners = position + self.corners @ rotation.T
        reach = np.concatenate([corners, *(self._cast_on_floor(corners, light) for light in self.lights)])
        for index, view in enumerate(self.views):
            rgb[index], depth[index], segmentation[index] = view.rgb, view.depth, 0
            rows, columns = self._rectangle(view, reach)
            if rows.stop > rows.start and columns.stop > columns.start:
                part = (index, rows, columns)
                rgb[part] = self._colors(data, view, rows, columns, position, rotation)
                depth[part], segmentation[part] = self._depth(data, view, rows, columns)

    def _depth(self, data: Any, view: _View, rows: slice, columns: slice) -> tuple[NDArray[Any], NDArray[Any]]:
        distance, geom, _ = self._cast(data, view.origin, view.centers[rows, columns])
        return np.where(geom >= 0, distance, 0.0).astype(np.float32), (geom == _BLOCK).astype(np.uint8)

    def _colors(
        self,
        data: Any,
        view: _View,
        rows: slice,
        columns: slice,
        position: NDArray[np.float64],
        rotation: NDArray[np.float64],
    ) -> NDArray[np.uint8]:
        scale = self.settings.supersampling
        fine = (slice(rows.start * scale, rows.stop * scale), slice(columns.start * scale, columns.stop * scale))
        directions = view.directions[fine]
        distance, geom, normals = self._cast(data, view.origin, directions)
        colors = view.colors[fine].copy()
        on_block = geom == _BLOCK
        colors[on_block] = self._block_color(normals[on_block], rotation)
        on_floor = geom == _FLOOR
        points = view.origin + directions[on_floor] * distance[on_floor][:, None]
        shade = self._shadow(points, position, rotation)
        colors[on_floor] *= (1.0 - shade * view.floor_share[fine][on_floor])[:, None]
        return _average(colors, scale)

    def _block_color(self, normals: NDArray[np.float64], rotation: NDArray[np.float64]) -> NDArray[np.float64]:
        local = normals @ rotation
        axis = np.abs(local).argmax(axis=1)
        negative = np.take_along_axis(local, axis[:, None], axis=1)[:, 0] < 0
        light = self.settings.light
        lambert = np.maximum(-normals @ self.lights[0], 0.0)
        return self.face_colors[2 * axis + negative] * (light.ambient + light.diffuse * lambert)[:, None]

    def _shadow(
        self, points: NDArray[np.float64], position: NDArray[np.float64], rotation: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return the share of the light's disc that the block hides from each point (slab test per direction)."""
        hidden = np.zeros(len(points))
        offset = points - position
        along = offset @ self.lights[0]
        spread = math.tan(math.radians(self.settings.light.softness)) * (np.abs(along) + 1.0)
        near = (offset * offset).sum(1) - along * along <= (np.linalg.norm(self.half) + spread) ** 2
        local = offset[near] @ rotation
        for light in self.lights:
            direction = -light @ rotation
            direction = np.where(np.abs(direction) < 1e-12, 1e-12, direction)
            first = (-self.half - local) / direction
            second = (self.half - local) / direction
            enter = np.minimum(first, second).max(axis=1)
            leave = np.maximum(first, second).min(axis=1)
            hidden[near] += (leave > np.maximum(enter, 1e-9)).astype(float) / len(self.lights)
        return hidden

    def _cast_on_floor(self, points: NDArray[np.float64], light: NDArray[np.float64]) -> NDArray[np.float64]:
        return points - light * (points[:, 2:] / light[2])

    def _rectangle(self, view: _View, points: NDArray[np.float64]) -> tuple[slice, slice]:
        """Return the rows and columns in which points may be seen; the whole image when one is behind the camera."""
        height, width = view.depth.shape
        projected = points @ view.world_to_pixel[:, :3].T + view.world_to_pixel[:, 3]
        if projected[:, 2].min() < 1e-3:
            return slice(0, height), slice(0, width)
        pixels = projected[:, :2] / projected[:, 2:]
        low = np.clip(np.floor(pixels.min(axis=0)) - 1, 0, [width, height]).astype(int)
        high = np.clip(np.ceil(pixels.max(axis=0)) + 1, 0, [width, height]).astype(int)
        return slice(int(low[1]), int(high[1])), slice(int(low[0]), int(high[0]))

    def _view(self, data: Any, intrinsics: NDArray[np.float64], cam_to_world: NDArray[np.float64]) -> _View:
        camera, scale, light = self.settings.camera, self.settings.supersampling, self.settings.light
        origin, rotation = cam_to_world[:3, 3].copy(), cam_to_world[:3, :3]
        fine = _ray_directions(intrinsics, rotation, camera.height, camera.width, scale)
        centers = _ray_directions(intrinsics, rotation, camera.height, camera.width, 1)
        distance, geom, normals = self._cast(data, origin, fine)
        on_floor = geom == _FLOOR
        points = origin + fine * distance[..., None]
        lambert = max(0.0, -float(self.lights[0][2]))
        lit = floor_color(points, self.settings) * (light.ambient + light.diffuse * lambert)
        colors = np.where(on_floor[..., None], lit, np.asarray(self.settings.floor.background))
        share = np.where(on_floor, light.diffuse * lambert / (light.ambient + light.diffuse * lambert), 0.0)
        center_distance, center_geom, _ = self._cast(data, origin, centers)
        world_to_camera = np.linalg.inv(cam_to_world)[:3]
        return _View(
            origin=origin,
            directions=fine,
            centers=centers,
            world_to_pixel=intrinsics @ world_to_camera,
            colors=colors,
            floor_share=share,
            rgb=_average(colors, scale),
            depth=np.where(center_geom >= 0, center_distance, 0.0).astype(np.float32),
        )

    def _cast(
        self, data: Any, origin: NDArray[np.float64], directions: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.int32], NDArray[np.float64]]:
        """Return distance (in lengths of the direction; -1 = nothing), geom index (-1 = nothing) and unit normal."""
        shape = directions.shape[:-1]
        count = math.prod(shape)
        geom, distance = np.empty(count, np.int32), np.empty(count)
        normal = np.empty(3 * count)
        rays = np.ascontiguousarray(directions).reshape(-1)
        mujoco.mj_multiRay(
            self.model, data, origin, rays, None, True, -1, geom, distance, normal, count, mujoco.mjMAXVAL
        )
        return distance.reshape(shape), geom.reshape(shape), normal.reshape(*shape, 3)


def _ray_directions(
    intrinsics: NDArray[np.float64], rotation: NDArray[np.float64], height: int, width: int, scale: int
) -> NDArray[np.float64]:
    """Return rays (height * scale, width * scale, 3) in the world, one unit long along the optical axis."""
    x = ((np.arange(width * scale) + 0.5) / scale - intrinsics[0, 2]) / intrinsics[0, 0]
    y = ((np.arange(height * scale) + 0.5) / scale - intrinsics[1, 2]) / intrinsics[1, 1]
    grid = np.stack([*np.meshgrid(x, y), np.ones((height * scale, width * scale))], axis=-1)
    return np.ascontiguousarray(grid @ rotation.T)


def _light_directions(direction: list[float], softness: float) -> NDArray[np.float64]:
    """Return unit directions (light, 3): the middle of the light's disc first, then a spiral over it."""
    middle = np.asarray(direction, float) / np.linalg.norm(direction)
    if softness <= 0:
        return middle[None]
    side = np.cross(middle, [1.0, 0.0, 0.0] if abs(middle[0]) < 0.9 else [0.0, 1.0, 0.0])
    side /= np.linalg.norm(side)
    up = np.cross(middle, side)
    index = np.arange(1, _NUM_LIGHTS)
    radius = math.tan(math.radians(softness)) * np.sqrt(index / (_NUM_LIGHTS - 1))
    angle = index * math.pi * (3.0 - math.sqrt(5.0))
    disc = radius[:, None] * (np.cos(angle)[:, None] * side + np.sin(angle)[:, None] * up)
    spread = middle + disc
    return np.concatenate([middle[None], spread / np.linalg.norm(spread, axis=1, keepdims=True)])


def _average(colors: NDArray[np.float64], scale: int) -> NDArray[np.uint8]:
    """Average ``scale`` x ``scale`` samples per pixel and round to uint8."""
    height, width = colors.shape[0] // scale, colors.shape[1] // scale
    means = np.clip(colors, 0, 1).reshape(height, scale, width, scale, 3).mean(axis=(1, 3))
    return np.rint(255 * means).astype(np.uint8)

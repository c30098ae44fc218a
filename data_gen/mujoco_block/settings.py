"""Settings of the MuJoCo Block scene: no value stands here, all of them stand in ``conf/data_gen/mujoco_block/``."""

import math
from dataclasses import dataclass
from typing import Any

from omegaconf import MISSING

from vpd_lightning.data import schema


@dataclass
class SplitSettings:
    """Number of trajectories per split."""

    train: int = MISSING
    validation: int = MISSING
    test: int = MISSING


@dataclass
class CameraSettings:
    """Cameras on an upper half sphere around ``target``, all looking at it."""

    num_views: int = MISSING
    height: int = MISSING
    width: int = MISSING
    field_of_view: float = MISSING  # vertical, degrees
    radius: float = MISSING  # m
    elevation_min: float = MISSING  # degrees above the horizon
    elevation_max: float = MISSING
    target: list[float] = MISSING  # m


@dataclass
class BlockSettings:
    """The block and its contact with the floor."""

    side: float = MISSING  # m
    mass: float = MISSING  # kg
    friction: float = MISSING  # sliding, of block and floor
    face_colors: list[list[float]] = MISSING  # +x -x +y -y +z -z, sRGB in [0, 1]


@dataclass
class FloorSettings:
    """A finite square floor at z = 0 with a soft checker pattern."""

    half_size: float = MISSING  # m
    color: list[float] = MISSING
    contrast: float = MISSING  # amplitude of the pattern, in sRGB
    tile: float = MISSING  # side of a tile, m
    background: list[float] = MISSING  # colour where there is no floor


@dataclass
class LightSettings:
    """One directional light with a cast shadow, and ambient light."""

    direction: list[float] = MISSING  # where the light travels
    ambient: float = MISSING
    diffuse: float = MISSING
    softness: float = MISSING  # angular radius of the light, degrees (ray cast only)


@dataclass
class TossSettings:
    """Uniform ranges of the initial state; the orientation is uniform over all rotations."""

    position_min: list[float] = MISSING  # m
    position_max: list[float] = MISSING
    velocity_max: list[float] = MISSING  # m/s, symmetric about 0
    angular_velocity_max: list[float] = MISSING  # rad/s about the block's axes, symmetric about 0


@dataclass
class StorageSettings:
    """How files are written."""

    compression: str = MISSING
    depth_encoding: str = MISSING


@dataclass
class MujocoBlockSettings:
    """Everything that decides what is in the data set (with the seed)."""

    splits: SplitSettings = MISSING
    num_frames: int = MISSING
    frame_time: float = MISSING  # s
    timestep: float = MISSING  # s, of the physics
    near: float = MISSING  # m along rays
    far: float = MISSING
    workspace_min: list[float] = MISSING
    workspace_max: list[float] = MISSING
    renderer: str = MISSING  # auto | egl | osmesa | raycast
    supersampling: int = MISSING  # rays per pixel side (ray cast); MSAA samples are its square (GL)
    camera: CameraSettings = MISSING
    block: BlockSettings = MISSING
    floor: FloorSettings = MISSING
    light: LightSettings = MISSING
    toss: TossSettings = MISSING
    storage: StorageSettings = MISSING

    def __post_init__(self) -> None:
        camera, block, floor, toss = self.camera, self.block, self.floor, self.toss
        counts = {f"splits.{name}": getattr(self.splits, name) for name in ("train", "validation", "test")}
        for name, value in counts.items():
            _check(0 <= value <= 1_000_000, name, value, "0 to 1,000,000")
        _check(sum(counts.values()) > 0, "splits", counts, "at least one trajectory")
        _check(1 <= self.num_frames <= 10_000, "num_frames", self.num_frames, "1 to 10,000")
        _check(0 < self.timestep <= 0.02, "timestep", self.timestep, "above 0, at most 0.02 s")
        _check(0 < self.frame_time <= 10, "frame_time", self.frame_time, "above 0, at most 10 s")
        steps = self.frame_time / self.timestep
        _check(
            abs(steps - round(steps)) < 1e-6 and steps > 0.5,
            "frame_time",
            self.frame_time,
            f"a multiple of timestep ({self.timestep})",
        )
        _check(0 < self.near < self.far, "near, far", (self.near, self.far), "0 < near < far")
        _check(1 <= camera.num_views <= 256, "camera.num_views", camera.num_views, "1 to 256")
        for name in ("height", "width"):
            _check(8 <= getattr(camera, name) <= 2048, f"camera.{name}", getattr(camera, name), "8 to 2048")
        _check(1 <= camera.field_of_view <= 150, "camera.field_of_view", camera.field_of_view, "1 to 150 degrees")
        _check(camera.radius > 0, "camera.radius", camera.radius, "above 0")
        _check(
            0 < camera.elevation_min <= camera.elevation_max < 90,
            "camera.elevation",
            (camera.elevation_min, camera.elevation_max),
            "0 < min <= max < 90 degrees",
        )
        _check(0 < block.side <= 10, "block.side", block.side, "above 0, at most 10 m")
        _check(block.mass > 0, "block.mass", block.mass, "above 0")
        _check(0 <= block.friction <= 10, "block.friction", block.friction, "0 to 10")
        _check(len(block.face_colors) == 6, "block.face_colors", block.face_colors, "six colours")
        _check(floor.half_size > 0 and floor.tile > 0, "floor", (floor.half_size, floor.tile), "sizes above 0")
        _check(1 <= self.supersampling <= 4, "supersampling", self.supersampling, "1 to 4")
        _check(
            self.renderer in ("auto", "egl", "osmesa", "raycast"),
            "renderer",
            self.renderer,
            "auto, egl, osmesa, raycast",
        )
        _check(self.light.direction[2] < 0, "light.direction", self.light.direction, "a downward direction")
        for name in ("workspace_min", "workspace_max"):
            _check(len(getattr(self, name)) == 3, name, getattr(self, name), "three numbers")
        for name in ("position_min", "position_max", "velocity_max", "angular_velocity_max"):
            _check(len(getattr(toss, name)) == 3, f"toss.{name}", getattr(toss, name), "three numbers")
        lowest = toss.position_min[2] - block.side * math.sqrt(3) / 2
        _check(lowest > 0, "toss.position_min", toss.position_min, "a height at which the block cannot touch the floor")
        _check(
            self.storage.compression in schema.COMPRESSIONS,
            "storage.compression",
            self.storage.compression,
            ", ".join(schema.COMPRESSIONS),
        )
        _check(
            self.storage.depth_encoding in schema.DEPTH_ENCODINGS,
            "storage.depth_encoding",
            self.storage.depth_encoding,
            ", ".join(schema.DEPTH_ENCODINGS),
        )

    @property
    def substeps(self) -> int:
        """Physics steps per frame."""
        return round(self.frame_time / self.timestep)


def _check(is_allowed: bool, name: str, given: Any, allowed: str) -> None:
    if not is_allowed:
        raise ValueError(f"{name} is {given}; allowed: {allowed}")

"""Settings of the MuJoCo Block scene: no value stands here, all of them stand in ``conf/data_gen/mujoco_block/``."""

import math
from dataclasses import dataclass
from typing import ClassVar

from omegaconf import MISSING

from data_gen.scene_settings import SceneSettings, require


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
class MujocoBlockSettings(SceneSettings):
    """Everything that decides what is in the data set (with the seed)."""

    RENDERERS: ClassVar[tuple[str, ...]] = ("auto", "egl", "osmesa", "blender", "raycast")

    block: BlockSettings = MISSING
    floor: FloorSettings = MISSING
    light: LightSettings = MISSING
    toss: TossSettings = MISSING

    def __post_init__(self) -> None:
        super().__post_init__()
        block, floor, toss = self.block, self.floor, self.toss
        require(0 < block.side <= 10, "block.side", block.side, "above 0, at most 10 m")
        require(block.mass > 0, "block.mass", block.mass, "above 0")
        require(0 <= block.friction <= 10, "block.friction", block.friction, "0 to 10")
        require(len(block.face_colors) == 6, "block.face_colors", block.face_colors, "six colours")
        require(floor.half_size > 0 and floor.tile > 0, "floor", (floor.half_size, floor.tile), "sizes above 0")
        require(self.light.direction[2] < 0, "light.direction", self.light.direction, "a downward direction")
        for name in ("position_min", "position_max", "velocity_max", "angular_velocity_max"):
            require(len(getattr(toss, name)) == 3, f"toss.{name}", getattr(toss, name), "three numbers")
        lowest = toss.position_min[2] - block.side * math.sqrt(3) / 2
        allowed = "a height at which the block cannot touch the floor"
        require(lowest > 0, "toss.position_min", toss.position_min, allowed)

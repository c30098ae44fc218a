"""Floor, ground around it, dome and lights of a MOVi-like scene.

Kubric's floor is part of a dome 100 m across. Here a flat floor meets a dome of the same size, so that every pixel has
a depth; nothing collides with the dome.
"""

import colorsys
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from data_gen.cameras import mjcf_numbers
from data_gen.movi.mesh import Mesh
from data_gen.movi.mesh_xml import mesh_xml, texture_xml
from data_gen.movi.settings import LIT_HALF_SIZE, MoviSettings

GREY = (0.5, 0.5, 0.5)  # Kubric's "gray", sRGB
TILE = 10.0  # m, side of the floor's texture before it repeats
_AROUND, _UP = 32, 8  # faces of the dome
_DOWN = (0.0, 0.0, -1.0)
_OVERLAP, _SINK = 0.25, 5e-4  # m
_SKIRT = 0.02  # rad, how far the dome reaches below the floor
_FILLS = ((-6.4, 2.9, -4.3), (4.7, 4.0, -3.0))  # directions of CLEVR's key and fill lamps
_FILL_SHARES = (1.0, 0.45)


@dataclass(frozen=True, eq=False)
class Surroundings:
    """How floor and dome look in one trajectory: a colour for both, or a texture for each."""

    color: tuple[float, float, float]  # sRGB, 0 to 1
    floor_texture: NDArray[np.uint8] | None = None  # (height, width, 3), repeats every ``TILE`` metres
    dome_texture: NDArray[np.uint8] | None = None  # (height, width, 3): left to right around, horizon at the bottom


def draw_surroundings(look: str, generator: np.random.Generator) -> Surroundings:
    """Return surroundings of a kind: ``grey``, ``hue`` or ``texture``."""
    if look == "grey":
        return Surroundings(GREY)
    if look == "hue":
        return Surroundings(colorsys.hsv_to_rgb(float(generator.uniform()), 1.0, 1.0))
    from data_gen.movi.textures import floor_texture, panorama_texture

    return Surroundings((1.0, 1.0, 1.0), floor_texture(generator), panorama_texture(generator))


def surroundings_assets(settings: MoviSettings, look: Surroundings) -> str:
    """Return the MJCF assets of floor, ground and dome."""
    plain = f'rgba="{mjcf_numbers(look.color)} 1"'
    floor, ground, dome = plain, plain, plain
    textures = ""
    if look.floor_texture is not None:
        textures += texture_xml("floor", look.floor_texture)
        floor = f'texture="floor" texuniform="true" texrepeat="{1 / TILE!r} {1 / TILE!r}"'
        ground = 'texture="floor"'
    if look.dome_texture is not None:
        textures += texture_xml("dome", look.dome_texture)
        dome = 'texture="dome"'
    # The normals of ground and dome look down, away from all lights: they show their own colour, as bright as the
    # floor's.
    emission = max(0.0, _floor_brightness(settings) - settings.light.ambient)
    radius = settings.floor.dome_radius
    return f"""{textures}{mesh_xml("dome", dome_mesh(radius))}{mesh_xml("ground", ground_mesh(radius))}
    <material name="floor" {floor} specular="0" shininess="0"/>
    <material name="ground" {ground} specular="0" shininess="0" emission="{emission!r}"/>
    <material name="dome" {dome} specular="0" shininess="0" emission="{emission!r}"/>"""


def surroundings_bodies(settings: MoviSettings) -> str:
    """Return the MJCF elements of floor, ground, dome and lights for the world body."""
    light = settings.light
    lights = [_light(light.direction, light.sun, casts_shadow=True)]
    for direction, share in zip(_FILLS, _FILL_SHARES, strict=True):
        lights.append(_light(direction, share * light.fill, casts_shadow=False))
    return f"""{"".join(lights)}
    <geom name="floor" type="plane" size="{LIT_HALF_SIZE!r} {LIT_HALF_SIZE!r} {LIT_HALF_SIZE!r}" material="floor"
      contype="0" conaffinity="0"/>
    <geom name="ground" type="mesh" mesh="ground" material="ground" contype="0" conaffinity="0"/>
    <geom name="dome" type="mesh" mesh="dome" material="dome" contype="0" conaffinity="0"/>"""


def ground_mesh(radius: float) -> Mesh:
    """Return the square frame between the lit floor and the dome; its texture goes on from the floor's."""
    square = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    # Its inner border lies under the floor's, so that no rounding opens a gap, and its outer border hangs down, unseen
    # behind the dome: MuJoCo refuses a mesh that is flat all over.
    flat = np.concatenate([(LIT_HALF_SIZE - _OVERLAP) * square, radius * square, radius * square])
    corner, after = np.arange(8), np.array([1, 2, 3, 0, 5, 6, 7, 4])
    faces = np.concatenate([np.stack([corner, corner + 4, after + 4], 1), np.stack([corner, after + 4, after], 1)])
    return Mesh(
        vertices=np.column_stack([flat, np.repeat([-_SINK, 0.0, -1.0], 4)]),
        faces=faces.astype(np.int32),
        texcoords=flat / TILE,
        normals=np.tile(_DOWN, (12, 1)),
    )


def dome_mesh(radius: float) -> Mesh:
    """Return the inside of a half sphere around the origin; u runs around it, v from the horizon to the top."""
    azimuth, elevation = np.meshgrid(np.linspace(0, 2 * np.pi, _AROUND + 1), np.linspace(-_SKIRT, np.pi / 2, _UP + 1))
    flat = np.cos(elevation)
    points = radius * np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)], axis=-1)
    texcoords = np.stack([azimuth / (2 * np.pi), np.clip(elevation / (np.pi / 2), 0, 1)], axis=-1)
    row, column = (index.reshape(-1) for index in np.meshgrid(np.arange(_UP), np.arange(_AROUND), indexing="ij"))
    corner = row * (_AROUND + 1) + column
    above, right = corner + _AROUND + 1, corner + 1
    lower, upper = np.stack([corner, above, right], axis=1), np.stack([right, above, above + 1], axis=1)
    faces = np.concatenate([lower, upper[row < _UP - 1]]).astype(np.int32)  # the top is one point
    return Mesh(
        vertices=points.reshape(-1, 3),
        faces=faces,
        texcoords=texcoords.reshape(-1, 2),
        normals=np.tile(_DOWN, (points.size // 3, 1)),
    ).without_strays()


def _light(direction: tuple[float, ...] | list[float], strength: float, casts_shadow: bool) -> str:
    place = -20.0 * np.asarray(direction) / np.linalg.norm(direction)
    return (
        f'<light directional="true" castshadow="{str(casts_shadow).lower()}" pos="{mjcf_numbers(place)}"'
        f' dir="{mjcf_numbers(direction)}" ambient="0 0 0" diffuse="{mjcf_numbers([strength] * 3)}"'
        f' specular="{mjcf_numbers([0.6 * strength] * 3)}"/>'
    )


def _floor_brightness(settings: MoviSettings) -> float:
    light = settings.light
    downwards = [-np.asarray(way)[2] / np.linalg.norm(way) for way in (light.direction, *_FILLS)]
    strengths = [light.sun, *(share * light.fill for share in _FILL_SHARES)]
    return min(1.0, light.ambient + float(np.dot(downwards, strengths)))

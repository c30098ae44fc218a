"""MuJoCo's textures as pictures and coordinates that Blender can use.

MuJoCo looks a flat texture up by coordinates on the surface (those of a mesh, or its own for simple shapes) and a cube
texture by the direction from the shape's centre. Rows of a texture go along +v in its data, as in Blender's images.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from data_gen.blender.shapes import Triangles

Floats = NDArray[np.float64]
_RGB_ROLE = 1  # mjTEXROLE_RGB
_FLAT, _SKYBOX = 0, 2  # mjTEXTURE_2D and mjTEXTURE_SKYBOX; 1 is a cube
_PANORAMA_WIDTHS = (1024, 4096)  # smallest and largest: cube edges stay sharp, memory stays small

# Per cube face (+x -x +y -y +z -z): the axes and signs of s and t on it (OpenGL's table).
_FACE_AXES = (
    ((2, -1), (1, -1)),
    ((2, 1), (1, -1)),
    ((0, 1), (2, 1)),
    ((0, 1), (2, -1)),
    ((0, 1), (1, -1)),
    ((0, -1), (1, -1)),
)


def texture_of_material(model: Any, material: int) -> int:
    """Return the id of the colour texture of a material; -1 where there is none."""
    return int(model.mat_texid[material, _RGB_ROLE]) if material >= 0 else -1


def is_flat(model: Any, texture: int) -> bool:
    """Tell whether a texture is a plain picture rather than a cube."""
    return int(model.tex_type[texture]) == _FLAT


def pixels(model: Any, texture: int) -> NDArray[np.uint8]:
    """Return the picture of a texture, (height, width, 3); a cube texture has its six faces below each other.

    Grey textures become RGB; a fourth channel is dropped (MuJoCo uses the material's alpha).
    """
    height, width = int(model.tex_height[texture]), int(model.tex_width[texture])
    channels, start = int(model.tex_nchannel[texture]), int(model.tex_adr[texture])
    picture = np.asarray(model.tex_data[start : start + height * width * channels]).reshape(height, width, channels)
    picture = np.repeat(picture[..., :1], 3, axis=2) if channels < 3 else picture[..., :3]
    if not is_flat(model, texture) and height == width:  # one picture for all faces
        picture = np.tile(picture, (6, 1, 1))
    return picture


def tinted(picture: NDArray[np.uint8], rgb: Floats) -> NDArray[np.uint8]:
    """Multiply a picture with a colour, both sRGB, as MuJoCo does."""
    return np.rint(np.clip(picture * rgb, 0, 255)).astype(np.uint8)


def flat_coordinates(triangles: Triangles, repeat: Floats, size: Floats, is_uniform: bool) -> Floats:
    """Return (u, v) of corners for a flat texture on a shape that has no coordinates of its own.

    Args:
        triangles: the shape.
        repeat: the material's ``texrepeat``.
        size: the shape's half sizes; 0 where it is infinite.
        is_uniform: ``repeat`` counts per two metres rather than per shape.
    """
    scale = np.where((size[:2] > 0) & is_uniform, repeat * size[:2], repeat)
    return triangles.chart * scale + triangles.shift


def box_coordinates(unit: Floats, width: int) -> Floats:
    """Return (u, v) of a box's corners (six to a face, faces in the order +x -x +y -y +z -z) in the stacked cube."""
    coordinates = np.empty((len(unit), 2))
    inset = 1 - 1 / width  # half a texel, so that filtering does not reach the neighbouring face
    for face, ((s_axis, s_sign), (t_axis, t_sign)) in enumerate(_FACE_AXES):
        corners = slice(6 * face, 6 * face + 6)
        s, t = s_sign * unit[corners, s_axis], t_sign * unit[corners, t_axis]
        coordinates[corners] = np.stack([(s * inset + 1) / 2, (face + (t * inset + 1) / 2) / 6], axis=1)
    return coordinates


def panorama(cube: NDArray[np.uint8], *, is_sky: bool = False) -> NDArray[np.uint8]:
    """Turn a stacked cube (6 w, w, 3) into an equirectangular picture for Blender's environment lookup.

    Blender's rule: u = 1/2 - atan2(y, x) / 2 pi, v = 1/2 + asin(z) / pi. MuJoCo's sky has the cube's y axis up.
    """
    width = int(np.clip(4 * cube.shape[1], *_PANORAMA_WIDTHS))
    height = width // 2
    longitude = (0.5 - (np.arange(width) + 0.5) / width) * 2 * np.pi
    latitude = ((np.arange(height) + 0.5) / height - 0.5) * np.pi
    flat = np.cos(latitude)[:, None]
    up = np.broadcast_to(np.sin(latitude)[:, None], (height, width))
    directions = np.stack([flat * np.cos(longitude), flat * np.sin(longitude), up], axis=-1)
    if is_sky:
        directions = directions[..., [0, 2, 1]] * [1.0, 1.0, -1.0]
    return cube_lookup(cube, directions)


def cube_lookup(cube: NDArray[np.uint8], directions: Floats) -> NDArray[np.uint8]:
    """Return the colour of a stacked cube (6 w, w, 3) in directions (..., 3), bilinear within each face."""
    width = cube.shape[1]
    axis = np.abs(directions).argmax(axis=-1)
    major = np.take_along_axis(directions, axis[..., None], axis=-1)[..., 0]
    face = 2 * axis + (major < 0)
    result = np.empty((*directions.shape[:-1], 3), np.uint8)
    for index, ((s_axis, s_sign), (t_axis, t_sign)) in enumerate(_FACE_AXES):
        chosen = face == index
        there, length = directions[chosen], np.abs(major[chosen])
        s = np.clip((s_sign * there[:, s_axis] / length + 1) / 2 * width - 0.5, 0, width - 1)
        t = np.clip((t_sign * there[:, t_axis] / length + 1) / 2 * width - 0.5, 0, width - 1)
        column, row = s.astype(int), t.astype(int)
        beside, below = np.minimum(column + 1, width - 1), np.minimum(row + 1, width - 1)
        right, down = (s - column)[:, None], (t - row)[:, None]
        picture = cube[index * width : (index + 1) * width]
        upper = picture[row, column] * (1 - right) + picture[row, beside] * right
        lower = picture[below, column] * (1 - right) + picture[below, beside] * right
        result[chosen] = np.rint(upper * (1 - down) + lower * down)
    return result


def skybox(model: Any) -> NDArray[np.uint8] | None:
    """Return the panorama of the first skybox texture in world axes, or None."""
    for texture in range(model.ntex):
        if int(model.tex_type[texture]) == _SKYBOX:
            return panorama(pixels(model, texture), is_sky=True)
    return None

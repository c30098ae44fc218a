import numpy as np
import pytest

from data_gen.blender import shapes, textures
from tests.data_gen.blender.small_scene import small_scene

RNG = np.random.default_rng(3)
CUBE = RNG.integers(0, 256, (6 * 8, 8, 3), dtype=np.uint8)


def test_cube_lookup_follows_the_cube_map_table():
    """One direction on each face, written out from the OpenGL specification's table, moved to the texel's centre."""
    table = {  # face: (major axis, its sign, s in terms of x y z, t in terms of x y z)
        0: (0, 1, (0, 0, -1), (0, -1, 0)),
        1: (0, -1, (0, 0, 1), (0, -1, 0)),
        2: (1, 1, (1, 0, 0), (0, 0, 1)),
        3: (1, -1, (1, 0, 0), (0, 0, -1)),
        4: (2, 1, (1, 0, 0), (0, -1, 0)),
        5: (2, -1, (-1, 0, 0), (0, -1, 0)),
    }
    for face, (axis, sign, s_axis, t_axis) in table.items():
        column, row = 6, 1
        s, t = (2 * (column + 0.5) / 8 - 1), (2 * (row + 0.5) / 8 - 1)
        direction = s * np.array(s_axis, float) + t * np.array(t_axis, float)
        direction[axis] = sign
        found = textures.cube_lookup(CUBE, 2.5 * direction)
        assert np.array_equal(found, CUBE[8 * face + row, column]), face


def test_panorama_shows_what_the_cube_shows_in_every_direction():
    picture = textures.panorama(CUBE)
    height, width = picture.shape[:2]
    directions = RNG.normal(size=(500, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    # Blender's rule for environment pictures; row 0 looks down.
    u = 0.5 - np.arctan2(directions[:, 1], directions[:, 0]) / (2 * np.pi)
    v = 0.5 + np.arcsin(directions[:, 2]) / np.pi
    seen = picture[np.minimum((v * height).astype(int), height - 1), np.minimum((u * width).astype(int), width - 1)]
    difference = np.abs(seen.astype(int) - textures.cube_lookup(CUBE, directions))
    assert np.quantile(difference, 0.98) < 4  # half a texel of 1024 beside; at the cube's edges colours jump


def test_sky_has_the_cubes_up_face_overhead():
    picture = textures.panorama(CUBE, is_sky=True)
    up_face = CUBE[2 * 8 : 3 * 8].reshape(-1, 3)
    assert (picture[-1] >= up_face.min(axis=0)).all() and (picture[-1] <= up_face.max(axis=0)).all()
    assert np.ptp(picture[-1].astype(int), axis=0).max() < 5
    middle = CUBE[2 * 8 + 3 : 2 * 8 + 5, 3:5].astype(float).mean(axis=(0, 1))
    assert picture[-1].mean(axis=0) == pytest.approx(middle, abs=4)


def test_box_corners_look_into_the_texels_that_their_direction_hits():
    """A cube whose colours are the coordinates of its texels tells where a direction hits."""
    row, column = np.mgrid[:48, :8]
    cube = np.stack([30 * column, 30 * (row % 8), 40 * (row // 8)], axis=-1).astype(np.uint8)
    unit = shapes.box(np.ones(3)).unit
    coordinates = textures.box_coordinates(unit, 8)
    middle = unit.reshape(6, 6, 3).mean(axis=1, keepdims=True)
    inside = (0.6 * unit.reshape(6, 6, 3) + 0.4 * middle).reshape(-1, 3)
    looked_up = 0.6 * coordinates.reshape(6, 6, 2) + 0.4 * coordinates.reshape(6, 6, 2).mean(axis=1, keepdims=True)
    position = looked_up.reshape(-1, 2) * [8, 48] - 0.5
    hit = textures.cube_lookup(cube, inside).astype(float)
    assert np.array_equal(hit[:, 2] / 40, position[:, 1] // 8)
    # Coordinates shrink by up to half a texel towards the rim, so that filtering stays within the face.
    assert np.abs(position[:, 0] - hit[:, 0] / 30).max() < 0.5
    assert np.abs(position[:, 1] % 8 - hit[:, 1] / 30).max() < 0.5


def test_pixels_are_the_models_own_bytes():
    model, _, _ = small_scene()
    flat, cube = model.texture("flat").id, model.texture("cube").id
    assert textures.is_flat(model, flat) and not textures.is_flat(model, cube)
    assert textures.pixels(model, flat).shape == (32, 64, 3)
    start = int(model.tex_adr[flat])
    assert np.array_equal(textures.pixels(model, flat).ravel(), model.tex_data[start : start + 32 * 64 * 3])
    assert textures.pixels(model, cube).shape == (96, 16, 3)


@pytest.mark.parametrize(("is_uniform", "wanted"), [(False, [3.0, 2.0]), (True, [6.0, 2.0])])
def test_repeats_count_per_shape_or_per_two_metres(is_uniform: bool, wanted: list[float]):
    plane = shapes.plane(2.0, 1.0)
    coordinates = textures.flat_coordinates(plane, np.array([3.0, 2.0]), np.array([2.0, 1.0, 0.0]), is_uniform)
    assert np.ptp(coordinates, axis=0) == pytest.approx(wanted)

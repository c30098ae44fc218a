"""Wide smooth surfaces in small made-up grids of points, where the answer is known by construction."""

import numpy as np
import pytest

from vpd_lightning.geometry.wide_surfaces import wide_surfaces

SETTINGS = {"max_slope": 0.15, "max_turn": float(np.cos(np.radians(20))), "min_width": 0.5, "tolerance": 0.5}
SIZE, STEP = 24, 0.1


def sheet(height=None):
    """One view of points on z = height(x, y), a tenth of a metre apart, with normals by the height's slopes."""
    axis = np.arange(SIZE) * STEP
    x, y = np.meshgrid(axis, axis, indexing="xy")
    z = np.zeros_like(x) if height is None else height(x, y)
    slope_y, slope_x = np.gradient(z, STEP)
    normals = np.stack([-slope_x, -slope_y, np.ones_like(z)], axis=-1)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    return np.stack([x, y, z], axis=-1)[None], normals[None]


def wide_mask(points, normals, valid=None, **changes):
    valid = np.ones(points.shape[:3], bool) if valid is None else valid
    footprints = np.full(valid.shape, STEP)
    return wide_surfaces(points, normals, valid, footprints, **{**SETTINGS, **changes})


def test_a_plane_is_wide_whichever_way_it_faces():
    points, normals = sheet()
    for axes in ([0, 1, 2], [2, 0, 1], [1, 2, 0]):
        assert wide_mask(points[..., axes], normals[..., axes]).all()


def test_a_gentle_hill_is_one_surface_and_a_patch_above_it_is_none():
    points, normals = sheet(lambda x, y: 0.1 * np.sin(2 * x) * np.cos(y))
    points[0, 8:14, 9:15, 2] += 0.6

    wide = wide_mask(points, normals)[0]

    lifted = np.zeros_like(wide)
    lifted[8:14, 9:15] = True
    assert np.array_equal(wide, ~lifted)


def test_what_lies_within_the_tolerance_of_a_plane_is_on_it():
    points, normals = sheet()
    points[0, 8:14, 9:15, 2] += 0.4 * STEP  # too steep a step at the rim, but 0.4 footprints high

    assert wide_mask(points, normals).all()
    assert wide_mask(points, normals, tolerance=0.3)[0, 8:14, 9:15].sum() == 0


@pytest.mark.parametrize("view", [0, 1])
def test_views_see_the_same_surface_though_pixels_of_two_views_are_no_neighbours(view):
    points, normals = (np.concatenate([values, values]) for values in sheet())
    valid = np.zeros(points.shape[:3], bool)
    valid[1 - view] = True
    valid[view, 5:9, 5:9] = True  # of this view only a scrap is seen; the other says what it lies on

    assert np.array_equal(wide_mask(points, normals, valid), valid)


def test_the_smallest_width_is_a_share_of_all_that_is_seen():
    points, normals = sheet()
    valid = np.zeros(points.shape[:3], bool)
    valid[0, :, :6] = valid[0, :, 10:11] = True  # a strip of six columns and a line far from it, one plane
    points[0, :, 10:11, 2] += 1.0

    wide = wide_mask(points, normals, valid, min_width=0.7)

    # both are as long as all that is seen, and neither is as wide
    assert wide[0, :, :6].all()
    assert not wide_mask(points, normals, valid, min_width=0.99).any()


def test_without_valid_points_or_with_one_nothing_is_wide():
    points, normals = sheet()
    valid = np.zeros(points.shape[:3], bool)
    assert not wide_mask(points, normals, valid).any()
    valid[0, 3, 3] = True
    assert not wide_mask(points, normals, valid).any()


def test_points_that_are_not_valid_may_hold_anything():
    points, normals = sheet()
    valid = np.random.default_rng(0).random(points.shape[:3]) < 0.9
    expected = wide_mask(points, normals, valid)
    points[~valid], normals[~valid] = 1e6, 0.0

    assert np.array_equal(wide_mask(points, normals, valid), expected)
    assert not expected[~valid].any()


def test_a_sharp_fold_divides_a_sheet_even_where_normals_along_it_turn_slowly():
    # A fold of 80 degrees along the 12th row; along the seam the normals sweep from one side's to the other's.
    points, normals = sheet(lambda x, y: np.where(y > 12 * STEP, np.tan(np.radians(80)) * (y - 12 * STEP), 0.0))
    angle = np.radians(np.linspace(0, 80, SIZE))
    for row in (12, 13):
        normals[0, row] = np.stack([np.zeros(SIZE), -np.sin(angle), np.cos(angle)], axis=-1)

    # the upper part is 12 times as long as it is seen from above; below it is no part of what is wide
    wide = wide_mask(points, normals, min_width=0.6, tolerance=1e-6)[0]

    assert wide[14:].all() and not wide[:11].any()


def test_a_face_seen_from_the_side_is_not_linked_to_the_floor_far_behind_it():
    # From the 14th column on the floor lies 5 m behind. A face ends there, whose tilt of 15 degrees points at it: the
    # step from its last column down to the floor leaves either plane by half of that.
    points, normals = sheet()
    points[0, :, 15:, 0] += 5.0
    face = (slice(8, 14), slice(9, 15))
    tilt = np.radians(15)
    points[0][face][..., 2] = 0.66 + np.tan(tilt) * (1.4 - points[0][face][..., 0])
    normals[0][face] = np.sin(tilt), 0.0, np.cos(tilt)

    wide = wide_mask(points, normals, min_width=0.3)[0]

    expected = np.ones_like(wide)
    expected[face] = False
    assert np.array_equal(wide, expected)

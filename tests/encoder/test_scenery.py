from dataclasses import fields, replace

import pytest
import torch

from tests.encoder.test_unet import encoder as plain_encoder
from tests.encoder.test_unet import fitted_background, frames
from vpd_lightning.geometry.cameras import pixel_rays, project, unproject
from vpd_lightning.geometry.normals import depth_normals
from vpd_lightning.randomness import RandomKeys
from vpd_lightning.types import Cameras, RGBDFrames

WORKSPACE = {"workspace_min": [-2, -2, -1], "workspace_max": [2, 2, 1]}


def encoder(data, **changes):
    return plain_encoder(**{"background": fitted_background(data), "has_scenery": True, **WORKSPACE, **changes})


def with_a_body():
    """Two frames of two views of a level floor; in front of it, a body of four pixels in one view of the first."""
    data = frames(batch=2)
    cameras = Cameras(data.cameras.intrinsics.clone(), data.cameras.cam_to_world, 8, 8)
    cameras.intrinsics[..., 1, 1] = 12.5  # pixels that are not square
    closer = RGBDFrames(data.rgb, data.depth.clone(), cameras)
    closer.depth[0, 1, 2:4, 2:4] = 1.5
    return data, closer


def encoded(model, data, purpose="current"):
    return model(data, RandomKeys(0, 0, [0, 1]), purpose).particles


def still_pixels():
    """Which pixels stand still beside the body: all but it, those around it, and those of the edge beside these."""
    still = torch.ones(2, 2, 8, 8, dtype=torch.bool)
    still[0, 1, :5, :5] = False
    return still


def test_scenery_needs_a_background():
    with pytest.raises(ValueError, match="has_scenery needs a background"):
        plain_encoder(has_scenery=True)


def test_points_are_the_pixels_that_neither_move_nor_touch_what_moves():
    data, closer = with_a_body()

    scenery = encoded(encoder(data), closer).scenery

    still = still_pixels().flatten(1)
    assert torch.equal(scenery.mask, still)
    points = unproject(closer.depth, closer.cameras).flatten(1, 3)
    torch.testing.assert_close(scenery.positions[still], points[still], rtol=0, atol=1e-6)
    assert torch.equal(scenery.colors[still], (data.rgb.float() / 255).flatten(1, 3)[still])
    normals = depth_normals(closer.depth, closer.cameras).flatten(1, 3)
    assert torch.equal(scenery.normals[still], normals[still])
    assert (scenery.normals[..., 2] > 0.99).sum() > 100


def test_a_sliver_of_a_body_at_the_edge_is_no_scenery():
    """Outermost pixels have no normal; what leaves the plane beside them is not known to stand still."""
    data, closer = with_a_body()
    # Behind the floor, so that the background does not find them.
    closer.depth[0, 0, 0, 2:5] = 2.3  # a row of a body that is mostly outside of the picture
    closer.depth[1, 0, 3, 7] = 2.2

    mask = encoded(encoder(data), closer).scenery.mask.unflatten(1, (2, 8, 8))

    expected = still_pixels()
    expected[0, 0, 0, 2:5] = expected[1, 0, 3, 7] = False
    expected[0, 0, 0, 0] = False  # a corner, whose row does not go on
    assert torch.equal(mask, expected)


@pytest.mark.parametrize("tilt", [0.0, 0.5, 1.2])
def test_a_plane_goes_on_to_the_edge_however_it_is_tilted(tilt):
    data, _ = with_a_body()
    rows = (torch.arange(8) + 0.5 - 4) / 12.5  # y over z
    tilted = replace(data, depth=(2 / (1 + tilt * rows))[:, None].expand_as(data.depth).contiguous())
    model = encoder(tilted, workspace_min=[-9, -9, -9], workspace_max=[9, 9, 9])

    assert encoded(model, tilted).scenery.mask.all()


def test_points_may_lie_outside_of_the_workspace_where_particles_do_not():
    data, closer = with_a_body()
    small = {"workspace_min": [-0.3, -0.3, -1], "workspace_max": [0.3, 0.3, 1]}

    particles = encoded(encoder(data, **small), closer)

    assert particles.positions[particles.mask][:, :2].abs().max() <= 0.3
    assert torch.equal(particles.scenery.mask, still_pixels().flatten(1))
    assert particles.scenery.positions[particles.scenery.mask][:, :2].abs().max() > 0.8


def test_sizes_are_those_of_pixels_and_views_lead_from_the_camera_to_the_point():
    data, closer = with_a_body()
    closer = replace(closer, depth=closer.depth * 1.2)

    scenery = encoded(encoder(data, workspace_min=[-2, -2, -3]), closer).scenery

    assert scenery.mask.sum() > 200
    sizes = (closer.depth / (8.0 * 12.5) ** 0.5).flatten(1)
    torch.testing.assert_close(scenery.sizes[scenery.mask], sizes[scenery.mask], rtol=1e-6, atol=0)
    centers = closer.cameras.cam_to_world[..., :3, 3].repeat_interleave(64, dim=1)
    away = scenery.positions - centers
    views = (away / away.norm(dim=-1, keepdim=True))[scenery.mask]
    torch.testing.assert_close(scenery.views[scenery.mask], views, rtol=0, atol=1e-6)
    assert (scenery.views[scenery.mask][:, 2] < -0.5).all()  # the cameras look down


def test_occluders_are_the_points_that_move():
    data, closer = with_a_body()

    scenery = encoded(encoder(data, num_particles=100, moving_fraction=0.5), closer).scenery

    assert scenery.occluder_mask.sum(dim=1).tolist() == [4, 0]
    points = unproject(closer.depth, closer.cameras)[0, 1, 2:4, 2:4].flatten(0, 1)
    found = scenery.occluders[0][scenery.occluder_mask[0]]
    assert torch.equal(found[found.sum(dim=1).argsort()], points[points.sum(dim=1).argsort()])
    assert not scenery.occluders[~scenery.occluder_mask].any()
    pixels, depths = project(found, closer.cameras[0, 1])
    assert (pixels.floor() >= 2).all() and (pixels.floor() < 4).all() and (depths - 1.5).abs().max() < 1e-5


def test_what_moves_outside_of_the_workspace_casts_nothing():
    data, closer = with_a_body()

    scenery = encoded(encoder(data, workspace_max=[2, 2, 0.3]), closer).scenery

    assert not scenery.occluder_mask.any()


def test_the_frame_before_has_no_scenery():
    data, closer = with_a_body()
    model = encoder(data)

    assert encoded(model, closer, "previous").scenery is None
    assert encoded(encoder(data, has_scenery=False), closer).scenery is None


def test_scenery_leaves_the_particles_as_they_were():
    data, closer = with_a_body()
    model = encoder(data)
    bare = encoder(data, has_scenery=False)
    bare.load_state_dict(model.state_dict())

    with_it, without = encoded(model, closer), encoded(bare, closer)

    assert with_it.normals is None and without.normals is None
    for name in ("positions", "features", "mask", "colors", "moving"):
        assert torch.equal(getattr(with_it, name), getattr(without, name))


@pytest.mark.parametrize("missing", [0.0, -1.0, float("nan"), float("inf")])
def test_pixels_without_a_measurement_are_no_points_and_leave_no_nan(missing):
    data, closer = with_a_body()
    closer.depth[:, 0, 0:2, 0:3] = missing
    closer.depth[1, 1, 7] = missing

    scenery = encoded(encoder(data), closer).scenery

    measured = torch.ones(2, 2, 8, 8, dtype=torch.bool)
    measured[:, 0, 0:2, 0:3] = False
    measured[1, 1, 7] = False
    assert torch.equal(scenery.mask, (still_pixels() & measured).flatten(1))
    for item in fields(scenery):
        assert torch.isfinite(getattr(scenery, item.name)).all(), item.name
    assert (scenery.sizes > 0).all()
    lengths = scenery.normals[scenery.mask].norm(dim=-1)
    assert ((lengths - 1).abs() < 1e-5).logical_or(lengths == 0).all()


def test_pixels_without_a_measurement_are_far_but_for_those_beside_what_moves():
    data, closer = with_a_body()
    closer.depth[0, 1, 1, 1:3] = 0.0  # touches the body
    closer.depth[0, 1, 6:] = 0.0

    scenery = encoded(encoder(data), closer).scenery

    far = torch.zeros(2, 2, 8, 8, dtype=torch.bool)
    far[0, 1, 6:] = True
    assert torch.equal(scenery.far_mask, far.flatten(1)) and not (scenery.far_mask & scenery.mask).any()
    assert torch.equal(scenery.colors[scenery.far_mask], (data.rgb.float() / 255)[far])
    directions = pixel_rays(closer.cameras).directions[far]
    torch.testing.assert_close(scenery.views[scenery.far_mask], directions, rtol=0, atol=1e-6)
    expected = torch.full_like(scenery.sizes[scenery.far_mask], (8.0 * 12.5) ** -0.5)
    torch.testing.assert_close(scenery.sizes[scenery.far_mask], expected, rtol=1e-6, atol=0)


def test_a_batch_of_scenes_equals_its_members():
    data, closer = with_a_body()
    model = encoder(data)

    together = encoded(model, closer).scenery
    for member in range(2):
        keys = RandomKeys(0, 0, [member])
        alone = model(closer[member : member + 1], keys, "current").particles.scenery
        for item in fields(alone):
            one, other = getattr(together, item.name)[member], getattr(alone, item.name)[0]
            if item.name.startswith("occluder"):  # padded to those of the other member
                assert not one[len(other) :].any()
                one = one[: len(other)]
            torch.testing.assert_close(one, other, rtol=0, atol=1e-6)

import pytest
import torch

from tests.geometry.test_cameras import random_cameras
from vpd_lightning.geometry.normals import depth_normals
from vpd_lightning.types import Cameras


def downward_camera(height=8, width=8):
    cam_to_world = torch.eye(4, dtype=torch.float64)
    cam_to_world[:3, :3] = torch.diag(torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64))  # looks along -z
    cam_to_world[2, 3] = 2.0
    intrinsics = torch.tensor([[10.0, 0, 4.0], [0, 10.0, 4.0], [0, 0, 1]], dtype=torch.float64)
    return Cameras(intrinsics, cam_to_world, height, width)


def test_a_floor_has_upward_normals():
    normals = depth_normals(torch.full((8, 8), 2.0, dtype=torch.float64), downward_camera())

    assert torch.allclose(normals[1:-1, 1:-1], torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64).expand(6, 6, 3))
    assert (normals[0] == 0).all() and (normals[:, -1] == 0).all()


def test_a_step_keeps_the_normals_of_both_sides():
    depth = torch.full((8, 8), 2.0, dtype=torch.float64)
    depth[:, 4:] = 1.5

    normals = depth_normals(depth, downward_camera())

    assert (normals[1:-1, 1:-1, 2] > 0.999).all()


@pytest.mark.parametrize("missing", [0.0, float("nan"), float("inf")])
def test_a_hole_does_not_bend_the_normals_around_it(missing):
    depth = torch.full((8, 8), 2.0, dtype=torch.float64)
    depth[3:5, 2:6] = missing
    depth[6, 1] = depth[6, 3] = missing  # a pixel without any neighbour along its row

    normals = depth_normals(depth, downward_camera())

    known = normals.norm(dim=-1) > 0
    assert torch.allclose(normals[known], torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64))
    assert not known[3:5, 2:6].any() and not known[6, 2] and known[2, 3]


def test_missing_depth_gives_zero_normals_and_no_nan():
    cameras = random_cameras(shape=())
    depth = torch.ones(6, 9, dtype=torch.float64)
    depth[2, 3], depth[3, 3] = 0.0, float("nan")

    normals = depth_normals(depth, cameras)

    assert torch.isfinite(normals).all()
    assert (normals[2, 3] == 0).all() and (normals[3, 3] == 0).all()

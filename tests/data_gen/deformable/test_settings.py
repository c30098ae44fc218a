from dataclasses import asdict

import numpy as np
import pytest

from data_gen.cameras import camera_intrinsics, camera_poses
from data_gen.deformable import Settings
from data_gen.settings import differences, load_settings
from vpd_lightning.errors import ConfigError

SCENES = ("deformable_block", "deformable_multi", "deformable_collision")


@pytest.mark.parametrize("scene", SCENES)
def test_paper_presets_have_the_papers_numbers(scene: str):
    settings = load_settings(Settings, scene, "paper", {})

    assert (settings.splits.train, settings.splits.validation, settings.splits.test) == (256, 16, 16)
    assert (settings.num_frames, settings.camera.num_views) == (80, 4)
    assert (settings.camera.height, settings.camera.width) == (128, 128)
    assert (settings.near, settings.far) == (9.0, 30.0)
    assert (settings.workspace_min, settings.workspace_max) == ([-8.0, -8.0, -2.0], [8.0, 8.0, 8.0])


def test_the_sets_have_the_papers_bodies():
    block, multi, collision = (load_settings(Settings, scene, "paper", {}).bodies for scene in SCENES)

    assert (block.count, list(block.shapes)) == (1, ["cube"])
    assert (multi.count, set(multi.shapes)) == (1, {"cube", "cylinder", "donut", "icosahedron", "duck"})
    assert collision.count == 2 and {"ball", "cylinder"} <= set(collision.shapes)


@pytest.mark.parametrize("scene", SCENES)
def test_tiny_presets_are_the_papers_at_a_smaller_size(scene: str):
    paper, tiny = (asdict(load_settings(Settings, scene, name, {})) for name in ("paper", "tiny"))

    assert {line.split(":")[0] for line in differences(paper, tiny)} == {
        "splits.train", "splits.validation", "splits.test", "num_frames",
        "camera.height", "camera.width", "camera.field_of_view",
        "bodies.spacing", "drop.gap_min", "drop.gap_max", "light.shadow_size",
    }  # fmt: skip
    assert (tiny["camera"]["num_views"], tiny["camera"]["height"], tiny["num_frames"]) == (4, 64, 40)


@pytest.mark.parametrize("preset", ["paper", "tiny"])
@pytest.mark.parametrize("scene", SCENES)
def test_floor_fills_every_picture_within_far(scene: str, preset: str):
    """The four corner rays of each camera meet the finite floor; a straight edge is farthest at its ends."""
    settings = load_settings(Settings, scene, preset, {})
    camera = settings.camera
    corners = np.array([[x, y, 1.0] for x in (0, camera.width) for y in (0, camera.height)])
    for intrinsics, pose in zip(camera_intrinsics(camera), camera_poses(camera), strict=True):
        rays = corners @ np.linalg.inv(intrinsics).T @ pose[:3, :3].T
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        distance = -pose[2, 3] / rays[:, 2]
        points = pose[:3, 3] + distance[:, None] * rays
        assert (distance > settings.near).all() and (distance < settings.far).all()
        assert np.abs(points[:, :2]).max() < settings.floor.half_size


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("bodies.shapes", ["cube", "dounut"], "did you mean 'donut'"),
        ("bodies.shapes", [], "at least one of cube, cylinder"),
        ("bodies.shapes", ["ball"], "a colour for each shape .ball"),
        ("bodies.colors.cube", [2.0, 0.0, 0.0], "three numbers from 0 to 1"),
        ("bodies.count", 0, "1 to 8"),
        ("bodies.spacing", 1.0, "0.3 to 0.6 m"),
        ("bodies.poisson", 0.5, "0 to below 0.5"),
        ("bodies.yong", 1e4, "did you mean 'bodies.young'"),
        ("contact.solver", "PGS", "CG, Newton"),
        ("contact.solref", [0.004, 1.0], r"at least two timesteps .0.008 s"),
        ("drop.gap_min", 0.01, "nothing touches at the start"),
        ("drop.highest", 0.1, "above the sum of the gaps"),
        ("light.direction", [0.0, 0.0, 1.0], "a downward direction"),
        ("renderer", "raycast", "auto, egl, osmesa, blender"),
    ],
)
def test_wrong_settings_are_refused_by_name(key: str, value: object, message: str):
    with pytest.raises(ConfigError, match=message):
        load_settings(Settings, "deformable_block", "paper", {key: value})

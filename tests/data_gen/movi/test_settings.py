from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest

from data_gen.cameras import camera_intrinsics, camera_poses
from data_gen.movi import Settings
from data_gen.movi.catalogue import Catalogue
from data_gen.movi.shapes import SHAPES
from data_gen.settings import load_preset, load_settings, settings_hash
from vpd_lightning.errors import ConfigError, DataError

SCENES = ("movi_a", "movi_b", "movi_c", "movi_a_high", "movi_c_high")
TRIANGLE_PYRAMID = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 {height}\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 3 1 4\n"


@pytest.mark.parametrize("scene", SCENES)
def test_paper_preset_has_the_papers_numbers(scene: str):
    settings = load_settings(Settings, scene, "paper", {})

    assert (settings.splits.train, settings.splits.validation, settings.splits.test) == (350, 16, 16)
    assert (settings.num_frames, settings.camera.num_views) == (96, 9)
    assert (settings.camera.height, settings.camera.width) == (128, 128)
    assert (settings.near, settings.far) == (0.5, 15.0)
    assert (settings.workspace_min, settings.workspace_max) == ([-10.0] * 3, [10.0] * 3)
    assert settings.objects.count == 3
    assert settings.timestep == pytest.approx(1 / 960) and settings.substeps == 20  # 48 frames/s
    # A 35 mm lens on a 32 mm sensor; square pixels, so the vertical angle is the horizontal one.
    assert settings.camera.field_of_view == pytest.approx(np.degrees(2 * np.arctan(16 / 35)), abs=1e-5)
    assert load_preset(scene, "paper")[0] == "movi"


@pytest.mark.parametrize("scene", SCENES)
def test_tiny_preset_is_the_papers_scene_at_a_smaller_size(scene: str):
    paper, tiny = (asdict(load_settings(Settings, scene, name, {})) for name in ("paper", "tiny"))

    different = {key for key in paper if paper[key] != tiny[key]}
    assert different == {"splits", "num_frames", "frame_time", "camera"}
    assert {key for key in paper["camera"] if paper["camera"][key] != tiny["camera"][key]} == {"height", "width"}
    assert tiny["splits"] == {"train": 4, "validation": 2, "test": 2}
    assert tiny["camera"]["height"] >= 64 and tiny["camera"]["num_views"] >= 4 and tiny["num_frames"] >= 10


def test_scenes_differ_in_what_the_paper_says():
    a, b, c = (load_settings(Settings, scene, "paper", {}) for scene in SCENES[:3])

    assert (a.objects.shapes, a.objects.sizes) == (["cube", "cylinder", "sphere"], [0.7, 1.4])
    assert (tuple(b.objects.shapes), b.objects.sizes, b.objects.color) == (SHAPES, [0.7, 1.4], "hue")
    assert (c.objects.shapes, c.objects.sizes, c.objects.color) == ([], [0.75, 3.0], "texture")
    assert [settings.floor.look for settings in (a, b, c)] == ["grey", "hue", "texture"]


@pytest.mark.parametrize("preset", ["paper", "tiny"])
@pytest.mark.parametrize("scene", ["movi_a_high", "movi_c_high"])
def test_high_cameras_see_floor_within_reach_only(scene: str, preset: str):
    """Every ray, the pictures' corners included, meets the floor within the far bound of the rays."""
    settings = load_settings(Settings, scene, preset, {})
    camera = settings.camera
    x, y = np.meshgrid([0, camera.width], [0, camera.height])
    pixels = np.stack([x, y, np.ones_like(x)], axis=-1).reshape(-1, 3)
    for matrix, pose in zip(camera_intrinsics(camera), camera_poses(camera), strict=True):
        rays = pixels @ np.linalg.inv(matrix).T @ pose[:3, :3].T
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        distance = -pose[2, 3] / rays[:, 2]
        assert (distance > 0).all() and (distance < settings.far).all()


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("objects.shape", ["cube"], "did you mean 'objects.shapes'"),
        ("objects.shapes", ["cube", "piano"], r"objects\.shapes is \['piano'\]; allowed"),
        ("objects.shapes", [], "texture where shapes is"),
        ("objects.count", 0, "objects.count is 0; allowed: 1 to 50"),
        ("objects.size_choice", "any", "one_of, between"),
        ("objects.sizes", [0.0], "sizes of 0.05 to 4 m"),
        ("objects.sizes", [], "sizes of 0.05 to 4 m"),
        ("objects.color", "plaid", "clevr, hue, texture"),
        ("objects.mesh_hash", "abc", "without objects.mesh_folder"),
        ("objects.mesh_folder", "somewhere", "null where objects.shapes names shapes"),
        ("objects.materials", [], "at least one material"),
        ("floor.restitution", 1.5, "floor restitution is 1.5; allowed: 0 to 1"),
        ("floor.friction", 0.0, "floor friction is 0.0; allowed: above 0"),
        ("floor.look", "lava", "grey, hue, texture"),
        ("floor.dome_radius", 5.0, "the cameras"),
        ("light.direction", [0.0, 0.0, 1.0], "a downward direction"),
        ("throw.region_min", [-5.0, -5.0, -1.0], "a region above the floor"),
        ("throw.region_max", [-6.0, 5.0, 5.0], "min below max"),
        ("throw.velocity_max", [4.0], "throw.velocity_max is .*; allowed: three numbers"),
        ("throw.max_trials", 0, "1 to 100,000"),
        ("timestep", 1 / 480, "1/960 s, for which contacts are calibrated"),
        ("frame_time", 0.0123, "multiple of timestep"),
        ("renderer", "raycast", "auto, egl, osmesa, blender"),
    ],
)
def test_wrong_settings_are_refused_by_name(key: str, value: object, message: str):
    with pytest.raises(ConfigError, match=message) as caught:
        load_settings(Settings, "movi_a", "paper", {key: value})
    assert len(str(caught.value).splitlines()) <= 3


def test_too_lively_materials_are_refused():
    ball = {"name": "ball", "friction": 1.0, "restitution": 0.98, "density": 1.0, "specular": 0.0, "shininess": 0.0}
    with pytest.raises(ConfigError, match="products of at most 0.9"):
        load_settings(Settings, "movi_a", "paper", {"objects.materials": [ball]})


def test_users_meshes_are_known_by_their_content(tmp_path: Path):
    mesh = tmp_path / "pyramid.obj"
    mesh.write_text(TRIANGLE_PYRAMID.format(height=1))
    first = load_settings(Settings, "movi_c", "paper", {"objects.mesh_folder": str(tmp_path)})
    item = Catalogue(first.objects).draw(np.random.default_rng(0))
    mesh.write_text(TRIANGLE_PYRAMID.format(height=2))
    second = load_settings(Settings, "movi_c", "paper", {"objects.mesh_folder": str(tmp_path)})

    assert item.name == "pyramid.obj"
    assert item.volume == pytest.approx(1 / 6)
    assert len(first.objects.mesh_hash) == 64 and first.objects.mesh_hash != second.objects.mesh_hash
    assert settings_hash(asdict(first)) != settings_hash(asdict(second))
    with pytest.raises(ConfigError, match="objects.mesh_hash"):
        overrides = {"objects.mesh_folder": str(tmp_path), "objects.mesh_hash": first.objects.mesh_hash}
        load_settings(Settings, "movi_c", "paper", overrides)
    with pytest.raises(DataError, match="not a folder"):
        load_settings(Settings, "movi_c", "paper", {"objects.mesh_folder": str(tmp_path / "missing")})

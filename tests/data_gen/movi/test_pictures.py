"""What GL draws, checked against geometry. GL runs in worker processes: its backend is chosen before MuJoCo loads."""

from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
import torch

from data_gen.generate import generate
from data_gen.movi import model as movi_model
from data_gen.movi.user_meshes import load_folder
from tests.data_gen.blocks import contents
from tests.data_gen.movi.test_settings import TRIANGLE_PYRAMID
from tests.data_gen.test_gl import read
from tests.data_gen.test_mujoco_block import distance_to_box
from vpd_lightning.data.schema import Trajectory
from vpd_lightning.geometry.rotations import rotation_matrix

TOLERANCE = 1e-4  # m; float32 depth is good to 2e-6 m at 15 m
DOME_RADIUS = 50.0

pytestmark = [pytest.mark.gl, pytest.mark.slow]


@pytest.fixture(scope="module")
def primitives(tmp_path_factory: pytest.TempPathFactory) -> list[Trajectory]:
    """MOVi-A with cubes and spheres at the paper's resolution, a few frames while they fly, bounce and rest."""
    overrides = {
        "splits.train": 2, "splits.validation": 0, "splits.test": 0, "num_frames": 5, "frame_time": 0.5,
        "objects.shapes": ["cube", "sphere"],
    }  # fmt: skip
    folder = generate("movi_a", "paper", tmp_path_factory.mktemp("a") / "a", 0, workers=1, overrides=overrides)
    found = []
    for path in sorted(folder.glob("train/*.h5")):
        with h5py.File(path) as file:
            attributes = dict(file.attrs)
        found.append(replace(read(path), attributes=attributes))
    return found


def unprojected(trajectory: Trajectory) -> np.ndarray:
    """World points (time, view, height, width, 3)."""
    height, width = trajectory.depth.shape[2:]
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    pixels = np.stack([x, y, np.ones_like(x)], axis=-1)
    rays = np.einsum("hwc,vdc->vhwd", pixels, np.linalg.inv(trajectory.intrinsics))
    points = trajectory.depth.astype(np.float64)[..., None] * rays
    poses = trajectory.cam_to_world
    return np.einsum("tvhwc,vdc->tvhwd", points, poses[:, :3, :3]) + poses[:, None, None, :3, 3]


def test_every_pixel_has_the_depth_of_floor_or_dome_or_object(primitives: list[Trajectory]):
    for trajectory in primitives:
        assert trajectory.state is not None
        points, background = unprojected(trajectory), trajectory.state["segmentation"] == 0
        assert (trajectory.depth > 0).all()
        on_floor = background & (np.linalg.norm(points, axis=-1) < 0.98 * DOME_RADIUS)
        near = on_floor & (np.abs(points[..., :2]).max(axis=-1) < 10.0)
        assert near.mean() > 0.5
        assert np.abs(points[near][:, 2]).max() < TOLERANCE
        assert np.abs(points[on_floor][:, 2]).max() < 1e-3  # far beyond the workspace float32 is coarser
        dome = np.linalg.norm(points[background & ~on_floor], axis=-1)
        assert len(dome) > 100
        assert dome.max() < DOME_RADIUS + TOLERANCE  # its corners lie on the sphere, its faces inside


def test_objects_have_the_depth_of_their_analytic_surface(primitives: list[Trajectory]):
    seen = {"cube": 0, "sphere": 0}
    # A drawn sphere is a polyhedron with its corners on the true one: half as many stacks as slices, over half a turn.
    flatness = 2 * (1 - np.cos(np.pi / movi_model.SPHERE_SLICES))
    for trajectory in primitives:
        state, names = trajectory.state, str(trajectory.attributes["objects"]).split(",")
        assert state is not None
        points = unprojected(trajectory)
        rotations = rotation_matrix(torch.from_numpy(state["quaternions"])).numpy()
        for time in range(len(points)):
            for number, half in enumerate(state["half_sizes"]):
                chosen = points[time][state["segmentation"][time] == number + 1]
                if not len(chosen):
                    continue
                position = state["positions"][time, number]
                seen[names[number]] += len(chosen)
                if names[number] == "sphere":
                    radial = np.linalg.norm(chosen - position, axis=-1) - half[0]
                    assert np.quantile(radial, 0.99) < TOLERANCE
                    # Edge-on the rasteriser's grid of 1/256 pixel moves points along the ray.
                    assert radial.max() < 5e-3
                    assert radial.min() > -flatness * half[0] - TOLERANCE
                else:
                    assert distance_to_box(chosen, position, rotations[time, number], half).max() < TOLERANCE
    assert min(seen.values()) > 500


def test_horizon_of_the_grey_scene_does_not_show(primitives: list[Trajectory]):
    """Floor and dome have one colour, as Kubric's dome has, which is both."""
    trajectory = primitives[0]
    assert trajectory.state is not None
    points, background = unprojected(trajectory), trajectory.state["segmentation"] == 0
    distance = np.linalg.norm(points, axis=-1)
    dome = np.median(trajectory.rgb[background & (distance > 0.98 * DOME_RADIUS)], axis=0)
    floor = np.median(trajectory.rgb[background & (distance < 20.0)], axis=0)
    assert np.ptp(floor) == 0  # grey
    assert np.abs(dome - floor).max() <= 2


def test_shadows_fall_where_the_sun_is_hidden(primitives: list[Trajectory]):
    """Below a body in flight, along the sun's direction, the floor is darker."""
    direction = np.array([-11.7, 6.6, -25.8])
    trajectory = primitives[0]
    state = trajectory.state
    assert state is not None
    points, gray = unprojected(trajectory)[0], trajectory.rgb[0].mean(axis=-1)
    background = state["segmentation"][0] == 0
    lit = np.median(gray[background])
    checked = 0
    for position in state["positions"][0]:
        spot = position - direction * (position[2] / direction[2])
        near = background & (np.linalg.norm(points - spot, axis=-1) < 0.15)
        if near.any():
            checked += 1
            assert np.median(gray[near]) < 0.8 * lit
    assert checked >= 2


def test_users_meshes_are_thrown_and_their_hash_stands_in_the_file(tmp_path: Path):
    folder = tmp_path / "meshes"
    folder.mkdir()
    (folder / "pyramid.obj").write_text(TRIANGLE_PYRAMID.format(height=1))
    overrides = {
        "splits.train": 1, "splits.validation": 0, "splits.test": 0, "num_frames": 2,
        "objects.mesh_folder": str(folder),
    }  # fmt: skip
    generate("movi_c", "tiny", tmp_path / "data", 0, workers=1, overrides=overrides)

    with h5py.File(tmp_path / "data" / "train" / "000000.h5") as file:
        assert file.attrs["objects"] == "pyramid.obj,pyramid.obj,pyramid.obj"
        assert file.attrs["mesh_hash"] == load_folder(folder).sha256()
        assert len(np.unique(file["state/segmentation"])) > 1


def test_same_seed_gives_the_same_bytes_and_files_say_what_was_thrown(tmp_path: Path):
    small = {
        "splits.train": 2, "splits.validation": 0, "splits.test": 1, "num_frames": 3, "camera.num_views": 2,
        "camera.height": 48, "camera.width": 48,
    }  # fmt: skip
    first = contents(generate("movi_b", "tiny", tmp_path / "first", 5, workers=1, overrides=small))
    again = contents(generate("movi_b", "tiny", tmp_path / "again", 5, workers=2, overrides=small))
    other = contents(generate("movi_b", "tiny", tmp_path / "other", 6, workers=1, overrides=small))

    assert first == again
    assert len(set(first.values())) == 3  # another index or split is another trajectory
    assert not set(first.values()) & set(other.values())
    with h5py.File(tmp_path / "first" / "train" / "000000.h5") as file:
        assert len(str(file.attrs["objects"]).split(",")) == 3
        assert set(str(file.attrs["materials"]).split(",")) <= {"metal", "rubber"}
        assert file.attrs["sizes"].shape == file.attrs["masses"].shape == (3,)
        assert (file.attrs["masses"] > 0).all()
        assert (file.attrs["split"], file.attrs["index"]) == ("train", 0)

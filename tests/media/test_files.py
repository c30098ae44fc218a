"""Particle files, camera files and rings, colours of particles, and folders of results."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh

from vpd_lightning.errors import ConfigError, DataError
from vpd_lightning.files import OutputFolder, choose_folder
from vpd_lightning.geometry.cameras import pixel_rays, project
from vpd_lightning.media.camera_paths import common_target, look_at, read_camera_file, resized, ring_cameras
from vpd_lightning.media.particle_colors import particle_colors
from vpd_lightning.media.particle_files import write_glb, write_particles, write_ply
from vpd_lightning.media.pictures import write_contact_sheet, write_particle_plot
from vpd_lightning.randomness import RandomKeys
from vpd_lightning.release.results_folder import beside_checkpoint
from vpd_lightning.renderer.base import AbstractRenderer
from vpd_lightning.types import Cameras, Particles, Rays, RenderedRays

INTRINSICS = [[30.0, 0.0, 16.0], [0.0, 30.0, 12.0], [0.0, 0.0, 1.0]]


def two_cameras() -> Cameras:
    eyes = torch.tensor([[2.0, 0.0, 1.0], [0.0, 2.0, 1.0]], dtype=torch.float64)
    poses = look_at(eyes, torch.tensor([0.1, 0.1, -0.2], dtype=torch.float64))
    return Cameras(torch.tensor(INTRINSICS, dtype=torch.float64).expand(2, 3, 3), poses, 24, 32)


def test_ply_holds_the_points_and_their_colours(tmp_path: Path) -> None:
    positions = np.random.default_rng(0).normal(size=(5, 3)).astype(np.float32)
    colors = np.arange(15, dtype=np.uint8).reshape(5, 3)
    write_ply(tmp_path / "p.ply", positions, colors)
    header, _, body = (tmp_path / "p.ply").read_bytes().partition(b"end_header\n")
    assert header.splitlines()[:3] == [b"ply", b"format binary_little_endian 1.0", b"element vertex 5"]
    assert header.splitlines()[3:] == [
        *(b"property float " + name for name in (b"x", b"y", b"z")),
        *(b"property uchar " + name for name in (b"red", b"green", b"blue")),
    ]
    rows = np.frombuffer(body, dtype=[("position", "<f4", 3), ("color", "u1", 3)])
    assert np.array_equal(rows["position"], positions) and np.array_equal(rows["color"], colors)


def cloud() -> tuple[np.ndarray, np.ndarray]:
    random = np.random.default_rng(1)
    return random.normal(size=(50, 3)).astype(np.float32), random.integers(0, 256, size=(50, 3), dtype=np.uint8)


def test_trimesh_reads_the_ply_to_the_last_bit(tmp_path: Path) -> None:
    positions, colors = cloud()
    write_ply(tmp_path / "p.ply", positions, colors)
    read = trimesh.load(tmp_path / "p.ply")
    assert np.asarray(read.vertices, np.float32).tobytes() == positions.tobytes()
    assert np.array_equal(read.colors[:, :3], colors)


def test_glb_holds_the_same_bits_and_stands_upright(tmp_path: Path) -> None:
    positions, colors = cloud()
    write_glb(tmp_path / "p.glb", positions, colors)
    # The file by its own header: JSON chunk, then a binary chunk with the two buffers.
    content = (tmp_path / "p.glb").read_bytes()
    assert content[:4] == b"glTF"
    length = int.from_bytes(content[12:16], "little")
    header, binary = json.loads(content[20 : 20 + length]), content[28 + length :]
    (primitive,) = header["meshes"][0]["primitives"]
    assert primitive["mode"] == 0, "points"
    stored = {}
    for name, number in primitive["attributes"].items():
        accessor = header["accessors"][number]
        start = header["bufferViews"][accessor["bufferView"]].get("byteOffset", 0) + accessor.get("byteOffset", 0)
        kind = {5126: "<f4", 5121: "u1"}[accessor["componentType"]]
        width = {"VEC3": 3, "VEC4": 4}[accessor["type"]]
        stored[name] = np.frombuffer(binary, kind, accessor["count"] * width, start).reshape(-1, width)
    assert stored["POSITION"].tobytes() == positions.tobytes()
    assert np.array_equal(stored["COLOR_0"][:, :3], colors) and (stored["COLOR_0"][:, 3] == 255).all()
    # trimesh, and what a viewer with y up sees: the world's z.
    scene = trimesh.load(tmp_path / "p.glb")
    (geometry,) = scene.geometry.values()
    assert np.asarray(geometry.vertices, np.float32).tobytes() == positions.tobytes()
    assert np.array_equal(geometry.colors[:, :3], colors)
    seen = scene.to_geometry().vertices
    assert np.allclose(seen, np.stack([positions[:, 0], positions[:, 2], -positions[:, 1]], axis=1), atol=1e-6)


def test_npz_holds_positions_features_and_colours(tmp_path: Path) -> None:
    write_particles(tmp_path / "p.npz", np.ones((4, 3)), np.zeros((4, 7)), np.zeros((4, 3), np.uint8))
    arrays = np.load(tmp_path / "p.npz")
    assert {name: arrays[name].shape for name in arrays} == {
        "positions": (4, 3),
        "features": (4, 7),
        "colors": (4, 3),
    }


def test_ring_looks_at_the_target_from_one_height_and_distance() -> None:
    cameras = two_cameras()
    target = common_target(cameras, torch.zeros(3, dtype=torch.float64))
    torch.testing.assert_close(target, torch.tensor([0.1, 0.1, -0.2], dtype=torch.float64), atol=1e-3, rtol=0)
    ring = ring_cameras(cameras, 8, target)
    pixels, depth = project(target.expand(8, 1, 3), ring)
    torch.testing.assert_close(pixels[:, 0], torch.tensor([16.0, 12.0]).double().expand(8, 2))
    assert (depth > 0).all() and ring.cam_to_world[:, 2, 3].std() < 1e-12
    torch.testing.assert_close(torch.linalg.det(ring.cam_to_world), torch.ones(8, dtype=torch.float64))
    assert (ring.cam_to_world[:, 2, 1] < 0).all(), "the image's y axis points down"


def test_resizing_keeps_the_view() -> None:
    cameras = two_cameras()
    large = resized(cameras, 48, 64)
    point = torch.tensor([[[0.2, -0.1, 0.3]]], dtype=torch.float64).expand(2, 1, 3)
    torch.testing.assert_close(project(point, large)[0], 2 * project(point, cameras)[0])
    assert pixel_rays(large).origins.shape == (2, 48, 64, 3)


def test_camera_files_are_read(tmp_path: Path) -> None:
    cameras = two_cameras()
    content = {
        "height": 24,
        "width": 32,
        "moving": True,
        "cameras": [{"intrinsics": INTRINSICS, "cam_to_world": pose.tolist()} for pose in cameras.cam_to_world],
    }
    (tmp_path / "path.json").write_text(json.dumps(content))
    read, moving = read_camera_file(tmp_path / "path.json")
    assert moving and (read.height, read.width) == (24, 32)
    torch.testing.assert_close(read.cam_to_world.double(), cameras.cam_to_world, atol=1e-6, rtol=0)


@pytest.mark.parametrize(
    "content",
    [
        "not json",
        "[]",
        '{"height": 24, "width": 32, "cameras": []}',
        '{"height": 24, "width": 32, "cameras": [{"intrinsics": [[1]], "cam_to_world": [[1]]}]}',
        '{"height": -1, "width": 32, "cameras": [{"intrinsics": [[1]], "cam_to_world": [[1]]}]}',
        json.dumps(
            {"height": 24, "width": 32, "cameras": [{"intrinsics": INTRINSICS, "cam_to_world": [[1.0] * 4] * 4}]}
        ),
    ],
)
def test_bad_camera_files_are_refused(tmp_path: Path, content: str) -> None:
    (tmp_path / "bad.json").write_text(content)
    with pytest.raises(DataError, match=r"bad\.json"):
        read_camera_file(tmp_path / "bad.json")


def test_a_missing_camera_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"no camera file .*none\.json"):
        read_camera_file(tmp_path / "none.json")


class NearestColor(AbstractRenderer):
    """Gives each ray the features of the first particle that it passes within 1 cm, beyond its near bound."""

    near = 0.3

    def forward(self, particles: Particles, rays: Rays, keys: RandomKeys | None) -> RenderedRays:
        offset = particles.positions[:, None] - rays.origins[:, :, None]
        along = (offset * rays.directions[:, :, None]).sum(-1)
        beside = (offset - along[..., None] * rays.directions[:, :, None]).norm(dim=-1)
        along = along.masked_fill((beside > 0.01) | (along < self.near), torch.inf)
        colors = particles.features[0][along.argmin(-1)]
        return RenderedRays(colors, along.amin(-1), torch.ones(along.shape[:2]))


def test_a_particle_has_its_own_colour_even_behind_others() -> None:
    # Three particles in a row: from the viewpoint the first one hides the others.
    positions = torch.tensor([[[0.0, 0.0, 0.0], [0.0, 0.0, -0.2], [0.0, 0.0, -0.5], [9.0, 9.0, 9.0]]])
    features = torch.eye(4)[None, :, :3]
    mask = torch.tensor([[True, True, True, False]])
    colors = particle_colors(NearestColor(), Particles(positions, features, mask), torch.tensor([0.0, 0.0, 2.0]))
    assert colors.tolist() == [[255, 0, 0], [0, 255, 0], [0, 0, 255]]


def test_a_folder_of_results_appears_when_it_is_complete(tmp_path: Path) -> None:
    with OutputFolder(tmp_path / "deep" / "results") as partial:
        (partial / "a.txt").write_text("a")
        assert not (tmp_path / "deep" / "results").exists()
    assert (tmp_path / "deep" / "results" / "a.txt").read_text() == "a"
    assert len(list((tmp_path / "deep").iterdir())) == 1


@pytest.mark.parametrize("failure", [RuntimeError, KeyboardInterrupt, SystemExit])
def test_a_failure_leaves_no_folder_behind(tmp_path: Path, failure: type[BaseException]) -> None:
    with pytest.raises(failure), OutputFolder(tmp_path / "results") as partial:
        (partial / "a.txt").write_text("a")
        raise failure
    assert not list(tmp_path.iterdir())


def test_a_named_folder_must_not_exist_and_the_usual_one_gets_a_number(tmp_path: Path) -> None:
    (tmp_path / "results").mkdir()
    with pytest.raises(ConfigError, match="exists already"):
        choose_folder(str(tmp_path / "results"), tmp_path)
    assert choose_folder(None, tmp_path / "results") == tmp_path / "results_2"
    assert beside_checkpoint(tmp_path / "checkpoints" / "last.ckpt", "evaluation") == tmp_path / "evaluation"


def test_pictures_are_png_files(tmp_path: Path) -> None:
    images = np.random.default_rng(0).integers(0, 255, size=(3, 20, 24, 3), dtype=np.uint8)
    write_contact_sheet(tmp_path / "sheet.png", [("clip", images, images)], [1, 3], "title")
    write_particle_plot(
        tmp_path / "particles.png", [("step 1", np.zeros((4, 3)), np.zeros((4, 3), np.uint8))], (-1, -1, -1), (1, 1, 1)
    )
    for name in ("sheet.png", "particles.png"):
        assert (tmp_path / name).read_bytes().startswith(b"\x89PNG")

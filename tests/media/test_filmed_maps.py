"""Depth of films: that of a scene whose depth is known, on disk in the project's convention."""

from pathlib import Path

import numpy as np
import torch

from tests.evaluation.tossed_box import CAM_TO_WORLD, FLOOR_HEIGHT, INTRINSICS, SIZE, draw
from vpd_lightning.dynamics.persistence import PersistenceDynamics
from vpd_lightning.encoder.base import AbstractEncoder, EncoderOutput
from vpd_lightning.geometry.cameras import pixel_rays, unproject
from vpd_lightning.media.filmed_maps import map_pictures, write_maps, z_depth
from vpd_lightning.media.render_rollout import render_rollout
from vpd_lightning.media.viewpoints import Viewpoints
from vpd_lightning.randomness import RandomKeys
from vpd_lightning.renderer.base import AbstractRenderer
from vpd_lightning.simulator import Simulator
from vpd_lightning.types import Cameras, Particles, Rays, RenderedRays, RGBDFrames

CAMERAS = Cameras(torch.tensor(INTRINSICS).float(), torch.tensor(CAM_TO_WORLD).float(), SIZE, SIZE)
FAR = 5.0


class Floor(AbstractRenderer):
    """Sees the floor of ``tossed_box`` by its height; what passes it is ``FAR`` away and empty."""

    def forward(self, particles: Particles, rays: Rays, keys: RandomKeys | None) -> RenderedRays:
        distance = (FLOOR_HEIGHT - rays.origins[..., 2]) / rays.directions[..., 2]
        hit = distance > 0
        return RenderedRays(torch.zeros_like(rays.origins), torch.where(hit, distance, FAR), hit.float())


class Blind(AbstractEncoder):
    """Encodes nothing; a simulator asks its parameters where it runs."""

    def __init__(self) -> None:
        super().__init__()
        self.weight = torch.nn.Parameter(torch.zeros(1))

    def forward(self, frames: RGBDFrames, keys: RandomKeys, purpose: str) -> EncoderOutput:
        raise AssertionError("nothing is encoded here")


def rendered_floor(viewpoints: Viewpoints, num_states: int):
    simulator = Simulator(
        encoder=Blind(),
        dynamics=PersistenceDynamics(),
        renderer=Floor(),
        location_noise=0.0,
        checkpoint_dynamics=False,
        pixel_gradient_to_motion=1.0,
    )
    states = [Particles(torch.zeros(1, 1, 3), torch.zeros(1, 1, 2))] * num_states
    return render_rollout(simulator, states, viewpoints, lambda what, done, total: None)


def known_depth(view: int) -> np.ndarray:
    """z-depth of the floor with the box far away, by the arithmetic of ``tossed_box``; 0 where there is no floor."""
    return draw(np.array([0.0, 0.0, 99.0]), np.array([1.0, 0, 0, 0]), view)[1]


def test_depth_is_along_the_optical_axis() -> None:
    rendered = rendered_floor(Viewpoints(CAMERAS, False, None, ["a", "b"], ["a", "b"]), 2)
    assert rendered.depth.shape == rendered.opacity.shape == (2, 2, SIZE, SIZE)
    for view in range(2):
        known = known_depth(view)
        near = (known > 0) & (known < 4)
        assert near.sum() > 100
        for depth in rendered.depth[:, view].numpy():
            np.testing.assert_allclose(depth[near], known[near], rtol=1e-4)
    heights = unproject(rendered.depth[0], CAMERAS)[rendered.opacity[0] > 0.5][..., 2]
    torch.testing.assert_close(heights, torch.full_like(heights, FLOOR_HEIGHT), atol=1e-3, rtol=0)


def test_a_moving_camera_sees_one_moment_from_every_place() -> None:
    rendered = rendered_floor(Viewpoints(CAMERAS, True, None, ["path"], ["0", "1"]), 1)
    assert rendered.depth.shape == (2, 1, SIZE, SIZE)
    still = rendered_floor(Viewpoints(CAMERAS, False, None, ["a", "b"], ["a", "b"]), 1)
    assert torch.equal(rendered.depth[:, 0], still.depth[0])


def test_z_depth_undoes_what_rays_do() -> None:
    depth = torch.rand(2, SIZE, SIZE) + 0.5
    points = unproject(depth, CAMERAS)
    distance = (points - pixel_rays(CAMERAS).origins).norm(dim=-1)
    torch.testing.assert_close(z_depth(distance, CAMERAS), depth)
    assert (distance > depth + 0.01).any()


def test_files_say_where_the_depth_was_seen_from(tmp_path: Path) -> None:
    maps = {"depth": np.full((3, SIZE, SIZE), 2.0, np.float32), "opacity": np.ones((3, SIZE, SIZE), np.float32)}
    write_maps(tmp_path, "film", maps, maps["opacity"], CAMERAS[0], 10.0)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["film_depth.webm", "film_maps.npz", "film_opacity.webm"]
    arrays = np.load(tmp_path / "film_maps.npz")
    assert set(arrays) == {"depth", "opacity", "intrinsics", "cam_to_world"}
    assert np.array_equal(arrays["depth"], maps["depth"]) and arrays["depth"].dtype == np.float32
    assert arrays["cam_to_world"].shape == (3, 4, 4)


def test_previews_are_black_where_nothing_is_and_turn_from_blue_to_red() -> None:
    depth = np.linspace(1, 2, 100, dtype=np.float32).reshape(1, 10, 10)
    opacity = np.ones_like(depth)
    opacity[0, 5] = 0.1
    pictures = map_pictures({"depth": depth}, opacity)
    colors, says = pictures["depth"]
    assert says.startswith("depth, 1.0")
    assert (colors[0, 5] == 0).all() and (colors[0, :5].max(-1) > 0).all()
    near, far = colors[0, 0, 3].astype(int), colors[0, 9, 3].astype(int)
    assert near[2] > near[0] and far[0] > far[2]
    assert map_pictures({"depth": np.zeros_like(depth)}, opacity)["depth"][0].max() == 0, "nothing was measured"

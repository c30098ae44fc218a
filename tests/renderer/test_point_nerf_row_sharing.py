"""One row of the network for all samples of a ray that no particle reaches."""

import pytest
import torch

from tests.renderer.small_renderer import assert_same, gradients_of, rays_of, renderer_of, scene
from vpd_lightning.randomness import RandomKeys
from vpd_lightning.renderer.field.radiance_field import RadianceField
from vpd_lightning.renderer.row_sharing import SharedRows

TIGHT = {"max_radius": 0.25}


@pytest.mark.parametrize("changes", [{}, {"early_stop": 0.2}, {"checkpoint_chunks": True, "ray_chunk_size": 3}])
def test_rows_without_any_neighbor_are_shared_exactly(changes: dict) -> None:
    particles, rays, keys = scene(), rays_of(), RandomKeys(0, 3, [0, 1])
    plain = renderer_of(**TIGHT, **changes)
    shared = renderer_of(**TIGHT, **changes, share_rows_below=0.0)
    assert_same(plain(particles, rays, keys), shared(particles, rays, keys))
    assert plain.last_shared_rows is None
    assert 0.2 < shared.last_shared_rows < 1
    expected = gradients_of(plain, particles, rays, keys)
    for one, other in zip(gradients_of(shared, particles, rays, keys), expected, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-8, atol=1e-9)


def test_only_rows_that_are_needed_are_evaluated() -> None:
    seen = []

    class Counting(RadianceField):
        def forward(self, features, directions, use_color=True):
            seen.append(features.flatten(0, -2))
            return super().forward(features, directions, use_color)

    field = Counting(
        input_dim=2, net_depth=2, net_width=4, skip_layer=1, net_width_condition=4, view_degree=1,
        density_activation="softplus", initial_density=1.0,
    ).double()  # fmt: skip
    features = torch.zeros(2, 3, 4, 2, dtype=torch.float64)
    features[0, 1, 2] = torch.tensor([0.25, -0.5])
    features[1, 2, 0] = torch.tensor([0.0, -0.75])
    features[1, 2, 3] = torch.tensor([0.125, -0.125])
    directions = torch.randn(2, 3, 3, dtype=torch.float64)
    rows = SharedRows(features, 0.125)
    sigmas, rgbs = rows.evaluate(field, features, directions, True)
    assert seen[0].tolist() == [[0.25, -0.5], [0.0, -0.75], *[[0.0, 0.0]] * 6]
    assert rows.num_samples == 24 and rows.num_saved == 16
    features[1, 2, 3] = 0.0  # what it was taken for
    expected = field(features, directions)
    torch.testing.assert_close(sigmas, expected[0], rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(rgbs, expected[1], rtol=1e-12, atol=1e-12)


def test_a_scene_without_particles_takes_one_row_per_ray_and_tier() -> None:
    renderer, plain = renderer_of(share_rows_below=0.0), renderer_of()
    particles, rays = scene(count=0), rays_of()
    assert_same(plain(particles, rays, None), renderer(particles, rays, None))
    assert renderer.last_shared_rows == pytest.approx(1 - 2 / (8 + 20))


def test_a_threshold_above_all_features_shows_the_scene_without_particles() -> None:
    renderer = renderer_of(share_rows_below=1e9)
    seen, empty = renderer(scene(), rays := rays_of(), None), renderer(scene(count=0), rays, None)
    assert_same(seen, empty)

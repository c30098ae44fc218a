"""PointNeRFRenderer, coarse and fine tier together, against rays followed one at a time in float64."""

from collections.abc import Callable

import numpy as np
import pytest
import torch
from torch import nn

from tests.reference import reference_radiance_field as reference
from tests.reference.reference_features import annular_features, nearest
from vpd_lightning.geometry.ray_sampling import even_quantiles, stratified_samples
from vpd_lightning.renderer.field.radiance_field import RadianceField
from vpd_lightning.renderer.point_nerf import PointNeRFRenderer
from vpd_lightning.types import Particles, Rays

RADII, BANDWIDTHS = [0.0, 0.3], [0.2, 0.4]
NEAR, FAR, NUM_NEIGHBORS, VIEW_DEGREE, NUM_COARSE, NUM_FINE = 0.5, 3.0, 4, 2, 7, 9
NUM_PARTICLES, NUM_RAYS, FEATURE_DIM = 30, 4, 3


def _renderer() -> PointNeRFRenderer:
    renderer = PointNeRFRenderer(
        feature_dim=FEATURE_DIM, num_neighbors=NUM_NEIGHBORS, kernel_radii=RADII, kernel_bandwidths=BANDWIDTHS,
        near=NEAR, far=FAR, num_coarse_samples=NUM_COARSE, num_fine_samples=NUM_FINE, net_depth=6, net_width=8,
        skip_layer=4, net_width_condition=5, view_degree=VIEW_DEGREE, density_activation="relu",
        kernel_normalization=None, normalization_epsilon=1e-6, feature_network=None,
        neighbors_backend="auto", features_backend="auto", sort_particles=True, reuse_coarse=True, max_radius=None,
        ray_chunk_size=3, checkpoint_chunks=True,
    )  # fmt: skip
    for parameter in renderer.parameters():
        nn.init.normal_(parameter, std=0.5, generator=torch.Generator().manual_seed(parameter.numel()))
    with torch.no_grad():  # dense enough that the ray is neither empty nor opaque
        for module in renderer.modules():
            if isinstance(module, RadianceField):
                module.density.bias += 0.5
    return renderer.double()


def _field(network: RadianceField) -> reference.Field:
    def linear(layer: nn.Linear) -> reference.Linear:
        return layer.weight.detach().double().numpy(), layer.bias.detach().double().numpy()

    return reference.Field(
        [linear(layer) for layer in network.trunk],
        linear(network.density),
        None if network.bottleneck is None else linear(network.bottleneck),
        linear(network.condition),
        linear(network.color),
        skip_layer=4,
    )


def _query(
    network: RadianceField, positions: np.ndarray, features: np.ndarray, origin: np.ndarray, direction: np.ndarray
) -> Callable[[float], tuple[float, list[float]]]:
    field = _field(network)

    def at(t: float) -> tuple[float, list[float]]:
        point = np.array([[origin[axis] + t * direction[axis] for axis in range(3)]])
        index = np.array([nearest(positions, point[0], NUM_NEIGHBORS)])
        mask = np.ones(index.shape, dtype=bool)
        feature = annular_features(point, positions, features, index, mask, RADII, BANDWIDTHS)[0]
        return reference.evaluate(field, feature, direction, VIEW_DEGREE)

    return at


# float32: samples move by 2^-22 of 3 m, which kernels and networks (slopes of order ten to a hundred) carry on.
@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-6), (torch.float32, 1e-3)])
def test_both_tiers_match_the_loops(dtype: torch.dtype, tolerance: float) -> None:
    generator = np.random.default_rng(0)
    positions = generator.uniform(-1, 1, (2, NUM_PARTICLES, 3))
    features = generator.uniform(size=(2, NUM_PARTICLES, FEATURE_DIM))
    valid = np.ones((2, NUM_PARTICLES), dtype=bool)
    valid[1, 20:] = False  # padding, which must not be seen
    origins = generator.normal(size=(2, NUM_RAYS, 3))
    origins *= 1.8 / np.linalg.norm(origins, axis=-1, keepdims=True)
    directions = generator.uniform(-0.3, 0.3, (2, NUM_RAYS, 3)) - origins
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)

    renderer = _renderer()
    coarse, fine = (module for module in renderer.modules() if isinstance(module, RadianceField))
    assert coarse.view_degree is None and fine.view_degree == VIEW_DEGREE
    queries = [
        [[_query(net, positions[b][valid[b]], features[b][valid[b]], origins[b, r], directions[b, r])
          for net in (coarse, fine)] for r in range(NUM_RAYS)]
        for b in range(2)
    ]  # fmt: skip
    renderer = renderer.to(dtype)
    rendered = renderer(
        Particles(torch.from_numpy(positions).to(dtype), torch.from_numpy(features).to(dtype), torch.from_numpy(valid)),
        Rays(torch.from_numpy(origins).to(dtype), torch.from_numpy(directions).to(dtype)),
        None,
    )
    t_coarse = stratified_samples(NEAR, FAR, NUM_COARSE, 1, None)[0].double().numpy()
    np.testing.assert_allclose(t_coarse, np.linspace(NEAR, FAR, NUM_COARSE), rtol=1e-6)
    u = even_quantiles(NUM_FINE, 1, torch.device("cpu"))[0].double().numpy()
    np.testing.assert_allclose(u, np.linspace(0, 1, NUM_FINE), rtol=1e-6, atol=1e-6)

    for member in range(2):
        for ray in range(NUM_RAYS):
            coarse_color, fine_color = reference.render_ray(*queries[member][ray], t_coarse, u)
            found = rendered.rgbs[member, ray].detach().numpy()
            np.testing.assert_allclose(found, fine_color, rtol=tolerance, atol=tolerance)
            if rendered.coarse_rgbs is not None:
                found = rendered.coarse_rgbs[member, ray].detach().numpy()
                np.testing.assert_allclose(found, coarse_color, rtol=tolerance, atol=tolerance)
    opacities = rendered.opacities.detach()
    assert (opacities > 0.1).any() and (opacities < 0.999).any()

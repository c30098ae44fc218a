"""RadianceField against the network written out unit by unit in float64."""

import numpy as np
import pytest
import torch
from torch import nn

from tests.reference import reference_radiance_field as reference
from vpd_lightning.renderer.field.radiance_field import RadianceField

SIZES = {"input_dim": 5, "net_depth": 8, "net_width": 9, "skip_layer": 4, "net_width_condition": 6}


def _linear(layer: nn.Linear) -> reference.Linear:
    return layer.weight.detach().double().numpy(), layer.bias.detach().double().numpy()


# float32: eleven layers of at most fourteen terms of order 1; each adds about 1e-6, the densities reach ten.
@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-6), (torch.float32, 1e-4)])
@pytest.mark.parametrize("view_degree", [None, 4])
def test_network_matches_the_loops(view_degree: int | None, dtype: torch.dtype, tolerance: float) -> None:
    torch.manual_seed(0)
    network = RadianceField(**SIZES, view_degree=view_degree, density_activation="relu", initial_density=1.0).to(dtype)
    for parameter in network.parameters():
        nn.init.normal_(parameter, std=0.5)
    features = torch.randn(3, 4, 5, dtype=dtype)
    directions = nn.functional.normalize(torch.randn(3, 3, dtype=dtype), dim=-1)
    with torch.no_grad():  # centre the raw densities, so that the ReLU cuts some of them
        network.density.bias += 1e3
        network.density.bias -= network(features, directions, use_color=False)[0].mean()
    field = reference.Field(
        [_linear(layer) for layer in network.trunk],
        _linear(network.density),
        None if network.bottleneck is None else _linear(network.bottleneck),
        _linear(network.condition),
        _linear(network.color),
        skip_layer=4,
    )
    sigmas, rgbs = network(features, None if view_degree is None else directions)
    for ray in range(3):
        for sample in range(4):
            density, color = reference.evaluate(
                field, features[ray, sample].double().numpy(), directions[ray].double().numpy(), view_degree or 0
            )
            np.testing.assert_allclose(sigmas[ray, sample].item(), density, rtol=tolerance, atol=tolerance)
            np.testing.assert_allclose(rgbs[ray, sample].detach().numpy(), color, rtol=tolerance, atol=tolerance)
    assert (sigmas > 0).any() and (sigmas == 0).any()

from collections.abc import Callable
from functools import partial

import pytest
import torch

from vpd_lightning.renderer.field.positional_encoding import encoding_dim, positional_encoding
from vpd_lightning.renderer.field.radiance_field import RadianceField

SMALL = {
    "input_dim": 6,
    "net_depth": 6,
    "net_width": 16,
    "skip_layer": 2,
    "net_width_condition": 8,
    "view_degree": 2,
    "density_activation": "relu",
    "initial_density": 0.3,
}


def field_of(**changes: object) -> RadianceField:
    field = RadianceField(**(SMALL | changes)).double()
    for parameter in field.parameters():
        torch.nn.init.normal_(parameter, std=0.4)
    return field


def literal(field: RadianceField, features: torch.Tensor, directions: torch.Tensor | None) -> tuple[torch.Tensor, ...]:
    """jaxnerf's network with its concatenations written out."""
    hidden = features
    for index, layer in enumerate(field.trunk):
        hidden = layer(hidden).relu()
        if index % 2 == 0 and index > 0 and index + 1 < len(field.trunk):
            hidden = torch.cat([hidden, features], dim=-1)
    raw_density = field.density(hidden)[..., 0]
    density = raw_density.relu() if field.density_activation == "relu" else torch.nn.functional.softplus(raw_density)
    if directions is not None:
        encoded = positional_encoding(directions, 2)[..., None, :].expand(*hidden.shape[:-1], -1)
        hidden = torch.cat([field.bottleneck(hidden), encoded], dim=-1)
    if field.condition is not None:
        hidden = field.condition(hidden).relu()
    return density, field.color(hidden).sigmoid()


@pytest.mark.parametrize("density_activation", ["relu", "softplus"])
@pytest.mark.parametrize("view_degree", [None, 2])
def test_the_fused_network_equals_jaxnerfs(view_degree: int | None, density_activation: str) -> None:
    field = field_of(view_degree=view_degree, density_activation=density_activation)
    features = torch.rand(2, 3, 5, 6, dtype=torch.float64, requires_grad=True)
    directions = None if view_degree is None else torch.randn(2, 3, 3, dtype=torch.float64)
    got, expected = field(features, directions), literal(field, features, directions)
    for one, other in zip(got, expected, strict=True):
        # Only the order of summation differs.
        torch.testing.assert_close(one, other, rtol=1e-10, atol=1e-12)
    gradients = [
        torch.autograd.grad(sigmas.sum() + rgbs.square().sum(), [features, *field.parameters()])
        for sigmas, rgbs in (got, expected)
    ]
    for one, other in zip(*gradients, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-9, atol=1e-10)


@pytest.mark.parametrize("condition", [{"view_degree": 2}, {"view_degree": None, "net_width_condition": None}])
def test_scenes_given_once_equal_scenes_concatenated_at_every_sample(condition: dict[str, int | None]) -> None:
    field = field_of(**condition)
    features = torch.rand(2, 3, 5, 4, dtype=torch.float64, requires_grad=True)
    scenes = torch.rand(2, 2, dtype=torch.float64, requires_grad=True)
    directions = None if condition["view_degree"] is None else torch.randn(2, 3, 3, dtype=torch.float64)
    whole = torch.cat([features, scenes[:, None, None].expand(2, 3, 5, 2)], dim=-1)
    got, expected = field(features, directions, scenes=scenes), literal(field, whole, directions)
    for one, other in zip(got, expected, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-10, atol=1e-12)
    gradients = [
        torch.autograd.grad(sigmas.sum() + rgbs.square().sum(), [features, scenes, *field.parameters()])
        for sigmas, rgbs in (got, expected)
    ]
    for one, other in zip(*gradients, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-9, atol=1e-10)


def test_without_color_the_density_is_the_same() -> None:
    field, features = field_of(view_degree=None), torch.rand(1, 4, 6, dtype=torch.float64)
    sigmas, rgbs = field(features, None, use_color=False)
    assert rgbs is None
    torch.testing.assert_close(sigmas, field(features, None)[0], rtol=1e-12, atol=1e-12)


def test_the_encoding_has_jaxnerfs_order_and_length() -> None:
    vectors = torch.randn(5, 3, dtype=torch.float64)
    encoded = positional_encoding(vectors, 4)
    assert encoded.shape == (5, 27) and encoding_dim(4) == 27
    expected = [vectors]
    for power in range(4):
        expected += [torch.sin(vectors * 2**power), torch.sin(vectors * 2**power + torch.pi / 2)]
    torch.testing.assert_close(encoded, torch.cat(expected, dim=-1), rtol=0, atol=1e-14)
    assert torch.equal(positional_encoding(vectors, 0), vectors)


# Without view directions and without a layer of its own, the colour is 3 * 257 numbers instead of 128 * 257 + 3 * 129.
@pytest.mark.parametrize(
    ("view_degree", "layer", "count"), [(None, 128, 527_108), (4, 128, 596_356), (None, None, 494_596)]
)
def test_parameter_counts_at_the_papers_size(view_degree: int | None, layer: int | None, count: int) -> None:
    size = {"input_dim": 64, "net_depth": 8, "net_width": 256, "skip_layer": 4, "net_width_condition": layer}
    field = RadianceField(**(SMALL | size | {"view_degree": view_degree}))
    assert sum(parameter.numel() for parameter in field.parameters()) == count


@pytest.mark.parametrize("density_activation", ["relu", "softplus"])
def test_the_scene_starts_as_visible_fog(density_activation: str) -> None:
    field = RadianceField(**(SMALL | {"density_activation": density_activation}))
    sigmas, _ = field(torch.rand(3, 4, 6) * 50, torch.randn(3, 3))
    torch.testing.assert_close(sigmas, torch.full((3, 4), 0.3))
    sigmas.sum().backward()
    assert bool(field.density.weight.grad.abs().sum() > 0)


def test_outputs_are_float32_under_autocast() -> None:
    field = field_of().float()
    features, directions = torch.rand(2, 5, 6), torch.randn(2, 3)
    exact = field(features, directions)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        rounded = field(features, directions)
    for one, other in zip(rounded, exact, strict=True):
        assert one.dtype == torch.float32
        # bf16 products keep two to three digits of values around one, through eight layers.
        torch.testing.assert_close(one, other, rtol=0.1, atol=0.1)


@pytest.mark.parametrize("view_degree", [None, 2])
def test_autocast_rounds_the_fused_network_no_worse_than_jaxnerfs(view_degree: int | None) -> None:
    field = field_of(view_degree=view_degree, density_activation="softplus").float()
    features = torch.rand(64, 16, 6, requires_grad=True)
    directions = None if view_degree is None else torch.randn(64, 3)

    def gradient(network: Callable[..., tuple[torch.Tensor, ...]], is_rounded: bool) -> torch.Tensor:
        with torch.autocast("cpu", dtype=torch.bfloat16, enabled=is_rounded):
            sigmas, rgbs = network(features, directions)
        loss = sigmas.float().mean() + rgbs.float().square().mean()
        gradients = torch.autograd.grad(loss, [features, *field.parameters()])
        assert all(one.dtype == torch.float32 for one in gradients)
        return torch.cat([one.flatten() for one in gradients])

    exact = gradient(field, is_rounded=False)
    error = float((gradient(field, is_rounded=True) - exact).norm())
    literal_error = float((gradient(partial(literal, field), is_rounded=True) - exact).norm())
    # Eight bits per product, and ReLUs near their bend that open on one side only; both networks by their own chance.
    assert error < 0.05 * float(exact.norm()) and error < 1.5 * literal_error


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("net_depth", 0),
        ("view_degree", -1),
        ("density_activation", "exp"),
        ("initial_density", 0.0),
        ("net_width_condition", None),
    ],
)
def test_values_out_of_range_are_refused_by_name(name: str, value: object) -> None:
    with pytest.raises(ValueError, match=name):
        RadianceField(**(SMALL | {name: value}))

"""The radiance field on features of every size, with activations driven to their ends."""

import pytest
import torch
from torch import Tensor

from tests.stability.hard_scenes import Mode, is_finite
from tests.stability.known_faults import known_fault
from vpd_lightning.renderer.field.positional_encoding import positional_encoding
from vpd_lightning.renderer.field.radiance_field import DENSITY_ACTIVATIONS, RadianceField

SIZES = (0.0, 1e-40, 1e-20, 1e-6, 1.0, 1e3, 1e6)


def field(mode: Mode, device: torch.device, activation: str = "relu", **changes) -> RadianceField:
    torch.manual_seed(0)
    settings = {
        "input_dim": 12, "net_depth": 8, "net_width": 32, "skip_layer": 4, "net_width_condition": 16,
        "view_degree": 4, "density_activation": activation, "initial_density": 0.2,
    }  # fmt: skip
    built = RadianceField(**{**settings, **changes}).to(device, mode.dtype)
    with torch.no_grad():  # the density head starts at zero
        for parameter in built.parameters():
            parameter.add_(0.05 * torch.randn_like(parameter))
    return built


def inputs(mode: Mode, device: torch.device, size: float) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(1)
    features = size * torch.randn(7, 10, 12, generator=generator, dtype=torch.float64)
    directions = torch.nn.functional.normalize(torch.randn(7, 3, generator=generator, dtype=torch.float64), dim=-1)
    return features.to(device, mode.dtype), directions.to(device, mode.dtype)


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("view_degree", [None, 0, 4])
@pytest.mark.parametrize("activation", DENSITY_ACTIVATIONS)
def test_densities_and_colours_are_in_range_with_finite_gradients(
    activation: str, view_degree: int | None, size: float, mode: Mode, device: torch.device
):
    network = field(mode, device, activation, view_degree=view_degree)
    features, directions = inputs(mode, device, size)
    features.requires_grad_()

    with mode.context(device):
        sigmas, rgbs = network(features, directions)
    gradients = torch.autograd.grad((sigmas.sum() + rgbs.sum()), [features, *network.parameters()])

    assert sigmas.dtype == rgbs.dtype == mode.dtype and is_finite(sigmas, rgbs, *gradients)
    assert (sigmas >= 0).all() and (rgbs >= 0).all() and (rgbs <= 1).all()


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("activation", DENSITY_ACTIVATIONS)
def test_the_field_is_that_of_float64(activation: str, size: float, mode: Mode, device: torch.device):
    network, twin = field(mode, device, activation), field(mode, device, activation).double()
    features, directions = inputs(mode, device, size)

    with mode.context(device):
        sigmas, rgbs = network(features, directions)
    exact_sigmas, exact_rgbs = twin(features.double(), directions.double())

    # Products with bfloat16 factors err by 2^-9 each; ten layers and sums of 32 terms make at most a few percent of the
    # largest value. In float32 and float64 the same count gives a few hundred eps.
    share = 0.05 if mode.is_autocast else 500 * mode.eps
    torch.testing.assert_close(sigmas.double(), exact_sigmas, rtol=0, atol=share * max(1.0, float(exact_sigmas.max())))
    raw_size = max(1.0, size)  # the argument of the sigmoid grows with the features, and its error with it
    assert float((rgbs.double() - exact_rgbs).abs().max()) <= min(1.0, share * 10 * raw_size)


@pytest.mark.parametrize("raw", [-1e6, -1e5, -100.0, -20.0, 0.0, 20.0, 100.0, 1e5, 1e6])
@pytest.mark.parametrize("activation", DENSITY_ACTIVATIONS)
def test_activations_at_their_ends(activation: str, raw: float, mode: Mode, device: torch.device):
    network = field(mode, device, activation)
    with torch.no_grad():
        network.density.bias.fill_(raw)
        network.color.bias.fill_(raw)
    features, directions = inputs(mode, device, 1e-3)
    features.requires_grad_()

    with mode.context(device):
        sigmas, rgbs = network(features, directions)
    gradients = torch.autograd.grad(sigmas.sum() + rgbs.sum(), [features, *network.parameters()])

    assert is_finite(sigmas, rgbs, *gradients)
    # bfloat16 holds the bias to 3 digits; the features add a little.
    expected = (
        max(raw, 0.0) if activation == "relu" or abs(raw) > 1 else torch.nn.functional.softplus(torch.tensor(raw))
    )
    torch.testing.assert_close(sigmas.double(), torch.full_like(sigmas.double(), float(expected)), rtol=0.01, atol=0.2)


@pytest.mark.parametrize("initial_density", [1e-6, 1e-3, 1.0, 40.0, 1e3, 1e6])
@pytest.mark.parametrize("activation", DENSITY_ACTIVATIONS)
def test_the_first_density_is_the_wanted_one_in_worlds_of_any_size(
    activation: str, initial_density: float, request: pytest.FixtureRequest
):
    """The first density is one over the length of a ray: 1e6 per metre where a world is a micrometre across."""
    known_fault(request, "softplus_bias", activation == "softplus" and initial_density >= 1e3)
    network = RadianceField(
        input_dim=4, net_depth=2, net_width=8, skip_layer=4, net_width_condition=4, view_degree=None,
        density_activation=activation, initial_density=initial_density,
    ).double()  # fmt: skip

    sigmas, _ = network(torch.rand(3, 4, dtype=torch.float64), None)

    # The bias is stored in float32 before the network is cast.
    torch.testing.assert_close(sigmas, torch.full_like(sigmas, initial_density), rtol=1e-5, atol=0)


@pytest.mark.parametrize("shape", [(0, 5), (5, 0), (0, 0)])
def test_no_rays_and_no_samples(shape: tuple[int, int], mode: Mode, device: torch.device):
    network = field(mode, device)

    with mode.context(device):
        sigmas, rgbs = network(
            torch.zeros(*shape, 12, device=device, dtype=mode.dtype),
            torch.zeros(shape[0], 3, device=device, dtype=mode.dtype),
        )

    assert sigmas.shape == shape and rgbs.shape == (*shape, 3)


@pytest.mark.parametrize("degree", [0, 4, 10])
def test_the_encoding_of_a_direction_is_that_of_float64(degree: int, mode: Mode, device: torch.device):
    _, directions = inputs(mode, device, 1.0)

    with mode.context(device):
        encoded = positional_encoding(directions, degree)
    exact = positional_encoding(directions.double(), degree)

    # Multiplying by a power of two is exact, so sines err by one rounding of theirs, at any degree.
    torch.testing.assert_close(encoded.double(), exact, rtol=0, atol=4 * mode.eps)

"""LPIPS against its formula in float64 with torchmetrics' published weights, and what it needs to be measured.

AlexNet's weights are not part of any package: random ones take their place here, so what is compared is everything but
their values.
"""

import inspect
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType, SimpleNamespace

import pytest
import torch
import torchmetrics.functional.image.lpips as torchmetrics_lpips
from torch import nn

from vpd_lightning.metrics import lpips as module
from vpd_lightning.metrics.lpips import lpips, lpips_of_images
from vpd_lightning.metrics.true_images import TrueImages

FILE = "alexnet-owt-7be5be79.pth"
SHIFT, SCALE = torch.tensor([-0.030, -0.088, -0.188]), torch.tensor([0.458, 0.448, 0.450])


def alexnet_features() -> nn.Sequential:
    """The convolutions of AlexNet as torchvision orders them, with random weights."""
    torch.manual_seed(0)
    return nn.Sequential(
        nn.Conv2d(3, 64, 11, stride=4, padding=2), nn.ReLU(inplace=True), nn.MaxPool2d(3, 2),
        nn.Conv2d(64, 192, 5, padding=2), nn.ReLU(inplace=True), nn.MaxPool2d(3, 2),
        nn.Conv2d(192, 384, 3, padding=1), nn.ReLU(inplace=True),
        nn.Conv2d(384, 256, 3, padding=1), nn.ReLU(inplace=True),
        nn.Conv2d(256, 256, 3, padding=1), nn.ReLU(inplace=True), nn.MaxPool2d(3, 2),
    )  # fmt: skip


@pytest.fixture
def made_torchvision(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[Path]:
    """A stand-in for torchvision, whose weights are "on the machine" once the returned file is there."""
    weights = SimpleNamespace(DEFAULT=SimpleNamespace(url=f"https://example.org/models/{FILE}"))
    models = ModuleType("torchvision.models")
    models.AlexNet_Weights = weights  # type: ignore[attr-defined]
    models.alexnet = lambda weights: SimpleNamespace(features=alexnet_features())  # type: ignore[attr-defined]
    package = ModuleType("torchvision")
    package.models = models  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "torchvision", package)
    monkeypatch.setitem(sys.modules, "torchvision.models", models)
    monkeypatch.setattr(torchmetrics_lpips, "_TORCHVISION_AVAILABLE", True)
    monkeypatch.setattr("torchmetrics.image.lpip._TORCHVISION_AVAILABLE", True)
    monkeypatch.setattr(torch.hub, "get_dir", lambda: str(tmp_path))
    module.network.cache_clear()
    yield tmp_path / "checkpoints" / FILE
    module.network.cache_clear()


@pytest.fixture
def network(made_torchvision: Path) -> nn.Module:
    made_torchvision.parent.mkdir()
    made_torchvision.touch()
    found = module.network()
    assert found is not None
    return found


@torch.no_grad()
def by_formula(pred: torch.Tensor, target: torch.Tensor) -> list[float]:
    """Return equation 1 of the paper for each image (``image height width 3``), in float64."""
    features = alexnet_features().double()
    heads = torch.load(
        Path(inspect.getfile(torchmetrics_lpips)).parent / "lpips_models" / "alex.pth", map_location="cpu"
    )
    values = []
    for one, other in zip(pred.double(), target.double(), strict=True):
        total, pair = 0.0, [((2 * image - 1 - SHIFT) / SCALE).permute(2, 0, 1)[None] for image in (one, other)]
        level = 0
        for layer in features:
            pair = [layer(image) for image in pair]
            if isinstance(layer, nn.ReLU):
                first, second = (image / (image.square().sum(dim=1, keepdim=True).sqrt() + 1e-8) for image in pair)
                weights = heads[f"lin{level}.model.1.weight"].double().flatten()
                total += float(((first - second).square() * weights[:, None, None]).sum(dim=1).mean())
                level += 1
        assert level == 5
        values.append(total)
    return values


def images(*shape: int) -> torch.Tensor:
    return torch.rand(*shape, 64, 64, 3, generator=torch.Generator().manual_seed(1))


def test_it_follows_the_formula(network: nn.Module) -> None:
    truth = images(3)
    pred = (truth + 0.3 * truth.flip(1) - 0.1).clamp(0, 1)
    assert lpips(pred, truth, network).tolist() == pytest.approx(by_formula(pred, truth), rel=1e-4)


def test_identical_images_have_none_and_the_prediction_is_clamped(network: nn.Module) -> None:
    truth = images(2)
    assert lpips(truth, truth, network).tolist() == [0.0, 0.0]
    wild = 3 * truth - 1
    assert torch.equal(lpips(wild, truth, network), lpips(wild.clamp(0, 1), truth, network))


def test_an_image_has_the_same_value_in_any_company(network: nn.Module, monkeypatch: pytest.MonkeyPatch) -> None:
    truth = images(2, 3)
    pred = truth.flip(2)
    together = lpips(pred, truth, network)
    assert together.shape == (2, 3) and together.dtype == truth.dtype
    monkeypatch.setattr(module, "_IMAGES_PER_CALL", 1)
    torch.testing.assert_close(lpips(pred, truth, network), together, rtol=1e-4, atol=1e-6)


def test_one_prediction_stands_for_all_steps(network: nn.Module) -> None:
    truth = images(3, 2)
    values = lpips_of_images(truth[:1], TrueImages(truth))
    assert values.shape == (3, 2) and values[0].abs().max() < 1e-6 and (values[1:] > 0).all()


def test_images_that_are_too_small_have_no_value(network: nn.Module) -> None:
    for size, is_known in ((30, False), (31, True)):
        truth = images(1, 2)[..., :size, :size, :]
        assert lpips_of_images(truth, TrueImages(truth)).isnan().all() != is_known


def test_without_weights_there_is_no_value_and_nothing_is_fetched(
    made_torchvision: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(torch.hub, "load_state_dict_from_url", lambda *_, **__: pytest.fail("it went to fetch them"))
    assert not made_torchvision.exists() and module.network() is None
    assert lpips_of_images(images(1, 2), TrueImages(images(4, 2))).isnan().all()


@pytest.mark.parametrize("error", [ImportError, RuntimeError, AttributeError])
def test_a_torchvision_that_does_not_import_is_none(monkeypatch: pytest.MonkeyPatch, error: type[Exception]) -> None:
    class Broken(ModuleType):
        def __getattr__(self, name: str) -> object:
            raise error("operator torchvision::nms does not exist")

    monkeypatch.setitem(sys.modules, "torchvision", Broken("torchvision"))
    monkeypatch.setitem(sys.modules, "torchvision.models", Broken("torchvision.models"))
    module.network.cache_clear()
    assert module.network() is None
    module.network.cache_clear()

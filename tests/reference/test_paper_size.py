"""Parameter counts at the paper's full size, counted by hand from appendix A, against the modules themselves."""

import pytest
import torch
from torch import nn

from vpd_lightning.config import build_simulator, compose
from vpd_lightning.encoder.networks.unet_network import UNetNetwork
from vpd_lightning.renderer.field.radiance_field import RadianceField

CHANNELS = [64, 128, 256, 512, 512, 256, 128, 64, 16]
FEATURE, HIDDEN, STEPS, KERNELS = 16, 128, 10, 4
WIDTH, CONDITION_WIDTH, VIEW_DEGREE = 256, 128, 4

# Written out as numbers too, as they stand in docs/paper_map.md.
UNET, GNN, COARSE_FIELD, FINE_FIELD = 7_026_256, 1_612_435, 527_108, 596_356


def _conv(inputs: int, outputs: int) -> int:
    return 3 * 3 * inputs * outputs + outputs


def _linear(inputs: int, outputs: int) -> int:
    return inputs * outputs + outputs


def _mlp(inputs: int, *outputs: int) -> int:
    return sum(_linear(i, o) for i, o in zip((inputs, *outputs[:-1]), outputs, strict=True))


def _count(module: nn.Module) -> int:
    return sum(parameter.numel() for parameter in module.parameters())


def _unet_by_hand() -> int:
    down = _conv(3, 64) + _conv(64, 128) + _conv(128, 256) + _conv(256, 512) + _conv(512, 512)
    # What comes up from below, beside the skip of the same size.
    up = _conv(512 + 512, 256) + _conv(256 + 256, 128) + _conv(128 + 128, 64) + _conv(64 + 64, 16)
    return down + up


def _gnn_by_hand() -> int:
    norm = 2 * HIDDEN
    encode_nodes = 2 * _mlp(FEATURE, HIDDEN, HIDDEN)  # previous and current particles
    encode_edges = 4 * _mlp(3, HIDDEN, HIDDEN)  # previous->A, current->A, A->A, A->current
    into_edges = 2 * (_mlp(2 * HIDDEN, HIDDEN, HIDDEN) + norm)  # edge + sender; the abstract node is empty
    into_nodes = _mlp(HIDDEN, HIDDEN, HIDDEN) + norm  # the sum of all messages; the node itself is empty
    edge = _mlp(3 * HIDDEN, HIDDEN, HIDDEN) + norm  # edge + sender + receiver
    node = _mlp(2 * HIDDEN, HIDDEN, HIDDEN) + norm  # node + sum of messages
    decode = _mlp(HIDDEN, HIDDEN, HIDDEN, HIDDEN, 3) + _mlp(HIDDEN, HIDDEN, HIDDEN, HIDDEN, FEATURE)
    return encode_nodes + encode_edges + into_edges + into_nodes + STEPS * (edge + node) + edge + node + decode


def _field_by_hand(view_directions: bool) -> int:
    inputs = KERNELS * FEATURE
    trunk = _linear(inputs, WIDTH) + 4 * _linear(WIDTH, WIDTH)  # layers 0-4
    trunk += _linear(WIDTH + inputs, WIDTH) + 2 * _linear(WIDTH, WIDTH)  # layers 5-7, the input joins again
    # "followed by 1 layer of width 128" holds for both networks; the bottleneck is jaxnerf's, to meet the directions.
    bottleneck = _linear(WIDTH, WIDTH) if view_directions else 0
    view = 3 + 3 * 2 * VIEW_DEGREE if view_directions else 0
    head = _linear(WIDTH + view, CONDITION_WIDTH) + _linear(CONDITION_WIDTH, 3)
    return trunk + _linear(WIDTH, 1) + bottleneck + head


def test_the_hand_formulas_give_the_printed_numbers() -> None:
    assert (_unet_by_hand(), _gnn_by_hand()) == (UNET, GNN)
    assert (_field_by_hand(view_directions=False), _field_by_hand(view_directions=True)) == (COARSE_FIELD, FINE_FIELD)


def test_the_composed_model_of_mujoco_block_has_the_counts_of_the_hand_formulas() -> None:
    simulator = build_simulator(compose("train", ["experiment=mujoco_block"]))
    assert _count(simulator.encoder) == _unet_by_hand()
    assert _count(simulator.dynamics) == _gnn_by_hand()
    networks = [module for module in simulator.renderer.modules() if isinstance(module, RadianceField)]
    assert [_count(network) for network in networks] == [COARSE_FIELD, FINE_FIELD]
    assert _count(simulator.renderer) == COARSE_FIELD + FINE_FIELD
    assert _count(simulator) == UNET + GNN + COARSE_FIELD + FINE_FIELD == 9_762_155


def test_the_unet_has_one_convolution_per_listed_width_at_the_listed_size() -> None:
    network = UNetNetwork(channels=CHANNELS, in_channels=3)
    seen: list[tuple[int, int]] = []
    for module in network.modules():
        if isinstance(module, nn.Conv2d):
            assert module.kernel_size == (3, 3)
            module.register_forward_hook(lambda _, __, output: seen.append((output.shape[1], output.shape[-1])))
    assert network(torch.zeros(1, 3, 128, 128)).shape == (1, 16, 128, 128)
    assert seen == list(zip(CHANNELS, [128, 64, 32, 16, 8, 16, 32, 64, 128], strict=True))
    assert not any(isinstance(module, nn.BatchNorm2d) for module in network.modules())


SISTERS = ["deformable_block", "deformable_multi", "deformable_collision", "movi_a", "movi_b", "movi_c"]


@pytest.mark.parametrize("name", SISTERS)
def test_the_other_experiments_have_the_same_networks(name: str) -> None:
    assert _count(build_simulator(compose("train", [f"experiment={name}"]))) == 9_762_155

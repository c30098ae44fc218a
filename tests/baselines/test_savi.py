import pytest
import torch

from tests.baselines.sizes import KUBRIC_SAVI, PAPER_SAVI, count, images, savi
from vpd_lightning.baselines.slot_state import SlotState
from vpd_lightning.baselines.soft_position import SoftPositionEmbedding


@pytest.mark.parametrize(("sizes", "total"), [(PAPER_SAVI, 1_990_148), (KUBRIC_SAVI, 1_990_660)])
def test_the_papers_sizes(sizes, total):
    model = savi(sizes).eval()
    resolution, num_slots = sizes["resolution"], sizes["num_slots"]

    with torch.no_grad():
        slots, _ = model.encode(images(1, 1, resolution), None)
        decoded = model.decoder(slots)

    assert model.encoder.map_size == 64
    assert slots.shape == (1, 1, num_slots, 128)
    assert decoded.images.shape == (1, 1, 3, resolution, resolution)
    assert decoded.rgbs.shape == (1, 1, num_slots, 3, resolution, resolution)
    assert decoded.masks.shape == (1, 1, num_slots, 1, resolution, resolution)
    assert count(model) == total


def test_the_parts_have_the_number_of_parameters_that_the_released_ones_have():
    model = savi(PAPER_SAVI)

    assert count(model.encoder.convolutions) == 312_256
    assert count(model.encoder.position) == 320
    assert count(model.encoder.mlp) == 24_960
    assert count(model.kernel_head) == 99_328
    assert count(model.slot_attention) == 214_912
    assert count(model.predictor.transformer) == 396_544
    assert count(model.predictor.lstm) == 395_264
    assert count(model.predictor.projection) == 32_896
    assert count(model.decoder.position) == 640
    assert count(model.decoder) == 513_156
    assert model.initial_slots.numel() == 512
    assert count(savi(PAPER_SAVI, kernel_head=False)) == 1_990_148 - 99_328


def test_soft_positions_are_the_distances_to_the_four_borders():
    position = SoftPositionEmbedding(channels=4, height=3, width=5)
    with torch.no_grad():
        position.linear.weight.copy_(torch.eye(4))
        position.linear.bias.zero_()

    found = position(torch.zeros(2, 4, 3, 5))

    assert found.shape == (2, 4, 3, 5) and not position.state_dict().keys() - {"linear.weight", "linear.bias"}
    assert torch.allclose(found[0, :, 0, 0], torch.tensor([0.0, 0.0, 1.0, 1.0]))
    assert torch.allclose(found[0, :, 2, 1], torch.tensor([1.0, 0.25, 0.0, 0.75]))
    assert torch.allclose(found[1, :, 1, 4], torch.tensor([0.5, 1.0, 0.5, 0.0]))


def test_the_encoder_is_linear_behind_its_last_convolution_and_adds_positions_there():
    encoder, shown = savi(encoder_channels=[8, 8, 8], encoder_first_stride=2).encoder, images()[0]
    first, second, third = encoder.convolutions

    features = torch.nn.functional.conv2d(shown, first.weight, first.bias, stride=2, padding=2)
    features = torch.nn.functional.conv2d(features.clamp_min(0), second.weight, second.bias, padding=2)
    features = torch.nn.functional.conv2d(features.clamp_min(0), third.weight, third.bias, padding=2)
    pixel = encoder.position(features)[:, :, 3, 5]

    tokens = encoder(shown)
    assert tokens.shape == (3, 64, 16)
    assert torch.allclose(tokens[:, 3 * 8 + 5], encoder.mlp(pixel), atol=1e-5)
    assert [type(layer).__name__ for layer in encoder.mlp] == ["LayerNorm", "Linear", "ReLU", "Linear"]


def test_the_decoder_doubles_until_the_resolution_is_reached():
    decoder, slots = savi(decoder_channels=[16, 8, 8, 8]).decoder, torch.randn(2, 3, 16)

    features = decoder.position(slots.reshape(6, 16, 1, 1).expand(-1, -1, 8, 8))
    sizes = []
    for convolution, stride in zip(decoder.convolutions, [2, 1, 1], strict=True):
        features = torch.nn.functional.conv_transpose2d(
            features, convolution.weight, convolution.bias, stride=stride, padding=2, output_padding=stride - 1
        ).clamp_min(0)
        sizes.append(features.shape[-1])
    layers = torch.einsum("ntij,ct->ncij", features, decoder.to_layers.weight[:, :, 0, 0])
    layers = (layers + decoder.to_layers.bias[:, None, None]).reshape(2, 3, 4, 16, 16)

    assert sizes == [16, 16, 16]
    assert torch.allclose(decoder(slots).rgbs, layers[:, :, :3], atol=1e-5)
    assert torch.allclose(decoder(slots).masks, layers[:, :, 3:].softmax(1), atol=1e-5)


def test_images_are_the_mixture_of_layers_by_masks():
    decoded = savi().decoder(torch.randn(2, 4, 3, 16))

    assert (decoded.masks >= 0).all()
    assert torch.allclose(decoded.masks.sum(2), torch.ones(2, 4, 1, 16, 16), atol=1e-5)
    mixed = sum(decoded.masks[:, :, i] * decoded.rgbs[:, :, i] for i in range(3))
    assert torch.allclose(decoded.images, mixed, atol=1e-6)


def test_the_decoder_keeps_the_order_of_slots_in_its_layers_only():
    model, slots = savi(), torch.randn(2, 3, 16)
    order = torch.tensor([1, 2, 0])

    decoded, permuted = model.decoder(slots), model.decoder(slots[:, order])

    assert torch.allclose(permuted.images, decoded.images, atol=1e-5)
    assert torch.allclose(permuted.masks, decoded.masks[:, order], atol=1e-5)


def test_permuted_first_guesses_permute_the_slots_of_all_frames():
    model, video = savi().eval(), images()
    order = torch.tensor([1, 2, 0])
    slots, _ = model.encode(video, None)

    model.initial_slots.data = model.initial_slots.data[:, order]
    permuted, _ = model.encode(video, None)

    assert torch.allclose(permuted, slots[:, :, order], atol=1e-5)
    assert not torch.allclose(permuted, slots, atol=1e-2)


def test_slots_depend_on_no_later_frame_and_on_earlier_ones():
    model, video = savi().eval(), images(time=4)
    slots, _ = model.encode(video, None)
    changed = video.clone()
    changed[:, 2:] = images(time=2, seed=5)

    assert torch.equal(model.encode(changed, None)[0][:, :2], slots[:, :2])
    assert not torch.allclose(model.encode(changed, None)[0][:, 2:], slots[:, 2:], atol=1e-3)
    assert torch.allclose(model.encode(video[:, :2], None)[0], slots[:, :2], atol=1e-6)
    assert not torch.allclose(model.encode(video[:, 1:], None)[0], slots[:, 1:], atol=1e-3)


def test_a_video_in_pieces_gives_the_slots_of_the_whole_when_the_state_goes_along():
    model, video = savi().eval(), images(time=5)
    whole, last = model.encode(video, None)

    first, state = model.encode(video[:, :3], None)
    second, end = model.encode(video[:, 3:], state)

    assert torch.allclose(torch.cat([first, second], dim=1), whole, atol=1e-6)
    assert torch.allclose(end.cell, last.cell, atol=1e-6)
    forgotten = SlotState(slots=state.slots, hidden=torch.zeros_like(state.hidden), cell=torch.zeros_like(state.cell))
    assert not torch.allclose(model.encode(video[:, 3:], forgotten)[0], second, atol=1e-4)


def test_two_calls_on_one_video_agree():
    model, video = savi().eval(), images()

    assert torch.equal(model.encode(video, None)[0], model.encode(video, None)[0])


def test_all_that_is_used_gets_a_gradient():
    model, video = savi(), images()
    slots, _ = model.encode(video, None)
    (model.decoder(slots).images - video).square().mean().backward()

    for name, parameter in model.named_parameters():
        assert parameter.grad is not None, name
        if name.startswith("kernel_head.3."):
            assert parameter.grad[:16].abs().max() > 0 and (parameter.grad[16:] == 0).all()
        else:
            assert parameter.grad.abs().max() > 0, name


def test_the_kernel_head_may_be_left_out():
    model = savi(kernel_head=False)

    assert model.encode(images(), None)[0].shape == (2, 3, 3, 16)
    assert not [name for name in model.state_dict() if name.startswith("kernel_head")]


def test_images_of_another_size_are_refused():
    with pytest.raises(ValueError, match="16 pixels square"):
        savi().encode(images(size=8), None)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"num_slots": 0}, "num_slots"),
        ({"resolution": 24}, "resolution"),
        ({"resolution": 128}, "not to resolution 128"),
        ({"encoder_first_stride": 3}, "first_stride"),
        ({"encoder_kernel_size": 4}, "kernel_size"),
        ({"encoder_channels": []}, "channels"),
        ({"decoder_kernel_size": 4}, "kernel_size"),
        ({"decoder_channels": [8, 8, 8]}, "slot_dim 16"),
        ({"predictor_num_heads": 3}, "num_heads"),
        ({"predictor_num_layers": 0}, "num_layers"),
        ({"dropout": 1.0}, "dropout"),
    ],
)
def test_wrong_settings_are_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        savi(**changes)
